"""Radau collocation, the last resort."""
