"""The parallel trainer: its books, its gradients, and training by a crew of this process.

What needs Ray is in `test_pabal_ray.py`.
"""

from __future__ import annotations

import ast
import dataclasses
import sys
from collections import Counter
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from toy import ToyEnvs

from safemr.errors import UserError
from safemr.experiment import checkpoints, resources
from safemr.experiment.catalogue import hyperparameters, load_algorithm
from safemr.learning import losses
from safemr.learning.acting import Acting
from safemr.learning.contract import TrainingDivergedError, process_seed
from safemr.learning.evaluation import evaluate
from safemr.parallel import gradients, workers
from safemr.parallel.crew import LostError, RayCrew
from safemr.parallel.ledger import Earnings, Flights, Numbers
from safemr.parallel.workers import BUFFER, LEARNER, SAMPLER

ROOT = Path(__file__).resolve().parents[1]
MODULES = ("safemr.parallel.safemr", "safemr.parallel.joint_sis", "safemr.parallel.fac")
SMALL = {
    **{"num_envs": 8, "hidden": 16, "batch_size": 32, "start_steps": 200, "chunk": 3},
    **{"target_entropy": -1.0, "replay_capacity": 4000, "max_gradient_age": 2},
}


# The books


def test_experience_earns_what_it_earns_in_one_process() -> None:
    """One gradient step for `update_every` decisions after the start, however it is cut up."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        chunks = rng.integers(1, (60, 4), (20, 2), endpoint=True)
        whole, late = Earnings(0, 8, 4.0), Earnings(100, 8, 4.0)
        for decisions, held in chunks:
            whole.store(int(decisions * held), int(decisions))
            late.store(int(decisions * held), int(decisions))
        decisions, steps = int(chunks[:, 0].sum()), int(chunks.prod(1).sum())
        assert whole.steps == late.steps == steps
        assert whole.earned == decisions // 8
        assert decisions - 100 - 60 < 8 * (late.earned + 1)
        assert late.earned <= (decisions - 100 / 4) / 8 or steps <= 100


def test_a_chunk_across_the_start_counts_from_there() -> None:
    books = Earnings(100, 8, 4.0)
    books.store(180, 90)  # actions held for two steps; the last 80 steps are 40 decisions
    assert books.earned == 5


@pytest.mark.parametrize("lead", [1, 2, 5])
def test_experience_is_ahead_by_less_than_the_lead_and_a_chunk(lead: int) -> None:
    rng = np.random.default_rng(lead)
    books, under_way, done, most = Earnings(0, 8, float(lead)), list[int](), 0, 0.0
    for act in rng.choice(["ask", "store", "learn"], 3_000):
        if act == "ask" and books.may_sample(sum(under_way), done):
            under_way.append(16)
        elif act == "store" and under_way:
            books.store(under_way[0], under_way.pop(0))
        elif act == "learn" and done < books.earned:
            done += 1
        assert done <= books.earned
        most = max(most, (books.learned_from + sum(under_way)) / 8 - done)
    assert lead <= most < lead + 16 / 8
    assert done > 100


@pytest.mark.parametrize("limit", [0, 1, 2, 6])
@pytest.mark.parametrize("learners", [1, 2, 5])
def test_no_gradient_gets_too_old_and_none_waits_for_ever(limit: int, learners: int) -> None:
    rng = np.random.default_rng([limit, learners])
    flights, numbers, out = Flights(limit), Numbers(), list[int]()
    landed, ages = list[int](), set[int]()
    for choice in rng.choice(["depart", "land", "lose"], 3_000, p=[0.5, 0.45, 0.05]):
        ready = [n for n in out if flights.may_land(n)]
        assert not out or out[0] in ready  # the oldest
        assert out or flights.may_depart
        if choice == "depart" and flights.may_depart and len(out) < learners:
            out.append(numbers.take())
            flights.depart(out[-1])
        elif choice == "land" and ready:
            number = int(rng.choice(ready))
            out.remove(number)
            ages.add(flights.land(number))
            landed.append(number)
        elif choice == "lose" and out:
            number = out.pop(int(rng.integers(len(out))))
            flights.lose(number)
            numbers.give_back(number)
    assert flights.version == len(landed) == len(set(landed))
    assert min(ages) == 0
    assert max(ages) <= limit
    assert (max(ages) > 0) == (min(limit, learners - 1) > 0)


def test_without_the_bound_a_gradient_gets_older_than_it() -> None:
    """The bound does something: of three under way the last but one has to wait for the first."""
    flights = Flights(2)
    for number in (1, 2, 3):
        flights.depart(number)
    assert not flights.may_depart
    assert [flights.may_land(n) for n in (1, 2, 3)] == [True, True, True]
    assert flights.land(3) == 0
    assert flights.may_depart
    flights.depart(4)
    assert [flights.may_land(n) for n in (1, 2, 4)] == [True, True, False]


def test_a_lost_number_is_given_out_again_first() -> None:
    numbers = Numbers()
    assert [numbers.take() for _ in range(3)] == [1, 2, 3]
    numbers.give_back(2)
    assert numbers.due(0)
    assert [numbers.take(), numbers.take()] == [2, 4]
    assert not numbers.due(4)


# Gradients


def agent_of(module: str, **overrides: Any) -> Any:
    algorithm = load_algorithm(module)
    config = algorithm.hyperparameters(**{**SMALL, **overrides})
    return algorithm.trainer.agent_type(config, 3, 2, 0.25, 0, 1000)


def batch(count: int = 32) -> Any:
    rng = np.random.default_rng(1)

    def of(*shape: int, low: float = -1.0, high: float = 1.0) -> torch.Tensor:
        return torch.from_numpy(rng.uniform(low, high, (count, *shape)).astype(np.float32))

    near = (of(2, low=0.2, high=1.5), of(2, low=-1.5), of(2, low=0.2, high=1.5), of(2, low=-1.5))
    discounts = torch.full((count,), 0.95)
    return workers.Batch(of(3), of(2), of(), discounts, of(3), of(), *near)


@pytest.mark.parametrize("module", MODULES)
def test_gradients_are_those_of_the_losses_and_leave_the_weights(module: str) -> None:
    """The 64th step has one of each kind; the torch backend is the definition."""
    found = {}
    for backend in ("torch", "fused"):
        agent = agent_of(module, backend=backend)
        before = gradients.weights(agent)
        found[backend], info = gradients.Learning(agent).gradients(batch(), 64, measure=True)
        after = gradients.weights(agent)
        assert all(np.array_equal(before[name], after[name]) for name in before)
        assert {"critic_loss", "policy_loss", "violating_share"} <= info.keys()
    kinds = {"critics", "policy", "temperature", "multiplier"}
    assert found["torch"].keys() == kinds | ({"zeta"} if "fac" not in module else set())
    for name, gradient in found["torch"].items():
        scale = np.abs(gradient).max()
        assert scale > 0
        np.testing.assert_allclose(found["fused"][name], gradient, atol=1e-4 * scale)
    agent = agent_of(module, backend="torch")
    drawn = batch()
    values = agent.critics(torch.cat((drawn.observations, drawn.actions), 1))[..., 0]
    loss = losses.critic_loss(values, agent.critic_targets(drawn))
    (expected,) = torch.autograd.grad(loss, [agent.critics.parameters])
    np.testing.assert_allclose(found["torch"]["critics"], expected.numpy(), rtol=1e-6, atol=1e-9)


def test_a_step_on_sent_gradients_is_that_of_one_process() -> None:
    """Where no policy is due, both halves together do what `update` does."""
    alone, driver, learner = (agent_of("safemr.parallel.safemr") for _ in range(3))
    learning = gradients.Learning(learner)
    alone.update(batch(), 1)
    gradients.take_over(learner, gradients.weights(driver))
    gradients.step(driver, learning.gradients(batch(), 1, measure=False)[0])
    one, other = gradients.weights(alone), gradients.weights(driver)
    assert alone.updates == driver.updates == 1
    for name in one:
        np.testing.assert_allclose(other[name], one[name], rtol=1e-5, atol=1e-7)
    assert not np.array_equal(one["critics"], gradients.weights(learner)["critics"])


def test_kinds_take_turns_as_in_one_process() -> None:
    learning = gradients.Learning(agent_of("safemr.parallel.safemr", certificate_start=0.0))
    kinds = [tuple(learning.gradients(batch(), n, measure=False)[0]) for n in range(1, 17)]
    count = Counter(kind for each in kinds for kind in each)
    expected = {"critics": 16, "policy": 8, "temperature": 8, "multiplier": 4, "zeta": 1}
    assert count == expected


# A crew of this process


class Promise:
    def __init__(self, make: Any) -> None:
        self.make, self.done, self.value, self.error = make, False, None, None


class Crew:
    """Does what is asked when it is waited for, in an order of chance; each worker in its order."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.workers: list[Any] = []
        self.asked: dict[int, list[Promise]] = {}
        self.dead: set[int] = set()
        self.doomed: dict[int, int] = {}  # a worker's number -> tasks after which it dies
        self.done: Counter[str] = Counter()

    def __call__(self, workers: int) -> Crew:
        return self

    def hire(self, worker: Any, *args: Any) -> int:
        self.workers.append(worker(*args))
        return len(self.workers) - 1

    def ask(self, worker: int, method: str, *args: Any) -> Promise:
        def make() -> Any:
            given = [self.get(a) if isinstance(a, Promise) else a for a in args]
            if worker in self.doomed:
                self.doomed[worker] -= 1
                if self.doomed[worker] < 0:
                    self.dead.add(worker)
            if worker in self.dead:
                raise LostError("killed")
            self.done[method] += 1
            return getattr(self.workers[worker], method)(*given)

        promise = Promise(make)
        self.asked.setdefault(worker, []).append(promise)
        promise.make = lambda: (self._before(worker, promise), make())[1]
        return promise

    def _before(self, worker: int, promise: Promise) -> None:
        for earlier in list(self.asked[worker]):
            if earlier is promise:
                break
            self._fulfil(earlier)
        self.asked[worker] = [p for p in self.asked[worker] if not p.done and p is not promise]

    def _fulfil(self, promise: Promise) -> None:
        if promise.done:
            return
        promise.done = True
        try:
            promise.value = promise.make()
        except LostError as error:
            promise.error = error

    def put(self, value: Any) -> Promise:
        promise = Promise(None)
        promise.done, promise.value = True, value
        return promise

    def first(self, promises: Any) -> Promise:
        return promises[self.random.integers(len(promises))]

    def get(self, promise: Promise) -> Any:
        self._fulfil(promise)
        if promise.error is not None:
            raise promise.error
        return promise.value

    def lives(self, worker: int) -> bool:
        return worker not in self.dead

    def dismiss(self, worker: int) -> None:
        self.dead.add(worker)

    def notes(self) -> dict[str, Any]:
        return {}

    def close(self) -> None:
        pass


