"""The aircraft experiment's tables and figures from a small fixed set of records."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from matplotlib.colors import to_hex, to_rgb

from envs.aircraft import AircraftVectorEnv
from safemr.aircraft import scoring, unsafe_sets
from safemr.aircraft.reachability import ADVERSARIAL, CONSTANT, Grid, Solution, solve
from safemr.aircraft.scoring import TrueSets
from safemr.certificates.energy import in_metres
from safemr.conventions import COVERS
from safemr.errors import UserError
from safemr.experiment import config, planning, records
from safemr.learning.networks import StackedMLP
from safemr.learning.observation import ObservationTransform
from safemr.learning.policies import Policy
from safemr.measure.store import Measurements
from safemr.report import aircraft as tables
from safemr.report import statistics
from safemr.report.figures import aircraft as pictures
from safemr.report.figures import style

ROOT = Path(__file__).resolve().parents[1]
# Per variant and seed: zeta in units of five metres.
ZETAS = {
    ("SafeMR", 100): (0.05, 0.4, 1.0),
    ("SafeMR", 101): (0.05, 0.5, 1.0),
    ("JointSIS", 100): (0.06, 1.0, 1.0),
    ("JointSIS", 101): (0.06, 0.9, 1.0),
    ("FAC-phih", 100): (0.06, 0.2, 2.0),
}
FRONTIER = pd.DataFrame(
    {"missed_share": [0.0, 0.1, 1.0], "volume_ratio": [1.9, 1.3, 0.7], "sigma": 0, "k": 1, "n": 1}
)


@pytest.fixture(scope="module")
def solutions() -> tuple[Solution, Solution]:
    grid = Grid(shape=(66, 66, 48))
    return solve(CONSTANT, grid), solve(ADVERSARIAL, grid)


@pytest.fixture(scope="module")
def sets(solutions: tuple[Solution, Solution]) -> TrueSets:
    return TrueSets(dict(zip((CONSTANT, ADVERSARIAL), solutions, strict=True)).__getitem__, 13)


@pytest.fixture(scope="module")
def truth(sets: TrueSets) -> unsafe_sets.Truth:
    return sets.truth


def turning(rate: float, **extras: Any) -> dict[str, np.ndarray]:
    """The arrays of a policy that turns at a constant rate everywhere."""
    transform = ObservationTransform.for_layout(AircraftVectorEnv.observation_layout)
    network = StackedMLP(1, (transform.dim, 4, 2), generator=torch.Generator().manual_seed(0))
    network.load(torch.zeros_like(network.parameters))
    arrays = Policy(transform, network, squash=True, extras=extras).arrays()
    weights = arrays["policy_parameters"].reshape(-1)
    weights[-2] = np.arctanh(rate)  # bias of the mean
    return arrays


def write(
    root: Path,
    variant: str,
    seed: int,
    policy: dict[str, np.ndarray] | None,
    task: Any = "Aircraft",
    algorithm: str = "fac",
) -> None:
    hyperparameters = {"eta": 0.01}
    described = {"name": algorithm, "version": 1, "hyperparameters": hyperparameters}
    run: dict[str, Any] = {
        **{"schema": 1, "task": planning.installed(task), "algorithm": described},
        **{"seed": seed, "steps": 10, "log_every": 10},
        "evaluation": {"every": 10, "episodes": 1, "seed": 0},
    }
    row = {"step": 10, "eval_return": 0.0, "eval_cost": 0.0, "eval_zero_violation_share": 1.0}
    records.write_record(root / records.record_path(run, variant), run, variant, [row], {}, policy)


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pd.DataFrame]:
    root = tmp_path_factory.mktemp("results")
    for (variant, seed), zeta in ZETAS.items():
        extras = {"zeta": np.array(zeta, np.float32), "length_scale": np.array(5.0)}
        write(root, variant, seed, turning(0.5 if variant == "SafeMR" else 1e-6, **extras))
    return root, records.read_records(root)[0]


@pytest.fixture(scope="module")
def comparison(sets: TrueSets, index: tuple[Path, pd.DataFrame]) -> pd.DataFrame:
    return scoring.compare(sets, FRONTIER, *index, flights=200)


def test_what_was_measured_needs_no_solution_again(
    comparison: pd.DataFrame, index: tuple[Path, pd.DataFrame]
) -> None:
    def unavailable(case: object) -> Solution:
        raise AssertionError("solved again")

    nothing = TrueSets(unavailable, log2_states=13)
    again = scoring.compare(nothing, FRONTIER, *index, flights=200)
    pd.testing.assert_frame_equal(again, comparison)
    with pytest.raises(AssertionError, match="solved again"):
        scoring.compare(nothing, FRONTIER, *index, flights=201)


def test_every_run_and_every_reference_has_a_row(comparison: pd.DataFrame) -> None:
    learners = comparison[comparison["kind"] == "learner"]
    assert set(zip(learners["variant"], learners["seed"], strict=True)) == ZETAS.keys()
    names = set(comparison["variant"]) - {variant for variant, _ in ZETAS}
    assert names == {
        *scoring.CERTIFICATES,
        scoring.TRUE_SET,
        scoring.ADVERSARIAL_SET,
        scoring.STRAIGHT,
    }


def test_a_record_in_other_units_is_the_same_certificate(comparison: pd.DataFrame) -> None:
    """FAC-phih in units of five metres against the handcrafted one in metres."""
    rows = comparison.set_index("variant")
    np.testing.assert_allclose(
        in_metres(rows.loc["FAC-phih", ["sigma", "k", "n"]].astype(float), 5.0),
        rows.loc["phi_h", ["sigma", "k", "n"]].astype(float),
        rtol=1e-6,
    )
    for metric in ("volume_ratio", "missed_share", "iou", "infeasible_share", "leak_share"):
        assert rows.loc["FAC-phih", metric] == pytest.approx(rows.loc["phi_h", metric], abs=1e-3)


def test_rows_hold_what_the_measures_say(
    comparison: pd.DataFrame, truth: unsafe_sets.Truth
) -> None:
    row = comparison[(comparison["variant"] == "JointSIS") & (comparison["seed"] == 101)].iloc[0]
    phi = unsafe_sets.energy_of(CONSTANT, np.float32(ZETAS["JointSIS", 101]).tolist(), 5.0)
    expected = unsafe_sets.compare_certificate(truth, phi, eta=0.01)
    for metric in scoring.COLUMNS:
        assert row[metric] == getattr(expected, metric)
    assert row["eta"] == 0.01
    assert row["least_volume_ratio"] == pytest.approx(1.9 - 6.0 * row["missed_share"])
    rows = comparison.set_index("variant")
    # A constant turn of 0.5 rad/s costs 0.25 a step; no turn costs nothing and is straight flight.
    assert rows.loc["SafeMR", "effort_per_step"].tolist() == pytest.approx([0.25, 0.25])
    straight = rows.loc[scoring.STRAIGHT, "collision_share"]
    assert rows.loc["JointSIS", "collision_share"].tolist() == [straight, straight]
    assert rows.loc[scoring.TRUE_SET, "collision_share"] < 0.1 * straight
    # Obeying phi_0 says to turn in the last moment; a certificate that nearly covers helps.
    obeyed = rows.loc[["phi_0", "phi_h", "code init"], "collision_share"]
    assert obeyed.is_monotonic_decreasing
    assert obeyed.iloc[-1] < 0.7 * straight
    assert 1.15 < rows.loc[scoring.ADVERSARIAL_SET, "volume_ratio"] < 1.3


def test_table_prints_both_numbers_the_verdict_and_what_is_missing(
    comparison: pd.DataFrame, index: tuple[Path, pd.DataFrame], tmp_path: Path
) -> None:
    expected = pd.DataFrame(
        [("Aircraft", "SafeMR", seed) for seed in (100, 101, 102, 103)],
        columns=["task", "variant", "seed"],
    )
    missing = statistics.missing_runs(expected, index[1])
    table = tables.comparison_table(comparison, missing)
    assert table.notes[-1] == "Runs missing: SafeMR on Aircraft (seeds 102, 103)."
    shown = table.display.set_index("certificate")
    ours = comparison[comparison["variant"] == "SafeMR"]
    mean = statistics.mean_interval(ours["volume_ratio"].to_numpy())
    assert shown.loc["SafeMR", "volume ratio"] == f"{mean.mean:.2f}"  # two seeds: no interval
    assert shown.loc["SafeMR", ["seeds", "covers"]].tolist() == ["2", "0 of 2"]
    assert shown.loc[scoring.TRUE_SET, ["missed %", "covers"]].tolist() == [
        "0.0",
        "yes",
    ]
    gap = statistics.difference_interval(
        *(
            statistics.scores_of(scoring.as_scores(comparison), "Aircraft", variant, "volume_ratio")
            for variant in ("SafeMR", "JointSIS")
        )
    )
    assert (
        f"SafeMR minus JointSIS, Welch's 95% interval: volume ratio {gap.mean:+.3f};"
        in (table.notes[0])
    )
    assert gap.mean < 0
    for path in table.write(tmp_path):
        assert "SafeMR" in path.read_text()


def test_without_any_run_the_references_remain(sets: TrueSets, tmp_path: Path) -> None:
    none = pd.DataFrame(columns=["task", "variant", "seed", "folder"])
    comparison = scoring.compare(sets, FRONTIER, tmp_path, none, flights=20)
    table = tables.comparison_table(comparison, none)
    assert table.notes == ()
    assert set(scoring.CERTIFICATES) <= set(table.display["certificate"])
    pictures.frontier(FRONTIER, comparison, COVERS)


def test_records_that_do_not_say_their_certificate_are_all_named(
    sets: TrueSets, tmp_path: Path
) -> None:
    write(tmp_path, "Silent", 100, None)
    write(tmp_path, "Baseline", 101, turning(0.1))
    index = records.read_records(tmp_path)[0]
    with pytest.raises(UserError, match=r"zeta.*Baseline/seed101.*Silent/seed100"):
        scoring.compare(sets, FRONTIER, tmp_path, index, flights=20)


def test_frontier_table_is_the_frontier(truth: unsafe_sets.Truth) -> None:
    table = scoring.frontier_table(truth, [0.1, 1.0])
    (point, _) = unsafe_sets.frontier(truth, [0.1, 1.0])
    assert table.loc[0].tolist() == [0.1, point.volume_ratio, *point.zeta]
    assert table["volume_ratio"].is_monotonic_decreasing


def test_figures_draw_the_boundaries_they_are_given(tmp_path: Path) -> None:
    """Discs of known radius: of several runs the boundary is the middle one."""
    x, y = np.arange(-6, 6.01, 0.25), np.arange(-5, 5.01, 0.25)
    radius = np.hypot(*np.meshgrid(x, y, indexing="ij"))
    learned = {"SafeMR": [3.0 - radius], "JointSIS": [3.5 - radius, 3.75 - radius]}
    cuts = [
        pictures.Slice(psi, radius - 2.0, 1.5 - radius, learned, radius - 2.5)
        for psi in (0.0, 1.0, 2.0, 4.0)
    ]
    figure = pictures.slices(x, y, cuts, d_min=1.0)
    assert [ax.get_title() for ax in figure.axes] == [
        rf"$\psi={degrees}\degree$" for degrees in (0, 57, 115, 229)
    ]
    drawn = {}
    for line in figure.axes[0].collections:
        points = np.concatenate([path.vertices for path in line.get_paths()])
        if len(line.get_edgecolor()):
            drawn.setdefault(to_hex(line.get_edgecolor()[0]), []).append(
                float(np.hypot(*points.T).mean())
            )
    assert drawn[style.colour("SafeMR").lower()] == pytest.approx([3.0], abs=0.02)
    assert drawn[style.colour("JointSIS").lower()] == pytest.approx([3.625], abs=0.02)
    assert sorted(drawn[pictures.TRUE.lower()])[-2:] == pytest.approx([2.0, 2.5], abs=0.02)
    pdf, png = style.save(figure, tmp_path / "slices")
    assert pdf.read_bytes().startswith(b"%PDF")
    assert png.stat().st_size > 10_000


def test_each_of_several_coinciding_boundaries_is_seen() -> None:
    """None hides another, and no two have the same line."""
    x, y = np.arange(-6, 6.01, 0.25), np.arange(-5, 5.01, 0.25)
    radius = np.hypot(*np.meshgrid(x, y, indexing="ij"))
    names = ["SafeMR", "JointSIS", "SafeMR-free", "JointSIS-free", "SafeMR-literal"]
    learned = {name: [4.0 - radius] for name in names}
    cut = pictures.Slice(0.0, radius - 2.0, 1.5 - radius, learned)
    figure = pictures.slices(x, y, [cut], d_min=1.0)
    (legend,) = figure.legends
    named = [line for line in legend.get_lines() if line.get_label() in names]
    assert len(named) == len({line.get_color() for line in named}) == len(names)
    figure.set_dpi(200)
    figure.canvas.draw()
    seen = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    (ax,) = figure.axes
    box = ax.get_window_extent()
    inside = seen[int(len(seen) - box.y1) : int(len(seen) - box.y0), int(box.x0) : int(box.x1)]
    shown = {
        name: int((np.abs(inside - np.array(to_rgb(style.colour(name))) * 255) < 12).all(-1).sum())
        for name in names
    }
    assert min(shown.values()) > 0.5 * sum(shown.values()) / len(names), shown


def test_frontier_figure_shows_every_run_once(comparison: pd.DataFrame) -> None:
    figure = pictures.frontier(FRONTIER, comparison, COVERS, handcrafted=["FAC-phih"])
    (ax,) = figure.axes
    shown = {
        to_hex(line.get_markeredgecolor()): line.get_xydata()
        for line in ax.lines
        if line.get_linestyle() == "None"
    }
    for variant in ("SafeMR", "JointSIS"):
        rows = comparison[comparison["variant"] == variant]
        expected = rows[["missed_share", "volume_ratio"]].to_numpy(float) * [100, 1]
        np.testing.assert_allclose(shown[style.colour(variant).lower()], expected)


def test_slices_hold_the_sets_of_the_comparison(
    comparison: pd.DataFrame, sets: TrueSets, tmp_path: Path
) -> None:
    x, y, (cut,) = scoring.slices(
        sets,
        comparison,
        Measurements(tmp_path),
        degrees=[180],
        spacing=0.5,
        handcrafted=["FAC-phih"],
    )
    assert set(cut.learned) == {"SafeMR", "JointSIS"}
    assert len(cut.learned["SafeMR"]) == 2
    inside = np.hypot(*np.meshgrid(x, y, indexing="ij")) < CONSTANT.d_min
    for claimed in (cut.handcrafted, *cut.learned["JointSIS"]):
        assert (claimed[inside] > 0).all()
    assert (cut.truth[inside] <= 0).all()
    assert (cut.adversarial <= cut.truth + 1e-6).all()


@pytest.mark.parametrize("name", ["config", "quick"])
def test_shipped_learners_start_alike_and_mean_the_papers_certificates(name: str) -> None:
    """Whatever the unit: SafeMR and JointSIS share a start, FAC has phi_h and phi_0."""
    files = [ROOT / "config/config.yaml", ROOT / f"config/{name}.yaml"]
    plan = planning.resolve(config.load(files))
    zetas = {}
    for run in plan.aircraft:
        values = run.config["algorithm"]["hyperparameters"]
        zeta = [values[parameter] for parameter in ("sigma", "k", "n")]
        zetas[run.variant] = in_metres(zeta, values["length_scale"])
        assert values["target_entropy"] == -1.0
    certificates = scoring.CERTIFICATES
    assert zetas["FAC-phih"] == pytest.approx(certificates["phi_h"])
    assert zetas["FAC-phi0"] == pytest.approx(certificates["phi_0"])
    for variant in zetas.keys() - {"FAC-phih", "FAC-phi0"}:
        assert zetas[variant] == pytest.approx(certificates["code init"])


def test_the_papers_grid_has_the_same_learners_as_the_quick_one() -> None:
    """But for the run in metres, which shows once what the paper's a and b do unscaled, and for
    the neural energy functions, which are beyond the paper."""
    quick, paper = (
        yaml.safe_load((ROOT / f"config/{name}.yaml").read_text())["aircraft"]["algorithms"]
        for name in ("quick", "config")
    )
    quick.pop("SafeMR-metres")
    papers = {k: v for k, v in quick.items() if v["algorithm"] != "neural_safemr"}
    assert papers == paper


# --- other traffic -------------------------------------------------------------------------------

MIRRORED = {"name": "Aircraft-left", "base": "Aircraft", "settings": {"other_turn": -1.0}}


@pytest.fixture(scope="module")
def mirrored() -> TrueSets:
    grid = Grid(shape=(66, 66, 48))
    return TrueSets(lambda case: solve(case, grid), 13, MIRRORED)


def certified(rate: float = 0.5) -> dict[str, np.ndarray]:
    return turning(rate, zeta=np.array((0.06, 1.0, 1.0), np.float32), length_scale=np.array(5.0))


def test_the_true_set_is_that_of_the_tasks_traffic(sets: TrueSets, mirrored: TrueSets) -> None:
    """Traffic that turns left instead of right is the mirror image of the encounter."""
    states = sets.truth.states[:2000]
    x, y, psi = states.T
    image = mirrored.constant(np.stack([x, -y, 2 * np.pi - psi], -1))
    np.testing.assert_allclose(image, sets.constant(states), atol=0.05)
    assert np.abs(mirrored.constant(states) - sets.constant(states)).max() > 1


def test_a_record_is_held_against_the_true_set_of_its_own_traffic(
    sets: TrueSets, mirrored: TrueSets, comparison: pd.DataFrame, tmp_path: Path
) -> None:
    write(tmp_path, "SafeMR", 0, certified(), MIRRORED)
    index = records.read_records(tmp_path)[0]
    with pytest.raises(UserError, match=r"flew with other_turn = -1, the true .* that of 1"):
        scoring.compare(sets, FRONTIER, tmp_path, index, flights=50)
    found = scoring.compare(mirrored, FRONTIER, tmp_path, index, flights=50)
    ours = found[found["variant"] == "SafeMR"].iloc[0]
    # The energy is its own mirror image, so its shares are those of the right-turning traffic.
    straight = comparison[(comparison["variant"] == "JointSIS") & (comparison["seed"] == 100)].iloc[
        0
    ]
    for metric in ("volume_ratio", "missed_share", "iou"):
        assert ours[metric] == pytest.approx(straight[metric], abs=0.02)
    assert tables.comparison_table(found, task=MIRRORED).caption.startswith("Aircraft-left. ")


def test_kept_measurements_of_the_registered_traffic_keep_their_names(
    sets: TrueSets, mirrored: TrueSets
) -> None:
    assert sets.kept_as("frontier") == ("frontier", {})
    entry = planning.describe_task("Aircraft", {})
    assert TrueSets(sets._solve, 13, entry).kept_as("slices") == ("slices", {})
    assert mirrored.kept_as("frontier") == (
        "frontier Aircraft-left", {"task": planning.installed(MIRRORED)}
    )  # fmt: skip


@pytest.mark.parametrize(
    ("task", "expected"),
    [
        ("Pillars-0.15-Goal", "no encounter of two aircraft"),
        ({**MIRRORED, "settings": {"other_turn": 2.0}}, "at most 1 rad/s"),
        ({**MIRRORED, "settings": {"d_min": 3.0}}, "no true unsafe set is solved for its d_min"),
    ],
)
def test_a_task_without_a_true_set_is_refused(task: Any, expected: str) -> None:
    with pytest.raises(UserError, match=expected):
        TrueSets(lambda case: None, 13, task)


def test_a_neural_certificate_is_not_compared_as_its_fixed_part(
    sets: TrueSets, tmp_path: Path
) -> None:
    network = {"certificate_parameters": np.zeros(3)}
    write(tmp_path, "Neural", 0, {**certified(), **network}, algorithm="neural_safemr")
    index = records.read_records(tmp_path)[0]
    with pytest.raises(UserError, match=r"neural_safemr is a network beside a fixed"):
        scoring.compare(sets, FRONTIER, tmp_path, index, flights=50)
