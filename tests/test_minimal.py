"""The example for readers takes the steps of the torch backend, and needs nothing of `safemr`."""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from toy import ToyEnvs

from safemr.algorithms import safemr
from safemr.learning.evaluation import evaluate
from safemr.learning.networks import squashed_gaussian
from safemr.learning.observation import ObservationTransform
from safemr.learning.replay import Replay
from safemr.tasks import make_envs

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = ROOT / "examples/safemr_minimal.py"

# The operations are the same, but the library multiplies stacks of matrices and steps on one flat
# vector, so sums round differently: in float32 by 1e-7 of a network's norm (measured). That lasts
# until a unit is within rounding of its kink for some sample, or two critics of a tie: then that
# sample's gradient takes the other branch. With 64 units this happens about once in 100 updates,
# and makes a difference of 1e-5.
ROUNDING, BRANCHES = 1e-6, 1e-4


@pytest.fixture(scope="module")
def minimal() -> ModuleType:
    spec = importlib.util.spec_from_file_location("safemr_minimal", PROGRAM)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look up the types of their fields
    spec.loader.exec_module(module)
    return module


def library_config(config: Any, **settings: Any) -> safemr.Config:
    """The library's for the example's."""
    settings = dataclasses.asdict(config) | settings
    for field, end in (("zeta", ""), ("low", "_min"), ("high", "_max")):
        names = [name + end for name in ("sigma", "k", "n")]
        settings |= dict(zip(names, settings.pop(field), strict=True))
    return safemr.Config(**settings)


class Library:
    """A trainer of the torch backend whose time steps are remembered until they are played back."""

    def __init__(self, config: safemr.Config, envs: Any, seed: int, total_steps: int) -> None:
        self.envs, self.tape, self.losses = envs, [], {}
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
                array.clone()
                for member in range(network.shape.count)
                for weight, bias in layers
                for array in (weight[member], bias[member, 0])
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
        np.testing.assert_allclose(action, expected, rtol=0.0, atol=10 * BRANCHES)
        return result


def norm(tensors: list[torch.Tensor]) -> float:
    return float(torch.cat([tensor.reshape(-1) for tensor in tensors]).norm())


def assert_same_numbers(library: Library, variables: dict[str, Any]) -> None:
    """``variables``: those of the example's `train` where it stands."""
    agent = library.trainer.agent
    assert variables["updates"] == agent.updates
    tolerance = ROUNDING if agent.updates <= 20 else BRANCHES
    for name, expected in library.networks().items():
        found = [parameter.detach() for parameter in variables[name].parameters()]
        difference = norm([a - b for a, b in zip(found, expected, strict=True)])
        assert difference <= tolerance * norm(expected), name
    for ours, theirs in ((variables["zeta"], agent.zeta),
                         (variables["log_alpha"], agent.log_temperature)):  # fmt: skip
        torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=0.0)
    for name in ("critic", "policy", "certificate"):
        if name in variables["losses"]:
            loss = variables["losses"][name].item()
            assert loss == pytest.approx(
                float(library.losses[name]), rel=10 * tolerance, abs=tolerance
            ), name


@pytest.mark.parametrize(
    ("task", "settings", "steps", "updates"),
    [
        # The memory forgets, episodes end, phi > eta_D > 0, zeta moves late.
        (
            "Pillars-0.15-Goal",
            {"hidden": 16, "batch_size": 64, "replay_capacity": 480, "eta": 0.02,
             "certificate_start": 0.2},
            1360,
            300,
        ),
        # zeta reaches its box, lambda its cap, and its gradient the norm to which it is clipped.
        (
            "Hazards-0.15-Push",
            {"low": (0.25, 0.1, 0.1), "multiplier_cap": 0.048, "multiplier_grad_norm": 1e-4},
            560,
            100,
        ),
    ],
)  # fmt: skip
def test_example_takes_the_steps_of_the_torch_backend(
    minimal: ModuleType, task: str, settings: dict[str, Any], steps: int, updates: int
) -> None:
    config = minimal.Config(num_envs=8, start_steps=160, update_every=4, **settings)
    envs = make_envs({"name": task, "settings": {"max_episode_steps": 30}}, config.num_envs)
    library = Library(library_config(config, backend="torch"), envs, 7, steps)
    run = minimal.train(config, Playback(library), 7, steps)
    first = None
    for number, (step, *_) in enumerate(run):
        if number % 15 == 0 or step >= steps:
            assert_same_numbers(library, run.gi_frame.f_locals)
            first = first or library.networks()
    assert library.trainer.agent.updates == updates
    for name, last in library.networks().items():
        moved = norm([a - b for a, b in zip(first[name], last, strict=True)])
        assert moved > 50 * BRANCHES * norm(last), f"{name} hardly moved: nothing was compared"
    assert abs(library.trainer.agent.zeta[0] - 0.3) > 0.04


