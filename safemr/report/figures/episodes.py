"""An episode as a film: the scene, or the plane that phi is of, and what phi and the filter did."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import animation
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from safemr.certificates.bound import BoundCertificate
from safemr.errors import UserError
from safemr.files import Arrays
from safemr.measure.tracks import scene_at
from safemr.report.figures import style
from safemr.report.figures.scenes import DrawScene

DPI = 100
WIDTH, HEIGHT = 7.2, 3.3  # inches
TRAIL = 75  # steps of the path that are shown
WINDOW = 200  # steps around the present one that the right side shows
INTERVENED, VIOLATING, COURSE = "#D55E00", "#B2182B", "#009E73"
WRITERS: dict[str, Any] = {".gif": animation.PillowWriter, ".mp4": animation.FFMpegWriter}


def check_video(path: Path) -> None:
    """Raises UserError where a film cannot be written to this file on this machine."""
    if path.suffix not in WRITERS:
        raise UserError(f"--video {path}: it must end in {' or '.join(WRITERS)}")
    if not WRITERS[path.suffix].isAvailable():
        raise UserError(f"--video {path}: ffmpeg, which writes it, is not installed; use .gif")


@style.styled
def film(
    data: Arrays,
    certificate: BoundCertificate,
    path: Path,
    *,
    title: str,
    acts: bool,
    draw_scene: DrawScene | None = None,
    stride: int = 4,
    step_s: float = 0.02,
) -> None:
    """Write `safemr.measure.filters.episode` as .gif or .mp4, every ``stride``-th step of it.

    In real time where a step takes ``step_s`` [s]. acts: whether the filter's actions were flown.
    draw_scene draws the left side (`envs.drawing`); without it or a scene in the data that is
    phi's plane, with the nearest obstacle in it. Raises UserError as `check_video`.
    """
    check_video(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(WIDTH, HEIGHT), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.25])
    energy, size = right.inset_axes((0, 0.42, 1, 0.58)), right.inset_axes((0, 0, 1, 0.3))
    right.axis("off")
    energy.sharex(size)
    cursors = _history(data, energy, size, acts)
    scene = _scene(data, left, draw_scene) if draw_scene and "robot" in data else None
    move = scene or _plane(data, left, certificate)
    figure.suptitle(title, fontsize=style.LETTERS)
    writer = WRITERS[path.suffix](fps=max(1, round(1 / (stride * step_s))))
    with writer.saving(figure, path, DPI):
        for step in range(0, len(data["phi"]), stride):
            move(step)
            for cursor in cursors:
                cursor.set_xdata([step, step])
            shown = min(WINDOW, len(data["phi"]))
            first = min(max(0, step - shown // 2), len(data["phi"]) - shown)
            size.set_xlim(first, first + shown)
            writer.grab_frame()


def _scene(data: Arrays, ax: Axes, draw_scene: DrawScene) -> Callable[[int], None]:
    """Draws a step of an episode seen from above."""

    def move(step: int) -> None:
        ax.clear()
        draw_scene(ax, scene_at(data, 0, step))
        begin = max(0, step - TRAIL)
        trail = data["robot"][begin : step + 1, 0, :2]
        ax.plot(*trail.T, color="0.3", lw=1, zorder=7)
        changed = trail[data["intervened"][begin : step + 1]]
        ax.plot(*changed.T, ls="none", marker=".", ms=3, color=INTERVENED, zorder=8)
        goals = int(data["goal_met"][:step].sum())
        total = float(data["reward"][:step].sum())
        bad = int(data["violating"][:step].sum())
        ax.set(title=f"return {total:.1f}, goals {goals}, violating steps {bad}", xticks=[],
               yticks=[], xlabel="", ylabel="")  # fmt: skip

    return move


def _plane(data: Arrays, ax: Axes, certificate: BoundCertificate) -> Callable[[int], None]:
    """Draws phi's plane once, and moves the obstacle that phi is of in it."""
    if certificate.certificate.observes:
        ax.set(xlabel="distance $d$ (m)", ylabel=r"rate $\dot d$ (m/s)")
        ax.plot(data["d"], data["d_dot"], color="0.85", lw=0.5)
    else:
        certificate.plot(ax, speed=max(1e-3, float(np.abs(data["d_dot"]).max())))
    (trail,) = ax.plot([], [], color=COURSE, lw=1.2)
    (point,) = ax.plot([], [], ls="none", marker="o", color=COURSE, ms=4)

    def move(step: int) -> None:
        part = slice(max(0, step - TRAIL), step + 1)
        trail.set_data(data["d"][part], data["d_dot"][part])
        point.set_data(data["d"][[step]], data["d_dot"][[step]])

    return move


def _history(data: Arrays, energy: Axes, size: Axes, acts: bool) -> list[Any]:
    """phi over the steps, and below it the size of the interventions; returns their cursors."""
    steps = np.arange(len(data["phi"]))
    phi, intervened = data["phi"], data["intervened"]
    energy.axhspan(0, max(1e-3, 1.1 * float(phi.max())), color=VIOLATING, alpha=0.12, lw=0)
    energy.axhline(0, color="k", lw=0.8)
    energy.plot(steps, phi, color="0.2", lw=1)
    at = np.flatnonzero(intervened)
    word = "filter acts" if acts else "filter would act"
    energy.plot(at, phi[at], ls="none", marker=".", ms=3, color=INTERVENED, label=word)
    none = np.flatnonzero(~data["feasible"])
    if len(none):
        energy.plot(none, phi[none], ls="none", marker="x", ms=4, color="k", label="no safe action")
    energy.set_ylabel(r"energy $\phi$")
    energy.legend(loc="lower right", fontsize=style.SMALL)
    energy.tick_params(labelbottom=False)
    size.fill_between(steps, 0, data["distance"], step="post", color=INTERVENED, lw=0)
    size.set(xlabel="step", ylabel="change", ylim=(0, max(1.0, 1.1 * data["distance"].max())))
    return [ax.axvline(0, color="0.4", lw=0.8) for ax in (energy, size)]
