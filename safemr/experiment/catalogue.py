"""What there is to choose from: algorithms, those here and those of other packages, and their
hyperparameters.

One here is a file of `safemr.algorithms`, by its name; how one of another package is named,
`safemr.packages` says. Both keep to the same contract (`load_algorithm`).
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import importlib
import math
import pkgutil
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from safemr import packages
from safemr.certificates.certificate import FAMILIES as CERTIFICATES
from safemr.certificates.certificate import Certificate, family_named
from safemr.environments import register_tasks
from safemr.errors import UserError, show
from safemr.experiment.config import FAMILIES, Variant
from safemr.experiment.roles import BASELINE, LEARNABLE, NOTHING, OUTSIDE, ROLES, Variants
from safemr.learning.hyperparameters import resolved, unused
from safemr.names import nearest, unknown


@dataclass(frozen=True)
class Algorithm:
    """What the module of an algorithm says about itself."""

    name: str  # of a file here, or the dotted one of another package's module
    version: int
    family: str
    hyperparameters: type[Any]  # the frozen dataclass ``Config``
    trainer: type[Any]
    certificate: str | None  # the family of its energy functions, None without any
    role: str = BASELINE  # what its variants are where the configuration does not say
    learns: str = NOTHING  # of its energy function

    @property
    def package(self) -> str | None:
        """The other package that it comes from."""
        return packages.package_of(self.name) if packages.is_outside(self.name) else None

    @property
    def settable(self) -> set[str]:
        """The hyperparameters that change anything: all but the ones declared as not used."""
        names = {field.name for field in dataclasses.fields(self.hyperparameters) if field.init}
        return names - unused(self.hyperparameters).keys()


def algorithm_names() -> list[str]:
    """The modules in `safemr.algorithms`: one file is one algorithm."""
    package = importlib.import_module("safemr.algorithms")
    return sorted(module.name for module in pkgutil.iter_modules(package.__path__))


def full_name(name: str, where: str = "") -> str:
    """The name under which a record knows an algorithm. Raises UserError where there is none."""
    name = name.removeprefix(f"{packages.ALGORITHMS}.")
    if name in algorithm_names() or packages.is_outside(name):
        return name
    registered = packages.registered(packages.ALGORITHMS)
    if name in registered:
        return registered[name]
    known = [*algorithm_names(), *registered]
    error = unknown("algorithm", name, known, where)
    if nearest(name, known):
        raise error
    raise UserError(f"{error}; one of yours is named by its module, PACKAGE.MODULE")


@functools.cache
def load_algorithm(name: str, where: str = "") -> Algorithm:
    """Import an algorithm by name and check the module's contract.

    Raises:
        UserError: there is none of that name, or its module breaks the contract; naming both.
    """
    name = full_name(name, where)
    file, module = _file(name), _imported(name, where)
    for part in ("VERSION", "Config", "Trainer"):
        if not hasattr(module, part):
            raise UserError(f"{file} must define {part}")
    if type(module.VERSION) is not int or module.VERSION < 1:
        raise UserError(f"{file}: VERSION must be an integer from 1 on, not {show(module.VERSION)}")
    if not hasattr(module.Config, "__dataclass_fields__"):
        raise UserError(f"{file}: Config must be a dataclass, @dataclass(frozen=True)")
    family = getattr(module.Trainer, "family", None)
    if family not in FAMILIES:
        raise UserError(f"{file}: Trainer.family must be one of {', '.join(FAMILIES)}")
    certificate = declared_certificate(name)
    if certificate != getattr(module, "CERTIFICATE", None):
        raise UserError(f'{file}: write CERTIFICATE = "<name>", a text that can be read as it is')
    if certificate is not None:
        try:
            certificate_family(certificate)
        except UserError as error:
            raise UserError(f"{file}: {error}") from error
    optional = {"ROLE": (BASELINE, ROLES), "LEARNS": (NOTHING, LEARNABLE)}
    said = {part: getattr(module, part, default) for part, (default, _) in optional.items()}
    for part, (_, known) in optional.items():
        if said[part] not in known:
            raise UserError(f"{file}: {part} must be one of {', '.join(known)}")
    return Algorithm(
        name, module.VERSION, family, module.Config, module.Trainer, certificate, *said.values()
    )


def _file(name: str) -> str:
    """What an error calls the source of an algorithm."""
    return name if packages.is_outside(name) else f"safemr/algorithms/{name}.py"


def _imported(name: str, where: str = "") -> Any:
    """The module of an algorithm by its full name."""
    register_tasks()  # an algorithm may import from that package
    if packages.is_outside(name):
        try:
            return packages.imported(name)
        except UserError as error:
            raise UserError(f"{where}: {error}" if where else str(error)) from error
    try:
        return importlib.import_module(f"safemr.algorithms.{name}")
    except Exception as error:  # whatever is wrong in that file, its author wants to know where
        reason = str(error).partition("\n")[0]
        raise UserError(
            f"safemr/algorithms/{name}.py does not import: {type(error).__name__}: {reason}"
        ) from error


@functools.cache
def declared_certificate(name: str) -> str | None:
    """The family of an algorithm's certificates, ``CERTIFICATE = "..."`` in its file, or None.

    It is read, not imported: readers of records and a dry run need no torch for it. Raises
    UserError for an unknown algorithm.
    """
    name = full_name(name)
    outside = packages.is_outside(name)
    source = packages.origin(name if outside else f"{packages.ALGORITHMS}.{name}")
    if source is None:
        if outside:
            packages.imported(name)  # which says what is missing
        return None
    with contextlib.suppress(SyntaxError):  # importing it says more of what is wrong
        for node in ast.parse(source.read_text(encoding="utf-8")).body:
            if (
                isinstance(node, ast.Assign)
                and ast.unparse(node.targets[0]) == "CERTIFICATE"
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                return node.value.value
    return None


def certificate_family(name: str, algorithm: str = "") -> type[Certificate]:
    """The class of a family, which an algorithm that declares it makes known when imported.

    algorithm: one that declares it, where that is known; it may be another package's.
    Raises UserError for a family that there is not.
    """
    theirs = [algorithm] if packages.is_outside(algorithm) else []
    for each in (*theirs, *algorithm_names()):
        if name in CERTIFICATES:
            break
        if declared_certificate(each) == name:
            _imported(each)
    return family_named(name)


def variants_of(entries: Mapping[str, Variant], outside: Iterable[str] = ()) -> Variants:
    """Roles, and what is learned, of entries of ``algorithms``; those of `outside` come last."""
    algorithms = {label: load_algorithm(entry.algorithm) for label, entry in entries.items()}
    others = list(outside)
    return Variants(
        {label: entries[label].role or algorithm.role for label, algorithm in algorithms.items()}
        | dict.fromkeys(others, OUTSIDE),
        {label: algorithm.learns for label, algorithm in algorithms.items()}
        | dict.fromkeys(others, NOTHING),
    )


def hyperparameters(
    algorithm: Algorithm, overrides: Mapping[str, Any], where: str
) -> dict[str, Any]:
    """The complete hyperparameters of an algorithm, defaults included, types and ranges checked."""
    hints = typing.get_type_hints(algorithm.hyperparameters)
    names = algorithm.settable
    values = {}
    for name, value in overrides.items():
        if name not in names:
            raise _not_settable(name, algorithm, where)
        values[name] = coerce(value, hints[name], f"{where}: {name}")
    try:
        complete = algorithm.hyperparameters(**values)
    except (UserError, ValueError) as error:
        raise UserError(f"{where}: {error}") from error
    return resolved(complete)


def _not_settable(name: str, algorithm: Algorithm, where: str) -> UserError:
    """The error for a hyperparameter that an algorithm does not have, or has and does not use."""
    ignored = unused(algorithm.hyperparameters)
    if name in ignored:
        return UserError(
            f"{where}: {algorithm.name} does not use {name} ({ignored[name]}); leave it out"
        )
    users = []
    for other in algorithm_names():
        with contextlib.suppress(UserError):  # what another file lacks is no concern here
            if name in load_algorithm(other).settable:
                users.append(other)
    if users:
        return UserError(
            f"{where}: {algorithm.name} does not use {name}, which is a hyperparameter of "
            f"{', '.join(users)}; leave it out"
        )
    return unknown("hyperparameter", name, algorithm.settable, f"{where} ({algorithm.name})")


def coerce(value: Any, hint: Any, where: str) -> Any:
    """``value`` as the annotated type, or a UserError. Integers pass as floats, nothing else."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return value
    if origin is typing.Literal:
        if not any(value == choice and type(value) is type(choice) for choice in arguments):
            raise unknown("value", value, map(str, arguments), where)
        return value
    if origin in (typing.Union, types.UnionType):
        for option in arguments:
            try:
                return coerce(value, option, where)
            except UserError:
                continue
    elif origin in (tuple, list) and isinstance(value, (list, tuple)):
        variadic = origin is list or arguments[-1:] == (Ellipsis,)
        types_of = [arguments[0]] * len(value) if variadic else list(arguments)
        if len(types_of) == len(value):
            return origin(coerce(v, t, where) for v, t in zip(value, types_of, strict=True))
    elif hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if abs(value) < math.inf and abs(value) < 1e300:
            return float(value)
    elif (hint is None or hint is type(None)) and value is None:
        return None
    elif hint in (int, str, bool) and type(value) is hint:
        return value
    name = getattr(hint, "__name__", str(hint)) if origin is None else str(hint)
    raise UserError(f"{where} must be {name}, not {show(value)}")
