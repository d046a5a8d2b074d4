"""What every part stands on: refusals, units, files, compiled code."""
