"""A change of an algorithm's behaviour must bump its VERSION, or stale records would be believed.

For each algorithm a short training on the toy task is compared with `fingerprints.json`. When the
numbers differ although VERSION does not: bump VERSION in the algorithm's file if the change is
meant, then write the new fingerprint with `python tests/test_fingerprints.py`. That writes what is
new, an algorithm or a version, and leaves every other fingerprint as it is.

An algorithm without a fingerprint has nothing to compare with. That is as it should be until runs
of it are recorded under results/: no record could be stale. From then on it must have one.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from toy import OF_THE_ROBOT, envs_for  # noqa: E402

from safemr.experiment import planning, records  # noqa: E402

FILE = Path(__file__).with_name("fingerprints.json")
# Round-off differs between processors; behaviour does not differ by so little.
TOLERANCE = 2e-3
STEPS = 1600
# The robot's motion amplifies round-off while a learned policy drives it, so that the processor
# would decide: weights that differ by 1e-7 change a metric by up to 7e-2 after 350 such control
# steps, by 1e-6 after these 10.
ROBOT_STEPS = 800
ROBOT = {
    **{"num_envs": 16, "hidden": 16, "batch_size": 32, "start_steps": 640},
    "certificate_delay": 8,  # of the guard's, whose steps are few
}
SMALL = {
    "off_policy": {"num_envs": 4, "hidden": 16, "batch_size": 32, "start_steps": 200},
    "on_policy": {"num_envs": 4, "hidden": 16, "epoch_steps": 800},
}


def fingerprint(name: str) -> dict[str, Any]:
    """VERSION and the metrics of a short training with all defaults but its size."""
    algorithm = planning.load_algorithm(name)
    fields = algorithm.hyperparameters.__dataclass_fields__
    chosen, steps = SMALL[algorithm.family], STEPS
    if name in OF_THE_ROBOT:
        chosen, steps = ROBOT, ROBOT_STEPS
    small = {field: value for field, value in chosen.items() if field in fields}
    trainer = algorithm.trainer(
        algorithm.hyperparameters(**small), envs_for(algorithm.name), 0, steps
    )
    metrics = trainer.advance(steps)
    kept = {name: float(f"{value:.6g}") for name, value in metrics.items() if value == value}
    return {"version": algorithm.version, "metrics": kept}


def recorded_algorithms(results: Path) -> set[str]:
    """The algorithms that runs are recorded of, below any results root."""
    configs = results.glob(f"**/runs/*/*/seed*/{records.CONFIG}")
    return {json.loads(path.read_text())["algorithm"]["name"] for path in configs}


def renewed(
    stored: dict[str, Any], versions: dict[str, int], make: Callable[[str], dict[str, Any]]
) -> dict[str, Any]:
    """The fingerprints with those of new algorithms and new versions made, the others kept."""
    return {
        name: stored[name] if stored.get(name, {}).get("version") == version else make(name)
        for name, version in versions.items()
    }


@pytest.mark.parametrize("name", planning.algorithm_names())
def test_behaviour_changes_only_with_the_version(name):
    stored = json.loads(FILE.read_text()).get(name)
    remedy = f"bump VERSION in safemr/algorithms/{name}.py if meant, then run: python {__file__}"
    if stored is None:
        assert name not in recorded_algorithms(ROOT / "results"), (
            f"runs of {name} are recorded, but not how it behaves: run: python {__file__}"
        )
        pytest.skip(f"no run of {name} is recorded, so none can be stale")
    now = fingerprint(name)
    assert stored["version"] == now["version"], f"{name}: new version; run: python {__file__}"
    assert stored["metrics"].keys() == now["metrics"].keys(), remedy
    for metric, value in stored["metrics"].items():
        scale = max(abs(value), 1e-3)
        assert abs(now["metrics"][metric] - value) <= TOLERANCE * scale, (
            f"{name}: {metric} is {now['metrics'][metric]}, was {value}; {remedy}"
        )


def test_a_changed_hyperparameter_changes_the_fingerprint():
    """The comparison can fail: a slightly different learning rate is outside the tolerance."""
    name = "joint_sis"
    algorithm = planning.load_algorithm(name)
    small = {**SMALL["off_policy"], "critic_lr": 1.2e-3}
    trainer = algorithm.trainer(
        algorithm.hyperparameters(**small), envs_for(algorithm.name), 0, STEPS
    )
    stored, now = json.loads(FILE.read_text())[name]["metrics"], trainer.advance(STEPS)
    assert any(abs(now[m] - v) > TOLERANCE * max(abs(v), 1e-3) for m, v in stored.items())


def test_the_algorithms_of_this_repository_have_fingerprints():
    recorded = recorded_algorithms(ROOT / "results") & set(planning.algorithm_names())
    assert len(recorded) > 5
    assert recorded <= json.loads(FILE.read_text()).keys()


def test_only_new_algorithms_and_versions_get_a_new_fingerprint():
    """Else a change without a new version would be gone with the next baseline's fingerprint."""
    stored = {"old": {"version": 1}, "bumped": {"version": 1}, "gone": {"version": 1}}
    made = []
    found = renewed(
        stored, {"old": 1, "bumped": 2, "mine": 1}, lambda name: made.append(name) or {"version": 2}
    )
    assert made == ["bumped", "mine"]
    assert found == {"old": stored["old"], "bumped": {"version": 2}, "mine": {"version": 2}}


if __name__ == "__main__":
    before = json.loads(FILE.read_text())
    versions = {name: planning.load_algorithm(name).version for name in planning.algorithm_names()}
    prints = renewed(before, versions, fingerprint)
    FILE.write_text(json.dumps(prints, indent=1, sort_keys=True) + "\n")
    changed = [name for name, value in prints.items() if before.get(name) != value]
    print(f"{FILE.name}: {', '.join(changed) or 'nothing'} new")
