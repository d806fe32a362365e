"""Families of energy functions from other packages, by the example with a braking distance."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from toy import ToyEnvs

from safemr import packages, paper
from safemr.aircraft import scoring, unsafe_sets
from safemr.aircraft.reachability import CONSTANT
from safemr.algorithms import fac, joint_sis, neural_safemr, safemr
from safemr.certificates import energy, falsification, families
from safemr.certificates.certificate import EnergyCertificate
from safemr.certificates.families import PAPER, EnergyFamily, Values
from safemr.errors import UserError
from safemr.experiment import catalogue, planning, records, train
from safemr.experiment.record import Record
from safemr.measure import certify
from safemr.paper import Zeta
from safemr.report import certificates, sensitivity
from safemr.report.figures import curves

ROOT = Path(__file__).resolve().parents[1]
NAME = "braking_distance.energy"
SMALL = {"num_envs": 4, "hidden": 16, "batch_size": 32, "start_steps": 200}
AT = (0.2, 1.5, 0.4)
generator = np.random.default_rng(0)


def forget() -> None:
    for cached in (families.named, catalogue.load_algorithm, packages.registered):
        cached.cache_clear()
    importlib.invalidate_caches()


@pytest.fixture
def family(monkeypatch: pytest.MonkeyPatch) -> Iterator[EnergyFamily]:
    monkeypatch.syspath_prepend(str(ROOT / "examples/braking_distance"))
    yield families.named(NAME)
    forget()


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of a package `mine` on the path of this process."""
    folder = tmp_path / "packages/mine"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(folder.parent))
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "mine"]:
        del sys.modules[name]
    forget()


def test_phi_by_hand(family: EnergyFamily) -> None:
    """At 3 m/s: 0.2 + 0.5 - 2 + 9 / 3 + 0.4 * 3; what goes away counts by its distance alone."""
    d_dot = np.array([-3.0, 0.0, 3.0])
    phi = families.phi_at(np.full(3, 2.0), d_dot, 0.5, family.at(AT))
    np.testing.assert_allclose(phi, [2.9, -1.3, -1.3])
    assert family.at(AT)._asdict() == {"sigma": 0.2, "u": 1.5, "t": 0.4}
    assert family.magnitude(0.5, *AT, 2.0, 3.0) == pytest.approx(2 * 0.7 + 3 * (1 / 3 + 0.4))
    # Its own term is what every phi has that says none.
    default = families.magnitude(family.phi)
    assert default(0.5, *AT, 2.0, 3.0) == pytest.approx(family.magnitude(0.5, *AT, 2.0, 3.0))


def test_the_term_of_a_family_without_one_is_the_papers_of_the_papers_phi() -> None:
    zeta = torch.tensor([0.3, 0.7, 2.0], dtype=torch.float64, requires_grad=True)
    terms = [
        function(0.25, *zeta.unbind(), 0.35, 0.15)
        for function in (families.magnitude(energy.energy), energy.magnitude)
    ]
    assert terms[0].item() == pytest.approx(terms[1].item())
    gradients = [torch.autograd.grad(term, zeta)[0] for term in terms]
    torch.testing.assert_close(*gradients)


def test_metres_are_the_same_certificate(family: EnergyFamily) -> None:
    found = EnergyCertificate("one", family.at(AT), eta=0.1, length_scale=5.0)
    metres = found.in_metres()
    assert metres.parameters == pytest.approx({"sigma": 1.0, "u": 7.5, "t": 0.4})
    d, d_dot = generator.uniform(0.5, 9.0, (7, 3)), generator.uniform(-2, 2, (7, 3))
    phis = [one.phi(d, d_dot, 5.0) for one in (found, metres)]
    np.testing.assert_allclose(5.0 * phis[0], phis[1])
    assert metres.eta == pytest.approx(0.5)


def test_learners_descend_its_loss_and_stay_in_its_box(family: EnergyFamily) -> None:
    config = joint_sis.Config(**SMALL, family=NAME, certificate_travel=1e3)
    trainer = joint_sis.Trainer(config, ToyEnvs, 0, 800)
    start = [parameter.start for parameter in family.parameters]
    assert trainer.agent.zeta.tolist() == pytest.approx(start)
    metrics = trainer.advance(800)
    assert {"sigma", "u", "t", "certificate_grad_u"} <= metrics.keys()
    assert not {"k", "n", "certificate_grad_n"} & metrics.keys()
    zeta = trainer.agent.zeta.tolist()
    assert zeta != pytest.approx(start)
    for value, parameter in zip(zeta, family.parameters, strict=True):
        assert parameter.low - 1e-6 <= value <= parameter.high + 1e-6
    saved = trainer.policy.arrays()
    assert saved["zeta"].shape == (3,)
    assert str(saved["family"]) == NAME
    again = joint_sis.Trainer(config, ToyEnvs, 0, 800)
    again.load_state_dict(trainer.state_dict())
    assert again.agent.zeta.tolist() == zeta


