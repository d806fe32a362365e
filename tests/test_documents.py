"""Numbers in the documents that the records, the statistics or the code can tell."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest
from documents import PAIR, ROOT, cells, column, only, text_of, window
from scipy.special import stdtrit

from safemr.experiment import planning
from safemr.learning.networks import LOG_STD_MAX, LOG_STD_MIN
from safemr.report import statistics
from safemr.report.statistics import difference_interval

ALGORITHMS = (ROOT / "docs/algorithms.md").read_text()
REPRODUCIBILITY = (ROOT / "REPRODUCIBILITY.md").read_text()
FORMS = ("free", "literal")


@pytest.mark.parametrize(("seeds", "deviations"), [(3, 3.5), (5, 2.1)])
def test_what_a_few_seeds_can_tell_apart(seeds: int, deviations: float) -> None:
    """Four times in five, by simulation with the intervals of the tables."""
    random = np.random.default_rng(seeds)
    first = random.normal(deviations, 1.0, (4_000, seeds))
    second = random.normal(0.0, 1.0, (4_000, seeds))
    found = [difference_interval(x, y).low > 0 for x, y in zip(first, second, strict=True)]
    assert np.mean(found) == pytest.approx(0.8, abs=0.025)
    said = text_of(REPRODUCIBILITY)
    assert "their means differ by about 3.5 (n = 3) or 2.1 (n = 5) of them" in said
    half = stdtrit(seeds - 1, 0.975) / np.sqrt(seeds)
    assert f"{half:.1f} (n = {seeds})" in said


@pytest.mark.parametrize("name", ["PPO-L", "TRPO-L", "CPO"])
def test_the_runs_at_limit_25_are_told_as_recorded(name: str) -> None:
    path = only(f"bands/runs/PointGoal1/{name}/*")
    rows = [line for line in ALGORITHMS.splitlines() if line.startswith(f"| {name} | ")]
    (row,) = (line for line in rows if line.count(", ") == 8)
    _, returns, costs, multiplier = (cell.strip() for cell in row.strip("|").split("|"))
    fifths = [(1, 2e5 * part, 2e5 * (part + 1)) for part in range(5)]
    for cell, metric, unit in ((returns, "train_return", 0.1), (costs, "train_cost", 1.0)):
        for said, (_, low, high) in zip(cell.split(","), fifths, strict=True):
            assert float(said) == pytest.approx(window(path, metric, low, high), abs=0.51 * unit)
    if name != "CPO":
        assert float(multiplier) == pytest.approx(column(path, "multiplier")[-1], abs=0.006)
    else:
        reach, explained = (column(path, n) for n in ("cost_reach", "explained_variance_cost"))
        assert f"by {np.nanmean(reach):.0f} (`cost_reach`" in text_of(ALGORITHMS)
        assert f"at most {np.nanmax(explained):.2f} of the variance" in text_of(ALGORITHMS)


@pytest.mark.parametrize("name", ["PPO-L", "TRPO-L", "CPO"])
@pytest.mark.parametrize("settings", ["published", "grid"])
def test_the_runs_at_published_settings_are_told_as_recorded(name: str, settings: str) -> None:
    root, last = ("published", 240e3) if settings == "published" else ("probes", 256e3)
    path = only(f"{root}/runs/Pillars-0.15-Goal/{name}/seed100-*")
    edges = (56e3, 104e3, 152e3, 200e3, last)
    for cell, low, high in zip(cells(ALGORITHMS, name, settings), edges, edges[1:], strict=False):
        said = [float(number) for number in cell.split(",")]
        found = [window(path, metric, low, high) for metric in ("train_return", "train_cost")]
        assert said == pytest.approx(found, abs=0.051)


def test_the_literal_loss_is_told_as_recorded() -> None:
    def first_gradient(variant: str) -> float:
        paths = sorted(ROOT.glob(f"results/variants/runs/Pillars-*/{variant}/*/progress.csv"))
        assert len(paths) == 5
        gradients = [column(path, "certificate_grad_sigma") for path in paths]
        starts = [
            column(path, "step")[~np.isnan(g)][0] for path, g in zip(paths, gradients, strict=True)
        ]
        assert set(starts) == {30_000}
        return float(np.mean([gradient[~np.isnan(gradient)][0] for gradient in gradients]))

    literal, ours = first_gradient("JointSIS-literal"), first_gradient("SafeMR")
    said = text_of(ALGORITHMS)
    assert f"gradient is {literal:.2f} for JointSIS-literal and {ours:.2f} for SafeMR" in said
    slope = 2.0 * (0.3 + 0.25)  # n (sigma + d_min)^(n - 1) at the start, on Pillars-0.15-Goal
    assert f"of about a = {literal / slope:.1f} whose" in said


def test_the_settings_in_the_table_are_the_code_s() -> None:
    defaults = planning.load_algorithm("safemr").hyperparameters()
    said = text_of(ALGORITHMS)
    assert f"log alpha = {defaults.initial_log_temperature:g} | log alpha = 0" in said
    assert f"clamped to [{LOG_STD_MIN:g}, {LOG_STD_MAX:g}] | clamped to [-5, 1]" in said
    assert defaults.updates_together == 4
    updates = {
        int(column(path, "updates")[-1])
        for path in ROOT.glob("results/runs/*/SafeMR/*/progress.csv")
        if "Aircraft" not in path.parts
    }
    assert updates == {49_376, 98_504}
    assert "49,376 (98,504) in a run" in said


def test_what_the_cmdp_baselines_constrain_on_push_is_told_as_recorded() -> None:
    """Summed depth and violating steps while exploring, over the last fifth of training."""
    found: dict[str, list[float]] = {"train_cost": [], "train_cost_indicator": []}
    for task in ("Hazards-0.15-Push", "Hazards-0.30-Push"):
        for name in ("PPO-L", "TRPO-L", "CPO"):
            paths = list(ROOT.glob(f"results/runs/{task}/{name}/*/progress.csv"))
            for metric, values in found.items():
                values.append(np.mean([window(path, metric, 1.2e6, 1.6e6) for path in paths]))
    depth, steps = found.values()
    expected = (
        f"at a cost of {min(depth):.1f} to {max(depth):.1f} and at {min(steps):.0f} to "
        f"{max(steps):.0f} violating steps an episode"
    )
    assert expected in text_of(REPRODUCIBILITY)
    for task in ("Pillars-0.15-Goal", "Pillars-0.30-Goal"):  # where the two are equal
        for path in ROOT.glob(f"results/runs/{task}/CPO/*/progress.csv"):
            indicator = column(path, "train_cost_indicator")
            np.testing.assert_allclose(column(path, "train_cost"), indicator)


def verdicts_in(document: str) -> dict[str, str]:
    """Statement -> verdict of a table of claims."""
    rows = re.findall(
        r"^\| (.+?) \| .+? \| .+? \| ([a-z ]+) \| .+ \| \w+ \|$", document, re.MULTILINE
    )
    return {statement: verdict for statement, verdict in rows if verdict != "verdict"}


def test_what_the_second_grid_changed_is_all_that_the_tables_say() -> None:
    _, page = (ROOT / "docs/first-grid.md").read_text().split("## Verdicts\n")
    first = verdicts_in(page.split("\n## ")[0])
    second = verdicts_in((ROOT / "results/tables/claims.md").read_text())
    assert len(first) == len(second) == 24
    _, section = REPRODUCIBILITY.split("## What the second grid changed\n")
    table = re.findall(
        r"^\| (.+?) \| ([a-z ]+) \| ([a-z ]+) \| .+ \|$", section.split("\n## ")[0], re.MULTILINE
    )
    told = {
        statement: (before, after) for statement, before, after in table if before != "first grid"
    }
    changed = {s: (first[s], second[s]) for s in first if first[s] != second[s]}
    assert told == changed


def test_numbers_of_the_variants_are_the_tables() -> None:
    tables = ROOT / "results/variants/tables"
    said = text_of(ALGORITHMS)
    unseen = (tables / "unseen_layouts.md").read_text()
    violating = cells(unseen, "Pillars-0.15-Goal", "SafeMR-floor-0.02")[6]
    assert f"violations in {violating} unseen episodes" in said
    for variant, form in (
        ("SafeMR-floor-0", "is {:.1f} ± {:.1f} at a sigma"),
        ("SafeMR-floor-0.02", "actor-critic ({:.1f}, violations"),
        ("SafeMR-replay", "return, {:.1f} ± {:.1f} at a"),
    ):
        returned = cells(unseen, "Pillars-0.15-Goal", variant)[2].split(" ± ")
        assert form.format(*map(float, returned)) in said


def test_limits_of_the_published_bands_are_quoted_with_their_costs() -> None:
    """OmniSafe's benchmark of SafetyPointGoal1: return; cost."""
    for name, value, cost in (("PPO-L", "13.0", "25.8"), ("CPO", "20.5", "28.8")):
        assert f"| {name} | {value} | {cost} |" in ALGORITHMS
    assert "| PPO without constraint | 25.4 | 55.7 |" in ALGORITHMS
    assert not re.search(r"near 25 \|", ALGORITHMS)


