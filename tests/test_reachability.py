"""The reachability solver against reference slices, the analytic barrier and a grid-free bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from safemr.aircraft.reachability import (
    ADVERSARIAL,
    CASES,
    CONSTANT,
    Grid,
    Solution,
    load_or_solve,
    solve,
)
from safemr.aircraft.reachability.barrier import boundary_error, sheets
from safemr.aircraft.reachability.check import (
    compare,
    intersection_over_union,
    main,
    read_references,
)
from safemr.aircraft.reachability.oracle import open_loop_value
from safemr.aircraft.reachability.solver import VALUE_RANGE
from safemr.errors import UserError

SLICES = Path(__file__).parent / "golden" / "aircraft" / "slices.npz"


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("solutions")


@pytest.fixture(scope="module")
def solutions(cache: Path) -> dict[str, Solution]:
    """Both cases on the default grid."""
    return {case: load_or_solve(cache, dynamics) for case, dynamics in CASES.items()}


def sample(count: int, seed: int = 0) -> np.ndarray:
    """Random states around the unsafe sets."""
    return np.random.default_rng(seed).uniform([-6, -9, 0], [19, 9, 2 * np.pi], (count, 3))


def mirrored(states: np.ndarray) -> np.ndarray:
    return states * np.array([1.0, -1.0, -1.0])


def test_interpolation_is_exact_for_multilinear_functions_and_periodic():
    grid = Grid((-1.0, 2.0), (0.0, 3.0), (5, 4, 8))
    plane = grid.plane()
    level = np.cos(grid.psi)
    values = (1 + plane[..., 0] * plane[..., 1])[None] * level[:, None, None]
    states = np.random.default_rng(0).uniform([-1, 0, -20], [2, 3, 20], (1000, 3))
    expected = (1 + states[:, 0] * states[:, 1]) * np.interp(
        states[:, 2], grid.psi, level, period=2 * np.pi
    )
    found = grid.interpolate(values.astype(np.float32), states)
    np.testing.assert_allclose(found, expected, atol=2e-6)
    with pytest.raises(ValueError, match="outside"):
        grid.interpolate(values.astype(np.float32), np.array([2.1, 1.0, 0.0]))


@pytest.mark.parametrize("case", CASES)
def test_sweeps_equal_the_definition(case: str):
    """Two sweeps of the compiled kernel against the recursion in plain array code."""
    dynamics, grid = CASES[case], Grid((-6.0, 12.0), (-8.0, 8.0), (23, 19, 16))
    solution = solve(dynamics, grid, 0.2)
    states = np.concatenate(
        [
            np.broadcast_to(grid.plane(), (16, 23, 19, 2)),
            np.broadcast_to(grid.psi[:, None, None, None], (16, 23, 19, 1)),
        ],
        axis=-1,
    )
    separation = dynamics.separation(states) - dynamics.d_min
    value = np.clip(separation, *VALUE_RANGE)
    for _ in range(2):
        present = replace(solution, value=value.astype(np.float32))
        best = np.max([present.worst_next(states, a) for a in (-1.0, 0.0, 1.0)], axis=0)
        value = np.minimum(value, best)
    np.testing.assert_allclose(solution.value, value, atol=5e-6)


@pytest.mark.parametrize("name", ["A_dp", "B_dp"])
def test_reference_slices(solutions: dict[str, Solution], name: str):
    (reference,) = [each for each in read_references(SLICES) if each.name == name]
    for result in compare(solutions[reference.case], reference):
        assert result.disagreements == 0
        assert result.iou >= 0.999


def test_an_euler_step_is_told_apart(solutions: dict[str, Solution]):
    (reference,) = [each for each in read_references(SLICES) if each.name == "A_euler_dp"]
    results = compare(solutions["A"], reference)
    assert [result.within_bounds for result in results] == [True, False, False]


@pytest.mark.parametrize(("case", "volume"), [("A", 721.8), ("B", 885.5)])
def test_volumes(solutions: dict[str, Solution], case: str, volume: float):
    assert solutions[case].volumes[-1] == pytest.approx(volume, rel=0.002)


@pytest.mark.parametrize("case", CASES)
def test_no_point_of_the_analytic_barrier_is_unsafe(solutions: dict[str, Solution], case: str):
    for states in sheets(CASES[case]).values():
        on_grid = states[solutions[case].grid.contains(states)]
        value = solutions[case](on_grid)
        assert value.min() >= -0.005
        # The sheets are the boundary up to where they meet: not merely outside the set.
        assert np.mean(np.abs(value) < 0.02) > 0.4


@pytest.mark.parametrize("degrees", [60, 120, 180, 240, 300])
def test_boundary_is_the_analytic_barrier(solutions: dict[str, Solution], degrees: int):
    """Constant traffic: every boundary point lies on the disc or on a sheet, to 0.06 m."""
    assert 0.0 < boundary_error(solutions["A"], [degrees]) < 0.06


def test_boundary_error_sees_a_wrong_boundary(solutions: dict[str, Solution]):
    solution = solutions["A"]
    assert boundary_error(replace(solution, value=solution.value - np.float32(0.2)), [120]) > 0.15
    with pytest.raises(ValueError, match="constant turn rate"):
        boundary_error(solutions["B"])


@pytest.mark.parametrize("case", CASES)
def test_parallel_flight_is_unsafe_in_collision_only(solutions: dict[str, Solution], case: str):
    """psi = 0: who copies the traffic's turns keeps the separation, so V = d - 5 exactly."""
    angle = np.linspace(0, 2 * np.pi, 400)
    for radius, tolerance in ((4.6, 0.01), (5.0, 0.01), (5.4, 0.01)):
        states = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=-1)
        np.testing.assert_allclose(solutions[case](states), radius - 5.0, atol=tolerance)


