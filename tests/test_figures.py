"""Figures: one colour an algorithm, the numbers that were given, files that are what they say."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text

from safemr import files, paper
from safemr.certificates.point_robot import ROBOT
from safemr.errors import UserError
from safemr.experiment import config, planning
from safemr.paper import Zeta
from safemr.report import finding, sensitivity, statistics
from safemr.report.figures import aircraft, certificate, curves, scenes, scores, style
from safemr.report.figures import finding as finding_figure
from safemr.report.tables import SafetyRule

TASKS = ("Pillars-0.15-Goal", "Hazards-0.15-Push")
D_MIN = 0.25
CONFIGS = Path(__file__).parents[1] / "config"


@pytest.fixture(scope="module")
def progress() -> pd.DataFrame:
    generator = np.random.default_rng(0)
    rows = [
        (task, variant, seed, step, metric, generator.normal(level, 0.2))
        for task in TASKS
        for variant, level in (("SafeMR", 2.0), ("JointSIS", 1.0), ("CPO", 3.0), ("mine", 0.5))
        for seed in (0, 1, 2)
        for step in (100, 200, 300)
        for metric in ("eval_return", "eval_cost", "eval_cost_indicator", "sigma", "k", "n")
    ]
    rows += [(*row[:4], "eval_zero_violation_share", 0.9) for row in rows[::6]]
    return pd.DataFrame(rows, columns=["task", "variant", "seed", "step", "metric", "value"])


def luminance(colour: str) -> np.ndarray:
    return np.array([int(to_hex(colour)[i : i + 2], 16) for i in (1, 3, 5)]) / 255


def test_algorithms_have_distinct_colours_and_unknown_ones_a_stable_one():
    names = (*paper.ALGORITHMS, "SAC-L")
    tints = np.array([luminance(style.colour(name)) for name in names])
    gaps = np.abs(tints[:, None] - tints[None]).sum(-1) + 3 * np.eye(len(names))
    assert gaps.min() > 0.3
    for part in (style.line_style, style.marker):  # in grey, too
        assert len({str(part(name)) for name in paper.ALGORITHMS}) == len(paper.ALGORITHMS)
    assert style.colour("my method") == style.colour("my method")
    assert style.colour("my method") not in {style.colour(name) for name in names}


def test_the_shipped_variants_have_distinct_looks():
    names = list(config.load([CONFIGS / "config.yaml", CONFIGS / "variants.yaml"]).algorithms)
    tints = np.array([luminance(style.colour(name)) for name in names])
    gaps = np.abs(tints[:, None] - tints[None]).sum(-1) + 3 * np.eye(len(names))
    assert gaps.min() > 0.3
    assert len({style.marker(name) for name in names}) == len(names)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_no_two_algorithms_of_a_configuration_look_alike(path: Path):
    chosen = config.load([CONFIGS / "config.yaml", path])
    plan = planning.resolve(chosen)
    looks: dict[str, str] = {}
    runs = list(plan.runs)
    if chosen.sizes_beside:  # whose certificates stand in the same figure
        runs += planning.resolve(config.load([CONFIGS / "config.yaml"])).runs
    for run in runs:
        if "[" not in run.variant:  # points of the sensitivity grid have looks of their own
            other = looks.setdefault(str(style.look(run.variant)), run.variant)
            assert other == run.variant, f"{other} and {run.variant} look alike"


@pytest.mark.parametrize("name", ["config", "forms"])
def test_certificates_that_are_drawn_by_size_have_colours_of_their_own(name: str):
    names = {run.variant for run in planning.resolve(config.load([CONFIGS / "config.yaml"])).runs}
    chosen = config.load([CONFIGS / "config.yaml", CONFIGS / f"{name}.yaml"])
    names |= {run.variant for run in planning.resolve(chosen).runs}
    assert len({style.colour(variant) for variant in names}) == len(names) >= 11


def test_the_certificate_check_draws_every_certificate():
    names = [f"SafeMR[{a},0.15] (seed 0)" for a in range(20)] + ["SafeMR (seed 0)"]
    margins = pd.DataFrame({"distance": [1.0, 1.0], "bearing": [0.0, 1.0], "margin": [-1.0, 1.0]})
    margins = pd.concat([margins, margins.assign(distance=2.0)])
    zetas = {name: Zeta(0.1 + 0.01 * i, 1.0, 2.0) for i, name in enumerate(names)}
    figure = certificate.certificate_check(zetas, 0.25, margins, names[-1])
    solid = [line for line in figure.axes[0].lines if line.get_label() in names]
    assert [line.get_label() for line in solid] == names
    assert solid[-1].get_color() == style.colour("SafeMR")


def test_order_is_the_papers_then_alphabetical():
    assert style.ordered(["zeta", "CPO", "alpha", "SafeMR"]) == ["SafeMR", "CPO", "alpha", "zeta"]


def test_training_curves_draw_the_estimates(progress):
    returns = statistics.learning_curves(progress, "eval_return")
    costs = statistics.learning_curves(progress, "eval_cost")
    figure = curves.training_curves(returns, costs, TASKS)
    ax = figure.axes[0]
    lines = {line.get_color(): line for line in ax.lines}
    expected = returns[(returns["task"] == TASKS[0]) & (returns["variant"] == "SafeMR")]
    drawn = lines[style.colour("SafeMR")].get_xydata()
    np.testing.assert_allclose(drawn, expected[["step", "mean"]].to_numpy(float))
    assert len(figure.axes) == 4
    assert len(figure.legends) == 1
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["SafeMR", "JointSIS", "CPO", "mine"]
    rows = [text.get_text() for text in figure.axes[2].get_yticklabels()]
    assert rows == names, "of the costs"
    whiskers = [line.get_segments() for line in ax.collections]
    steps = [{x for (x, _), _ in segments} for segments in whiskers]
    assert all(steps)
    assert not set.intersection(*steps), "at different steps, or they lie upon each other"


def test_curves_of_all_tasks_have_one_axis_of_steps(progress):
    """One task's budgets differ tenfold, which makes the axis logarithmic for the other, too."""
    late = progress[(progress["task"] == TASKS[0]) & (progress["variant"] == "CPO")]
    longer = pd.concat([progress, late.assign(step=10 * late["step"])])
    tables = [statistics.learning_curves(longer, m) for m in ("eval_return", "eval_cost")]
    figure = curves.training_curves(*tables, TASKS)
    assert {ax.get_xlim() for ax in figure.axes} == {(100.0, 3000.0)}
    assert {ax.get_xscale() for ax in figure.axes} == {"log"}
    assert {ax.get_xlabel() for ax in figure.axes[2:4]} == {"environment steps ($10^6$, log scale)"}


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [(2e4, 2e6, [3e4, 1e5, 3e5, 1e6]), (1, 1000, [1, 10, 100, 1000]), (100, 300, [100, 200]),
     (6.0, 7.0, [6.0, 7.0])],
)  # fmt: skip
def test_logarithmic_axes_have_more_than_one_tick(low, high, ticks):
    assert style.log_ticks(low, high) == pytest.approx(ticks)


