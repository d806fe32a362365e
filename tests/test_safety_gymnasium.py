"""Safety-Gymnasium's tasks through a process boundary: on a stand-in, and on itself if it is there.

SAFETY_GYMNASIUM_PYTHON names a Python with examples/safety_gymnasium/requirements.txt.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
import yaml

import safemr
from safemr import UserError, cli, paper

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "examples/safety_gymnasium"
ID = "safety_bridge:SafetyPointGoal1-v0"
REAL = os.environ.get("SAFETY_GYMNASIUM_PYTHON")
LAUNCHER = """#!{python}
import runpy, sys
from importlib import metadata

metadata.version = {versions}.__getitem__
sys.argv = sys.argv[3:]
sys.path.insert(0, {simulator!r})
runpy.run_path(sys.argv[0], run_name="__main__")
"""
TASKS = [("Point", "Goal1"), ("Car", "Goal1"), ("Point", "Push2"), ("Car", "Push1")]
VERSIONS = {"safety-gymnasium": "1.0.0", "mujoco": "2.3.3", "numpy": "1.23.5"}


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))


def stand_in(folder: Path, versions: dict[str, str]) -> str:
    """A Python that has, by its own word, those versions."""
    path = folder / "python"
    simulator = str(ROOT / "tests/simulator")
    path.write_text(LAUNCHER.format(python=sys.executable, versions=versions, simulator=simulator))
    path.chmod(0o755)
    return str(path)


@pytest.fixture
def python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    path = stand_in(tmp_path, VERSIONS)
    monkeypatch.setenv("SAFETY_GYMNASIUM_PYTHON", path)
    return path


def batch(count: int, name: str = "SafetyPointGoal1-v0", limit: int = 5) -> Any:
    from safety_bridge.batch import SafetyBatch

    return SafetyBatch(count, name, limit)


def test_distances_costs_and_restarts(python: str) -> None:
    envs = batch(2)
    observations, infos = envs.reset(seed=7)
    assert (envs.d_min, envs.num_obstacles, envs.max_episode_steps) == (0.2, 3, 5)
    hazards = [np.random.RandomState(seed).uniform(-1.0, 1.0, (3, 2)) for seed in (7, 8)]
    np.testing.assert_array_equal(infos["d"], [np.hypot(*places.T) for places in hazards])
    np.testing.assert_array_equal(infos["d_dot"], 0.0)
    actions, costs = np.array([[-0.4, 0.8], [0.3, -0.9]]), []  # into a hazard, and not
    for step in range(1, 6):
        before = infos["d"]
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        ended = infos["final_info"] if step == 5 else infos
        places = 0.1 * step * actions
        away = [here - place for here, place in zip(hazards, places, strict=True)]
        np.testing.assert_allclose(ended["d"], [np.hypot(*row.T) for row in away])
        midway = [row + 0.05 * action for row, action in zip(away, actions, strict=True)]
        rate = [-(row @ a) / np.hypot(*row.T) for row, a in zip(midway, actions, strict=True)]
        np.testing.assert_allclose(0.1 * np.array(rate), ended["d"] - before, atol=0.02)
        exact = [-(row @ a) / np.hypot(*row.T) for row, a in zip(away, actions, strict=True)]
        np.testing.assert_allclose(ended["d_dot"], exact)
        np.testing.assert_array_equal(ended["cost"], (ended["d"] < 0.2).any(1))
        np.testing.assert_allclose(rewards, places[:, 0])
        assert not terminated.any()
        assert truncated.all() == (step == 5)
        costs.append(ended["cost"])
    assert np.array(costs).max(0).tolist() == [1.0, 0.0]
    np.testing.assert_allclose(infos["final_obs"], np.column_stack((places, [1.0, 1.0])))
    np.testing.assert_array_equal(observations, [[0.0, 0.0, 2.0]] * 2)  # the next episode's start
    assert (infos["d_dot"] == 0.0).all()
    envs.close()


def test_a_batch_is_its_worlds_and_a_mask_leaves_the_others(python: str) -> None:
    together, alone = batch(3), [batch(1) for _ in range(3)]
    random = np.random.default_rng(0)
    together.reset(seed=5)
    for row, one in enumerate(alone):
        one.reset(seed=[5 + row])
    for _ in range(12):
        actions = random.uniform(-0.9, 0.9, (3, 2))
        all_of_it = together.step(actions)
        each = [one.step(actions[row : row + 1]) for row, one in enumerate(alone)]
        for part in range(4):
            np.testing.assert_array_equal(all_of_it[part], np.concatenate([r[part] for r in each]))
        for name in ("d", "d_dot", "cost"):
            np.testing.assert_array_equal(
                all_of_it[4][name], np.concatenate([r[4][name] for r in each])
            )
    before = all_of_it
    after, infos = together.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(after[[0, 2]], before[0][[0, 2]])
    np.testing.assert_array_equal(infos["d"][[0, 2]], before[4]["d"][[0, 2]])
    assert after[1, 2] == before[0][1, 2] + 1  # its next episode
    for envs in (together, *alone):
        envs.close()
        envs.close()


def test_one_world_is_a_batch_of_one_that_shows_how_an_episode_ends(python: str) -> None:
    import safety_bridge  # noqa: F401  (registers the tasks)

    one = gymnasium.make("SafetyPointGoal1-v0", max_episode_steps=5)
    both = batch(1)
    assert one.get_wrapper_attr("d_min") == both.d_min
    for seed in (7, None):  # None: the next episode, which the batch has begun by itself
        seen, info = one.reset(seed=seed)
        if seed is not None:
            observations, infos = both.reset(seed=[seed])
            np.testing.assert_array_equal(seen, observations[0])
            np.testing.assert_array_equal(info["d"], infos["d"][0])
    one.reset(seed=7)
    action = np.array([-0.4, 0.8])
    for step in range(1, 6):
        seen, reward, terminated, truncated, info = one.step(action)
        observations, rewards, _, _, infos = both.step(action[None])
        final = infos["final_info"] if step == 5 else infos
        np.testing.assert_array_equal(info["d"], final["d"][0])
        assert info["cost"] == final["cost"][0]
        assert reward == rewards[0]
        assert not terminated
        assert truncated == (step == 5)
    np.testing.assert_array_equal(seen, infos["final_obs"][0])
    assert not np.array_equal(seen, observations[0])
    one.close()
    both.close()


def test_one_world_is_kept_out_of_a_hazard_by_a_filter(python: str) -> None:
    import safety_bridge  # noqa: F401

    hazards = np.random.RandomState(7).uniform(-1.0, 1.0, (3, 2))

    def model(observations: Any, actions: Any) -> Any:
        """The stand-in moves by a tenth of an action."""
        away = hazards - (observations[:, None, :2] + 0.1 * actions[:, None])
        d = np.hypot(*np.moveaxis(away, 2, 0))
        return d, -(away * actions[:, None]).sum(2) / d

    costs = []
    for certificate in (None, safemr.EnergyCertificate("phi_0", paper.PHI_0)):
        env: Any = gymnasium.make("SafetyPointGoal1-v0")
        if certificate is not None:
            env = safemr.SafetyFilter(env, certificate, model=model)
        env.reset(seed=7)
        steps = [env.step(np.array([-0.4, 0.8]))[4] for _ in range(5)]  # into a hazard
        costs.append(sum(info["cost"] for info in steps))
        env.close()
    assert costs[0] > 0 == costs[1]
    assert any(info["filter_intervened"] for info in steps)


@pytest.mark.parametrize(
    ("name", "words"),
    [("wheels", "ValueError: a wheel fell off"), ("exits", "exit status 3")],
)
def test_a_failure_of_the_simulator_is_one_line(python: str, name: str, words: str) -> None:
    envs = batch(1, name)
    envs.reset(seed=0)
    with pytest.raises(UserError, match=words) as caught:
        envs.step(np.ones((1, 2)))
    assert "\n" not in str(caught.value)
    assert python in str(caught.value)


def test_what_is_wrong_with_the_other_python_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, python: str, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "no python").write_text("#!/bin/sh\necho it never was >&2\nexit 4\n")
    (tmp_path / "no python").chmod(0o755)
    old = tmp_path / "old"
    old.mkdir()
    with pytest.raises(UserError, match=r"ends: ValueError: a wheel is missing"):
        batch(1, "broken")
    for path, words in (
        ("", "SAFETY_GYMNASIUM_PYTHON is not set.*requirements.txt"),
        (str(tmp_path / "nowhere"), "nowhere does not start: No such file or directory"),
        (str(tmp_path / "no python"), "exit status 4, it never was"),
        (sys.executable, "ModuleNotFoundError: No module named 'safety_gymnasium'; pip install"),
        (stand_in(old, VERSIONS | {"mujoco": "3.1"}), "mujoco 3.1, not .* mujoco 2.3.3: pip"),
    ):
        monkeypatch.setenv("SAFETY_GYMNASIUM_PYTHON", path)
        assert cli_error(["check", ID], capfd).count("\n") == 1
        with pytest.raises(UserError, match=words):
            batch(1)


def cli_error(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    from safemr import foreign_check

    foreign_check._examined.cache_clear()
    with pytest.raises(SystemExit):
        cli.main(arguments)
    return capfd.readouterr().err


def test_the_simulator_ends_with_the_program_that_started_it(python: str, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "from safety_bridge.batch import SafetyBatch\n"
        "import time\n"
        "envs = SafetyBatch(1, 'wheels', 5)\n"
        "print(envs._child.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{FOLDER}"}
    started = subprocess.Popen(
        [sys.executable, str(program)], stdout=subprocess.PIPE, env=environment, text=True
    )
    assert started.stdout is not None
    child = int(started.stdout.readline())
    os.kill(child, 0)  # it is there
    started.send_signal(signal.SIGKILL)
    started.wait()
    started.stdout.close()
    until = time.monotonic() + 30.0
    while time.monotonic() < until and _runs(child):
        time.sleep(0.02)
    assert not _runs(child)


def _runs(pid: int) -> bool:
    """Whether there is such a process that is no zombie."""
    state = subprocess.run(
        ["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False
    ).stdout.strip()
    return state not in ("",) and not state.startswith("Z")


def test_it_trains_and_no_path_of_this_machine_is_in_the_record(
    python: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from safemr import foreign_check

    foreign_check._examined.cache_clear()
    assert cli.main(["check", ID, "--set", "task.max_episode_steps=40"]) == 0
    assert f"ready: safemr train --task {ID}" in capsys.readouterr().out
    record = safemr.train(
        ID, steps=640, out=tmp_path / "out", log_points=2, eval_episodes=2, quiet=True,
        start_steps=160, batch_size=32, hidden=16, interface={"action_repeat": 3},
        settings={"max_episode_steps": 40},
    )  # fmt: skip
    assert record.rows[-1]["eval_length"] == 40
    texts = [path.read_text() for path in record.folder.glob("*.json")]
    assert texts
    assert not any(str(tmp_path / "python") in text for text in texts)
    assert json.loads((record.folder / "config.json").read_text())["task"]["version"] == 1


def test_the_reach_of_a_robot(importable: None) -> None:
    from safety_bridge.server import reach

    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='agent' pos='3 4 0.1' euler='0 0 30'>"
        "<geom name='ball' size='0.1'/>"
        "<geom name='nose' type='box' pos='0.1 0 0' size='.05 .05 .05'/>"
        "<geom name='wheel' type='cylinder' euler='90 0 0' size='0.02 0.12'/>"
        "</body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    agent = SimpleNamespace(
        engine=SimpleNamespace(model=model, data=data), body_info=SimpleNamespace()
    )
    for names, expected in (
        (["ball"], 0.1),
        (["ball", "nose"], np.hypot(0.15, 0.05)),
        (["wheel"], np.hypot(0.12, 0.02)),
    ):
        agent.body_info.geom_names = names
        assert reach(agent) == pytest.approx(expected)


def test_the_sky_is_read_from_no_picture(tmp_path: Path, importable: None) -> None:
    from safety_bridge.server import WithoutSky

    path = tmp_path / "assets.yaml"
    path.write_text("textures: {skybox: {'@fileup': star.png}, floor: {'@builtin': checker}}\n")
    shim = WithoutSky(yaml)
    for _ in range(2):
        with open(path) as file:
            found = shim.load(file, Loader=shim.FullLoader)["textures"]
        assert "@fileup" not in found["skybox"]
        assert found["floor"] == {"@builtin": "checker"}


# With one step of the physics an action, of h seconds, the place moves by h times the velocity
# reached: d by h times its rate but for (h v)^2 / 2 d.
SUBSTEPS = """
import sys
sys.path.insert(0, sys.argv[1])
import numpy as np
import server

