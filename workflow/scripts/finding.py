"""The finding in one picture: the final policies' returns and violations on unseen layouts."""

from pathlib import Path

import pandas as pd

from safemr.report import finding, second_protocol
from safemr.report.figures import finding as drawing
from safemr.report.figures import style

params = snakemake.params
flown = pd.concat([pd.read_csv(path) for path in snakemake.input], ignore_index=True)
flown = flown[flown["variant"].isin(list(params.variants))]
rule = second_protocol.rule_of(params.protocol, params.tolerance, params.clean_share)
found = finding.points(flown, rule)
each = " for each seed" if params.own else ""
figure = drawing.finding(
    found,
    finding.ahead(flown, found, params.method, style.label, params.baselines),
    params.tasks,
    method=params.method,
    rule=rule,
    where=f"Final policies on {params.episodes} layouts{each} that no run was evaluated on",
)
style.save(figure, Path(snakemake.output.pdf[0]).with_suffix(""))
