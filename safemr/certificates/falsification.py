"""Falsification of a certificate: a dense, seeded search for states without a safe action.

A state violates feasibility when no action of a stated grid satisfies Eq. cstr0,
phi(s') - max(phi(s) - eta_D, 0) < 0, s' being the state a decision later: an action is held for
``action_repeat`` control steps, one where nothing else is said. A state found is a proof (up to the
grid) and can be replayed; not finding one proves nothing. The search runs on `PointRobot`, the
worst states are confirmed in the simulator through the environment's public interface.

States: one obstacle at the origin, the robot at distance d on the -x axis, all other objects far
away. Five numbers describe such a state of the point robot completely: distance, bearing (angle
from the nose to the obstacle), course (angle from the obstacle's direction to the velocity), speed
and turn rate. The search covers d from d_min to where phi < 0 at any speed (of held actions,
as much farther as the robot gets in the steps after the first), all angles, and the speeds and turn
rates that the actuators reach; states in which the nose is inside a solid obstacle are left out.
Not every state of this box can be reached by driving, so the shares describe the certificate, not
an episode; `safemr.measure.policy_check` counts what happens in episodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safemr.certificates.energy import constraint, largest
from safemr.certificates.families import PAPER, Parameters, family_of, named, phi_at
from safemr.certificates.point_robot import ROBOT
from safemr.errors import UserError
from safemr.tasks import Task, base_of, make_envs, name_of, settings_of, task_settings, traits

Array = NDArray[np.float64]
Worlds = Mapping[str, NDArray[Any]]  # `envs.get_state()["worlds"]`: arrays with one row a world

COLUMNS = ("distance", "bearing", "course", "speed", "turn_rate")
FAR_AWAY = 100.0  # m, where the objects stand that play no part

# The action grid: thrust saturates at |a0| = 0.05, so a0 is gridded inside that. The yaw torque is
# limited too and varies only for a1 within 0.05 of 0.3 psi_dot; there a1 is gridded densely, beside
# a uniform grid over [-1, 1].
THRUSTS = np.array([-0.05, -0.025, 0.0, 0.025, 0.05])
TURNS = np.linspace(-1.0, 1.0, 11)
SERVO_OFFSETS = np.linspace(-0.06, 0.06, 9)

KEPT, CHILDREN = 32, 32  # refinement: worst states kept, perturbations of each
CHUNK = 256  # states evaluated at once: what a processor's cache holds, twice as fast as 4,096


def action_grid(turn_rates: Array, action_scale: Sequence[float] = ()) -> Array:
    """[S, A, 2] thrusts combined with uniform turns and turns about the servo's zero torque.

    ``action_scale``: bounds of the two components for who cannot do more; empty: none.
    """
    near = ROBOT.servo_gain * turn_rates[:, None] + SERVO_OFFSETS
    uniform = np.broadcast_to(TURNS, (len(turn_rates), len(TURNS)))
    turns = np.clip(np.concatenate([uniform, near], 1), -1, 1)
    shape = (len(turn_rates), len(THRUSTS), turns.shape[1])
    thrusts = np.broadcast_to(THRUSTS[None, :, None], shape)
    grid = np.stack([thrusts, np.broadcast_to(turns[:, None], shape)], -1)
    grid = grid.reshape(len(turn_rates), -1, 2)
    return np.clip(grid, -np.array(action_scale), action_scale) if action_scale else grid


def energies(states: Array, d_min: float, zeta: Parameters) -> Array:
    """phi(s) [S] of states [S, 5]."""
    return phi_at(states[:, 0], -states[:, 3] * np.cos(states[:, 2]), d_min, zeta)


def grid_margins(
    states: Array,
    d_min: float,
    zeta: Parameters,
    eta: float,
    action_repeat: int = 1,
    action_scale: Sequence[float] = (),
) -> Array:
    """g = phi(s') - max(phi(s) - eta, 0) [S, A] for every action of the grid, by the model.

    s' is ``action_repeat`` control steps after s.
    """
    actions = action_grid(states[:, 4], action_scale)
    count = actions.shape[1]
    pose, velocity = (np.repeat(part, count, 0) for part in _robot(states))
    for _ in range(action_repeat):
        pose, velocity = ROBOT.step(pose, velocity, actions.reshape(-1, 2))
    d = np.hypot(pose[:, 0], pose[:, 1])
    d_dot = (pose[:, 0] * velocity[:, 0] + pose[:, 1] * velocity[:, 1]) / d
    phi_next = phi_at(d, d_dot, d_min, zeta).reshape(len(states), count)
    return constraint(energies(states, d_min, zeta)[:, None], phi_next, eta)


# --- (b) the search ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Falsification:
    """Result of a search; shares are of the sampled states, uniform in the five coordinates."""

    task: Task
    zeta: Parameters
    eta: float
    states: Array  # [S, 5]
    phi: Array  # [S]
    margin: Array  # [S] least g over the grid; >= 0: no safe action
    worst_state: Array  # [5] after refinement
    worst_margin: float  # in the simulator
    confirmed: int  # of `examined` worst and random states, verdicts that the simulator shares
    examined: int
    action_repeat: int = 1  # control steps for which an action was held
    action_scale: tuple[float, ...] = ()  # bounds of the action grid

    @property
    def infeasible(self) -> NDArray[np.bool_]:
        return self.margin >= 0

    @property
    def infeasible_share(self) -> float:
        """Share of all states without a safe action."""
        return float(self.infeasible.mean())

    @property
    def leak_share(self) -> float:
        """Share of the states with phi <= 0 that leave the safe set whatever the action."""
        inside = self.phi <= 0
        return float(self.infeasible[inside].mean()) if inside.any() else float("nan")

    def example(self) -> dict[str, Any]:
        """The worst state as plain numbers, enough for `replay`.

        What is not said of the task (base, settings) is that of the registered one; without family
        it is the paper's; without action_repeat an action lasts one control step, without
        action_scale the grid is whole.
        """
        state = dict(zip(COLUMNS, map(float, self.worst_state), strict=True))
        name, base = name_of(self.task), base_of(self.task)
        changed = task_settings(settings_of(self.task))
        task: dict[str, Any] = {"task": name}
        task |= {"base": base} if base != name else {}
        task |= {"settings": changed} if changed else {}
        held: dict[str, Any] = {}
        held |= {"action_repeat": self.action_repeat} if self.action_repeat != 1 else {}
        held |= {"action_scale": list(self.action_scale)} if self.action_scale else {}
        family = {} if family_of(self.zeta) is PAPER else {"family": family_of(self.zeta).name}
        return {**task, **family, **self.zeta._asdict(), "eta": self.eta, **held, "state": state,
                "margin": self.worst_margin}  # fmt: skip


def falsify(
    envs: Any,
    task: Task,
    zeta: Parameters,
    *,
    eta: float = 0.0,
    count: int = 2**16,
    seed: int = 0,
    rounds: int = 12,
    action_repeat: int = 1,
    action_scale: Sequence[float] = (),
) -> Falsification:
    """Search `count` Sobol states, refine the worst, confirm in the simulator.

    envs: `make_simulator` of ``task``. Actions of `action_grid` are held for ``action_repeat``
    control steps. Each round of the refinement perturbs the worst states, with
    smaller steps than the last, and keeps what is worse. Raises UserError where phi stays positive
    far from the obstacle, so that the box of states has no end, or where an episode is shorter than
    a decision.
    """
    from scipy.stats import qmc  # a second, which kept measurements do not need

    d_min, held = float(envs.d_min), (action_repeat, tuple(action_scale))
    bounds = np.array(
        [(d_min, largest_distance(zeta, d_min, action_repeat)), (-np.pi, np.pi), (-np.pi, np.pi),
         (0.0, ROBOT.max_speed), (-ROBOT.max_turn_rate, ROBOT.max_turn_rate)]
    )  # fmt: skip

    def least(states: Array) -> Array:
        parts = np.array_split(states, max(1, len(states) // CHUNK))
        return np.concatenate(
            [grid_margins(part, d_min, zeta, eta, *held).min(1) for part in parts]
        )

    sampler = qmc.Sobol(len(bounds), rng=np.random.default_rng(seed))
    states = qmc.scale(sampler.random(count), *bounds.T)
    states = states[~overlaps_obstacle(envs, states)]
    margin = least(states)
    generator = np.random.default_rng(seed + 1)
    order = np.argsort(-margin)[:KEPT]
    worst, values = states[order], margin[order]
    for step in 0.1 * 0.7 ** np.arange(rounds):
        parents = np.repeat(worst, CHILDREN, 0)
        noise = step * np.ptp(bounds, axis=1) * generator.normal(size=parents.shape)
        trial = np.clip(parents + noise, *bounds.T)
        trial = trial[~overlaps_obstacle(envs, trial)]
        worst, values = np.concatenate([worst, trial]), np.concatenate([values, least(trial)])
        order = np.argsort(-values)[:KEPT]
        worst, values = worst[order], values[order]
    examined = np.concatenate([worst, states[generator.integers(len(states), size=KEPT)]])
    simulated = simulated_margins(envs, examined, zeta, eta, *held)
    agree = (simulated >= 0) == (least(examined) >= 0)
    top = int(simulated.argmax())
    return Falsification(
        task=task, zeta=zeta, eta=eta, states=states, phi=energies(states, d_min, zeta),
        margin=margin, worst_state=examined[top], worst_margin=float(simulated[top]),
        confirmed=int(agree.sum()), examined=len(examined),
        action_repeat=action_repeat, action_scale=tuple(action_scale),
    )  # fmt: skip


# What makes the unsafe set smaller, of another family than the paper's and of the paper's.
_SMALLER = ("parameters of a smaller unsafe set", "a smaller sigma or k, or a larger n")


def largest_distance(zeta: Parameters, d_min: float, action_repeat: int = 1) -> float:
    """Distance beyond which phi < 0 even at full closing speed, and at least 1.5 d_min, m.

    The zero of phi(d, -v_max), found by bisection of phi, which falls with d, and the way that
    is driven in the control steps of a decision after its first: from there too it may end in
    phi > 0.
    """
    low, high = d_min, d_min + 20.0
    if phi_at(high, -ROBOT.max_speed, d_min, zeta) > 0:
        raise UserError(
            f"phi is positive {high:.1f} m from the obstacle for {', '.join(zeta._asdict())} = "
            f"{tuple(zeta)}: no bounded search covers it; use {_SMALLER[family_of(zeta) is PAPER]}"
        )
    for _ in range(60):
        middle = (low + high) / 2
        positive = phi_at(middle, -ROBOT.max_speed, d_min, zeta) > 0
        low, high = (middle, high) if positive else (low, middle)
    return max(high, 1.5 * d_min) + (action_repeat - 1) * ROBOT.max_speed * ROBOT.step_s


def overlaps_obstacle(envs: Any, states: Array) -> NDArray[np.bool_]:
    """[S] whether the nose (a box ahead of the sphere) is inside a solid obstacle."""
    if not envs.task.solid_obstacles:
        return np.zeros(len(states), bool)
    distance, bearing = states[:, 0], states[:, 1]
    along = np.abs(distance * np.cos(bearing) - ROBOT.nose_centre) - ROBOT.nose_half
    across = np.abs(distance * np.sin(bearing)) - ROBOT.nose_half
    return np.hypot(np.maximum(along, 0), np.maximum(across, 0)) < envs.task.obstacle_size


# --- the simulator -------------------------------------------------------------------------------


def make_simulator(task: Task, num_envs: int = 128) -> Any:
    """The task's batched environment. Raises UserError for a task without the point robot."""
    envs = make_envs(task, num_envs)
    if not traits(envs).point_robot:
        raise UserError(f"falsification needs a task of the point robot; {name_of(task)} is none")
    envs.reset(seed=0)
    return envs


def worlds_near_obstacle(envs: Any, states: Array) -> dict[str, NDArray[Any]]:
    """States [S, 5] as the simulator's worlds; one obstacle at the origin, the rest far away."""
    template = envs.get_state()["worlds"]
    worlds = {name: np.repeat(array[:1], len(states), 0) for name, array in template.items()}
    pose, velocity = _robot(states)
    worlds["start"], worlds["goal"][:] = pose, -FAR_AWAY
    worlds["obstacles"][:], worlds["obstacles"][:, 0] = FAR_AWAY, 0.0
    # The slide joints turn with the body, so joint velocities are in the frame of the start.
    cosine, sine = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    qpos, qvel = worlds["qpos"], worlds["qvel"]
    qpos[:, :3], qvel[:] = 0.0, 0.0
    qvel[:, 0] = cosine * velocity[:, 0] + sine * velocity[:, 1]
    qvel[:, 1] = cosine * velocity[:, 1] - sine * velocity[:, 0]
    qvel[:, 2] = velocity[:, 2]
    if qpos.shape[1] > 3:  # a box: high up, so that it touches nothing meanwhile
        qpos[:, 3:6] = FAR_AWAY
    worlds["warmstart"][:], worlds["control"][:], worlds["asleep"][:] = 0.0, 0.0, -1
    return worlds


def next_energies(
    envs: Any, worlds: Worlds, actions: Array, zeta: Parameters, action_repeat: int = 1
) -> Array:
    """phi(s') [S], the largest over obstacles, of S worlds after holding actions [S, 2].

    Raises UserError where they cannot be held for ``action_repeat`` control steps of an episode.
    """
    if not 1 <= action_repeat <= envs.max_episode_steps:
        raise UserError(
            f"an action cannot be held for {action_repeat} control steps in episodes of "
            f"{envs.max_episode_steps}"
        )
    count, size = len(actions), envs.num_envs
    result = np.empty(count)
    for begin in range(0, count, size):
        rows = np.minimum(np.arange(begin, begin + size), count - 1)  # fill up with the last world
        state = envs.get_state()
        state["worlds"] = {name: array[rows] for name, array in worlds.items()}
        state["steps"][:] = 0
        envs.set_state(state)
        for _ in range(action_repeat):
            infos = envs.step(actions[rows])[-1]
        # Present where the limit is reached by the last of these steps, by all worlds at once.
        infos = infos.get("final_info", infos)
        phi = largest(phi_at(infos["d"], infos["d_dot"], envs.d_min, zeta))
        result[begin : begin + size] = phi[: count - begin]
    return result


def simulated_grid(envs: Any, worlds: Worlds, turn_rates: Array, phi: Array, zeta: Parameters,
                   eta: float, action_repeat: int = 1,
                   action_scale: Sequence[float] = ()) -> tuple[Array, Array]:  # fmt: skip
    """Actions [S, A, 2] of the grid and g [S, A] in the simulator, for S worlds with phi(s) [S]."""
    actions = action_grid(turn_rates, action_scale)
    count = actions.shape[1]
    repeated = {name: np.repeat(array, count, 0) for name, array in worlds.items()}
    phi_next = next_energies(envs, repeated, actions.reshape(-1, 2), zeta, action_repeat)
    return actions, constraint(phi[:, None], phi_next.reshape(len(phi), count), eta)


def simulated_margins(
    envs: Any,
    states: Array,
    zeta: Parameters,
    eta: float,
    action_repeat: int = 1,
    action_scale: Sequence[float] = (),
) -> Array:
    """Least g over the grid [S] in the simulator."""
    held = (action_repeat, action_scale)
    worlds, phi = worlds_near_obstacle(envs, states), energies(states, float(envs.d_min), zeta)
    return simulated_grid(envs, worlds, states[:, 4], phi, zeta, eta, *held)[1].min(1)


def task_of(example: Mapping[str, Any]) -> dict[str, Any]:
    """The task on which an example was found."""
    name = str(example["task"])
    base = {"base": str(example["base"])} if "base" in example else {}
    return {"name": name, "settings": dict(example.get("settings", {})), **base}


def replay(example: Mapping[str, Any]) -> tuple[Array, Array]:
    """Actions [A, 2] of the grid and their g [A], in the simulator, in an example's state.

    They are held for as many control steps as the example says.
    """
    held = int(example.get("action_repeat", 1)), tuple(example.get("action_scale", ()))
    family = named(str(example.get("family", PAPER.name)))
    zeta = family.at([float(example[name]) for name in family.names])
    envs = make_simulator(task_of(example))
    states = np.array([[float(example["state"][name]) for name in COLUMNS]])
    worlds, phi = worlds_near_obstacle(envs, states), energies(states, float(envs.d_min), zeta)
    actions, g = simulated_grid(envs, worlds, states[:, 4], phi, zeta, float(example["eta"]), *held)
    envs.close()
    return actions[0], g[0]


def _robot(states: Array) -> tuple[Array, Array]:
    """World pose [S, 3] and velocity [S, 3] of the robot in states [S, 5]."""
    distance, bearing, course, speed, turn_rate = states.T
    pose = np.stack([-distance, np.zeros_like(distance), -bearing], -1)
    return pose, np.stack([speed * np.cos(course), speed * np.sin(course), turn_rate], -1)
