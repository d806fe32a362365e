"""SafeMR in one file, from the environment to the gradient, in plain PyTorch.

    python examples/safemr_minimal.py --task Pillars-0.15-Goal --steps 100000 --seed 100

Read it from top to bottom: the equations, by their labels in the paper's source, then networks,
memory and observations, then `train`, which is Algorithm 1. It imports nothing of `safemr`;
tests/test_minimal.py holds that it takes the same steps as `safemr train --set backend=torch`,
which adds variants, records, resuming and, by default, compiled kernels.

Shapes: B transitions, N environments, M obstacles, D numbers observed, A numbers of an action.
"""

from __future__ import annotations

import argparse
import copy
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn

TASKS = ("Pillars-0.15-Goal", "Pillars-0.30-Goal", "Hazards-0.15-Push", "Hazards-0.30-Push")


@dataclass(frozen=True)
class Config:
    # zeta = [sigma, k, n] starts at `zeta` and stays in the box from `low` to `high`; metres
    zeta: tuple[float, float, float] = (0.3, 1.0, 2.0)
    low: tuple[float, float, float] = (0.05, 0.1, 0.1)
    high: tuple[float, float, float] = (1.0, 3.0, 4.0)
    a: float = 0.35  # weight of (sigma + d_min)^n
    b: float = 0.15  # weight of k
    eta: float = 0.0  # eta_D, by which phi is to fall in a step
    constraint_floor: float = -0.001  # far from danger g is so negative that lambda would die
    constraint_scale: float = 10.0  # Q_phi learns 10 g, so that its errors count beside Q_w's
    certificate_travel: float = 0.33  # sum of zeta's learning rates, which fall linearly to 0
    certificate_start: float = 0.05  # share of the gradient steps before zeta moves
    multiplier_bias: float = -3.0  # lambda starts near softplus(-3) = 0.05
    multiplier_cap: float = 100.0  # largest lambda
    multiplier_lr: float = 3e-4
    multiplier_grad_norm: float = 3.0  # its gradient is clipped to this norm
    gamma: float = 0.99
    n_step: int = 5  # rewards summed before the bootstrap
    polyak: float = 0.005  # share by which the target critics follow in a gradient step
    critic_lr: float = 1e-3
    policy_lr: float = 1e-3
    temperature_lr: float = 3e-4
    initial_log_temperature: float = -4.0
    target_entropy: float = -2.0
    lr_final: float = 0.1  # these learning rates fall linearly to this share
    hidden: int = 64
    policy_delay: int = 2  # m_pi: gradient steps for one of the policy
    multiplier_delay: int = 4  # m_lambda
    certificate_delay: int = 16  # m_phi: zeta moves slowest, so that the others can follow it
    num_envs: int = 16
    update_every: int = 8  # environment steps per gradient step
    updates_together: int = 4  # gradient steps that share one draw and its targets
    batch_size: int = 256
    replay_capacity: int = 500_000
    start_steps: int = 5_000  # random actions first, without learning
    start_hold: int = 10  # time steps for which each is held: shorter ones get the robot nowhere


class Batch(NamedTuple):
    observations: Tensor  # [B, D] of the state s
    actions: Tensor  # [B, A]
    d: Tensor  # [B, M] in s, distance of the robot's centre to an obstacle's [m]
    d_dot: Tensor  # [B, M] its rate [m/s]
    d_next: Tensor  # [B, M] the same in the next state s'
    d_dot_next: Tensor
    returns: Tensor  # [B] R^(m) = sum_{i<m} gamma^i r_{t+i}
    discounts: Tensor  # [B] gamma^m, 0 after a termination
    bootstraps: Tensor  # [B, D] observations m steps ahead


def energy(d: Tensor, d_dot: Tensor, d_min: float, zeta: Tensor) -> Tensor:
    """phi(s) = max over obstacles of (sigma + d_min)^n - d^n - k d_dot (Eq. sis), [B]."""
    sigma, k, n = zeta
    return ((sigma + d_min) ** n - d**n - k * d_dot).amax(-1)


