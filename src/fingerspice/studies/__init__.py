"""Studies, which need many runs, or equations other than those of a run."""
