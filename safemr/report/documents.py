"""Tables inside documents: `safemr documents FILE...` puts in what the pipeline made.

Between the lines ``<!-- table: PATH -->`` and ``<!-- end of table -->`` of a document stands the
content of PATH, relative to the document; links in it lead where they led from its own place. With
``--check`` nothing is written; the exit status says whether anything would change.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence
from pathlib import Path, PurePath

from safemr import files
from safemr.errors import UserError

_TABLE = re.compile(r"(?ms)^<!-- table: (?P<path>\S+) -->\n.*?^<!-- end of table -->$")
_LINK = re.compile(r"\]\((?P<path>(?![a-z]+:|[#/])[^)#\s]+)")


def with_tables(document: Path) -> str:
    """The document's text with every table as it now is.

    Raises:
        UserError: the document, or a table that it names, is missing.
    """

    def fresh(match: re.Match[str]) -> str:
        path = match["path"]
        source = document.parent / path
        table = _read(source, f"named in {document}; make it with `make.py all`").strip()
        table = _moved(table, source.parent, document.parent)
        return f"<!-- table: {path} -->\n{table}\n<!-- end of table -->"

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


def _moved(text: str, source: Path, target: Path) -> str:
    """Markdown whose relative links are from ``source`` as it stands in ``target``."""

    def link(match: re.Match[str]) -> str:
        moved = os.path.relpath(source / match["path"], target)
        return f"]({PurePath(moved).as_posix()}"

    return _LINK.sub(link, text)


def _read(path: Path, otherwise: str) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): {otherwise}") from error
