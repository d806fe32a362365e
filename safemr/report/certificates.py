"""``safemr certify``: the checks of certificates as table, picture and replayable examples."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from safemr.certificates import falsification
from safemr.certificates.certificate import EnergyCertificate
from safemr.certificates.families import PAPER, Parameters, named
from safemr.certificates.feasibility import BRAKINGS, CONVENTIONS
from safemr.errors import UserError
from safemr.experiment.planning import describe_task, installed
from safemr.experiment.strict_yaml import assignment
from safemr.paper import Zeta
from safemr.report.tables import Table
from safemr.tasks import Task, base_of, name_of, settings_of, task_settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

from safemr.measure.certify import (
    DEFAULT_STATES,
    DEFAULT_TASK,
    certificate_of_record,
    certify,
    contact_distance,
    example_titles,
    margin_column,
    margin_map,
    paper_certificates,
)

SAME_MARGIN = 1e-6  # processors differ by round-off
SAME_HELD_MARGIN = 1e-3  # which grows while an action is held (`safemr.certificates.point_robot`)


def certificate_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The rows of `certify` as a `Table`."""
    data = pd.DataFrame(rows)
    verdicts = {
        f"C {convention}, {braking}": [_verdict(margin) for margin in data[column]]
        for convention in CONVENTIONS
        for braking in BRAKINGS
        if (column := margin_column(convention, braking)) in data
    }
    others = {str(row["certificate"]): str(row["family"]) for row in rows if "family" in row}
    display = pd.DataFrame(
        {
            "certificate": data["certificate"],
            "task": data["task"],
            "parameters" if others else "[sigma, k, n]": [_parameters(row) for row in rows],
            **verdicts,
            "infeasible": [_share(share, data["states"][i])
                           for i, share in enumerate(data["infeasible_share"])],
            "leaking": [f"{100 * share:.3f}%" for share in data["leak_share"]],
            "least g at the worst state": [f"{margin:+.4f}" for margin in data["worst_margin"]],
            "simulator agrees": data["simulator_agrees"],
        }
    )  # fmt: skip
    if "action_repeat" in data:
        repeats = data["action_repeat"].fillna(1).astype(int)
        display["control steps a decision"] = [str(repeat) for repeat in repeats]
    if "policy_steps" in data:
        for name, heading in (("violating", "policy violates"), ("avoidable", "avoidably")):
            shares = data[f"policy_{name}_share"]
            display[heading] = ["–" if np.isnan(s) else f"{100 * s:.3f}%" for s in shares]
    caption = (
        "Certificates. Four verdicts of the analytic condition with the smallest margin in m/s^2 "
        "(C inside: (sigma + d_min)^n, outside: sigma + d_min^n; deceleration with the robot "
        "aligned, or from drag alone); share of searched states without a safe action "
        "(infeasible); of states with phi <= 0 that every action takes out of the safe set "
        "(leaking); and the worst best margin found, positive where no action is safe. Shares are "
        "uniform over distance, bearing, course, speed and turn rate; not every such state can be "
        "driven to."
    )
    notes = [
        f"{names} of {family}: no analytic verdict, as the condition is derived for the phi of "
        "[sigma, k, n]."
        for family in dict.fromkeys(others.values())
        if (names := ", ".join(name for name, of in others.items() if of == family))
    ]
    return Table("certificates", caption, data, display, notes)


def _verdict(margin: float) -> str:
    return "–" if np.isnan(margin) else f"{'holds' if margin >= 0 else 'fails'} ({margin:+.2f})"


def _parameters(row: Mapping[str, Any]) -> str:
    """The parameters in a row of `certify`; the paper's have no names beside them."""
    if "family" not in row:
        return f"[{row['sigma']:.3f}, {row['k']:.3f}, {row['n']:.3f}]"
    return ", ".join(f"{name} = {row[name]:.3f}" for name in named(row["family"]).names)