def test_example_acts_for_itself_and_is_evaluated_alike(minimal: ModuleType) -> None:
    """In an environment that does not amplify differences, without playback."""
    config = minimal.Config(
        num_envs=4, hidden=16, start_steps=80, batch_size=32, update_every=4, target_entropy=-1.0
    )
    library = Library(library_config(config, backend="torch"), ToyEnvs(4), 1, 800)
    run = minimal.train(config, ToyEnvs(4), 1, 800)
    for number, (step, policy, *_) in enumerate(run):
        library.trainer.advance(step)
        if number % 50 == 49:
            assert_same_numbers(library, run.gi_frame.f_locals)
            mine = policy
    assert library.trainer.agent.updates == 180
    network = library.trainer.agent.policy
    theirs = network.shape.layers(network.parameters.detach())[-1][1][0, 0]
    violating = []
    for push in (0.0, 3.0):  # towards the wall, which pays and must not be touched
        mine[-1].bias.detach()[0] += push
        theirs[0] += push
        found = minimal.evaluate(mine, ToyEnvs(5))
        expected = evaluate(library.trainer.policy, ToyEnvs(5), 10_000)
        assert found["return"] == pytest.approx(expected["return"], rel=1e-3)
        assert found["violating steps"] == expected["cost_indicator"]
        assert found["clean episodes"] == expected["zero_violation_share"]
        violating.append(found["violating steps"])
    assert violating[0] < violating[1]


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


@pytest.mark.parametrize("task", ["Pillars-0.15-Goal", "Hazards-0.15-Push"])
def test_observations_of_the_example_are_those_of_the_library(
    minimal: ModuleType, task: str
) -> None:
    """Beyond every clip, too."""
    envs = make_envs(task, 1)
    raw = np.random.default_rng(0).normal(0.0, 10.0, (64, envs.single_observation_space.shape[0]))
    infos = {"d": raw[:, :4], "d_dot": raw[:, 4:8]}
    found, d, d_dot = minimal.observe(envs, raw, infos)
    expected = ObservationTransform.for_layout(envs.observation_layout)(raw)
    np.testing.assert_array_equal(found.numpy(), expected)
    np.testing.assert_array_equal(d.numpy(), infos["d"].astype(np.float32))
    np.testing.assert_array_equal(d_dot.numpy(), infos["d_dot"].astype(np.float32))


def test_squashed_gaussian_of_the_example_is_that_of_the_library(minimal: ModuleType) -> None:
    """Where tanh saturates and at the bounds of the standard deviation, too."""
    rng = torch.Generator().manual_seed(0)
    output, noise = 10.0 * torch.randn(64, 4, generator=rng), torch.randn(64, 2, generator=rng)
    pairs = zip(minimal.squashed_gaussian(output, noise), squashed_gaussian(output, noise),
                strict=True)  # fmt: skip
    for found, expected in pairs:
        torch.testing.assert_close(found, expected)


def test_example_has_the_hyperparameters_of_the_library(minimal: ModuleType) -> None:
    assert library_config(minimal.Config()) == safemr.Config()


def test_example_imports_nothing_of_safemr() -> None:
    names = set()
    for node in ast.walk(ast.parse(PROGRAM.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module.partition(".")[0])
    assert names - sys.stdlib_module_names == {"gymnasium", "numpy", "torch"}


def test_example_is_a_program() -> None:
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(PROGRAM), "--help"]
    done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    assert all(option in done.stdout for option in ("--task", "--steps", "--seed"))


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--task", "Pillars"], "Pillars-0.15-Goal"),
        (["--steps", "5000"], "--steps must exceed the 5000"),
        (["--seed", "-1"], "--seed be >= 0"),
    ],
)
def test_example_refuses_what_it_cannot_run(
    minimal: ModuleType, monkeypatch: Any, capsys: Any, arguments: list[str], complaint: str
) -> None:
    monkeypatch.setattr(sys, "argv", ["safemr_minimal.py", *arguments])
    with pytest.raises(SystemExit) as caught:
        minimal.main()
    assert caught.value.code == 2
    assert complaint in capsys.readouterr().err


def test_example_prints_a_line_at_each_twentieth(
    minimal: ModuleType, monkeypatch: Any, capsys: Any
) -> None:
    monkeypatch.setattr(sys, "argv", ["safemr_minimal.py", "--steps", "800"])
    small = functools.partial(minimal.Config, hidden=8, start_steps=80, batch_size=8)
    monkeypatch.setattr(minimal, "Config", small)
    short = functools.partial(gymnasium.make_vec, max_episode_steps=5)
    monkeypatch.setattr(minimal.gymnasium, "make_vec", short)
    minimal.main()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 20
    assert int(lines[-1].split("|")[0]) == 800
    assert all(name in lines[-1] for name in ("return", "clean episodes", "sigma", "certificate"))
