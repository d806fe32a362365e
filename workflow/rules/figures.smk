# Tables and figures of the navigation grid.
GRID = {"tasks": list(CONFIG.tasks), "variants": [*CONFIG.algorithms, *CONFIG.outside]}
TABLES = {
    "table1": "../report/table_1.rst",
    "results": "../report/results.rst",
    "differences": "../report/differences.rst",
    "compute": "../report/compute.rst",
}
PUSH_TASKS = has("pushes_box")
if PUSH_TASKS:
    TABLES["push_split"] = "../report/push_split.rst"
PARALLEL = [run for run in PLAN.navigation if cores(run.config) > 1]
if PARALLEL:
    TABLES["parallel"] = "../report/parallel.rst"


rule table_1:
    input:
        scores=JUDGED,
        runs=rules.aggregate.output.runs,
        controllers=rules.controllers.output[0],
        progress=rules.aggregate.output.progress if PARALLEL else [],
    output:
        *[report(f"{RESULTS}/tables/{name}.md", caption=caption, category="Tables")
          for name, caption in TABLES.items()],
        table=expand(f"{RESULTS}/tables/{{name}}.{{end}}", name=TABLES, end=["csv", "tex"]),
    log:
        f"{LOGS}/table_1.log",
    threads: 1
    params:
        **GRID,
        **BUDGET,
        method=METHOD,
        # A baseline that somebody adds counts in Table I.
        baselines=PLAN.grid.rivals,
        push=PUSH_TASKS,
        layouts=CONFIG.evaluation.episodes,
        flown=CONFIG.unseen_layouts.episodes if CONFIG.protocol == 2 else 0,
        expected=expected((*PLAN.navigation, *PLAN.outside)),
        **SAFE,
        sources=sources("tables"),
    script:
        "../scripts/tables.py"


def figure_outputs(*names):
    """PDFs, and PNGs that the report shows, each with the caption of its name."""
    captions = {name: f"../report/{name.partition('/')[0]}.rst" for name in names}
    shown = [report(f"{FIGURES}/{name}.png", caption=caption, category="Figures")
             for name, caption in captions.items()]
    return {"pdf": [f"{FIGURES}/{name}.pdf" for name in names], "png": shown}


# Illustrations: the paper's numbers, where its task is among them, and the tasks themselves; no
# record.
ILLUSTRATIONS = ["energy_and_safe_set", "narrow_passage"] * WITH_PAPERS
ILLUSTRATIONS += ["environments"] * bool(ROBOT_TASKS)

# Aggregates divide by the paper's returns, so that they are of its tasks alone.
FINAL_SCORES = ["return_against_cost"]
FINAL_SCORES += ["aggregate_scores", "aggregate_safe_scores"] * bool(PAPER_TASKS)


rule illustrations:
    output:
        **figure_outputs(*ILLUSTRATIONS),
    log:
        f"{LOGS}/illustrations.log",
    threads: 1
    params:
        tasks=entries_of(ROBOT_TASKS),
        sources=sources("illustrations"),
    script:
        "../scripts/illustrations.py"


# What reads all of the progress, in one process: training, the same against processor time, and the
# learned parameters.
CURVES = ["training_curves", "compute_curves"] + ["parameters"] * bool(LEARNED)


rule curves:
    input:
        progress=rules.aggregate.output.progress,
        runs=rules.aggregate.output.runs,
    output:
        **figure_outputs(*CURVES),
    log:
        f"{LOGS}/curves.log",
    threads: 1
    params:
        **GRID,
        **BUDGET,
        learned=LEARNED,
        parameters=parameters_of(run for run in PLAN.navigation if run.variant in LEARNED),
        sources=sources("curves"),
    script:
        "../scripts/curves.py"


rule final_scores:
    input:
        scores=JUDGED,
    output:
        **figure_outputs(*FINAL_SCORES),
    log:
        f"{LOGS}/final_scores.log",
    threads: 1
    params:
        **GRID,
        **BUDGET,
        method=METHOD,
        **SAFE,
        sources=sources("final_scores"),
    script:
        "../scripts/final_scores.py"


# Made on demand (docs/tuning.md): the learned parameters against what moved them.
rule certificate_paths:
    input:
        progress=rules.aggregate.output.progress,
    output:
        **figure_outputs("certificate_paths"),
    log:
        f"{LOGS}/certificate_paths.log",
    threads: 1
    params:
        **BUDGET,
        task=GRID["tasks"][0] if GRID["tasks"] else "",
        algorithms={
            run.variant: {**run.config["algorithm"], "steps": run.config["steps"]}
            for run in PLAN.navigation
            if run.variant in LEARNED and run.task == CONFIG.tasks[0]
        },
        groups={
            members[0]: members
            for role in ("method", "ablation")
            if (members := [label for label in PLAN.grid.of(role) if label in LEARNED])
        },
        parameters=parameters_of(run for run in PLAN.navigation if run.variant in LEARNED),
        sources=sources("certificate_paths"),
    script:
        "../scripts/certificate_paths.py"


