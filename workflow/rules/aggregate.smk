# Records -> tidy tables. Every record is verified; one that cannot be believed stops the rule.

# What tables and figures are made of: everything, or with allow_missing what is there already.
RECORDED = [
    run
    for run in PLAN.runs
    if not CONFIG.allow_missing or os.path.exists(f"{RESULTS}/{run.path}/provenance.json")
]
RECORDED_PATHS = {run.path for run in RECORDED}  # looked up for each run by every job of a cluster
if not RECORDED:
    sys.exit("error: allow_missing is set, but none of the configured runs is recorded yet")


rule aggregate:
    input:
        record_files(RECORDED),
    output:
        runs=f"{SUMMARY}/runs.csv",
        progress=f"{SUMMARY}/progress.csv.gz",
        scores=f"{SUMMARY}/scores.csv",
    log:
        f"{LOGS}/aggregate.log",
    threads: 1
    params:
        root=RESULTS,
        folders=[run.path.as_posix() for run in RECORDED],
        sources=sources("aggregate"),
    message:
        "Verifying and aggregating the records of %d runs" % len(RECORDED)
    script:
        "../scripts/aggregate.py"


TARGETS += [rules.aggregate.output.runs, rules.aggregate.output.scores]
