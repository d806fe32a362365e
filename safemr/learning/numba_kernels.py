"""The arithmetic of one soft actor-critic step as compiled loops around BLAS products.

At the sizes of this work three quarters of a PyTorch update go into dispatching about 170 small
operations. Here a critic step, a policy step and a batch of targets are one call each. What is
computed is defined by the losses in `safemr.learning.losses`; gradients are written out by hand and
tested against PyTorch's. The formulas of the losses and of Adam are therefore the only ones that
occur twice in this repository.

Arrays are float32 and C-contiguous. The batch is the last axis of everything inside (activations
[K, width, B]): then the first layer of a whole stack is one product, biases are added row by row,
and every elementwise loop runs along memory.
"""

from __future__ import annotations

import ctypes
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cython_blas

from envs.compiled import njit
from safemr.learning.networks import ACTIVATIONS, LOG_STD_MAX, LOG_STD_MIN

Floats = NDArray[np.float32]
Scalar = Any  # float32 when compiled

# Sums may be reordered, so that they vectorise; NaN and infinity keep their meaning, because
# diverged training is recognised by them.
_compiled = njit(error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"})

# Cached machine code holds constants until this file changes: those of networks.py are compared.
_ELU, _RELU = 0, 1
# A Python float would turn the loops into double precision.
_0, _HALF, _1, _2 = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0))
_LOG_STD_MIN, _LOG_STD_MAX = np.float32(-20.0), np.float32(2.0)
_LOG_DENSITY = np.float32(0.5 * math.log(2.0 * math.pi) + 2.0 * math.log(2.0))
_LINEAR_FROM = np.float32(20.0)  # beyond this softplus(x) = x in float32
_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, np.float32(1e-8)  # defaults of torch.optim.Adam
if ACTIVATIONS[:2] != ("elu", "relu") or (LOG_STD_MIN, LOG_STD_MAX) != (_LOG_STD_MIN, _LOG_STD_MAX):
    raise ImportError(
        "safemr/learning/numba_kernels.py and safemr/learning/networks.py state different constants"
    )


def _use_one_blas_thread() -> None:
    """np.dot in compiled code calls scipy's BLAS, whose threads only wait at these sizes.

    Environment variables would be read when scipy is first imported, which may have happened.
    """
    library = ctypes.CDLL(cython_blas.__file__)  # names are looked up in what it links, too
    openblas = "openblas_set_num_threads"
    for name in (openblas, f"scipy_{openblas}", "MKL_Set_Num_Threads"):
        if hasattr(library, name):
            getattr(library, name)(1)


_use_one_blas_thread()


class Network(NamedTuple):
    """A `safemr.learning.networks.StackedMLP`: its flat parameters, layer widths, number of members
    and index of its activation in ACTIVATIONS."""

    parameters: Floats
    sizes: NDArray[np.int64]
    members: int
    activation: int


class Optimiser(NamedTuple):
    """State of a torch.optim.Adam for one flat tensor: moments and number of steps done [1]."""

    mean: Floats
    square: Floats
    step: Floats


@_compiled
def _layer(flat: Floats, net: Network, level: int) -> tuple[Floats, Floats]:
    """Views of a layer: weight [K, out, in] and bias [K, out]; `networks.Shape.layers`."""
    at = 0
    for below in range(level):
        at += net.members * (net.sizes[below] + 1) * net.sizes[below + 1]
    i, o = net.sizes[level], net.sizes[level + 1]
    middle = at + net.members * o * i
    weight = flat[at:middle].reshape((net.members, o, i))
    return weight, flat[middle : middle + net.members * o].reshape((net.members, o))


@_compiled
def _hidden(net: Network, memory: Floats, level: int, batch: int) -> Floats:
    """View [K, width, B] of the activations that enter ``level`` >= 1."""
    at = 0
    for below in range(1, level):
        at += net.members * net.sizes[below] * batch
    size = net.members * net.sizes[level] * batch
    return memory[at : at + size].reshape((net.members, net.sizes[level], batch))


@_compiled
def _memory(net: Network, batch: int) -> Floats:
    """Room for all hidden activations."""
    width = 0
    for level in range(1, len(net.sizes) - 1):
        width += net.sizes[level]
    return np.empty(net.members * width * batch, np.float32)


@_compiled
def _add_bias(z: Floats, bias: Floats) -> None:
    for member in range(z.shape[0]):
        for row in range(z.shape[1]):
            shift = bias[member, row]
            for b in range(z.shape[2]):
                z[member, row, b] += shift


