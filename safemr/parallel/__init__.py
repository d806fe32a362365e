"""The parallel trainer (PABAL): samplers, buffers and learners as processes of Ray.

`safemr.parallel.safemr`, `.joint_sis` and `.fac` are algorithms; `trainer` says how they work.
"""
