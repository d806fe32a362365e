"""Learned unsafe sets of the aircraft encounter against the true one, and the best possible ones.

An energy is any function phi(states [N, 3]) -> [N], such as that of a certificate (`of_states`);
its unsafe set is U = {phi > 0} and the collision disc {d < d_min}. Volumes are shares of
`Truth.states`, a Sobol sample of the box in which the environment starts. The *shell* is the truly
unsafe set without the disc: what a certificate has to add to the mere distance.

For the energy family, sigma is known in closed form once k and n are: with
g = d^n + k d_dot, which is -phi at sigma = d_min = 0, phi > 0 is g < (sigma + d_min)^n. Covering a
share of the shell thus asks for (sigma + d_min)^n above that quantile of g, and the least sigma
that does so gives the least volume. `frontier` therefore searches k and n only.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from envs.aircraft import BOX_HIGH, BOX_LOW, AircraftDynamics, observe
from safemr import paper
from safemr.aircraft.reachability.grid import Floats
from safemr.aircraft.reachability.solver import CONSTANT, Solution
from safemr.certificates.certificate import Certificate, EnergyCertificate
from safemr.certificates.energy import energy, magnitude, scaled
from safemr.certificates.families import Values
from safemr.conventions import COVERS
from safemr.errors import UserError
from safemr.learning.evaluation import Acts
from safemr.paper import Zeta
from safemr.tasks import Task, base_of, make_envs, name_of, settings_of, task_settings

Energy = Callable[[Floats], Floats]  # phi of states [..., 3], [...]


def dynamics_of(task: Task) -> AircraftDynamics:
    """The encounter of a task, for the solver and for flights; its traffic may turn otherwise.

    Raises UserError where the solved value would be that of another task.
    """
    if base_of(task) != paper.AIRCRAFT_TASK:
        raise UserError(f"{name_of(task)} is no encounter of two aircraft: it has no true set here")
    (turn,) = CONSTANT.other_turns
    for name, value in task_settings(settings_of(task)).items():
        if name != "other_turn":
            raise UserError(
                f"{name_of(task)}: no true unsafe set is solved for its {name} = {value}"
            )
        turn = float(value)
    if not abs(turn) <= 1:  # what the solver's grid and horizon are made for
        raise UserError(
            f"{name_of(task)}: other_turn = {turn:g}: true unsafe sets are solved for traffic that "
            "turns at most 1 rad/s"
        )
    return replace(CONSTANT, other_turns=(turn,))


@dataclass(frozen=True)
class Truth:
    """The solved value on a Sobol sample of the environment's box."""

    dynamics: AircraftDynamics
    states: Floats  # [N, 3]
    value: Floats  # [N]
    domain: float  # volume of the box [m^2 rad]

    @classmethod
    def sample(cls, solution: Solution, log2_count: int = 19) -> Truth:
        """The first 2^log2_count Sobol points: with 2^19, volumes are right to about 0.02 %."""
        from scipy.stats.qmc import Sobol  # a second, which kept measurements do not need

        low, high = np.array([*BOX_LOW, 0.0]), np.array([*BOX_HIGH, 2 * np.pi])
        unit = Sobol(3, scramble=False).random_base2(log2_count)
        states = low + unit * (high - low)
        return cls(solution.dynamics, states, solution(states), float(np.prod(high - low)))

    def thinned(self, factor: int) -> Truth:
        """The first part of the points, which is a Sobol sample again."""
        count = len(self.states) // factor
        return replace(self, states=self.states[:count], value=self.value[:count])

    @property
    def unsafe(self) -> NDArray[np.bool_]:
        return self.value <= 0

    @property
    def disc(self) -> NDArray[np.bool_]:
        return self.dynamics.separation(self.states) < self.dynamics.d_min

    @property
    def volume(self) -> float:
        """Volume of the true unsafe set [m^2 rad]."""
        return self.domain * float(np.mean(self.unsafe))


def of_states(dynamics: AircraftDynamics, certificate: Certificate) -> Energy:
    """phi of a certificate as a function of the encounter's states."""

    def phi(states: Floats) -> Floats:
        d, d_dot = dynamics.separation(states), dynamics.separation_rate(states)
        seen = observe(states) if certificate.observes else None
        return certificate.phi(d[..., None], d_dot[..., None], dynamics.d_min, seen)

    return phi


def energy_of(
    dynamics: AircraftDynamics, zeta: Sequence[float], length_scale: float = 1.0
) -> Energy:
    """phi of zeta, [sigma, k, n] where it is of no other family, with lengths in units of
    ``length_scale`` [m]."""
    point = zeta if isinstance(zeta, Values) else Zeta(*zeta)
    given = EnergyCertificate("zeta", point, length_scale=length_scale)
    return of_states(dynamics, given)


