# The final policies on layouts that no run was evaluated on: ten fixed layouts say little of others.
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
        tolerance=CONFIG.cost_tolerance,
        clean_share=CONFIG.zero_violation_share,
        sources=sources("unseen_table"),
    script:
        "../scripts/unseen_table.py"


if CONFIG.unseen_layouts and FLOWN:
    TARGETS += rules.unseen_table.output
