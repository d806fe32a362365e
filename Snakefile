# From nothing to every table and figure: `snakemake -j2 all`.
# Training runs are content-addressed (workflow/rules/train.smk), so what is already recorded under
# results/ is not trained again, in a fresh clone neither.
from snakemake.utils import min_version

min_version("9.14")


report: "workflow/report/workflow.rst"


include: "workflow/rules/common.smk"
include: "workflow/rules/recovery.smk"
include: "workflow/rules/train.smk"
include: "workflow/rules/outside.smk"
include: "workflow/rules/aggregate.smk"
include: "workflow/rules/evidence.smk"
include: "workflow/rules/unseen.smk"
include: "workflow/rules/filters.smk"
include: "workflow/rules/figures.smk"
include: "workflow/rules/sensitivity.smk"
include: "workflow/rules/aircraft.smk"


# On a cluster only what trains is a job of the scheduler: the rest takes seconds to minutes.
localrules:
    aggregate,
    aircraft_comparison,
    aircraft_figures,
    aircraft_frontier,
    aircraft_neural,
    all,
    certificate_paths,
    certificates,
    claims,
    compute_curves,
    controllers,
    filters,
    final_scores,
    illustrations,
    parameters,
    policies,
    rollouts,
    sensitivity,
    table_1,
    training_curves,
    unseen_layouts,
    unseen_table,
    weight_map,


onerror:
    print(f"What is complete, and why the rest is not, says: safemr records {RESULTS}")
    print(
        "Tables and figures of what is complete: snakemake -j2 all --config allow_missing=true"
    )


rule all:
    default_target: True
    input:
        TARGETS,
