"""The measurements that the repository keeps are what its code measures.

What is kept is believed as long as its key is the same, and the key holds a version, no sources:
measuring code that gives other numbers without a new version would leave old ones standing. So one
measurement of every kind is made again from the same record and compared.

On the processor that measured first all numbers are equal. Elsewhere powers and sines differ in
their last bits, which changes nothing here by more than 1e-9, and so do the matrix products of
networks. Those matter where a policy flies: after some ten steps of a navigation task a robot is
1e-3 m from where it was, and after a hundred it may pass an obstacle on the other side. What such
flights say can be compared within their standard errors only, and their courses in the first steps
only (`TOLERANCE`).
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from safemr import files
from safemr.aircraft import neural, scoring
from safemr.experiment import records
from safemr.experiment.record import Record
from safemr.measure import certify, controllers, evaluate, filters, oracle, store, trajectories
from safemr.measure.store import HEADER, Measurements

RESULTS = Path(__file__).resolve().parents[1] / "results"
QUICK = RESULTS / "quick"  # has every kind, the neural energies too
TASK = "Pillars-0.15-Goal"


class Again:
    """A results root in which things are measured again, with records of another root."""

    def __init__(self, recorded: Path, root: Path, solved: Path) -> None:
        self.recorded, self.root, self.solved = recorded, root, solved
        self.measurements = Measurements(root)

    def kept(self, kind: str, label: str) -> tuple[Path, dict[str, Any]]:
        """The file that the repository keeps under a label, and its header."""
        (path,) = (self.recorded / store.FOLDER / kind).glob(f"{label}-*")
        if path.suffix == ".json":
            return path, json.loads(path.read_text())
        return path, json.loads(str(files.load_arrays(path)[HEADER]))

    def record(self, inputs: Mapping[str, Any]) -> Path:
        """A copy of the record that a measurement was made on."""
        place = Path("runs", inputs["record"])
        shutil.copytree(self.recorded / place, self.root / place, dirs_exist_ok=True)
        return self.root / place

    def sets(self, log2_states: int) -> scoring.TrueSets:
        return scoring.TrueSets.cached(self.solved, log2_states)

    def frontier(self) -> pd.DataFrame:
        _, entry = self.kept("aircraft_frontier", "frontier")
        return pd.DataFrame(entry["value"])


def the_controllers(again: Again) -> None:
    inputs = again.kept("controllers", TASK)[1]["inputs"]
    controllers.measured_scores(
        again.measurements, [inputs["task"]], seeds=inputs["seeds"], episodes=inputs["episodes"]
    )


def a_learned_certificate(again: Again) -> None:
    inputs = again.kept("certificates", f"{TASK}-SafeMR-seed*")[1]["inputs"]
    certificate, task = certify.certificate_of_record(again.record(inputs["policy"]))
    certify.measured_certificate(
        again.measurements, certificate, task, states=inputs["states"], episodes=inputs["episodes"]
    )


def the_margins(again: Again) -> None:
    inputs = again.kept("certificates", f"{TASK}-SafeMR-seed*")[1]["inputs"]
    certificate, task = certify.certificate_of_record(again.record(inputs["policy"]))
    certify.measured_margins(again.measurements, certificate, task)


def the_rollouts(again: Again) -> None:
    inputs = again.kept("rollouts", f"{TASK}-SafeMR-seed*")[1]["inputs"]
    certificate, task = certify.certificate_of_record(again.record(inputs["policy"]))
    trajectories.measured(
        again.measurements, certificate, task, layouts=inputs["layouts"], steps=inputs["steps"]
    )


def the_episodes(again: Again) -> None:
    inputs = again.kept("episodes", f"{TASK}-SafeMR-seed*")[1]["inputs"]
    trajectories.measured_episodes(
        again.measurements,
        Record.open(again.record(inputs["policy"])),
        layouts=inputs["layouts"],
        steps=inputs["steps"],
    )


def unseen_layouts(again: Again) -> None:
    inputs = again.kept("unseen_layouts", f"{TASK}-SafeMR-seed0")[1]["inputs"]
    evaluate.measured(
        again.measurements,
        Record.open(again.record(inputs)),
        episodes=inputs["episodes"],
        seed=inputs["seed"],
    )


def behind_filters(again: Again) -> None:
    inputs = again.kept("filters", f"{TASK}-PPO-L-seed0*behind-SafeMR*")[1]["inputs"]
    learned = Record.open(again.record(inputs["certificate"]["record"]))
    filters.measured(
        again.measurements,
        Record.open(again.record(inputs)),
        learned.certificate(),
        episodes=inputs["episodes"],
        seed=inputs["seed"],
    )


def the_least_certificate(again: Again) -> None:
    inputs = again.kept("unseen_layouts", f"{TASK}-FAC-oracle-seed*")[1]["inputs"]
    oracle.measured_sizes(again.measurements, [again.record(inputs)])


def the_frontier(again: Again) -> None:
    inputs = again.kept("aircraft_frontier", "frontier")[1]["inputs"]
    scoring.measured_frontier(again.measurements, again.sets(inputs["log2_states"]))


def learners_and_references(again: Again) -> None:
    inputs = again.kept("aircraft_learners", "Aircraft-SafeMR-seed0")[1]["inputs"]
    folder = again.record(inputs["policy"])
    runs, _ = records.read_records(again.root, [folder.relative_to(again.root)])
    scoring.compare(
        again.sets(inputs["log2_states"]), again.frontier(), again.root, runs, inputs["flights"]
    )


def the_slices(again: Again) -> None:
    nothing_learned = pd.DataFrame({"kind": [], "variant": []})
    scoring.slices(again.sets(19), nothing_learned, again.measurements)


def neural_energies(again: Again) -> None:
    entry = again.kept("aircraft_neural", "neural")[1]
    inputs, order = entry["inputs"], [(row["variant"], row["seed"]) for row in entry["value"]]

    def place(folder: Path) -> int:
        """Of a record among the rows, which are in the order of the configuration."""
        return order.index((folder.parts[-2], int(folder.name.partition("-")[0][len("seed") :])))

    folders = sorted((again.record(policy) for policy in inputs["policies"]), key=place)
    runs, _ = records.read_records(again.root, [f.relative_to(again.root) for f in folders])
    energy = Record.open(folders[0]).hyperparameters
    neural.measured(
        again.measurements, again.sets(inputs["log2_states"]), again.frontier(), again.root, runs,
        energy,
    )  # fmt: skip


CASES: Mapping[Callable[[Again], None], tuple[Path, tuple[str, ...]]] = {
    the_controllers: (RESULTS, ("controllers",)),
    a_learned_certificate: (RESULTS, ("certificates",)),
    the_margins: (RESULTS, ("margins",)),
    the_rollouts: (RESULTS, ("rollouts",)),
    the_episodes: (RESULTS, ("episodes",)),
    unseen_layouts: (RESULTS, ("unseen_layouts",)),
    behind_filters: (RESULTS, ("filters",)),
    the_least_certificate: (RESULTS / "oracle", ("oracle", "encounters")),
    the_frontier: (RESULTS, ("aircraft_frontier",)),
    learners_and_references: (RESULTS, ("aircraft_learners", "aircraft_references")),
    the_slices: (RESULTS, ("aircraft_slices",)),
    neural_energies: (QUICK, ("aircraft_neural", "aircraft_neural_slice")),
}


CLOSE = 1e-6
FIRST_STEPS = 3
# Kind -> pattern of the place of a number -> by how much it may differ, absolutely below 1.
TOLERANCE: Mapping[str, Mapping[str, float]] = {
    # Eight episodes of a thousand steps, few of which violate.
    "certificates": {r"/row/policy_\w+_share": 0.02},
    # A hundred episodes: four standard errors of a return (sd 8 of 18), of a share.
    "unseen_layouts": {
        "/(return|goals|reward_approach|reward_goal)": 0.25, "/return_sd": 0.3, "/length": CLOSE,
        "/zero_violation_share": 0.2, "/violation_rate": 0.02, "/cost.*": 5.0,
    },
    # Twenty episodes behind a filter; the processor's time is whatever it is.
    "filters": {
        "/(return|goals|reward_approach|reward_goal)": 0.5, "/length": CLOSE,
        "/zero_violation_share": 0.4, "/violation_rate": 0.02, "/cost.*": 5.0,
        "/(intervened|infeasible|distance)": 0.1, "/microseconds": np.inf,
    },
    # Ten thousand flights, or two thousand.
    "aircraft_learners": {"/(collisions|collision_share|effort.*|least_separation)": 0.01},
    "aircraft_neural": {
        # The control is trained by what is measured, for thousands of steps.
        r"\[\d+\]/(collisions|\w*share\w*|effort.*|least_separation|volume.*|iou)": 0.02,
    },
    # Half precision: one step of it at 1.
    "aircraft_slices": {"/.*": 1e-3},
    "aircraft_neural_slice": {"/.*": 1e-3},
    "rollouts": {"/map/(multiplier|phi)": 1e-4},
    # Of the first steps: 1e-7 of an action is 5e-6 of a reward two steps later, 1e-3 m four later.
    "episodes": {"/(robot|reward)": 1e-4},
}  # fmt: skip


def allowed(kind: str, place: str) -> float:
    patterns = TOLERANCE.get(kind, {}).items()
    return next((limit for pattern, limit in patterns if re.fullmatch(pattern, place)), CLOSE)


def differences(now: Any, before: Any, place: str = "") -> list[tuple[str, float]]:
    """Every number's place and difference, relative where it is above 1; inf where not alike."""
    if isinstance(before, dict):
        if now.keys() != before.keys():
            return [(place, np.inf)]
        return [d for k in before for d in differences(now[k], before[k], f"{place}/{k}")]
    if isinstance(before, list):
        if len(now) != len(before):
            return [(place, np.inf)]
        pairs = enumerate(zip(now, before, strict=True))
        return [d for i, (a, b) in pairs for d in differences(a, b, f"{place}[{i}]")]
    if isinstance(before, np.ndarray):
        if now.shape != before.shape or now.dtype != before.dtype:
            return [(place, np.inf)]
        if before.dtype.kind in "fc":
            gaps = np.abs(now - before) / np.fmax(1.0, np.abs(before))
            alike = np.isnan(now) == np.isnan(before)
            return [(place, float(np.where(alike, np.nan_to_num(gaps), np.inf).max(initial=0)))]
        return [(place, 0.0 if np.array_equal(now, before) else np.inf)]
    if isinstance(before, float) and isinstance(now, float):
        if np.isnan(before) or np.isnan(now):
            return [(place, 0.0 if np.isnan(before) == np.isnan(now) else np.inf)]
        return [(place, abs(now - before) / max(1.0, abs(before)))]
    return [(place, 0.0 if now == before else np.inf)]


