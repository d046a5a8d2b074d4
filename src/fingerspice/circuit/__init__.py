"""Circuits: netlist text, devices, waveforms, state space."""
