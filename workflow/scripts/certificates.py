"""Check the paper's certificates and the learned ones; table, picture, replayable examples."""

import json
from dataclasses import replace
from pathlib import Path

from safemr.errors import reported_errors
from safemr.measure import certify
from safemr.measure.store import Measurements
from safemr.report import certificates
from safemr.report.figures import style
from safemr.tasks import name_of

params, output = snakemake.params, snakemake.output
measurements = Measurements(params.root)
rows, examples = [], {}
with reported_errors():
    learned = {
        folder: certify.certificate_of_record(Path(params.root, folder))
        for folder in params.folders
    }
    papers = certify.paper_certificates() if params.paper else []
    jobs = [(certificate, certify.DEFAULT_TASK) for certificate in papers] + [*learned.values()]
    for title, (certificate, task) in zip(certify.example_titles(jobs), jobs, strict=True):
        row, examples[title] = certify.measured_certificate(
            measurements, certificate, task, states=params.states, episodes=params.episodes
        )
        rows.append(row)
    chosen = [(certificate, certify.DEFAULT_TASK) for certificate in papers]
    chosen += [learned[folder] for folder in params.pictured] or jobs[-1:]
    # The map is that of the last one.
    chosen.sort(key=lambda job: job[0].name.partition(" (")[0] == params.method)
    mapped = certify.measured_margins(measurements, *chosen[-1])
    figure = certificates.picture([certificate for certificate, _ in chosen], *mapped)
table = certificates.certificate_table(rows)
lacking = [
    f"{certificate.name} on {name_of(task)}"
    for certificate, task in learned.values()
    if certify.trained_policy(certificate) is None
]
if lacking:
    note = f"No policy.npz, parameters from progress.csv: {'; '.join(lacking)}."
    print(note)
    table = replace(table, notes=[note])
table.write(Path(output.markdown).parent)
Path(output.examples).write_text(json.dumps(examples, indent=1, sort_keys=True) + "\n")
style.save(figure, Path(output.pdf).with_suffix(""))
