"""One training run from a resolved configuration to its record.

    safemr train --task Pillars-0.15-Goal --algorithm safemr --seed 100 --steps 100000

The pipeline calls the same program with ``--resolved`` (the run's configuration as JSON). Whatever
the algorithm, this file evaluates, records, checkpoints and resumes; the algorithm only trains.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from safemr.certificates import families
from safemr.conventions import evaluation_seed
from safemr.environments import SafetyEnvs, check_envs, exact_resume
from safemr.errors import UserError, tell
from safemr.experiment import planning, records
from safemr.experiment.config import WANDB_MODES
from safemr.experiment.provenance import distribution_of
from safemr.experiment.sections import checked_name
from safemr.experiment.signals import StoppedError, StopSignals
from safemr.experiment.strict_yaml import assignment
from safemr.learning.interface import Interface
from safemr.paper import Zeta
from safemr.tasks import is_foreign, make_envs

if TYPE_CHECKING:
    from safemr.experiment.checkpoints import RunSession


class Progress:
    """What a person sees: a line per log point, redrawn in place on a terminal."""

    def __init__(
        self, label: str, steps: int, stream: TextIO, parameters: Sequence[str] = Zeta._fields
    ) -> None:
        self._label, self._steps, self._stream = label, steps, stream
        self._parameters = parameters  # of the energy function, shown where they are logged

    def show(self, row: Mapping[str, float]) -> None:
        def number(name: str, form: str = ".2f") -> str:
            value = row.get(name, float("nan"))
            return "-" if value != value else format(value, form)

        share = min(row["step"] / self._steps, 1.0)
        rate = row["time_steps_per_s"]
        left = (self._steps - row["step"]) / rate if rate > 0 else 0.0
        zeta = ""
        if all(name in row for name in self._parameters):
            zeta = " | zeta " + " ".join(number(name, ".3f") for name in self._parameters)
        terminal = self._stream.isatty()
        bar = "#" * round(20 * share)
        line = (
            f"{self._label} "
            + (f"[{bar:<20}] " if terminal else "")
            + f"{int(row['step'])}/{self._steps} | {rate:.0f} steps/s | train return "
            f"{number('train_return')} cost {number('train_cost')} | eval return "
            f"{number('eval_return')} cost {number('eval_cost')}{zeta} | "
            f"{int(max(left, 0.0)) // 60}:{int(max(left, 0.0)) % 60:02d} left"
        )
        end = "\n" if not terminal or share >= 1.0 else ""
        tell(("\r\x1b[K" if terminal else "") + line, self._stream, end=end)


def train(
    config: Mapping[str, Any],
    session: RunSession,
    *,
    label: str = "",
    stream: TextIO | None = None,
    wandb: Mapping[str, str] | None = None,
) -> None:
    """Trains inside an open ``session``, continuing from its checkpoint where there is one.

    Raises UserError where the installed code is not the version that ``config`` asks for, and
    `safemr.learning.contract.TrainingDivergedError` when a quantity stops being finite or
    becomes absurdly large.
    """
    import torch

    from safemr.experiment.wandb_log import WandbLog
    from safemr.learning.contract import check_parameters
    from safemr.learning.evaluation import evaluate

    # One run is one thread: at these sizes more threads only wait for each other.
    torch.set_num_threads(1)
    described = config["algorithm"]
    algorithm = planning.load_algorithm(described["name"])
    if algorithm.version != described["version"]:
        raise UserError(
            f"the run asks for {described['name']} version {described['version']}, the installed "
            f"code is version {algorithm.version}: check out the revision that made the record, "
            "or resolve the configuration anew"
        )
    steps, log_every, evaluation = config["steps"], config["log_every"], config["evaluation"]
    evaluation_envs = make_envs(config["task"], evaluation["episodes"])
    check_envs(evaluation_envs)
    interface = Interface.read(config.get("interface")).fitted(evaluation_envs)

    def environments(num_envs: int) -> SafetyEnvs:
        return interface.around(make_envs(config["task"], num_envs))

    hyperparameters = algorithm.hyperparameters(**described["hyperparameters"])
    trainer = algorithm.trainer(hyperparameters, environments, config["seed"], steps)
    state = session.resume()
    if state is not None:
        trainer.load_state_dict(state)
        tell(f"{label} continues at step {trainer.step}", stream)
    family = families.named(described["hyperparameters"].get("family", families.PAPER.name))
    progress = Progress(label, steps, stream or sys.stderr, family.names)
    ending = contextlib.closing(trainer) if hasattr(trainer, "close") else contextlib.nullcontext()
    with ending, WandbLog(config, session, wandb or {}) as wandb_log:
        while trainer.step < steps:
            begun, before = time.perf_counter(), trainer.step
            metrics = trainer.advance(min((before // log_every + 1) * log_every, steps))
            trained = time.perf_counter()
            check_parameters(trainer.step, trainer.policy.network.parameters)
            if trainer.step // evaluation["every"] > before // evaluation["every"]:
                result = evaluate(trainer.policy, evaluation_envs, evaluation["seed"])
                metrics |= {f"eval_{name}": value for name, value in result.items()}
            row = {
                "step": trainer.step,
                **metrics,
                "time_wall_s": session.elapsed()["wall_s"],
                "time_steps_per_s": (trainer.step - before) / (trained - begun),
                "time_eval_s": time.perf_counter() - trained,
            }
            session.record(row)
            progress.show(row)
            wandb_log.log(row)
            session.maybe_checkpoint(trainer.state_dict)
    notes: dict[str, Any] = dict(getattr(trainer, "notes", {}))
    if not exact_resume(evaluation_envs):
        notes["exact_resume"] = False
    if is_foreign(config["task"]):
        notes["task_package"] = distribution_of(config["task"]["id"].partition(":")[0])
    session.finish(trainer.policy.arrays(), notes)


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="safemr train",
        description=__doc__,
        epilog="Tasks, algorithms and what can be --set, with defaults and meaning: "
        "`safemr list`, `safemr list ALGORITHM`.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    asked = {"-h", "--help"} & set(sys.argv[1:] if argv is None else argv)
    tasks = ", ".join(planning.task_names()) if asked else ""  # imports the simulator
    parser.add_argument(
        "--task",
        help=f"one of {tasks}, or Gymnasium's id of an environment from outside, with the package "
        "that registers it (my_package:MyTask-v0, docs/your-own.md)",
    )
    parser.add_argument("--task-name", help="what the task is called with settings of its own")
    parser.add_argument("--algorithm", help=f"one of {', '.join(planning.algorithm_names())}")
    parser.add_argument("--seed", type=int, default=100, help="0-9 are the reported seeds")
    parser.add_argument("--steps", type=int, default=320_000, help="environment steps")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="override a hyperparameter; task.NAME=VALUE is a setting of the environment, "
        "interface.NAME=VALUE one of how the learner meets it",
    )
    parser.add_argument("--log-points", type=int, default=20, help="rows of progress.csv")
    parser.add_argument("--eval-episodes", type=int, default=10)
    parser.add_argument(
        "--eval-seed", type=int, help="first layout (default: that of reported or of tuning seeds)"
    )
    parser.add_argument(
        "--resolved", help="a run's complete configuration as JSON, or a file of it"
    )
    parser.add_argument("--variant", help="label of the run (default: the algorithm's name)")
    parser.add_argument(
        "--out", "--root", dest="root", type=Path, default=Path("results"), help="results root"
    )
    parser.add_argument("--wandb", choices=WANDB_MODES, default="disabled")
    parser.add_argument("--wandb-project", default="safemr")
    parser.add_argument("--wait", action="store_true", help="wait for another process on this run")
    parser.add_argument(
        "--die-with-parent", action="store_true", help="stop when the parent process is gone"
    )
    parser.add_argument(
        "--attempt",
        type=int,
        default=1,
        help="which try of one Snakemake this is: from the second on a run that diverged is left",
    )
    return parser.parse_args(argv)


def resolve(arguments: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """The run's configuration and label from command-line arguments."""
    if arguments.resolved:
        text = arguments.resolved
        try:
            if not text.lstrip().startswith("{"):
                text = Path(text).read_text(encoding="utf-8")
            config = json.loads(text)
            name = config["algorithm"]["name"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"--resolved {arguments.resolved[:60]}: not a run: {error}") from error
        return config, arguments.variant or name
    if not arguments.task or not arguments.algorithm:
        raise UserError("give --task and --algorithm (or --resolved)")
    if arguments.eval_seed is None:
        arguments.eval_seed = evaluation_seed(arguments.seed)
    for name in ("seed", "steps", "log_points", "eval_episodes", "eval_seed"):
        if getattr(arguments, name) < (0 if "seed" in name else 1):
            raise UserError(f"--{name.replace('_', '-')} must be positive")
    overrides: dict[str, Any] = dict(
        one if isinstance(one, tuple) else assignment(one) for one in arguments.set
    )
    settings, asked = (
        {
            name.removeprefix(prefix): overrides.pop(name)
            for name in list(overrides)
            if name.startswith(prefix)
        }
        for prefix in ("task.", "interface.")
    )
    task = _task(arguments, settings)
    where = "--set interface"
    interface = planning.fitted_interface(Interface.read(asked, where), task, where)
    algorithm = planning.load_algorithm(arguments.algorithm, "--algorithm")
    log_every = max(arguments.steps // arguments.log_points, 1)
    values = planning.hyperparameters(algorithm, overrides, "--set")
    planning.check_setting(
        algorithm, values, task, arguments.steps, arguments.algorithm, interface.action_repeat
    )
    run = planning.make_run(
        task,
        algorithm,
        values,
        variant=arguments.variant or arguments.algorithm,
        seed=arguments.seed,
        steps=arguments.steps,
        interface=interface,
        log_every=log_every,
        evaluation={
            "every": log_every,
            "episodes": arguments.eval_episodes,
            "seed": arguments.eval_seed,
        },
    )
    return json.loads(records.canonical_json(run.config)), run.variant


def _task(arguments: argparse.Namespace, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The task's entry; settings that make another task of it need a name."""
    if planning.is_id(arguments.task):
        foreign = planning.ForeignTask.said(arguments.task, settings, "--task")
        name = checked_name(arguments.task_name or foreign.name, "--task-name")
        return planning.describe_foreign(name, foreign, "it with --task-name")
    if arguments.task_name is None:
        task = planning.describe_task(arguments.task, settings, "--task")
        planning.check_name(task, "--set", "give it with --task-name")
        return task
    name = checked_name(arguments.task_name, "--task-name")
    planning.describe_task(arguments.task, settings, "--task")
    return planning.describe_task(name, settings, "--task-name", base=arguments.task)


def main(argv: Sequence[str] | None = None, signals: StopSignals | None = None) -> int:
    """Runs the command line; returns the exit status (2 user error, 3 locked, 4 diverged, 128 and
    the number of the signal that ended it). ``signals``: handlers that outlive this call."""
    if signals is None:
        with StopSignals() as own:
            return main(argv, own)
    arguments = _parse(argv)
    try:
        return _run(arguments, signals)
    except StoppedError as error:
        name = error.number.name
        tell(f"stopped at once by {name}; the same command continues from the last checkpoint")
        return 128 + error.number
    except UserError as error:
        tell(f"error: {error}")
        return int(getattr(error, "exit_code", 2))
    except OSError as error:  # a full disk, a folder that is not ours; checkpoints are as they were
        tell(f"error: cannot write under {arguments.root}: {error}")
        return 2


def _run(arguments: argparse.Namespace, signals: StopSignals) -> int:
    # They import torch, which takes seconds, in which a signal shall not end in a traceback.
    from safemr.experiment.checkpoints import CHECKPOINT, RunSession
    from safemr.learning.contract import TrainingDivergedError

    config, variant = resolve(arguments)
    label = f"{variant} {config['task']['name']} seed {config['seed']}"
    with RunSession(
        config,
        variant,
        arguments.root,
        wait=arguments.wait,
        die_with_parent=arguments.die_with_parent,
        signals=signals,
    ) as session:
        if session.complete:
            tell(f"{label}: already recorded in {session.folder}")
            return 0
        if arguments.attempt > 1 and (reason := session.failure()):
            tell(f"error: {label} diverged before and is not tried again: {reason}")
            return 4
        try:
            train(
                config,
                session,
                label=label,
                wandb={"mode": arguments.wandb, "project": arguments.wandb_project},
            )
        except TrainingDivergedError as error:
            session.fail(str(error))
            last = int(session.rows[-1]["step"]) if session.rows else 0
            path = session.work / CHECKPOINT
            kept = f"last good checkpoint: {path}" if path.exists() else "no checkpoint yet"
            tell(f"error: {label}: {error}; last good log point: step {last}; {kept}")
            return 4
        tell(f"{label}: record in {session.folder}")
        return 0


if __name__ == "__main__":
    # Until the process has ended: a late signal would make Snakemake remove the finished record.
    raise SystemExit(main(signals=StopSignals().install()))
