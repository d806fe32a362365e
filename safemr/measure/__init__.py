"""What is measured on finished records, and kept: checks, flights, trajectories, controllers."""
