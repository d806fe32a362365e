"""What an algorithm's ``Config`` says about its fields, in one form for all algorithms.

A ``Config`` derives from `Hyperparameters`; it and its mixins may declare, as class variables,

- ``RANGES``: field -> the interval that its value must lie in, as text: ``"(0, 1]"``. The ends
  exclude what can only end in absurd numbers or in a run that learns nothing;
- ``CHOICES``: field -> the values that it may have;
- ``UNUSED``: field that is inherited and changes nothing here -> why. It keeps its default, so that
  the resolved hyperparameters and with them the digests of records stay as they are, and setting
  it is refused (`safemr.experiment.catalogue.hyperparameters`);
- ``ADDED``: fields that came after runs had been recorded, whose default is what those runs did.
  Resolved hyperparameters say such a field only where it differs (`resolved`), so that the digests
  of records stay as they are. The default of such a field must never change.

What a class declares replaces what its parents say of the same field. The meaning of a field is the
comment behind it or, where there is none, the comment lines directly above it (`meanings`).
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import io
import textwrap
import tokenize
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

from safemr.errors import UserError


class Setting(NamedTuple):
    """What hyperparameters are set for: a task and a budget."""

    action_dim: int
    episode_steps: int  # time limit of an episode
    total_steps: int  # control steps of the run
    action_repeat: int = 1  # control steps of a decision

    @property
    def episode_decisions(self) -> int:
        """The most decisions of an episode."""
        return -(-self.episode_steps // self.action_repeat)


@dataclasses.dataclass(frozen=True)
class Hyperparameters:
    """Base of the algorithms' ``Config``; see the module."""

    RANGES: ClassVar[Mapping[str, str]] = {}
    CHOICES: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    UNUSED: ClassVar[Mapping[str, str]] = {}
    ADDED: ClassVar[frozenset[str]] = frozenset()

    def __post_init__(self) -> None:
        for name, interval in declared(type(self), "RANGES").items():
            self.require(name, within(getattr(self, name), interval), f"must lie in {interval}")
        for name, choices in declared(type(self), "CHOICES").items():
            self.require(name, getattr(self, name) in choices, f"use one of {choices}")
        defaults = {field.name: field.default for field in dataclasses.fields(self)}
        for name, reason in unused(type(self)).items():
            self.require(name, getattr(self, name) == defaults[name], f"not used: {reason}")

    def check_setting(self, setting: Setting) -> None:
        """Refuse what cannot work on a task with a budget, although each value is a valid one.

        Raises:
            UserError: it names the hyperparameter and what it may be.
        """

    def require(self, name: str, holds: bool, remedy: str) -> None:
        """Raise UserError about the field ``name`` unless ``holds``."""
        if not holds:
            raise UserError(f"{name} = {getattr(self, name)!r}: {remedy}")


def declared(config: type[Any], what: str) -> dict[str, Any]:
    """One of the class variables of `Hyperparameters`, collected over a class and its parents."""
    collected: dict[str, Any] = {}
    for part in reversed(config.__mro__):
        collected |= vars(part).get(what, {})
    return collected


def unused(config: type[Any]) -> dict[str, str]:
    """Fields that an algorithm inherits and does not use -> why; empty for any other class."""
    return declared(config, "UNUSED")


def resolved(config: Any) -> dict[str, Any]:
    """The fields of an algorithm's ``Config`` as a record says them."""
    values = dataclasses.asdict(config)
    added: set[str] = set()
    for part in type(config).__mro__:
        added |= vars(part).get("ADDED", frozenset())
    for field in dataclasses.fields(config):
        if field.name in added and values[field.name] == field.default:
            del values[field.name]
    return values


def within(value: float, interval: str) -> bool:
    """Whether a number lies in an interval such as ``"(0, 1]"`` or ``"[0, inf)"``."""
    low, high = map(float, interval[1:-1].split(","))
    above = value >= low if interval[0] == "[" else value > low
    return above and (value <= high if interval[-1] == "]" else value < high)


def meanings(config: type[Any]) -> dict[str, str]:
    """Field -> its meaning, from the comments in the source; empty text where there is none."""
    found: dict[str, str] = {}
    for part in reversed(config.__mro__):
        if dataclasses.is_dataclass(part):
            found |= _comments(part)
    return {field.name: found.get(field.name, "") for field in dataclasses.fields(config)}


def _comments(part: type[Any]) -> dict[str, str]:
    """The comments beside the fields that one class defines."""
    source = textwrap.dedent(inspect.getsource(part))
    body = ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    comments: dict[int, tuple[str, bool]] = {}  # line -> text, whether it stands alone
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            alone = not token.line[: token.start[1]].strip()
            comments[token.start[0]] = (token.string.lstrip("# "), alone)
    result = {}
    for node in body.body:
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        line = node.end_lineno or node.lineno
        lines = [comments[line][0]] if line in comments else []
        if not lines:
            above = node.lineno - 1
            while above in comments and comments[above][1]:
                lines.insert(0, comments[above][0])
                above -= 1
        result[node.target.id] = " ".join(lines)
    return result
