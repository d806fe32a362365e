"""Single values of a configuration or a command line: their text, and their type."""

from __future__ import annotations

from typing import Any

import pytest

from safemr.errors import UserError
from safemr.experiment import catalogue, strict_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("[1, 2]", [1, 2]),
        ("true", True),
        ("abc", "abc"),
        ("2020-13-45", "2020-13-45"),
        ("[1", "[1"),
    ],
)
def test_values_of_a_command_line(text: str, value: Any) -> None:
    assert strict_yaml.typed(text) == value
    assert strict_yaml.assignment(f"gamma={text}") == ("gamma", value)


@pytest.mark.parametrize(
    ("value", "hint", "expected"),
    [
        (1, float, 1.0),
        (True, bool, True),
        ([1, 2], tuple[float, ...], (1.0, 2.0)),
        ([1, 2], tuple[int, int], (1, 2)),
        (None, int | None, None),
        (3, int | None, 3),
        ("elu", str, "elu"),
    ],
)
def test_coercion_keeps_types(value: Any, hint: Any, expected: Any) -> None:
    result = catalogue.coerce(value, hint, "x")
    assert result == expected
    assert type(result) is type(expected)


@pytest.mark.parametrize(
    ("value", "hint"),
    [
        (True, float),
        (True, int),
        (1.0, int),
        ("1", float),
        ([1], tuple[int, int]),
        (1, bool),
        (0, str),
    ],
)
def test_coercion_refuses_what_is_not_the_type(value: Any, hint: Any) -> None:
    with pytest.raises(UserError, match="x must be"):
        catalogue.coerce(value, hint, "x")