def test_the_constraint_and_the_loss_are_those_of_its_phi(family: EnergyFamily) -> None:
    config = safemr.Config(family=NAME, start=AT, a=0.5, b=0.25, constraint_floor=-99.0)
    trainer = safemr.Trainer(safemr.Config(**SMALL, family=NAME), ToyEnvs, 0, 800)
    trainer.advance(400)
    batch = trainer.replay.sample(64, torch.Generator().manual_seed(0))
    zeta = torch.tensor(AT)
    rows = ((batch.d, batch.d_dot), (batch.d_next, batch.d_dot_next))
    before, after = (family.phi(d, d_dot, 0.5, *AT).amax(-1) for d, d_dot in rows)
    g = after - before.clamp_min(0.0)
    torch.testing.assert_close(fac.constraint_values(batch, zeta, 0.5, config), g)
    ones = torch.ones(64)
    loss = safemr.certificate_loss(batch, ones, zeta, 0.5, config)
    assert loss.item() == pytest.approx(
        g.mean().item() + 0.5 * 0.7 + 0.25 * (1 / 3 + 0.4), abs=1e-5
    )


def test_a_network_corrects_it_as_it_corrects_the_papers(family: EnergyFamily) -> None:
    config = neural_safemr.Config(**SMALL, family=NAME, start=AT)
    policy = neural_safemr.Trainer(config, ToyEnvs, 0, 800).policy
    found = neural_safemr.NeuralCertificate.from_policy(policy, "it")
    assert found.parameters == pytest.approx({"sigma": 0.2, "u": 1.5, "t": 0.4, "smoothing": 0.1})
    d, d_dot = np.linspace(1.0, 4.0, 9)[:, None], np.linspace(-2.0, 1.0, 9)[:, None]
    plain = EnergyCertificate("it", family.at(AT)).phi(d, d_dot, 0.5)
    corrected = found.phi(d, d_dot, 0.5, np.zeros((9, 1)))
    far = plain > 0.5 - d[:, 0] + 1.0  # where contact has no part in the soft maximum
    assert far.any()
    np.testing.assert_allclose(corrected[far], plain[far], atol=1e-4)  # f is 0 at the start


def test_resolved_settings_say_the_family_and_its_version(
    family: EnergyFamily, monkeypatch: pytest.MonkeyPatch
) -> None:
    algorithm = catalogue.load_algorithm("safemr")

    def resolved(values: dict[str, Any]) -> dict[str, Any]:
        return json.loads(
            records.canonical_json(catalogue.hyperparameters(algorithm, values, "it"))
        )

    plain, other = resolved({}), resolved({"family": NAME})
    assert other == {**plain, "family": NAME, "family_version": 1}
    assert resolved({"family": "paper"}) == plain
    moved = resolved({"family": NAME, "start": [0.2, 1, 0.4]})
    assert moved == {**other, "start": [0.2, 1.0, 0.4]}
    assert safemr.Config(**moved).first_zeta == (0.2, 1.0, 0.4)  # as a record is read
    monkeypatch.setattr(
        metadata, "entry_points", lambda group: [metadata.EntryPoint("braking", NAME, group)]
    )
    packages.registered.cache_clear()
    assert resolved({"family": "braking"}) == other


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"family": NAME, "sigma": 0.2}, "sigma = 0.2: is of the paper's family"),
        ({"family": NAME, "k_max": 2.0}, "k_max = 2.0: is of the paper's family"),
        ({"family": NAME, "start": (0.1,)}, "must be 3 numbers: sigma, u, t"),
        ({"family": NAME, "start": (0.1, 99.0, 0.3)}, r"start = .*u must lie in \[0.2, 10.0\]"),
        ({"family": NAME, "family_version": 2}, "the installed .* is version 1"),
        ({"start": (0.1, 1.0, 1.0)}, "here set sigma, k and n"),
        ({"family": "gone.energy"}, "there is no module gone"),
        ({"family": "papre"}, "did you mean 'paper'.*PACKAGE.MODULE"),
    ],
)
def test_what_does_not_fit_is_one_line(
    family: EnergyFamily, values: dict[str, Any], says: str
) -> None:
    with pytest.raises(UserError, match=says) as caught:
        safemr.Config(**values)
    assert "\n" not in str(caught.value)