@dataclass(frozen=True)
class CertificateMetrics:
    """One certificate against the truth; shares are in [0, 1]."""

    volume: float  # of U [m^2 rad]
    volume_ratio: float  # to the true unsafe set
    iou: float  # of U and the true unsafe set
    missed_share: float  # of the shell, not in U
    infeasible_share: float  # of states outside the disc: no turn gives phi' < max(phi, 0)
    infeasible_share_eta: float  # the same with phi' < max(phi - eta, 0)
    leak_share: float  # of {phi <= 0} outside the disc: every turn gives phi' > 0

    @property
    def covers(self) -> bool:
        return self.missed_share <= COVERS


def compare_certificate(
    truth: Truth, phi: Energy, eta: float = 0.1, turns: int = 11
) -> CertificateMetrics:
    """Metrics of ``phi``; ``eta`` is in its units.

    One-step feasibility tries ``turns`` turn rates and lets the traffic reply at its worst.
    """
    dynamics, states = truth.dynamics, truth.states
    outside = ~truth.disc
    now = phi(states)
    claimed = (now > 0) | truth.disc
    shell = truth.unsafe & outside
    both, either = claimed & truth.unsafe, claimed | truth.unsafe
    best = np.full(np.count_nonzero(outside), np.inf)
    for a in np.linspace(-dynamics.turn_limit, dynamics.turn_limit, turns):
        worst = np.full(len(best), -np.inf)
        for b in dynamics.other_turns:
            worst = np.maximum(worst, phi(dynamics.flow(states[outside], a, b)))
        best = np.minimum(best, worst)
    before = now[outside]
    kept = before <= 0
    return CertificateMetrics(
        volume=truth.domain * float(np.mean(claimed)),
        volume_ratio=_ratio(claimed, truth.unsafe),
        iou=_ratio(both, either),
        missed_share=_ratio(shell & ~claimed, shell),
        infeasible_share=float(np.mean(best >= np.maximum(before, 0))),
        infeasible_share_eta=float(np.mean(best >= np.maximum(before - eta, 0))),
        leak_share=_ratio(kept & (best > 0), kept),
    )


