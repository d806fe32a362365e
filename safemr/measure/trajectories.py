"""What figures need of a trained policy, computed once and kept as arrays.

`episodes` records trajectories, `multiplier_map` the multiplier and the energy over a plane of
positions. The figures of `safemr.report.figures.scenes` and `.certificate` are drawn from them
without torch or an environment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safemr.certificates.certificate import EnergyCertificate
from safemr.certificates.energy import largest
from safemr.certificates.falsification import make_simulator
from safemr.certificates.families import Parameters, phi_at
from safemr.errors import UserError
from safemr.experiment.planning import installed
from safemr.experiment.record import Record
from safemr.files import Arrays
from safemr.learning.evaluation import Acts
from safemr.measure.store import Measurements
from safemr.measure.tracks import GEOMETRY, below
from safemr.tasks import Task, name_of

if TYPE_CHECKING:
    from safemr.learning.policies import Policy

TOUCHED = 1e-5  # m off the free path: a contact


def episodes(
    policy: Acts,
    task: Task,
    *,
    seeds: list[int],
    steps: int = 1000,
) -> Arrays:
    """The first `steps` control steps of the deterministic policy, one episode a seed.

    It is asked for an action where it decides, every ``action_repeat`` steps if it says so.
    Returns robot [T+1, N, 3] (x, y, heading), goal [T+1, N, 2], box [T+1, N, 3] (nan without a
    box), vase [T+1, N, 3] in a task that has one, obstacles [N, M, 2], reward [T, N],
    cost_indicator [T, N], goal_met [T, N], and the task's geometry. The same seeds give the same
    layouts to every policy. Raises UserError for more steps than an episode has.
    """
    envs = make_simulator(task, len(seeds))
    if steps > envs.max_episode_steps:
        raise UserError(
            f"{name_of(task)} episodes have {envs.max_episode_steps} steps, {steps} were asked"
        )
    observations, _ = envs.reset(seed=seeds)
    action_repeat = getattr(policy, "action_repeat", 1)
    bodies = ("robot", "goal", "box", *(("vase",) if envs.task.has_vase else ()))
    tracks: dict[str, list[NDArray[Any]]] = {name: [] for name in bodies}
    scores: dict[str, list[NDArray[Any]]] = {
        name: [] for name in ("reward", "cost_indicator", "goal_met")
    }
    obstacles = np.array([envs.scene(i).obstacles for i in range(len(seeds))])
    for step in range(steps + 1):
        # After an episode's last step the environment shows the next layout: repeat the old poses.
        if step < envs.max_episode_steps:
            scenes = [envs.scene(index) for index in range(len(seeds))]
        for name, track in tracks.items():
            track.append(np.array([_pose(getattr(scene, name)) for scene in scenes], np.float32))
        if step < steps:
            if step % action_repeat == 0:
                actions = policy.act(observations)
            observations, reward, _, _, infos = envs.step(actions)
            scores["reward"].append(reward.astype(np.float32))
            for name in ("cost_indicator", "goal_met"):
                scores[name].append(infos[name].astype(np.float32))
    stacked = {name: np.stack(rows) for name, rows in (tracks | scores).items()}
    geometry = _geometry(envs)
    envs.close()
    return {**stacked, "obstacles": obstacles.astype(np.float32), **geometry}


def multipliers(policy: Policy, observations: NDArray[Any]) -> NDArray[np.float64]:
    """lambda_xi(s) [N] of a recorded policy, softplus and cap as in training.

    Raises UserError where the policy's algorithm has no multiplier network.
    """
    if "multiplier_parameters" not in policy.extras:
        raise UserError("this policy was recorded without a multiplier network")
    import torch  # seconds, which kept measurements do not need

    from safemr.learning.policies import network_from_arrays

    network = network_from_arrays("multiplier", policy.extras)
    with torch.no_grad():
        raw = network(torch.from_numpy(policy.transform(observations)))[0, :, 0]
        values = torch.nn.functional.softplus(raw)
    cap = float(policy.extras.get("multiplier_cap", np.inf))
    return values.clamp_max(cap).double().numpy()


def multiplier_map(
    policy: Policy,
    zeta: Parameters,
    task: Task,
    *,
    seed: int = 0,
    speed: float = 0.75,
    heading: float = 0.0,
    points: int = 81,
) -> Arrays:
    """lambda(s) and phi(s) for a robot moving along `heading` at `speed`, over the task's square.

    The layout is that of `seed`; the robot is put on each point of the grid, coasts for one step,
    and the observation it then makes is evaluated. Returns x [P], y [P], multiplier [P, P] and phi
    [P, P] (rows along y), obstacles, goal, speed, heading, geometry. The multiplier is nan inside
    d_min and where the robot touches something, which changes its velocity.
    """
    envs = make_simulator(task, points)
    envs.reset(seed=[seed] * points)
    scene, template = envs.scene(0), envs.get_state()
    extent = float(envs.task.extent)
    x = np.linspace(-extent, extent, points)
    multiplier, phi = np.empty((points, points)), np.empty((points, points))
    moved = np.empty((points, points, 2))
    for row, y in enumerate(x):
        state = {**template, "worlds": {k: v.copy() for k, v in template["worlds"].items()}}
        worlds = state["worlds"]
        worlds["start"] = np.stack([x, np.full(points, y), np.full(points, heading)], -1)
        worlds["qpos"][:, :3], worlds["qvel"][:] = 0.0, 0.0
        worlds["qvel"][:, 0] = speed
        envs.set_state(state)
        observations, *_, infos = envs.step(np.zeros((points, 2), np.float32))
        multiplier[row] = multipliers(policy, observations)
        phi[row] = largest(phi_at(infos["d"], infos["d_dot"], envs.d_min, zeta))
        multiplier[row, infos["d"].min(1) < envs.d_min] = np.nan
        reached = np.array([envs.scene(index).robot[:2] for index in range(points)])
        moved[row] = reached - worlds["start"][:, :2]
    shift = np.median(moved.reshape(-1, 2), axis=0)
    multiplier[np.abs(moved - shift).max(-1) > TOUCHED] = np.nan
    geometry = _geometry(envs)
    envs.close()
    return {
        "x": x + shift[0], "y": x + shift[1], "multiplier": multiplier, "phi": phi,
        "obstacles": scene.obstacles, "goal": scene.goal,
        "speed": np.array(speed), "heading": np.array(heading), **geometry,
    }  # fmt: skip


def measured(
    measurements: Measurements,
    certificate: EnergyCertificate,
    task: Task,
    *,
    layouts: list[int],
    steps: int,
) -> Arrays:
    """`episodes` and `multiplier_map` (of the first layout) of a certificate's recorded policy.

    Their arrays under "episodes/" and "map/", kept among ``measurements``.
    """
    certificate = certificate.in_metres()
    record = certificate.record
    assert record is not None
    inputs = {
        "policy": record.inputs, **certificate.entry,
        "task": installed(task),
        "layouts": layouts, "steps": steps,
    }  # fmt: skip

    def measure() -> Arrays:
        policy = record.policy()
        parts = {
            "episodes": episodes(policy, task, seeds=layouts, steps=steps),
            "map": multiplier_map(policy, certificate.zeta, task, seed=layouts[0]),
        }
        return {f"{part}/{name}": x for part, made in parts.items() for name, x in made.items()}

    return measurements.arrays("rollouts", record.label, inputs, measure)


def measured_episodes(
    measurements: Measurements, record: Record, *, layouts: list[int], steps: int
) -> Arrays:
    """`episodes` of any record's policy, kept among ``measurements``."""
    inputs = {
        "policy": record.inputs, "task": installed(record.task), "layouts": layouts, "steps": steps,
    }  # fmt: skip

    def measure() -> Arrays:
        made = episodes(record.policy(), record.task, seeds=layouts, steps=steps)
        return {f"episodes/{name}": values for name, values in made.items()}

    return below(measurements.arrays("episodes", record.label, inputs, measure), "episodes/")


def _pose(values: NDArray[Any] | None) -> NDArray[Any]:
    return np.full(3, np.nan) if values is None else np.asarray(values)


def _geometry(envs: Any) -> Arrays:
    return {name: np.array(getattr(envs.task, name)) for name in GEOMETRY}
