# Final policies behind the safety filters of certificates: what a learned phi is good for afterwards.
FILTERS = CONFIG.filters
FILTERED = {}  # task -> label -> recorded runs
for run in PLAN.navigation if FILTERS else ():
    wanted = run.variant in (*FILTERS.policies, *FILTERS.certificates)
    if wanted and run.config["seed"] in FILTERS.seeds and run.path in RECORDED_PATHS:
        if run.task in (ROBOT_TASKS if FILTERS.tasks is None else FILTERS.tasks):
            FILTERED.setdefault(run.task, {}).setdefault(run.variant, []).append(run)


def paths_of(runs):
    """Folders of records, relative to the results root."""
    return [run.path.as_posix() for run in runs]


rule filters:
    input:
        [
            path
            for variants in FILTERED.values()
            for runs in variants.values()
            for path in record_files(runs)
        ],
    output:
        scores=f"{SUMMARY}/filters.csv",
        table=expand(f"{RESULTS}/tables/filters.{{end}}", end=["csv", "tex"]),
        markdown=report(
            f"{RESULTS}/tables/filters.md",
            caption="../report/filters.rst",
            category="Tables",
        ),
        pdf=f"{FIGURES}/filters.pdf",
        png=report(
            f"{FIGURES}/filters.png",
            caption="../report/filters.rst",
            category="Figures",
        ),
    log:
        f"{LOGS}/filters.log",
    threads: 1
    params:
        root=RESULTS,
        tasks=[
            {
                "task": entries_of([task])[0],
                "policies": [
                    path
                    for label in FILTERS.policies
                    for path in paths_of(variants.get(label, []))
                ],
                "certificates": {
                    name: paths_of(variants.get(name, [])) for name in FILTERS.certificates
                },
            }
            for task, variants in FILTERED.items()
        ],
        unlearned=[name for name in FILTERS.policies if name not in CONFIG.algorithms]
        if FILTERS
        else [],
        seeds=list(FILTERS.seeds) if FILTERS else [],
        episodes=FILTERS and FILTERS.episodes,
        seed=FILTERS and FILTERS.seed,
        lacking=without_policy(
            [run for variants in FILTERED.values() for runs in variants.values() for run in runs]
        ),
        sources=sources("filters"),
    message:
        "Flying final policies behind the filters of certificates"
    script:
        "../scripts/filters.py"


if FILTERED:
    TARGETS += [*rules.filters.output]