TOTAL = 1000


def trainer_of(module: str = MODULES[0], crew: Crew | None = None, **overrides: Any) -> Any:
    algorithm = load_algorithm(module)
    counts = {"samplers": 2, "buffers": 2, "learners": 3}
    config = algorithm.hyperparameters(**{**SMALL, **counts, **overrides})
    return algorithm.trainer(config, ToyEnvs, 0, TOTAL, crew or Crew(0))


@pytest.mark.parametrize("module", MODULES)
@pytest.mark.parametrize("counts", [(1, 1, 1), (4, 2, 3)])
def test_the_ratio_is_kept_and_ages_are_bounded(module: str, counts: tuple[int, ...]) -> None:
    names = ("samplers", "buffers", "learners")
    trainer = trainer_of(module, **dict(zip(names, counts, strict=True)))
    for until in (160, 400, 720, TOTAL):
        metrics = trainer.advance(until)
        assert trainer.step == until  # which all of its environments together divide
        assert metrics["updates"] == max(until - SMALL["start_steps"], 0) // 8
        assert metrics["lost_tasks"] == 0
        assert metrics.get("gradient_age_max", 0) <= SMALL["max_gradient_age"]
        assert all(np.isfinite(v) for n, v in metrics.items() if not n.startswith("train_"))
    assert metrics["gradient_age_max"] == (0 if counts[2] == 1 else SMALL["max_gradient_age"])
    assert metrics["train_episodes"] > 0
    assert trainer.policy.act(np.zeros((5, 1))).shape == (5, 1)
    assert trainer.notes["deterministic"] is False


