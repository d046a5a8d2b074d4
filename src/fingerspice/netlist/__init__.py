"""From text to a circuit."""