@_compiled
def _activate(z: Floats, bias: Floats, activation: int) -> None:
    """z <- activation(z + bias); comparisons are such that NaN stays NaN."""
    for member in range(z.shape[0]):
        for row in range(z.shape[1]):
            line, shift = z[member, row], bias[member, row]
            if activation == _RELU:
                for b in range(len(line)):
                    x = line[b] + shift
                    line[b] = _0 if x < _0 else x
            elif activation == _ELU:
                for b in range(len(line)):
                    x = line[b] + shift
                    line[b] = math.expm1(x) if x < _0 else x
            else:
                for b in range(len(line)):
                    line[b] = math.tanh(line[b] + shift)


@_compiled
def _activation_gradient(grad: Floats, output: Floats, activation: int) -> None:
    """grad <- grad * activation'(z), written in terms of the activation's output."""
    grad, output = grad.reshape(-1), output.reshape(-1)
    if activation == _RELU:
        for j in range(len(grad)):
            grad[j] = grad[j] if output[j] > _0 else _0
    elif activation == _ELU:
        for j in range(len(grad)):
            grad[j] = grad[j] if output[j] > _0 else grad[j] * (output[j] + _1)
    else:
        for j in range(len(grad)):
            grad[j] *= _1 - output[j] * output[j]


@_compiled
def forward(net: Network, x: Floats, memory: Floats) -> Floats:
    """Outputs [K, out, B] of all members at x [B, in]; hidden activations stay in ``memory``."""
    batch, levels = len(x), len(net.sizes) - 1
    out = np.empty((net.members, net.sizes[-1], batch), np.float32)
    for level in range(levels):
        weight, bias = _layer(net.parameters, net, level)
        z = out if level == levels - 1 else _hidden(net, memory, level + 1, batch)
        if weight.shape[2] == 0:  # a perceptron without inputs is its bias
            z.fill(_0)
        elif level == 0:
            rows = net.members * weight.shape[1]
            np.dot(weight.reshape((rows, weight.shape[2])), x.T, z.reshape((rows, batch)))
        else:
            below = _hidden(net, memory, level, batch)
            for member in range(net.members):
                np.dot(weight[member], below[member], z[member])
        if level == levels - 1:
            _add_bias(z, bias)
        else:
            _activate(z, bias, net.activation)
    return out


@_compiled
def _backward_hidden(net: Network, level: int, grad: Floats, memory: Floats) -> Floats:
    """From the gradient at the pre-activations of ``level`` to that of the level below."""
    weight, _ = _layer(net.parameters, net, level)
    output = _hidden(net, memory, level, grad.shape[2])
    below = np.empty_like(output)
    for member in range(net.members):
        np.dot(weight[member].T, grad[member], below[member])
    _activation_gradient(below, output, net.activation)
    return below


@_compiled
def backward(net: Network, x: Floats, memory: Floats, grad: Floats) -> Floats:
    """Gradient of all parameters, flat, from that of the outputs, [K, out, B]."""
    flat, batch = np.empty_like(net.parameters), len(x)
    for level in range(len(net.sizes) - 2, -1, -1):
        weight, bias = _layer(flat, net, level)
        for member in range(net.members):
            for row in range(weight.shape[1]):
                bias[member, row] = grad[member, row].sum()
        if level == 0:
            rows = net.members * weight.shape[1]
            if weight.size:
                np.dot(grad.reshape((rows, batch)), x, weight.reshape((rows, weight.shape[2])))
        else:
            below = _hidden(net, memory, level, batch)
            for member in range(net.members):
                np.dot(grad[member], below[member].T, weight[member])
            grad = _backward_hidden(net, level, grad, memory)
    return flat


@_compiled
def backward_inputs(net: Network, memory: Floats, grad: Floats, first: int) -> Floats:
    """Gradient [in - first, B] of the inputs from column ``first`` on, summed over members."""
    for level in range(len(net.sizes) - 2, 0, -1):
        grad = _backward_hidden(net, level, grad, memory)
    weight, _ = _layer(net.parameters, net, 0)
    rows = net.members * weight.shape[1]
    table = weight.reshape((rows, weight.shape[2]))
    columns = np.empty((weight.shape[2] - first, rows), np.float32)
    for column in range(len(columns)):
        for row in range(rows):
            columns[column, row] = table[row, first + column]
    return np.dot(columns, grad.reshape((rows, grad.shape[2])))


