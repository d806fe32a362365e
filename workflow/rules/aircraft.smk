# The aircraft experiment: its learners are runs of the one training rule. The solved truth is kept
# in <results root>/.work/aircraft, which no record needs and a clone solves again (15 s).
AIRCRAFT = [run for run in PLAN.aircraft if run in RECORDED]
AIRCRAFT_FIGURES = ["aircraft_slices", "aircraft_airplane", "aircraft_frontier"]


rule aircraft_frontier:
    output:
        f"{SUMMARY}/aircraft_frontier.csv",
    log:
        f"{LOGS}/aircraft_frontier.log",
    threads: 1
    params:
        cache=f"{RESULTS}/.work/aircraft",
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
        root=RESULTS,
        folders=[run.path.as_posix() for run in AIRCRAFT],
        expected=expected(PLAN.aircraft),
    message:
        "Comparing %d learned certificates with the true unsafe set" % len(AIRCRAFT)
    script:
        "../scripts/aircraft_comparison.py"


rule aircraft_figures:
    input:
        comparison=rules.aircraft_comparison.output.comparison,
        frontier=rules.aircraft_frontier.output[0],
    output:
        pdf=expand(f"{FIGURES}/{{name}}.pdf", name=AIRCRAFT_FIGURES),
        png=report(
            expand(f"{FIGURES}/{{name}}.png", name=AIRCRAFT_FIGURES),
            caption="../report/aircraft.rst",
            category="Figures",
        ),
    log:
        f"{LOGS}/aircraft_figures.log",
    threads: 1
    params:
        cache=f"{RESULTS}/.work/aircraft",
    script:
        "../scripts/aircraft_figures.py"


if CONFIG.aircraft:
    TARGETS += [*rules.aircraft_comparison.output, *rules.aircraft_figures.output]
