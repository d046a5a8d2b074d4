"""Numerical methods; knows no physics."""