def test_held_actions_count_as_the_steps_they_last() -> None:
    from safemr.learning.interface import Interface

    algorithm = load_algorithm(MODULES[0])
    config = algorithm.hyperparameters(**SMALL, samplers=2, buffers=1, learners=2)
    held = Interface(3)
    trainer = algorithm.trainer(config, lambda n: held.around(ToyEnvs(n)), 0, TOTAL, Crew(0))
    metrics = trainer.advance(TOTAL)
    assert TOTAL <= trainer.step < TOTAL + 8 * 3 * SMALL["chunk"]
    decisions = (trainer.step - SMALL["start_steps"]) / 3  # but for episodes' short last ones
    assert metrics["updates"] == pytest.approx(decisions / 8, abs=3)
    assert trainer.policy.action_repeat == 3


def gone(trainer: Any, crew: Crew, kind: int, after: int) -> None:
    """One worker of a kind dies after some more tasks."""
    crew.doomed[trainer._workers[kind][0]] = after


@pytest.mark.parametrize("kind", [SAMPLER, LEARNER])
def test_a_dead_sampler_or_learner_is_replaced(kind: int) -> None:
    crew = Crew(0)
    trainer = trainer_of(crew=crew)
    trainer.advance(400)
    hired = len(crew.workers)
    gone(trainer, crew, kind, 2)
    metrics = trainer.advance(TOTAL)
    assert metrics["lost_tasks"] >= 1
    assert len(crew.workers) == hired + 1
    assert trainer._lives[kind] == [1, *[0] * (len(trainer._lives[kind]) - 1)]
    assert trainer.step == TOTAL
    assert metrics["updates"] == trainer.agent.updates == (TOTAL - SMALL["start_steps"]) // 8
    assert metrics["gradient_age_max"] <= SMALL["max_gradient_age"]


