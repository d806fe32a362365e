"""The one exception that means "the user can fix this"."""

from __future__ import annotations


class UserError(Exception):
    """A single-line message that names the culprit and the remedy.

    Command-line entry points print it to standard error and exit with status 2; anything else that
    escapes is a bug and keeps its traceback.
    """