def test_what_several_processes_learn_and_cost() -> None:
    said = text_of((ROOT / "docs/pabal.md").read_text())
    table = pd.read_csv(ROOT / "results/pabal/tables/parallel.csv").set_index("variant")
    seconds = table["driver_cpu_s"] + table["workers_cpu_s"].fillna(0)
    sizes = ("2-2-2", "4-4-4")
    narrow = [round(seconds[f"SafeMR-{size}"] / seconds["SafeMR"], 1) for size in sizes]
    wide = [round(seconds[f"SafeMR-256-{size}"] / seconds["SafeMR-256"], 1) for size in sizes]
    assert [round(ratio) for ratio in narrow] == [4, 4]
    assert wide == [2.5, 3.2]
    assert "about four times the processor time" in said
    assert "2.5 to 3.2 times with 256" in said
    driver = table["driver_cpu_s"]
    assert all(driver[f"SafeMR-{size}"] > driver["SafeMR"] for size in sizes)
    shares = [100 * driver[f"SafeMR-256-{size}"] / driver["SafeMR-256"] for size in sizes]
    assert "with 256 units {:.0f} to {:.0f}% of that".format(*shares) in said
    assert table["lost_tasks"].sum() == 0
    assert table["gradient_age_max"].max() <= 8
    assert "no gradient was older than the bound of 8 steps" in said
    for name in ("SafeMR", "SafeMR-2-2-2", "SafeMR-4-4-4"):
        other = name.replace("SafeMR", "SafeMR-256")
        assert table["return"][other] > table["return"][name]
        assert table["return_low"][other] < table["return_high"][name]
    updates, violations = {}, []
    for path in ROOT.glob("results/pabal/runs/*/*/*/progress.csv"):
        several = path.parents[1].name.endswith(("2-2-2", "4-4-4"))
        updates.setdefault(several, set()).add(int(np.nanmax(column(path, "updates"))))
        steps = column(path, "train_cost_indicator") * column(path, "train_episodes")
        violations.append(round(float(np.nansum(steps))))
    assert updates == {True: {19_375}, False: {19_376}}
    assert "19,375 gradient steps in all runs of several processes, 19,376 in those of one" in said
    assert f"{min(violations)} to {max(violations)} a run" in said


