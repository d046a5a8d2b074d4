"""From a circuit to its solution in time."""