def test_what_a_dead_sampler_did_last_is_cut() -> None:
    crew = Crew(0)
    trainer = trainer_of(crew=crew)
    trainer.advance(400)
    ring = crew.workers[trainer._buffer(0)]._rings[0]
    newest = slice((ring._head - 1) * ring.num_envs, ring._head * ring.num_envs)
    assert not ring._fields["ended"][newest].all()
    gone(trainer, crew, SAMPLER, 0)
    trainer.advance(700)
    assert ring._fields["ended"][newest].all()


def test_without_a_buffer_the_run_ends_with_one_line() -> None:
    crew = Crew(0)
    trainer = trainer_of(crew=crew)
    trainer.advance(400)
    gone(trainer, crew, BUFFER, 1)
    with pytest.raises(UserError, match="buffer 0 of 2 is gone at step") as caught:
        trainer.advance(TOTAL)
    assert "\n" not in str(caught.value)
    assert "continues from the last checkpoint" in str(caught.value)
    trainer = trainer_of(crew=(crew := Crew(0)))
    trainer.advance(16)
    crew.dead.add(trainer._workers[BUFFER][0])
    with pytest.raises(UserError, match="buffer is gone"):
        trainer.state_dict()


def test_workers_that_always_die_end_the_run() -> None:
    class Doomed(Crew):
        def hire(self, worker: Any, *args: Any) -> int:
            number = super().hire(worker, *args)
            if worker is workers.Learner:
                self.dead.add(number)
            return number

    with pytest.raises(UserError, match=r"lost one after the other.*killed"):
        trainer_of(crew=Doomed(0)).advance(TOTAL)


