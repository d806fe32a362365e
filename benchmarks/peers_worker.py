"""What `benchmarks.peers` runs in the environment of another package, with its Python.

    PYTHON -m benchmarks.peers_worker '{"work": "omnisafe_epochs", ...}'

Answers are lines of JSON: first the versions of the packages that matter, then one for every line
that is read, which asks for one more block. It ends when its input does. Of this repository it
needs the standard library's `benchmarks.stopwatch`, the repairs with which Safety-Gymnasium can be
imported, and, to learn on our task, ``envs``.
"""

from __future__ import annotations

import json
import os
import sys
import time
from importlib import metadata
from typing import Any

from benchmarks.stopwatch import Stopwatch


class Answers:
    """Standard input and output as a channel; whatever else is printed goes to standard error."""

    def __init__(self) -> None:
        self._channel = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)

    def say(self, answer: dict[str, Any]) -> None:
        print(json.dumps(answer), file=self._channel, flush=True)

    def wait(self) -> None:
        """Until a block is asked for. Raises SystemExit where the input has ended."""
        if not sys.stdin.readline():
            sys.exit()


def versions(*packages: str) -> dict[str, Any]:
    found = {name: metadata.version(name) for name in packages}
    return {"versions": {"python": ".".join(map(str, sys.version_info[:3])), **found}}


def omnisafe_epochs(
    answers: Answers, task: str, epoch_steps: int, batch: int, passes: int, early_stop: bool
) -> None:
    """PPO-Lagrangian's own ``learn``, one epoch a block."""
    from examples.safety_gymnasium.safety_bridge.server import simulator

    simulator()
    import torch
    import yaml
    from safety_gymnasium import world

    world.yaml = yaml  # users of OmniSafe have its simulator with the sky
    import omnisafe

    torch.manual_seed(100)
    settings = {
        "seed": 100,
        "train_cfgs": {"torch_threads": 1, "total_steps": 500 * epoch_steps},
        "algo_cfgs": {
            "steps_per_epoch": epoch_steps,
            "update_iters": passes,
            "batch_size": batch,
            "kl_early_stop": early_stop,
        },
    }
    agent = omnisafe.Agent("PPOLag", task, custom_cfgs=settings).agent
    clock, adapter, steps = Stopwatch(), agent._env, 0
    env = adapter._env
    while not hasattr(env, "_support_envs"):  # OmniSafe's wrappers around its adapter
        env = env._env
    clock.time("environment steps", env, "step")
    clock.time("environment steps", env, "reset")
    clock.time("resets", env._env.unwrapped, "reset")
    clock.time("learning", agent, "_update")
    clock.time("acting", adapter, "rollout")
    actor_step, rollout = agent._update_actor, adapter.rollout

    def counted(*arguments: Any) -> None:
        nonlocal steps
        steps += 1
        actor_step(*arguments)

    def asked(*arguments: Any, **keywords: Any) -> None:
        """At the start of an epoch: tells of the one before, and waits."""
        nonlocal steps
        clock.lap()
        if steps:
            made = {
                "passes": steps / -(-epoch_steps // batch),
                "resets of a world": 1_000 * clock.calls["resets"] / epoch_steps,
            }
            answers.say({"count": epoch_steps, "parts": dict(clock.spent), **made})
        answers.wait()
        clock.reset()
        steps = 0
        rollout(*arguments, **keywords)

    agent._update_actor, adapter.rollout = counted, asked
    answers.say(versions("omnisafe", "safety-gymnasium", "mujoco", "gymnasium", "numpy", "torch"))
    agent.learn()


def sb3_updates(
    answers: Answers, width: int, lr: float, observations: int, actions: int, held: int, count: int
) -> None:
    """Gradient steps of soft actor-critic, ``count`` a block; the memory holds random numbers."""
    import gymnasium
    import numpy as np
    from stable_baselines3.common.logger import Logger

    class Shapes(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-1.0, 1.0, (observations,))
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (actions,))

    model = soft_actor_critic(Shapes(), width, lr, buffer_size=held)
    model.set_logger(Logger(None, []))
    memory, random = model.replay_buffer, np.random.default_rng(0)
    for values in (memory.observations, memory.next_observations, memory.actions, memory.rewards):
        values[:] = random.uniform(-1.0, 1.0, values.shape)
    memory.full = True
    clock = Stopwatch()
    clock.time("gathering", memory, "sample")
    clock.time("update", model, "train")
    answers.say(versions("stable-baselines3", "numpy", "torch"))
    while True:
        answers.wait()
        clock.reset()
        model.train(count, model.batch_size)
        clock.lap()
        answers.say({"count": count, "parts": dict(clock.spent)})


def sb3_learning(
    answers: Answers,
    task: str,
    seed: int,
    every: int,
    episodes: int,
    layouts: int,
    width: int,
    lr: float,
    **options: Any,
) -> None:
    """Soft actor-critic on our scalar environment; a block is ``every`` steps and an evaluation."""
    import gymnasium
    import numpy as np

    import envs as tasks  # registers them

    assert tasks.__doc__
    name = f"{task}-v0"
    started = soft_actor_critic(gymnasium.make(name), width, lr, seed=seed, **options)
    started.learn(300)  # what is loaded and compiled once
    model = soft_actor_critic(gymnasium.make(name), width, lr, seed=seed, **options)
    flown = [gymnasium.make(name) for _ in range(episodes)]

    def evaluated() -> float:
        """Mean return of the deterministic policy; all episodes are of one length."""
        seen = [env.reset(seed=layouts + index)[0] for index, env in enumerate(flown)]
        total, ended = 0.0, False
        while not ended:
            chosen, _ = model.predict(np.array(seen), deterministic=True)
            steps = [env.step(action) for env, action in zip(flown, chosen, strict=True)]
            seen = [step[0] for step in steps]
            total += sum(step[1] for step in steps)
            ended = steps[0][2] or steps[0][3]
        return total / episodes

    answers.say(versions("stable-baselines3", "gymnasium", "mujoco", "numba", "numpy", "torch"))
    while True:
        answers.wait()
        begun, before = time.process_time(), model.num_timesteps
        model.learn(every, reset_num_timesteps=before == 0, log_interval=10**9)
        spent = time.process_time() - begun
        steps = model.num_timesteps - before
        answers.say({"steps": steps, "cpu_s": spent, "return": evaluated()})


def soft_actor_critic(env: Any, width: int, lr: float, **options: Any) -> Any:
    """Stable-Baselines3's, one thread; what is not given is its own default."""
    import torch
    from stable_baselines3 import SAC

    torch.set_num_threads(1)
    network = {"net_arch": [width, width]}
    return SAC("MlpPolicy", env, lr, policy_kwargs=network, device="cpu", **options)


WORK = {work.__name__: work for work in (omnisafe_epochs, sb3_updates, sb3_learning)}


def main() -> None:
    answers = Answers()
    settings = json.loads(sys.argv[1])
    WORK[settings.pop("work")](answers, **settings)


if __name__ == "__main__":
    main()
