"""Pictures of the energy function: what it means, what it allows, and how it was checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from numpy.typing import ArrayLike, NDArray

from safemr.certificates.energy import constraint, energy, largest
from safemr.certificates.feasibility import CONVENTIONS, radial_requirement
from safemr.certificates.point_robot import ROBOT
from safemr.paper import Zeta
from safemr.report.figures import style

Array = NDArray[np.float64]

# The paper's three sets: colour and line.
_PAPER = (("#000000", "-"), ("#7A7A7A", (0, (4, 1.5))), ("#A5A5A5", (0, (1, 1.2))))
# White to the method's orange, darker.
_SHADES = ListedColormap(1 - np.linspace(0, 1, 256)[:, None] * (1 - np.array([0.78, 0.26, 0.0])))
_HANDCRAFTED = {"phi_0": "FAC-phi0", "phi_h": "FAC-phih"}


# --- Fig. "energy": the energy function and the safe set -----------------------------------------


def radial_drive(distance: float, d_dot: float, zeta: Zeta, d_min: float, steps: int) -> Array:
    """[T, 2] distance and its rate of a robot that heads straight for an obstacle.

    Straight-line dynamics of `PointRobot`. Inside the safe set the robot takes the strongest thrust
    forwards that satisfies Eq. cstr0; outside it brakes with all its thrust. It ends where its
    energy has fallen well below zero again.
    """
    path = [(distance, d_dot)]
    thrusts = np.linspace(-ROBOT.thrust, ROBOT.thrust, 41)
    for _ in range(steps):
        d, rate = path[-1]
        phi = float(_phi(d, rate, d_min, zeta))
        options = [_radial_step(d, rate, thrust) for thrust in thrusts]
        safe = [(d, v) for d, v in options if constraint(phi, _phi(d, v, d_min, zeta), 0.0) < 0]
        path.append(safe[0] if safe and phi <= 0 else options[-1])
        if path[0][1] < 0 < path[-1][1] and _phi(*path[-1], d_min, zeta) < -0.1:
            break
    return np.array(path)


@style.styled
def energy_and_safe_set(zeta: Zeta, d_min: float) -> Figure:
    """Fig. "energy": phi over distance and approach speed, and along two computed drives.

    One drive starts inside the safe set and stays there (condition 1); one starts outside, at high
    energy, and dissipates it (condition 2).
    """
    figure = style.new_figure(style.TEXT_WIDTH, 2.7)
    plane, time = figure.subplots(1, 2, width_ratios=[1.35, 1])
    d, rate = np.meshgrid(np.linspace(0, 1.6, 241), np.linspace(-1.5, 0.75, 181))
    phi = _phi(d, rate, d_min, zeta)
    norm = TwoSlopeNorm(0.0, phi.min(), phi.max())
    image = plane.contourf(d, rate, phi, levels=24, cmap="RdBu_r", norm=norm)
    image.set_edgecolor("face")
    plane.contour(d, rate, phi, levels=[0.0], colors="k", linewidths=1.3)
    plane.axvspan(0, d_min, fc="0.35", alpha=0.55, hatch="////", ec="0.2", lw=0)
    plane.axhline(0, color="0.4", lw=0.5)
    drives = {
        "condition 1: stays at low energy": (radial_drive(1.55, -1.0, zeta, d_min, 100), "-"),
        "condition 2: dissipates high energy": (radial_drive(0.7, -0.8, zeta, d_min, 100), "--"),
    }
    for name, (path, line) in drives.items():
        plane.plot(*path.T, color="k", ls=line, lw=1.1)
        plane.plot(*path[0], marker="o", color="k", ms=3.5)
        plane.annotate("", path[6], path[4], arrowprops={"arrowstyle": "->", "lw": 1})
        seconds = ROBOT.step_s * np.arange(len(path))
        phi_along = _phi(path[:, 0], path[:, 1], d_min, zeta)
        time.plot(seconds, phi_along, color="k", ls=line, label=name)
    plane.set(xlabel="distance $d$ (m)", ylabel=r"rate $\dot d$ (m/s)", xlim=(0, 1.6))
    plane.grid(False)
    plane.text(d_min / 2, -0.4, "collision", rotation=90, ha="center", va="center", color="white")
    plane.text(0.62, -1.25, r"$\phi>0$: energy must fall", ha="center")
    plane.text(1.28, 0.45, r"$\phi\leq 0$: safe set", ha="center")
    bar = figure.colorbar(image, ax=plane, pad=0.02, ticks=[-2, -1, 0, 1])
    bar.set_label(r"energy $\phi$")
    top = 1.15 * time.get_ylim()[1]
    time.axhspan(0, top, color="#B2182B", alpha=0.1, lw=0)
    time.axhline(0, color="k", lw=0.8)
    time.set(xlabel="time (s)", ylabel=r"energy $\phi$", ylim=(None, top))
    time.set_xlim(left=0)
    time.legend(loc="lower right")
    for letter, ax in zip("ab", (plane, time), strict=True):
        style.panel_letter(ax, letter)
    return figure


# --- Fig. "intro": passing between two obstacles -------------------------------------------------


def admissible_speed(
    positions: Array, obstacles: Array, zeta: Zeta, d_min: float, direction: Array
) -> Array:
    """Largest speed [...] along `direction` with phi <= 0 for every obstacle; nan where phi(0) > 0.

    positions [..., 2], obstacles [M, 2]. phi is linear in d_dot, hence in the speed, so two
    evaluations give its zero; moving away from an obstacle is never limited by it.
    """
    gaps = positions[..., None, :] - obstacles
    d = np.linalg.norm(gaps, axis=-1)
    rate = (gaps * direction).sum(-1) / np.maximum(d, 1e-12)  # d_dot at 1 m/s
    at_rest = energy(d, 0.0 * d, d_min, *zeta)
    slope = energy(d, rate, d_min, *zeta) - at_rest
    with np.errstate(divide="ignore", invalid="ignore"):
        limits = np.where(style.steady(slope) > 0, -at_rest / slope, np.inf)
    speed = np.minimum(limits.min(-1), ROBOT.max_speed)
    return np.where(largest(style.steady(at_rest)) > 0, np.nan, speed)


@style.styled
def narrow_passage(
    conservative: tuple[str, Zeta], efficient: tuple[str, Zeta], d_min: float, *, gap: float = 1.0
) -> Figure:
    """Fig. "intro": speed at which a robot may drive between two pillars, for two certificates.

    gap: distance of the pillars' centres, m. Grey: phi > 0 even at rest. The third panel follows
    the middle line.
    """
    obstacles = np.array([[0.0, gap / 2], [0.0, -gap / 2]])
    x, y = np.meshgrid(np.linspace(-1.3, 1.3, 261), np.linspace(-1.15, 1.15, 231))
    positions, ahead = np.stack([x, y], -1), np.array([1.0, 0.0])
    figure = style.new_figure(style.TEXT_WIDTH, 2.05)
    *maps, line = figure.subplots(1, 3, width_ratios=[1, 1, 1])
    looks = (("#0072B2", "--"), ("#D55E00", "-"))
    for ax, (name, zeta) in zip(maps, (conservative, efficient), strict=True):
        speed = style.steady(admissible_speed(positions, obstacles, zeta, d_min, ahead))
        image = ax.pcolormesh(x, y, speed, cmap="viridis", vmin=0, vmax=ROBOT.max_speed,
                              shading="gouraud", rasterized=True)  # fmt: skip
        blocked = np.isnan(speed).astype(float)
        ax.contourf(x, y, blocked, levels=[0.5, 1.5], colors=["0.75"])
        ax.contour(x, y, blocked, levels=[0.5], colors="k", linewidths=0.9)
        for centre in obstacles:
            ax.add_patch(Circle(tuple(centre), d_min, fill=False, ec="w", ls=":", lw=1))
            ax.add_patch(Circle(tuple(centre), d_min - ROBOT.radius, fc="0.2", ec="none"))
        ax.annotate("", (-0.7, 0), (-1.2, 0), arrowprops={"arrowstyle": "->", "lw": 1.2})
        ax.set(aspect="equal", xlabel="$x$ (m)", title=name)
        ax.grid(False)
    maps[0].set_ylabel("$y$ (m)")
    figure.colorbar(image, ax=maps, pad=0.02, label="admissible speed (m/s)", shrink=0.9)
    path = np.stack([np.linspace(-1.3, 1.3, 521), np.zeros(521)], -1)
    for letter, (_, zeta), (tint, dash) in zip("ab", (conservative, efficient), looks, strict=True):
        speed = style.steady(admissible_speed(path, obstacles, zeta, d_min, ahead))
        line.plot(path[:, 0], np.nan_to_num(speed), color=tint, ls=dash, label=f"({letter})")
    line.set(xlabel="$x$ on the middle line (m)", ylabel="admissible speed (m/s)")
    line.set(xlim=(-1.3, 1.3), ylim=(-0.03, 1.1 * ROBOT.max_speed), box_aspect=2.3 / 2.6)
    line.legend(loc="center right")
    for letter, ax in zip("abc", (*maps, line), strict=True):
        style.panel_letter(ax, letter)
    return figure


# --- the check -----------------------------------------------------------------------------------


def draw_requirement(zetas: Mapping[str, Zeta], d_min: float, ax: Axes) -> Axes:
    """Required deceleration beyond drag against closing speed, and what thrust can add to drag.

    Drag is subtracted because the certificates' lines would lie upon each other beside it.
    """
    u = np.linspace(0, ROBOT.max_speed, 301)[1:]
    drag = ROBOT.deceleration(u, "drag only")
    brake = style.steady(ROBOT.deceleration(u, "aligned brake") - drag)
    ax.fill_between(u, 0, brake, color="0.93", lw=0)
    for level in (0.0 * brake, brake):
        ax.plot(u, level, color="k", lw=1.4)
    ax.text(0.03 * u[-1], brake[0] + 0.05, "available: drag and aligned brake", va="bottom",
            fontsize=style.SMALL)  # fmt: skip
    ax.text(0.97 * u[-1], -0.05, "available: drag only", va="top", ha="right",
            fontsize=style.SMALL)  # fmt: skip
    papers = iter(_PAPER)
    # Of the ones that are not the paper's many end close to each other: once more, larger.
    near = ax.inset_axes((0.07, 0.42, 0.36, 0.38))
    ends = []
    for given, zeta in zetas.items():
        name = _math(given)
        variant = _HANDCRAFTED.get(given, given.partition(" (")[0])
        paper = given.startswith("paper") and next(papers, None)
        tint, line = paper or (style.colour(variant), style.line_style(variant))
        if zeta.k > 0:
            inside, outside = (
                style.steady(radial_requirement(zeta, d_min, u, where) - drag)
                for where in CONVENTIONS
            )
            ax.plot(u, inside, color=tint, ls=line, label=name)
            ax.fill_between(u, inside, outside, color=tint, alpha=0.25, lw=0)
            near.plot(u, inside, color=tint, ls=line)
            if not paper:
                ends.append(inside)
        else:
            ax.plot([], [], ls="none", label=f"{name}: no finite value ($k=0$)")
    ax.fill_between([], [], [], color="0.5", alpha=0.25, lw=0,
                    label=r"up to $C=\sigma+d_{\min}^n$")  # fmt: skip
    ax.set(xlabel="closing speed $u$ (m/s)", ylabel="radial deceleration\nbeyond drag (m/s$^2$)")
    ax.set(xlim=(0, ROBOT.max_speed), ylim=(-0.5, 1.14 * brake.max()))
    if len(ends) > 1:
        part = np.array(ends)[:, u >= 0.9 * ROBOT.max_speed]
        margin = 0.1 * (part.max() - part.min())
        near.set(xlim=(0.9 * ROBOT.max_speed, ROBOT.max_speed), xticks=[], yticks=[])
        near.set_ylim(part.min() - margin, part.max() + margin)
        near.grid(False)
        style.mark_zoom(ax, near)
    else:
        near.remove()
    ax.legend(loc="upper center", bbox_to_anchor=(0.45, -0.22), ncols=2, columnspacing=1.0)
    return ax


def draw_margin_map(margins: pd.DataFrame, ax: Axes, *, rest: float | None = None) -> Axes:
    """Best margin over distance and bearing (`certify.margin_map`); the zero level in black.

    rest: distance at which phi of a robot at rest is 0, which is where the worst of the few speeds
    that are searched changes.
    """
    table = margins.pivot(index="distance", columns="bearing", values="margin")
    bearing, distance = np.degrees(table.columns.to_numpy()), table.index.to_numpy()
    limit = max(float(np.nanmax(np.abs(table.to_numpy()))), 1e-6)
    image = ax.pcolormesh(bearing, distance, table, cmap="RdBu_r", vmin=-limit, vmax=limit,
                          rasterized=True)  # fmt: skip
    handles: list[Line2D | Patch] = []
    if np.nanmax(table.to_numpy()) > 0:
        ax.contour(bearing, distance, table.fillna(-1), levels=[0.0], colors="k", linewidths=1)
        handles.append(Line2D([], [], color="k", lw=1, label=r"$g=0$: red, no action is safe"))
    if rest is not None and distance[0] < rest < distance[-1]:
        ax.axhline(rest, color="0.2", lw=0.9, ls=(0, (4, 2)))
        text = r"nearer, $\phi>0$ even at rest"
        handles.append(Line2D([], [], color="0.2", lw=0.9, ls=(0, (4, 2)), label=text))
    if table.isna().to_numpy().any():
        handles.append(Patch(fc="0.75", label="the robot would overlap the obstacle"))
    ax.set_facecolor("0.75")
    ax.set(xlabel="bearing of the obstacle (deg)", ylabel="distance $d$ (m)")
    ax.set_xticks([0, 45, 90, 135, 180])
    ax.grid(False)
    if handles:
        ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.22))
    figure = ax.get_figure()
    assert figure is not None
    figure.colorbar(image, ax=ax, pad=0.02, label="least $g$ of the worst motion (m$^n$)")
    return ax


@style.styled
def certificate_check(
    zetas: Mapping[str, Zeta], d_min: float, margins: pd.DataFrame, mapped: str
) -> Figure:
    """Analytic condition for several certificates, and the searched margins of one of them.

    zetas: of the paper's family; other families have no such condition.
    """
    rows = (len(zetas) + 2) // 2
    figure = style.new_figure(style.TEXT_WIDTH, 2.6 + 0.14 * max(rows, 3))
    left, right = figure.subplots(1, 2)
    draw_requirement(zetas, d_min, left)
    mapping = zetas.get(mapped)
    draw_margin_map(margins, right, rest=mapping and mapping.sigma + d_min)
    right.set_title(_math(mapped))
    for letter, ax in zip("ab", (left, right), strict=True):
        style.panel_letter(ax, letter)
    return figure


# --- what a trained policy's multiplier sees -----------------------------------------------------


def draw_multiplier_map(data: Mapping[str, NDArray], ax: Axes, *, top: float) -> Any:
    """lambda(s) as shades up to ``top``, phi = 0 as a line; returns what the bar of shades needs.

    data: `trajectories.multiplier_map`.
    """
    image = ax.pcolormesh(data["x"], data["y"], data["multiplier"], cmap=_SHADES, vmin=0, vmax=top,
                          rasterized=True)  # fmt: skip
    outside = np.where(np.isnan(data["multiplier"]), np.nan, data["phi"])
    ax.contour(data["x"], data["y"], outside, levels=[0.0], colors="#0072B2", linewidths=1.3)
    size = float(data["obstacle_size"])
    for centre in data["obstacles"]:
        ax.add_patch(Circle(tuple(centre), size, fc="0.35", ec="none"))
        ax.add_patch(
            Circle(tuple(centre), float(data["d_min"]), fill=False, ec="k", ls=":", lw=0.8)
        )
    goal = Circle(tuple(data["goal"]), float(data["goal_size"]), fill=False, ec="#009E73", lw=1.2)
    ax.add_patch(goal)
    heading, extent = float(data["heading"]), float(data["extent"])
    start = np.array([-0.9, -0.88]) * extent
    end = start + 0.3 * extent * style.steady([np.cos(heading), np.sin(heading)])
    ax.annotate("", tuple(end), tuple(start), arrowprops={"arrowstyle": "->", "lw": 1})
    tick = np.floor(extent) or extent
    ax.set(aspect="equal", xticks=[-tick, 0, tick], yticks=[-tick, 0, tick], xlabel="$x$ (m)")
    ax.grid(False)
    return image


@style.styled
def multiplier_maps(scenes: Mapping[str, Mapping[str, NDArray]], names: Sequence[str]) -> Figure:
    """One panel a task: the multiplier of a trained policy and the zero level of its phi (blue).

    All have one scale of shades. The arrow is the direction of motion at every point; green: the
    goal; dotted: d_min.
    """
    figure = style.new_figure(style.row_width(len(names)), 2.5)
    axes = figure.subplots(1, len(names), squeeze=False)[0]
    peaks = [float(np.nanmax(scene["multiplier"])) for scene in scenes.values()]
    for ax, name in zip(axes, names, strict=True):
        ax.set_title(name)
        if name in scenes:
            image = draw_multiplier_map(scenes[name], ax, top=max(*peaks, 1e-3))
        else:
            style.note(ax, "no record")
            ax.set(box_aspect=1, xticks=[], yticks=[])
    if scenes:
        figure.colorbar(
            image, ax=list(axes), pad=0.01, shrink=0.8, label=r"multiplier $\lambda(s)$"
        )
    axes[0].set_ylabel("$y$ (m)")
    handles: list[Artist] = [
        Line2D([], [], color="#0072B2", lw=1.3, label=r"$\phi = 0$"),
        Line2D([], [], color="k", ls=":", lw=0.8, label=r"$d = d_{\min}$"),
        Patch(fc="0.35", ec="none", label="obstacle"),
        Line2D([], [], color="#009E73", marker="o", mfc="none", ls="none", label="goal"),
        Line2D([], [], color="k", marker=r"$\rightarrow$", ls="none", ms=8, label="motion"),
    ]
    style.legend_below(figure, handles, len(handles))
    return figure


def _phi(d: ArrayLike, d_dot: ArrayLike, d_min: float, zeta: Zeta) -> Array:
    """The energy as it is drawn and decided on in drawings: the same on every machine."""
    return style.steady(energy(d, d_dot, d_min, *zeta))


def _math(name: str) -> str:
    return {"phi_0": r"$\phi_0$", "phi_h": r"$\phi_h$"}.get(name, name)


def _radial_step(distance: float, d_dot: float, force: float) -> tuple[float, float]:
    """One environment step on the line through the obstacle; force > 0 pushes away, N."""
    for _ in range(ROBOT.substeps):
        drag = ROBOT.damping * d_dot
        d_dot += ROBOT.substep * (force - drag) / (ROBOT.mass + ROBOT.substep * ROBOT.damping)
        distance += ROBOT.substep * d_dot
    return distance, d_dot