# What drawings need of the trained policies. policy.npz is optional in a record and hence no input:
# which ones are missing is written down beside the figures that lack them.
rule rollouts:
    input:
        lambda wildcards: record_files(
            run for run in FIRST_RUNS.values() if run.task == wildcards.task
        ),
    output:
        f"{SUMMARY}/rollouts/{{task}}.npz",
    log:
        f"{LOGS}/rollouts/{{task}}.log",
    wildcard_constraints:
        task=one_of(ROBOT_TASKS),
    threads: 1
    params:
        root=RESULTS,
        folders=lambda wildcards: {
            variant: FIRST_RUNS[wildcards.task, variant].path.as_posix()
            for variant in LEARNED
            if (wildcards.task, variant) in FIRST_RUNS
        },
        layouts=[CONFIG.evaluation.seed + index for index in range(4)],
        steps=lambda wildcards: min(400, PLAN.tasks[wildcards.task].traits.episode_steps),
        lacking=lambda wildcards: without_policy(
            run for run in FIRST_RUNS.values() if run.task == wildcards.task
        ),
        sources=sources("rollouts"),
    script:
        "../scripts/rollouts.py"


rule policies:
    input:
        expand(rules.rollouts.output[0], task=ROBOT_TASKS),
    output:
        **figure_outputs("multiplier_maps", *(f"trajectories/{task}" for task in ROBOT_TASKS)),
        animation=report(
            f"{FIGURES}/rollout.gif", caption="../report/rollout.rst", category="Figures"
        ),
        missing=f"{SUMMARY}/missing_policies.csv",
    log:
        f"{LOGS}/policies.log",
    threads: 1
    params:
        tasks=ROBOT_TASKS,
        variants=LEARNED,
        method=METHOD,
        steps=300,
        sources=sources("policies"),
    script:
        "../scripts/policies.py"


# The picture of the README, where the policies have flown unseen layouts.
FLOWN_TASKS = [task for task in CONFIG.tasks if task in FLOWN]
UNSEEN = dict(method=METHOD, baselines=PLAN.grid.rivals, **SAFE)


rule finding:
    input:
        expand(rules.unseen_layouts.output[0], task=FLOWN_TASKS),
    output:
        **figure_outputs("finding"),
    log:
        f"{LOGS}/finding.log",
    threads: 1
    params:
        **UNSEEN,
        tasks=FLOWN_TASKS,
        variants=GRID["variants"],
        seeds=BUDGET["seeds"],
        episodes=CONFIG.unseen_layouts and CONFIG.unseen_layouts.episodes,
        own=CONFIG.unseen_layouts and CONFIG.unseen_layouts.own,
        sources=sources("finding"),
    script:
        "../scripts/finding.py"


# The method beside an algorithm that violates, on the task whose certificates are pictured.
BESIDE = {
    run.variant: run
    for run in reversed(PLAN.navigation)
    if run.task == PICTURED and run.path in RECORDED_PATHS
}


rule side_by_side:
    input:
        record_files(BESIDE.values()),
        flown=f"{SUMMARY}/unseen_layouts/{PICTURED}.csv",
    output:
        report(
            f"{FIGURES}/side_by_side.gif",
            caption="../report/side_by_side.rst",
            category="Figures",
        ),
    log:
        f"{LOGS}/side_by_side.log",
    threads: 1
    params:
        **UNSEEN,
        root=RESULTS,
        folders={variant: run.path.as_posix() for variant, run in BESIDE.items()},
        layouts=[CONFIG.unseen_layouts.seed + index for index in range(12)]
        if CONFIG.unseen_layouts
        else [],
        steps=500,
        lacking=without_policy(BESIDE.values()),
        sources=sources("side_by_side"),
    script:
        "../scripts/side_by_side.py"


TARGETS += [*rules.table_1.output, *rules.curves.output, *rules.final_scores.output]
if ILLUSTRATIONS:
    TARGETS += [*rules.illustrations.output]
if LEARNED and ROBOT_TASKS:
    TARGETS += [*rules.policies.output]
if CONFIG.unseen_layouts and FLOWN_TASKS:
    TARGETS += [*rules.finding.output]
if CONFIG.unseen_layouts and METHOD in BESIDE and PICTURED in FLOWN:
    TARGETS += [*rules.side_by_side.output]
