"""Every shipped deck and fifty random ones, exported and run in ngspice 39, give the same node voltages as here."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from ngspice_tools import CIRCUITS, run_ngspice
from random_decks import NETWORKS, SOURCES, deck

SEEDS = range(50)
DECKS = sorted(Path(CIRCUITS).glob("*.cir"))
# Exported as a hundred thousand points and more, among which ngspice searches at every step: their beginnings, s.
BEGINNINGS = {"burst": 4e-3, "chirp": 15e-3}
JUMPS = ("jump", "pwl", "repeat", "square", "pulse")


def deviation(circuit: fs.Circuit) -> float:
    """Largest difference of a node's voltage over the largest of all, and of an area over 35 mm^2, at ngspice's times.

    Beside the edges, which take up to 1 ns there.
    """
    assert circuit.tran is not None
    layers = [e for e in circuit.elements if e.spec.is_layer]
    signals = {e.node_names[2]: "area" for e in layers}
    for element in circuit.elements:
        for node, name in zip(element.nodes[:2], element.node_names[:2], strict=True):
            if node != "0" and name not in signals:
                signals[name] = "voltage"
    shown = {name: f"v({name.replace('.', '_')})" for name in signals}
    theirs = run_ngspice(fs.export_netlist(circuit), signals=list(shown.values()), timeout=60.0)
    t, first = np.unique(np.minimum(theirs["time"], circuit.tran.stop), return_index=True)
    waves = [e.waveform for e in circuit.by_device("V", "I") if e.waveform is not None]
    edges = np.concatenate([np.zeros(1), *(wave.breakpoints(0.0, t[-1]) for wave in waves)])
    away = np.abs(t[:, None] - edges[None, :]).min(axis=1) > 3e-9
    assert away.sum() > 900
    ours = fs.simulate(circuit, t_eval=t[away], rtol=1e-8)
    voltages = {name.lower(): v for name, v in ours.node_voltages.items()}
    peak = max(np.abs(v).max() for v in voltages.values())
    off = {
        name: np.abs(voltages[name.lower()] - theirs[shown[name]][first][away]).max() / peak
        for name, kind in signals.items()
        if kind == "voltage"
    }
    for gap, area in zip(circuit.by_device("GAP"), np.atleast_2d(np.transpose(ours.area)), strict=False):
        name = gap.node_names[2]
        off[name] = np.abs(1e6 * area - theirs[shown[name]][first][away]).max() / 35.0
    return float(max(off.values()))


@pytest.mark.parametrize("law", ["local", "mobile"])
@pytest.mark.parametrize("path", DECKS, ids=lambda path: path.stem)
def test_every_shipped_deck_agrees_as_exported(path: Path, law: str) -> None:
    circuit = replace(fs.read_netlist(path), charge_law=law)
    if path.stem in BEGINNINGS and circuit.tran is not None:
        stop = BEGINNINGS[path.stem]
        circuit = replace(circuit, tran=replace(circuit.tran, stop=stop, step=stop / 2000.0))
    # 400 to 1000 steps in a period; the largest, 1e-4, are those of the area at its kink.
    assert deviation(circuit) <= 1.5e-4


@pytest.mark.filterwarnings("ignore:of the source's energy")
@pytest.mark.parametrize("seed", SEEDS)
def test_random_decks_agree_as_exported(seed: int) -> None:
    what, circuit, law = deck(seed)
    assert circuit.charge_law == law
    # A thousand steps in a period: what a jump sets going is met to h, all else to h^2.
    assert deviation(circuit) <= (1e-3 if any(kind in what for kind in JUMPS) else 1.5e-4), what


def test_the_random_decks_hold_every_device_source_and_directive() -> None:
    decks = [deck(seed) for seed in SEEDS]
    circuits = [circuit for _, circuit, _ in decks]
    elements = [e for c in circuits for e in c.elements]
    assert {e.device for e in elements} == {"LAYER", "SLAB", "SKIN", "SKIN_DISPERSIVE", "GAP", "R", "C", "V", "I"}
    waves = {type(e.waveform).__name__ for e in elements if e.waveform is not None}
    assert waves >= {"DC", "Sine", "Pulse", "Exp", "PWL", "Square"}
    assert waves & {"Chirp", "Product", "Sawtooth"}
    for key in ("a_fix", "tau"):
        assert {e.values[key] > 0.0 for e in elements if e.device == "GAP"} == {True, False}
    assert {c.charge_law for c in circuits} == {"local", "mobile"}
    assert {c.tran.uic for c in circuits if c.tran} == {True, False}
    assert {c.tran.start > 0.0 for c in circuits if c.tran} == {True, False}
    assert any(c.ac for c in circuits)
    assert any("." in e.name for e in elements)
    assert {what.split(",")[0] for what, _, _ in decks} == set(NETWORKS)
    assert {what.split(", ")[1] for what, _, _ in decks} == set(SOURCES)


@pytest.mark.parametrize(
    "source",
    [
        fs.Pulse(0.0, 100.0, 1e-3, 1e-3, 1e-3, 0.0, 4e-3),
        fs.Pulse(0.0, 100.0, 1e-3, 1e-3, 1e-3, 0.0),
        fs.Pulse(-50.0, 100.0, 1e-3, 0.0, 0.0, 4e-3, 4e-3),
        fs.Pulse(20.0, 100.0, -3e-3, 1e-3, 1e-3, 2e-3, 8e-3),
        fs.Exp(0.0, 100.0, 0.0, 1e-3, 5e-3, 2e-3),
        fs.Exp(20.0, 100.0, 0.0, 1e-3, 0.0, 2e-3),
        fs.Exp(0.0, 100.0, -1e-3, 1e-3, 5e-3, 2e-3),
    ],
    ids=lambda source: repr(source)[:60],
)
@pytest.mark.parametrize("start", ["", " uic"])
def test_times_of_zero_and_before_the_start_are_the_same_there(source: fs.Waveform, start: str) -> None:
    # ngspice takes PW = 0 for TSTOP, TD1 = 0 for TSTEP and TD2 = 0 for TD1 + TSTEP: by 90 %, and by up to 9.5 %.
    circuit = fs.read_netlist(CIRCUITS / "fingerpad.cir")
    text = circuit.text.replace("50m uic", f"12m{start}")
    assert deviation(fs.parse_netlist(text).replace({"Vdrive": source})) <= 5e-5


def test_an_exp_from_zero_is_said_to_be_another_in_ngspice() -> None:
    text = (CIRCUITS / "fingerpad.cir").read_text().replace("SIN(0 200 100)", "EXP(0 100 0 1m 10m 2m)")
    with pytest.warns(fs.FingerspiceWarning, match=r"Vdrive: EXP has TD1 = 0, .* ngspice 39, which takes TSTEP"):
        circuit = fs.parse_netlist(text)
    theirs = run_ngspice(text, signals=["v(drive)"])
    late = np.interp([1e-3, 5e-3], theirs["time"], theirs["v(drive)"])
    wave = circuit["Vdrive"].waveform
    assert wave is not None
    np.testing.assert_allclose(late, wave.value(np.array([1e-3, 5e-3]) - 10e-6), rtol=1e-4)


# ngspice 39 stops at a node called temper, and at brackets in the formulas of a layer.
@pytest.mark.parametrize(("name", "exported"), [("temper", "temper_"), ("Net-(V1-Pad1)", "Net__V1_Pad1_")])
def test_names_that_ngspice_does_not_take_are_changed(name: str, exported: str) -> None:
    text = (CIRCUITS / "amplifier.cir").read_text()
    circuit = fs.parse_netlist(text.replace(" drive ", f" {name} "))
    signal = f"v({exported})"
    theirs = run_ngspice(fs.export_netlist(circuit), signals=[signal])
    ours = fs.simulate(circuit, t_eval=np.array([0.3e-3, 0.7e-3])).node_voltages[name]
    np.testing.assert_allclose(np.interp([0.3e-3, 0.7e-3], theirs["time"], theirs[signal]), ours, atol=0.02)


def test_names_that_become_one_with_their_letter_are_refused() -> None:
    text = (CIRCUITS / "amplifier.cir").read_text().replace("Ccable  drive 0          150p", "Xa drive 0 part")
    text = text.replace(".tran", "RXa_R1 drive 0 1meg\n.subckt part p n\nR1 p n 1meg\nC1 p n 150p\n.ends\n.tran", 1)
    with pytest.raises(fs.InputError, match=r"RXa_R1 and Xa\.R1 would be one name in the export"):
        fs.export_netlist(fs.parse_netlist(text))
