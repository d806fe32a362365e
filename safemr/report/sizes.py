"""``safemr oracle``: the sizes of certificates beside the least that is feasible, as a table."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from safemr.certificates.certificate import EnergyCertificate
from safemr.certificates.families import PAPER
from safemr.errors import UserError
from safemr.experiment.planning import describe_task, fitted_interface
from safemr.experiment.sections import told
from safemr.experiment.strict_yaml import assignment
from safemr.learning.interface import Interface
from safemr.measure.certify import DEFAULT_TASK
from safemr.measure.oracle import COLUMNS, ORACLE, Yardstick
from safemr.measure.store import Measurements
from safemr.report import statistics
from safemr.report.tables import ABSENT, FEW, Table, plus_minus


def table(sizes: pd.DataFrame, others: Others | None = None) -> Table:
    """A row a task and certificate, those of one variant together.

    sizes: `safemr.measure.oracle.measured_sizes`, or what was read of its CSV.
    """
    if others:
        sizes = pd.concat([sizes, others.sizes], ignore_index=True)
    rows: list[dict[str, Any]] = []
    named = sizes.assign(name=sizes["variant"].fillna(sizes["certificate"]))
    for (task, name), part in named.groupby(["task", "name"], sort=False):
        yardstick = named[(named["task"] == task) & (named["certificate"] == ORACLE)]
        area = statistics.mean_interval(part["area"].to_numpy())
        rows.append(
            {
                "task": task, "certificate": name, "runs": int(part["variant"].notna().sum()),
                **{parameter: part[parameter].mean() for parameter in PAPER.names},
                "area": area.mean, "area_low": area.low, "area_high": area.high,
                "ratio": area.mean / float(yardstick["area"].iloc[0]),
                "feasible": int((part["infeasible"] == 0).sum()), "certificates": len(part),
                "infeasible_share": float((part["infeasible"] / part["encounters"]).max()),
                "worst": float(part["worst"].max()),
            }
        )  # fmt: skip
    data = pd.DataFrame(rows)
    display = pd.DataFrame(
        [
            [
                row["task"], row["certificate"], str(row["runs"] or ABSENT),
                ", ".join(f"{row[parameter]:.3f}" for parameter in PAPER.names),
                plus_minus(row["area"], row["area_low"], row["area_high"], 3),
                f"{row['ratio']:.2f}",
                f"{row['feasible']} of {row['certificates']}",
                f"{100 * row['infeasible_share']:.4f}%",
                ABSENT if np.isnan(row["worst"]) else f"{row['worst']:+.4f}",
            ]
            for row in rows
        ],
        columns=["task", "certificate", "runs", "[sigma, k, n]", "unsafe area (m²)",
                 "of the oracle's", "feasible", "encounters without a safe action",
                 "least g at the worst"],
    )  # fmt: skip
    caption = (
        "How small a certificate may be. Unsafe area: {phi > 0} beyond d_min, averaged over the "
        "motions that the robot reaches from rest and their directions. Feasible: in every such "
        "motion, at every place of a grid around an obstacle, some action keeps the constraint; "
        "the share and the least g are of the worst run. The oracle is the feasible member of the "
        "paper's family with the least area, in the box in which the learners keep zeta by default."
    )
    if others and len(others.sizes):
        caption += f" Of another configuration's runs (under {others.root}): {others.told}."
    return Table("sizes", caption, data, display, [FEW])


KEPT = ("task", "variant", "seed", "k", "area", "regularized")  # by `merged`


def _remedy(root: Path) -> str:
    return f"make the results under {root} first, or say sizes: true"


def missing(sizes: Path, *flights: Path) -> str | None:
    """What to say if one of the files that `Others.read` takes is missing."""
    for path in (sizes, *flights):
        if not path.exists():
            return f"sizes.beside: {path} is missing; {_remedy(sizes.parent.parent)}"
    return None


@dataclass(frozen=True)
class Others:
    """Certificates of the runs of another configuration that this one does not have.

    root: its results root; sizes: its rows for them, of `safemr.measure.oracle.COLUMNS`; flown:
    the flights of all its runs on these tasks, by task, variant, seed, metric and value.
    """

    root: Path
    sizes: pd.DataFrame
    flown: pd.DataFrame

    @property
    def told(self) -> str:
        """For a caption: the variants and, where seeds differ from variant to variant, these."""
        seeds = {
            name: told(part["seed"].astype(int).unique())
            for name, part in self.sizes.groupby("variant", sort=False)
        }
        if len(set(seeds.values())) < 2:
            return ", ".join(seeds)
        return ", ".join(f"{name} (seeds {which})" for name, which in seeds.items())

    @classmethod
    def read(cls, sizes: Path, *flights: Path, ours: pd.DataFrame, flown: pd.DataFrame) -> Others:
        """What a configuration lacks on its tasks.

        sizes, flights: files that the pipeline made under the summary of the other's results root;
        ours: this configuration's sizes, as `table` takes them; flown: its flights.
        Raises UserError where a file is missing or old, where sizes were measured for other
        decisions, or where a task, or a variant that both have, has no run in both that flew alike:
        areas, feasibility and returns of the two could then not be compared.
        """
        root = sizes.parent.parent
        if said := missing(sizes, *flights):
            raise UserError(said)
        remedy = _remedy(root)
        theirs, flown_there = pd.read_csv(sizes), pd.concat(map(pd.read_csv, flights))
        if absent := [name for name in COLUMNS if name not in theirs]:
            raise UserError(f"sizes.beside: {sizes} has no column {absent[0]!r}; {remedy}")
        tasks = list(ours["task"].unique())
        for task in tasks:
            here, there = (
                one.loc[(one["task"] == task) & (one["certificate"] == ORACLE), "area"].to_list()
                for one in (ours, theirs)
            )
            if not there:
                raise UserError(f"sizes.beside: {sizes} does not have {task}; say sizes: true")
            if not np.allclose(here, there):
                raise UserError(
                    f"sizes.beside: on {task} the least feasible certificate has the unsafe area "
                    f"{here[0]:.4f} here and {there[0]:.4f} under {root}: give the task the same "
                    "interface as there, or say sizes: true"
                )
            if not _flew_alike(flown, flown_there, task):
                raise UserError(
                    f"sizes.beside: no run on {task} has the same return here and under {root}, so "
                    "that flights may be on other layouts: have a run of it here, too, with the "
                    "same unseen_layouts, or say sizes: true"
                )
        keys = ["task", "variant", "seed"]
        theirs = theirs[theirs["task"].isin(tasks)].dropna(subset="variant")
        here, there = (
            one.dropna(subset="variant").astype({"seed": int}).set_index(keys).index
            for one in (ours, theirs)
        )
        both = set(here.droplevel("seed")) & set(there.droplevel("seed"))
        if apart := sorted(both - set(here.intersection(there).droplevel("seed"))):
            task, variant = apart[0]
            raise UserError(
                f"sizes.beside: {variant} has runs on {task} here and under {root}, but none with "
                "the same seed, so that they may differ in more: rename it, or have such a run"
            )
        return cls(root, theirs[~there.isin(here)], flown_there)


def _flew_alike(first: pd.DataFrame, second: pd.DataFrame, task: str) -> bool:
    """Whether there are runs on the task in both, and all of them have one return."""
    both = pd.merge(
        *(one[(one["task"] == task) & (one["metric"] == "eval_return")] for one in (first, second)),
        on=["variant", "seed"],
    )
    return bool(len(both)) and np.allclose(both["value_x"], both["value_y"])


def merged(sizes: pd.DataFrame, flown: pd.DataFrame) -> pd.DataFrame:
    """Area and feasibility of every run's certificate with the return and the violating steps of
    its final policy on unseen layouts: task, variant, seed, k, area, regularized, feasible, return,
    violating.

    sizes: as in `table`; flown: task, variant, seed, metric, value.
    """
    runs = sizes.dropna(subset="variant")
    wide = flown.pivot_table(
        index=["task", "variant", "seed"], columns="metric", values="value"
    ).reset_index()
    found = runs.astype({"seed": int}).merge(wide, on=["task", "variant", "seed"])
    return pd.DataFrame(
        {
            **{name: found[name] for name in KEPT},
            "feasible": found["infeasible"] == 0,
            "return": found["eval_return"],
            "violating": found["eval_cost_indicator"],
        }
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """`safemr oracle`; prints the table of a task's references and of a certificate given."""
    parser = argparse.ArgumentParser(
        prog="safemr oracle", description="the least feasible certificate of a task, and others"
    )
    parser.add_argument("--task", default=DEFAULT_TASK, help=f"default {DEFAULT_TASK}")
    parser.add_argument("--set", action="append", default=[], metavar="interface.NAME=VALUE",
                        help="of the decisions, such as interface.action_repeat=5")  # fmt: skip
    for name in PAPER.names:
        parser.add_argument(f"--{name}", type=float, help="of a certificate to compare, in metres")
    options = parser.parse_args(arguments)
    settings = dict(map(assignment, options.set))
    for name in settings:
        if not name.startswith("interface."):
            raise UserError(
                f"--set {name}: only decisions have settings here: interface.NAME=VALUE"
            )
    entry = {name.removeprefix("interface."): value for name, value in settings.items()}
    zeta = [getattr(options, name) for name in PAPER.names]
    if None in zeta and any(value is not None for value in zeta):
        raise UserError("--sigma, --k and --n belong together: give all three")
    task = describe_task(options.task, {}, "--task")
    interface = fitted_interface(Interface.read(entry or None), task, "--set interface")
    yardstick = Yardstick(task, interface)
    with tempfile.TemporaryDirectory() as folder:
        measurements = Measurements(folder)
        rows = yardstick.references(measurements)
        if None not in zeta:
            given = EnergyCertificate("given", PAPER.at(zeta))
            rows.append(yardstick.row(measurements, given))
    print(table(pd.DataFrame(rows, columns=COLUMNS)).markdown())
    return 0
