"""An animation: the method beside the unsafe algorithm that returns the most, on one layout."""

import functools
from pathlib import Path

import pandas as pd

from envs.drawing import draw_scene, legend_of
from safemr.certificates.certificate import EnergyCertificate
from safemr.certificates.energy import largest
from safemr.certificates.families import phi_at
from safemr.errors import UserError, reported_errors
from safemr.experiment.record import Record
from safemr.measure import trajectories
from safemr.measure.store import Measurements
from safemr.report import finding, second_protocol
from safemr.report.figures import scenes

params = snakemake.params
flown = pd.read_csv(snakemake.input.flown)
rule = second_protocol.rule_of(params.protocol, params.tolerance, params.clean_share)
points = finding.points(flown, rule)
rivals = points[(points["label"] == "no") & points["variant"].isin(list(params.baselines))]
rivals = rivals[rivals["variant"].isin(list(params.folders))].sort_values("return")
shown = [params.method, *rivals["variant"].tail(1)]
recorded, energies = {}, {}
with reported_errors():
    for variant in shown:
        record = Record.open(Path(params.root, params.folders[variant]))
        if not record.has_policy:
            print(f"not shown, no policy in {record.folder}")
            continue
        recorded[variant] = trajectories.measured_episodes(
            Measurements(params.root), record, layouts=params.layouts, steps=params.steps
        )
        try:
            zeta = EnergyCertificate.from_record(record).in_metres().zeta
        except UserError:  # none, or one that is more than a phi of distance and rate
            energies[variant] = None
            continue
        d_min = float(recorded[variant]["d_min"])
        energies[variant] = functools.partial(
            lambda d, d_dot, d_min, zeta: largest(phi_at(d, d_dot, d_min, zeta)),
            d_min=d_min,
            zeta=zeta,
        )
# The first layout on which the rival violates and the method does not; else the first.
violates = [data["cost_indicator"].any(axis=0) for data in recorded.values()]
chosen = [
    place
    for place in range(len(params.layouts))
    if len(violates) == 2 and violates[1][place] and not violates[0][place]
]
episode = chosen[0] if chosen else 0
print(f"shown: {', '.join(recorded)} on layout {params.layouts[episode]}")
scenes.animation(
    recorded,
    draw_scene,
    snakemake.output[0],
    episode=episode,
    steps=params.steps,
    pixels=350,
    energies=energies,
    entries=legend_of,
)
