"""PID-Lagrangian for `safemr`, as a package of its own."""