def test_small_changes_of_a_parameter_do_not_look_still(progress):
    rows = [
        (TASKS[0], variant, 0, step, "sigma", 0.3 - change * step)
        for variant, change in (("SafeMR", 0.1), ("JointSIS", 0.001))
        for step in (0, 1)
    ]
    table = pd.DataFrame(rows, columns=list(progress.columns))
    ax = curves.parameter_evolution(table, TASKS[:1]).axes[0]
    heights = ax.transAxes.inverted().transform(ax.transData.transform([(0, 0), (0, -0.001)]))
    assert heights[0, 1] - heights[1, 1] > 0.1
    assert [text.get_text() for text in ax.texts] == ["0.200", "0.299"]


def test_wide_intervals_do_not_flatten_the_curves():
    table = pd.DataFrame(
        {"variant": "SafeMR", "step": [0, 100], "mean": [0.0, 10.0], "low": [-500.0, -500.0],
         "high": [500.0, 500.0]}
    )  # fmt: skip
    ax = style.new_figure(3, 2).subplots()
    curves.draw_curves(table, ax)
    low, high = ax.get_ylim()
    assert -7 < low <= 0
    assert 10 <= high < 17


def test_a_peak_between_whiskers_is_in_the_view():
    rows = [(name, step, 9.0 * (step == 1)) for name in ("a", "b") for step in range(4)]
    table = pd.DataFrame(rows, columns=["variant", "step", "mean"])
    ax = style.new_figure(3, 2).subplots()
    curves.draw_curves(table.assign(low=table["mean"], high=table["mean"]), ax)
    assert ax.get_ylim()[1] > 9.0
    curves.cost_axis(ax, "cost")
    assert ax.get_ylim()[1] > 9.0


