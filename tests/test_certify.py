"""The certificate check: closed forms, the model against the simulator, replayable examples."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_record import CONFIG, ROWS

from safemr import files, paper
from safemr.certificates import falsification
from safemr.certificates.certificate import EnergyCertificate
from safemr.certificates.energy import constraint, energy, largest
from safemr.certificates.falsification import ROBOT
from safemr.certificates.feasibility import analytic_condition, radial_requirement
from safemr.certificates.point_robot import PointRobot
from safemr.errors import UserError
from safemr.experiment import records
from safemr.measure import certify
from safemr.measure.policy_check import check_policy
from safemr.measure.store import Measurements
from safemr.paper import Zeta
from safemr.report import certificates

ROOT = Path(__file__).resolve().parents[1]
LEARNED = list(paper.TABLE_II.values())
D_MIN = 0.25
TASK = "Pillars-0.15-Goal"


@pytest.fixture(scope="module", params=["Pillars-0.15-Goal", "Hazards-0.30-Push"])
def simulator(request):
    envs = falsification.make_simulator(request.param, 64)
    yield envs
    envs.close()


@pytest.fixture(scope="module")
def pillars():
    envs = falsification.make_simulator(TASK)
    yield envs
    envs.close()


def random_states(count: int, seed: int = 0) -> np.ndarray:
    low, high = [0.5, -np.pi, -np.pi, 0.0, -3.0], [1.5, np.pi, np.pi, 1.5, 3.0]
    return np.random.default_rng(seed).uniform(low, high, (count, 5))


# --- (a) the analytic condition ------------------------------------------------------------------


@pytest.mark.parametrize("zeta", [*LEARNED, paper.PHI_H])
def test_each_set_holds_with_the_aligned_brake_and_fails_with_drag_alone(zeta):
    table = analytic_condition(zeta, D_MIN).set_index(["convention", "braking"])["holds"]
    assert table.xs("aligned brake", level="braking").all()
    assert not table.xs("drag only", level="braking").any()
    assert len(table) == 4


@pytest.mark.parametrize(
    ("zeta", "inside", "outside"),
    list(zip(LEARNED, [3.02, 3.35, 2.80], [3.09, 3.45, 2.85], strict=True)),
)
def test_requirement_at_top_speed_is_equation_three_of_issa(zeta, inside, outside):
    """n (C + k v)^((n-1)/n) / k in 1/s, computed independently of this package."""
    top = np.array([1.5])
    for convention, expected in (("inside", inside), ("outside", outside)):
        value = radial_requirement(zeta, D_MIN, top, convention) / 1.5
        assert value == pytest.approx(expected, abs=0.005)


@given(st.floats(0.0, 0.5), st.floats(0.3, 3.0), st.floats(1.0, 3.0), st.floats(0.1, 1.5))
def test_requirement_is_the_one_that_stops_the_energy_from_rising(sigma, k, n, u):
    """At phi = 0 and that deceleration, phi_dot = 0: checked with finite differences of phi."""
    zeta = Zeta(sigma, k, n)
    required = radial_requirement(zeta, D_MIN, np.array([u]), "inside")[0]
    d = ((sigma + D_MIN) ** n + k * u) ** (1 / n)
    h = 1e-6
    rates = [energy(d - u * t, -u + required * t, D_MIN, *zeta) for t in (-h, h)]
    assert abs((rates[1] - rates[0]) / (2 * h)) < 1e-5 * max(1.0, k * required)


def test_eta_needs_more_deceleration():
    plain, slack = (analytic_condition(LEARNED[0], D_MIN, eta=eta)["margin"] for eta in (0, 0.01))
    np.testing.assert_allclose(plain - slack, 0.01 / 0.02 / LEARNED[0].k, rtol=1e-9)


def test_an_energy_without_velocity_has_no_finite_requirement():
    assert not analytic_condition(paper.PHI_0, D_MIN)["holds"].any()


# --- the model and the simulator -----------------------------------------------------------------


def test_constants_are_those_of_the_specification():
    robot = PointRobot()
    assert robot.mass == pytest.approx(0.00518879, rel=1e-6)
    assert robot.inertia == pytest.approx(2.84218e-5, rel=1e-6)
    assert robot.max_speed == pytest.approx(1.5)
    assert robot.step_s == pytest.approx(0.02)
    assert robot.deceleration(np.array([0.0]), "aligned brake")[0] == pytest.approx(2.89, abs=0.005)


def simulated_grid(simulator, states, zeta, action_repeat):
    """g [S, A] of the grid, held for so many steps."""
    worlds = falsification.worlds_near_obstacle(simulator, states)
    phi = falsification.energies(states, float(simulator.d_min), zeta)
    return falsification.simulated_grid(
        simulator, worlds, states[:, 4], phi, zeta, 0.0, action_repeat
    )[1]


def test_model_equals_the_simulator_away_from_contact(simulator):
    states, zeta = random_states(24), LEARNED[0]
    modelled = falsification.grid_margins(states, float(simulator.d_min), zeta, 0.0)
    np.testing.assert_allclose(modelled, simulated_grid(simulator, states, zeta, 1), atol=1e-9)


def test_model_equals_the_simulator_over_held_actions(simulator):
    """To 1e-9 wherever the servo does not amplify a nudge; the least of the grid everywhere."""
    states, zeta = random_states(24), LEARNED[0]
    nudged = states + 1e-12 * np.random.default_rng(1).normal(size=states.shape)
    modelled, again = (
        falsification.grid_margins(x, float(simulator.d_min), zeta, 0.0, 5)
        for x in (states, nudged)
    )
    simulated = simulated_grid(simulator, states, zeta, 5)
    steady = np.abs(modelled - again) < 1e-10
    assert steady.mean() > 0.5
    np.testing.assert_allclose(modelled[steady], simulated[steady], rtol=0, atol=1e-9)
    np.testing.assert_allclose(modelled.min(1), simulated.min(1), rtol=0, atol=1e-4)


def test_placed_worlds_have_the_distance_and_rate_that_were_asked_for(simulator):
    states = random_states(64, seed=1)
    state = simulator.get_state()
    state["worlds"] = falsification.worlds_near_obstacle(simulator, states)
    simulator.set_state(state)
    infos = simulator.step(np.zeros((64, 2)))[-1]
    moved = states[:, 0] - 0.02 * states[:, 3] * np.cos(states[:, 2])
    np.testing.assert_allclose(infos["d"][:, 0], moved, atol=2e-3)
    np.testing.assert_allclose(
        infos["d_dot"][:, 0], -states[:, 3] * np.cos(states[:, 2]), atol=0.15
    )
    others = infos["d"][:, 1:]
    assert (others > 90).all()


def test_action_grid_resolves_thrust_and_servo():
    (grid,) = falsification.action_grid(np.array([2.0]))
    assert np.abs(grid[:, 0]).max() == 0.05
    assert np.abs(grid).max() <= 1
    near = np.unique(grid[np.abs(grid[:, 1] - 0.6) <= 0.06 + 1e-12, 1])
    assert len(near) >= 9
    assert np.diff(near).max() <= 0.0151


def test_the_grid_stays_within_what_a_learner_can_do():
    rates = np.array([-1.0, 2.0])
    whole = falsification.action_grid(rates)
    np.testing.assert_array_equal(falsification.action_grid(rates, (0.05, 1.0)), whole)
    np.testing.assert_array_equal(
        falsification.action_grid(rates, (0.02, 0.5)), np.clip(whole, [-0.02, -0.5], [0.02, 0.5])
    )


def test_a_state_may_have_a_safe_action_for_one_step_and_none_for_five(pillars):
    """Sideways and near top speed, a thrust across the way helps for one step alone."""
    state = np.array([[1.2743, 1.7460, 0.1955, 1.4605, 0.5931]])
    for repeat, margin in ((1, -0.0388), (5, 0.0042)):
        modelled = falsification.grid_margins(state, D_MIN, paper.PHI_H, 0.0, repeat).min()
        assert modelled == pytest.approx(margin, abs=5e-4)
        simulated = falsification.simulated_margins(pillars, state, paper.PHI_H, 0.0, repeat)
        assert simulated == pytest.approx(modelled, abs=1e-4)


def test_an_action_is_held_within_one_episode(pillars):
    states = random_states(8)
    actions = np.full((8, 2), 0.03)

    def after(envs, repeat):
        worlds = falsification.worlds_near_obstacle(envs, states)
        return falsification.next_energies(envs, worlds, actions, paper.PHI_H, repeat)

    short = falsification.make_simulator(
        {"name": "Short", "base": TASK, "settings": {"max_episode_steps": 5}}, 8
    )
    np.testing.assert_array_equal(after(short, 5), after(pillars, 5))
    with pytest.raises(UserError, match="held for 6 control steps in episodes of 5"):
        after(short, 6)
    short.close()


# --- (b) falsification ---------------------------------------------------------------------------


def test_search_is_seeded_and_its_example_replays(pillars):
    first, second = (
        falsification.falsify(pillars, TASK, LEARNED[1], count=512, rounds=3) for _ in range(2)
    )
    np.testing.assert_array_equal(first.margin, second.margin)
    assert first.worst_margin == second.worst_margin
    assert first.confirmed == first.examined
    example = json.loads(json.dumps(first.example()))
    actions, g = falsification.replay(example)
    assert g.min() == pytest.approx(first.worst_margin, abs=1e-12)
    assert actions.shape == (len(g), 2)


def test_an_example_of_held_actions_says_so_and_replays(pillars):
    def example(**held):
        search = falsification.falsify(pillars, TASK, LEARNED[1], count=256, rounds=2, **held)
        return json.loads(json.dumps(search.example()))

    assert not {"action_repeat", "action_scale"} & example().keys()
    found = example(action_repeat=5, action_scale=(0.02, 1.0))
    assert (found["action_repeat"], found["action_scale"]) == (5, [0.02, 1.0])
    actions, g = falsification.replay(found)
    assert g.min() == pytest.approx(found["margin"], abs=1e-12)
    assert np.abs(actions[:, 0]).max() == 0.02
    del found["action_repeat"]
    assert abs(falsification.replay(found)[1].min() - found["margin"]) > 1e-3


def test_refinement_finds_that_no_learned_set_is_feasible_everywhere(pillars):
    result = falsification.falsify(pillars, TASK, LEARNED[0], count=1024)
    assert result.worst_margin > 0.01
    _distance, bearing, course, speed, turn_rate = result.worst_state
    # sideways, closing in fast, turning as fast as the servo can
    assert abs(np.cos(bearing)) < 0.2
    assert np.cos(course) > 0.9
    assert speed > 1.3
    assert abs(turn_rate) > 2.5


def test_distance_alone_leaks_and_a_strong_velocity_term_does_not(pillars):
    bare = falsification.falsify(pillars, TASK, paper.PHI_0, count=2048, rounds=1)
    assert bare.leak_share > 0.005  # too fast to stop within one step of contact
    strong = falsification.falsify(pillars, TASK, Zeta(0.3, 3.0, 1.0), count=2048, rounds=1)
    assert strong.leak_share == 0.0


def test_states_inside_a_solid_obstacle_are_left_out(simulator):
    facing = np.array([[0.27, 0.0, 0.0, 0.0, 0.0], [0.27, np.pi, 0.0, 0.0, 0.0]])
    overlap = falsification.overlaps_obstacle(simulator, facing)
    assert overlap.tolist() == [simulator.task.solid_obstacles, False]


@settings(max_examples=30)
@given(st.floats(0.0, 1.0), st.floats(0.0, 3.0), st.floats(0.5, 4.0))
def test_searched_distances_contain_every_state_with_positive_energy(sigma, k, n):
    zeta = Zeta(sigma, k, n)
    if energy(D_MIN + 20.0, -1.5, D_MIN, *zeta) > 0:
        with pytest.raises(UserError, match="no bounded search"):
            falsification.largest_distance(zeta, D_MIN)
        return
    reach = falsification.largest_distance(zeta, D_MIN)
    assert (energy(np.linspace(reach, 30, 200)[1:], -ROBOT.max_speed, D_MIN, *zeta) <= 1e-9).all()


# --- (c) a policy --------------------------------------------------------------------------------


class Constant:
    def __init__(self, *action: float) -> None:
        self.action = np.array(action, np.float32)

    def act(self, observations, deterministic=True):
        return np.tile(self.action, (len(observations), 1))


def test_a_resting_robot_never_violates_and_a_rammer_could_have_done_otherwise():
    task = TASK
    resting = check_policy(Constant(0, 0), task, LEARNED[0], num_envs=4, steps=20)
    assert resting.decisions == 80
    assert resting.violating == 0
    assert resting.avoidable_share == 0.0
    ramming = check_policy(Constant(1, 0), task, LEARNED[0], num_envs=16, steps=120, limit=20)
    assert ramming.violating > 0
    assert ramming.examined == min(20, ramming.violating)
    assert ramming.avoidable >= 0.8 * ramming.examined
    assert ramming.avoidable_share <= ramming.violating_share


def test_the_constraint_of_a_policy_is_between_states_a_decision_apart():
    """Of 4, 4, and in each episode at last 2 steps, which are no whole decision, by hand."""
    task = {"name": "Short", "base": TASK, "settings": {"max_episode_steps": 50}}
    ramming = Constant(1, 0)
    ramming.action_repeat = 4
    check = check_policy(ramming, task, LEARNED[0], num_envs=16, steps=50, seed=3, limit=4)
    envs = falsification.make_simulator(task, 16)
    _, infos = envs.reset(seed=3)
    phi = []
    for _ in range(49):
        phi.append(largest(energy(infos["d"], infos["d_dot"], D_MIN, *LEARNED[0])))
        infos = envs.step(np.tile(ramming.action, (16, 1)))[-1]
    envs.close()
    apart = np.array(phi)[::4]
    assert check.decisions == 12 * 16
    assert check.violating == (constraint(apart[:-1], apart[1:], 0.0) >= 0).sum() > 4
    assert check.examined == 4


# --- the command ---------------------------------------------------------------------------------


def test_command_prints_four_verdicts_and_writes_table_picture_and_examples(tmp_path, capsys):
    arguments = ["--sigma", "0.2", "--k", "0.8", "--n", "2.1", "--name", "mine",
                 "--states", "256", "--out", str(tmp_path)]  # fmt: skip
    assert certificates.main(arguments) == 0
    printed = capsys.readouterr().out
    assert printed.count("holds (") == 2
    assert printed.count("fails (") == 2
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"certificates.csv", "certificates.md", "certificates.tex",
                     "certificates.pdf", "certificates.png", "examples.json"}  # fmt: skip
    assert certificates.main(["--replay", str(tmp_path / "examples.json")]) == 0
    assert "mine on Pillars-0.15-Goal: 100 actions" in capsys.readouterr().out


def test_without_parameters_the_papers_certificates_are_checked():
    names = [certificate.name for certificate in certify.paper_certificates()]
    assert names == ["paper [0.35, 0.15]", "paper [0.45, 0.15]", "paper [0.35, 0.25]",
                     "phi_h", "phi_0"]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [(["--sigma", "0.2"], "--k"), (["--sigma", "-1", "--k", "1", "--n", "2"], "negative"),
     (["--record", "x", "--k", "1"], "--record"), (["--replay", "nowhere.json"], "nowhere.json"),
     (["--sigma", "0.3", "--k", "3", "--n", "0.1"], "no bounded search"),
     (["--task", "Aircraft"], "point robot"),
     (["--task", "Pillars-0.15-Gaol"], "Pillars-0.15-Goal"),
     (["--set", "task.obstacle_sise=0.3"], "obstacle_size"), (["--set", "gamma=0.9"], "task.NAME"),
     (["--set", "task.obstacle_size"], "NAME=VALUE"),
     (["--record", "x", "--task", "Pillars-0.30-Goal"], "--task: a record says its own"),
     (["--record", "x", "--set", "task.obstacle_size=0.3"], "--set: a record says its own"),
     (["--record", "x", "--eta", "0.1"], "--eta: a record says its own")],
)  # fmt: skip
def test_bad_requests_are_named(arguments, culprit):
    with pytest.raises(UserError, match=culprit):
        certificates.main([*arguments, "--states", "64"])


# --- a task with other settings ------------------------------------------------------------------

LARGE = {"name": "Large", "version": 1, "settings": {"obstacle_size": 0.3}, "base": TASK}
ZETA = ["--sigma", "0.2", "--k", "0.8", "--n", "2.1", "--name", "mine", "--states", "256"]


def record_on(
    root: Path,
    task: dict[str, Any],
    algorithm: str = "fac",
    interface: dict[str, Any] | None = None,
    **arrays: Any,
) -> Path:
    """A record that logs a zeta."""
    described = {"name": algorithm, "version": 1, "hyperparameters": {"gamma": 0.99}}
    config = {**CONFIG, "task": task, "algorithm": described}
    config |= {"interface": interface} if interface else {}
    rows = [{**row, "sigma": 0.2, "k": 0.8, "n": 2.1} for row in ROWS]
    folder = root / records.record_path(config, "FAC-phih")
    records.write_record(folder, config, "FAC-phih", rows, {}, arrays or None)
    return folder


def test_the_search_covers_the_distances_of_the_settings():
    """With obstacles of 0.3 m the robot's centre must stay 0.4 m away: no state is nearer."""
    certificate = EnergyCertificate("mine", Zeta(0.2, 0.8, 2.1))
    (_, plain), (row, search) = (
        certify.certify(certificate, task, states=256) for task in (TASK, LARGE)
    )
    assert plain.states[:, 0].min() < 0.3
    assert search.states[:, 0].min() >= 0.4
    assert row["task"] == "Large"
    assert search.confirmed == search.examined, "the simulator has the same obstacles"
    expected = analytic_condition(certificate.zeta, 0.4)["margin"].tolist()
    found = [value for name, value in row.items() if name.startswith("margin_")]
    assert found == expected
    margins = certify.margin_map(certificate, LARGE, distances=3, bearings=3)
    assert margins["distance"].min() == pytest.approx(0.4)


