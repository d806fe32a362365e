"""Grids other than the paper's: every registered task, alone and together, and tasks with settings
of their own go through all that draws and tabulates; nothing of the paper stands beside them."""

from __future__ import annotations

import re
import runpy
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib.image
import numpy as np
import pandas as pd
import pytest
from test_workflow import Checkout, checkout  # noqa: F401  a fixture

from envs.drawing import draw_scene
from safemr import paper
from safemr.certificates.falsification import make_simulator
from safemr.experiment import planning
from safemr.measure.store import Measurements
from safemr.report import statistics
from safemr.report.figures import curves, scenes
from safemr.report.figures import scores as drawing

SCRIPTS = Path(__file__).resolve().parents[1] / "workflow" / "scripts"
GOAL = "Pillars-0.15-Goal"
EIGHT = {"base": GOAL, "settings": {"num_obstacles": 8}}
VARIANTS = ("SafeMR", "CPO")
METRICS = {
    "eval_return": (2.0, 1.0), "eval_cost": (0.0, 0.3), "eval_cost_indicator": (0.0, 3.0),
    "eval_zero_violation_share": (1.0, 0.5), "sigma": (0.2, 0.3), "k": (1.0, 1.1), "n": (2.0, 2.1),
    "time_wall_s": (5.0, 9.0),
}  # fmt: skip


def progress_of(tasks: list[str], seeds: int = 3) -> pd.DataFrame:
    rows = [
        (task, variant, seed, step, metric, values[place] + 0.01 * seed * (metric == "eval_return"))
        for task in tasks
        for place, variant in enumerate(VARIANTS)
        for seed in range(seeds)
        for step in (100, 200)
        for metric, values in METRICS.items()
    ]
    return pd.DataFrame(rows, columns=["task", "variant", "seed", "step", "metric", "value"])


def run_script(name: str, **given: Any) -> None:
    """One script of the workflow, with what Snakemake would give it."""
    runpy.run_path(
        str(SCRIPTS / f"{name}.py"),
        init_globals={"snakemake": SimpleNamespace(**{k: SimpleNamespace(**v) if isinstance(v, dict)
                                                      else v for k, v in given.items()})},
    )  # fmt: skip


def written(folder: Path, tasks: list[str], seeds: int = 3) -> dict[str, str]:
    """The tables of the aggregation of synthetic runs."""
    progress = progress_of(tasks, seeds)
    index = progress[["task", "variant", "seed"]].drop_duplicates()
    index = index.assign(steps=200, cpu_s=60.0, wall_s=60.0, peak_rss_mb=100.0, cpu="a processor")
    controllers = pd.DataFrame(columns=["task", "variant", "seed", "metric", "value"])
    files = {
        "progress": progress, "scores": statistics.final_scores(progress), "runs": index,
        "controllers": controllers,
    }  # fmt: skip
    for name, table in files.items():
        table.to_csv(folder / f"{name}.csv", index=False)
    return {name: str(folder / f"{name}.csv") for name in files}


GRIDS = {**{name: [name] for name in planning.task_names()}, "Pillars-8": ["Pillars-8"]}
GRIDS["all together"] = [*planning.task_names(), "Pillars-8", "Doors-Reach"]


@pytest.mark.parametrize("tasks", GRIDS.values(), ids=GRIDS)
def test_tables_and_figures_of_any_grid(tasks: list[str], tmp_path: Path) -> None:
    given = written(tmp_path, tasks)
    papers = [task for task in tasks if task in paper.TABLE_I]
    expected = pd.read_csv(given["runs"])[["task", "variant", "seed"]].to_numpy().tolist()
    grid = {"tasks": tasks, "variants": list(VARIANTS), "tolerance": 1.0, "clean_share": 0.95}
    grid |= {"method": "SafeMR", "protocol": 1}
    names = ["return_against_cost"]
    names += ["aggregate_scores", "aggregate_safe_scores"] * bool(papers)
    pdf = [str(tmp_path / f"{name}.pdf") for name in names]
    run_script("final_scores", input=given, params=grid, output={"pdf": pdf})
    pdf = [str(tmp_path / f"{name}.pdf") for name in ("training_curves", "compute_curves")]
    run_script("curves", input=given, params=grid, output={"pdf": pdf})
    drawn = {path.stem for path in tmp_path.glob("*.png")}
    assert drawn == {*names, "training_curves", "compute_curves"}
    params = {**grid, "expected": expected, "baselines": ["CPO"], "push": [], "layouts": 7}
    params["flown"] = 0
    run_script("tables", input=given, params=params, output={"table": [str(tmp_path / "x.csv")]})
    first = (tmp_path / "table1.md").read_text(encoding="utf-8")
    assert ("Paper" in first) == bool(papers)
    assert "nan" not in first
    assert "on 7 fixed layouts" in (tmp_path / "results.md").read_text(encoding="utf-8")
    params |= {"points": {}}
    claims = {**given, "certificates": [], "aircraft": []}
    run_script("claims", input=claims, params=params,
               output={"markdown": str(tmp_path / "claims.md")})  # fmt: skip
    verdicts = pd.read_csv(tmp_path / "claims.csv").set_index("claim")["verdict"]
    for task in paper.TASKS:
        assert (verdicts[f"highest_return[{task}]"] == "not run") == (task not in tasks)
    if not papers and "Aircraft" not in tasks:
        assert set(verdicts) == {"not run"}


