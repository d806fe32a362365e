"""Adam (Kingma & Ba, arXiv:1412.6980) by PyTorch's own arithmetic, without its optimiser class.

Making any ``torch.optim.Optimizer`` imports PyTorch's compiler, which takes longer than all else
between PyTorch's import and the first gradient step. `Adam` calls the function that
``torch.optim.Adam`` calls and keeps the same state, so numbers and checkpoints are that class's to
the bit, and what asks an optimiser for ``param_groups``, ``defaults`` or ``state`` finds them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam

_SETTINGS: dict[str, Any] = {
    "betas": (0.9, 0.999),
    "eps": 1e-8,
    "weight_decay": 0,
    "amsgrad": False,
    "maximize": False,
    "foreach": None,
    "capturable": False,
    "differentiable": False,
    "fused": True,
    "decoupled_weight_decay": False,
}


class Adam:
    """Steps on the ``grad`` of some tensors, which all learn at one rate.

    Attributes:
        param_groups: one group; its ``lr`` may be changed between steps.
        defaults: the settings at the start, with the first ``lr``.
        state: for each tensor that was stepped on, ``step`` (number of steps, []) and the moments
            ``exp_avg`` and ``exp_avg_sq`` (of the tensor's shape).
    """

    def __init__(self, parameters: Iterable[Tensor], lr: float, *, fused: bool = True) -> None:
        """``fused``: in one operation a tensor, which rounds otherwise than the plain one."""
        self.defaults = {"lr": lr, **_SETTINGS, "fused": fused or None}
        self.param_groups = [{**self.defaults, "params": list(parameters)}]
        self.state: dict[Tensor, dict[str, Tensor]] = {}

    def moments(self, parameters: Tensor) -> dict[str, Tensor]:
        """The state of one tensor, zeros before its first step."""
        if parameters not in self.state:
            self.state[parameters] = {
                "step": torch.zeros((), device=parameters.device),
                "exp_avg": torch.zeros_like(parameters),
                "exp_avg_sq": torch.zeros_like(parameters),
            }
        return self.state[parameters]

    @torch.no_grad()
    def step(self) -> None:
        """One step on every tensor that has a gradient."""
        (group,) = self.param_groups
        stepped = [each for each in group["params"] if each.grad is not None]
        moments = [self.moments(each) for each in stepped]
        beta1, beta2 = group["betas"]
        adam(
            stepped,
            [each.grad for each in stepped],
            [each["exp_avg"] for each in moments],
            [each["exp_avg_sq"] for each in moments],
            [],
            [each["step"] for each in moments],
            fused=group["fused"],
            amsgrad=False,
            beta1=beta1,
            beta2=beta2,
            lr=group["lr"],
            weight_decay=0,
            eps=group["eps"],
            maximize=False,
        )

    def state_dict(self) -> dict[str, Any]:
        """That of ``torch.optim.Adam``: tensors by their position; moments are not copied."""
        (group,) = self.param_groups
        places = range(len(group["params"]))
        state = {
            place: self.state[each]
            for place, each in enumerate(group["params"])
            if each in self.state
        }
        return {"state": state, "param_groups": [{**group, "params": list(places)}]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes over a copy of a `state_dict`, or of one of ``torch.optim.Adam``."""
        (group,), (saved,) = self.param_groups, state["param_groups"]
        parameters = group["params"]
        if len(saved["params"]) != len(parameters):
            raise ValueError(f"state of {len(saved['params'])} tensors for {len(parameters)}")
        self.param_groups = [{**saved, "params": parameters}]
        self.state = {
            parameters[place]: {
                name: value.detach().to(parameters[place].device, copy=True)
                for name, value in moments.items()
            }
            for place, moments in state["state"].items()
        }