def test_open_loop_bound(solutions: dict[str, Solution]):
    """What a sequence of turns achieves, the value may not deny; and it is nearly all of it."""
    states = sample(4000)
    bound = np.clip(open_loop_value(CONSTANT, states), *VALUE_RANGE)
    value = solutions["A"](states)
    assert (value - bound).min() > -0.15  # interpolation, at kinks far from the boundary
    near = np.abs(bound) < 0.3
    assert (value - bound)[near].min() > -0.03
    assert (value - bound)[near].max() < 0.12  # at most one switch
    assert intersection_over_union(value <= 0, bound <= 0) > 0.995
    simple = open_loop_value(CONSTANT, states, switches=0)
    assert (simple <= open_loop_value(CONSTANT, states) + 1e-12).all()
    assert np.mean((value <= -0.02) & (simple > 0)) == 0.0
    with pytest.raises(ValueError, match="constant turn rate"):
        open_loop_value(ADVERSARIAL, states)


def test_adversarial_traffic_is_mirror_symmetric_and_worse(solutions: dict[str, Solution]):
    states = sample(20_000)
    value = solutions["B"](states)
    np.testing.assert_allclose(value, solutions["B"](mirrored(states)), atol=2e-3)
    assert (value <= solutions["A"](states) + 2e-3).all()
    assert (value <= solutions["A"](mirrored(states)) + 2e-3).all()


def test_refinement_converges(solutions: dict[str, Solution]):
    states = sample(60_000)
    finest = solutions["A"](states) <= 0
    ious = [
        intersection_over_union(solve(CONSTANT, Grid(shape=shape))(states) <= 0, finest)
        for shape in ((33, 33, 24), (66, 66, 48), (131, 131, 96))
    ]
    assert ious[0] < ious[1] < ious[2]
    assert ious[1] > 0.99
    assert ious[2] > 0.998


@pytest.mark.parametrize("case", CASES)
def test_horizon_converges(solutions: dict[str, Solution], case: str):
    solution = solutions[case]
    assert (np.diff(solution.volumes) <= 0).all() or (np.diff(solution.volumes) >= 0).all()
    assert solution.volumes[0] == pytest.approx(25 * np.pi * 2 * np.pi, rel=0.005)
    late = solution.volumes[-5:]
    assert np.ptp(late) < 1e-4 * late[-1]
    assert solution.changes[-1] < 2e-3
    # A horizon of 1 s, as in the released experiment, is not enough.
    assert solution.volumes[10] < 0.99 * solution.volumes[-1]


@pytest.mark.parametrize("case", CASES)
def test_a_larger_domain_does_not_move_the_boundary(case: str):
    near = solve(CASES[case], Grid(shape=(66, 66, 48)))
    wide = solve(CASES[case], Grid((-14.0, 28.0), (-21.0, 21.0), (106, 106, 48)))
    fine = Grid((-6.0, 20.0), (-13.0, 13.0), (66, 66, 48))
    assert near.grid == fine
    assert wide.grid.spacing == pytest.approx(near.grid.spacing)
    states = sample(60_000)
    np.testing.assert_array_equal(near(states) <= 0, wide(states) <= 0)


