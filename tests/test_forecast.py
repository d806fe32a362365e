"""What a dry run says: the runs to be trained, and about how long they take."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from safemr.experiment import config, planning, records
from safemr.experiment.forecast import announced

ROOT = Path(__file__).resolve().parents[1]


def run(
    algorithm: str, task: str = "Pillars-0.15-Goal", seed: int = 0, steps: int = 6000
) -> planning.Run:
    described = planning.load_algorithm(algorithm)
    return planning.make_run(
        planning.describe_task(task, {}),
        described,
        planning.hyperparameters(described, {}, algorithm),
        variant=algorithm.upper(),
        seed=seed,
        steps=steps,
        log_every=steps,
        evaluation={"every": steps, "episodes": 1, "seed": 0},
    )


def record(root: Path, done: planning.Run, cpu_s: float) -> None:
    row = {"step": 6000.0, "eval_return": 1.0, "eval_cost": 0.0, "eval_zero_violation_share": 1.0}
    folder = root / done.path
    records.write_record(folder, done.config, done.variant, [row], {"cpu_s": cpu_s})


def test_what_is_recorded_is_not_announced(tmp_path: Path) -> None:
    done, left = run("fac"), run("fac", seed=1)
    record(tmp_path, done, 60.0)
    assert announced(tmp_path, [done]) == []
    lines = announced(tmp_path, [done, left, run("fac", "Pillars-0.30-Goal")])
    assert lines[1:] == ["  FAC: Pillars-0.15-Goal 1, Pillars-0.30-Goal 1"]
    # A minute for the one, and nothing is recorded on the other's task.
    assert lines[0] == "To be trained: 2 runs, about 1 core-minutes and 1 run of unknown length"
    assert announced(tmp_path / "empty", [left]) == [
        "To be trained: 1 run, for how long no record tells",
        "  FAC: Pillars-0.15-Goal 1",
    ]


def test_a_new_baseline_is_estimated_by_its_own_family(tmp_path: Path) -> None:
    recorded = [run("fac"), run("ppo_lagrangian")]
    for done, minutes in zip(recorded, (10.0, 70.0), strict=True):
        record(tmp_path, done, 60.0 * minutes)
    for name, steps, expected in (
        ("sac_lagrangian", 6000, "10 core-minutes"),
        ("cpo", 6000, "70 core-minutes"),
        ("cpo", 12000, "2.3 core-hours"),
    ):
        (first, _) = announced(tmp_path, [*recorded, run(name, steps=steps)])
        assert first == f"To be trained: 1 run, about {expected} by the records here"


def test_a_run_whose_actions_are_held_is_not_estimated_by_records_of_another_hold(
    tmp_path: Path,
) -> None:
    """A control step of such a run costs a part of one with a decision of its own."""

    def planned(**interface: int) -> list[planning.Run]:
        raw = {
            "tasks": ["Pillars-0.15-Goal"],
            "algorithms": {"FAC": {"algorithm": "fac", "start_steps": 100}},
            "seeds": [0, 1],
            "budget": {"off_policy": 6000},
            "log_points": 10,
            "evaluation": {"points": 5, "episodes": 1},
            "interface": interface,
        }
        return list(planning.resolve(config.parse(raw)).runs)

    (every, _), held = planned(), planned(action_repeat=5)
    record(tmp_path, every, 600.0)
    (first, _) = announced(tmp_path, held)
    assert first == "To be trained: 2 runs, for how long no record tells"
    record(tmp_path, held[0], 120.0)
    (first, _) = announced(tmp_path, held)
    assert first == "To be trained: 1 run, about 2 core-minutes by the records here"


@pytest.mark.slow
def test_the_dry_run_of_one_new_baseline_can_be_read(tmp_path: Path) -> None:
    """All of the paper's grid and SAC-Lagrangian, as make.py asks Snakemake."""
    default = yaml.safe_load((ROOT / "config/config.yaml").read_text())
    overlay = tmp_path / "more.yaml"
    algorithms = {**default["algorithms"], "SAC-L": {"algorithm": "sac_lagrangian"}}
    overlay.write_text(yaml.safe_dump({"algorithms": algorithms}))
    program = (
        "import importlib.util, pathlib, sys; "
        "spec = importlib.util.spec_from_file_location('make', 'make.py'); "
        "make = importlib.util.module_from_spec(spec); spec.loader.exec_module(make); "
        "make.environment = lambda: pathlib.Path(sys.prefix); "
        "sys.exit(make.main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, "all", "-n", "--configfile", str(overlay)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    printed = done.stdout + done.stderr
    assert done.returncode == 0, printed
    lines = printed.splitlines()
    assert len(lines) < 100
    assert max(map(len, lines)) <= 400  # the names of all rules that run, for one
    assert re.search(
        r"^To be trained: 20 runs, about \d+ core-minutes by the records here$", printed, re.M
    )
    assert re.search(r"^  SAC-L: Pillars-0.15-Goal 5, .*Hazards-0.30-Push 5$", printed, re.M)
    assert re.search(r"^train +20$", printed, re.M)


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        *((word, True) for word in ("-n", "-np", "-pn", "--dry-run", "--dryrun")),
        *((word, False) for word in ("--nolock", "-j2", "--config", "-p", "n", "all")),
    ],
)
def test_dry_runs_are_recognised(argument: str, expected: bool) -> None:
    sys.path.insert(0, str(ROOT))
    try:
        import make
    finally:
        sys.path.remove(str(ROOT))
    assert make.is_dry(argument) is expected
