"""Recordings: their pieces in the lanes of vectors."""
