"""The compiled coupled model: the one place where a stack's matrices, a contact's curve and a stepper meet.

Compiled code cannot be cached across processes when its right-hand side is handed in as a function, so the
stepping loop lives beside the model and takes everything else as numbers.
"""
