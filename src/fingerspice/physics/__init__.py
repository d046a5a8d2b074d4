"""Physics of the sliding fingertip; knows no software: no netlist, no integrator."""
