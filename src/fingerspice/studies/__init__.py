"""Studies: questions that take many runs, or other equations than those of a run."""
