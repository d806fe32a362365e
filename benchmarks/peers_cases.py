"""What `benchmarks.peers` measures: other packages at work, ours, and what is compared to what."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import platform
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from benchmarks.on_policy import OMNISAFE
from benchmarks.stopwatch import REST
from benchmarks.training import Run, watch
from safemr.algorithms import ppo_lagrangian
from safemr.conventions import TUNING_EVALUATION_SEED
from safemr.errors import UserError
from safemr.experiment.planning import load_algorithm
from safemr.experiment.provenance import package_versions
from safemr.learning.evaluation import evaluate
from safemr.tasks import make_envs

ROOT = Path(__file__).resolve().parents[1]
TASK, COST_LIMIT = "Pillars-0.15-Goal", 25.0
EPOCH_TASKS = {"omnisafe": "SafetyPointGoal1-v0", "here": "PointGoal1"}
BATCHES = (64, 2_000)  # OmniSafe's, and one with which an epoch is cheap
HELD, UPDATES = 150_000, 200  # transitions in the memory, gradient steps of a block
WIDTHS = (64, 256)
LR = 1e-3  # of policy and critics here
BACKENDS = ("torch", "fused")
EPISODES = 10
SCHEDULED = 400_000  # steps that the learning rates here span, the recipe's budget
UNCONSTRAINED = {"sigma": 0.0, "k": 0.0, "n": 1.0}  # FAC-phi0
EVERY = (8, 1, 4, 2)  # steps between two gradient steps; the recipe's first
# What stands for our recipe in Stable-Baselines3: returns of five steps, the first temperature.
LIKE_OURS = {"n_steps": 5, "ent_coef": "auto_0.0183"}
SB3_LEARNING: Mapping[str, dict[str, Any]] = {
    "64 units, lr 1e-3": {"width": 64, "lr": LR},
    "256 units, lr 3e-4 (its defaults)": {"width": 256, "lr": 3e-4},
    "64 units, settings like ours": {"width": 64, "lr": LR, **LIKE_OURS},
    "64 units, settings like ours, update every 8": {
        "width": 64,
        "lr": LR,
        "train_freq": 8,
        "learning_starts": 5_000,
        **LIKE_OURS,
    },
    "64 units, lr 3e-4": {"width": 64, "lr": 3e-4},
    "256 units, lr 1e-3": {"width": 256, "lr": LR},
}
NAMES = {"omnisafe": "OmniSafe", "sb3": "Stable-Baselines3"}
DISTRIBUTIONS = {"omnisafe": "omnisafe", "sb3": "stable-baselines3"}

Block = dict[str, Any]


class Subject(Protocol):
    """What is measured. A block says the CPU seconds of its work, as `per` reads them."""

    versions: Mapping[str, str]

    def block(self) -> Block: ...

    def close(self) -> None: ...


def missing(package: str, reason: str) -> UserError:
    """That a peer's environment is not there, and how to make it."""
    return UserError(
        f"--{package}-python: {reason}; make an environment with {NAMES[package]} by the commands "
        f"at the head of benchmarks/peers_{package}.txt, and give its bin/python"
    )


def checked(package: str, python: Path | None) -> None:
    """Raises UserError where there is no such Python, or not this package."""
    if python is None:
        raise missing(package, "is not given")
    asked = f"from importlib import metadata; metadata.version({DISTRIBUTIONS[package]!r})"
    try:
        subprocess.run([python, "-c", asked], check=True, capture_output=True)
    except OSError as error:
        raise missing(package, f"{python}: {error.strerror}") from None
    except subprocess.CalledProcessError:
        raise missing(package, f"{python} has no {NAMES[package]}") from None


