# The aircraft experiment: its learners are runs of the one training rule. The solved truth is kept
# in <results root>/.work/aircraft, which no record needs and a clone solves again (15 s).
# Those with a neural energy function have a table and a figure of their own, and are made when
# aircraft.algorithms has any.
NEURAL_PLAN = [
    run for run in PLAN.aircraft if PLAN.encounter.learns[run.variant] == "network"
]
AIRCRAFT_PLAN = [run for run in PLAN.aircraft if run not in NEURAL_PLAN]
AIRCRAFT = [run for run in AIRCRAFT_PLAN if run.path in RECORDED_PATHS]
NEURAL = [run for run in NEURAL_PLAN if run.path in RECORDED_PATHS]
ENCOUNTER = dict(PLAN.aircraft[0].config["task"]) if PLAN.aircraft else paper.AIRCRAFT_TASK
AIRCRAFT_FIGURES = ["aircraft_slices", "aircraft_frontier"]


rule aircraft_frontier:
    output:
        f"{SUMMARY}/aircraft_frontier.csv",
    log:
        f"{LOGS}/aircraft_frontier.log",
    threads: 1
    params:
        root=RESULTS,
        cache=f"{RESULTS}/.work/aircraft",
        task=ENCOUNTER,
        sources=sources("aircraft_frontier"),
    message:
        "Solving the aircraft's true unsafe sets and the frontier of the energy family"
    script:
        "../scripts/aircraft_frontier.py"


rule aircraft_comparison:
    input:
        record_files(AIRCRAFT),
        frontier=rules.aircraft_frontier.output[0],
    output:
        comparison=f"{SUMMARY}/aircraft.csv",
        scores=f"{SUMMARY}/aircraft_scores.csv",
        table=expand(f"{RESULTS}/tables/aircraft.{{end}}", end=["csv", "tex"]),
        markdown=report(
            f"{RESULTS}/tables/aircraft.md", caption="../report/aircraft.rst", category="Tables"
        ),
    log:
        f"{LOGS}/aircraft_comparison.log",
    threads: 1
    params:
        cache=f"{RESULTS}/.work/aircraft",
        task=ENCOUNTER,
        root=RESULTS,
        folders=[run.path.as_posix() for run in AIRCRAFT],
        expected=expected(AIRCRAFT_PLAN),
        pair=PLAN.encounter.pair(),
        lacking=without_policy(AIRCRAFT),
        sources=sources("aircraft_comparison"),
    message:
        "Comparing %d learned certificates with the true unsafe set" % len(AIRCRAFT)
    script:
        "../scripts/aircraft_comparison.py"


rule aircraft_figures:
    input:
        comparison=rules.aircraft_comparison.output.comparison,
        frontier=rules.aircraft_frontier.output[0],
    output:
        **figure_outputs(*AIRCRAFT_FIGURES),
    log:
        f"{LOGS}/aircraft_figures.log",
    threads: 1
    params:
        root=RESULTS,
        cache=f"{RESULTS}/.work/aircraft",
        task=ENCOUNTER,
        method=PLAN.encounter.first("method", paper.METHOD),
        handcrafted=PLAN.encounter.of("handcrafted"),
        sources=sources("aircraft_figures"),
    script:
        "../scripts/aircraft_figures.py"


rule aircraft_neural:
    input:
        record_files(NEURAL),
        comparison=rules.aircraft_comparison.output.comparison,
        frontier=rules.aircraft_frontier.output[0],
    output:
        comparison=f"{SUMMARY}/aircraft_neural.csv",
        table=expand(f"{RESULTS}/tables/aircraft_neural.{{end}}", end=["csv", "tex"]),
        markdown=report(
            f"{RESULTS}/tables/aircraft_neural.md",
            caption="../report/aircraft_neural.rst",
            category="Tables",
        ),
        pdf=f"{FIGURES}/aircraft_neural.pdf",
        png=report(
            f"{FIGURES}/aircraft_neural.png",
            caption="../report/aircraft_neural.rst",
            category="Figures",
        ),
    log:
        f"{LOGS}/aircraft_neural.log",
    threads: 1
    params:
        cache=f"{RESULTS}/.work/aircraft",
        task=ENCOUNTER,
        root=RESULTS,
        folders=[run.path.as_posix() for run in NEURAL],
        expected=expected(NEURAL_PLAN),
        pair=PLAN.encounter.pair(),
        energy=[run.config["algorithm"]["hyperparameters"] for run in NEURAL_PLAN[:1]],
        lacking=without_policy(NEURAL),
        sources=sources("aircraft_neural"),
    message:
        "Comparing %d neural certificates with the true unsafe set" % len(NEURAL)
    script:
        "../scripts/aircraft_neural.py"


if CONFIG.aircraft:
    TARGETS += [*rules.aircraft_comparison.output, *rules.aircraft_figures.output]
if NEURAL_PLAN:
    TARGETS += [*rules.aircraft_neural.output]
