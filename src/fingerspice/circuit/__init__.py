"""A circuit, its devices, and its equations."""
