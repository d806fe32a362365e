"""What a run does not import before it learns: PyTorch's compiler, and what only figures need."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent
PROGRAM = """
import sys
from kills import short_run
from safemr.experiment import planning
from safemr.experiment.train import make_envs

for name in planning.algorithm_names():
    algorithm = planning.load_algorithm(name)
    if "backend" not in algorithm.settable:
        continue
    run = short_run(name, overrides={"backend": sys.argv[1]})
    given = algorithm.hyperparameters(**run.config["algorithm"]["hyperparameters"])
    trainer = algorithm.trainer(
        given, lambda count: make_envs(run.config["task"], count), 0, run.config["steps"]
    )
    trainer.advance(2 * run.config["log_every"])
    trainer.load_state_dict(trainer.state_dict())
    print(name)
heavy = ("torch._dynamo", "torch._inductor", "sympy", "matplotlib", "pandas", "wandb")
print([name for name in heavy if name in sys.modules])
"""


@pytest.mark.parametrize("backend", ["fused", "torch"])
def test_learning_does_not_import_a_compiler(backend: str) -> None:
    """Steps of every algorithm, through a checkpoint's state; the trust region's included."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, backend],
        cwd=TESTS, capture_output=True, text=True, check=True,
    )  # fmt: skip
    *names, found = done.stdout.splitlines()
    assert {"safemr", "joint_sis", "sac_lagrangian", "ppo_lagrangian", "cpo"} <= set(names)
    assert found == "[]"
