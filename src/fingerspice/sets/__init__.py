"""Named sets of parameters, each value with its unit, range and source, and what to cite for a run."""
