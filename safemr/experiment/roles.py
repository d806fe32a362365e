"""What a variant is in a comparison, whatever its label says.

Its *role* is what tables and figures compare it as: that of its algorithm (``ROLE`` in the module),
or what the entry in the configuration says. What it *learns* of its energy function is a fact of
the algorithm (``LEARNS`` in the module) that no entry changes.
Neither is a hyperparameter, so neither is part of a record's digest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

METHOD = "method"  # under test, or a form of it; the first one of a grid is the one of Table I
ABLATION = "ablation"  # the method without its regularizer
BASELINE = "baseline"
HANDCRAFTED = "handcrafted"  # a baseline with a fixed energy function
OUTSIDE = "outside"  # an implementation outside `safemr`, an entry of `outside`

ROLES = (METHOD, ABLATION, BASELINE, HANDCRAFTED)  # that an algorithm or an entry may have

ZETA = "zeta"  # sigma, k and n are learned, and they are all of the energy function
NETWORK = "network"  # a network is learned beside a fixed zeta
NOTHING = "nothing"
LEARNABLE = (ZETA, NETWORK, NOTHING)


@dataclass(frozen=True)
class Variants:
    """The variants of one part of a configuration: label -> role, and label -> what it learns."""

    roles: Mapping[str, str]
    learns: Mapping[str, str]

    def of(self, *roles: str) -> list[str]:
        """The labels with one of these roles, in the order of the configuration."""
        return [label for label, role in self.roles.items() if role in roles]

    @property
    def learned(self) -> list[str]:
        """The labels whose certificate is a learned zeta."""
        return [label for label in self.roles if self.learns.get(label) == ZETA]

    @property
    def rivals(self) -> list[str]:
        """The labels that the method is compared with: all that are no form of it."""
        return [label for label, role in self.roles.items() if role != METHOD]

    def first(self, role: str, otherwise: str) -> str:
        """The first label with a role, which is the one that a comparison of two takes."""
        return next(iter(self.of(role)), otherwise)

    def pair(self) -> list[str]:
        """The first method and the first ablation whose zeta is learned, as far as there are."""
        found = ([v for v in self.of(role) if v in self.learned] for role in (METHOD, ABLATION))
        return [label for labels in found for label in labels[:1]]