def picture(
    certificates: Sequence[EnergyCertificate], margins: pd.DataFrame, d_min: float
) -> Figure:
    """The analytic condition of certificates of one task, and ``margins`` of the last of them.

    Only those of the paper's family have that condition.
    """
    from safemr.report.figures import certificate as drawing

    zetas = {
        certificate.name: zeta
        for certificate in certificates
        if isinstance(zeta := certificate.in_metres().zeta, Zeta)
    }
    return drawing.certificate_check(zetas, d_min, margins, certificates[-1].name)


def main(arguments: Sequence[str] | None = None) -> int:
    """`safemr certify`; prints the table and, with --out, writes table, picture and examples."""
    options = _parser().parse_args(arguments)
    if options.replay is not None:
        return _replay(options)
    jobs = _jobs(options)
    rows, searches = [], []
    for certificate, task in jobs:
        print(f"certifying {certificate.name} on {name_of(task)} ...", file=sys.stderr)
        row, search = certify(certificate, task, states=options.states, seed=options.seed)
        rows.append(row)
        searches.append(search)
    table = certificate_table(rows)
    print(table.markdown())
    for row, search in zip(rows, searches, strict=True):
        print(f"worst state of {row['certificate']}: {json.dumps(search.example())}")
    if options.out is not None:
        _write(options.out, table, jobs, searches)
    return 0


def _jobs(options: argparse.Namespace) -> list[tuple[EnergyCertificate, Task]]:
    """What the command line asks for: (certificate, task) each."""
    given = (options.sigma, options.k, options.n)
    if options.family != PAPER.name and any(value is not None for value in given):
        raise UserError(f"{options.family} has other parameters than sigma, k and n: give --at")
    if options.at and options.family == PAPER.name:
        raise UserError("--at is for another --family; give --sigma, --k and --n")
    if options.record:
        if any(value is not None for value in given):
            raise UserError("give either --record or --sigma, --k and --n, not both")
        for name in ("task", "set", "eta", "at"):
            if getattr(options, name):
                raise UserError(f"--{name}: a record says its own; leave it out beside --record")
        return [certificate_of_record(Path(folder)) for folder in options.record]
    if options.family != PAPER.name:
        asked = [EnergyCertificate(options.name, _point(options.family, options.at))]
    elif all(value is None for value in given):
        asked = paper_certificates()
    elif any(value is None for value in given):
        raise UserError("--sigma, --k and --n belong together: give all three")
    else:
        if min(options.sigma, options.k) < 0 or options.n <= 0:
            raise UserError("sigma and k must not be negative and n must be positive")
        asked = [EnergyCertificate(options.name, Zeta(*given))]
    task = _task(options.task or DEFAULT_TASK, options.set)
    return [(replace(certificate, eta=options.eta), task) for certificate in asked]


def _point(name: str, values: Sequence[float]) -> Parameters:
    """Parameters of a family other than the paper's; without values, where learning starts."""
    family = named(name)
    values = values or [parameter.start for parameter in family.parameters]
    if len(values) != len(family.names):
        raise UserError(f"--at: {name} has {len(family.names)} parameters, {family.names}")
    return family.at(values)


def _task(registered: str, assignments: Sequence[str]) -> Task:
    """A registered task; with other settings (``task.NAME=VALUE``) under a name that says them."""
    settings = dict(map(assignment, assignments))
    for name in settings:
        if not name.startswith("task."):
            raise UserError(
                f"--set {name}: only the environment has settings here: task.NAME=VALUE"
            )
    settings = {name.removeprefix("task."): value for name, value in settings.items()}
    entry = describe_task(registered, settings, "--task")
    changed = task_settings(settings)
    return {**entry, "name": _named(registered, changed), "base": registered} if changed else entry


def _named(registered: str, changed: Mapping[str, Any]) -> str:
    """A task and its settings in words."""
    said = ", ".join(f"{name}={value}" for name, value in sorted(changed.items()))
    return f"{registered} with {said}" if said else registered


