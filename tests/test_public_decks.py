"""Decks that other people have published, in our own words: here and in ngspice the same, measures and steps, too."""

import re
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from ngspice_tools import beside, call_ngspice

#: Decks of runs, each with where it is from and ngspice's largest step, s.
RUNS = {
    "sine with parameters: lopesivan/estudo-ngspice, 01-ckt.sp": ("""\
.param T={8*atan(1)} f={1/T} A=1
V1 1 0 SIN(0 {A} {f})
R1 1 0 100
.tran {T/100} {T}
.meas tran x WHEN v(1)=0 FALL=1
.meas tran vmax MAX v(1) FROM=0 TO=3.14
""", 1e-3),
    "high-pass under a train of pulses: ssp1512/analog_circuit_simulations, rc_hpf.sp": ("""\
.PARAM vdd_var=1
C1 vin vout 1p
R1 vout GND 1k
Vsin vin GND 0 PULSE(0 vdd_var 0.5n 1p 1p 0.1n 0.2n)
.SAVE ALL
.OP
.TRAN 10p 4n
.GLOBAL GND
.meas tran top MAX v(vout) FROM=2n TO=4n
.meas tran low MIN v(vout) FROM=2n TO=4n
""", 2e-13),
    "rise time of an RC with parameters: tomverbeure.github.io, PyLTSpice": ("""\
.param r=1k c=1u
V1 in 0 PWL(0 0 2m 0 2.001m 1)
R1 in out {r}
C1 out 0 {c}
.tran 10u 10m
.meas tran start_rise WHEN v(out)=0.1 RISE=1
.meas tran end_rise WHEN v(out)=0.9 RISE=1
.meas tran rise_time TRIG v(out) VAL=0.1 RISE=1 TARG v(out) VAL=0.9 RISE=1
""", 1e-6),
    "hot plug with a bypass and a load step: embeddedos.org, datasets of circuits": ("""\
V_IN n_in 0 PWL(0 0 100u 48)
R_F1 n_in n_f 20m
R_PRE n_f n_bus 10
S_BYP n_f n_bus n_byp 0 SW_BYP
V_BYP n_byp 0 PWL(0 0 30m 0 30.001m 5)
C_BULK n_bus n_esr 470u
R_ESR n_esr 0 50m
I_LOAD n_bus 0 PWL(0 0 40m 0 40.1m 4.16667)
.model SW_BYP SW(RON=10m ROFF=1g VT=2.5 VH=0)
.tran 10u 50m
.meas tran most MAX v(n_esr)
.meas tran sag FIND v(n_bus) AT=49m
""", 2e-6),
    "amplifier as a pole and a buffer: a checker of student circuits": ("""\
.subckt opamp in_p in_n out
G1 0 n1 in_p in_n 1
R1 n1 0 100k
C1 n1 0 1.59e-4
E1 buf 0 n1 0 1
Rout buf out 75
.ends opamp
Vin in 0 PULSE(0 1 0.1m 1u 1u 2m 4m)
X1 in fb out opamp
R2 out fb 9k
R3 fb 0 1k
CL out 0 1n
.tran 1u 1m
.meas tran settled FIND v(out) AT=0.9m
.meas tran delay TRIG v(in) VAL=0.5 RISE=1 TARG v(out) VAL=2 RISE=1
""", 2e-8),
    "gate driver of slices: a segmented driver for GaN": ("""\
.param VDRV=5 rslice={8/8}
Vvp vp 0 {VDRV}
Vpu pu 0 PULSE(0 1 0 1n 1n 200n 500n)
Vpd pd 0 PULSE(1 0 0 1n 1n 200n 500n)
S1 vp a pu 0 SWP
R1 a g {rslice}
S2 b 0 pd 0 SWP
R2 g b {rslice}
Cg g s 1n
Ls s 0 0.5n
.model SWP SW(Ron=0.01 Roff=1e9 Vt=0.5 Vh=0.05)
.tran 0.1n 1u
.meas tran vgate_high MAX v(g)
.meas tran vgate_last FIND v(g) AT=900n
""", 5e-12),
    "divider of a pulse: a tool that reads other simulators' results": ("""\
v1 node_a 0 PULSE(0 1 0 1n 1n 10n 20n)
r1 node_a node_b 10
r2 node_b 0 20
.tran 0.1n 40n
.meas tran v_out_max MAX v(node_b)
.meas tran width TRIG v(node_b) VAL=0.3 RISE=2 TARG v(node_b) VAL=0.3 FALL=2
""", 1e-11),
}  # fmt: skip