def test_a_crew_that_cannot_be_hired_is_let_go_and_the_reason_told() -> None:
    class Unhired(Crew):
        closed = False

        def hire(self, worker: Any, *args: Any) -> int:
            raise TypeError("cannot pickle it")

        def close(self) -> None:
            self.closed = True

    crew = Unhired(0)
    with pytest.raises(TypeError, match="cannot pickle it"), closing(trainer_of(crew=crew)) as one:
        one.advance(TOTAL)
    assert crew.closed


def test_a_checkpoint_is_drained_and_continues(tmp_path: Path) -> None:
    first = trainer_of(crew=Crew(0))
    first.advance(600)
    checkpoints.save(tmp_path / "checkpoint.pt", {"state": first.state_dict()})
    state = checkpoints.load(tmp_path / "checkpoint.pt")["state"]
    crew = Crew(1)
    again = trainer_of(crew=crew)
    again.load_state_dict(state)
    assert again.step == first.step == 600
    assert again.agent.updates == first.agent.updates == (600 - SMALL["start_steps"]) // 8
    one, other = first.policy.arrays(), again.policy.arrays()
    assert all(np.array_equal(one[name], other[name]) for name in one)
    second = again.state_dict()  # as it was, through the processes of a second crew
    for name in ("samplers", "rings"):
        texts = [repr(checkpoints.encode(each[name])) for each in (state, second)]
        assert texts[0] == texts[1]
    metrics = again.advance(TOTAL)
    assert metrics["updates"] == (TOTAL - SMALL["start_steps"]) // 8
    assert again._lives == [[1, 1], [1, 1], [1, 1, 1]]
    assert crew.done["cut"] == 0


def test_a_sampler_that_died_at_the_checkpoint_begins_anew() -> None:
    crew = Crew(0)
    first = trainer_of(crew=crew)
    first.advance(600)
    crew.dead.add(first._workers[SAMPLER][1])
    state = first.state_dict()
    assert [each is None for each in state["samplers"]] == [False, True]
    again = trainer_of(crew=(second := Crew(1)))
    again.load_state_dict(state)
    again.advance(TOTAL)
    assert again.step == TOTAL
    assert second.done["cut"] == 1


def test_every_process_draws_from_a_stream_of_its_own() -> None:
    places = [(kind, i, life) for kind in range(4) for i in range(3) for life in range(3)]
    seeds = {process_seed(seed, *place) for place in places for seed in (0, 1)}
    assert len(seeds) == 2 * len(places)


def test_samplers_share_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is its share of the environments, of the random start and of the schedules."""
    made = []

    class Seen(Acting):
        def __init__(self, config: Any, make_envs: Any, seed: int, total_steps: int) -> None:
            made.append((config.num_envs, config.start_steps, total_steps))
            super().__init__(config, make_envs, seed, total_steps)

    monkeypatch.setattr(workers, "Acting", Seen)
    crew = Crew(0)
    trainer_of(crew=crew, samplers=4).advance(16)
    assert made == [(2, 50, 250)] * 4


def test_it_diverges_in_one_line() -> None:
    trainer = trainer_of(critic_lr=1.0, constraint_scale=1000.0)
    trainer._staff()
    with torch.no_grad():
        trainer.agent.critics.parameters.fill_(1e30)
    with pytest.raises(TrainingDivergedError, match="critics_gradient"):
        trainer.advance(TOTAL)


@pytest.mark.slow
def test_it_learns() -> None:
    """The toy's optimum, as the loop of one process does (`test_off_policy.py`)."""
    algorithm = load_algorithm("safemr.parallel.safemr")
    counts = {"samplers": 2, "buffers": 2, "learners": 3}
    config = algorithm.hyperparameters(**{**SMALL, **counts, "hidden": 32, "update_every": 2})
    trainer = algorithm.trainer(config, ToyEnvs, 0, 12_000, Crew(0))
    before = evaluate(trainer.policy, ToyEnvs(10), 0)
    trainer.advance(12_000)
    after = evaluate(trainer.policy, ToyEnvs(10), 0)
    assert after["return"] > before["return"] + 10


