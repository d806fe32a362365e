"""Networks: stacked multilayer perceptrons over one flat parameter vector.

At the sizes of this work (64 hidden units, batches of a few hundred) PyTorch's time goes into
dispatching many small operations, not into arithmetic. So K networks of equal shape are evaluated
as batched products, their parameters live in one flat tensor (one optimiser step, one norm, one
`lerp_` for all of them), and a whole network is a single node of the autograd graph with a
hand-written backward pass. Losses stay ordinary differentiable PyTorch code on its outputs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from safemr.errors import UserError

Activation = Literal["elu", "relu", "tanh"]
Layers = list[tuple[Tensor, Tensor]]

ACTIVATIONS: tuple[Activation, ...] = ("elu", "relu", "tanh")


def _activate_(z: Tensor, activation: Activation) -> Tensor:
    if activation == "relu":
        return z.relu_()
    if activation == "elu":
        return torch.nn.functional.elu_(z)
    # 2 logistic(2 z) - 1: PyTorch's tanh takes twice as long as these four passes together.
    return z.mul_(2.0).sigmoid_().mul_(2.0).sub_(1.0)


def _activation_gradient(grad: Tensor, output: Tensor, activation: Activation) -> Tensor:
    """grad * activation'(z), written in terms of the activation's output."""
    if activation == "relu":
        return torch.ops.aten.threshold_backward(grad, output, 0.0)
    if activation == "elu":
        return torch.ops.aten.elu_backward(grad, 1.0, 1.0, 1.0, True, output)
    return torch.ops.aten.tanh_backward(grad, output)


@dataclass(frozen=True)
class Shape:
    """K perceptrons with layer widths ``sizes`` = (input, hidden..., output)."""

    count: int
    sizes: tuple[int, ...]
    activation: Activation = "elu"

    def __post_init__(self) -> None:
        if self.activation not in ACTIVATIONS:
            raise UserError(f"unknown activation {self.activation!r}: use one of {ACTIVATIONS}")

    @property
    def numel(self) -> int:
        pairs = zip(self.sizes[:-1], self.sizes[1:], strict=True)
        return self.count * sum(i * o + o for i, o in pairs)

    def layers(self, flat: Tensor) -> Layers:
        """Views (weight [K, out, in], bias [K, 1, out]) into a flat vector, first layer first."""
        views, at = [], 0
        for i, o in zip(self.sizes[:-1], self.sizes[1:], strict=True):
            size = self.count * i * o
            weight = flat[at : at + size].view(self.count, o, i)
            at += size
            bias = flat[at : at + self.count * o].view(self.count, 1, o)
            at += self.count * o
            views.append((weight, bias))
        return views


def _affine(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """x W^T + b for every network; a single output is a row-wise sum, 4x faster than a product."""
    if weight.shape[1] == 1:
        return (x * weight).sum(-1, keepdim=True).add_(bias)
    return torch.baddbmm(bias, x, weight.transpose(1, 2))


def _affine_backward(grad: Tensor, weight: Tensor) -> Tensor:
    """Gradient with respect to the input of `_affine`."""
    return grad * weight if weight.shape[1] == 1 else torch.bmm(grad, weight)


class _Forward(torch.autograd.Function):
    """One graph node for a whole stack of perceptrons: first derivatives only.

    ``flat`` is what autograd differentiates; ``layers`` are detached views of the same memory,
    made once, because slicing a flat vector anew costs as much as a small product.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, flat: Tensor, shape: Shape, layers: Layers) -> Tensor:
        inputs = [x if x.dim() == 3 else x.expand(shape.count, *x.shape)]
        for weight, bias in layers[:-1]:
            inputs.append(_activate_(_affine(inputs[-1], weight, bias), shape.activation))
        ctx.shape, ctx.layers, ctx.shared_input = shape, layers, x.dim() == 2
        # flat is saved only so that autograd notices a step taken between forward and backward.
        ctx.save_for_backward(flat, *inputs)
        return _affine(inputs[-1], *layers[-1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        _, *inputs = ctx.saved_tensors
        need_input, need_flat = ctx.needs_input_grad[:2]
        pieces: list[Tensor] = []
        for level in range(len(inputs) - 1, -1, -1):
            if need_flat:
                weight_grad = torch.bmm(grad.transpose(1, 2), inputs[level])
                pieces += (grad.sum(1).view(-1), weight_grad.view(-1))
            if level == 0 and not need_input:
                break
            grad = _affine_backward(grad, ctx.layers[level][0])
            if level:
                grad = _activation_gradient(grad, inputs[level], ctx.shape.activation)
        grad_flat = torch.cat(pieces[::-1]) if need_flat else None
        if not need_input:
            return None, grad_flat, None, None
        return (grad.sum(0) if ctx.shared_input else grad), grad_flat, None, None


class StackedMLP:
    """K multilayer perceptrons of one shape, evaluated together.

    ``parameters`` is one flat leaf tensor. Calling with x [B, in] feeds the same input to every
    network, x [K, B, in] one input each; the result is [K, B, out].
    """

    def __init__(
        self,
        count: int,
        sizes: Sequence[int],
        activation: Activation = "elu",
        *,
        generator: torch.Generator | None = None,
        hidden_gain: float = math.sqrt(2.0),
        output_gain: float = 1.0,
        output_bias: float = 0.0,
        dtype: torch.dtype = torch.float32,
        device: str = "cpu",
    ) -> None:
        self.shape = Shape(count, tuple(sizes), activation)
        parameters = torch.zeros(self.shape.numel, dtype=dtype)
        layers = self.shape.layers(parameters)
        for level, (weight, bias) in enumerate(layers):
            last = level == len(layers) - 1
            for member in weight:
                torch.nn.init.orthogonal_(
                    member, output_gain if last else hidden_gain, generator=generator
                )
            if last:
                bias.fill_(output_bias)
        self._hold(parameters.to(device).requires_grad_(True))

    def _hold(self, parameters: Tensor) -> None:
        self.parameters = parameters
        self._layers = self.shape.layers(parameters.detach())

    def __call__(self, x: Tensor) -> Tensor:
        return _Forward.apply(x, self.parameters, self.shape, self._layers)

    def frozen(self, x: Tensor) -> Tensor:
        """The same outputs, differentiable in x only."""
        return _Forward.apply(x, self.parameters.detach(), self.shape, self._layers)

    @torch.no_grad()
    def jvp(self, x: Tensor, tangent: Tensor) -> Tensor:
        """Directional derivative of the outputs along ``tangent`` [numel] in parameter space."""
        shape = self.shape
        hidden = x if x.dim() == 3 else x.expand(shape.count, *x.shape)
        moved: Tensor | None = None
        layers, tangents = self._layers, shape.layers(tangent)
        for level, ((weight, bias), (d_weight, d_bias)) in enumerate(
            zip(layers, tangents, strict=True)
        ):
            d_z = _affine(hidden, d_weight, d_bias)
            if moved is not None:
                d_z = _affine(moved, weight, d_z)
            if level == len(layers) - 1:
                return d_z
            hidden = _activate_(_affine(hidden, weight, bias), shape.activation)
            moved = _activation_gradient(d_z, hidden, shape.activation)
        raise AssertionError("a perceptron has at least one layer")

    def copy(self, members: int | None = None) -> StackedMLP:
        """A target network: a detached copy of the first ``members`` networks (default: all)."""
        twin = object.__new__(StackedMLP)
        shape = self.shape
        twin.shape = Shape(members or shape.count, shape.sizes, shape.activation)
        twin._hold(self.parameters.new_empty(twin.shape.numel).detach())
        twin.follow(self, 1.0)
        return twin

    def member(self, index: int) -> StackedMLP:
        """A detached copy of one of the networks."""
        twin = object.__new__(StackedMLP)
        twin.shape = Shape(1, self.shape.sizes, self.shape.activation)
        parts = [part[index].reshape(-1) for layer in self._layers for part in layer]
        twin._hold(torch.cat(parts).detach())
        return twin

    @torch.no_grad()
    def follow(self, source: StackedMLP, rate: float) -> None:
        """Polyak averaging: parameters <- (1 - rate) parameters + rate source's first members."""
        count = self.shape.count
        for mine, theirs in zip(self._layers, source._layers, strict=True):
            for own, new in zip(mine, theirs, strict=True):
                own.lerp_(new[:count], rate) if rate < 1.0 else own.copy_(new[:count])

    def load(self, values: Tensor | np.ndarray) -> None:
        """Overwrites the parameters; raises ValueError when the number of them differs."""
        new = torch.as_tensor(values, dtype=self.parameters.dtype)
        if new.shape != self.parameters.shape:
            raise ValueError(
                f"expected {self.parameters.numel()} parameters, found {tuple(new.shape)}"
            )
        with torch.no_grad():
            self.parameters.copy_(new)


LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


def squashed_gaussian(output: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Reparameterised sample of a tanh-squashed Gaussian and its log-density.

    output [..., 2A] holds mean and log standard deviation, noise [..., A] is standard normal.
    Returns actions in (-1, 1) [..., A] and log pi(a|s) [...]. The change of variables uses
    log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2u)), which is exact also where tanh saturates.
    """
    mean, log_std = output.chunk(2, -1)
    log_std = log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
    u = torch.addcmul(mean, log_std.exp(), noise)
    # log N(u) - log|da/du| summed over the action's dimensions
    size = noise.shape[-1]
    constant = size * (0.5 * math.log(2.0 * math.pi) + 2.0 * math.log(2.0))
    terms = log_std + 0.5 * noise.square() - 2.0 * (u + torch.nn.functional.softplus(-2.0 * u))
    return u.tanh(), -terms.sum(-1) - constant
