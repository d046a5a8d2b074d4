"""Results of runs: signals, figures, errors, failures and files."""
