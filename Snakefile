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
include: "workflow/rules/sizes.smk"
include: "workflow/rules/figures.smk"
include: "workflow/rules/sensitivity.smk"
include: "workflow/rules/aircraft.smk"
include: "workflow/rules/page.smk"


onstart:
    # While jobs wait for a core Snakemake looks at all of them and their inputs every second, once
    # more for each job that has finished, to hold a limit of 100 starts a second that is of no use
    # here; and it solves a linear program to choose among jobs of one core each.
    # These are internals: where a later version has none of that name, it goes on as it would. A
    # cluster's limit is its administrator's business and stays.
    if getattr(workflow, "local_exec", False):
        workflow.scheduler.job_rate_limiter = None
        if hasattr(workflow.scheduler, "job_selector_greedy"):
            workflow.scheduler._job_selector = workflow.scheduler.job_selector_greedy


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
    controllers,
    curves,
    filters,
    final_scores,
    finding,
    illustrations,
    judged,
    page,
    policies,
    protocol,
    rollouts,
    sensitivity,
    side_by_side,
    sizes,
    table_1,
    unseen_layouts,
    unseen_table,
    verdicts,
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
