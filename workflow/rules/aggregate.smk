# Records -> tidy tables. Every record is verified; one that cannot be believed stops the rule.
rule aggregate:
    input:
        record_files(PLAN.runs),
    output:
        runs=f"{SUMMARY}/runs.csv",
        progress=f"{SUMMARY}/progress.csv.gz",
        scores=f"{SUMMARY}/scores.csv",
    log:
        f"{LOGS}/aggregate.log",
    threads: 1
    params:
        root=RESULTS,
        folders=sorted(RUNS),
    message:
        "Verifying and aggregating the records of %d runs" % len(PLAN.runs)
    script:
        "../scripts/aggregate.py"


TARGETS += [rules.aggregate.output.runs, rules.aggregate.output.scores]
