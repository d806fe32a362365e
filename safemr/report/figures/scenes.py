"""Scenes seen from above: the environments, trajectories side by side, short animations.

The drawing of a scene itself belongs to the environments (`envs.drawing.draw_scene`) and is handed
in, so that this package needs none of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from safemr.measure.tracks import Arrays, scene_at
from safemr.report.figures import style

DrawScene = Callable[..., Axes]  # (ax, scene, trajectory or None)


@style.styled
def environments(scenes: Mapping[str, Any], draw_scene: DrawScene) -> Figure:
    """Fig. "experimentenvs": one layout of each task; scenes: task -> scene."""
    figure = style.new_figure(style.row_width(len(scenes)), 2.0)
    axes = figure.subplots(1, len(scenes), squeeze=False)[0]  # tasks differ in extent
    for ax, (task, scene) in zip(axes, scenes.items(), strict=True):
        draw_scene(ax, scene)
        _frame(ax, task)
    return figure


@style.styled
def trajectories(
    recorded: Mapping[str, Arrays], draw_scene: DrawScene, *, steps: int = 300
) -> Figure:
    """The first `steps` steps of each variant (rows) on the same layouts (columns).

    recorded: variant -> `trajectories.episodes` with the same seeds. The path has the variant's
    colour; crosses mark violating steps, small rings goals that were reached, and each panel states
    the return collected. Without any recording the figure says so.
    """
    if not recorded:
        return _nothing()
    columns = next(iter(recorded.values()))["robot"].shape[1]
    figure = style.new_figure(style.TEXT_WIDTH, 0.3 + 1.75 * len(recorded))
    axes = figure.subplots(len(recorded), columns, squeeze=False, sharex="col", sharey="col")
    for row, (variant, data) in zip(axes, recorded.items(), strict=True):
        for episode, ax in enumerate(row):
            _draw_path(data, episode, steps, ax, draw_scene, style.colour(variant))
            total = float(data["reward"][:steps, episode].sum())
            _frame(ax, f"return {total:.1f}".replace("-", "\N{MINUS SIGN}"))
            view = _view(list(recorded.values()), episode, steps)
            ax.set(xlim=view[0], ylim=view[1])
        row[0].set_ylabel(style.label(variant), color=style.colour(variant))
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
) -> None:
    """A GIF of the variants side by side on one layout, in real time for stride 4 (80 ms a frame).

    One palette serves all frames, which keeps the file small; it loops for ever. Without any
    recording it is one frame that says so, and a shorter recording ends earlier.
    """
    steps = min([steps, *(len(data["robot"]) - 1 for data in recorded.values())])
    shown = range(0, steps + 1, stride)
    frames = (
        _frames(recorded, draw_scene, episode, shown, pixels) if recorded else [_pixels(_nothing())]
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
) -> list[Image.Image]:
    """A picture a step, on one figure: new axes and their layout cost more than the drawing."""
    dpi = 100
    figure = style.new_figure(len(recorded) * pixels / dpi, 1.1 * pixels / dpi)
    figure.set_dpi(dpi)
    axes = figure.subplots(1, len(recorded), squeeze=False)[0]
    view = _view(list(recorded.values()), episode)
    frames = []
    for step in steps:
        for ax, (variant, data) in zip(axes, recorded.items(), strict=True):
            for artist in (*ax.patches, *ax.lines):
                artist.remove()
            draw_scene(ax, scene_at(data, episode, step))
            path = data["robot"][max(0, step - 75) : step + 1, episode, :2]
            ax.plot(*path.T, color=style.colour(variant), lw=1)
            goals = int(data["goal_met"][:step, episode].sum())
            _frame(ax, f"{style.label(variant)}: goals {goals}")
            ax.set(xlim=view[0], ylim=view[1])
        frames.append(_pixels(figure))
        figure.set_layout_engine("none")  # what the first frame found fits the others
    return frames


def _pixels(figure: Figure) -> Image.Image:
    figure.canvas.draw()
    return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())  # type: ignore[attr-defined]


def _draw_path(
    data: Arrays, episode: int, steps: int, ax: Axes, draw_scene: DrawScene, tint: str
) -> None:
    draw_scene(ax, scene_at(data, episode, 0))
    path = data["robot"][: steps + 1, episode, :2]
    ax.plot(path[:, 0], path[:, 1], color=tint, lw=0.9, zorder=7)
    ax.plot(*path[-1], marker="o", ms=3, color=tint, mec="white", mew=0.5, zorder=8)
    violating = path[1:][data["cost_indicator"][:steps, episode] > 0]
    ax.plot(violating[:, 0], violating[:, 1], ls="none", marker="x", ms=3, color="k", zorder=9)
    met = np.flatnonzero(data["goal_met"][:steps, episode] > 0)
    goals = data["goal"][met, episode]
    ax.plot(goals[:, 0], goals[:, 1], ls="none", marker="o", mfc="none", mec="0.35", ms=4, mew=0.6,
            zorder=3)  # fmt: skip
    if data["box"].shape[-1] and not np.isnan(data["box"][0, episode]).any():
        box = data["box"][: steps + 1, episode, :2]
        ax.plot(box[:, 0], box[:, 1], color="#8a6a00", lw=0.8, ls=(0, (2, 1)), zorder=6)


def _view(
    recordings: Sequence[Arrays], episode: int, steps: int | None = None
) -> NDArray[np.float64]:
    """[2, 2] limits of x and y: the task's square, widened by up to half to hold what moves."""
    extent = float(recordings[0]["extent"])
    low, high = np.full(2, -extent), np.full(2, extent)
    end = None if steps is None else steps + 1
    for data in recordings:
        for name, margin in (("robot", 0.2), ("box", 0.4)):
            points = data[name][:end, episode, :2]
            if points.size and not np.isnan(points).all():
                low = np.fmin(low, np.nanmin(points, 0) - margin)
                high = np.fmax(high, np.nanmax(points, 0) + margin)
    return np.stack([np.maximum(low, -1.5 * extent), np.minimum(high, 1.5 * extent)], -1)


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
