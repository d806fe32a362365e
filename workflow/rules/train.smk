# One training run. `exec` makes the trainer a child of Snakemake itself, so that it notices when
# Snakemake is gone; its checkpoints live in <results root>/.work/<digest>/, which is no output, so
# that a failed job keeps them. An orphan of a killed Snakemake is waited for. The signals that the
# trainer answers with a checkpoint and a line reach the whole process group: `tee` ignores them and
# ends when the trainer has.
from snakemake.logging import logger

from safemr.experiment.resources import cores, memory_mb

RECORD = RESULTS + "/runs/{task}/{variant}/seed{seed}-{digest}"


# What a run asks of a cluster; what a time limit ends continues at its checkpoint when it is tried
# again.
TRAINING = dict(
    mem_mb=lambda wildcards: memory_mb(run_of(wildcards).config),
    runtime=lambda wildcards, attempt: 60 * attempt,  # minutes
)


# Not the digests themselves: a pattern of thousands is searched for each file of each run.
DIGEST = "[0-9a-f]{12}"


def run_of(wildcards):
    path = RECORD.removeprefix(RESULTS + "/").format(**wildcards)
    if path not in RUNS:
        raise WorkflowError(f"{RESULTS}/{path} is no run of this configuration")
    return RUNS[path]


# A run that failed had no record before, which Snakemake would say of each of its files.
logger.addFilter(lambda message: "no backup found" not in str(message.msg))


rule train:
    output:
        # `update`: Snakemake would remove what is there when a job begins, which may be hours after it
        # looked: the record that meanwhile the orphan of a killed Snakemake has finished, or a person.
        update(expand(f"{RECORD}/{{name}}", name=REQUIRED_FILES, allow_missing=True)),
    log:
        f"{LOGS}/train/{{task}}_{{variant}}_seed{{seed}}-{{digest}}.log",
    wildcard_constraints:
        variant=one_of(run.path.parts[2] for run in PLAN.trained),
        digest=DIGEST,
    threads: lambda wildcards: cores(run_of(wildcards).config)
    resources:
        **TRAINING,
        attempt=lambda wildcards, attempt: attempt,  # from --retries; what diverged says no
    params:
        resolved=lambda wildcards: run_of(wildcards).resolved,
        variant=lambda wildcards: run_of(wildcards).variant,
        root=RESULTS,
    message:
        "Training {wildcards.variant} on {wildcards.task}, seed {wildcards.seed}"
    shell:
        "exec {sys.executable:q} -u -P -m safemr.experiment.train --resolved {params.resolved:q}"
        " --variant {params.variant:q} --root {params.root:q} --die-with-parent --wait"
        " --attempt {resources.attempt}"
        # The copy to wandb is no part of a run: what is not in `params` does not make it train again.
        " --wandb {CONFIG.wandb_mode:q} --wandb-project {CONFIG.wandb_project:q}"
        " >> {log:q} 2> >(trap '' HUP INT TERM; exec tee -a {log:q} >&2)"


if workflow.is_main_process and workflow.output_settings.dryrun and not CONFIG.allow_missing:
    from safemr.errors import tell
    from safemr.experiment.forecast import announced, left_out

    for line in announced(CONFIG.results_root, PLAN.trained) + left_out(PLAN.tasks):
        tell(line)
