"""Solution of a circuit in time: choice of the model, integrators, periodic states, streams."""