#: Decks of sweeps, likewise; measures of a fine sweep there are compared with those of the deck's own here.
SWEEPS = {
    "worst case of a low-pass: a board maker's sample for its checker": """\
.param R1_val=1k C1_val=1u
V1 in 0 AC 1
R1 in out {R1_val}
C1 out 0 {C1_val}
.ac dec 40 10 1Meg
.meas ac gain_1k FIND vdb(out) AT=1k
.meas ac phase_100 FIND vp(out) AT=100
.meas ac corner WHEN vdb(out)=-3
""",
    "differentiator with an amplifier of high gain: a set of op-amp decks": """\
V1 in 0 DC 0 AC 1
C1 in inv 1n
R1 inv out 10k
E1 out 0 0 inv 100k
.AC DEC 20 1 100MEG
.meas ac unity WHEN vdb(out)=0
.meas ac at_1k FIND vm(out) AT=1k
""",
    "low-pass of an L and a C: MicroSpice": """\
V1 in 0 AC 1
L1 in out 100nH
R1 out gnd 50
C1 out gnd 100nF
.ac dec 50 10k 10meg
.meas ac peak MAX vm(out)
.meas ac corner WHEN vdb(out)=-3
""",
}


def measures_of_ngspice(text: str, folder: Path) -> dict[str, float]:
    (folder / "deck.cir").write_text(text)
    said = call_ngspice(folder, "deck.cir", timeout=120.0).stdout
    return {m[1]: float(m[2]) for m in re.finditer(r"^(\w+) +=\s+([-+.\deE]+)", said, re.MULTILINE)}


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.filterwarnings("ignore:.*outside 1 nH:fingerspice.FingerspiceWarning")
def test_a_published_deck_runs_as_in_ngspice(name: str, tmp_path: Path) -> None:
    body, step = RUNS[name]
    text = f"{name}\n{body}.end\n"
    circuit = fs.parse_netlist(text)
    bare = re.sub(r"(?im)^\.(op|save|meas).*\n", "", text)
    found = beside(circuit, bare, max_step=step, after=20.0 * step, edge=5.0 * step)
    largest = max(float(np.abs(theirs).max()) for _, theirs in found.nodes.values())
    # ngspice changes a switch at the end of a step, so that its error is of first order there.
    allowed = 8e-3 if "driver" in name else 1e-6
    for node, (ours, theirs) in found.nodes.items():
        assert np.abs(ours - theirs).max() <= allowed * largest, node
    theirs = measures_of_ngspice(re.sub(r"(?im)^\.tran (\S+) (\S+)", rf".tran \1 \2 0 {step!r}", text), tmp_path)
    measures = fs.simulate(circuit).measures
    assert len(measures) >= 2
    for measure, value in measures.items():
        assert value == pytest.approx(theirs[measure.lower()], rel=max(allowed, 5e-6)), measure


@pytest.mark.parametrize("name", SWEEPS)
def test_a_published_sweep_is_measured_as_in_ngspice(name: str, tmp_path: Path) -> None:
    text = f"{name}\n{SWEEPS[name]}.end\n"
    circuit = fs.parse_netlist(text)
    found = fs.phasor(circuit, np.geomspace(circuit.ac.start, circuit.ac.stop, 101))
    theirs = measures_of_ngspice(re.sub(r"(?i)\.ac dec \d+", ".save all\n.ac dec 4000", text), tmp_path)
    assert len(found.measures) >= 2
    for measure, value in found.measures.items():
        assert value == pytest.approx(theirs[measure], rel=3e-5), measure
    if "of an L and a C" in name:
        # Q is 50: the summit between the points of a sweep.
        assert found.measures["peak"] == pytest.approx(50.0 / np.sqrt(1.0 - 1e-4), rel=1e-12)


def test_published_steps_of_an_operating_point(tmp_path: Path) -> None:
    """A loaded source (a course in KiCad), at every load as ngspice has it by itself, and in closed form."""
    loads = [10.0, 30.0, 100.0, 300.0, 900.0, 1e3, 3e3, 10e3, 1e6]
    body = "V1 vsrc 0 12\nRS vsrc vout 100\nRL vout 0 {RLOAD}\n.param RLOAD=900\n"
    step = ".step param RLOAD list 10 30 100 300 900 1k 3k 10k 1Meg\n.op\n"
    found = fs.operating_points(fs.parse_netlist(f"loads\n{body}{step}.end\n"))
    np.testing.assert_array_equal(found.rload, loads)
    np.testing.assert_allclose(found["v:vout"], 12.0 * np.array(loads) / (np.array(loads) + 100.0), rtol=1e-14)
    for place in (0, 4, 8):
        one = body.replace("RLOAD=900", f"RLOAD={loads[place]!r}")
        (tmp_path / "deck.cir").write_text(f"loads\n{one}.control\nop\nprint v(vout)\nquit 0\n.endc\n.end\n")
        said = call_ngspice(tmp_path, "deck.cir").stdout
        theirs = float(re.search(r"v\(vout\) = (\S+)", said)[1])  # type: ignore[index]
        assert found["v:vout"][place].item() == pytest.approx(theirs, rel=1e-6)
