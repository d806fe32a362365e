# The points [a, b] of the regularizer. They are variants of the one training rule.
from safemr.experiment.planning import seeds_told

# The grid may have the base point, and the variant without [a, b], with more seeds than the study.
AT_POINTS = [
    run
    for run in {run.path: run for run in (*PLAN.sensitivity, *PLAN.navigation)}.values()
    if CONFIG.sensitivity and run.task == CONFIG.sensitivity.task
    if run.variant in (*PLAN.points, ABLATION)
]
LEARNED_AT_POINTS = dict(
    task=CONFIG.sensitivity and CONFIG.sensitivity.task,
    expected=expected(AT_POINTS),
    seeds=seeds_told(AT_POINTS),
    method=CONFIG.sensitivity and CONFIG.sensitivity.variant,
    ablation=ABLATION,
    points={label: list(point) for label, point in PLAN.points.items()},
    parameters=parameters_of(PLAN.sensitivity),
)


rule sensitivity:
    input:
        progress=rules.aggregate.output.progress,
        runs=rules.aggregate.output.runs,
    output:
        **figure_outputs("sensitivity"),
        table=expand(f"{RESULTS}/tables/table2.{{end}}", end=["csv", "md", "tex"]),
    log:
        f"{LOGS}/sensitivity.log",
    threads: 1
    params:
        **LEARNED_AT_POINTS,
        sources=sources("sensitivity"),
    script:
        "../scripts/sensitivity.py"


# The same question for a whole grid of points, which curves could not show.
rule weight_map:
    input:
        progress=rules.aggregate.output.progress,
        scores=JUDGED,
        runs=rules.aggregate.output.runs,
    output:
        **figure_outputs("weight_map"),
        table=expand(f"{RESULTS}/tables/weight_map.{{end}}", end=["csv", "md", "tex"]),
    log:
        f"{LOGS}/weight_map.log",
    threads: 1
    params:
        **LEARNED_AT_POINTS,
        **SAFE,
        sources=sources("weight_map"),
    script:
        "../scripts/weight_map.py"


if CONFIG.sensitivity:
    shown = rules.weight_map if CONFIG.sensitivity.is_map else rules.sensitivity
    TARGETS += shown.output
