"""One style for every figure: widths, letters, and the look of every algorithm."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import ArrayLike, NDArray

COLUMN_WIDTH = 3.5  # inches, one column of the paper
TEXT_WIDTH = 7.16  # inches, both columns

LETTERS, SMALL = 8, 7  # points: titles and names of axes; numbers, legends and notes. No other.

RC: dict[str, Any] = {
    "font.family": "STIXGeneral",  # Times-like, shipped with matplotlib: the same on every machine
    "mathtext.fontset": "stix",
    "font.size": LETTERS,
    "axes.titlesize": LETTERS,
    "axes.labelsize": LETTERS,
    "figure.titlesize": LETTERS,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "legend.fontsize": SMALL,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.2,
    "lines.solid_capstyle": "round",
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "hatch.linewidth": 0.4,
    "figure.dpi": 150,
    "pdf.fonttype": 42,  # text stays text
    "figure.constrained_layout.use": True,
}

# Okabe-Ito colours: distinct under the common colour-vision deficiencies. In grey the markers and
# lines tell algorithms apart: certificate learners have long lines, CMDP baselines dashes, fixed
# energies dots.
_SOLID, _DASHED, _DOTTED = "-", (0, (4, 1.5)), (0, (1, 1.2))
_DASH_DOTTED = (0, (4, 1.2, 1, 1.2))
_LONG, _SHORT, _DASH_DASHED, _SPARSE = (
    (0, (9, 1.5)),
    (0, (2, 1)),
    (0, (6, 1.2, 2, 1.2)),
    (0, (1, 2.4)),
)
_WARM, _COLD = ("#D55E00", "#AA3377", "#CCBB44"), ("#0072B2", "#1B1464", "#66CCEE")
_FORMS = {"": _SOLID, "literal": _DASH_DOTTED, "released": _DASHED}  # "": floored
_TRAVELS = {"0.1": "v", "0.33": "p", "1": "^", "3.3": ">"}
_ALGORITHMS: dict[str, tuple[str, Any, str, str]] = {  # label -> colour, line, marker, mathtext
    "SafeMR": ("#D55E00", _SOLID, "o", "SafeMR"),
    "JointSIS": ("#0072B2", _LONG, "s", "JointSIS"),
    "PPO-L": ("#009E73", _DASHED, "^", "PPO-L"),
    "TRPO-L": ("#56B4E9", _SHORT, "v", "TRPO-L"),
    "CPO": ("#CC79A7", _DASH_DASHED, "D", "CPO"),
    "FAC-phi0": ("#555555", _DOTTED, "P", r"FAC-$\phi_0$"),
    "FAC-phih": ("#E69F00", _SPARSE, "X", r"FAC-$\phi_h$"),
    "SAC-L": ("#000000", _DASHED, "*", "SAC-L"),
    # config/oracle.yaml
    "FAC-oracle": ("#882255", _DOTTED, "p", "FAC-oracle"),
    "SafeMR-guarded": ("#117733", _SOLID, "h", "SafeMR-guarded"),
    "SafeMR-guarded-above": ("#44AA99", _DASHED, "h", "SafeMR-guarded-above"),
    "SafeMR-guarded-below": ("#999933", _SHORT, "h", "SafeMR-guarded-below"),
    # config/variants.yaml
    "SafeMR-literal": ("#AA3377", _DASH_DOTTED, ">", "SafeMR-literal"),
    "SafeMR-floor-0.02": ("#CCBB44", _DASH_DOTTED, "h", "SafeMR-floor-0.02"),
    "SafeMR-floor-0": ("#EE6677", _DASH_DOTTED, "p", "SafeMR-floor-0"),
    "SafeMR-replay": ("#228833", _DASH_DOTTED, "8", "SafeMR-replay"),
    "JointSIS-literal": ("#1B1464", _DASH_DOTTED, "<", "JointSIS-literal"),
    "JointSIS-released": ("#66CCEE", _DASH_DOTTED, "d", "JointSIS-released"),
    "SafeMR-free": ("#332288", _SHORT, "d", "SafeMR-free"),
    "JointSIS-free": ("#44AA99", _SHORT, "D", "JointSIS-free"),
    # config/pabal.yaml
    "SafeMR-2-2-2": ("#0072B2", _DASHED, "s", "SafeMR-2-2-2"),
    "SafeMR-4-4-4": ("#009E73", _DASH_DOTTED, "^", "SafeMR-4-4-4"),
    "SafeMR-256": ("#882255", _LONG, "p", "SafeMR-256"),
    "SafeMR-256-2-2-2": ("#56B4E9", _SHORT, "D", "SafeMR-256-2-2-2"),
    "SafeMR-256-4-4-4": ("#999933", _DASH_DASHED, "v", "SafeMR-256-4-4-4"),
}
# config/forms_tuning.yaml: colour for algorithm and form, line for the form, marker for the travel.
for _base, _tints in (("SafeMR", _WARM), ("JointSIS", _COLD)):
    for (_form, _line), _tint in zip(_FORMS.items(), _tints, strict=True):
        for _travel, _marker in _TRAVELS.items():
            _name = "-".join(part for part in (_base, _form, _travel) if part)
            _ALGORITHMS[_name] = (_tint, _line, _marker, _name)
# config/forms.yaml: each form at one travel.
_ALGORITHMS["SafeMR-released"] = (_WARM[2], _DASHED, "<", "SafeMR-released")
_ALGORITHMS["JointSIS-floored"] = ("#44AA99", _LONG, "v", "JointSIS-floored")
# The two other points [a, b] of the paper, beside certificates of all kinds.
_ALGORITHMS["SafeMR[0.45,0.15]"] = ("#EE3377", _SHORT, "^", "SafeMR[0.45,0.15]")
_ALGORITHMS["SafeMR[0.35,0.25]"] = ("#994F00", _DASHED, "v", "SafeMR[0.35,0.25]")
# For variants that nobody planned: Tol's "muted" colours, lines and markers, by a checksum of the
# label, the same in every figure.
_OTHERS = ("#882255", "#117733", "#332288", "#999933", "#AA4499", "#88CCEE", "#44AA99", "#CC6677")
_OTHER_LINES = (_DASH_DOTTED, _DASHED, _SHORT, _DASH_DASHED)
_OTHER_MARKERS = "d*<>ph8H"

Look = tuple[str, Any, str]  # colour, line style, marker

UNSAFE = "#C44E52"  # true or actual violation
INK = "0.25"


styled = matplotlib.rc_context(cast(Any, RC))  # decorator of every function that builds a figure


def _other(variant: str) -> Look:
    """The look of an unknown name, which few other names share."""
    rest, tint = divmod(zlib.crc32(variant.encode()), len(_OTHERS))
    rest, line = divmod(rest, len(_OTHER_LINES))
    return _OTHERS[tint], _OTHER_LINES[line], _OTHER_MARKERS[rest % len(_OTHER_MARKERS)]


def colour(variant: str) -> str:
    """The variant's colour, the same in every figure; unknown names get one by their checksum."""
    return _ALGORITHMS.get(variant, _other(variant))[0]


