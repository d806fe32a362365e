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
