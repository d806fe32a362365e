"""From a line of configuration to a record: plan, train, checkpoints, records, provenance."""
