"""Steps of circuits with one area and one source, series stacks."""
