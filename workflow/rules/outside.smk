# Implementations outside `safemr`: whatever writes the record (examples/outside/README.md) takes
# part in tables and figures. One rule each; their labels, budgets and hyperparameters stand under
# `outside` in the configuration.
def outside_runs(algorithm):
    """The runs of the entries of `outside` that name this algorithm."""
    return [run for run in PLAN.outside if run.config["algorithm"]["name"] == algorithm]


rule cross_entropy:
    output:
        # `update` as in train.smk; the command then leaves a record alone that is there already.
        update(expand(f"{RECORD}/{{name}}", name=REQUIRED_FILES, allow_missing=True)),
    log:
        f"{LOGS}/outside/{{task}}_{{variant}}_seed{{seed}}-{{digest}}.log",
    wildcard_constraints:
        variant=one_of(run.path.parts[2] for run in outside_runs("cross_entropy")),
        digest=DIGEST,
    threads: 1
    resources:
        **TRAINING,
    params:
        resolved=lambda wildcards: run_of(wildcards).resolved,
        variant=lambda wildcards: run_of(wildcards).variant,
        folder=lambda wildcards: RECORD.format(**wildcards),
        program=os.path.join(workflow.basedir, "examples/outside/cross_entropy.py"),
    shell:
        "test -f {params.folder:q}/provenance.json ||"
        " {sys.executable:q} {params.program:q} --config {params.resolved:q}"
        " --variant {params.variant:q} --out {params.folder:q} > {log:q} 2>&1"
