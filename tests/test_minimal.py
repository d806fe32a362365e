"""The example for readers takes the steps of the torch backend, and needs nothing of `safemr`."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from toy import ToyEnvs

from safemr.algorithms import safemr
from safemr.learning.evaluation import evaluate
from safemr.learning.replay import Replay
from safemr.tasks import make_envs

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = ROOT / "examples/safemr_minimal.py"

# The operations are the same, but the library multiplies stacks of matrices and steps on one flat
# vector, so sums round differently: 1e-7 of a network's norm, measured over 300 updates. Adam may
# make a whole step of a gradient that is only rounding (a unit that is all but dead), which is why
# more is allowed. Runs move the networks by more than 1000 times this.
TOLERANCE = 1e-5


@pytest.fixture(scope="module")
def minimal() -> ModuleType:
    spec = importlib.util.spec_from_file_location("safemr_minimal", PROGRAM)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look up the types of their fields
    spec.loader.exec_module(module)
    return module


class Library:
    """A trainer of the torch backend whose time steps are remembered until they are played back."""

    def __init__(self, settings: dict[str, Any], envs: Any, seed: int, total_steps: int) -> None:
        self.envs, self.tape, self.losses = envs, [], {}
        config = safemr.Config(backend="torch", **settings)
        self.trainer = safemr.Trainer(config, lambda _: self, seed, total_steps)
        agent_update = self.trainer.agent.update

        def update(drawn: Any, parts: int, measure: bool) -> dict[str, float]:
            """Measures every update; the trainer would only one in sixteen."""
            for name, value in agent_update(drawn, parts, measure=True).items():
                self.losses[name.removesuffix("_loss")] = value
            return {}

        self.trainer.agent.update = update

    def __getattr__(self, name: str) -> Any:
        return getattr(self.envs, name)

    def reset(self, seed: int) -> Any:
        result = self.envs.reset(seed=seed)
        self.tape.append((seed, result))
        return result

    def step(self, action: np.ndarray) -> Any:
        result = self.envs.step(action)
        self.tape.append((action.copy(), result))
        return result

    def networks(self) -> dict[str, list[torch.Tensor]]:
        """Weights and biases of each member, first layer first."""
        agent, found = self.trainer.agent, {}
        for name in ("critics", "targets", "policy", "multiplier"):
            network = getattr(agent, name)
            layers = network.shape.layers(network.parameters.detach())
            found[name] = [
                array[member].squeeze(0) if array.shape[1] == 1 and kind else array[member]
                for member in range(network.shape.count)
                for layer in layers
                for kind, array in enumerate(layer)
            ]
        return found


class Playback:
    """The environment of the example: what the trainer of the library saw at the same time step.

    The simulator's contacts and the servo of the yaw multiply a difference of 1e-7 between two
    actions by up to 20 in every time step, so any two implementations that act for themselves part
    within ten steps. Here both go on from the same states, and the actions are compared.
    """

    def __init__(self, library: Library) -> None:
        self.library = library

    def __getattr__(self, name: str) -> Any:
        return getattr(self.library.envs, name)

    def reset(self, seed: int) -> Any:
        expected, result = self.library.tape.pop(0)
        assert seed == expected
        return result

    def step(self, action: np.ndarray) -> Any:
        trainer = self.library.trainer
        trainer.advance(trainer.step + 1)
        expected, result = self.library.tape.pop(0)
        np.testing.assert_allclose(action, expected, rtol=0.0, atol=TOLERANCE)
        return result


def norm(tensors: list[torch.Tensor]) -> float:
    return float(torch.cat([tensor.reshape(-1) for tensor in tensors]).norm())


def assert_same_numbers(library: Library, variables: dict[str, Any]) -> None:
    """``variables``: those of the example's `train` where it stands."""
    agent = library.trainer.agent
    assert variables["updates"] == agent.updates
    for name, expected in library.networks().items():
        found = [parameter.detach() for parameter in variables[name].parameters()]
        difference = norm([a - b for a, b in zip(found, expected, strict=True)])
        assert difference <= TOLERANCE * norm(expected), name
    for ours, theirs in ((variables["zeta"], agent.zeta),
                         (variables["log_alpha"], agent.log_temperature)):  # fmt: skip
        torch.testing.assert_close(ours, theirs, rtol=TOLERANCE, atol=0.0)
    for name in ("critic", "policy", "certificate"):
        if name in variables["losses"]:
            loss = variables["losses"][name].item()
            assert loss == pytest.approx(float(library.losses[name]), rel=1e-4, abs=1e-6), name


