"""What the second protocol judges: final policies as flown, training as it was logged."""

import pandas as pd

from safemr.report.second_protocol import judged_scores

given = snakemake.input
flown = pd.concat([pd.read_csv(path) for path in given.flown], ignore_index=True)
judged_scores(pd.read_csv(given.scores), flown).to_csv(snakemake.output[0], index=False)
