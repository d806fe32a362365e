"""The arithmetic of the on-policy family as compiled loops around BLAS products.

What is computed is defined by `safemr.learning.on_policy`, `trust_region` and the algorithms; the
gradients are written out and tested against PyTorch's. Layout and rules are those of
`safemr.learning.numba_kernels`: float32, C-contiguous, the batch as the last axis of everything
inside. Its perceptron and Adam stand here again because compiled code is kept by file and must not
hold what another file can change. Samples are worked on in blocks whose activations fit the cache.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.compiled import njit
from safemr.learning.networks import ACTIVATIONS
from safemr.learning.numba_kernels import Network, Optimiser

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]
Scalar = Any  # float32 when compiled

# As in numba_kernels: sums may be reordered, NaN and infinity keep their meaning.
_compiled = njit(error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"})

_ELU, _RELU = 0, 1
_0, _HALF, _1, _2 = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0))
_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
_B1, _B2, _EPS = 0.9, 0.999, np.float32(1e-8)  # defaults of torch.optim.Adam
_BLOCK = 512  # samples worked on together
# Lambert's continued fraction of tanh after seven terms: numerator / x and denominator in x^2
_P0, _P1, _P2 = (np.float32(value / 135135.0) for value in (17325.0, 378.0, 1.0))
_Q0, _Q1, _Q2 = (np.float32(value / 135135.0) for value in (62370.0, 3150.0, 28.0))
_FLAT, _QUARTER = np.float32(9.0), np.float32(0.25)  # tanh(9) = 1 in float32
if ACTIVATIONS != ("elu", "relu", "tanh"):
    raise ImportError("safemr/learning/on_policy_kernels.py knows other activations")


class Samples(NamedTuple):
    """`rollouts.Batch` as the kernels see it."""

    observations: Floats  # [B, D]
    actions: Floats  # [B, A]
    mean: Floats  # [B, A]
    log_std: Floats  # [A]
    log_density: Floats  # [B]
    advantages: Floats  # [B]
    cost_advantages: Floats  # [B]


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
def _room(net: Network) -> int:
    """Numbers that the hidden activations of a sample take."""
    return int(net.members * net.sizes[1:-1].sum())


@_compiled
def _tanh(x: Scalar) -> Scalar:
    """tanh to 2e-7 without a branch or a table: a fraction p / q at x / 4, doubled twice."""
    x = _FLAT if x > _FLAT else x  # NaN stays NaN
    x = -_FLAT if x < -_FLAT else x
    y = _QUARTER * x
    s = y * y
    p = y * (_1 + s * (_P0 + s * (_P1 + s * _P2)))
    q = _1 + s * (_Q0 + s * (_Q1 + s * _Q2))
    p, q = _2 * p * q, p * p + q * q  # tanh(2 y) = 2 t / (1 + t^2)
    return _2 * p * q / (p * p + q * q)


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
                    line[b] = _tanh(line[b] + shift)


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
        if level == 0:
            rows = net.members * weight.shape[1]
            np.dot(weight.reshape((rows, weight.shape[2])), x.T, z.reshape((rows, batch)))
        else:
            below = _hidden(net, memory, level, batch)
            for member in range(net.members):
                np.dot(weight[member], below[member], z[member])
        if level == levels - 1:
            z += bias.reshape((net.members, len(bias[0]), 1))
        else:
            _activate(z, bias, net.activation)
    return out


@_compiled
def backward(net: Network, x: Floats, memory: Floats, grad: Floats, total: Floats) -> None:
    """Adds the gradient of all parameters to ``total``, from that of the outputs [K, out, B]."""
    flat, batch = np.empty_like(net.parameters), len(x)
    for level in range(len(net.sizes) - 2, -1, -1):
        weight, bias = _layer(flat, net, level)
        for member in range(net.members):
            for row in range(weight.shape[1]):
                bias[member, row] = grad[member, row].sum()
        if level == 0:
            rows = net.members * weight.shape[1]
            np.dot(grad.reshape((rows, batch)), x, weight.reshape((rows, weight.shape[2])))
        else:
            output = _hidden(net, memory, level, batch)
            below = np.empty_like(output)
            above, _ = _layer(net.parameters, net, level)
            for member in range(net.members):
                np.dot(grad[member], output[member].T, weight[member])
                np.dot(above[member].T, grad[member], below[member])
            _activation_gradient(below, output, net.activation)
            grad = below
    for j in range(len(flat)):
        total[j] += flat[j]


@_compiled
def tangent(net: Network, direction: Floats, x: Floats, memory: Floats) -> Floats:
    """`networks.StackedMLP.jvp` [K, out, B] where `forward` has left ``memory``."""
    batch, levels = len(x), len(net.sizes) - 1
    moved = np.empty((0, 0, 0), np.float32)
    for level in range(levels):
        weight, _ = _layer(net.parameters, net, level)
        d_weight, d_bias = _layer(direction, net, level)
        d_z = np.empty((net.members, weight.shape[1], batch), np.float32)
        if level == 0:
            rows = net.members * weight.shape[1]
            np.dot(d_weight.reshape((rows, weight.shape[2])), x.T, d_z.reshape((rows, batch)))
        else:
            below = _hidden(net, memory, level, batch)
            for member in range(net.members):
                np.dot(d_weight[member], below[member], d_z[member])
                d_z[member] += np.dot(weight[member], moved[member])
        d_z += d_bias.reshape((net.members, len(d_bias[0]), 1))
        if level < levels - 1:
            _activation_gradient(d_z, _hidden(net, memory, level + 1, batch), net.activation)
        moved = d_z
    return moved


@_compiled
def adam(parameters: Floats, grad: Floats, optimiser: Optimiser, lr: float) -> None:
    """One step of torch.optim.Adam with its default betas and epsilon."""
    optimiser.step[0] += _1
    step = float(optimiser.step[0])
    rate = np.float32(lr / (1.0 - _B1**step))
    root = np.float32(1.0 / math.sqrt(1.0 - _B2**step))
    keep, new_1, new_2 = np.float32(_B2), np.float32(1.0 - _B1), np.float32(1.0 - _B2)
    mean, square = optimiser.mean, optimiser.square
    for j in range(len(parameters)):
        g = grad[j]
        mean[j] += new_1 * (g - mean[j])
        square[j] = keep * square[j] + new_2 * g * g
        parameters[j] -= rate * mean[j] / (math.sqrt(square[j]) * root + _EPS)


@_compiled
def _gathered(table: Floats, rows: Rows) -> Floats:
    out = np.empty((len(rows), table.shape[1]), np.float32)
    for b in range(len(rows)):
        line = table[rows[b]]
        for column in range(len(line)):
            out[b, column] = line[column]
    return out


@_compiled
def evaluate(net: Network, x: Floats) -> Floats:
    """Outputs [K, out, B] of all members at x [B, in], for any B."""
    out = np.empty((net.members, net.sizes[-1], len(x)), np.float32)
    memory = np.empty(_room(net) * min(len(x), _BLOCK), np.float32)
    for begin in range(0, len(x), _BLOCK):
        end = min(begin + _BLOCK, len(x))
        out[:, :, begin:end] = forward(net, x[begin:end], memory)
    return out


@_compiled
def act(actor: Network, observations: Floats, perturbation: Floats) -> Floats:
    """Actions [N, A]: means plus ``perturbation``."""
    return perturbation + evaluate(actor, observations)[0].T


@_compiled
def value_step(
    critics: Network,
    optimiser: Optimiser,
    lr: float,
    observations: Floats,
    returns: Floats,
    rows: Rows,
) -> Floats:
    """A step of all K critics on the mean squared error at some samples; the errors before, [K].

    observations [B, D], returns [K, B], rows: those of the minibatch.
    """
    losses, share = np.zeros(critics.members), 1.0 / len(rows)
    scale = np.float32(2.0 * share)
    total = np.zeros_like(critics.parameters)
    memory = np.empty(_room(critics) * min(len(rows), _BLOCK), np.float32)
    for begin in range(0, len(rows), _BLOCK):
        part = rows[begin : begin + _BLOCK]
        x = _gathered(observations, part)
        values = forward(critics, x, memory)
        for member in range(critics.members):
            line = values[member, 0]
            for b in range(len(part)):
                line[b] -= returns[member, part[b]]
            loss = _0
            for b in range(len(part)):
                loss += line[b] * line[b]
                line[b] *= scale
            losses[member] += loss * share
        backward(critics, x, memory, values, total)
    adam(critics.parameters, total, optimiser, lr)
    return losses.astype(np.float32)


@_compiled
def _ratios(samples: Samples, rows: Rows, mean: Floats, log_std: Floats, ratio: Floats) -> float:
    """ratio [B] <- pi(a|s) / pi_old(a|s) for mean [A, B]; returns the sum of KL(pi_old || pi)."""
    size = len(log_std)
    inverse = np.exp(-log_std)
    divergence, constant = 0.0, size * _HALF_LOG_2_PI
    for a in range(size):
        difference = float(samples.log_std[a]) - float(log_std[a])
        divergence += math.exp(2.0 * difference) - 1.0 - 2.0 * difference
        constant += log_std[a]
    divergence *= 0.5 * len(rows)
    shift = np.float32(constant)
    for b in range(len(rows)):
        row, squares, moved = rows[b], _0, _0
        for a in range(size):
            z = (samples.actions[row, a] - mean[a, b]) * inverse[a]
            d = (samples.mean[row, a] - mean[a, b]) * inverse[a]
            squares += z * z
            moved += d * d
        ratio[b] = math.exp(-_HALF * squares - shift - samples.log_density[row])
        divergence += 0.5 * float(moved)
    return divergence


@_compiled
def _pull(
    actor: Network,
    log_std: Floats,
    x: Floats,
    actions: Floats,
    memory: Floats,
    mean: Floats,
    slopes: Floats,
    total: Floats,
) -> None:
    """Adds to ``total`` [P] the gradient of a sum whose slopes in log pi(a|s) are ``slopes`` [B].

    mean [1, A, B] are the actor's outputs at x; the gradient takes their place.
    """
    size = len(log_std)
    inverse = np.exp(-log_std)
    count = len(actor.parameters)
    for a in range(size):
        spread = _0
        for b in range(len(slopes)):
            z = (actions[b, a] - mean[0, a, b]) * inverse[a]
            spread += slopes[b] * (z * z - _1)
            mean[0, a, b] = slopes[b] * z * inverse[a]
        total[count + a] += spread
    backward(actor, x, memory, mean, total[:count])


@_compiled
def clipped_step(
    actor: Network,
    log_std: Floats,
    optimiser: Optimiser,
    log_std_optimiser: Optimiser,
    lr: float,
    samples: Samples,
    rows: Rows,
    clip: float,
    multiplier: float,
    bound: float,
) -> tuple[bool, float, float]:
    """PPO-Lagrangian's step on some samples, not taken where KL(pi_old || pi) is above ``bound``.

    Returns whether it was taken, the loss before it, and the share of ratios beyond ``clip``.
    """
    share, penalty = 1.0 / len(rows), np.float32(multiplier)
    scale = np.float32(-share / (1.0 + multiplier))
    low, high, width = np.float32(1.0 - clip), np.float32(1.0 + clip), np.float32(clip)
    total = np.zeros(len(actor.parameters) + len(log_std), np.float32)
    memory = np.empty(_room(actor) * min(len(rows), _BLOCK), np.float32)
    divergence, loss, beyond = 0.0, 0.0, 0
    for begin in range(0, len(rows), _BLOCK):
        part = rows[begin : begin + _BLOCK]
        x = _gathered(samples.observations, part)
        mean = forward(actor, x, memory)
        slopes = np.empty(len(part), np.float32)
        divergence += _ratios(samples, part, mean[0], log_std, slopes)
        for b in range(len(part)):
            ratio, gain = slopes[b], samples.advantages[part[b]]
            cost = penalty * samples.cost_advantages[part[b]]
            clipped = low if ratio < low else high if ratio > high else ratio
            worse = clipped * gain < ratio * gain
            kept = (clipped if worse else ratio) * gain
            loss += scale * (kept - ratio * cost)
            slope = _0 if worse else gain
            slopes[b] = scale * ratio * (slope - cost)
            beyond += abs(ratio - _1) > width
        actions = _gathered(samples.actions, part)
        _pull(actor, log_std, x, actions, memory, mean, slopes, total)
    if divergence * share > bound:
        return False, loss, beyond * share
    count = len(actor.parameters)
    adam(actor.parameters, total[:count], optimiser, lr)
    adam(log_std, total[count:], log_std_optimiser, lr)
    return True, loss, beyond * share


@_compiled
def surrogates(actor: Network, log_std: Floats, samples: Samples) -> tuple[float, float, float]:
    """E[r A], E[r A_cost] and E_s[KL(pi_old || pi)] over all samples."""
    batch = len(samples.actions)
    mean = evaluate(actor, samples.observations)[0]
    ratio = np.empty(batch, np.float32)
    divergence = _ratios(samples, np.arange(batch), mean, log_std, ratio)
    reward, cost = 0.0, 0.0
    for b in range(batch):
        reward += float(ratio[b]) * float(samples.advantages[b])
        cost += float(ratio[b]) * float(samples.cost_advantages[b])
    return reward / batch, cost / batch, divergence / batch


@_compiled
def surrogate_gradient(
    actor: Network, log_std: Floats, samples: Samples, reward: float, cost: float
) -> Floats:
    """Gradient [P] of reward E[r A] + cost E[r A_cost], network first, then log_std."""
    batch = len(samples.actions)
    total = np.zeros(len(actor.parameters) + len(log_std), np.float32)
    memory = np.empty(_room(actor) * min(batch, _BLOCK), np.float32)
    along, against = np.float32(reward / batch), np.float32(cost / batch)
    for begin in range(0, batch, _BLOCK):
        end = min(begin + _BLOCK, batch)
        x, slopes = samples.observations[begin:end], np.empty(end - begin, np.float32)
        mean = forward(actor, x, memory)
        _ratios(samples, np.arange(begin, end), mean[0], log_std, slopes)
        for b in range(end - begin):
            gain = along * samples.advantages[begin + b]
            slopes[b] *= gain + against * samples.cost_advantages[begin + b]
        _pull(actor, log_std, x, samples.actions[begin:end], memory, mean, slopes, total)
    return total


@_compiled
def hidden_states(actor: Network, x: Floats) -> Floats:
    """Hidden activations at x [B, D], a row for each block, for `fisher_product`."""
    blocks = (len(x) + _BLOCK - 1) // _BLOCK
    memories = np.empty((blocks, _room(actor) * min(len(x), _BLOCK)), np.float32)
    for block in range(blocks):
        forward(actor, x[block * _BLOCK : (block + 1) * _BLOCK], memories[block])
    return memories


@_compiled
def fisher_product(
    actor: Network, log_std: Floats, x: Floats, memories: Floats, v: Floats, damping: float
) -> Floats:
    """(J^T M J + damping I) v, `trust_region.fisher_vector_product`, at x [B, D]; v [P] -> [P]."""
    count, share = len(actor.parameters), np.float32(1.0 / len(x))
    total = np.float32(damping) * v
    weight = share * np.exp(-_2 * log_std)
    for block in range(len(memories)):
        part = x[block * _BLOCK : (block + 1) * _BLOCK]
        moved = tangent(actor, v[:count], part, memories[block])
        for a in range(len(log_std)):
            for b in range(len(part)):
                moved[0, a, b] *= weight[a]
        backward(actor, part, memories[block], moved, total[:count])
    for a in range(len(log_std)):
        total[count + a] += _2 * v[count + a]
    return total