# Configuration


@pytest.mark.parametrize(
    ("settings", "culprit"),
    [
        ({"samplers": 3}, "samplers = 3: must divide num_envs = 16"),
        ({"samplers": 2, "buffers": 4}, "buffers = 4: must not exceed samplers = 2"),
        ({"max_gradient_age": -1}, r"max_gradient_age = -1: must lie in \[0, 1000\]"),
        ({"updates_together": 2}, "does not use updates_together"),
    ],
)
def test_what_cannot_work_is_refused(settings: dict[str, Any], culprit: str) -> None:
    with pytest.raises(UserError, match=culprit):
        hyperparameters(load_algorithm(MODULES[0]), settings, "--set")


@pytest.mark.parametrize("module", MODULES)
def test_they_are_their_algorithms_with_five_hyperparameters_more(module: str) -> None:
    """So a learner's record keeps its digest, and defaults mean the same in both."""
    parallel, alone = load_algorithm(module), load_algorithm(module.rpartition(".")[2])
    more = {"samplers", "buffers", "learners", "chunk", "max_gradient_age"}
    ours, theirs = (dataclasses.asdict(a.hyperparameters()) for a in (parallel, alone))
    assert ours == theirs | {name: ours[name] for name in more}
    for said in ("role", "learns", "certificate", "family"):
        assert getattr(parallel, said) == getattr(alone, said)


def test_a_run_asks_for_cores_and_memory_by_its_processes() -> None:
    def asked(name: str, **values: Any) -> tuple[int, int]:
        resolved = hyperparameters(load_algorithm(name), values, "--set")
        config = {"algorithm": {"hyperparameters": resolved}}
        return resources.cores(config), resources.memory_mb(config)

    assert asked("safemr") == asked("ppo_lagrangian") == (1, 1500)
    small, large = (asked(MODULES[0], samplers=n, buffers=n, learners=n) for n in (2, 4))
    assert (small[0], large[0]) == (7, 13)
    assert large[1] - small[1] == 2 * sum(resources.EACH.values())


def test_only_the_crew_imports_ray_and_only_when_it_is_asked() -> None:
    importing = {}
    for package in ("safemr", "envs", "workflow", "examples", "benchmarks"):
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text())
            found = [node for node in ast.walk(tree) if "ray" in _imported(node)]
            if found:
                inside = [n for f in ast.walk(tree) if isinstance(f, ast.FunctionDef)
                          for n in ast.walk(f)]  # fmt: skip
                importing[str(path.relative_to(ROOT))] = all(node in inside for node in found)
    assert importing == {"safemr/parallel/crew.py": True}


def _imported(node: ast.AST) -> set[str]:
    names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
    names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
    return {name.partition(".")[0] for name in names}


def test_without_ray_one_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"needs Ray: pip install \"\.\[ray\]\""):
        RayCrew(1)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1"])
def test_no_cluster_at_the_address_is_one_line(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Said at once; Ray would wait for it for minutes."""
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(is_initialized=lambda: False))
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(UserError, match=f"RAY_ADDRESS = {address}: no cluster") as caught:
        RayCrew(1)
    assert "\n" not in str(caught.value)
