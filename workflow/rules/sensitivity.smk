# The points [a, b] of the regularizer. They are variants of the one training rule.
rule sensitivity:
    input:
        progress=rules.aggregate.output.progress,
        runs=rules.aggregate.output.runs,
    output:
        pdf=f"{FIGURES}/sensitivity.pdf",
        png=report(
            f"{FIGURES}/sensitivity.png",
            caption="../report/sensitivity.rst",
            category="Figures",
        ),
        table=expand(f"{RESULTS}/tables/table2.{{end}}", end=["csv", "md", "tex"]),
    log:
        f"{LOGS}/sensitivity.log",
    threads: 1
    params:
        task=CONFIG.sensitivity and CONFIG.sensitivity.task,
        expected=expected(PLAN.sensitivity),
        points={label: list(point) for label, point in PLAN.points.items()},
    script:
        "../scripts/sensitivity.py"


if CONFIG.sensitivity:
    TARGETS += rules.sensitivity.output
