"""A redraw gives the same bytes everywhere: the last bits of a function decide nothing.

Processors differ in the last bits of powers, sines and matrix products. Here every value is
disturbed by up to two units in the last place of it, or of 1 where it is smaller: a difference of
powers has the errors of the powers.
"""

from __future__ import annotations

import io
import types
from collections.abc import Callable

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from envs import drawing
from safemr import paper
from safemr.certificates import energy, feasibility
from safemr.report.figures import aircraft, certificate, style

LEARNED = paper.TABLE_II[paper.HEADLINE]
D_MIN = 0.25


def disturbed(function: Callable[..., np.ndarray], seed: int) -> Callable[..., np.ndarray]:
    """The function, with errors of up to two units in the last place."""
    generator = np.random.default_rng(seed)

    def wrapped(*arguments):
        values = np.asarray(function(*arguments))
        errors = generator.integers(-2, 3, values.shape) * np.finfo(float).eps
        return values + errors * np.fmax(1.0, np.abs(values))

    return wrapped


def energy_and_safe_set() -> Figure:
    return certificate.energy_and_safe_set(LEARNED, D_MIN)


def narrow_passage() -> Figure:
    pair = (("handcrafted", paper.PHI_H), ("learned", LEARNED))
    return certificate.narrow_passage(*pair, D_MIN)


@style.styled
def requirement() -> Figure:
    figure = style.new_figure(3, 2)
    zetas = {"paper": LEARNED, "phi_h": paper.PHI_H}
    certificate.draw_requirement(zetas, D_MIN, figure.subplots())
    return figure


def aircraft_slice() -> Figure:
    """Round sets on a round grid: many nodes lie exactly on a boundary."""
    x, y = np.arange(-4.0, 9.05, 0.1), np.arange(-6.0, 6.05, 0.1)
    plane = np.meshgrid(x, y, indexing="ij")
    sets = [certificate.energy(np.hypot(*plane), 0.0, radius, 0.0, 0.0, 2.0) for radius in (2, 3)]
    learned = {"SafeMR": [sets[0]]}
    cut = aircraft.Slice(np.pi / 3, np.round(-sets[0], 3), sets[1], learned)
    return aircraft.slices(x, y, [cut], 2.0)


def image(figure: Figure) -> bytes:
    stream = io.BytesIO()
    with matplotlib.rc_context(style.RC):
        figure.savefig(stream, format="png", dpi=300, metadata={"Software": None})
    return stream.getvalue()


@pytest.mark.parametrize("draw", [energy_and_safe_set, narrow_passage, requirement, aircraft_slice])
def test_the_last_bits_change_no_byte_of_a_picture(draw, monkeypatch):
    images = set()
    for seed in range(2):
        monkeypatch.setattr(certificate, "energy", disturbed(energy.energy, seed))
        other = disturbed(feasibility.radial_requirement, seed)
        monkeypatch.setattr(certificate, "radial_requirement", other)
        images.add(image(draw()))
    assert len(images) == 1


def test_thresholds_are_not_decided_by_the_last_bits(monkeypatch):
    """Where phi(0) is 0, at d = 0.3 + d_min with phi_h, the robot may stand."""
    positions = np.array([[-0.55, 0.0], [0.0, 0.55], [-0.33, 0.44]])
    speeds = []
    for seed in range(20):
        monkeypatch.setattr(certificate, "energy", disturbed(energy.energy, seed))
        speeds.append(
            certificate.admissible_speed(
                positions, np.zeros((1, 2)), paper.PHI_H, D_MIN, np.array([1.0, 0.0])
            )
        )
    np.testing.assert_allclose(speeds, [[0.0, certificate.ROBOT.max_speed, 0.0]] * 20, atol=1e-9)


def test_steady_values_are_close_stable_and_keep_nan():
    values = np.array([0.7265625, -1.05, 1 / 3, np.nan, 0.0, 12.3])
    steady = style.steady(values)
    np.testing.assert_allclose(steady, values, atol=1e-6)
    for seed in range(50):
        np.testing.assert_array_equal(style.steady(disturbed(np.asarray, seed)(values)), steady)


def test_scenes_stored_in_single_precision_are_turned_in_double():
    """A sine in single precision differs between processors by what a PDF prints."""
    robot = np.array([0.3, -0.7, 2.1], np.float32)
    box = np.array([1.1, 0.4, -0.9], np.float32)
    task = types.SimpleNamespace(
        obstacle_size=0.15, d_min=D_MIN, goal_size=0.3, extent=2.0, solid_obstacles=True
    )
    drawn = []
    for precision in (np.float32, np.float64):
        scene = types.SimpleNamespace(
            task=task, robot=robot.astype(precision), box=box.astype(precision), vase=None,
            goal=np.ones(2), obstacles=np.zeros((1, 2)),
        )  # fmt: skip
        ax = style.new_figure(2, 2).subplots()
        drawing.draw_scene(ax, scene)
        drawn.append([patch.get_path().vertices for patch in ax.patches])
        drawn[-1] += [line.get_xydata() for line in ax.lines]
    for single, double in zip(*drawn, strict=True):
        np.testing.assert_allclose(single, double, rtol=0, atol=1e-12)
