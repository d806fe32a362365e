"""Values of a configuration, checked one by one: type, range, spelling; one line for a fault.

Every function takes the value and ``where`` it stands, for the message, and returns it in its
type. All of them raise UserError, naming ``where``, the value and what it may be.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from safemr.errors import UserError, show
from safemr.names import unknown

LARGEST_SEED = 2**31 - 1
LARGEST_COUNT = 10**10
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,59}")


class Section:
    """A mapping with a fixed set of keys."""

    def __init__(self, value: Any, where: str, known: Collection[str]) -> None:
        self.where = where
        self.value = mapping(value, where)
        for key in self.value:
            if key not in known:
                raise unknown("key", key, known, where)

    def required(self, key: str) -> Any:
        if key not in self.value:
            raise UserError(f"{self.where} lacks {key!r}")
        return self.value[key]

    def get(self, key: str, default: Any = None) -> Any:
        return self.value.get(key, default)


def mapping(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise UserError(f"{where} must be a mapping, not {show(value)}")
    for key in value:
        if not isinstance(key, str):
            raise UserError(f"{where}: the key {show(key)} must be text; put it in quotes")
    return value


def labelled(value: Any, where: str) -> list[tuple[str, Any]]:
    items = [
        (checked_name(key, f"a name in {where}"), item)
        for key, item in mapping(value, where).items()
    ]
    distinct([key.lower() for key, _ in items], where)
    return items


def listed(value: Any, where: str) -> list[Any]:
    if not isinstance(value, (list, tuple)):
        raise UserError(f"{where} must be a list, not {show(value)}")
    if not value:
        raise UserError(f"{where} is empty")
    return list(value)


def distinct(items: Sequence[Any], where: str) -> None:
    for index, item in enumerate(items):
        if item in items[:index]:
            raise UserError(f"{where} names {show(item)} twice")


def checked_name(value: Any, where: str) -> str:
    """A name as folders, figures and rules can hold it."""
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise UserError(
            f"{where} must consist of letters, digits and . _ + - (60 at most, not beginning with "
            f"a sign), not {show(value)}"
        )
    return value


def integer(value: Any, where: str, low: int, high: int = LARGEST_COUNT) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise UserError(f"{where} must be an integer, not {show(value)}")
    if not low <= value <= high:
        raise UserError(f"{where} = {show(value)} must lie in [{low}, {high}]")
    return value


def flag(value: Any, where: str) -> bool:
    if not isinstance(value, bool):
        raise UserError(f"{where} must be true or false, not {show(value)}")
    return value


def number(value: Any, where: str, low: float = -math.inf, high: float = math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UserError(f"{where} must be a number, not {show(value)}")
    if not low <= value <= high or not abs(value) < 1e300:
        raise UserError(f"{where} = {show(value)} must be finite and lie in [{low:g}, {high:g}]")
    return float(value)


def seeds_in(value: Any, where: str) -> tuple[int, ...]:
    items = listed(value, where)
    seeds = tuple(integer(item, f"each of {where}", 0, LARGEST_SEED) for item in items)
    distinct(seeds, where)
    return seeds


def told(seeds: Iterable[int]) -> str:
    """For a reader, in their order: ``0 to 4``, or ``0, 1, 3``."""
    numbers = sorted(seeds)
    if len(numbers) > 2 and numbers[-1] - numbers[0] == len(numbers) - 1:
        return f"{numbers[0]} to {numbers[-1]}"
    return ", ".join(map(str, numbers))