def test_the_picture_of_the_tasks_shows_what_their_settings_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registered = (*paper.TASKS, "PointGoal1")
    entries: list[dict[str, Any]] = [{"name": name, "settings": {}} for name in registered]
    entries.append({"name": "Pillars-8", **EIGHT})
    seen = {}
    draw = scenes.environments

    def spy(layouts: Any, *rest: Any) -> Any:
        seen.update({name: len(scene.obstacles) for name, scene in layouts.items()})
        return draw(layouts, *rest)

    monkeypatch.setattr(scenes, "environments", spy)
    run_script("illustrations", params={"tasks": entries},
               output={"pdf": [str(tmp_path / "environments.pdf")]})  # fmt: skip
    counts = (4, 4, 1, 1, 8, 8)
    assert seen == dict(zip((*registered, "Pillars-8"), counts, strict=True))
    assert {path.name for path in tmp_path.iterdir()} == {"environments.pdf", "environments.png"}


def test_panels_of_more_tasks_than_the_papers_do_not_write_over_each_other() -> None:
    tasks = [*planning.task_names(), "Pillars-8"]
    progress = progress_of(tasks)
    returns, costs = (
        statistics.learning_curves(progress, name) for name in ("eval_return", "eval_cost")
    )
    scores = statistics.final_scores(progress)
    for figure in (
        curves.training_curves(returns, costs, tasks),
        drawing.return_against_cost(scores, tasks),
    ):
        figure.canvas.draw()
        lower = figure.axes[-len(tasks) :]
        boxes = [ax.xaxis.label.get_window_extent() for ax in lower]
        titles = [ax.title.get_window_extent() for ax in figure.axes[: len(tasks)]]
        for row in (boxes, titles):
            assert all(left.x1 < right.x0 for left, right in pairwise(row))


def test_scenes_of_tasks_of_different_extent_are_square_each() -> None:
    layouts = {name: make_simulator(name, 1).scene(0) for name in (GOAL, "PointGoal1")}
    figure = scenes.environments(layouts, draw_scene)
    figure.canvas.draw()
    for ax, extent in zip(figure.axes, (2.0, 1.5), strict=True):
        assert ax.get_ylim() == ax.get_xlim() == (-extent - 0.3, extent + 0.3)


def test_aggregates_say_of_which_tasks_they_are_and_what_few_runs_cannot_say() -> None:
    progress = progress_of([GOAL, "Pillars-8"], seeds=2)
    scores = statistics.final_scores(progress)
    aggregates = statistics.aggregate(
        scores, VARIANTS, "SafeMR", {GOAL: 10.0}, np.linspace(0, 2, 11)
    )
    assert aggregates.improvement["CPO"].mean == 1.0
    assert np.isnan(aggregates.improvement["CPO"].low)
    figure = drawing.aggregate_scores(aggregates, tasks=[GOAL])
    texts = [text.get_text() for ax in figure.axes for text in (ax.title,)]
    assert texts.count("2 runs a task: no intervals") == 2
    assert figure.get_suptitle() == f"on {GOAL} alone"
    three = statistics.final_scores(progress_of([GOAL]))
    aggregates = statistics.aggregate(three, VARIANTS, "SafeMR", {GOAL: 10.0}, np.array([0.0]))
    plain = drawing.aggregate_scores(aggregates)
    assert not any("no intervals" in ax.get_title() for ax in plain.axes)
    assert plain.get_suptitle() == ""


def test_a_recording_shorter_than_the_animation_ends_it(tmp_path: Path) -> None:
    track = np.zeros((9, 1, 3), np.float32)
    recorded = {
        "robot": track, "goal": track[..., :2], "box": np.full_like(track, np.nan),
        "obstacles": np.zeros((1, 8, 2)),
        "goal_met": np.zeros((8, 1)), "cost_indicator": np.zeros((8, 1)),
        **{name: np.array(0.2) for name in ("obstacle_size", "d_min", "goal_size")},
        "extent": np.array(1.5), "solid_obstacles": np.array(False),
    }  # fmt: skip
    scenes.animation({"SafeMR": recorded}, lambda ax, scene: ax, tmp_path / "a.gif", stride=4)
    assert (tmp_path / "a.gif").stat().st_size > 0


