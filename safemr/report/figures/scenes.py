"""Scenes seen from above: the environments, trajectories side by side, short animations.

The drawing of a scene itself belongs to the environments (`envs.drawing.draw_scene`) and is handed
in, so that this package needs none of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from PIL import Image

from safemr.certificates.point_robot import ROBOT
from safemr.measure.tracks import Arrays, scene_at
from safemr.report.figures import style

Array = NDArray[np.float64]
DrawScene = Callable[..., Axes]  # (ax, scene, trajectory or None)
Entries = Callable[[Any], Sequence[Artist]]  # legend entries of a scene: envs.drawing.legend_of
Phi = Callable[
    [Array, Array], Array
]  # energy of distances [m] and their rates [m/s], [..., M] each

_PATH_OF_BOX: dict[str, Any] = {"color": "#8a6a00", "lw": 0.8, "ls": (0, (2, 1))}
_VIOLATION: dict[str, Any] = {"ls": "none", "marker": "x", "ms": 4, "color": "k"}
_REACHED: dict[str, Any] = {
    "ls": "none",
    "marker": "o",
    "mfc": "none",
    "mec": "0.35",
    "ms": 4,
    "mew": 0.6,
}


@style.styled
def environments(
    scenes: Mapping[str, Any], draw_scene: DrawScene, entries: Entries | None = None
) -> Figure:
    """Fig. "experimentenvs": one layout of each task with a scale; scenes: task -> scene."""
    figure = style.new_figure(style.row_width(len(scenes)), 2.3)
    axes = figure.subplots(1, len(scenes), squeeze=False)[0]  # tasks differ in extent
    for ax, (task, scene) in zip(axes, scenes.items(), strict=True):
        draw_scene(ax, scene)
        _frame(ax, task)
        _scale_bar(ax)
    _scene_legend(figure, list(scenes.values()), entries)
    return figure


@style.styled
def trajectories(
    recorded: Mapping[str, Arrays],
    draw_scene: DrawScene,
    *,
    steps: int = 300,
    entries: Entries | None = None,
) -> Figure:
    """The first `steps` steps of each variant (rows) on the same layouts (columns).

    recorded: variant -> `trajectories.episodes` with the same seeds. The path has the variant's
    colour and a dot every second; crosses mark violating steps, small rings goals that were
    reached, and each panel states the return collected. All panels have one view, which holds all
    paths. Without any recording the figure says so.
    """
    if not recorded:
        return _nothing()
    columns = next(iter(recorded.values()))["robot"].shape[1]
    figure = style.new_figure(style.TEXT_WIDTH, 0.7 + 1.85 * len(recorded))
    axes = figure.subplots(len(recorded), columns, squeeze=False, sharex=True, sharey=True)
    view = _view(list(recorded.values()), slice(None), steps)
    for row, (variant, data) in zip(axes, recorded.items(), strict=True):
        for episode, ax in enumerate(row):
            _draw_path(data, episode, steps, ax, draw_scene, style.colour(variant))
            total = float(data["reward"][:steps, episode].sum())
            _frame(ax, f"return {total:.1f}".replace("-", "\N{MINUS SIGN}"))
            ax.set(xlim=view[0], ylim=view[1])
        row[0].set_ylabel(style.label(variant))
    _scale_bar(axes[-1, 0])
    tints = [style.colour(variant) for variant in recorded]
    seconds = steps * ROBOT.step_s
    handles: list[Artist] = [
        *(Line2D([], [], color=tint, lw=0.9, marker=".", ms=4,
                 label=f"{style.label(name)}, {seconds:g} s, a dot a second")
          for tint, name in zip(tints, recorded, strict=True)),
        Line2D([], [], **_REACHED, label="goal reached"),
        Line2D([], [], **_VIOLATION, label="violating step"),
    ]  # fmt: skip
    shown = [scene_at(data, 0, 0) for data in recorded.values()]
    if shown[0].box is not None:
        handles.append(Line2D([], [], **_PATH_OF_BOX, label="path of the box"))
    _scene_legend(figure, shown, entries, handles)
    return figure


def animation(
    recorded: Mapping[str, Arrays],
    draw_scene: DrawScene,
    path: Path | str,
    *,
    episode: int = 0,
    steps: int = 400,
    stride: int = 4,
    pixels: int = 220,
    energies: Mapping[str, Phi | None] | None = None,
    entries: Entries | None = None,
) -> None:
    """A GIF of the variants side by side on one layout, in real time for stride 4 (80 ms a frame).

    Violating steps are counted and marked; with ``energies`` the zero level of each variant's phi
    is drawn, for a robot that moves as its own does. One palette serves all frames, which keeps
    the file small; it loops for ever. Without any recording it is one frame that says so, and a
    shorter recording ends earlier.
    """
    steps = min([steps, *(len(data["robot"]) - 1 for data in recorded.values())])
    shown = range(0, steps + 1, stride)
    frames = (
        _frames(recorded, draw_scene, episode, shown, pixels, energies, entries)
        if recorded
        else [_pixels(_nothing())]
    )
    width, height = frames[0].size
    sample = Image.new("RGB", (width, 3 * height))
    for place, frame in enumerate((frames[0], frames[len(frames) // 2], frames[-1])):
        sample.paste(frame, (0, place * height))
    palette = sample.quantize(64)
    images = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=20 * stride, loop=0, optimize=True
    )


@style.styled
def _frames(
    recorded: Mapping[str, Arrays],
    draw_scene: DrawScene,
    episode: int,
    steps: Sequence[int],
    pixels: int,
    energies: Mapping[str, Phi | None] | None,
    entries: Entries | None,
) -> list[Image.Image]:
    """A picture a step, on one figure: new axes and their layout cost more than the drawing."""
    dpi = 100
    wide = pixels / dpi
    figure = style.new_figure(len(recorded) * wide, 1.1 * wide + 0.55 * (entries is not None))
    figure.set_dpi(dpi)
    axes = figure.subplots(1, len(recorded), squeeze=False)[0]
    if entries is not None:
        level = Line2D([], [], color=_LEVEL, lw=1.4, label=r"$\phi=0$ at the robot's velocity")
        handles = [level, Line2D([], [], **_VIOLATION, label="violating step")]
        _scene_legend(figure, [scene_at(data, episode, 0) for data in recorded.values()], entries,
                      handles)  # fmt: skip
    view = _view(list(recorded.values()), episode)
    frames = []
    for step in steps:
        if entries is not None:
            figure.suptitle(f"{step * ROBOT.step_s:4.1f} s")
        for ax, (variant, data) in zip(axes, recorded.items(), strict=True):
            for artist in (*ax.patches, *ax.lines, *ax.collections):
                artist.remove()
            draw_scene(ax, scene_at(data, episode, step))
            path = data["robot"][max(0, step - 75) : step + 1, episode, :2]
            ax.plot(*path.T, color=style.colour(variant), lw=1)
            bad = data["cost_indicator"][:step, episode] > 0
            ax.plot(*data["robot"][1 : step + 1, episode, :2][bad].T, **_VIOLATION, zorder=9)
            phi = (energies or {}).get(variant)
            if phi is not None:
                _zero_level(ax, phi, data, episode, step, view)
            goals = int(data["goal_met"][:step, episode].sum())
            name = f"{style.label(variant)}: goals {goals}"
            _frame(ax, f"{name}, violating steps {bad.sum()}" if energies is not None else name)
            ax.set(xlim=view[0], ylim=view[1])
            if bad[-1:].any():
                for spine in ax.spines.values():
                    spine.set(color=style.UNSAFE, linewidth=2.5)
        frames.append(_pixels(figure))
        figure.set_layout_engine("none")  # what the first frame found fits the others
    return frames


_LEVEL = "#CC79A7"


def _zero_level(
    ax: Axes, phi: Phi, data: Arrays, episode: int, step: int, view: Array, points: int = 121
) -> None:
    """Where the energy of a robot with this one's velocity would be 0."""
    track = data["robot"][:, episode, :2].astype(float)
    last = max(step, 1)
    velocity = (track[last] - track[last - 1]) / ROBOT.step_s
    x, y = (np.linspace(low, high, points) for low, high in view)
    gaps = np.stack(np.meshgrid(x, y), -1)[..., None, :] - data["obstacles"][episode]
    d = np.maximum(np.linalg.norm(gaps, axis=-1), 1e-6)
    values = style.steady(phi(d, (gaps @ velocity) / d))
    ax.contour(x, y, values, levels=[0.0], colors=[_LEVEL], linewidths=1.4, zorder=3)


