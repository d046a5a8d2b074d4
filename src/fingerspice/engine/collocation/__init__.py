"""Exponential collocation: the loop of steps, their control, what is read from them."""
