"""The aircraft experiment: the true unsafe set, and what learners claim of it."""
