"""Adam without PyTorch's optimiser class: the same numbers and the same state, to the bit."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor

from safemr.learning.adam import Adam


def tensors(dtype: torch.dtype) -> list[Tensor]:
    rng = torch.Generator().manual_seed(3)
    shapes = ((7, 5), (), (40,))
    return [torch.randn(s, generator=rng, dtype=dtype).requires_grad_(True) for s in shapes]


def give_gradients(step: int, *learners: list[Tensor]) -> None:
    """The same gradients to all, over many orders of magnitude; now and then none to the last."""
    rng = torch.Generator().manual_seed(step)
    for place, alike in enumerate(zip(*learners, strict=True)):
        scale = 10.0 ** (step % 9 - 6)
        gradient = scale * torch.randn(alike[0].shape, generator=rng, dtype=alike[0].dtype)
        for each in alike:
            each.grad = None if place == 2 and step % 5 == 0 else gradient.clone()


def assert_same(ours: object, theirs: object) -> None:
    assert type(ours) is type(theirs)
    if isinstance(ours, Tensor):
        assert ours.dtype == theirs.dtype
        assert torch.equal(ours, theirs)
    elif isinstance(ours, dict):
        assert list(ours) == list(theirs)
        for name in ours:
            assert_same(ours[name], theirs[name])
    elif isinstance(ours, list):
        assert len(ours) == len(theirs)
        for one, other in zip(ours, theirs, strict=True):
            assert_same(one, other)
    else:
        assert ours == theirs


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_numbers_and_state_are_those_of_torch(fused: bool, dtype: torch.dtype) -> None:
    mine, theirs = tensors(dtype), tensors(dtype)
    ours = Adam(mine, 0.02, fused=fused)
    reference = torch.optim.Adam(theirs, lr=0.02, fused=fused or None)
    assert_same(ours.state_dict(), reference.state_dict())
    for step in range(60):
        ours.param_groups[0]["lr"] = reference.param_groups[0]["lr"] = 0.02 * (1 - step / 60)
        give_gradients(step, mine, theirs)
        ours.step()
        reference.step()
        assert_same(mine, theirs)
    state = ours.state_dict()
    # Its order is that of the first steps, of no meaning.
    assert_same({**state, "state": dict(sorted(state["state"].items()))}, reference.state_dict())


@pytest.mark.parametrize("back", [False, True])
def test_continues_a_state_of_torch_and_torch_one_of_ours(back: bool) -> None:
    begun, continued = tensors(torch.float32), tensors(torch.float32)
    kinds = (Adam, torch.optim.Adam) if back else (torch.optim.Adam, Adam)
    first, second = kinds[0](begun, lr=0.02, fused=True), kinds[1](continued, lr=0.5, fused=True)
    for step in range(5):
        give_gradients(step, begun)
        first.step()
    for to, value in zip(continued, begun, strict=True):
        to.detach().copy_(value.detach())
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    for step in range(5, 12):
        give_gradients(step, begun, continued)
        first.step()
        second.step()
        assert_same(continued, begun)


def test_a_loaded_state_is_a_copy() -> None:
    one, other = tensors(torch.float32), tensors(torch.float32)
    source, target = Adam(one, 0.1), Adam(other, 0.1)
    give_gradients(1, one, other)
    source.step()
    target.load_state_dict(source.state_dict())
    before = {place: dict(each) for place, each in source.state_dict()["state"].items()}
    kept = before[0]["exp_avg"].clone()
    target.step()
    assert torch.equal(before[0]["exp_avg"], kept)
    assert float(target.state_dict()["state"][0]["step"]) == 2.0


def test_a_state_of_other_tensors_is_refused() -> None:
    with pytest.raises(ValueError, match="state of 3 tensors for 1"):
        Adam(tensors(torch.float32)[:1], 0.1).load_state_dict(
            Adam(tensors(torch.float32), 0.1).state_dict()
        )