class Peer:
    """Another package at work in its own environment, by `benchmarks.peers_worker`.

    settings: what is done there and with what. Raises UserError where it fails.
    """

    def __init__(self, package: str, python: Path | None, **settings: Any) -> None:
        assert python is not None, "`checked` comes before"
        self._package = package
        # In a folder of its own, as OmniSafe writes logs where it runs.
        self._folder = tempfile.TemporaryDirectory()
        self._told = Path(self._folder.name, "stderr")
        with self._told.open("w") as stderr:
            self._process = subprocess.Popen(
                [python.absolute(), "-m", "benchmarks.peers_worker", json.dumps(settings)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
                cwd=self._folder.name,
                env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._ask, self._answers = self._process.stdin, self._process.stdout
        self.versions: Mapping[str, str] = self._answer()["versions"]

    def _answer(self) -> Block:
        line = self._answers.readline()
        if not line:
            said = self._told.read_text(errors="replace").split("\n")
            last = next((text for text in reversed(said) if text.strip()), "without a word")
            self.close()
            raise UserError(f"{NAMES[self._package]} ended: {last.strip()}")
        answer: Block = json.loads(line)
        return answer

    def block(self) -> Block:
        with contextlib.suppress(BrokenPipeError):  # then there is no answer, which says why
            self._ask.write("\n")
            self._ask.flush()
        return self._answer()

    def close(self) -> None:
        with contextlib.suppress(BrokenPipeError):
            self._ask.close()
        self._process.wait()
        self._answers.close()
        self._folder.cleanup()


class Here:
    """A subject of this package, in this process."""

    def __init__(self) -> None:
        self.versions: Mapping[str, str] = {
            "python": platform.python_version(),
            **package_versions(),
        }

    def close(self) -> None:
        pass


class Epochs(Here):
    """PPO-Lagrangian; a block is an epoch."""

    def __init__(self, backend: str, **settings: Any) -> None:
        super().__init__()
        config = ppo_lagrangian.Config(
            backend=backend, cost_limit=COST_LIMIT, **{**OMNISAFE, **settings}
        )
        envs = functools.partial(make_envs, EPOCH_TASKS["here"])
        self._trainer = ppo_lagrangian.Trainer(config, envs, 100, 10**9)
        self._watch = watch(self._trainer)
        simulation = self._trainer.envs.unwrapped._simulation  # type: ignore[attr-defined]
        self._watch.time("resets", simulation, "reset")

    def block(self) -> Block:
        before = self._trainer.step
        self._watch.reset()
        metrics = self._trainer.advance(before + 1)
        self._watch.lap()
        spent = self._watch.spent
        names = {
            "environment": "environment steps",
            "resets": "resets",
            **dict.fromkeys(("inference, storing", "episode statistics"), "acting"),
            **dict.fromkeys(("values, advantages", "policy update", "critic step"), "learning"),
        }
        parts: dict[str, float] = {}
        for part, seconds in spent.items():
            name = names.get(part, REST)
            parts[name] = parts.get(name, 0.0) + seconds
        steps = self._trainer.step - before
        return {"count": steps, "parts": parts, "passes": metrics["policy_passes"]}


class Updates(Here):
    """Gradient steps of SAC-Lagrangian in the middle of a run; a block is UPDATES of them."""

    def __init__(self, backend: str, width: int, together: int, **delays: int) -> None:
        super().__init__()
        settings = {"hidden": width, "updates_together": together, **delays}
        self._run, self._together = Run("sac_lagrangian", TASK, HELD, backend, settings), together

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of observations and of actions."""
        return self._run.trainer.transform.dim, self._run.trainer.action_dim

    def block(self) -> Block:
        trainer, stopwatch = self._run.trainer, self._run.stopwatch
        stopwatch.reset()
        for _ in range(UPDATES // self._together):
            size = self._together * trainer.config.batch_size
            drawn = trainer.normaliser.batch(trainer.replay.sample(size, trainer._sampling))
            trainer.agent.update(drawn, self._together)
        stopwatch.lap()
        parts = dict(stopwatch.spent)
        gathering = parts.pop("gathering")
        return {
            "count": UPDATES,
            "parts": {"gathering": gathering, "update": sum(parts.values())},
        }


class Learning(Here):
    """A training run; a block is ``every`` steps and an evaluation, whose time is left out."""

    def __init__(self, algorithm: str, seed: int, every: int, **settings: Any) -> None:
        super().__init__()
        found = load_algorithm(algorithm)
        config, envs = found.hyperparameters(**settings), functools.partial(make_envs, TASK)
        started = found.trainer(config, envs, seed, SCHEDULED)
        started.advance(config.start_steps + 1_000)  # what is loaded and compiled once
        self._trainer, self._every = found.trainer(config, envs, seed, SCHEDULED), every
        self._layouts = make_envs(TASK, EPISODES)

    def block(self) -> Block:
        before, begun = self._trainer.step, time.process_time()
        self._trainer.advance(before + self._every)
        spent = time.process_time() - begun
        found = evaluate(self._trainer.policy, self._layouts, TUNING_EVALUATION_SEED)
        steps = self._trainer.step - before
        return {"steps": steps, "cpu_s": spent, "return": found["return"]}


@dataclass(frozen=True)
class Case:
    """What is measured; how it is opened (a run that learns: with a seed).

    peer: the package that it needs; against: the case that it is compared to.
    """

    name: str
    start: Callable[..., Subject]
    peer: str = ""
    against: str = ""


def epoch_cases(python: Path | None, steps: int) -> list[Case]:
    """Both packages with the same minibatches, all passes made; OmniSafe as it comes."""
    epoch = {"epoch_steps": steps, "passes": OMNISAFE["policy_passes"]}
    work = {"work": "omnisafe_epochs", "task": EPOCH_TASKS["omnisafe"], **epoch}
    peer = functools.partial(Peer, "omnisafe", python, **work)
    own = functools.partial(peer, batch=BATCHES[0], early_stop=True)
    cases = [Case("OmniSafe, as it comes", own, "omnisafe")]
    for batch in BATCHES:
        name = f"batch {batch:,}, all passes"
        against = f"OmniSafe, {name}"
        start = functools.partial(peer, batch=batch, early_stop=False)
        cases.append(Case(against, start, "omnisafe"))
        # No KL comes near a hundred: nothing stops early.
        settings: dict[str, Any] = {"epoch_steps": steps, "target_kl": 1.0, "kl_stop": 100.0}
        settings |= {"policy_batch": batch, "value_batch": batch}
        for backend in BACKENDS:
            here = functools.partial(Epochs, backend, **settings)
            cases.append(Case(f"here, {backend}, {name}", here, against=against))
    return cases


def update_cases(python: Path | None) -> list[Case]:
    """One update of each, by width, backend and delays."""
    cases = []
    for width in WIDTHS:
        against = f"Stable-Baselines3, {width} units"

        def peer(width: int = width) -> Subject:
            observations, actions = Updates("torch", 8, 1).shape
            sizes = {"observations": observations, "actions": actions}
            sizes |= {"width": width, "held": HELD, "count": UPDATES}
            return Peer("sb3", python, work="sb3_updates", lr=LR, **sizes)

        cases.append(Case(against, peer, "sb3"))
        each = {"policy_delay": 1, "multiplier_delay": 1}
        for backend in BACKENDS:
            for label, together, delays in (("every step", 1, each), ("default", 4, {})):
                start = functools.partial(Updates, backend, width, together, **delays)
                cases.append(
                    Case(f"here, {backend}, {width} units, {label}", start, against=against)
                )
    return cases


def learning_cases(python: Path | None, every: int) -> list[Case]:
    """Runs to a return; the recipes come first."""
    here, peers = [], []
    for updates in EVERY:
        for label, algorithm, zeta in (
            ("SafeMR", "safemr", {}),
            ("FAC-phi0", "fac", UNCONSTRAINED),
        ):
            settings: dict[str, Any] = {"every": every, "update_every": updates, **zeta}
            start = functools.partial(Learning, algorithm, **settings)
            here.append(Case(f"{label}, update every {updates}", start))
    about = {"task": TASK, "every": every, "episodes": EPISODES, "layouts": TUNING_EVALUATION_SEED}
    for label, settings in SB3_LEARNING.items():
        start = functools.partial(Peer, "sb3", python, work="sb3_learning", **about, **settings)
        peers.append(Case(f"Stable-Baselines3, {label}", start, "sb3"))
    return here[:2] + peers[:3] + here[2:] + peers[3:]
