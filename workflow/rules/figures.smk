# Tables and figures of the navigation grid.
GRID = {"tasks": list(CONFIG.tasks), "variants": [*CONFIG.algorithms, *CONFIG.outside]}


rule table_1:
    input:
        scores=rules.aggregate.output.scores,
        runs=rules.aggregate.output.runs,
    output:
        expand(f"{RESULTS}/tables/table1.{{end}}", end=["csv", "tex"]),
        report(f"{RESULTS}/tables/table1.md", caption="../report/table_1.rst", category="Tables"),
        expand(f"{RESULTS}/tables/results.{{end}}", end=["csv", "md", "tex"]),
    log:
        f"{LOGS}/table_1.log",
    threads: 1
    params:
        **GRID,
        expected=expected((*PLAN.navigation, *PLAN.outside)),
        folder=f"{RESULTS}/tables",
        tolerance=CONFIG.cost_tolerance,
        clean_share=CONFIG.zero_violation_share,
    script:
        "../scripts/tables.py"


rule training_curves:
    input:
        progress=rules.aggregate.output.progress,
    output:
        pdf=f"{FIGURES}/training_curves.pdf",
        png=report(
            f"{FIGURES}/training_curves.png",
            caption="../report/training_curves.rst",
            category="Figures",
        ),
    log:
        f"{LOGS}/training_curves.log",
    threads: 1
    params:
        **GRID,
    script:
        "../scripts/training_curves.py"


TARGETS += [*rules.table_1.output, *rules.training_curves.output]
