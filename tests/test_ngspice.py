"""The shipped decks, unchanged, in ngspice 39 against this package's runs of the same files."""

from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from ngspice_tools import CIRCUITS, GAP_SIGNALS, run_ngspice, with_charge_law
from scenes import LAWS, cases, every_law, shipped

STACKS = ["fingerpad", "fingerpad_5khz", "fingerpad_square", "fingerpad_square_5khz", "fingerpad_dispersive"]
ONE_GAP = ["ungrounded_user", "amplifier", "screen_protector", "current_drive", "am_carrier", "click", "learned_drive"]
# Sources that ngspice lacks: tests/test_export.py runs what is exported.
NOT_THERE = ["texture_recording", "chirp", "burst"]
SHIPPED = [*STACKS, *ONE_GAP, "two_fingers", "am_bump", *NOT_THERE]


def deviation(name, law, max_step=None, edit=lambda text: text, after=0.0):
    """Largest difference of the gap voltage over its peak, at ngspice's own times, and of the area in mm^2.

    From `after` (s) on: ngspice's first steps do not become shorter with its largest one.
    """
    text = edit(with_charge_law((CIRCUITS / f"{name}.cir").read_text(), law))
    theirs = run_ngspice(text, signals=list(GAP_SIGNALS), max_step=max_step)
    circuit = fs.parse_netlist(text)
    t = np.unique(theirs["time"])
    keep = np.searchsorted(theirs["time"], t, side="right") - 1
    # Inside a 1 ns edge the last digit of the time is a visible voltage.
    sources = [e.waveform for e in circuit.by_device("V", "I")]
    edges = np.concatenate([wave.breakpoints(1e-12, circuit.tran.stop) for wave in sources])
    near = t < after
    for edge in edges:
        near |= np.abs(t - edge) < 2e-9
    t, keep = t[~near], keep[~near]
    ours = fs.simulate(circuit, t_eval=np.minimum(t, circuit.tran.stop), rtol=1e-9)
    assert circuit.charge_law == ours.charge_law == law
    return (
        np.abs(ours.u_gap - theirs[GAP_SIGNALS[0]][keep]).max() / np.abs(ours.u_gap).max(),
        np.abs(1e6 * ours.area - theirs[GAP_SIGNALS[1]][keep]).max(),
    )


@every_law
@pytest.mark.parametrize("name", STACKS)
def test_sines_agree_to_1e_5_of_peak_and_squares_within_what_the_step_allows(name, law):
    # netlist.md: T/1000 gives 1e-6 on sines to 1e-4 on squares.
    du, _ = deviation(name, law)
    assert du <= (1e-4 if "square" in name else 1e-5)


@every_law
def test_agreement_improves_as_the_square_of_the_step(law):
    coarse, _ = deviation("fingerpad", law, max_step=1e-4)
    fine, area = deviation("fingerpad", law, max_step=1e-6)
    assert coarse > 1e-5
    assert fine <= 1e-7
    assert area <= 2e-3


# The charge laws in turn, and under stress both for each circuit.
IN_TURN = [(name, law) for i, name in enumerate(ONE_GAP) for law in LAWS[:: (-1) ** i][: cases(2, 1)]]


@pytest.mark.parametrize(("name", "law"), IN_TURN)
def test_other_circuits_agree_with_their_error_falling_as_the_square_of_the_step(name, law):
    step = shipped(name).tran.step
    coarse, _ = deviation(name, law, after=2e-6)
    fine, area = deviation(name, law, max_step=step / 4.0, after=2e-6)
    assert coarse <= 1e-4
    assert fine <= max(coarse / 10.0, 5e-6)
    assert area <= 4e-2


@every_law
def test_two_fingers_agree(law):
    text = with_charge_law((CIRCUITS / "two_fingers.cir").read_text(), law)
    nodes = ["v(xfirm.top)-v(xfirm.skin)", "v(xlight.top)-v(xlight.skin)", "v(firm)", "v(light)"]
    theirs = run_ngspice(text, signals=nodes, max_step=1e-7)
    circuit = fs.parse_netlist(text)
    t, keep = np.unique(np.minimum(theirs["time"], circuit.tran.stop), return_index=True)
    # ngspice's first steps are of first order, and the body takes its charge within 0.1 us.
    t, keep = t[t > 2e-6], keep[t > 2e-6]
    ours = fs.simulate(circuit, t_eval=t, rtol=1e-8)
    for i in range(2):
        assert np.abs(ours.u_gap[:, i] - theirs[nodes[i]][keep]).max() <= 1e-5 * np.abs(ours.u_gap[:, i]).max()
        assert np.abs(1e6 * ours.area[:, i] - theirs[nodes[2 + i]][keep]).max() <= 5e-3


@every_law
def test_contact_kinetics_agree(law):
    def slow(text):
        return text.replace("c2=5000", "c2=5000 tau=2m").replace(".nodeset", ".ic")

    du, area = deviation("fingerpad", law, edit=slow)
    assert du <= 1e-5
    assert area <= 5e-3


def test_every_shipped_deck_is_read_without_a_warning():
    decks = sorted(Path(CIRCUITS).glob("*.cir"))
    assert {d.stem for d in decks} == set(SHIPPED)
    for path in decks:
        assert fs.read_netlist(path).warnings == ()
