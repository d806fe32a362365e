# What the learned numbers are read against: scripted controllers, the check of the certificates,
# and the verdicts on the paper's claims.
ROBOT_TASKS = has("point_robot")
PAPER_TASKS = [task for task in CONFIG.tasks if task in paper.TASKS]
# For captions.
BUDGET = {"seeds": PLAN.seeds_told, "steps": dict(CONFIG.budget)}

# Variants whose certificate is learned, and of each the first recorded run on each task.
LEARNED = PLAN.grid.learned
FIRST_RUNS = {}
for entry in (*PLAN.navigation, *PLAN.sensitivity):
    learns = entry.variant in (*LEARNED, *PLAN.points)
    if learns and PLAN.tasks[entry.task].traits.point_robot and entry.path in RECORDED_PATHS:
        FIRST_RUNS.setdefault((entry.task, entry.variant), entry)

# The paper's certificates are those of one of its tasks, and stand beside what was learned there.
# Certificates are pictured on one task: theirs, or else the first with a learned one.
WITH_PAPERS = paper.SENSITIVITY_TASK in PAPER_TASKS
PICTURED = paper.SENSITIVITY_TASK if WITH_PAPERS else next((task for task, _ in FIRST_RUNS), "")


rule controllers:
    output:
        f"{SUMMARY}/controllers.csv",
    log:
        f"{LOGS}/controllers.log",
    threads: 1
    params:
        root=RESULTS,
        tasks=entries_of(ROBOT_TASKS),
        seeds=min(5, CONFIG.evaluation.episodes),
        episodes=CONFIG.evaluation.episodes,
        sources=sources("controllers"),
    message:
        "Evaluating the scripted controllers"
    script:
        "../scripts/controllers.py"


rule certificates:
    input:
        record_files(FIRST_RUNS.values()),
    output:
        table=expand(f"{RESULTS}/tables/certificates.{{end}}", end=["csv", "tex"]),
        markdown=report(
            f"{RESULTS}/tables/certificates.md",
            caption="../report/certificates.rst",
            category="Tables",
        ),
        examples=f"{RESULTS}/tables/certificate_examples.json",
        pdf=f"{FIGURES}/certificates.pdf",
        png=report(
            f"{FIGURES}/certificates.png",
            caption="../report/certificates.rst",
            category="Figures",
        ),
    log:
        f"{LOGS}/certificates.log",
    threads: 1
    params:
        root=RESULTS,
        folders=[run.path.as_posix() for run in FIRST_RUNS.values()],
        paper=WITH_PAPERS,
        pictured=[
            run.path.as_posix()
            for run in FIRST_RUNS.values()
            if run.variant in LEARNED and run.task == PICTURED
        ],
        method=METHOD,
        states=2**13,
        episodes=min(8, CONFIG.evaluation.episodes),
        lacking=without_policy(FIRST_RUNS.values()),
        sources=sources("certificates"),
    message:
        "Checking %d learned certificates%s" % (len(FIRST_RUNS), " and the paper's" * WITH_PAPERS)
    script:
        "../scripts/certificates.py"


rule claims:
    input:
        scores=JUDGED,
        progress=rules.aggregate.output.progress,
        certificates=rules.certificates.output.table[0] if WITH_PAPERS or FIRST_RUNS else [],
        aircraft=f"{SUMMARY}/aircraft.csv"
        if CONFIG.aircraft and CONFIG.aircraft.task == paper.AIRCRAFT_TASK
        else [],
    output:
        table=expand(f"{RESULTS}/tables/claims.{{end}}", end=["csv", "tex"]),
        markdown=report(
            f"{RESULTS}/tables/claims.md", caption="../report/claims.rst", category="Claims"
        ),
    log:
        f"{LOGS}/claims.log",
    threads: 1
    params:
        **BUDGET,
        expected=expected((*PLAN.navigation, *PLAN.sensitivity, *PLAN.aircraft, *PLAN.outside)),
        points={
            label: list(point)
            for label, point in PLAN.points.items()
            if CONFIG.sensitivity.task == paper.SENSITIVITY_TASK
        },
        **SAFE,
        sources=sources("claims"),
    script:
        "../scripts/claims.py"


# The front page's table, of what has all of the paper's tasks.
rule verdicts:
    input:
        claims=rules.claims.output.table[0],
        runs=rules.aggregate.output.runs,
    output:
        report(
            f"{RESULTS}/tables/verdicts.md", caption="../report/verdicts.rst", category="Claims"
        ),
    log:
        f"{LOGS}/verdicts.log",
    threads: 1
    params:
        figures=FIGURES,
        sources=sources("verdicts"),
    script:
        "../scripts/verdicts.py"


TARGETS += [*rules.claims.output]
if set(PAPER_TASKS) == set(paper.TASKS):
    TARGETS += [*rules.verdicts.output]
if WITH_PAPERS or FIRST_RUNS:
    TARGETS += [*rules.certificates.output]