@pytest.mark.parametrize(
    ("task", "settings", "steps", "updates"),
    [
        # The memory forgets, episodes end, and a return meets both.
        ("Pillars-0.15-Goal", {"hidden": 16, "replay_capacity": 480, "batch_size": 64}, 1360, 300),
        ("Hazards-0.15-Push", {}, 560, 100),
    ],
)
def test_example_takes_the_steps_of_the_torch_backend(
    minimal: ModuleType, task: str, settings: dict[str, Any], steps: int, updates: int
) -> None:
    settings = {"num_envs": 8, "start_steps": 160, "update_every": 4, **settings}
    envs = make_envs({"name": task, "settings": {"max_episode_steps": 30}}, settings["num_envs"])
    library = Library(settings, envs, 7, steps)
    run = minimal.train(minimal.Config(**settings), Playback(library), 7, steps)
    first = None
    for number, (step, *_) in enumerate(run):
        if number % 25 == 0 or step >= steps:
            assert_same_numbers(library, run.gi_frame.f_locals)
            first = first or library.networks()
    assert library.trainer.agent.updates == updates
    for name, last in library.networks().items():
        moved = norm([a - b for a, b in zip(first[name], last, strict=True)])
        assert moved > 1000 * TOLERANCE * norm(last), f"{name} hardly moved: nothing was compared"
    assert abs(library.trainer.agent.zeta[0] - 0.3) > 0.05


def test_example_acts_for_itself_and_is_evaluated_alike(minimal: ModuleType) -> None:
    """In an environment that does not amplify differences, without playback."""
    settings = {"num_envs": 4, "hidden": 16, "start_steps": 80, "batch_size": 32,
                "update_every": 4, "target_entropy": -1.0}  # fmt: skip
    library = Library(settings, ToyEnvs(4), 1, 1280)
    run = minimal.train(minimal.Config(**settings), ToyEnvs(4), 1, 1280)
    violations = []
    for number, (step, policy, _, _) in enumerate(run):
        library.trainer.advance(step)
        if number % 40 == 39:
            assert_same_numbers(library, run.gi_frame.f_locals)
            found = minimal.evaluate(policy, ToyEnvs(5))
            expected = evaluate(library.trainer.policy, ToyEnvs(5), 10_000)
            assert found["return"] == pytest.approx(expected["return"], rel=1e-4)
            assert found["violating steps"] == expected["cost_indicator"]
            assert found["clean episodes"] == expected["zero_violation_share"]
            violations.append(found["violating steps"])
    assert library.trainer.agent.updates == 300
    assert max(violations) > 0


def test_memory_of_the_example_is_that_of_the_library(minimal: ModuleType) -> None:
    """Terminations too, which the tasks hardly have; the ring has turned."""
    rng = torch.Generator().manual_seed(0)
    mine, theirs = minimal.Replay(9, 0.9, 4), Replay(9, 3, 2, 1, 1, gamma=0.9, n_step=4)
    for step in range(30):
        ended = torch.rand(3, generator=rng) < 0.3
        fields = {
            "observations": torch.full((3, 2), float(step)),
            "next_observations": torch.full((3, 2), step + 0.5),
            "actions": torch.rand(3, 1, generator=rng),
            "rewards": torch.randn(3, generator=rng),
            "terminated": (ended & (torch.rand(3, generator=rng) < 0.5)).float(),
            "ended": ended.float(),
        }
        distances = torch.rand(3, 4, generator=rng)
        names = ("d", "d_dot", "d_next", "d_dot_next")
        mine.add(**fields, **dict(zip(names, distances.split(1, 1), strict=True)))
        theirs.add(**fields, distances=distances, costs=torch.zeros(3))
        found, expected = (
            memory.sample(50, torch.Generator().manual_seed(step)) for memory in (mine, theirs)
        )
        for name, values in found._asdict().items():
            torch.testing.assert_close(values, getattr(expected, name), rtol=1e-6, atol=1e-6)


def test_example_has_the_hyperparameters_of_the_library(minimal: ModuleType) -> None:
    library = dataclasses.asdict(safemr.Config())
    mine = dataclasses.asdict(minimal.Config())
    names = ("sigma", "k", "n")
    for field, suffix in (("zeta", ""), ("low", "_min"), ("high", "_max")):
        assert mine.pop(field) == tuple(library[name + suffix] for name in names)
    assert mine == {name: library[name] for name in mine}


def test_example_imports_nothing_of_safemr() -> None:
    names = set()
    for node in ast.walk(ast.parse(PROGRAM.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module.partition(".")[0])
    assert names - sys.stdlib_module_names == {"gymnasium", "numpy", "torch"}


@pytest.mark.parametrize(
    ("arguments", "status", "expected"),
    [
        (["--help"], 0, "--steps"),
        (["--task", "Pillars"], 2, "Pillars-0.15-Goal"),
        (["--steps", "5000"], 2, "--steps must exceed"),
    ],
)
def test_example_as_a_program(arguments: list[str], status: int, expected: str) -> None:
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(PROGRAM), *arguments]
    done = subprocess.run(
        command, cwd=ROOT, env=variables, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == status
    assert expected in done.stdout + done.stderr