@_compiled
def adam(parameters: Floats, grad: Floats, optimiser: Optimiser, lr: float) -> None:
    """One step of torch.optim.Adam with its default betas and epsilon."""
    optimiser.step[0] += _1
    step = float(optimiser.step[0])
    rate = np.float32(lr / (1.0 - _BETA_1**step))
    root = np.float32(1.0 / math.sqrt(1.0 - _BETA_2**step))
    keep, new_1, new_2 = np.float32(_BETA_2), np.float32(1.0 - _BETA_1), np.float32(1.0 - _BETA_2)
    mean, square = optimiser.mean, optimiser.square
    for j in range(len(parameters)):
        g = grad[j]
        mean[j] += new_1 * (g - mean[j])
        square[j] = keep * square[j] + new_2 * g * g
        parameters[j] -= rate * mean[j] / (math.sqrt(square[j]) * root + _EPSILON)


@_compiled
def _approach(old: Floats, new: Floats, rate: Scalar) -> None:
    for j in range(len(old)):
        old[j] += rate * (new[j] - old[j])


@_compiled
def polyak(target: Network, source: Network, rate: float) -> None:
    """`networks.StackedMLP.follow`: the target's members are the source's first ones."""
    for level in range(len(target.sizes) - 1):
        old, old_bias = _layer(target.parameters, target, level)
        new, new_bias = _layer(source.parameters, source, level)
        _approach(old.reshape(-1), new.reshape(-1), np.float32(rate))
        _approach(old_bias.reshape(-1), new_bias.reshape(-1), np.float32(rate))


@_compiled
def _norm(grad: Floats) -> Scalar:
    total = _0
    for j in range(len(grad)):
        total += grad[j] * grad[j]
    return math.sqrt(total)


@_compiled
def _softplus(x: Scalar) -> Scalar:
    return x if x > _LINEAR_FROM else math.log1p(math.exp(x))


@_compiled
def _sigmoid(x: Scalar) -> Scalar:
    return _1 / (_1 + math.exp(-x))