def test_the_aircraft_without_the_bound_and_with_the_literal_loss() -> None:
    said = text_of((ROOT / "docs/aircraft.md").read_text())
    scores = pd.read_csv(ROOT / "results/variants/summary/aircraft_scores.csv")

    def of(variant: str, metric: str) -> np.ndarray:
        return statistics.scores_of(scores, "Aircraft", variant, metric)

    def difference(form: str, metric: str, unit: float = 1.0) -> list[float]:
        found = difference_interval(*(of(f"{name}-{form}", metric) for name in PAIR))
        return [unit * value for value in (found.mean, found.low, found.high)]

    assert not any(of(f"{name}-{form}", "sigma").any() for name in PAIR for form in FORMS)
    mean, low, high = (-value for value in difference("free", "volume_ratio"))
    assert f"by {mean:.3f} [{high:.3f}, {low:.3f}] of the true volume smaller" in said
    missed = difference("free", "missed_share", 100)
    assert "misses {:.1f} [{:.1f}, {:.1f}] points more".format(*missed) in said
    literal = difference("literal", "volume_ratio")
    assert "not told apart: {:.3f} [{:.3f}, {:.3f}]".format(*literal) in said
    volumes = [of(f"{name}-literal", "volume_ratio").mean() for name in PAIR]
    missed = [100 * of(f"{name}-literal", "missed_share").mean() for name in PAIR]
    assert "{:.2f} and {:.2f} times the true volume".format(*volumes) in said
    assert "with {:.0f} and {:.0f} % missed".format(*missed) in said
    assert sorted(round(100 * of(f"{n}-literal", "collision_share").mean()) for n in PAIR) == [
        15,
        16,
    ]