def content(path: Path) -> Any:
    """What was measured; of flown courses their shapes and the first steps."""
    if path.suffix == ".json":
        return json.loads(path.read_text())["value"]
    arrays = {name: values for name, values in files.load_arrays(path).items() if name != HEADER}
    for name in ("robot", "goal", "box", "reward", "cost_indicator", "goal_met"):
        whole = arrays.pop(f"episodes/{name}", None)
        if whole is not None:
            arrays |= {name: whole[:FIRST_STEPS], f"{name}, shape": np.array(whole.shape)}
    return arrays


def test_every_kind_is_measured_again_by_some_case() -> None:
    kinds = [kind for _, made in CASES.values() for kind in made]
    assert sorted(kinds) == sorted(store.VERSIONS)


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("solved")


@pytest.mark.slow
@pytest.mark.parametrize("measure", CASES, ids=lambda function: function.__name__)
def test_the_repository_keeps_what_its_code_measures(
    measure: Callable[[Again], None], tmp_path: Path, solved: Path
) -> None:
    """Otherwise VERSIONS was not raised with a change of the measuring code."""
    recorded, kinds = CASES[measure]
    measure(Again(recorded, tmp_path, solved))
    made = [(path.parent.name, path) for path in (tmp_path / store.FOLDER).glob("*/*")]
    assert {kind for kind, _ in made} == set(kinds)
    for kind, path in made:
        kept = recorded / store.FOLDER / kind / path.name
        assert kept.exists(), f"{kind}: inputs or version are others than those kept: redraw"
        found = differences(content(path), content(kept))
        far = [(place, gap) for place, gap in found if gap > allowed(kind, place)]
        assert not far, f"raise VERSIONS[{kind!r}] and redraw; or is it the processor? {far[:9]}"
