"""Numbers that this reproduction chose and that more than one part uses, each written once."""

# When an algorithm counts as safe on a task (`safemr.report.tables.SafetyRule`, `safe` in the
# configuration): mean violating steps an episode at most, mean share of clean episodes at least.
COST_TOLERANCE = 1.0
CLEAN_SHARE = 0.95

# A certificate covers the true unsafe set of the aircraft if it misses at most this share of its
# part outside the collision disc.
COVERS = 0.01

# First layout of the evaluations during a run, and of those layouts that no run was evaluated on.
EVALUATION_SEED = 10_000
UNSEEN_SEED = 20_000

# Runs with seeds from here on are for tuning, those below are reported. What is tuned is looked at
# on layouts of its own, so that the reported ones have decided nothing.
FIRST_TUNING_SEED = 100
TUNING_EVALUATION_SEED = 30_000
TUNING_UNSEEN_SEED = 40_000


def evaluation_seed(seed: int) -> int:
    """The first layout of the evaluations during a run with this seed."""
    return EVALUATION_SEED if seed < FIRST_TUNING_SEED else TUNING_EVALUATION_SEED


def unseen_seed(seed: int) -> int:
    """The first of the layouts on which no run with this seed was evaluated while it trained."""
    return UNSEEN_SEED if seed < FIRST_TUNING_SEED else TUNING_UNSEEN_SEED


def own_layouts(first: int, episodes: int, seed: int) -> int:
    """The first of the layouts that runs with this seed alone are flown on, ``episodes`` of them.

    first: that of seed 0. All algorithms with one seed fly the same; no two seeds share any, so
    that what a layout adds to a return or a violation is part of the spread between seeds.
    """
    return first + episodes * seed