def _ratio(part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> float:
    return float(np.count_nonzero(part)) / max(float(np.count_nonzero(whole)), 1.0)


@dataclass(frozen=True)
class ParameterBox:
    """Bounds of zeta that a frontier may use, in units of its length scale."""

    sigma: tuple[float, float]
    k: tuple[float, float]
    n: tuple[float, float]


WIDE_BOX = ParameterBox(sigma=(0.0, 5.0), k=(0.1, 10.0), n=(0.5, 3.0))
JOINT_SIS_BOX = ParameterBox(sigma=(0.0, 1.0), k=(0.5, 3.0), n=(0.1, 2.0))


@dataclass(frozen=True)
class FrontierPoint:
    """The certificate of least volume that misses at most ``missed_share`` of the shell."""

    missed_share: float
    volume_ratio: float  # inf where no certificate of the box covers that much
    zeta: tuple[float, float, float]


def frontier(
    truth: Truth,
    missed_shares: Sequence[float],
    box: ParameterBox = WIDE_BOX,
    length_scale: float = 1.0,
) -> list[FrontierPoint]:
    """The oracle: for each missed share, the least volume over all [sigma, k, n] of ``box``.

    A dense grid over (log k, n) on an eighth of the states, then grids that shrink around its best
    point on all of them; about 3 s a share. Feasibility is not asked for: no member of the family
    is feasible everywhere.
    """
    low, high = np.array([np.log(box.k[0]), box.n[0]]), np.array([np.log(box.k[1]), box.n[1]])
    counts = (25, 26)
    grid = np.stack(
        np.meshgrid(*map(np.linspace, low, high, counts), indexing="ij"), axis=-1
    ).reshape(-1, 2)
    samples = (truth.thinned(8), truth)
    coarse, fine = (_LeastSigma(sample, box, length_scale) for sample in samples)
    shares = np.asarray(missed_shares, float)
    rough = np.array([coarse(place, shares)[0] for place in grid])
    points = []
    for column, share in enumerate(shares):
        place, width = grid[np.argmin(rough[:, column])], (high - low) / np.subtract(counts, 1)
        for _ in range(4):
            offsets = np.stack(np.meshgrid(*2 * [np.linspace(-1, 1, 5)]), axis=-1).reshape(-1, 2)
            near = np.clip(place + offsets * width, low, high)
            ratios, sigmas = np.array([fine(candidate, shares[[column]]) for candidate in near]).T[
                0
            ]
            best = int(np.argmin(ratios))
            place, width = near[best], width / 2
        zeta = float(sigmas[best]), float(np.exp(place[0])), float(place[1])
        points.append(FrontierPoint(float(share), float(ratios[best]), zeta))
    return points


class _LeastSigma:
    """For (log k, n), the least sigma that covers enough of the shell, and the volume it takes."""

    def __init__(self, truth: Truth, box: ParameterBox, length_scale: float) -> None:
        dynamics, outside = truth.dynamics, ~truth.disc
        states = truth.states[outside]
        self.d, self.d_dot, self.d_min = scaled(
            dynamics.separation(states),
            dynamics.separation_rate(states),
            dynamics.d_min,
            length_scale,
        )
        self.shell = truth.unsafe[outside]
        self.disc_count = np.count_nonzero(truth.disc)
        self.true_count = np.count_nonzero(truth.unsafe)
        self.sigma_box = box.sigma

    def __call__(self, place: Floats, missed_shares: Floats) -> tuple[Floats, Floats]:
        """Volume ratios (inf where sigma would leave the box) and sigmas, one per missed share."""
        k, n = np.exp(place[0]), place[1]
        g = -energy(self.d, self.d_dot, 0.0, 0.0, k, n)
        ascending = np.sort(g[self.shell])
        missed = np.floor(missed_shares * len(ascending)).astype(int)
        needed = np.maximum(
            ascending[len(ascending) - 1 - np.minimum(missed, len(ascending) - 1)], 0
        )
        # The small addition makes the inequality strict after rounding.
        sigmas = np.maximum(needed ** (1 / n) * (1 + 1e-12) - self.d_min, self.sigma_box[0])
        volumes = [np.count_nonzero(g < magnitude(self.d_min, s, k, n, 1.0, 0.0)) for s in sigmas]
        ratios = (np.array(volumes) + self.disc_count) / self.true_count
        return np.where(sigmas <= self.sigma_box[1], ratios, np.inf), sigmas


@dataclass(frozen=True)
class Flights:
    """Closed-loop flights of one policy, one entry [N] per start."""

    collided: NDArray[np.bool_]
    effort: Floats  # sum of a^2 over the flight
    steps: NDArray[np.int64]
    least_separation: Floats  # [m], at control times

    def summary(self) -> dict[str, float]:
        """Number and share of collisions, effort per flight and per step, least separation."""
        return {
            "collisions": float(np.count_nonzero(self.collided)),
            "collision_share": float(np.mean(self.collided)),
            "effort": float(np.mean(self.effort)),
            "effort_per_step": float(self.effort.sum() / self.steps.sum()),
            "least_separation": float(self.least_separation.min()),
        }


def safe_starts(solution: Solution, count: int, seed: int, margin: float = 0.0) -> Floats:
    """States [count, 3], uniform in the environment's box where V > ``margin``."""
    generator = np.random.default_rng(seed)
    low, high = [*BOX_LOW, 0.0], [*BOX_HIGH, 2 * np.pi]
    kept = np.empty((0, 3))
    while len(kept) < count:
        drawn = generator.uniform(low, high, (count, 3))
        kept = np.concatenate([kept, drawn[solution(drawn) > margin]])
    return kept[:count]


def fly(policy: Acts, starts: Floats, dynamics: AircraftDynamics) -> Flights:
    """One episode of `Aircraft-v0` from each of ``starts`` [N, 3] under the deterministic policy.

    Raises ValueError for adversarial traffic, which the environment does not fly.
    """
    if len(dynamics.other_turns) != 1:
        raise ValueError("flights need traffic of constant turn rate")
    settings = {"other_turn": dynamics.other_turns[0]}
    envs = make_envs({"name": paper.AIRCRAFT_TASK, "settings": settings}, len(starts))
    observations, infos = envs.reset(options={"state": starts})
    running = np.ones(len(starts), bool)
    collided, effort = np.zeros(len(starts), bool), np.zeros(len(starts))
    steps, least = np.zeros(len(starts), np.int64), infos["d"][:, 0].copy()
    action_repeat = getattr(policy, "action_repeat", 1)
    for step in itertools.count():
        if not running.any():
            break
        if step % action_repeat == 0:
            actions = policy.act(observations, deterministic=True)
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        d = infos["d"][:, 0].copy()
        if "final_info" in infos:
            ended = infos["_final_info"]
            d[ended] = infos["final_info"]["d"][ended, 0]
        least[running] = np.minimum(least, d)[running]
        effort[running] -= rewards[running]
        steps[running] += 1
        collided |= running & (d < dynamics.d_min)
        running &= ~(terminated | truncated)
    envs.close()
    return Flights(collided, effort, steps, least)


class OptimalEvader:
    """The solved value as a policy: straight flight while that keeps V above ``margin`` [m].

    The reference for trained policies: by the truth it never collides from a safe state, and it
    turns only when it must.
    """

    def __init__(self, solution: Solution, margin: float = 0.1) -> None:
        self.solution, self.margin = solution, margin

    def act(self, observations: Floats, deterministic: bool = True) -> NDArray[np.float32]:
        """Turn rates [N, 1] for observations [N, 4]; there is nothing random about them."""
        x, y, cos, sin = observations.T
        states = np.stack([x, y, np.arctan2(sin, cos)], axis=-1)
        straight = self.solution.worst_next(states, 0.0) > self.margin
        turns = np.where(straight, 0.0, self.solution.evade(states))
        return turns[:, None].astype(np.float32)
