# How small a certificate may be, and what its size is worth.
from safemr.errors import tell
from safemr.experiment.catalogue import declared_certificate

TO_SIZE = [
    run
    for run in {run.path: run for run in (*PLAN.navigation, *PLAN.sensitivity)}.values()
    if CONFIG.sizes
    and run.task in ROBOT_TASKS
    and declared_certificate(run.config["algorithm"]["name"]) == "energy"
]
SIZED = [run for run in TO_SIZE if run.path in RECORDED_PATHS]
SIZED_TASKS = [task for task in CONFIG.tasks if any(run.task == task for run in SIZED)]
SIZES = f"{SUMMARY}/sizes.csv"
# The same of another configuration, its sizes first.
SIZES_BESIDE = [
    CONFIG.sizes_beside / Path(made).relative_to(RESULTS)
    for made in [SIZES, *expand(rules.unseen_layouts.output[0], task=SIZED_TASKS)]
    if CONFIG.sizes_beside
]
# The rule says so too, but after hours of training, and the other configuration may be made by then.
if SIZES_BESIDE and workflow.is_main_process:
    from safemr.report.sizes import missing

    if said := missing(*SIZES_BESIDE):
        tell(f"warning: {said}")


rule sizes:
    input:
        records=record_files(SIZED),
        flown=expand(rules.unseen_layouts.output[0], task=SIZED_TASKS),
        beside=[file for file in SIZES_BESIDE if file.exists()],
    output:
        sizes=SIZES,
        table=expand(
            f"{RESULTS}/tables/{{name}}.{{end}}", name=["sizes", "regularizer"], end=["csv", "tex"]
        ),
        markdown=report(
            f"{RESULTS}/tables/sizes.md", caption="../report/sizes.rst", category="Tables"
        ),
        regularizer=report(
            f"{RESULTS}/tables/regularizer.md",
            caption="../report/regularizer.rst",
            category="Tables",
        ),
        pdf=f"{FIGURES}/return_against_size.pdf",
        png=report(
            f"{FIGURES}/return_against_size.png",
            caption="../report/sizes.rst",
            category="Figures",
        ),
        fit_pdf=f"{FIGURES}/return_at_equal_size.pdf",
        fit_png=report(
            f"{FIGURES}/return_at_equal_size.png",
            caption="../report/regularizer.rst",
            category="Figures",
        ),
    log:
        f"{LOGS}/sizes.log",
    threads: 1
    params:
        root=RESULTS,
        folders=[run.path.as_posix() for run in SIZED],
        expected=expected(TO_SIZE),
        tasks=SIZED_TASKS,
        method=METHOD,
        ablation=ABLATION,
        beside=[file.as_posix() for file in SIZES_BESIDE],
        lacking=without_policy(SIZED),
        sources=sources("sizes"),
    message:
        "Looking for the least feasible certificates and measuring %d others" % len(SIZED)
    script:
        "../scripts/sizes.py"


if SIZED:
    TARGETS += [*rules.sizes.output]
