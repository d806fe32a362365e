"""YAML as configuration files are read: no key twice, 1e-3 is a number, errors in one line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from safemr.errors import UserError, show


def read_yaml(path: Path) -> dict[str, Any]:
    """The top-level mapping of a YAML file; duplicate keys are errors, 1e-3 is a number."""
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), StrictLoader)
    except OSError as error:
        raise UserError(f"cannot read the config file {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or str(error).partition("\n")[0]
        where = f"{path}, line {mark.line + 1}" if mark else f"{path}"
        raise UserError(f"{where}: {problem}") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise UserError(f"{path} must hold a mapping, not {show(content)}")
    return content


def typed(value: Any) -> Any:
    """A value of a command line: inside lists and mappings Snakemake leaves scalars as text."""
    if isinstance(value, str):
        try:
            return yaml.load(value, StrictLoader)
        except (yaml.YAMLError, ValueError, RecursionError):
            return value
    if isinstance(value, Mapping):
        return {key: typed(item) for key, item in value.items()}
    return [typed(item) for item in value] if isinstance(value, (list, tuple)) else value


def assignment(text: str) -> tuple[str, Any]:
    """Name and value of a NAME=VALUE of ``--set``."""
    name, separator, value = text.partition("=")
    if not separator or not name.strip():
        raise UserError(f"--set {text}: write NAME=VALUE")
    return name.strip(), typed(value)


class StrictLoader(yaml.SafeLoader):
    """YAML without duplicate keys, and with 1e-3 as a number (YAML 1.1 reads it as text)."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.tag != "tag:yaml.org,2002:merge" and key.value.__hash__ and key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {show(key.value)} stands twice", key.start_mark
                )
            if isinstance(key.value, str):
                seen.add(key.value)
        return super().construct_mapping(node, deep)


StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$"),
    list("-+.0123456789"),
)