def test_horizon_must_be_whole_periods():
    with pytest.raises(ValueError, match="horizon"):
        solve(CONSTANT, Grid(shape=(5, 5, 4)), 0.25)


def test_cached_solution_is_the_solution(tmp_path: Path):
    grid = Grid(shape=(20, 20, 12))
    first, second = (load_or_solve(tmp_path, CONSTANT, grid, 0.5) for _ in range(2))
    np.testing.assert_array_equal(first.value, second.value)
    np.testing.assert_array_equal(first.volumes, second.volumes)
    assert first.seconds == second.seconds  # read, not solved again
    load_or_solve(tmp_path, ADVERSARIAL, grid, 0.5)
    kept = sorted(tmp_path.iterdir())
    assert len(kept) == 2
    for path in kept:
        path.write_bytes(b"damaged")
    with pytest.raises(UserError, match="delete it"):
        load_or_solve(tmp_path, CONSTANT, grid, 0.5)
    for path in kept:
        path.unlink()
        path.mkdir()
    with pytest.raises(UserError, match="cannot be read: Is a directory"):
        load_or_solve(tmp_path, CONSTANT, grid, 0.5)


def reference_arrays() -> dict[str, np.ndarray]:
    with np.load(SLICES) as stored:
        return {name: stored[name] for name in ("x", "y", "psi", "A_dp_value", "A_dp_unsafe")}


def test_check_accepts_the_reference(
    solutions: dict[str, Solution], cache: Path, capsys: pytest.CaptureFixture[str]
):
    assert main([str(SLICES), "--cache", str(cache)]) == 0
    printed = capsys.readouterr().out
    assert printed.count("  ok") == 6
    assert printed.count("for information") == 9


def test_check_accepts_other_slices_and_grids(
    solutions: dict[str, Solution], cache: Path, tmp_path: Path
):
    x, y, psi = np.linspace(-5.5, 15, 80), np.linspace(-9, 9, 70), np.radians([60, 240, 301.5])
    finer = solve(CONSTANT, Grid(shape=(131, 131, 96)))
    mesh = np.stack(np.meshgrid(psi, x, y, indexing="ij"), axis=-1)[..., [1, 2, 0]]
    np.savez(tmp_path / "other.npz", x=x, y=y, psi=psi, A_value=finer(mesh))
    assert main([str(tmp_path / "other.npz"), "--cache", str(cache)]) == 0


def test_check_rejects_wrong_slices(
    solutions: dict[str, Solution],
    cache: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    arrays = reference_arrays()
    arrays["A_dp_value"] = np.roll(arrays["A_dp_value"], 2, axis=1)
    del arrays["A_dp_unsafe"]
    np.savez(tmp_path / "shifted.npz", **arrays)
    assert main([str(tmp_path / "shifted.npz"), "--cache", str(cache)]) == 1
    assert "OUT OF BOUNDS" in capsys.readouterr().out


def spoil(change: Callable[[dict[str, np.ndarray]], object]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        arrays = reference_arrays()
        change(arrays)
        np.savez(path, **arrays)

    return write


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: None, "does not exist"),
        (lambda path: path.write_text("no archive"), "cannot be read"),
        (spoil(lambda arrays: arrays.pop("psi")), "no axis 'psi'"),
        (spoil(lambda arrays: arrays.pop("A_dp_value")), "no array NAME_value"),
        (spoil(lambda arrays: arrays.update(x=arrays["x"][::-1])), "must rise"),
        (spoil(lambda arrays: arrays.update(psi=np.array([0.0, 120.0, 180.0]))), "rad"),
        (spoil(lambda arrays: arrays.update(y=arrays["y"][:-1])), "shape"),
        (spoil(lambda arrays: arrays.update(A_dp_value=arrays["A_dp_value"] * np.nan)), "finite"),
        (spoil(lambda arrays: arrays.update(A_dp_unsafe=~arrays["A_dp_unsafe"])), "contradicts"),
        (spoil(lambda arrays: arrays.update(C_dp_value=arrays["A_dp_value"])), "neither case"),
        (spoil(lambda arrays: arrays.update(x=arrays["x"] * 2)), "beyond the grid"),
    ],
)
def test_check_explains_bad_files(
    write: Callable[[Path], None],
    message: str,
    solutions: dict[str, Solution],
    cache: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    path = tmp_path / "slices.npz"
    write(path)
    assert main([str(path), "--cache", str(cache)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