def _pixels(figure: Figure) -> Image.Image:
    figure.canvas.draw()
    return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())  # type: ignore[attr-defined]


def _draw_path(
    data: Arrays, episode: int, steps: int, ax: Axes, draw_scene: DrawScene, tint: str
) -> None:
    draw_scene(ax, scene_at(data, episode, 0))
    path = data["robot"][: steps + 1, episode, :2]
    ax.plot(path[:, 0], path[:, 1], color=tint, lw=0.9, zorder=7)
    seconds = path[:: round(1 / ROBOT.step_s)]
    ax.plot(*seconds.T, ls="none", marker=".", ms=3, color=tint, zorder=8)
    violating = path[1:][data["cost_indicator"][:steps, episode] > 0]
    ax.plot(violating[:, 0], violating[:, 1], **_VIOLATION, zorder=9)
    met = np.flatnonzero(data["goal_met"][:steps, episode] > 0)
    goals = data["goal"][met, episode]
    ax.plot(goals[:, 0], goals[:, 1], **_REACHED, zorder=3)
    if data["box"].shape[-1] and not np.isnan(data["box"][0, episode]).any():
        box = data["box"][: steps + 1, episode, :2]
        ax.plot(box[:, 0], box[:, 1], **_PATH_OF_BOX, zorder=6)