def _write(
    folder: Path,
    table: Table,
    jobs: Sequence[tuple[EnergyCertificate, Task]],
    searches: Sequence[falsification.Falsification],
) -> None:
    from safemr.report.figures import style

    table.write(folder)
    found = [search.example() for search in searches]
    examples = dict(zip(example_titles(jobs), found, strict=True))
    text = json.dumps(examples, indent=1, sort_keys=True) + "\n"
    (folder / "examples.json").write_text(text, encoding="utf-8")
    task = jobs[0][1]
    pictured = [job[0] for job in jobs if job[1] == task]
    margins = margin_map(pictured[-1], task)
    style.save(picture(pictured, margins, contact_distance(task)), folder / "certificates")


def _replay(options: argparse.Namespace) -> int:
    """Exit status 1 where an example does not come out as its file says."""
    path = options.replay
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        examples = content if "state" not in content else {path.stem: content}
        stated = {name: float(example["margin"]) for name, example in examples.items()}
        for name, example in examples.items():
            _check_task(options, f"{path}: {name}", installed(falsification.task_of(example)))
        results = {name: falsification.replay(example) for name, example in examples.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} holds no example written by --out ({error!r})") from error
    differing = 0
    for name, (actions, g) in results.items():
        best, repeat = int(g.argmin()), int(examples[name].get("action_repeat", 1))
        held = f" held for {repeat} control steps" if repeat != 1 else ""
        verdict = "no action is safe" if g[best] >= 0 else "a safe action exists"
        a0, a1 = actions[best]
        print(
            f"{name}: {len(g)} actions{held}, least g = {g[best]:+.6f} at ({a0:.3f}, {a1:.3f}): "
            f"{verdict}"
        )
        if abs(g[best] - stated[name]) > (SAME_MARGIN if repeat == 1 else SAME_HELD_MARGIN):
            differing += 1
            print(f"{name}: the file says {stated[name]:+.6f}: another task or version made it")
    return 1 if differing else 0


def _check_task(options: argparse.Namespace, what: str, task: Task) -> None:
    """Raises UserError where ``--task`` or ``--set`` ask for another task than an example's."""
    asked = _task(options.task or base_of(task), options.set)
    said, wanted = ((base_of(entry), task_settings(settings_of(entry))) for entry in (task, asked))
    if (options.task or options.set) and said != wanted:
        raise UserError(f"{what} is an example of {_named(*said)}, not of {_named(*wanted)}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="safemr certify", description=__doc__)
    parser.add_argument("--sigma", type=float, help="parameters in metres and seconds")
    parser.add_argument("--k", type=float)
    parser.add_argument("--n", type=float)
    parser.add_argument("--family", default=PAPER.name, metavar="PACKAGE.MODULE",
                        help="another family of energy functions")  # fmt: skip
    parser.add_argument("--at", type=float, nargs="+", default=[], metavar="NUMBER",
                        help="its parameters, in its order (default: its start)")  # fmt: skip
    parser.add_argument("--eta", type=float, default=0.0, help="eta_D of the constraint")
    parser.add_argument("--name", default="given", help="name of --sigma, --k, --n in the table")
    parser.add_argument("--task", help=f"default {DEFAULT_TASK}")
    parser.add_argument("--set", action="append", default=[], metavar="task.NAME=VALUE",
                        help="a setting of the environment")  # fmt: skip
    parser.add_argument("--record", action="append", default=[], metavar="FOLDER",
                        help="a run record: its certificate, and its policy too")  # fmt: skip
    parser.add_argument("--states", type=int, default=DEFAULT_STATES,
                        help="states searched, a power of two")  # fmt: skip
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write table, picture, examples")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="replay examples.json")
    return parser


def _share(share: float, count: int) -> str:
    """A share in per cent; none found in `count` states is not zero."""
    return f"{100 * share:.3f}%" if share else f"none of {count}"
