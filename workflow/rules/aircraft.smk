# The aircraft experiment: its learners are runs of the one training rule.
if CONFIG.aircraft:
    TARGETS += record_files(PLAN.aircraft)
