"""`Certificate`: one object for every family, and what a record says of its own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sample_record import CONFIG, ROWS, make_record

from envs.aircraft import AircraftVectorEnv, observe
from safemr.aircraft.reachability import CONSTANT
from safemr.algorithms import neural_safemr
from safemr.algorithms.neural_safemr import NeuralCertificate, neural_energy
from safemr.certificates import certificate, energy
from safemr.certificates.certificate import Certificate, EnergyCertificate, family_named
from safemr.errors import UserError
from safemr.experiment import catalogue, records
from safemr.experiment.record import Record
from safemr.paper import Zeta

ZETA = Zeta(0.06, 1.0, 1.5)
NEURAL = {"num_envs": 4, "hidden": 16, "batch_size": 32, "start_steps": 200, "smoothing": 0.1}
generator = np.random.default_rng(0)
D, D_DOT = generator.uniform(0.5, 20, (7, 5, 3)), generator.normal(0, 2, (7, 5, 3))


def record_of(root: Path, algorithm: str, arrays: Any = None, rows: Any = None, **hyper: Any):
    described = {"name": algorithm, "version": 1, "hyperparameters": hyper}
    config = {**CONFIG, "algorithm": described}
    folder = root / records.record_path(config, "One")
    records.write_record(folder, config, "One", rows or ROWS, {}, arrays)
    return Record.open(folder)


def logged(zeta: Zeta) -> list[dict[str, float]]:
    return [{**row, **zeta._asdict()} for row in ROWS]


def test_an_unknown_family_is_refused_by_name() -> None:
    with pytest.raises(UserError, match=r"unknown family of certificates 'enregy'.*'energy'"):
        family_named("enregy")
    with pytest.raises(UserError, match=r"unknown family of certificates 'spline'.*energy, neural"):
        catalogue.certificate_family("spline")


def test_a_family_has_one_class() -> None:
    with pytest.raises(TypeError, match="'energy' is EnergyCertificate"):

        class Another(Certificate, family="energy"):
            pass

    assert family_named("energy") is EnergyCertificate


def test_algorithms_say_their_family() -> None:
    said = {
        name: catalogue.load_algorithm(name).certificate for name in catalogue.algorithm_names()
    }
    papers = ("fac", "fac_oracle", "joint_sis", "safemr", "safemr_guarded")
    energies = dict.fromkeys(papers, "energy")
    assert {name: family for name, family in said.items() if family} == {
        **energies,
        "neural_safemr": "neural",
    }
    with pytest.raises(UserError, match="unknown algorithm"):
        catalogue.declared_certificate("sfaemr")


@pytest.mark.parametrize("by", ["progress", "policy"])
def test_phi_of_a_record_is_the_energy_at_its_parameters(tmp_path: Path, by: str) -> None:
    """In its unit of length, over all obstacles, whichever of its files says the parameters."""
    single = Zeta(*np.array(ZETA, np.float32).tolist())
    arrays = {"zeta": np.array(ZETA, np.float32), "length_scale": np.array(5.0)}
    record = record_of(
        tmp_path, "safemr", arrays if by == "policy" else None,
        logged(single) if by == "progress" else None, eta=0.01, length_scale=5.0,
    )  # fmt: skip
    found = record.certificate()
    assert (found.family, found.name, found.eta) == ("energy", "One (seed 100)", 0.01)
    assert found.record is record
    assert found.length_scale == 5.0
    assert found.parameters == single._asdict()
    expected = energy.energy(D / 5, D_DOT / 5, 5.0 / 5, *single).max(-1)
    np.testing.assert_array_equal(found.phi(D, D_DOT, 5.0), expected)
    assert found.phi(D, D_DOT, 5.0).shape == (7, 5)


def test_metres_are_the_same_certificate() -> None:
    found = EnergyCertificate("one", ZETA, eta=0.1, length_scale=5.0)
    metres = found.in_metres()
    assert metres.length_scale == 1.0
    assert metres.in_metres() is metres
    factor = 5.0**ZETA.n
    phis = [one.phi(D, D_DOT, 5.0) for one in (found, metres)]
    np.testing.assert_allclose(factor * phis[0], phis[1], rtol=1e-9)
    later = [one.phi(D + 0.1, D_DOT, 5.0) for one in (found, metres)]
    ours, theirs = (
        one.constraint(*values)
        for one, values in zip((found, metres), zip(phis, later, strict=True), strict=True)
    )
    np.testing.assert_allclose(factor * ours, theirs, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(ours, energy.constraint(phis[0], later[0], 0.1))


@pytest.fixture(scope="module")
def trainer() -> neural_safemr.Trainer:
    """With a correction that is not 0."""
    settings = neural_safemr.Config(**NEURAL, length_scale=5.0)
    made = neural_safemr.Trainer(settings, lambda n: AircraftVectorEnv(n), 0, 800)
    parameters = made.agent.certificate.parameters
    drawn = torch.randn(parameters.shape, generator=torch.Generator().manual_seed(1))
    made.agent.certificate.load(drawn)
    return made


def test_phi_of_a_neural_record_is_the_neural_energy(
    trainer: neural_safemr.Trainer, tmp_path: Path
) -> None:
    arrays = trainer.policy.arrays()
    record = record_of(tmp_path, "neural_safemr", arrays, logged(ZETA), eta=0.02)
    found = record.certificate()
    assert isinstance(found, NeuralCertificate)
    assert (found.family, found.eta, found.length_scale) == ("neural", 0.02, 5.0)
    assert found.parameters["smoothing"] == 0.1
    states = generator.uniform([-6, -10, 0], [20, 10, 6], (4, 50, 3))
    d, d_dot = CONSTANT.separation(states)[..., None], CONSTANT.separation_rate(states)[..., None]
    phi = found.phi(d, d_dot, CONSTANT.d_min, observe(states))
    assert phi.shape == (4, 50)
    with torch.no_grad():
        expected = neural_energy(
            trainer.agent.certificate,
            torch.from_numpy(trainer.transform(observe(states).reshape(200, -1))),
            *(torch.from_numpy(values.reshape(200, 1)).float() for values in (d, d_dot)),
            CONSTANT.d_min,
            zeta=trainer.agent.zeta,
            length_scale=5.0,
            smoothing=0.1,
        )
    np.testing.assert_allclose(phi.reshape(-1), expected.numpy(), atol=1e-6)
    zeta = Zeta(*trainer.agent.zeta.tolist())
    fixed = EnergyCertificate("its fixed part", zeta, length_scale=5.0)
    assert np.abs(phi - fixed.phi(d, d_dot, CONSTANT.d_min)).max() > 0.1
    with pytest.raises(ValueError, match="observations"):
        found.phi(d, d_dot, CONSTANT.d_min)


def test_a_record_is_not_read_as_one_of_another_family(
    trainer: neural_safemr.Trainer, tmp_path: Path
) -> None:
    arrays = trainer.policy.arrays()
    neural = record_of(tmp_path, "neural_safemr", arrays, logged(ZETA))
    with pytest.raises(UserError, match="neural_safemr is a network beside a fixed"):
        EnergyCertificate.from_record(neural)
    with pytest.raises(UserError, match=r"safemr is that of \[sigma, k, n\] alone, not a network"):
        NeuralCertificate.from_record(record_of(tmp_path, "safemr", None, logged(ZETA)))
    arrays = {name: array for name, array in arrays.items() if name != certificate.NETWORK}
    without = record_of(tmp_path, "neural_safemr", arrays, gamma=0.9)
    with pytest.raises(UserError, match="no certificate_parameters"):
        without.certificate()


@pytest.mark.parametrize("algorithm", ["cpo", "sac_lagrangian", "of_an_outsider"])
def test_a_run_without_a_certificate_says_so(tmp_path: Path, algorithm: str) -> None:
    record = record_of(tmp_path, algorithm)
    with pytest.raises(UserError, match=f"its algorithm, {algorithm}, has no energy function"):
        record.certificate()


def test_what_is_logged_does_not_make_a_certificate_of_a_baseline(tmp_path: Path) -> None:
    """But an outside implementation has nothing else to say it with."""
    with pytest.raises(UserError, match="no certificate"):
        record_of(tmp_path, "sac_lagrangian", None, logged(ZETA)).certificate()
    outside = record_of(tmp_path, "of_an_outsider", None, logged(ZETA)).certificate()
    assert outside.parameters == ZETA._asdict()


def test_a_record_that_forgot_its_parameters_is_named(tmp_path: Path) -> None:
    record = Record.open(make_record(tmp_path))
    with pytest.raises(UserError, match="neither its progress nor its policy says sigma"):
        record.certificate()


def test_every_learned_certificate_of_the_repository_can_be_read() -> None:
    """The last logged parameters are those of the policy file, in the record's unit."""
    results = Path(__file__).resolve().parents[1] / "results"
    configs = sorted(results.glob("runs/*/*/seed0-*/config.json"))
    names = {path: json.loads(path.read_text())["algorithm"]["name"] for path in configs}
    chosen = [path.parent for path, name in names.items() if name in ("fac", "safemr")]
    assert len(chosen) > 5
    for folder in chosen:
        record = Record.open(folder)
        found = record.certificate()
        assert list(found.parameters.values()) == record.policy_arrays()["zeta"].tolist()
        assert found.length_scale == record.policy_arrays()["length_scale"]
