# One page with all of it. It comes last: it shows what the rules above have made.
from types import SimpleNamespace

from jinja2 import Environment, StrictUndefined
from snakemake.io import is_flagged

SHOWN = {
    end: [str(path) for path in TARGETS if str(path).endswith(end)]
    for end in (".md", ".png", ".gif")
}


def described(text, params=None):
    """A caption of workflow/report with the parameters of its rule, as Snakemake's report has it."""
    template = Environment(undefined=StrictUndefined).from_string(text)
    return template.render(snakemake=SimpleNamespace(params=params))


def captions():
    """File -> caption, of all that rules mark for the report and the page shows."""
    shown = {path for paths in SHOWN.values() for path in paths}
    return {
        str(path): described(
            workflow.sourcecache.open(path.flags["report"].caption).read(), rule.params
        )
        for rule in workflow.rules
        for path in rule.output
        if str(path) in shown and is_flagged(path, "report")
    }


rule page:
    input:
        tables=SHOWN[".md"],
        # Claims are joined with the names that are in the CSV.
        claims=rules.claims.output.table[0],
        pictures=[*SHOWN[".png"], *SHOWN[".gif"]],
        runs=rules.aggregate.output.runs,
    output:
        f"{RESULTS}/report.html",
    log:
        f"{LOGS}/page.log",
    threads: 1
    params:
        figures_root=FIGURES,
        captions=captions(),
        lead=described(
            workflow.sourcecache.open(
                workflow.current_basedir.join("../report/workflow.rst")
            ).read()
        ),
        expected=len(PLAN.runs),
        points=rules.claims.params.points,
        sources=sources("page"),
    message:
        "Writing the page of results"
    script:
        "../scripts/page.py"


TARGETS += [*rules.page.output]