def test_what_is_undecided_and_how_many_seeds_it_takes() -> None:
    second = verdicts_in((ROOT / "results/tables/claims.md").read_text())
    assert list(second.values()).count("inconclusive") == 8
    said = text_of(REPRODUCIBILITY)
    assert "Eight of the 24 claims." in said
    power = pd.read_csv(ROOT / "results/tables/power.csv").set_index(["task", "variant"])
    needed = power["seeds_to_see"].fillna(101).astype(int)
    small, large = ("Hazards-0.15-Push", "Hazards-0.30-Push")
    assert all(needed[small, name] > 100 for name in ("JointSIS", "FAC-phih", "PPO-L"))
    forms = (
        ("{} for phi_h, {} for PPO-L, {} for TRPO-L", large, ("FAC-phih", "PPO-L", "TRPO-L")),
        ("over 100 and {} on Hazards-0.15-Push", small, ("CPO",)),
        ("{} and {} on Hazards-0.30-Push", large, ("PPO-L", "CPO")),
        ("{} for PPO-L on Pillars-0.30-Goal", "Pillars-0.30-Goal", ("PPO-L",)),
    )
    for form, task, names in forms:
        assert form.format(*(needed[task, name] for name in names)) in said


def test_what_more_seeds_decided_on_the_aircraft() -> None:
    said, page = text_of(REPRODUCIBILITY), text_of((ROOT / "docs/aircraft.md").read_text())
    scores = pd.read_csv(ROOT / "results/summary/aircraft_scores.csv")

    def of(metric: str, first: int, last: int, level: float = 0.95) -> statistics.Estimate:
        chosen = scores[scores["seed"].between(first, last)]
        values = (statistics.scores_of(chosen, "Aircraft", name, metric) for name in PAIR[::-1])
        return difference_interval(*values, level)

    def ends(found: statistics.Estimate, sign: float = 1.0) -> str:
        low, high = sorted((sign * found.low, sign * found.high))
        return f"[{low:.3f}, {high:.3f}]"

    whole, five = of("volume_ratio", 0, 9), of("volume_ratio", 0, 4)
    assert f"Yes, by {whole.mean:.3f} {ends(whole)} of the true volume" in page
    assert f"with five seeds it was {five.mean:.3f} {ends(five)}" in page
    missed = of("missed_share", 0, 9)
    gap, low, high = (-100 * value for value in (missed.mean, missed.high, missed.low))
    assert f"{gap:.1f} [{low:.1f}, {high:.1f}] points more (of the shell" in page
    strict = of("volume_ratio", 0, 9, 0.97)
    assert f"The 97% interval is {ends(strict)}" in said
    assert strict.low > 0
    assert all(of("volume_ratio", *seeds).low < 0 for seeds in ((0, 4), (5, 9)))


@pytest.mark.parametrize(("level", "share"), [(0.95, 7.6), (0.97, 4.8)])
def test_what_two_looks_find_where_nothing_is(level: float, share: float) -> None:
    random = np.random.default_rng(0)
    pairs = random.normal(size=(4_000, 2, 10))
    looks = [[difference_interval(*pair[:, :seeds], level) for seeds in (5, 10)] for pair in pairs]
    found = [any(look.low > 0 or look.high < 0 for look in two) for two in looks]
    assert 100 * np.mean(found) == pytest.approx(share, abs=0.05)
    assert f"at {100 * level:.0f}%" in text_of(REPRODUCIBILITY)
    assert f"in {share}%" in text_of(REPRODUCIBILITY)
