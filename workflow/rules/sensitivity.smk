# The points [a, b] of the regularizer. They are variants of the one training rule.
LEARNED_AT_POINTS = dict(
    task=CONFIG.sensitivity and CONFIG.sensitivity.task,
    expected=expected(PLAN.sensitivity),
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