def _view(recordings: Sequence[Arrays], episodes: int | slice, steps: int | None = None) -> Array:
    """[2, 2] limits of x and y, a square: the task's, widened to hold what moves."""
    extent = float(recordings[0]["extent"])
    low, high = np.full(2, -extent), np.full(2, extent)
    end = None if steps is None else steps + 1
    for data in recordings:
        for name, margin in (("robot", 0.2), ("box", 0.4)):
            points = data[name][:end, episodes, :2].reshape(-1, 2)
            if points.size and not np.isnan(points).all():
                low = np.fmin(low, np.nanmin(points, 0) - margin)
                high = np.fmax(high, np.nanmax(points, 0) + margin)
    wide = (high - low).max()
    middle = (low + high) / 2
    return np.stack([middle - wide / 2, middle + wide / 2], -1)


def _scale_bar(ax: Axes) -> None:
    """A metre, below the lower left corner."""
    (left, _), (low, high) = ax.get_xlim(), ax.get_ylim()
    y = low - 0.06 * (high - low)
    ax.plot([left, left + 1.0], [y, y], color="k", lw=1.6, solid_capstyle="butt", clip_on=False)
    ax.annotate("1 m", (left + 1.0, y), (3, 0), textcoords="offset points", va="center",
                fontsize=style.SMALL, annotation_clip=False)  # fmt: skip
    ax.set_ylim(low, high)


def _scene_legend(
    figure: Figure,
    scenes: Sequence[Any],
    entries: Entries | None,
    others: Sequence[Artist] = (),
) -> None:
    """One legend of what all scenes and the other artists show, each name once."""
    found = {
        str(entry.get_label()): entry
        for scene in scenes
        for entry in (entries(scene) if entries else ())
    }
    found |= {str(entry.get_label()): entry for entry in others}
    if found:
        width = figure.get_figwidth() / style.TEXT_WIDTH
        longest = max(map(len, found)) + 7
        columns = max(1, min(len(found), int(110 * width / longest)))
        style.legend_below(figure, list(found.values()), columns)


@style.styled
def _nothing() -> Figure:
    figure = style.new_figure(style.COLUMN_WIDTH, 0.6)
    figure.text(0.5, 0.5, "no policy recorded", ha="center", color="0.5", style="italic")
    return figure


def _frame(ax: Axes, title: str) -> None:
    ax.set(title=title, xlabel="", ylabel="", xticks=[], yticks=[])
    ax.grid(False)
    for spine in ax.spines.values():
        spine.set(visible=True, color="0.6", linewidth=0.5)