# --- the whole pipeline --------------------------------------------------------------------------

NOTHING_ELSE: dict[str, Any] = {
    **{"unseen_layouts": None, "protocol": 1, "sizes": False},
    **{"sensitivity": None, "aircraft": None},
}
SMALL = {
    "algorithms": {
        "SafeMR": {"algorithm": "safemr", "start_steps": 200},
        "JointSIS": {"algorithm": "joint_sis", "start_steps": 200},
    },
    "seeds": [100, 101],
    "budget": {"off_policy": 1000},
    "log_points": 4,
    "evaluation": {"points": 2, "episodes": 1},
    "task_overrides": {},
}


def test_only_what_makes_sense_is_scheduled(checkout: Checkout) -> None:  # noqa: F811
    checkout.configure(tasks=["PointGoal1"], **NOTHING_ELSE)
    scheduled = checkout.scheduled()
    assert {"illustrations", "certificates", "rollouts", "policies", "final_scores"} <= {*scheduled}
    assert not {"sensitivity", "unseen_table", "aircraft_comparison"} & {*scheduled}
    checkout.configure(tasks=["Aircraft"], **NOTHING_ELSE)
    scheduled = checkout.scheduled()
    assert {"curves", "final_scores", "claims"} <= {*scheduled}
    assert not {"illustrations", "certificates", "rollouts", "policies"} & {*scheduled}


def no_fault(printed: str) -> None:
    assert "Traceback" not in printed
    assert not re.search(r"\berror:", printed)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["PointGoal1", "Aircraft", "Hazards-0.30-Push"])
def test_one_task_alone_from_nothing_to_figures(checkout: Checkout, task: str) -> None:  # noqa: F811
    checkout.configure(**SMALL, **NOTHING_ELSE, tasks=[task])
    no_fault(checkout.snakemake("all"))
    tables = checkout.folder / "results" / "tables"
    assert (tables / "certificates.md").exists() == (task != "Aircraft")
    assert ("Paper" in (tables / "table1.md").read_text()) == (task in paper.TASKS)
    assert "paper [" not in "".join(path.read_text() for path in tables.glob("certificates.md"))
    figures = {path.stem for path in (checkout.folder / "paper_figures").glob("*.png")}
    assert ("environments" in figures) == (task != "Aircraft")
    assert not {"energy_and_safe_set", "narrow_passage"} & figures
    assert checkout.scheduled() == {}


@pytest.mark.slow
def test_a_task_and_its_variant_from_nothing_to_figures(checkout: Checkout) -> None:  # noqa: F811
    points = {"task": "Pillars-8", "algorithm": "SafeMR", "points": [[0.35, 0.15], [0.45, 0.15]]}
    small = {**SMALL, "unseen_layouts": {"episodes": 2}, "sensitivity": points, "aircraft": None}
    checkout.configure(**small, tasks=[GOAL, {"Pillars-8": EIGHT}])
    no_fault(checkout.snakemake("all"))
    results = checkout.folder / "results"
    assert {path.name for path in (results / "runs").iterdir()} == {GOAL, "Pillars-8"}
    read = {path.name: path.read_text() for path in (results / "tables").glob("*.md")}
    lines = [line for line in read["table1.md"].splitlines() if line.startswith("| Paper")]
    assert all(line.endswith("| – |") for line in lines)
    assert len(lines) == 4
    assert "paper" not in read["table2.md"]
    assert " ± " not in "".join(line for text in read.values() for line in text.splitlines()
                                if line.startswith("| ") and "scripted" not in line)  # fmt: skip
    for name in ("results.md", "unseen_layouts.md", "certificates.md"):
        assert "| Pillars-8 |" in read[name]
    certified = pd.read_csv(results / "tables" / "certificates.csv")
    papers = certified[certified["certificate"].str.startswith("paper")]
    assert set(papers["task"]) == {GOAL}
    with np.load(results / "summary" / "rollouts" / "Pillars-8.npz") as stored:
        assert stored["SafeMR/episodes/obstacles"].shape[1:] == (8, 2)
    kept = Measurements(results).folder
    assert any(path.name.startswith("Pillars-8") for path in (kept / "controllers").iterdir())
    picture = matplotlib.image.imread(checkout.folder / "paper_figures" / "environments.png")
    assert picture.std() > 0
    assert checkout.scheduled() == {}