worlds = server.Worlds(server.simulator(), sys.argv[2], 2, 10000)
tasks = [env.unwrapped.task for env in worlds._envs]
for task in tasks:
    task.sim_conf.frameskip_binom_n = 1
m, random, errors, speeds = worlds.hello["obstacles"], np.random.default_rng(0), [], []
views = worlds.reset(np.array([0, 1]))
h = tasks[0].model.opt.timestep
for step in range(1500):
    before = views.copy()
    if step % 100 == 0:
        actions = random.uniform(-1.0, 1.0, (2, 1)) + random.uniform(-0.1, 0.1, (2, 2))
    worlds.step(actions)
    d, rate = views[:, -2 * m : -m], views[:, -m:]
    velocity = np.array([np.hypot(*task.agent.vel[:2]) for task in tasks])
    bound = (h * velocity[:, None]) ** 2 / (2.0 * np.maximum(d, 0.05)) + 1e-9
    errors.append((np.abs(d - before[:, -2 * m : -m] - h * rate) / (1.5 * bound))[d > 0.05].max())
    speeds.append(velocity.max())
print(max(errors), max(speeds))
"""


@pytest.mark.slow
@pytest.mark.skipif(not REAL, reason="SAFETY_GYMNASIUM_PYTHON names no Python")
@pytest.mark.parametrize(("robot", "task"), TASKS)
def test_rates_of_the_simulator_itself(robot: str, task: str) -> None:
    command = [str(REAL), "-I", "-c", SUBSTEPS, str(FOLDER / "safety_bridge")]
    done = subprocess.run(
        [*command, f"Safety{robot}{task}-v0"], capture_output=True, text=True, check=True
    )
    error, speed = map(float, done.stdout.split())
    assert speed > 0.3
    assert error < 1.0


@pytest.mark.slow
@pytest.mark.skipif(not REAL, reason="SAFETY_GYMNASIUM_PYTHON names no Python")
@pytest.mark.parametrize(("robot", "task"), TASKS)
def test_costs_of_the_simulator_itself(robot: str, task: str) -> None:
    """Only d < d_min costs anything and, in a hazard, always does; a seed decides the numbers."""
    envs = batch(8, f"Safety{robot}{task}-v0", 250)
    again = batch(8, f"Safety{robot}{task}-v0", 250)
    random = np.random.default_rng(0)
    infos = envs.reset(seed=0)[1]
    np.testing.assert_array_equal(again.reset(seed=0)[1]["d"], infos["d"])
    actions, paid = np.zeros(envs.action_space.shape), 0
    hazards = {"Goal1": 8, "Push1": 2, "Push2": 4}[task]
    for step in range(500):
        if step % 25 == 0:
            actions = random.uniform(-1.0, 1.0, actions.shape)
            actions[:, -1] *= 0.1 if robot == "Point" else 1.0  # its second one turns
            if robot == "Car":
                actions[:, 1] = actions[:, 0] + 0.01 * random.normal(size=8)
        _, _, _, truncated, infos = envs.step(actions)
        if step < 10:
            np.testing.assert_array_equal(again.step(actions)[4]["d"], infos["d"])
        if truncated.any():
            continue
        costs = infos["cost"] > 0.0
        assert ((infos["d"] < envs.d_min).any(1) | ~costs).all()
        assert (costs | (infos["d"][:, :hazards] >= envs.d_min).all(1)).all()
        paid += costs.sum()
    assert paid > 0
    envs.close()
    again.close()
