"""A change of an algorithm's behaviour must bump its VERSION, or stale records would be believed.

For each algorithm a short training on the toy task is compared with `fingerprints.json`. When the
numbers differ although VERSION does not: bump VERSION in the algorithm's file if the change is
meant, then write the new fingerprints with `python tests/test_fingerprints.py`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from toy import ToyEnvs  # noqa: E402

from safemr import runs  # noqa: E402

FILE = Path(__file__).with_name("fingerprints.json")
# Round-off differs between processors; behaviour does not differ by so little.
TOLERANCE = 2e-3
STEPS = 1600
SMALL = {
    "off_policy": {"num_envs": 4, "hidden": 16, "batch_size": 32, "start_steps": 200},
    "on_policy": {"num_envs": 4, "hidden": 16, "epoch_steps": 800},
}


def fingerprint(name: str) -> dict[str, Any]:
    """VERSION and the metrics of a short training with all defaults but its size."""
    algorithm = runs.load_algorithm(name)
    config = algorithm.hyperparameters(**SMALL[algorithm.family])
    trainer = algorithm.trainer(config, ToyEnvs, 0, STEPS)
    metrics = trainer.advance(STEPS)
    kept = {name: float(f"{value:.6g}") for name, value in metrics.items() if value == value}
    return {"version": algorithm.version, "metrics": kept}


@pytest.mark.parametrize("name", runs.algorithm_names())
def test_behaviour_changes_only_with_the_version(name):
    stored, now = json.loads(FILE.read_text()).get(name), fingerprint(name)
    remedy = f"bump VERSION in safemr/algorithms/{name}.py if meant, then run: python {__file__}"
    assert stored is not None, f"{name} has no fingerprint yet: run: python {__file__}"
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
    algorithm = runs.load_algorithm(name)
    small = {**SMALL["off_policy"], "critic_lr": 1.2e-3}
    trainer = algorithm.trainer(algorithm.hyperparameters(**small), ToyEnvs, 0, STEPS)
    stored, now = json.loads(FILE.read_text())[name]["metrics"], trainer.advance(STEPS)
    assert any(abs(now[m] - v) > TOLERANCE * max(abs(v), 1e-3) for m, v in stored.items())


if __name__ == "__main__":
    prints = {name: fingerprint(name) for name in runs.algorithm_names()}
    FILE.write_text(json.dumps(prints, indent=1, sort_keys=True) + "\n")
    print(f"wrote {FILE.name}: {', '.join(prints)}")
