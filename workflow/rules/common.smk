# Configuration -> plan; names that the rules share. No rules.
import os
import re
import sys

# Said before anything runs: Snakemake calls the interpreter of a script without quotes, and
# PYTHONPATH is split at colons.
if re.search(r"[^\w@%+=:,./-]", sys.executable):
    sys.exit(
        f"error: Snakemake cannot call an interpreter in {sys.prefix}: use an environment whose path "
        "has no spaces, quotes or other special characters (python3 make.py makes one by itself)"
    )
if os.pathsep in workflow.basedir:
    sys.exit(
        f"error: PYTHONPATH cannot hold {workflow.basedir}: move it to a path without {os.pathsep!r}"
    )

# The sources beside this Snakefile come first, here and in every job.
sys.path.insert(0, workflow.basedir)
os.environ["PYTHONPATH"] = os.pathsep.join(
    [workflow.basedir, *filter(None, [os.environ.get("PYTHONPATH")])]
)

from safemr.config import load
from safemr.errors import UserError
from safemr.records import REQUIRED_FILES
from safemr.plan_cache import plan_for

# A file given by --configfile replaces whole top-level keys of the default, so that it can also
# leave something out; Snakemake's own `configfile:` would merge the two entry by entry.
try:
    CONFIG = load(
        [
            os.path.join(workflow.basedir, "config/config.yaml"),
            *workflow.config_settings.configfiles,
        ],
        workflow.config_settings.config,
    )
    PLAN = plan_for(CONFIG)
except UserError as error:
    sys.exit(f"error: {error}")  # one line, without the frames of a WorkflowError

RESULTS, FIGURES = CONFIG.results_root.as_posix(), CONFIG.figures_root.as_posix()
RUNS = {run.path.as_posix(): run for run in PLAN.runs}
SUMMARY = f"{RESULTS}/summary"
LOGS = f"{RESULTS}/logs"
TARGETS = []  # each rules file adds what `all` must make


def record_files(runs):
    """The files of the records of some runs."""
    return [f"{RESULTS}/{run.path}/{name}" for run in runs for name in REQUIRED_FILES]


def expected(runs):
    """Task, variant and seed of some runs: what a table must show or call missing."""
    return [[run.task, run.variant, run.seed] for run in runs]


def one_of(names):
    """A wildcard constraint: one of some literal names."""
    return "|".join(re.escape(name) for name in sorted(set(names))) or "(?!)"
