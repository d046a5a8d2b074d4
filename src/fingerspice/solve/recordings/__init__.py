"""Runs under recordings."""