def constraint(batch: Batch, d_min: float, zeta: Tensor, c: Config) -> Tensor:
    """max(g, floor) of g(s, a) = phi(s') - max(phi(s) - eta_D, 0) (Eq. cstr0), [B].

    From the stored distances, because zeta moves while the memory stays; differentiable in zeta.
    """
    phi = energy(batch.d, batch.d_dot, d_min, zeta)
    phi_next = energy(batch.d_next, batch.d_dot_next, d_min, zeta)
    return (phi_next - (phi - c.eta).relu()).clamp_min(c.constraint_floor)


def policy_loss(log_pi: Tensor, q: Tensor, q_phi: Tensor, lam: Tensor, alpha: Tensor) -> Tensor:
    """J_pi = E[alpha log pi(a|s) - min_j Q_wj(s, a) + lambda(s) Q_phi(s, a)] (Eq. losspi)."""
    return (alpha * log_pi - q.amin(0) + lam * q_phi).mean()


def multiplier_loss(lam: Tensor, q_phi: Tensor) -> Tensor:
    """-E[lambda(s) Q_phi(s, a)] at the policy's actions. Descending it is Algorithm 1's ascent:
    lambda rises where these actions break the constraint, and falls elsewhere."""
    return -(lam * q_phi).mean()


def certificate_loss(batch: Batch, lam: Tensor, d_min: float, zeta: Tensor, c: Config) -> Tensor:
    """E[lambda(s) g(s, a)] (Eq. SL2) + a (sigma + d_min)^n + b k (Eq. sisadd): Eq. SL2add.

    The first term moves zeta to where the policy can keep the constraint; the second, the magnitude
    of phi, keeps small the set phi > 0 of states in which the policy is held back.
    """
    sigma, k, n = zeta
    lagrangian = (lam * constraint(batch, d_min, zeta, c)).mean()
    return lagrangian + c.a * (sigma + d_min) ** n + c.b * k


def perceptrons(
    count: int, inputs: int, hidden: int, outputs: int, rng: torch.Generator, gain: float = 1.0
) -> nn.ModuleList:
    """``count`` networks with two hidden layers; ``gain`` is that of the last layer."""
    widths = ((inputs, hidden), (hidden, hidden), (hidden, outputs))
    levels = [[nn.Linear(*width) for _ in range(count)] for width in widths]
    for level, layers in enumerate(levels):
        for layer in layers:
            nn.init.orthogonal_(layer.weight, gain if level == 2 else math.sqrt(2.0), rng)
            nn.init.zeros_(layer.bias)
    members = zip(*levels, strict=True)
    return nn.ModuleList(nn.Sequential(a, nn.ReLU(), b, nn.ReLU(), c) for a, b, c in members)


def values(networks: Iterable[nn.Module], observations: Tensor, actions: Tensor) -> Tensor:
    """Q(s, a) of every network, [number, B]."""
    pairs = torch.cat((observations, actions), 1)
    return torch.stack([network(pairs)[:, 0] for network in networks])


