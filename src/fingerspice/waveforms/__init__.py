"""Source voltages as functions of time."""
