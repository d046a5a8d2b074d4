"""The shipped decks in ngspice 39, unchanged, against our own run of the same files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from ngspice_tools import CIRCUITS, GAP_SIGNALS, run_ngspice, with_charge_law

SHIPPED = ["fingerpad", "fingerpad_5khz", "fingerpad_square", "fingerpad_square_5khz", "fingerpad_dispersive"]


def deviation(name, law, max_step=None):
    """Largest difference of the gap voltage over its peak, at ngspice's own times, and of the area in mm^2."""
    text = with_charge_law((CIRCUITS / f"{name}.cir").read_text(), law)
    theirs = run_ngspice(text, signals=list(GAP_SIGNALS), max_step=max_step)
    circuit = fs.parse_netlist(text)
    t = np.unique(theirs["time"])
    keep = np.searchsorted(theirs["time"], t, side="right") - 1
    # Inside a 1 ns edge the last digit of the time is a visible voltage.
    edges = circuit["Vdrive"].waveform.breakpoints(0.0, circuit.tran.stop)
    near = np.zeros(t.size, bool)
    for edge in edges:
        near |= np.abs(t - edge) < 2e-9
    t, keep = t[~near], keep[~near]
    ours = fs.simulate(circuit, t_eval=np.minimum(t, circuit.tran.stop), rtol=1e-9)
    assert circuit.charge_law == ours.charge_law == law
    return (
        np.abs(ours.u_gap - theirs[GAP_SIGNALS[0]][keep]).max() / np.abs(ours.u_gap).max(),
        np.abs(1e6 * ours.area - theirs[GAP_SIGNALS[1]][keep]).max(),
    )


@pytest.mark.parametrize("law", ["local", "mobile"])
@pytest.mark.parametrize("name", ["fingerpad", "fingerpad_5khz", "fingerpad_dispersive"])
def test_sines_agree_to_1e_5_of_peak(name, law):
    du, _ = deviation(name, law)
    assert du <= 1e-5


@pytest.mark.parametrize("law", ["local", "mobile"])
@pytest.mark.parametrize("name", ["fingerpad_square", "fingerpad_square_5khz"])
def test_squares_agree_within_what_the_step_allows(name, law):
    # netlist.md: T/1000 gives 1e-6 on sines to 1e-4 on squares.
    du, _ = deviation(name, law)
    assert du <= 1e-4


@pytest.mark.parametrize("law", ["local", "mobile"])
def test_agreement_improves_as_the_square_of_the_step(law):
    coarse, _ = deviation("fingerpad", law, max_step=1e-4)
    fine, area = deviation("fingerpad", law, max_step=1e-6)
    assert coarse > 1e-5
    assert fine <= 1e-7
    assert area <= 2e-3


def test_every_shipped_deck_is_read_without_a_warning():
    decks = sorted(Path(CIRCUITS).glob("*.cir"))
    assert {d.stem for d in decks} == set(SHIPPED)
    for path in decks:
        assert fs.read_netlist(path).warnings == ()