def squashed_gaussian(output: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Action a = tanh(u), u ~ N(mean, std^2), [B, A], and log pi(a|s), [B]."""
    mean, log_std = output.chunk(2, -1)
    log_std = log_std.clamp(-20.0, 2.0)
    u = mean + log_std.exp() * noise
    log_normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2.0 * math.pi)
    # log da/du = log(1 - tanh(u)^2), in a form that is exact also where tanh saturates
    log_slope = 2.0 * (math.log(2.0) - u - nn.functional.softplus(-2.0 * u))
    return u.tanh(), (log_normal - log_slope).sum(-1)


def descend(optimiser: torch.optim.Optimizer, loss: Tensor, max_norm: float = math.inf) -> None:
    """One step on ``loss``, differentiated in the optimiser's own parameters only."""
    parameters = optimiser.param_groups[0]["params"]
    optimiser.zero_grad()
    loss.backward(inputs=parameters)
    if max_norm < math.inf:
        nn.utils.clip_grad_norm_(parameters, max_norm)
    optimiser.step()


class Replay:
    """A ring of the last ``capacity`` time steps of N environments."""

    def __init__(self, capacity: int, gamma: float, n_step: int) -> None:
        self.capacity, self.gamma, self.n_step = capacity, gamma, n_step
        self.head = self.size = 0
        self.fields: dict[str, Tensor] = {}

    def add(self, **step: Tensor) -> None:
        """One time step; every field [N, ...]."""
        for name, value in step.items():
            if name not in self.fields:
                self.fields[name] = torch.zeros(self.capacity, *value.shape)
            self.fields[name][self.head] = value
        self.head = (self.head + 1) % self.capacity
        self.size = min(self.size + 1, self.capacity)

    def sample(self, count: int, rng: torch.Generator) -> Batch:
        """Uniform with replacement; a return stops where its episode or the memory ends."""
        fields, num_envs = self.fields, self.fields["rewards"].shape[1]
        drawn = torch.randint(self.size * num_envs, (count,), generator=rng)
        age, env = drawn // num_envs, drawn % num_envs  # age 0 is the oldest time step
        first = last = (self.head - self.size + age) % self.capacity
        returns, discounts = fields["rewards"][first, env], torch.full((count,), self.gamma)
        goes_on = torch.ones(count, dtype=torch.bool)
        for lag in range(1, self.n_step):
            goes_on = goes_on & (fields["ended"][last, env] == 0) & (age + lag < self.size)
            last = torch.where(goes_on, (last + 1) % self.capacity, last)
            returns = returns + goes_on * self.gamma**lag * fields["rewards"][last, env]
            discounts = torch.where(goes_on, self.gamma ** (lag + 1), discounts)
        discounts = discounts * (1.0 - fields["terminated"][last, env])
        bootstraps = fields["next_observations"][last, env]
        stored = (fields[name][first, env] for name in Batch._fields[:6])
        return Batch(*stored, returns, discounts, bootstraps)


# Sensor: the columns that mean something for a robot in the plane, their scale and clip; the others
# are read as they are. Constants, not running statistics: evaluation reads what training read.
SENSORS = {
    "accelerometer": ((0, 1), 0.1, 1.0),  # contacts throw it and the gyro far out of their range
    "gyro": ((2,), 0.3, 2.0),
    "magnetometer": ((0, 1), 2.0, math.inf),
    "velocimeter": ((0, 1), 1.0, math.inf),
    "vases_lidar": ((), 1.0, math.inf),  # of vases that are not there
}


def observe(envs: Any, observations: np.ndarray, infos: dict[str, Any]) -> tuple[Tensor, ...]:
    """What the networks see, [N, D], and d and d_dot, of which phi is made, [N, M]."""
    parts = []
    for name, block in envs.observation_layout.items():
        everything = range(block.stop - block.start)
        columns, scale, clip = SENSORS.get(name, (everything, 1.0, math.inf))
        values = observations[:, block][:, list(columns)].astype(np.float32) * np.float32(scale)
        parts.append(values.clip(-clip, clip))
    arrays = (np.concatenate(parts, 1), infos["d"], infos["d_dot"])
    return tuple(torch.from_numpy(array.astype(np.float32)) for array in arrays)


def train(c: Config, envs: Any, seed: int, total_steps: int) -> Iterator[tuple[int, Any, Any, Any]]:
    """Trains for ``total_steps`` environment steps.

    Yields after each time step: environment steps done, policy, zeta and the latest losses.
    """
    # Random numbers of one purpose must not depend on how many were drawn for another.
    words = [np.random.SeedSequence([seed, i]).generate_state(1, np.uint64)[0] for i in range(4)]
    rngs = [torch.Generator().manual_seed(int(word >> np.uint64(1))) for word in words]
    initial_rng, noise_rng, replay_rng, start_rng = rngs
    first_layout = int(np.random.SeedSequence([seed, 4]).generate_state(1)[0] >> 1)

    state = observe(envs, *envs.reset(seed=first_layout))
    observed, action_dim = state[0].shape[1], envs.single_action_space.shape[0]
    critics = perceptrons(3, observed + action_dim, c.hidden, 1, initial_rng)  # Q_w1, Q_w2, Q_phi
    targets = copy.deepcopy(critics[:2])
    (policy,) = perceptrons(1, observed, c.hidden, 2 * action_dim, initial_rng, gain=0.1)
    (multiplier,) = perceptrons(1, observed, c.hidden, 1, initial_rng, gain=0.1)
    nn.init.constant_(multiplier[-1].bias, c.multiplier_bias)
    log_alpha = torch.tensor(c.initial_log_temperature, requires_grad=True)
    zeta, low, high = map(torch.tensor, (c.zeta, c.low, c.high))
    critic_adam = torch.optim.Adam(critics.parameters(), c.critic_lr)
    policy_adam = torch.optim.Adam(policy.parameters(), c.policy_lr)
    multiplier_adam = torch.optim.Adam(multiplier.parameters(), c.multiplier_lr)
    alpha_adam = torch.optim.Adam([log_alpha], c.temperature_lr)

    def act(observations: Tensor) -> tuple[Tensor, Tensor]:
        noise = torch.randn((len(observations), action_dim), generator=noise_rng)
        return squashed_gaussian(policy(observations), noise)

    def lam(observations: Tensor) -> Tensor:
        return nn.functional.softplus(multiplier(observations)[:, 0]).clamp_max(c.multiplier_cap)

    replay = Replay(max(c.replay_capacity // c.num_envs, c.n_step), c.gamma, c.n_step)
    action, losses = torch.zeros(c.num_envs, action_dim), {}
    step, updates, owed = 0, 0, 0.0  # owed: gradient steps earned by experience, not yet done
    total = max((total_steps - c.start_steps) // c.update_every, 1)  # updates of the whole run
    still = int(c.certificate_start * total)  # those before zeta moves
    zeta_lr = 2.0 * c.certificate_travel / max((total - still) // c.certificate_delay, 1)
    while step < total_steps:
        # One time step of every environment
        if step >= c.start_steps:
            with torch.no_grad():
                action, _ = act(state[0])
        elif step % (c.start_hold * c.num_envs) == 0:
            action = torch.empty_like(action).uniform_(-1.0, 1.0, generator=start_rng)
        raw, rewards, terminated, truncated, infos = envs.step(action.numpy())
        before, state = state, observe(envs, raw, infos)
        after, ended = state, torch.from_numpy(terminated | truncated)
        if ended.any():  # there `state` begins the next episode, and the transition ends the old
            final = observe(envs, infos["final_obs"], infos["final_info"])
            pairs = zip(final, state, strict=True)
            after = tuple(torch.where(ended[:, None], old, new) for old, new in pairs)
        names = ("observations", "d", "d_dot", "next_observations", "d_next", "d_dot_next")
        replay.add(
            **dict(zip(names, before + after, strict=True)),
            actions=action,
            rewards=torch.from_numpy(rewards),
            terminated=torch.from_numpy(terminated),
            ended=ended,
        )
        step += c.num_envs

        # Gradient steps (Algorithm 1), as many as that experience has earned
        owed += c.num_envs / c.update_every if step >= c.start_steps else 0.0
        if owed >= c.updates_together:
            count = int(owed)
            owed -= count
            drawn = replay.sample(count * c.batch_size, replay_rng)
            batches = map(Batch._make, zip(*(x.chunk(count) for x in drawn), strict=True))
            # The critics' targets, formed once for all of these steps: the target networks move
            # 0.5% a step, and one large product costs less than several small ones.
            with torch.no_grad():
                next_action, log_pi = act(drawn.bootstraps)
                q_next = values(targets, drawn.bootstraps, next_action).amin(0)
                y = drawn.returns + drawn.discounts * (q_next - log_alpha.exp() * log_pi)
                # Q_phi has no bootstrap: the constraint is about one step.
                y_phi = c.constraint_scale * constraint(drawn, envs.d_min, zeta, c)
                ys = torch.stack((y, y, y_phi)).chunk(count, 1)
            for batch, target in zip(batches, ys, strict=True):
                share = 1.0 - (1.0 - c.lr_final) * min(updates / total, 1.0)
                for adam in (critic_adam, policy_adam, multiplier_adam, alpha_adam):
                    adam.param_groups[0]["lr"] = adam.defaults["lr"] * share
                updates += 1
                q = values(critics, batch.observations, batch.actions)
                losses["critic"] = (q - target).square().mean(1).sum()
                descend(critic_adam, losses["critic"])
                if updates % c.policy_delay == 0:
                    new_action, log_pi = act(batch.observations)
                    q = values(critics, batch.observations, new_action)
                    q_phi, multipliers = q[2] / c.constraint_scale, lam(batch.observations)
                    alpha = log_alpha.detach().exp()
                    losses["policy"] = policy_loss(
                        log_pi, q[:2], q_phi, multipliers.detach(), alpha
                    )
                    descend(policy_adam, losses["policy"])
                    # alpha rises where the policy has less than the target entropy
                    excess = -log_pi.detach().mean() - c.target_entropy
                    descend(alpha_adam, log_alpha * excess)
                    if updates % c.multiplier_delay == 0:
                        losses["multiplier"] = multiplier_loss(multipliers, q_phi.detach())
                        descend(multiplier_adam, losses["multiplier"], c.multiplier_grad_norm)
                if updates % c.certificate_delay == 0 and updates > still:
                    # A projected gradient step; not Adam's, which moves every parameter at one
                    # speed and so hides what the loss says. Its rate falls linearly to 0.
                    at = zeta.clone().requires_grad_(True)
                    multipliers = lam(batch.observations).detach()
                    losses["certificate"] = certificate_loss(batch, multipliers, envs.d_min, at, c)
                    (gradient,) = torch.autograd.grad(losses["certificate"], at)
                    rate = zeta_lr * max((total - updates) / (total - still), 0.0)
                    zeta = (zeta - rate * gradient).clamp(low, high)
            with torch.no_grad():
                rate = 1.0 - (1.0 - c.polyak) ** count
                for old, new in zip(targets.parameters(), critics[:2].parameters(), strict=True):
                    old.lerp_(new, rate)
        yield step, policy, zeta, losses


@torch.no_grad()
def evaluate(policy: nn.Module, envs: Any, seed: int = 10_000) -> dict[str, float]:
    """An episode of the policy without noise in every environment, each time in equal layouts."""
    state = observe(envs, *envs.reset(seed=seed))
    returns, violations = np.zeros((2, envs.num_envs))
    running = np.ones(envs.num_envs, bool)
    while running.any():
        action = policy(state[0]).chunk(2, -1)[0].tanh()
        observations, rewards, terminated, truncated, infos = envs.step(action.numpy())
        returns += running * rewards
        violations += running * infos["cost_indicator"]
        running &= ~(terminated | truncated)
        state = observe(envs, observations, infos)
    means = {"return": returns, "violating steps": violations, "clean episodes": violations == 0}
    return {name: float(each.mean()) for name, each in means.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains SafeMR; all else is edited in Config.")
    parser.add_argument("--task", choices=TASKS, default=TASKS[0])
    parser.add_argument("--steps", type=int, default=100_000, help="environment steps")
    parser.add_argument("--seed", type=int, default=100)
    given, c = parser.parse_args(), Config()
    if given.steps <= c.start_steps or given.seed < 0:
        parser.error(f"--steps must exceed the {c.start_steps} random ones, and --seed be >= 0")
    torch.set_num_threads(1)  # at these sizes a second thread only waits for the first
    # The prefix has Gymnasium import the package `envs`, which registers the tasks.
    task, mode = f"envs:{given.task}-v0", "vector_entry_point"
    training_envs, evaluation_envs = (gymnasium.make_vec(task, n, mode) for n in (c.num_envs, 10))
    lines = 0
    for step, policy, zeta, losses in train(c, training_envs, given.seed, given.steps):
        if step * 20 // given.steps > lines:
            lines = step * 20 // given.steps
            numbers = evaluate(policy, evaluation_envs)
            numbers |= dict(zip(("sigma", "k", "n"), zeta.tolist(), strict=True))
            numbers |= {f"{name} loss": loss.item() for name, loss in losses.items()}
            text = " | ".join(f"{name} {number:.3f}" for name, number in numbers.items())
            print(f"{step:>7} | {text}", flush=True)


if __name__ == "__main__":
    main()
