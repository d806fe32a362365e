"""The verdicts on the paper's claims in eight rows, for the front page of the repository."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePath
from typing import get_args

import pandas as pd

from safemr.experiment.sections import told
from safemr.report.findings import Verdict

# What a row says -> the claims of `safemr.report.claims` that it is about, by their names up to a
# bracket, and what each is called there; empty: what its bracket holds.
ROWS: Mapping[str, Mapping[str, str]] = {
    "SafeMR returns the most of all safe algorithms": {"highest_return": ""},
    "SafeMR ends without any violation": {"zero_violations": ""},
    "PPO-L, TRPO-L, CPO and phi_0 are unsafe on every task": {"unsafe": ""},
    "These four return more than SafeMR, on every task": {"higher_return": ""},
    "JointSIS and phi_h are safe, but return less": {"safe_but_lower": ""},
    "Two aircraft, whose true unsafe set is known": {
        "conservativeness": "SafeMR's unsafe set is smaller than JointSIS's",
        "coverage": "SafeMR's contains the true one",
        "handcrafted_coverage": "phi_h's lacks a part of the true one",
    },
    "Every state has a safe action": {
        "feasibility_paper": "under the paper's certificates",
        "feasibility_ours": "under those learned here",
    },
    "All three [a, b] work, and training does not diverge": {
        "sensitivity_return": "return above JointSIS's",
        "sensitivity_cost": "violations vanish",
        "slowest_certificate": "zeta = (sigma, k, n) settles last",
        "bounded": "losses stay bounded",
    },
}
_NOT_RUN = "not run"
# In the reason of a claim about several tasks each has its verdict (`findings.overall`).
_TASK = re.compile(r"(?:^|; )([^;:]+): (confirmed|refuted|inconclusive), ")


def verdicts(claims: pd.DataFrame, runs: pd.DataFrame, figures: PurePath) -> str:
    """Markdown of the short table: claim, verdict, links to the figures that show it.

    claims: the table of claims. runs: the runs that it is from, with seed and cpu_s. figures: the
    folder of the figures as links from the table's own place say it.

    Raises:
        KeyError: a claim stands in no row.
    """
    placed = {name: row for row, parts in ROWS.items() for name in parts}
    rows: dict[str, list[pd.Series]] = {row: [] for row in ROWS}
    for _, claim in claims.iterrows():
        rows[placed[str(claim["claim"]).partition("[")[0]]].append(claim)
    lines = [f"**{_caption(runs)}**", "", "| claim | verdict | shown in |", "| --- | --- | --- |"]
    for row, found in rows.items():
        if not found:  # a configuration without the tasks that it is about
            continue
        said = [claim for claim in found if claim["verdict"] != _NOT_RUN]
        shown = dict.fromkeys(claim["figure"] for claim in said)
        links = ", ".join(f"[{name}]({(figures / name).as_posix()}.png)" for name in shown)
        lines.append(f"| {row} | {_verdict(ROWS[row], found)} | {links} |")
    return "\n".join(lines) + "\n"


def _verdict(parts: Mapping[str, str], claims: list[pd.Series]) -> str:
    """``**confirmed**: Pillars-0.15-Goal; **refuted**: ...``, of a single claim by its tasks."""
    found = [(_part(parts, claim["claim"]), claim["verdict"]) for claim in claims]
    if len(claims) == 1:
        found = _TASK.findall(str(claims[0]["reason"])) or found
    groups = {
        verdict: ", ".join(filter(None, (part for part, own in found if own == verdict)))
        for verdict in get_args(Verdict)
        if any(own == verdict for _, own in found)
    }
    return "; ".join(
        f"**{verdict}**" + f": {names}" * bool(names) for verdict, names in groups.items()
    )


def _part(parts: Mapping[str, str], claim: str) -> str:
    name, _, inside = claim.partition("[")
    return parts[name] or inside.removesuffix("]")


def _caption(runs: pd.DataFrame) -> str:
    seeds = runs["seed"].unique()
    shown = told(seeds)
    each = runs.groupby(["task", "variant"])["seed"].nunique()
    if each.min() < len(seeds):
        shown += f", {each.min()} to {each.max()} of them each" if each.max() > each.min() else ""
    hours = runs["cpu_s"].sum() / 3600
    return (
        f"The paper's claims, judged by code from {len(runs)} recorded runs (seed"
        f"{'s' * (len(seeds) > 1)} {shown}; {hours:.1f} core-hours in all)."
    )
