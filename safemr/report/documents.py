"""Tables inside documents: `safemr documents FILE...` puts in what the pipeline made.

Between the lines ``<!-- table: PATH -->`` and ``<!-- end of table -->`` of a document stands the
content of PATH, relative to the document. With ``--check`` nothing is written; the exit status says
whether anything would change.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from safemr import files
from safemr.errors import UserError

_TABLE = re.compile(r"(?ms)^<!-- table: (?P<path>\S+) -->\n.*?^<!-- end of table -->$")


def with_tables(document: Path) -> str:
    """The document's text with every table as it now is.

    Raises:
        UserError: the document, or a table that it names, is missing.
    """

    def fresh(match: re.Match[str]) -> str:
        path = match["path"]
        table = _read(document.parent / path, f"named in {document}; make it with `make.py all`")
        return f"<!-- table: {path} -->\n{table.strip()}\n<!-- end of table -->"

    return _TABLE.sub(fresh, _read(document, "no such document"))


def main(arguments: Sequence[str] | None = None) -> int:
    """`safemr documents [--check] FILE...`."""
    parser = argparse.ArgumentParser(prog="safemr documents", description=__doc__)
    parser.add_argument("documents", nargs="+", type=Path, metavar="FILE")
    parser.add_argument("--check", action="store_true", help="write nothing, report differences")
    options = parser.parse_args(arguments)
    stale = []
    for document in options.documents:
        text = with_tables(document)
        if text != document.read_text(encoding="utf-8"):
            stale.append(str(document))
            if not options.check:
                files.write(document, text.encode())
    if stale:
        print(f"{'not current' if options.check else 'updated'}: {', '.join(stale)}")
    return 1 if stale and options.check else 0


def _read(path: Path, otherwise: str) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): {otherwise}") from error
