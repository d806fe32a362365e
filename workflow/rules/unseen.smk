# The final policies on layouts that no run was evaluated on: ten fixed layouts say little of others.
PROTOCOL_TABLES = ["windows", "training_violations", "power", "power_of_safety"]
TO_FLY = expected((*PLAN.navigation, *PLAN.sensitivity))
FLOWN = {}
for run in (*PLAN.navigation, *PLAN.sensitivity):
    if run.path in RECORDED_PATHS:
        FLOWN.setdefault(run.task, {})[run.path.as_posix()] = run


rule unseen_layouts:
    input:
        lambda wildcards: record_files(FLOWN[wildcards.task].values()),
    output:
        f"{SUMMARY}/unseen_layouts/{{task}}.csv",
    log:
        f"{LOGS}/unseen_layouts/{{task}}.log",
    wildcard_constraints:
        task=one_of(FLOWN),
    threads: 1
    params:
        root=RESULTS,
        folders=lambda wildcards: list(FLOWN[wildcards.task]),
        episodes=CONFIG.unseen_layouts and CONFIG.unseen_layouts.episodes,
        seed=CONFIG.unseen_layouts and CONFIG.unseen_layouts.seed,
        own=CONFIG.unseen_layouts and CONFIG.unseen_layouts.own,
        lacking=lambda wildcards: without_policy(FLOWN[wildcards.task].values()),
        sources=sources("unseen_layouts"),
    message:
        "Flying the final policies of {wildcards.task} on {params.episodes} unseen layouts"
    script:
        "../scripts/unseen_layouts.py"


rule unseen_table:
    input:
        flown=expand(rules.unseen_layouts.output[0], task=FLOWN),
        scores=rules.aggregate.output.scores,
        runs=rules.aggregate.output.runs,
    output:
        *[
            report(
                f"{RESULTS}/tables/{name}.md",
                caption=f"../report/{name}.rst",
                category="Tables",
            )
            for name in ("unseen_layouts", "unseen_differences")
        ],
        table=expand(
            f"{RESULTS}/tables/{{name}}.{{end}}",
            name=["unseen_layouts", "unseen_differences"],
            end=["csv", "tex"],
        ),
    log:
        f"{LOGS}/unseen_table.log",
    threads: 1
    params:
        episodes=CONFIG.unseen_layouts and CONFIG.unseen_layouts.episodes,
        layouts=CONFIG.evaluation.episodes,
        method=METHOD,
        **SAFE,
        own=CONFIG.unseen_layouts and CONFIG.unseen_layouts.own,
        expected=TO_FLY,
        sources=sources("unseen_table"),
    script:
        "../scripts/unseen_table.py"


# What the second protocol judges: the flights, and of training what is known of its violations.
rule judged:
    input:
        flown=expand(rules.unseen_layouts.output[0], task=FLOWN),
        scores=rules.aggregate.output.scores,
    output:
        f"{SUMMARY}/judged.csv",
    log:
        f"{LOGS}/judged.log",
    threads: 1
    params:
        sources=sources("judged"),
    script:
        "../scripts/judged.py"


# How the second protocol's choices bear on what is said: the window of final evaluations, violations
# while training, and what this many seeds can see.
rule protocol:
    input:
        judged=rules.judged.output[0],
        progress=rules.aggregate.output.progress,
        runs=rules.aggregate.output.runs,
    output:
        *[
            report(
                f"{RESULTS}/tables/{name}.md", caption=f"../report/{name}.rst", category="Tables"
            )
            for name in PROTOCOL_TABLES
        ],
        table=expand(
            f"{RESULTS}/tables/{{name}}.{{end}}", name=PROTOCOL_TABLES, end=["csv", "tex"]
        ),
    log:
        f"{LOGS}/protocol.log",
    threads: 1
    params:
        tasks=list(CONFIG.tasks),
        method=METHOD,
        baselines=PLAN.grid.rivals,
        **SAFE,
        expected=TO_FLY,
        sources=sources("protocol"),
    script:
        "../scripts/protocol.py"


if CONFIG.unseen_layouts and FLOWN:
    TARGETS += rules.unseen_table.output
    if CONFIG.protocol == 2:
        TARGETS += rules.protocol.output