GOOD = """
from safemr.certificates.families import Parameter
VERSION = 1
PARAMETERS = {"c": Parameter(0.1, 0.0, 1.0, metres=1), "k": Parameter(1.0, 0.1, 2.0)}
def phi(d, d_dot, d_min, c, k):
    return c + d_min - d - k * d_dot
"""


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("VERSION = 1", "", "must define VERSION"),
        ("VERSION = 1", "VERSION = 'one'", "VERSION must be an integer"),
        ('"c": Par', '"C-1": Par', "'C-1' is no name of a parameter"),
        ('"c": Par', '"eta": Par', "no parameter can be called eta"),
        ('"c": Par', '"train_c": Par', "no parameter can be called train_c"),
        ("Parameter(0.1, 0.0, 1.0, metres=1)", "Parameter(2.0, 0.0, 1.0)", "c must have low <="),
        ("Parameter(0.1, 0.0, 1.0, metres=1)", "0.1", r"c must be a Parameter\("),
        ("d_min, c, k)", "d_min, c)", r"phi must take \(d, d_dot, d_min, c, k\)"),
        ("- d - k", "+ d - k", "phi rises with d at c = 0.1"),
        ("- k * d_dot", "+ k * d_dot", "phi rises with d_dot"),
        ("c + d_min", "0.1 / c + d_min", "not finite at c = 0; narrow the box"),
        (", metres=1", "", "say the powers of metres in units"),
        ("return c", "return np.sqrt(c)", "fails at c = 0.1: NameError"),
        ("return c + d_min - d - k * d_dot", "return c", "phi has shape"),
    ],
)
def test_what_is_wrong_with_a_family_is_one_line(
    package: Path, before: str, after: str, says: str
) -> None:
    assert before in GOOD
    (package / "own.py").write_text(GOOD.replace(before, after))
    with pytest.raises(UserError, match=says) as caught:
        families.named("mine.own")
    assert "\n" not in str(caught.value)


def test_a_phi_of_arrays_alone_is_refused_before_it_learns(package: Path) -> None:
    text = "import numpy as np\n" + GOOD.replace("k * d_dot", "k * np.asarray(d_dot).copy()")
    (package / "own.py").write_text(text)
    assert families.named("mine.own").names == ("c", "k")
    with pytest.raises(UserError, match=r"mine\.own: phi does not work on torch tensors"):
        fac.Trainer(fac.Config(**SMALL, family="mine.own"), ToyEnvs, 0, 800)


@pytest.fixture
def record(family: EnergyFamily, tmp_path: Path) -> Record:
    """A short run of SafeMR on the aircraft with the family."""
    settings = {**SMALL, "family": NAME, "target_entropy": -1.0, "length_scale": 5.0}
    status = train.main(
        ["--task", "Aircraft", "--algorithm", "safemr", "--variant", "Braking", "--steps", "800",
         "--log-points", "2", "--eval-episodes", "1", "--out", str(tmp_path),
         *[f"--set={name}={value}" for name, value in settings.items()]]
    )  # fmt: skip
    assert status == 0
    (folder,) = tmp_path.glob("runs/Aircraft/Braking/*")
    return Record.open(folder)


def test_a_record_gives_its_certificate_and_the_aircraft_compares_it(
    family: EnergyFamily, record: Record
) -> None:
    found = record.certificate()
    assert isinstance(found, EnergyCertificate)
    assert isinstance(found.zeta, Values)
    assert found.energy_family is family
    assert list(found.parameters) == ["sigma", "u", "t"]
    assert list(found.parameters.values()) == record.policy_arrays()["zeta"].tolist()
    assert record.provenance["family"]["module"] == NAME
    assert record.provenance["family"]["sources"] == packages.digest(NAME)
    # On the aircraft: its row, its scores and its drawing.
    states = generator.uniform([-6, -10, 0], [20, 10, 6], (400, 3))
    value = CONSTANT.separation(states) - 7.0
    truth = unsafe_sets.Truth(CONSTANT, states, value, 1.0)
    row = scoring._certificate(truth, found)
    assert row["family"] == NAME
    assert row["u"] == found.parameters["u"]
    learner = {"kind": "learner", "variant": "Braking", "seed": 0, "covers": True, **row}
    comparison = pd.DataFrame(
        [learner, {**learner, "variant": "SafeMR", "family": None, "sigma": 0.06, "k": 1, "n": 1}]
    )
    (braking,), (papers,) = (
        scoring.learned_zetas(comparison, name) for name in ("Braking", "SafeMR")
    )
    assert braking == (found.zeta, 5.0)
    assert braking[0].family is family
    assert papers == (Zeta(0.06, 1, 1), 5.0)
    drawn = unsafe_sets.energy_of(CONSTANT, *braking)(states)
    np.testing.assert_array_equal(drawn, unsafe_sets.of_states(CONSTANT, found)(states))
    assert "family" not in set(scoring.as_scores(comparison)["metric"])


