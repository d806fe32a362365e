"""Names that a person writes: what somebody who wrote one that does not exist may have meant."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection, Iterable
from typing import Any

from safemr.errors import UserError, show


def unknown(kind: str, name: Any, known: Iterable[str], where: str = "") -> UserError:
    """The error for a name that does not exist, with the nearest ones that do."""
    names = sorted(known)
    listing = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    close = " or ".join(map(repr, nearest(str(name), names)))
    remedy = f"did you mean {close}?" if close else f"there is {listing or 'none'}"
    return UserError(f"unknown {kind} {show(name)}{' in ' + where if where else ''}; {remedy}")


def nearest(name: str, names: Collection[str]) -> list[str]:
    """The names, three at most, that somebody who wrote ``name`` is likely to have meant.

    Abbreviations, parts and other spellings of a name (ppo, PPO-L, jointsis) come before names
    that only look alike: by edit distance ppo is nearest to cpo.
    """

    def plain(text: str) -> str:
        return re.sub(r"[^a-z0-9]", "", text.lower())

    written = plain(name)
    tests: tuple[Callable[[str], bool], ...] = (
        lambda other: other == written,
        lambda other: len(written) >= 2 and other.startswith(written),
        lambda other: len(other) >= 3 and written.startswith(other),
        lambda other: len(written) >= 2 and written in other,
    )
    for test in tests:
        found = [other for other in names if written and test(plain(other))]
        if 1 <= len(found) <= 3:
            return found
    return difflib.get_close_matches(name, names, n=1, cutoff=0.5)
