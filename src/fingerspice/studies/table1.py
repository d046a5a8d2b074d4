"""The paper's scene as netlist text, for code that runs where the folder of decks may be missing."""

from __future__ import annotations

from fingerspice.circuit.circuit import Circuit
from fingerspice.netlist.netlist import parse_netlist

TABLE1_DECK = """\
Fingerpad on a 3M-coated touchscreen, Table 1
Vdrive  drive 0          SIN(0 200 100)
Xcoat   drive top  area  LAYER d=1u eps_r=3.9 r=0.2meg
Xgap    top   skin area  GAP   d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3
+                              alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000
Xskin   skin  0    area  SKIN  d=350u f=100
.tran 10u 50m uic
.end
"""
"""Table 1 under a sine of 200 V and 100 Hz (Fig. 4, left), as in `circuits/fingerpad.cir`."""


def table1_circuit(*, dispersive: bool = False) -> Circuit:
    """The circuit of `TABLE1_DECK`; with `dispersive` its skin has its own data at every frequency."""
    text = TABLE1_DECK
    if dispersive:
        text = text.replace("SKIN  d=350u f=100", "SKIN_DISPERSIVE d=350u")
    return parse_netlist(text)
