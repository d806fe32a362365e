"""What a trainer's arithmetic reads is the same after resuming, its order in memory included.

BLAS chooses its kernel by the order of its operands, and kernels round differently: a state whose
numbers are equal but whose arrays are laid out otherwise continues with other numbers. Whether it
does depends on the processor; whether the layouts are equal does not.
"""

from __future__ import annotations

import functools
import inspect
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from kills import short_run

from safemr.experiment import checkpoints, planning
from safemr.experiment.train import make_envs
from safemr.learning import numba_kernels, numba_steps
from safemr.learning.networks import StackedMLP
from safemr.learning.observation import ObservationTransform

OURS = ("safemr.", "envs.", "torch.optim.")
# Attributes that hold nothing from one log point to the next (an epoch's samples), or must differ
# between processes (where MuJoCo's data lie).
NO_STATE = (".rollout", "._addresses")


def arrays(value: Any, path: str = "", seen: set[int] | None = None) -> Iterator[tuple[str, Any]]:
    """Every array and tensor that can be reached from ``value``, with the way to it."""
    seen = set() if seen is None else seen
    if path.endswith(NO_STATE):
        return
    if isinstance(value, (np.ndarray, torch.Tensor)):
        yield path, value
        return
    if id(value) in seen:
        return
    seen.add(id(value))
    items: Mapping[Any, Any] = {}
    if isinstance(value, Mapping):
        # An optimiser's state has tensors as keys: their order counts.
        items = {
            f"[{index if isinstance(key, torch.Tensor) else key!r}]": item
            for index, (key, item) in enumerate(value.items())
        }
    elif isinstance(value, (list, tuple)):
        items = {f"[{index}]": item for index, item in enumerate(value)}
    elif isinstance(value, torch.Generator):
        items = {".get_state()": value.get_state()}
    elif type(value).__module__.startswith(OURS):
        items = {
            f".{name}": item
            for name, item in vars(value).items()
            # made anew from the others when asked for
            if not isinstance(
                inspect.getattr_static(type(value), name, None), functools.cached_property
            )
        }
    for name, item in items.items():
        yield from arrays(item, path + name, seen)


def viewed(array: Any) -> np.ndarray:
    return array.detach().numpy() if isinstance(array, torch.Tensor) else array


def layout(array: Any) -> tuple[Any, ...]:
    """Type, dtype, shape, strides in bytes and order of an array or tensor."""
    view = viewed(array)
    flags = view.flags
    return (
        *(type(array), view.dtype, view.shape, view.strides),
        *(flags.c_contiguous, flags.f_contiguous, flags.aligned, flags.writeable),
    )


def trainer_of(run: planning.Run) -> Any:
    config = run.config
    algorithm = planning.load_algorithm(config["algorithm"]["name"])
    return algorithm.trainer(
        algorithm.hyperparameters(**config["algorithm"]["hyperparameters"]),
        functools.partial(make_envs, config["task"]),
        config["seed"],
        config["steps"],
    )


NAVIGATION = [(name, "Pillars-0.15-Goal", {}) for name in planning.algorithm_names()]
OTHERS = [
    ("safemr", "Hazards-0.15-Push", {"backend": "torch"}),
    ("safemr", "Aircraft", {}),
    ("ppo_lagrangian", "Aircraft", {}),
    ("ppo_lagrangian", "Pillars-0.15-Goal", {"backend": "fused"}),
]


