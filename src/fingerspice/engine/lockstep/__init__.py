"""Batches: scenes in the lanes of vectors."""
