"""One style for every figure: widths, fonts, and one colour and line style per algorithm."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import ArrayLike, NDArray

COLUMN_WIDTH = 3.5  # inches, one column of the paper
TEXT_WIDTH = 7.16  # inches, both columns

RC: dict[str, Any] = {
    "font.family": "STIXGeneral",  # Times-like, shipped with matplotlib: the same on every machine
    "mathtext.fontset": "stix",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
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
    "legend.handlelength": 1.8,
    "hatch.linewidth": 0.4,
    "figure.dpi": 150,
    "pdf.fonttype": 42,  # text stays text
    "figure.constrained_layout.use": True,
}

# Okabe-Ito colours: distinct under the common colour-vision deficiencies. The line style tells the
# families apart in grey: certificate learners solid, CMDP baselines dashed, fixed energies dotted.
_SOLID, _DASHED, _DOTTED = "-", (0, (4, 1.5)), (0, (1, 1.2))
_DASH_DOTTED = (0, (4, 1.2, 1, 1.2))
_ALGORITHMS: dict[str, tuple[str, Any, str, str]] = {  # label -> colour, line, marker, mathtext
    "SafeMR": ("#D55E00", _SOLID, "o", "SafeMR"),
    "JointSIS": ("#0072B2", _SOLID, "s", "JointSIS"),
    "PPO-L": ("#009E73", _DASHED, "^", "PPO-L"),
    "TRPO-L": ("#56B4E9", _DASHED, "v", "TRPO-L"),
    "CPO": ("#CC79A7", _DASHED, "D", "CPO"),
    "FAC-phi0": ("#555555", _DOTTED, "P", r"FAC-$\phi_0$"),
    "FAC-phih": ("#E69F00", _DOTTED, "X", r"FAC-$\phi_h$"),
    "SAC-L": ("#000000", _DASHED, "*", "SAC-L"),
    # config/oracle.yaml
    "FAC-oracle": ("#882255", _DOTTED, "p", "FAC-oracle"),
    "SafeMR-guarded": ("#117733", _SOLID, "h", "SafeMR-guarded"),
    # config/variants.yaml
    "SafeMR-literal": ("#AA3377", _DASH_DOTTED, ">", "SafeMR-literal"),
    "SafeMR-floor-0.02": ("#CCBB44", _DASH_DOTTED, "h", "SafeMR-floor-0.02"),
    "SafeMR-floor-0": ("#EE6677", _DASH_DOTTED, "p", "SafeMR-floor-0"),
    "SafeMR-replay": ("#228833", _DASH_DOTTED, "8", "SafeMR-replay"),
    "JointSIS-literal": ("#1B1464", _DASH_DOTTED, "<", "JointSIS-literal"),
    "JointSIS-released": ("#66CCEE", _DASH_DOTTED, "d", "JointSIS-released"),
}
# Tol's "muted" colours for variants that nobody planned.
_OTHERS = ("#882255", "#117733", "#332288", "#999933", "#AA4499", "#88CCEE", "#44AA99", "#CC6677")

UNSAFE = "#C44E52"  # true or actual violation
INK = "0.25"


styled = matplotlib.rc_context(cast(Any, RC))  # decorator of every function that builds a figure


def colour(variant: str) -> str:
    """The variant's colour, the same in every figure; unknown names get one by their checksum."""
    known = _ALGORITHMS.get(variant)
    return known[0] if known else _OTHERS[zlib.crc32(variant.encode()) % len(_OTHERS)]


def line_style(variant: str) -> Any:
    """Matplotlib line style of the variant's family (unknown names: dash-dotted)."""
    known = _ALGORITHMS.get(variant)
    return known[1] if known else _DASH_DOTTED


def member_look(index: int) -> tuple[str, Any]:
    """Colour and line of the members of a group that is drawn alone: the first solid and dark."""
    if index == 0:
        return ("#000000", _SOLID)
    return (_OTHERS[(index - 1) % len(_OTHERS)], (_DASHED, _DOTTED, _SOLID)[(index - 1) % 3])


def marker(variant: str) -> str:
    """Matplotlib marker of the variant (unknown names: a thin diamond)."""
    known = _ALGORITHMS.get(variant)
    return known[2] if known else "d"


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


def thousands(ax: Axes) -> None:
    """Label the x axis in thousands or millions of environment steps."""
    million = ax.get_xlim()[1] >= 2e6
    unit, name = (1e6, r"$10^6$") if million else (1e3, r"$10^3$")
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / unit:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel(f"environment steps ({name})")


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
