"""Grids and random populations of a circuit, in memory or in a store."""