def line_style(variant: str) -> Any:
    """Matplotlib line style of the variant's family; unknown names: by their checksum."""
    return _ALGORITHMS.get(variant, _other(variant))[1]


def look(variant: str) -> Look:
    """Colour, line and marker of a variant."""
    return colour(variant), line_style(variant), marker(variant)


def member_look(index: int) -> Look:
    """Look of the members of a group that is drawn alone: the first solid and dark."""
    if index == 0:
        return "#000000", _SOLID, "o"
    line = (_DASHED, _DOTTED, _SOLID)[(index - 1) % 3]
    return _OTHERS[(index - 1) % len(_OTHERS)], line, "s^vDPX"[(index - 1) % 6]


def marker(variant: str) -> str:
    """Matplotlib marker of the variant; unknown names: by their checksum."""
    return _ALGORITHMS.get(variant, _other(variant))[2]


def label(variant: str) -> str:
    """The name as printed in a figure (mathtext)."""
    known = _ALGORITHMS.get(variant)
    return known[3] if known else variant


def marks(variants: Iterable[str]) -> list[Line2D]:
    """Entries of a legend for variants that are drawn as markers, in the order given."""
    return [
        Line2D([], [], color=colour(v), marker=marker(v), ls="none", ms=4, label=label(v))
        for v in variants
    ]


def ordered(variants: Iterable[str]) -> list[str]:
    """Known algorithms in the paper's order, then the others by name."""
    rank = {name: index for index, name in enumerate(_ALGORITHMS)}
    return sorted(set(variants), key=lambda name: (rank.get(name, len(rank)), name))


