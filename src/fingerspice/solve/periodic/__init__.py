"""Periodic states."""