def test_the_command_line_and_a_record_certify_the_same_task(tmp_path, capsys):
    folder = record_on(tmp_path, LARGE)
    assert certificates.main(["--record", str(folder), "--states", "256"]) == 0
    recorded = capsys.readouterr().out
    assert certificates.main([*ZETA, "--set", "task.obstacle_size=0.3"]) == 0
    given = capsys.readouterr().out
    assert "| Large |" in recorded
    assert "| Pillars-0.15-Goal with obstacle_size=0.3 |" in given
    worst = [json.loads(out.partition("worst state of ")[2].partition(": ")[2])
             for out in (recorded, given)]  # fmt: skip
    for example in worst:
        assert example.pop("base") == TASK
        assert example["settings"] == {"obstacle_size": 0.3}
        assert example["state"]["distance"] >= 0.4
        del example["task"]
    assert worst[0] == worst[1]


def test_a_replay_is_on_the_task_of_its_example_and_on_no_other(tmp_path, capsys):
    settings = ["--set", "task.obstacle_size=0.3"]
    certificates.main([*ZETA, *settings, "--out", str(tmp_path)])
    file = tmp_path / "examples.json"
    for matching in ([], settings, [*settings, "--task", TASK]):
        assert certificates.main(["--replay", str(file), *matching]) == 0
    assert "the file says" not in capsys.readouterr().out
    title = "mine on Pillars-0.15-Goal with obstacle_size=0.3"
    for other, named in (
        (["--set", "task.obstacle_size=0.2"], "Pillars-0.15-Goal with obstacle_size=0.2"),
        (["--task", "Pillars-0.30-Goal", *settings], "Pillars-0.30-Goal with obstacle_size=0.3"),
        (["--task", TASK], "Pillars-0.15-Goal"),
    ):
        with pytest.raises(UserError) as caught:
            certificates.main(["--replay", str(file), *other])
        message = f"{title} is an example of {title.removeprefix('mine on ')}, not of {named}"
        assert str(caught.value).endswith(message)
    # A file of before, which forgot the settings: it does not come out as it says.
    ((name, example),) = json.loads(file.read_text()).items()
    del example["settings"], example["base"]
    example["task"] = TASK
    file.write_text(json.dumps({name: example}))
    assert certificates.main(["--replay", str(file)]) == 1
    assert "the file says" in capsys.readouterr().out
    example["settings"] = {"obstacle_sise": 0.3}
    file.write_text(json.dumps({name: example}))
    with pytest.raises(UserError, match="obstacle_size"):
        certificates.main(["--replay", str(file)])


