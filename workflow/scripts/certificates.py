"""Check the paper's certificates and the learned ones; table, picture, replayable examples."""

import json
from dataclasses import replace
from pathlib import Path

from safemr import certify, reference
from safemr.cli import reported_errors
from safemr.measurements import Measurements
from safemr.plotting import style

params, output = snakemake.params, snakemake.output
measurements = Measurements(params.root)
rows, examples = [], {}
with reported_errors():
    jobs = [(c, certify.DEFAULT_TASK, {}) for c in certify.paper_certificates()]
    pictured = [job[0] for job in jobs]
    for folder in params.folders:
        jobs.append(certify.certificate_of_record(Path(params.root, folder)))
        if folder in params.pictured and jobs[-1][1] == certify.DEFAULT_TASK:
            pictured.append(jobs[-1][0])
    for certificate, task, settings in jobs:
        row, example = certify.measured_certificate(
            measurements, certificate, task,
            states=params.states, episodes=params.episodes, settings=settings,
        )  # fmt: skip
        rows.append(row)
        examples[f"{certificate.name} on {task}"] = example
    # The map is that of the last one.
    pictured.sort(key=lambda certificate: certificate.name.partition(" (")[0] == reference.METHOD)
    mapped = certify.measured_margins(measurements, pictured[-1], certify.DEFAULT_TASK)
    figure = certify.picture(pictured, *mapped)
table = certify.certificate_table(rows)
lacking = [f"{job[0].name} on {job[1]}" for job in jobs[5:] if job[0].policy is None]
if lacking:
    note = f"No policy.npz, parameters from progress.csv: {'; '.join(lacking)}."
    print(note)
    table = replace(table, notes=[note])
table.write(Path(output.markdown).parent)
Path(output.examples).write_text(json.dumps(examples, indent=1, sort_keys=True) + "\n")
style.save(figure, Path(output.pdf).with_suffix(""))
