"""Fits of circuits, contacts and materials to measured data, by least squares."""
