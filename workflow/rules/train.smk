# One training run. `exec` makes the trainer a child of Snakemake itself, so that it notices when
# Snakemake is gone; its checkpoints live in <results root>/.work/<digest>/, which is no output, so
# that a failed job keeps them. An orphan of a killed Snakemake is waited for. The signals that the
# trainer answers with a checkpoint and a line reach the whole process group: `tee` ignores them and
# ends when the trainer has.
RECORD = RESULTS + "/runs/{task}/{variant}/seed{seed}-{digest}"


def run_of(wildcards):
    return RUNS[RECORD.removeprefix(RESULTS + "/").format(**wildcards)]


rule train:
    output:
        expand(f"{RECORD}/{{name}}", name=REQUIRED_FILES, allow_missing=True),
    log:
        f"{LOGS}/train/{{task}}_{{variant}}_seed{{seed}}-{{digest}}.log",
    wildcard_constraints:
        variant=one_of(run.path.parts[2] for run in PLAN.trained),
        digest=one_of(run.digest for run in PLAN.trained),
    retries: 0  # a run is deterministic: what failed once fails again
    threads: 1
    params:
        resolved=lambda wildcards: run_of(wildcards).resolved,
        variant=lambda wildcards: run_of(wildcards).variant,
        root=RESULTS,
    message:
        "Training {wildcards.variant} on {wildcards.task}, seed {wildcards.seed}"
    shell:
        "exec {sys.executable:q} -u -P -m safemr.experiment.train --resolved {params.resolved:q}"
        " --variant {params.variant:q} --root {params.root:q} --die-with-parent --wait"
        # The copy to wandb is no part of a run: what is not in `params` does not make it train again.
        " --wandb {CONFIG.wandb_mode:q} --wandb-project {CONFIG.wandb_project:q}"
        " >> {log:q} 2> >(trap '' HUP INT TERM; exec tee -a {log:q} >&2)"


if workflow.is_main_process and workflow.output_settings.dryrun and not CONFIG.allow_missing:
    from safemr.errors import tell
    from safemr.experiment.forecast import announced, left_out

    for line in announced(CONFIG.results_root, PLAN.trained) + left_out(PLAN.tasks):
        tell(line)