def legend_columns(variants: Iterable[str]) -> int:
    """As many columns as the longest name leaves room for: what does not fit would be cut off."""
    lengths = [len(variant) for variant in variants]
    return max(1, min(len(lengths), 8, 96 // (max(lengths, default=1) + 5)))


def legend_below(figure: Figure, handles: Sequence[Artist], columns: int) -> Legend:
    """A legend under all panels in so many columns, or in fewer where it would be cut off."""
    while True:
        legend = figure.legend(handles=handles, loc="outside lower center", ncols=columns)
        if columns <= 1 or legend.get_window_extent().width <= figure.bbox.width:
            return legend
        legend.remove()
        columns -= 1


def new_figure(width: float, height: float) -> Figure:
    """An empty figure in inches, with a canvas of its own (no display, no global state)."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def row_width(panels: int) -> float:
    """Width in inches, of those that a page has, of a row of square panels."""
    return (COLUMN_WIDTH, 0.8 * TEXT_WIDTH, text_width(panels))[min(panels, 3) - 1]


def text_width(panels: int) -> float:
    """Width in inches of a row of panels over both columns: as the paper's four, more are wider.

    Narrower ones would write over each other; a page scales the whole row.
    """
    return TEXT_WIDTH * max(1.0, panels / 4)


def steady(values: ArrayLike) -> NDArray[np.float64]:
    """Values of a drawing in metres, seconds or the like, to a millionth; nan stays nan.

    Powers and sines differ between processors in their last bits, which decide where a contour
    passes a node of the grid, and with it some pixels. What comes from such a function is rounded
    before it is drawn, or compared with a threshold, so that every machine draws the same bytes:
    to a multiple of 2^-20, because round decimals, which grids have, are never halfway between two.
    """
    return np.round(np.asarray(values, np.float64) * 2.0**20) / 2.0**20


def interval_line(
    ax: Axes, table: pd.DataFrame, look: Look, *, place: int, of: int
) -> pd.DataFrame:
    """A mean as a line and markers; at some of them, others for each of ``of`` lines, its interval.

    table: x, mean, low, high. Shaded bands of many lines lie upon each other; whiskers at every
    ``of``-th point, counted from the last, with an offset of ``place``, do not. Returns those rows.
    """
    tint, line, mark = look
    shown = list(range(len(table)))[::-1][min(place, max(len(table) - 1, 0)) :: of]
    chosen = table.iloc[shown]
    ax.plot(table["x"], table["mean"], color=tint, ls=line, lw=1.1, marker=mark, markevery=shown,
            ms=3.8, mec="white", mew=0.4, zorder=3)  # fmt: skip
    ax.vlines(chosen["x"], chosen["low"], chosen["high"], color=tint, lw=0.8, alpha=0.7, zorder=3.5)
    return chosen


def line_entry(look: Look, text: str) -> Line2D:
    """The entry of a legend for `interval_line`."""
    tint, line, mark = look
    return Line2D([], [], color=tint, ls=line, lw=1.1, marker=mark, ms=3.8, mec="white", mew=0.4,
                  label=text)  # fmt: skip


def mark_zoom(ax: Axes, near: Axes) -> None:
    """A frame around what ``near``, an inset of ``ax``, shows larger."""
    near.spines[:].set(visible=True, color="0.4")
    (left, right), (low, high) = near.get_xlim(), near.get_ylim()
    ax.add_patch(Rectangle((left, low), right - left, high - low, fill=False, ec="0.4", lw=0.6,
                           zorder=6))  # fmt: skip


def note(ax: Axes, text: str) -> None:
    """Grey words in an empty panel."""
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", color="0.4", style="italic",
            fontsize=SMALL)  # fmt: skip


def steps_axis(ax: Axes, *, logarithmic: bool = False) -> None:
    """The x axis in millions of environment steps; a logarithmic one says so and has two ticks."""
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / 1e6:g}"))
    scale = ""
    if logarithmic:
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(FixedLocator(log_ticks(*ax.get_xlim())))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / 1e6:g}"))
        ax.xaxis.set_minor_locator(NullLocator())
        scale = ", log scale"
    ax.set_xlabel(f"environment steps ($10^6${scale})")


def log_ticks(low: float, high: float) -> list[float]:
    """Round numbers within [low, high] for a logarithmic axis: three or more where there are.

    Powers of ten, or 1 and 3, or 1, 2 and 5 times those; beside a single one both ends.
    """
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    inside: list[float] = []
    for steps, enough in (((1,), 3), ((1, 3), 3), ((1, 2, 5), 2)):
        ticks = sorted({float(step * power) for step in steps for power in powers})
        inside = [tick for tick in ticks if 0.999 * low <= tick <= 1.001 * high]
        if len(inside) >= enough:
            return inside
    return sorted({low, *inside, high})


def panel_letter(ax: Axes, letter: str) -> None:
    """(a), (b), ... above the upper left corner."""
    ax.set_title(f"({letter})", loc="left", fontweight="bold")


def save(figure: Figure, stem: Path | str) -> tuple[Path, Path]:
    """Write <stem>.pdf (vector) and <stem>.png (300 dpi) without dates; returns both paths."""
    pdf, png = Path(f"{stem}.pdf"), Path(f"{stem}.png")
    pdf.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(cast(Any, RC)):
        figure.savefig(pdf, metadata={"CreationDate": None})
        figure.savefig(png, dpi=300, metadata={"Software": None})
    return pdf, png
