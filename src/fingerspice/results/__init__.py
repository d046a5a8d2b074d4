"""Results of runs: signals, figures, stated errors, failures and files."""
