"""Which motions are reachable, which certificates are feasible there, and the least of them."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from toy import ToyEnvs

from safemr.algorithms import fac_oracle, joint_sis, safemr, safemr_guarded
from safemr.certificates import falsification
from safemr.certificates.families import PAPER
from safemr.certificates.oracle import Encounters, smallest
from safemr.certificates.point_robot import ROBOT
from safemr.certificates.reachable import reachable, responses
from safemr.errors import UserError
from safemr.paper import PHI_0, PHI_H, Zeta
from safemr.tasks import make_envs

COARSE = (0.2, 0.2, 1.0)
TASK = "Pillars-0.15-Goal"


@pytest.fixture(scope="module")
def envs() -> Iterator[Any]:
    made = falsification.make_simulator(TASK, 4)
    yield made
    made.close()


@pytest.fixture(scope="module")
def encounters(envs: Any) -> Encounters:
    return Encounters(envs, cell=COARSE, bearings=24, spacing=0.05)


@pytest.mark.parametrize("held", [1, 5])
def test_every_motion_has_a_trajectory_from_rest(held: int) -> None:
    """Its witness, driven decision by decision from rest, ends in it."""
    found = reachable(held, (), COARSE)
    assert len(found.kept) > 400
    for index in np.linspace(0, len(found.kept) - 1, 12).astype(int):
        motion = np.zeros((1, 3))
        for action in found.witness(int(index)):
            motion = responses(motion, action[None, None], held)[2][0]
        assert np.allclose(motion[0], found.representatives[index], rtol=0, atol=1e-9)


def test_the_simulator_goes_the_same_way() -> None:
    """Of the motion farthest sideways: MuJoCo, started at rest, ends in it."""
    found = reachable(1, (), COARSE)
    index = int(np.abs(found.representatives[:, 1]).argmax())
    envs = falsification.make_simulator(TASK, 1)
    state = envs.get_state()
    at_rest = np.array([[50.0, 0.0, 0.0, 0.0, 0.0]])
    state["worlds"] = falsification.worlds_near_obstacle(envs, at_rest)
    state["steps"][:] = 0
    envs.set_state(state)
    for action in found.witness(index):
        envs.step(action[None])
    worlds = envs.get_state()["worlds"]
    turn, (vx, vy, rate) = worlds["qpos"][0, 2], worlds["qvel"][0, :3]
    envs.close()
    # Joint velocities are in the frame of the start.
    along, across = np.cos(turn) * vx + np.sin(turn) * vy, np.cos(turn) * vy - np.sin(turn) * vx
    # After some sixty steps, in which the yaw servo amplifies round-off.
    assert np.allclose((along, across, rate), found.representatives[index], rtol=0, atol=0.01)


def test_nobody_slides_sideways_at_full_speed() -> None:
    """The corner in which the box of the falsification has its counterexamples is not reached."""
    motions = reachable().representatives
    speed = np.hypot(motions[:, 0], motions[:, 1])
    assert speed.max() == pytest.approx(ROBOT.max_speed, abs=0.05)
    sideways = np.abs(motions[:, 0]) < 0.3 * speed
    assert speed[sideways].max() < 0.8 * ROBOT.max_speed


def test_who_can_do_less_gets_less_far() -> None:
    slow = reachable(1, (0.02, 1.0), COARSE).representatives
    assert np.hypot(slow[:, 0], slow[:, 1]).max() < 0.5 * ROBOT.max_speed


def test_unsafe_area_in_closed_form(encounters: Encounters) -> None:
    """phi = sigma + d_min - d does not depend on the motion: an annulus."""
    d_min = encounters.d_min
    expected = np.pi * ((d_min + 0.2) ** 2 - d_min**2)
    assert encounters.unsafe_area(Zeta(0.2, 0.0, 1.0)) == pytest.approx(expected, rel=0.02)
    assert encounters.unsafe_area(PHI_0) == 0.0
    sizes = [encounters.unsafe_area(Zeta(0.1, k, 1.0)) for k in (0.0, 0.3, 0.6)]
    assert sizes == sorted(sizes)


def test_verdicts(encounters: Encounters, envs: Any) -> None:
    """phi_0 cannot be kept, and its worst state has no safe action in the simulator either."""
    verdict = encounters.verdict(PHI_0)
    assert not verdict.feasible
    assert verdict.worst > 0
    state = verdict.state[None]
    d_min = encounters.d_min
    assert falsification.grid_margins(state, d_min, PHI_0, 0.0).min() == pytest.approx(
        verdict.worst
    )
    assert falsification.simulated_margins(envs, state, PHI_0, 0.0)[0] > 0  # it meets the pillar
    speed, rate = verdict.state[3], verdict.state[4]
    along, across, turn = encounters.reachable.representatives[verdict.motion]
    assert (speed, rate) == pytest.approx((np.hypot(along, across), turn))
    assert encounters.verdict(Zeta(0.05, 0.6, 1.0)).feasible
    with pytest.raises(UserError, match="phi is positive"):
        encounters.verdict(Zeta(0.3, 3.0, 0.1))


def test_what_refuted_one_certificate_refutes_no_feasible_one(encounters: Encounters) -> None:
    rng = np.random.default_rng(0)
    told = 0
    for _ in range(40):
        zeta = Zeta(rng.uniform(0, 0.4), rng.uniform(0.1, 1.2), rng.uniform(0.8, 2.5))
        refuted = encounters.refuted(zeta)
        feasible = encounters.verdict(zeta).feasible
        assert not (refuted and feasible), zeta
        told += refuted
    assert told > 2


def test_the_least_one_is_the_least_of_the_grid(encounters: Encounters) -> None:
    """Against looking at every member of the grid."""
    box = ((0.0, 0.2, 0.8), (0.3, 1.1, 2.0))
    found = smallest(encounters, PAPER, box, points=4, zooms=0)
    members = itertools.product(*(np.linspace(*ends, 4) for ends in zip(*box, strict=True)))
    feasible = [zeta for zeta in map(Zeta._make, members) if encounters.verdict(zeta).feasible]
    assert found.zeta == min(feasible, key=encounters.unsafe_area)
    assert smallest(encounters, PAPER, box, points=4, zooms=1).area <= found.area
    assert found.verdict.feasible
    with pytest.raises(UserError, match="no paper certificate in the box is feasible"):
        smallest(encounters, PAPER, ((0.0, 0.0, 1.0), (0.1, 0.01, 1.1)), points=2)


def guarded(worst: Any, zeta: tuple[float, float, float]) -> safemr_guarded.Agent:
    """An agent whose encounters have the worst least g ``worst(zeta)``."""
    agent = safemr_guarded.Agent(safemr_guarded.Config(hidden=8), 3, 2, 0.25, 0, 10_000)
    agent.zeta.copy_(torch.tensor(zeta))

    def verdict(asked: Any, eta: float) -> Any:
        return SimpleNamespace(feasible=worst(*asked) < 0, worst=worst(*asked))

    agent.encounters = SimpleNamespace(
        refuted=lambda *asked: False,
        verdict=verdict,
        remembered_worst=lambda asked, eta: worst(*asked),
    )
    return agent


def test_a_step_that_loses_feasibility_is_left_its_part_along_the_boundary() -> None:
    start, proposed = (0.3, 1.0, 2.0), torch.tensor([0.2, 0.9, 2.1])
    free = guarded(lambda sigma, k, n: -1.0, start)
    assert torch.equal(free.admitted(proposed), proposed)
    # feasible from k = 0.95 on: sigma and n move as proposed, k to the wall
    walled = guarded(lambda sigma, k, n: 0.95 - k, start)
    assert walled.admitted(proposed).tolist() == pytest.approx([0.2, 0.95, 2.1], abs=2e-4)
    # feasible where k + n >= 3.05: the excess of 0.05 is divided between the two
    oblique = guarded(lambda sigma, k, n: 3.05 - k - n, start)
    assert oblique.admitted(proposed).tolist() == pytest.approx([0.2, 0.925, 2.125], abs=2e-4)
    # nothing but the present zeta is feasible, and no direction leads back
    stopped = guarded(lambda *asked: -1.0 if asked == tuple(stopped.zeta.tolist()) else 1.0, start)
    assert torch.equal(stopped.admitted(proposed), stopped.zeta)


def test_what_the_box_holds_back_does_not_help() -> None:
    """sigma would have to fall below its bound: k alone brings the step back."""
    agent = guarded(lambda sigma, k, n: sigma - 0.04 + 0.95 - k, (0.06, 1.0, 2.0))
    found = agent.admitted(torch.tensor([0.05, 0.9, 2.0]))
    assert found.tolist() == pytest.approx([0.05, 0.96, 2.0], abs=2e-4)


def test_from_an_infeasible_start_only_what_is_better_is_admitted() -> None:
    lost = guarded(lambda sigma, k, n: 5.0 - sigma**2, (0.3, 1.0, 2.0))  # out of the box's reach
    assert lost.admitted(torch.tensor([0.4, 1.0, 2.0]))[0] == pytest.approx(0.4)
    assert lost.admitted(torch.tensor([0.2, 1.0, 2.0]))[0] == pytest.approx(0.3)


def small(module: Any, **settings: Any) -> Any:
    config = module.Config(hidden=8, num_envs=4, batch_size=16, start_steps=400, **settings)
    return module.Trainer(config, lambda count: make_envs(TASK, count), 0, 4_000)


def test_a_guarded_descent_stays_feasible_also_when_continued(envs: Any) -> None:
    """With weights that drive zeta out of what is feasible where SafeMR would follow."""
    start = {"sigma": 0.3, "k": 1.0, "n": 1.5, "a": 1.0, "b": 1.0, "certificate_start": 0.0}
    settings = {"certificate_delay": 32, "certificate_travel": 4.0, **start}

    def begun() -> Any:
        trainer = small(safemr_guarded, **settings)
        trainer.agent.encounters = Encounters(envs, cell=COARSE, bearings=12, spacing=0.1)
        return trainer

    trainer = begun()
    begin = trainer.agent.zeta.clone()
    trainer.advance(2_000)
    middle = copy.deepcopy(trainer.state_dict())
    assert len(middle["agent"]["encounters"])  # something had refuted a step by then
    trainer.advance(4_000)
    zeta = Zeta(*trainer.agent.zeta.tolist())
    assert trainer.agent.zeta[1] < begin[1] - 0.1
    assert trainer.agent.encounters.verdict(zeta).feasible
    # continued from its checkpoint it ends at the same zeta: what it remembers is saved, too
    again = begun()
    again.load_state_dict(middle)
    again.advance(4_000)
    assert torch.equal(again.agent.zeta, trainer.agent.zeta)
    without = small(safemr, **settings)
    without.advance(4_000)
    lost = Zeta(*without.agent.zeta.tolist())
    assert not trainer.agent.encounters.verdict(lost).feasible


def test_what_was_remembered_tells_how_far_a_certificate_is_from_keeping_it(envs: Any) -> None:
    encounters = Encounters(envs, cell=COARSE, bearings=24, spacing=0.05)
    assert encounters.remembered_worst(PHI_0) == -np.inf
    verdict = encounters.verdict(PHI_0)
    assert 0.0 < encounters.remembered_worst(PHI_0) <= verdict.worst
    assert encounters.remembered_worst(PHI_H) < 0.0 or not encounters.verdict(PHI_H).feasible


def test_fac_with_the_oracle_keeps_what_it_found(encounters: Encounters) -> None:
    trainer = small(fac_oracle)
    found = Zeta(*trainer.agent.zeta.tolist())
    low, high = joint_sis.Config().box
    assert all(a - 1e-6 <= value <= b for a, value, b in zip(low, found, high, strict=True))
    assert encounters.verdict(found).feasible
    assert encounters.unsafe_area(found) < 0.5 * encounters.unsafe_area(PHI_H)
    trainer.advance(800)
    assert Zeta(*trainer.agent.zeta.tolist()) == found
    with pytest.raises(UserError, match=r"sigma = 0\.1: not used"):
        fac_oracle.Config(sigma=0.1)


@pytest.mark.parametrize("module", [fac_oracle, safemr_guarded])
def test_another_robot_is_refused(module: Any) -> None:
    config = module.Config(hidden=8, target_entropy=-1.0)
    with pytest.raises(UserError, match="known of the point robot alone"):
        module.Trainer(config, ToyEnvs, 0, 40_000)