def test_the_examples_that_the_repository_keeps_come_out_as_they_say(capsys):
    file = ROOT / "results/tables/certificate_examples.json"
    assert certificates.main(["--replay", str(file)]) == 0
    assert capsys.readouterr().out.count("no action is safe") == len(json.loads(file.read_text()))


def test_kept_measurements_of_other_settings_are_others(tmp_path):
    kept = Measurements(tmp_path)
    certificate = EnergyCertificate("mine", Zeta(0.2, 0.8, 2.1))
    plain = {"name": TASK, "version": 1, "settings": {}}
    rows, maps = [], []
    for task in (plain, LARGE, {**LARGE, "name": "Larger", "settings": {"obstacle_size": 0.4}}):
        rows.append(certify.measured_certificate(kept, certificate, task, states=64, episodes=1))
        maps.append(certify.measured_margins(kept, certificate, task))
    assert len({row["worst_margin"] for row, _ in rows}) == 3
    assert [d_min for _, d_min in maps] == pytest.approx([0.25, 0.4, 0.5])
    assert [example.get("settings") for _, example in rows] == [
        None, {"obstacle_size": 0.3}, {"obstacle_size": 0.4}
    ]  # fmt: skip


def test_a_record_is_checked_over_its_own_decisions(tmp_path, capsys, monkeypatch):
    """A hold of its configuration reaches search, table, example, map and what is kept."""
    plain, interface = {"name": TASK, "version": 1, "settings": {}}, {"action_repeat": 5}
    folders = [
        record_on(tmp_path, plain, interface=entry)
        for entry in (None, interface, interface | {"action_scale": [0.05, 1.0], "decode": []})
    ]
    jobs = [certify.certificate_of_record(folder)[0] for folder in folders]
    kept = Measurements(tmp_path)
    for module, name, less in (
        (certify, "margin_map", {"distances": 9, "bearings": 9}),
        (falsification, "falsify", {"rounds": 1}),
    ):
        monkeypatch.setattr(module, name, functools.partial(getattr(module, name), **less))
    rows, examples = zip(
        *(certify.measured_certificate(kept, job, plain, states=64, episodes=1) for job in jobs),
        strict=True,
    )
    assert [row.get("action_repeat") for row in rows] == [None, 5, 5]
    assert [example.get("action_repeat") for example in examples] == [None, 5, 5]
    assert [example.get("action_scale") for example in examples] == [None, None, [0.05, 1.0]]
    assert rows[0]["worst_margin"] < rows[1]["worst_margin"] == rows[2]["worst_margin"]
    maps = [certify.measured_margins(kept, job, plain)[0] for job in jobs[:2]]
    assert maps[1]["margin"].max() > maps[0]["margin"].max() > 0
    paths = sorted((tmp_path / "measurements/margins").iterdir())
    headers = [json.loads(str(files.load_arrays(path)["measurement"])) for path in paths]
    assert [header["inputs"]["interface"] for header in headers
            if "interface" in header["inputs"]] == [interface]  # fmt: skip
    arguments = [text for folder in folders[:2] for text in ("--record", str(folder))]
    assert certificates.main([*arguments, "--states", "64"]) == 0
    assert "control steps a decision" in capsys.readouterr().out
    file = tmp_path / "examples.json"
    file.write_text(json.dumps({"one step": examples[0], "five": examples[1]}))
    assert certificates.main(["--replay", str(file)]) == 0
    assert capsys.readouterr().out.count("100 actions held for 5 control steps, ") == 1


def test_equal_titles_are_numbered_so_that_no_example_is_lost():
    jobs = [(EnergyCertificate("a", Zeta(0, 0, 1)), task) for task in (TASK, LARGE, TASK, TASK)]
    titles = certify.example_titles(jobs)
    assert titles == [f"a on {TASK}", "a on Large", f"a on {TASK}, 2", f"a on {TASK}, 3"]


# --- an energy function that is more than its zeta -----------------------------------------------


@pytest.mark.parametrize("by", ["algorithm", "policy"])
def test_a_neural_record_is_not_certified_as_its_fixed_part(tmp_path, by):
    task = {"name": TASK, "version": 1, "settings": {}}
    if by == "algorithm":  # its policy.npz is optional
        folder = record_on(tmp_path, task, "neural_safemr")
    else:  # an algorithm of somebody else's, that saves such a network
        folder = record_on(tmp_path, task, "fac", certificate_parameters=np.zeros(3))
    with pytest.raises(UserError, match=r"is a network beside a fixed \[sigma, k, n\]") as caught:
        certificates.main(["--record", str(folder)])
    assert str(folder) in str(caught.value)
    assert "--sigma --k --n" in str(caught.value)
