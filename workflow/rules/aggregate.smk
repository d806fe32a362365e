# Records -> tidy tables. Every record is verified; one that cannot be believed stops the rule.
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
    message:
        "Verifying and aggregating the records of %d runs" % len(RECORDED)
    script:
        "../scripts/aggregate.py"


TARGETS += [rules.aggregate.output.runs, rules.aggregate.output.scores]
