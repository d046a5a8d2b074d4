"""Steps of circuits with any number of areas and sources."""
