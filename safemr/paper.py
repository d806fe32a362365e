"""What the paper prints, as data: the numbers that ours stand beside.

Source: Zheng, Ma, Zheng, Li, Wang, "Synthesize Efficient Safety Certificates for Learning-Based
Safe Control using Magnitude Regularization". Names in capitals quote its tables; percentages are
kept as printed, errors included, and recomputed where they are used.

Labels here are the paper's own names, and its claims (`safemr.report.claims`) are about the
variants of these names. What else asks for the method, its ablation or the baselines of a
configuration goes by their roles (`safemr.experiment.roles`); these names are what it falls back
on.
"""

from __future__ import annotations

from typing import NamedTuple

TASKS = ("Pillars-0.15-Goal", "Pillars-0.30-Goal", "Hazards-0.15-Push", "Hazards-0.30-Push")

METHOD = "SafeMR"
ABLATION = "JointSIS"  # the method without its regularizer
CMDP_BASELINES = ("PPO-L", "TRPO-L", "CPO")
BASELINES = (ABLATION, *CMDP_BASELINES, "FAC-phi0", "FAC-phih")
ALGORITHMS = (METHOD, *BASELINES)


class Zeta(NamedTuple):
    """Parameters of the energy function (Eq. sis)."""

    sigma: float
    k: float
    n: float


class PaperReturn(NamedTuple):
    """One column of Table I."""

    safemr: float
    best_safe: float
    printed_improvement: float  # per cent, as printed

    @property
    def improvement(self) -> float:
        """Per cent, recomputed from the two returns of the same column."""
        return 100 * (self.safemr / self.best_safe - 1)


# Table I, "Efficiency Improvement of SafeMR compared to all safe baselines". The first percentage
# disagrees with its own column: 10.034 against 9.286 is 8.1%.
TABLE_I = dict(
    zip(
        TASKS,
        (
            PaperReturn(10.034, 9.286, 10.2),
            PaperReturn(8.802, 6.921, 27.2),
            PaperReturn(1.639, 1.020, 60.7),
            PaperReturn(1.203, 0.871, 38.1),
        ),
        strict=True,
    )
)

# Table II, "Learned energy function parameters with different [a, b]" (Pillars-0.15-Goal).
AIRCRAFT_TASK = "Aircraft"
SENSITIVITY_TASK = "Pillars-0.15-Goal"
HEADLINE = (0.35, 0.15)  # which [a, b] Table I uses is not said; this is the first row of Table II
TABLE_II = {
    (0.35, 0.15): Zeta(0.201, 0.835, 2.084),
    (0.45, 0.15): Zeta(0.185, 0.753, 2.194),
    (0.35, 0.25): Zeta(0.223, 0.882, 1.984),
}

# Section "Baseline Algorithms": phi_0 = d_min - d and phi_h = (0.3 + d_min)^2 - d^2 - k d_dot. The
# paper does not give the k of phi_h; 1 is used here throughout.
PHI_0 = Zeta(0.0, 0.0, 1.0)
PHI_H = Zeta(0.3, 1.0, 2.0)