@pytest.mark.parametrize(("name", "task", "overrides"), [*NAVIGATION, *OTHERS])
def test_arrays_are_laid_out_as_before(
    name: str, task: str, overrides: dict[str, Any], tmp_path: Path
) -> None:
    """Field by field, before `state_dict` and after `load_state_dict` from a checkpoint's file."""
    run = short_run(name, task, overrides)
    trainer, resumed = trainer_of(run), trainer_of(run)
    trainer.advance(2 * run.config["log_every"])
    checkpoints.save(tmp_path / "checkpoint.pt", {"state": trainer.state_dict()})
    resumed.load_state_dict(checkpoints.load(tmp_path / "checkpoint.pt")["state"])
    before, after = dict(arrays(trainer)), dict(arrays(resumed))
    assert len(before) > 15
    assert {k: layout(v) for k, v in after.items()} == {k: layout(v) for k, v in before.items()}
    for key, array in before.items():
        assert viewed(array).tobytes() == viewed(after[key]).tobytes(), key


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("task", ["Pillars-0.15-Goal", "Aircraft"])
def test_the_transform_decides_the_order(task: str, dtype: Any, order: Any) -> None:
    """Whatever the environment's own order, what the networks see has its columns one by one."""
    layout = make_envs(planning.describe_task(task, {}), 1).observation_layout
    transform = ObservationTransform.for_layout(layout)
    width = max(part.stop for part in layout.values())
    raw = np.random.default_rng(0).normal(size=(16, width)).astype(dtype)
    seen = transform(np.array(raw, order=order))
    assert seen.strides == (4, 4 * len(raw))
    assert np.array_equal(seen, transform(raw))


def placed(array: np.ndarray, offset: int) -> np.ndarray:
    """A copy in the same order whose memory begins ``offset`` bytes after a multiple of 64."""
    memory = np.empty(array.nbytes + 128, np.uint8)
    begin = -memory.ctypes.data % 64 + offset
    flat = memory[begin : begin + array.nbytes].view(array.dtype)
    order = "C" if array.flags.c_contiguous else "F"
    copy = flat.reshape(array.shape, order=order)
    copy[...] = array
    assert copy.ctypes.data % 64 == offset
    assert copy.strides == array.strides or 1 in array.shape
    return copy


# malloc aligns to 16 bytes; 4 and 20 are there so that nothing rests on that.
OFFSETS = (0, 16, 32, 48, 4, 20)


@pytest.mark.parametrize("hidden", [64, 256])
@pytest.mark.parametrize("order", ["C", "F"])
def test_results_do_not_depend_on_where_arrays_begin(order: Any, hidden: int) -> None:
    """Alignment is not kept in a checkpoint, and need not be: acting, learning and evaluating give
    the same bits wherever an array begins. If this fails on some processor, runs with one seed
    differ there even when nothing interrupts them."""
    random = np.random.default_rng(0)
    for batch, width in itertools.product((1, 8, 10, 16, 20, 256, 500), (4, 39, 41, 57)):
        weights = torch.Generator().manual_seed(0)
        policy = StackedMLP(1, (width, hidden, hidden, 4), "relu", generator=weights)
        critics = StackedMLP(3, (width + 2, hidden, hidden, 1), "relu", generator=weights)
        observations = np.array(random.normal(size=(batch, width)), np.float32, order=order)
        noise = random.normal(size=(batch, 2)).astype(np.float32)
        targets = random.normal(size=(3, batch)).astype(np.float32)
        found = []
        for offset in OFFSETS:
            parameters = [placed(n.parameters.detach().numpy(), offset) for n in (policy, critics)]
            networks = [
                numba_steps.network(n)._replace(parameters=p)
                for n, p in zip((policy, critics), parameters, strict=True)
            ]
            inputs, perturbation = placed(observations, offset), placed(noise, offset)
            with torch.no_grad():
                evaluated = policy(torch.from_numpy(inputs)).numpy()
            actions, densities = numba_kernels.sample(networks[0], inputs, perturbation)
            moments = [placed(np.zeros_like(parameters[1]), offset) for _ in range(2)]
            adam = numba_kernels.Optimiser(*moments, np.zeros(1, np.float32))
            numba_kernels.critic_step(
                networks[1], adam, 1e-3, inputs, actions, placed(targets, offset)
            )
            results = (evaluated, actions, densities, parameters[1], *moments)
            found.append([result.tobytes() for result in results])
        assert all(result == found[0] for result in found[1:]), (batch, width)