def variations(names: list[str]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Learning curves and minutes of variants on one task."""
    rows = [
        {"task": TASKS[0], "variant": name, "step": step, "mean": float(index), "low": float(index),
         "high": float(index)}
        for index, name in enumerate(names)
        for step in (100, 200)
    ]  # fmt: skip
    returns = pd.DataFrame(rows)
    return returns, returns[["task", "variant", "step"]].assign(minutes=returns["step"] / 100)


def test_many_variants_of_one_task_are_told_apart():
    names = ["SafeMR", *(f"SafeMR-v{i}" for i in range(6)), "PPO-L", "PPO-L-v1", "CPO"]
    figure = curves.compute_curves(*variations(names), TASKS[:1])
    assert [ax.get_title().split(", ")[1] for ax in figure.axes] == ["SafeMR", "PPO-L", "CPO"]
    for ax, members in zip(figure.axes, (names[:7], names[7:9], names[9:]), strict=True):
        assert [text.get_text() for text in ax.get_legend().get_texts()] == members
        looks = {(line.get_color(), line.get_linestyle()) for line in ax.lines}
        assert len(looks) == len(ax.lines) == len(members)


def test_a_legend_of_long_names_stays_inside_the_figure():
    names = [f"a variant with a long name {i}" for i in range(8)]
    figure = curves.compute_curves(*variations(names), TASKS[:1])
    figure.canvas.draw()
    box, (legend,) = figure.bbox, figure.legends
    extent = legend.get_window_extent()
    assert extent.x0 >= box.x0
    assert extent.x1 <= box.x1


def found(progress: pd.DataFrame) -> Figure:
    flown = statistics.final_scores(progress)
    points = finding.points(flown, SafetyRule())
    return finding_figure.finding(points, finding.ahead(flown, points), TASKS)


def figures(progress: pd.DataFrame) -> dict[str, Callable[[], Figure]]:
    returns = statistics.learning_curves(progress, "eval_return")
    costs = statistics.learning_curves(progress, "eval_cost")
    final = statistics.final_scores(progress)
    scale = dict.fromkeys(TASKS, 1.0)
    one = dict.fromkeys(TASKS[:1], 1.0)
    zeta = paper.TABLE_II[paper.HEADLINE]
    margins = pd.DataFrame(
        {"distance": [0.3, 0.3, 0.6, 0.6], "bearing": [0.0, 1.0, 0.0, 1.0],
         "margin": [-0.1, 0.1, -0.2, np.nan]}
    )  # fmt: skip
    grid = np.linspace(-1, 1, 9)
    plane = {
        "x": grid, "y": grid, "multiplier": np.add.outer(grid**2, grid),
        "phi": np.outer(grid, grid), "obstacles": np.zeros((1, 2)), "goal": np.ones(2),
        "heading": np.array(0.0), "obstacle_size": np.array(0.15), "d_min": np.array(D_MIN),
        "goal_size": np.array(0.3), "extent": np.array(2.0),
    }  # fmt: skip
    minutes = returns[["task", "variant", "step"]].assign(minutes=returns["step"] / 100)
    weights = {
        name: (a, b)
        for name, a, b in (
            ("SafeMR", 0.3, 0.1),
            ("mine", 0.3, 0.2),
            ("CPO", 0.4, 0.1),
            ("absent", 0.4, 0.2),
        )
    }
    learned = statistics.last_values(progress, ("sigma", "k", "n"))
    return {
        "computing time": lambda: curves.compute_curves(returns, minutes, TASKS),
        "training": lambda: curves.training_curves(returns, costs, TASKS),
        "missing task": lambda: curves.training_curves(returns, costs, (*TASKS, "Elsewhere")),
        "no run": lambda: curves.training_curves(returns.iloc[:0], costs.iloc[:0], TASKS),
        "sensitivity": lambda: curves.sensitivity(
            returns[returns["task"] == TASKS[0]], costs[costs["task"] == TASKS[0]],
            {"SafeMR": (0.35, 0.15), "SafeMR[0.45,0.15]": (0.45, 0.15)},
        ),
        "weights": lambda: scores.weight_map(sensitivity.weight_map(final, learned, weights).data),
        "parameters": lambda: curves.parameter_evolution(
            progress, TASKS, variants=["SafeMR", "JointSIS"]
        ),
        "finding": lambda: found(progress),
        "return against cost": lambda: scores.return_against_cost(final, TASKS, tolerance=1.0),
        "aggregates": lambda: scores.aggregate_scores(
            statistics.aggregate(final, ["SafeMR", "CPO"], "SafeMR", scale, np.linspace(0, 4, 9))
        ),
        "aggregates of nothing": lambda: scores.aggregate_scores(
            statistics.aggregate(final.iloc[:0], ["SafeMR"], "SafeMR", one, np.linspace(0, 4, 9))
        ),
        "energy": lambda: certificate.energy_and_safe_set(zeta, D_MIN),
        "passage": lambda: certificate.narrow_passage(
            ("a", paper.PHI_H), ("b", zeta), D_MIN
        ),
        "check": lambda: certificate.certificate_check(
            {"phi_h": paper.PHI_H, "phi_0": paper.PHI_0}, D_MIN, margins, "phi_h"
        ),
        "multiplier": lambda: certificate.multiplier_maps({"t": plane}, ["t", "absent"]),
        "multiplier of one task": lambda: certificate.multiplier_maps({"t": plane}, ["t"]),
    }  # fmt: skip


@pytest.mark.parametrize("name", sorted(figures(pd.DataFrame(
    columns=["task", "variant", "seed", "step", "metric", "value"]))))  # fmt: skip
def test_figures_are_vector_and_pixels_at_print_width(progress, tmp_path, name):
    figure = figures(progress)[name]()
    assert figure.get_figwidth() in (
        style.COLUMN_WIDTH, style.TEXT_WIDTH, pytest.approx(0.8 * style.TEXT_WIDTH)
    )  # fmt: skip
    pdf, png = style.save(figure, tmp_path / "figure")
    content = pdf.read_bytes()
    assert content.startswith(b"%PDF")
    assert b"CreationDate" not in content
    width, _ = struct.unpack(">II", png.read_bytes()[16:24])
    assert width == pytest.approx(300 * figure.get_figwidth(), abs=1)
    written = [text for text in figure.findobj(Text) if text.get_text()]
    assert {text.get_fontsize() for text in written} <= {style.LETTERS, style.SMALL}
    figure.canvas.draw()  # at its own resolution again
    drawn = figure.get_tightbbox()
    assert drawn.x0 >= -0.02, "cut off at the left"
    assert drawn.x1 <= figure.get_figwidth() + 0.02, "cut off at the right"


def test_saving_twice_gives_equal_files(progress, tmp_path):
    final = statistics.final_scores(progress)
    pairs = [style.save(scores.return_against_cost(final, TASKS), tmp_path / name) for name in "ab"]
    for first, second in zip(*pairs, strict=True):
        assert first.read_bytes() == second.read_bytes()


def test_an_unsafe_algorithm_has_a_hollow_mean(progress):
    final = statistics.final_scores(progress)
    final.loc[final["metric"] == "eval_cost_indicator", "value"] = 0.0
    ax = scores.return_against_cost(final, TASKS, unsafe=[(TASKS[0], "CPO")]).axes[0]
    means = {line.get_color(): line for line in ax.lines if len(line.get_xdata()) == 1}
    assert means[style.colour("CPO")].get_markerfacecolor() == "none"
    assert means[style.colour("SafeMR")].get_markerfacecolor() == style.colour("SafeMR")
    places = [line.get_xdata()[0] for line in means.values()]
    assert len(set(places)) == len(places), "at no cost they do not hide each other"


def test_the_weight_map_shows_every_point_where_it_belongs(progress):
    axes = figures(progress)["weights"]().axes
    tracks = sensitivity.weight_map(
        statistics.final_scores(progress), progress.iloc[:0], {"mine": (0.3, 0.2)}
    ).data
    texts = {text.get_position(): text.get_text() for text in axes[0].texts}
    assert texts[0, 1] == f"{tracks['return'].item():.1f}"
    assert texts[1, 1] == "missing"
    frames = {round(patch.get_x()): to_hex(patch.get_edgecolor()) for patch in axes[0].patches}
    assert frames[1] == "#ffffff"  # CPO, above JointSIS


def test_a_task_without_records_says_so(progress):
    figure = figures(progress)["missing task"]()
    texts = [text.get_text() for text in figure.axes[2].texts]
    assert texts == ["no record: all runs"]


# --- what the certificate figures compute --------------------------------------------------------


def test_admissible_speed_is_where_the_energy_vanishes():
    """Straight at one obstacle with phi_h: (0.55^2 - d^2) + v = 0 gives v = d^2 - 0.55^2."""
    distances = np.array([0.5, 0.6, 0.8, 3.0])
    positions = np.stack([-distances, np.zeros(4)], -1)
    speed = certificate.admissible_speed(
        positions, np.zeros((1, 2)), paper.PHI_H, D_MIN, np.array([1.0, 0.0])
    )
    np.testing.assert_allclose(speed, [np.nan, 0.36 - 0.3025, 0.64 - 0.3025, 1.5], atol=1e-12)
    away = certificate.admissible_speed(
        -positions[1:], np.zeros((1, 2)), paper.PHI_H, D_MIN, np.array([1.0, 0.0])
    )
    np.testing.assert_allclose(away, 1.5)


def test_narrow_passage_is_closed_by_the_handcrafted_function_and_open_to_the_learned_one():
    obstacles, ahead = np.array([[0.0, 0.5], [0.0, -0.5]]), np.array([1.0, 0.0])
    line = np.stack([np.linspace(-1, 0, 201), np.zeros(201)], -1)
    learned = paper.TABLE_II[paper.HEADLINE]
    closed, opened = (
        certificate.admissible_speed(line, obstacles, zeta, D_MIN, ahead)
        for zeta in (paper.PHI_H, learned)
    )
    assert np.isnan(closed).any()
    assert np.nanmin(opened) > 0.2
    assert not np.isnan(opened).any()


def test_radial_drives_show_both_conditions():
    from safemr.certificates.energy import energy

    zeta = paper.TABLE_II[paper.HEADLINE]
    inside = certificate.radial_drive(1.55, -1.0, zeta, D_MIN, 100)
    assert (energy(*inside.T, D_MIN, *zeta) <= 0).all()
    assert (inside[:, 0] > D_MIN).all()
    outside = energy(*certificate.radial_drive(0.7, -0.8, zeta, D_MIN, 100).T, D_MIN, *zeta)
    assert outside[0] > 0
    assert outside[-1] <= 0
    assert (np.diff(outside[outside > 0]) < 0).all()


# --- scenes --------------------------------------------------------------------------------------


def recording(offset: float) -> dict[str, np.ndarray]:
    time = np.linspace(0, 1, 21, dtype=np.float32)
    robot = np.zeros((21, 2, 3), np.float32)
    robot[..., 0] = time[:, None] + offset
    return {
        "robot": robot, "goal": np.ones((21, 2, 2), np.float32),
        "box": np.full((21, 2, 3), np.nan, np.float32), "obstacles": np.zeros((2, 1, 2)),
        "reward": np.ones((20, 2), np.float32), "cost_indicator": np.zeros((20, 2)),
        "goal_met": np.zeros((20, 2)), "obstacle_size": np.array(0.15), "d_min": np.array(D_MIN),
        "goal_size": np.array(0.3), "extent": np.array(2.0), "solid_obstacles": np.array(True),
    }  # fmt: skip


def draw_nothing(ax, scene, trajectory=None):
    ax.plot(*scene.robot[:2], "k.")
    return ax


def test_the_view_holds_the_box_that_was_pushed_out_of_the_square():
    pushed = recording(0.0)
    pushed["box"][:] = 0.0
    pushed["box"][:11, 0, 1] = 2.1
    pushed["box"][11:, 0, 1] = 2.9  # after the steps that are drawn
    figure = scenes.trajectories({"SafeMR": pushed}, draw_nothing, steps=10)
    for ax in figure.axes[:2]:  # one view for all
        np.testing.assert_allclose(ax.get_ylim(), (-2.0, 2.5), atol=1e-6)
        np.testing.assert_allclose(np.diff(ax.get_xlim()), 4.5, atol=1e-6)


def test_trajectories_state_the_return_and_draw_the_path(tmp_path):
    path = tmp_path / "rollouts.npz"
    files.save_arrays(path, recording(0.0))
    recorded = {"SafeMR": files.load_arrays(path), "JointSIS": recording(0.5)}
    figure = scenes.trajectories(recorded, draw_nothing, steps=10)
    assert len(figure.axes) == 4
    assert figure.axes[0].get_title() == "return 10.0"
    paths = [line for line in figure.axes[2].lines if line.get_color() == style.colour("JointSIS")]
    np.testing.assert_allclose(paths[0].get_xdata(), 0.5 + np.linspace(0, 0.5, 11), atol=1e-6)


def test_animation_is_a_small_looping_gif(tmp_path):
    from PIL import Image

    path = tmp_path / "a.gif"
    scenes.animation({"SafeMR": recording(0)}, draw_nothing, path, steps=20, stride=4, pixels=120)
    with Image.open(path) as image:
        assert image.n_frames == 6
        assert image.info["loop"] == 0
        assert image.info["duration"] == 80


def test_the_zero_level_is_that_of_the_robots_velocity(monkeypatch):
    """It moves along x at 0.05 m a step: phi = 0.55^2 - d^2 - d_dot is 0 at 0.55 m from the
    obstacle abeam of it, and farther away before it."""
    drawn = []
    ax = style.new_figure(3, 3).subplots()
    keep = type(ax).contour
    monkeypatch.setattr(type(ax), "contour", lambda *a, **k: drawn.append(keep(*a, **k)))
    view = np.array([[-2.0, 2.0], [-2.0, 2.0]])
    phi = lambda d, d_dot: (0.55**2 - d**2 - d_dot).max(-1)  # noqa: E731
    scenes._zero_level(ax, phi, recording(0.0), 0, 20, view)
    (path,) = drawn[0].get_paths()
    speed = 0.05 / ROBOT.step_s
    x, y = path.vertices.T
    d = np.hypot(x, y)
    off = (0.55**2 - d**2 - x / d * speed)[d > 0.3]  # nearer than that the grid is coarse
    np.testing.assert_allclose(off, 0.0, atol=0.01)
    assert x.min() < -1.0


def test_the_finding_names_all_and_says_how_far_the_method_is_ahead(progress):
    flown = statistics.final_scores(progress)
    clean = flown["metric"].isin(["eval_cost_indicator", "eval_zero_violation_share"])
    value = (flown["metric"] == "eval_zero_violation_share").astype(float)
    flown = flown.assign(value=flown["value"].where(~clean, value))
    dirty = (flown["variant"] == "CPO") & (flown["metric"] == "eval_zero_violation_share")
    flown = flown.assign(value=flown["value"].where(~dirty, 0.4))
    points = finding.points(flown, SafetyRule())
    ahead = finding.ahead(flown, points)
    gap = statistics.difference_interval(
        *(
            statistics.scores_of(flown, TASKS[0], name, "eval_return")
            for name in ("SafeMR", "JointSIS")
        )
    )
    assert f"{gap.mean:+.1f} $\\pm$ {gap.half_width:.1f}" in ahead["text"].iloc[0]
    without = finding.ahead(flown, points, baselines=["CPO", "mine"])["text"].iloc[0]
    assert "JointSIS" not in without
    ax = finding_figure.finding(points, ahead, TASKS).axes[0]
    assert [text.get_text() for text in ax.texts] == ["SafeMR", "JointSIS", "CPO", "mine"]
    boxes = [text.get_window_extent() for text in ax.texts]
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    hollow = {line.get_color() for line in ax.lines if line.get_markerfacecolor() == "white"}
    assert hollow == {style.colour("CPO")}
    (x,) = {line.get_xdata()[0] for line in ax.lines if line.get_markerfacecolor() == "white"}
    assert x == pytest.approx(60.0)


def test_names_stand_nearest_to_their_own_marks():
    """Three safe ones above each other, as on Hazards-0.30-Push."""
    means = {"SafeMR": (0.0, 7.9, 0.8), "JointSIS": (0.0, 6.0, 1.4), "CPO": (28.0, 10.0, 0.0),
             "FAC-phi0": (27.8, 10.5, 1.1), "FAC-phih": (0.0, 7.2, 1.3)}  # fmt: skip
    tasks = ["first", "second", "third", "fourth"]  # four panels, of which each is small
    rows = [
        {"task": task, "variant": name, "safe": dirty == 0, "return": y, "return_low": y - half,
         "return_high": y + half, "dirty": dirty, "dirty_low": 0.8 * dirty,
         "dirty_high": 1.2 * dirty + 1.5}
        for task in tasks for name, (dirty, y, half) in means.items()
    ]  # fmt: skip
    said = pd.DataFrame({"task": tasks, "text": "two lines of title"})
    figure = finding_figure.finding(pd.DataFrame(rows), said, tasks)
    for ax in figure.axes:
        drawn = [
            next(name for name in means if style.label(name) == t.get_text()) for t in ax.texts
        ]
        marks = ax.transData.transform([means[name][:2] for name in drawn])
        for own, text in enumerate(ax.texts):
            box = text.get_window_extent()
            across, up = (np.clip(marks, box.p0, box.p1) - marks).T
            gaps = np.hypot(0.5 * across, up)  # what is on its line is read with it
            assert 1.2 * gaps[own] < np.delete(gaps, own).min(), text.get_text()


def test_what_some_seeds_call_unsafe_is_shaded_once(monkeypatch):
    x = y = np.linspace(-8.0, 8.0, 33)
    d = np.hypot(*np.meshgrid(x, y, indexing="ij"))
    cut = aircraft.Slice(0.0, d - 3, 2 - d, {"SafeMR": [r - d for r in (4.0, 5.0, 7.0)]})
    drawn = []
    ax = style.new_figure(3, 3).subplots()
    keep = type(ax).contour
    monkeypatch.setattr(type(ax), "contour", lambda *a, **k: drawn.append(keep(*a, **k)))
    aircraft.draw_slice(ax, x, y, cut, 2.0)
    radii = np.hypot(*drawn[-1].get_paths()[0].vertices.T)
    np.testing.assert_allclose(radii, 5.0, atol=0.05)


def test_trajectories_from_elsewhere_are_refused(tmp_path):
    path = tmp_path / "bad.npz"
    path.write_bytes(b"nothing")
    with pytest.raises(UserError, match=r"bad\.npz"):
        files.load_arrays(path)
