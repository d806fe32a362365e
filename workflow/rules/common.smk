# Configuration -> plan; names that the rules share. No rules.
import os
import re
import sys
from pathlib import Path

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

from snakemake.exceptions import WorkflowError

from safemr.experiment.config import load
from safemr.certificates.families import named
from safemr.errors import UserError
from safemr.experiment.records import POLICY, PROVENANCE, REQUIRED_FILES
from safemr.experiment.plan_cache import plan_for
from safemr import paper
from safemr.experiment.sources import digests

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
SOURCES = digests(
    sorted(Path(workflow.basedir, "workflow/scripts").glob("*.py")),
    Path(RESULTS, ".work/sources.json"),
)
SUMMARY = f"{RESULTS}/summary"
LOGS = f"{RESULTS}/logs"
# By their roles, whatever their labels: the variant that Table I is about, and the one without its
# regularizer.
METHOD = PLAN.grid.first("method", paper.METHOD)
ABLATION = PLAN.grid.first("ablation", paper.ABLATION)
SAFE = {
    "tolerance": CONFIG.cost_tolerance,
    "clean_share": CONFIG.zero_violation_share,
    "protocol": CONFIG.protocol,
}
# By which scores runs are judged: those of their last evaluations, or of flights on unseen layouts.
JUDGED = f"{SUMMARY}/{'judged' if CONFIG.protocol == 2 else 'scores'}.csv"
TARGETS = []  # each rules file adds what `all` must make


def has(trait):
    """Those of `tasks` whose environment has something: a name in `safemr.tasks.Traits`."""
    return [task for task in CONFIG.tasks if getattr(PLAN.tasks[task].traits, trait)]


def entries_of(names):
    """Of some tasks, what their environments are made from."""
    return [dict(PLAN.tasks[name].entry) for name in names]


def record_files(runs):
    """The files of the records of some runs."""
    return [f"{RESULTS}/{run.path}/{name}" for run in runs for name in REQUIRED_FILES]


def parameters_of(runs):
    """The names of the parameters of some runs' energy functions, each once."""
    families = {run.config["algorithm"]["hyperparameters"].get("family", "paper"): None for run in runs}
    return list(dict.fromkeys(name for family in families for name in named(family).names))


def expected(runs):
    """Task, variant and seed of some runs: what a table must show or call missing."""
    return [[run.task, run.variant, run.seed] for run in runs]


def one_of(names):
    """A wildcard constraint: one of some literal names."""
    return "|".join(re.escape(name) for name in sorted(set(names))) or "(?!)"


def sources(script):
    """A digest of what workflow/scripts/<script>.py uses: an edit there runs its rule again."""
    return SOURCES[script]


def without_policy(runs):
    """Which recorded runs lack policy.npz, which is optional and hence no input.

    A parameter of what reads policies, which is made again when one comes or goes.
    """
    folders = [f"{RESULTS}/{run.path}" for run in runs]
    complete = [folder for folder in folders if os.path.exists(f"{folder}/{PROVENANCE}")]
    return [folder for folder in complete if not os.path.exists(f"{folder}/{POLICY}")]
