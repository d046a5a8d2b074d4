"""The explorer: a local page on which values change and the run follows."""