def test_the_check_searches_it_and_leaves_the_papers_condition_out(family: EnergyFamily) -> None:
    weak, strong = (
        EnergyCertificate(name, family.at(values))
        for name, values in (("weak", (0.1, 20.0, 0.05)), ("strong", (0.1, 0.5, 0.5)))
    )
    rows, searches = zip(
        *(certify.certify(one, certify.DEFAULT_TASK, states=2**9) for one in (weak, strong)),
        strict=True,
    )
    assert rows[0]["infeasible_share"] > rows[1]["infeasible_share"]  # nobody brakes at 20 m/s^2
    assert rows[0]["worst_margin"] > 0
    assert not any(name.startswith("margin_") for name in rows[0])
    example = searches[0].example()
    assert (example["family"], example["u"]) == (NAME, 20.0)
    assert falsification.replay(example)[1].min() == pytest.approx(example["margin"])
    papers, _ = certify.certify(
        EnergyCertificate("phi_h", paper.PHI_H), certify.DEFAULT_TASK, states=2**9
    )
    both = certificates.certificate_table([papers, *rows])
    assert both.display["parameters"][1] == "sigma = 0.100, u = 20.000, t = 0.050"
    assert both.display["C inside, aligned brake"][1] == "–"
    assert "weak, strong of braking_distance.energy: no analytic verdict" in both.notes[0]
    alone = certificates.certificate_table(rows)
    assert not any(column.startswith("C ") for column in alone.display)
    assert "[sigma, k, n]" in certificates.certificate_table([papers]).display


def test_certify_takes_a_family_and_where_it_is(family: EnergyFamily) -> None:
    parser = certificates._parser()
    asked = parser.parse_args(["--family", NAME, "--at", "0.2", "1.5", "0.4", "--name", "mine"])
    ((found, _),) = certificates._jobs(asked)
    assert (found.name, tuple(found.zeta)) == ("mine", AT)
    for arguments, says in (
        (["--family", NAME, "--at", "1"], "has 3 parameters"),
        (["--family", NAME, "--k", "1"], "give --at"),
        (["--at", "1"], "--at is for another --family"),
    ):
        with pytest.raises(UserError, match=says):
            certificates._jobs(parser.parse_args(arguments))


def test_curves_and_tables_have_the_parameters_by_name(family: EnergyFamily) -> None:
    names = family.names
    rows = [
        ("T", "Braking", seed, step, name, float(step + seed))
        for seed in (0, 1) for step in (1, 2) for name in names
    ]  # fmt: skip
    columns = ["task", "variant", "seed", "step", "metric", "value"]
    progress = pd.DataFrame(rows, columns=columns)
    figure = curves.parameter_evolution(progress, ["T"], variants=["Braking"], parameters=names)
    assert [ax.get_title() for ax in figure.axes] == [r"$\sigma$", "u", "t"]
    table = sensitivity.table_two(
        progress[progress["step"] == 2], {"Braking": (0.35, 0.15)}, parameters=names
    )
    assert list(table.display.columns) == ["[a, b]", "seed", *names]
    assert "paper" not in set(table.data["seed"])


def test_the_papers_family_goes_through_the_same_door() -> None:
    assert families.named("paper") is PAPER
    assert PAPER.at((0.3, 1.0, 2.0)) == paper.PHI_H
    assert isinstance(PAPER.at((0.3, 1.0, 2.0)), Zeta)
    assert PAPER.in_metres((0.3, 1.0, 2.0), 5.0) == (energy.in_metres((0.3, 1.0, 2.0), 5.0), 25.0)
    run = planning.make_run(
        planning.describe_task("Aircraft", {}), catalogue.load_algorithm("fac"),
        catalogue.hyperparameters(catalogue.load_algorithm("fac"), {"target_entropy": -1.0}, ""),
        variant="x", seed=0, steps=100, log_every=10,
        evaluation={"every": 10, "episodes": 1, "seed": 0},
    )  # fmt: skip
    assert (
        not {"family", "start", "family_version"}
        & run.config["algorithm"]["hyperparameters"].keys()
    )
