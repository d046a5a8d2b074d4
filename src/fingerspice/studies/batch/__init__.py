"""Many scenes of one circuit at once: `batch.batch` is the door."""