@_compiled
def _squash(output: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """`networks.squashed_gaussian` of output [2A, B] and noise [B, A]: actions and densities."""
    batch, size = noise.shape
    actions, log_densities = np.empty((batch, size), np.float32), np.empty(batch, np.float32)
    for b in range(batch):
        total = size * _LOG_DENSITY
        for a in range(size):
            log_std = min(max(output[size + a, b], _LOG_STD_MIN), _LOG_STD_MAX)
            u = output[a, b] + math.exp(log_std) * noise[b, a]
            total += log_std + _HALF * noise[b, a] ** 2 - _2 * (u + _softplus(-_2 * u))
            actions[b, a] = math.tanh(u)
        log_densities[b] = -total
    return actions, log_densities


@_compiled
def _joined(observations: Floats, actions: Floats) -> Floats:
    """A critic's input [B, D + A]."""
    size = observations.shape[1]
    both = np.empty((len(observations), size + actions.shape[1]), np.float32)
    for b in range(len(both)):
        for column in range(size):
            both[b, column] = observations[b, column]
        for column in range(actions.shape[1]):
            both[b, size + column] = actions[b, column]
    return both


@_compiled
def sample(policy: Network, observations: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Actions [B, A] of the policy and their log-densities [B]."""
    output = forward(policy, observations, _memory(policy, len(observations)))
    return _squash(output[0], noise)


@_compiled
def next_values(
    policy: Network, targets: Network, observations: Floats, noise: Floats
) -> tuple[Floats, Floats]:
    """Target critics' values [K, B] of sampled actions and the log-densities of these [B]."""
    actions, log_densities = sample(policy, observations, noise)
    inputs = _joined(observations, actions)
    values = forward(targets, inputs, _memory(targets, len(inputs)))
    return values.reshape((targets.members, len(inputs))), log_densities


@_compiled
def critic_step(
    critics: Network,
    optimiser: Optimiser,
    lr: float,
    observations: Floats,
    actions: Floats,
    targets: Floats,
) -> tuple[Scalar, Scalar, Scalar]:
    """A step on `losses.critic_loss`; targets [K, B]. Returns loss, gradient norm, mean of Q_1."""
    inputs = _joined(observations, actions)
    memory = _memory(critics, len(inputs))
    values = forward(critics, inputs, memory)
    mean = values[0].mean()
    scale, loss = _2 / np.float32(len(inputs)), _0
    for member in range(critics.members):
        for b in range(len(inputs)):
            error = values[member, 0, b] - targets[member, b]
            loss += error * error
            values[member, 0, b] = scale * error
    grad = backward(critics, inputs, memory, values)
    adam(critics.parameters, grad, optimiser, lr)
    return loss / len(inputs), _norm(grad), mean


@_compiled
def _multipliers(raw: Floats, cap: Scalar) -> Floats:
    """lambda = min(softplus(raw), cap), [B]."""
    out = np.empty_like(raw)
    for b in range(len(raw)):
        value = _softplus(raw[b])
        out[b] = cap if value > cap else value
    return out


@_compiled
def policy_step(
    policy: Network,
    policy_optimiser: Optimiser,
    policy_lr: float,
    critics: Network,
    multiplier: Network,
    multiplier_inputs: Floats,
    log_temperature: Floats,
    temperature_optimiser: Optimiser,
    temperature_lr: float,
    observations: Floats,
    noise: Floats,
    constraint_scale: float,
    cap: float,
    target_entropy: float,
) -> tuple[Floats, Floats, Floats, Floats, Scalar, Scalar, Scalar]:
    """Steps on `policy_loss` and `temperature_loss` of `losses`; the last critic: the constraint's.

    Returns lambda(s), Q_phi(s, a) [B], the multiplier network's raw outputs [B] and hidden
    activations (for `multiplier_step`), policy loss, its gradient norm and the mean log-density.
    """
    batch, size = noise.shape
    share, scale = _1 / np.float32(batch), np.float32(constraint_scale)
    temperature = math.exp(log_temperature[0])
    memory = _memory(policy, batch)
    output = forward(policy, observations, memory)[0]
    actions, log_densities = _squash(output, noise)
    critic_memory = _memory(critics, batch)
    values = forward(critics, _joined(observations, actions), critic_memory)
    constraint = np.empty(batch, np.float32)
    multiplier_memory = _memory(multiplier, batch)
    raw = forward(multiplier, multiplier_inputs, multiplier_memory)[0, 0]
    multipliers = _multipliers(raw, np.float32(cap))

    loss = _0
    for b in range(batch):
        constraint[b] = values[-1, 0, b] / scale
        least, ties = values[0, 0, b], 0
        for member in range(critics.members - 1):
            least = min(least, values[member, 0, b])
        for member in range(critics.members - 1):
            ties += values[member, 0, b] == least
        loss += temperature * log_densities[b] - least + multipliers[b] * constraint[b]
        for member in range(critics.members - 1):
            values[member, 0, b] = -share / ties if values[member, 0, b] == least else _0
        values[-1, 0, b] = share * multipliers[b] / scale

    grad_actions = backward_inputs(critics, critic_memory, values, observations.shape[1])
    grad = np.empty((1, 2 * size, batch), np.float32)
    for a in range(size):
        for b in range(batch):
            action, log_std = actions[b, a], output[size + a, b]
            # d log pi / du = 2 tanh(u)
            grad_u = _2 * share * temperature * action + grad_actions[a, b] * (_1 - action * action)
            grad[0, a, b] = grad_u
            inside = _LOG_STD_MIN <= log_std <= _LOG_STD_MAX
            spread = grad_u * math.exp(log_std) * noise[b, a] - share * temperature
            grad[0, size + a, b] = spread if inside else _0
    flat = backward(policy, observations, memory, grad)
    adam(policy.parameters, flat, policy_optimiser, policy_lr)
    density = log_densities.mean()
    slope = np.full(1, -(density + np.float32(target_entropy)), np.float32)
    adam(log_temperature, slope, temperature_optimiser, temperature_lr)
    return multipliers, constraint, raw, multiplier_memory, loss * share, _norm(flat), density


@_compiled
def multiplier_step(
    multiplier: Network,
    optimiser: Optimiser,
    lr: float,
    inputs: Floats,
    memory: Floats,
    raw: Floats,
    constraint: Floats,
    cap: float,
    max_norm: float,
) -> float:
    """A step on `losses.multiplier_loss`, gradient clipped to ``max_norm``; returns its norm."""
    batch = len(raw)
    grad = np.empty((1, 1, batch), np.float32)
    for b in range(batch):
        slope = -constraint[b] / np.float32(batch) * _sigmoid(raw[b])
        grad[0, 0, b] = _0 if _softplus(raw[b]) > cap else slope
    flat = backward(multiplier, inputs, memory, grad)
    shrink = np.float32(max_norm) / (_norm(flat) + np.float32(1e-6))
    if shrink < _1:
        for j in range(len(flat)):
            flat[j] *= shrink
    adam(multiplier.parameters, flat, optimiser, lr)
    return _norm(flat)
