"""Controlled sources, inductors and switches: closed forms, ngspice under both charge laws, stated errors, refusals."""

import copy
import math
import pickle

import numpy as np
import pytest

import fingerspice as fs
from ngspice_tools import run_ngspice, with_charge_law
from scenes import DECKS, every_law, listed, refuses

FINGER = """\
Xcoat  top a    area LAYER d=1u eps_r=3.9 r=0.2meg
Xgap   a   skin area GAP   d=3.5u eps_r=1 r=1meg
Xskin  skin 0   area SKIN  d=350u f=1k
.nodeset v(area)=34.97
"""
#: Decks with a finger behind what is tested, each with the nodes that are compared and ngspice's largest step, s.
DRIVERS = {name: (nodes, step) for name, nodes, step in listed("drivers")}


def deck(name: str) -> str:
    return (DECKS / "drivers" / f"{name.replace(' ', '_')}.cir").read_text()


def parse(lines: str) -> fs.Circuit:
    return fs.parse_netlist(f"t\n{lines}\n.end\n")


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """Largest difference over the peak."""
    return float(np.abs(one - other).max() / np.abs(other).max())


@every_law
@pytest.mark.parametrize("name", DRIVERS)
def test_drivers_of_a_finger_agree_with_ngspice(name: str, law: str) -> None:
    text, (nodes, step) = with_charge_law(deck(name), law), DRIVERS[name]
    # The exported deck as well, which has every element in its own words.
    for one in (text, fs.export_netlist(fs.parse_netlist(text)) if name in ("currents", "H-bridge") else None):
        if one is None:
            continue
        theirs = run_ngspice(one, ["v(a)-v(skin)", *(f"v({node})" for node in nodes)], max_step=step)
        t, keep = np.unique(np.minimum(theirs["time"], fs.parse_netlist(text).tran.stop), return_index=True)
        late = (t > 5e-6) & ~inside_edges(text, t)
        ours = fs.simulate(fs.parse_netlist(text), t_eval=t[late])
        assert ours.method == "radau"
        assert apart(ours.u_gap, theirs["v(a)-v(skin)"][keep][late]) <= 1e-5
        for node in nodes:
            assert apart(ours.node_voltages[node], theirs[f"v({node})"][keep][late]) <= 1e-5


def inside_edges(text: str, t: np.ndarray) -> np.ndarray:
    """Times beside an edge of a pulse, in which switches change here and at ngspice's next step there."""
    pulses = [e.waveform for e in fs.parse_netlist(text).by_device("V") if isinstance(e.waveform, fs.Pulse)]
    edges = np.unique(np.concatenate([[-1.0, 1.0], *(wave.breakpoints(0.0, t[-1]) for wave in pulses)]))
    after = edges.searchsorted(t)
    return np.minimum(edges[after] - t, t - edges[after - 1]) < 1.1e-8


@pytest.mark.parametrize("seed", range(8))
def test_random_circuits_agree_with_ngspice(seed: int) -> None:
    random = np.random.default_rng(seed)
    lines, coils, pick = ["V1 a 0 SIN(0 1 1k)", "Vs b c 0"], list[str](), lambda: random.choice(list("0abcd"), 2, False)
    for i, kind in enumerate("RCLLEGFH"):
        (p, n), (x, y), size = pick(), pick(), 10.0 ** random.uniform(-1.0, 0.5)
        control = {"E": f"{x} {y}", "G": f"{x} {y}", "F": "Vs", "H": "Vs"}.get(kind, "")
        unit = {"R": 1e3, "C": 1e-7, "L": 1e-2, "G": 1e-4, "H": 1e2}.get(kind, 0.3)
        # A voltage source stands behind a resistor.
        lines += [f"{kind}{i} {p} {n if kind in 'RCLGF' else f'x{i}'} {control} {size * unit!r}"]
        lines += [f"Rx{i} x{i} {n} 50"] if kind in "EH" else []
        coils += [f"L{i}"] if kind == "L" else []
    lines += [f"K1 {' '.join(coils)} 0.8", *(f"Rg{node} {node} 0 100k" for node in "abcd"), ".tran 10u 1m uic"]
    text = "\n".join(["t", *lines, ".end", ""])
    ours = fs.simulate(fs.parse_netlist(text), rtol=1e-7)
    theirs = run_ngspice(text, [f"v({node})" for node in ours.node_voltages], max_step=1e-7)
    t, keep = np.unique(np.minimum(theirs["time"], 1e-3), return_index=True)
    ours = fs.simulate(ours.circuit, t_eval=t[t > 1e-5], rtol=1e-7)
    for node, v in ours.node_voltages.items():
        assert np.abs(v - theirs[f"v({node})"][keep][t > 1e-5]).max() <= 1e-4 * max(1e-3, float(np.abs(v).max()))


@every_law
@pytest.mark.parametrize("name", DRIVERS)
def test_stated_errors_are_met(name: str, law: str) -> None:
    circuit = fs.parse_netlist(with_charge_law(deck(name), law))
    fine = fs.simulate(circuit, rtol=1e-11)
    for rtol in (1e-4, 1e-8):
        run = fs.simulate(circuit, rtol=rtol)
        assert np.abs(run.u_gap - fine.u_gap).max() <= run.error.u_gap + fine.error.u_gap
        assert run.error.u_gap <= rtol * np.abs(run.u_gap).max()
        for node, v in run.node_voltages.items():
            assert np.abs(v - fine.node_voltages[node]).max() <= run.error.v_nodes + fine.error.v_nodes


def test_scipy_integrates_the_same_equations() -> None:
    circuit = fs.parse_netlist(deck("op-amp with a pole"))
    one, other = fs.simulate(circuit), fs.simulate(circuit, rtol=1e-6, method="scipy:Radau")
    assert apart(other.u_gap, one.u_gap) <= 1e-6


@pytest.mark.parametrize("resistance", [1.0, 10.0, 2.0 * math.sqrt(1e3), 500.0])
def test_a_series_rlc_follows_its_closed_form(resistance: float) -> None:
    run = fs.simulate(parse(f"V1 a 0 5\nR1 a b {resistance!r}\nL1 b c 1m\nC1 c 0 1u\n.tran 1u 1m uic"))
    alpha, w0 = resistance / 2e-3, 1.0 / math.sqrt(1e-9)
    w = np.sqrt(complex(w0**2 - alpha**2)) + 1e-9
    v = 5.0 * (1.0 - np.exp(-alpha * run.t) * (np.cos(w * run.t) + alpha / w * np.sin(w * run.t))).real
    assert np.abs(run.node_voltages["c"] - v).max() <= run.error.v_nodes + 1e-8
    assert run.error.v_nodes <= 1e-7


def test_an_lc_circuit_keeps_its_energy() -> None:
    run = fs.simulate(
        parse("C1 a 0 1u IC=10\nL1 a b 1m IC=0.2\nVs b 0 0\n.tran 1u 10m uic\n.meas tran highest MAX I(L1)"), rtol=1e-10
    )
    u, i = run.node_voltages["a"], -run.i_source
    energy = 0.5e-6 * u**2 + 0.5e-3 * i**2
    highest = math.hypot(0.2, 10.0 / math.sqrt(1e3))
    assert run.measures["highest"] == pytest.approx(highest, rel=1e-9)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-10)
    w, z = 1.0 / math.sqrt(1e-9), math.sqrt(1e3)
    np.testing.assert_allclose(u, 10.0 * np.cos(w * run.t) - 0.2 * z * np.sin(w * run.t), rtol=0, atol=1e-9)


def test_windings_with_a_coupling_of_1_are_a_transformer_with_its_magnetising_inductance() -> None:
    source = "V1 a 0 SIN(0 5 1k)\nR1 a b 10\n"
    two = fs.simulate(parse(f"{source}L1 b 0 10m\nL2 c 0 40m\nK1 L1 L2 1\nR2 c 0 100\n.tran 5u 3m uic"))
    # The load counts with the square of the ratio of 2.
    one = fs.simulate(parse(f"{source}L1 b 0 10m\nR2 b 0 25\n.tran 5u 3m uic"))
    np.testing.assert_allclose(two.node_voltages["b"], one.node_voltages["b"], rtol=0, atol=1e-7)
    np.testing.assert_allclose(two.node_voltages["c"], 2.0 * one.node_voltages["b"], rtol=0, atol=1e-7)


def test_three_windings_may_be_coupled_by_one_line() -> None:
    head, tail = "V1 a 0 SIN(0 5 1k)\nR1 a b 10\nL1 b 0 1m\nL2 c 0 2m\nL3 d 0 3m\n", "R2 c 0 10\nR3 d 0 10\n.tran 5u 1m"
    whole = fs.simulate(parse(f"{head}K1 L1 L2 L3 0.9\n{tail}\n.meas tran rest MAX {{abs(I(L3)+V(d)/10)}}"))
    pairs = fs.simulate(parse(f"{head}K1 L1 L2 0.9\nK2 L2 L3 0.9\nK3 L1 L3 0.9\n{tail}"))
    np.testing.assert_array_equal(whole.node_voltages["d"], pairs.node_voltages["d"])
    assert whole.measures["rest"] <= 1e-8  # of the winding's current and its load's


def test_a_switch_changes_where_its_control_passes_the_threshold() -> None:
    run = fs.simulate(parse(
        "V1 a 0 10\nVc c 0 SIN(0 1 1k)\nS1 a b c 0 sw\nC1 b 0 1u\nR1 b 0 1k\n"
        ".model sw SW(Ron=100 Roff=1e9 Vt=0.1 Vh=0.2)\n.tran 5u 3m uic"), rtol=1e-10)  # fmt: skip
    on, off = math.asin(0.3) / (2e3 * math.pi), (math.pi + math.asin(0.1)) / (2e3 * math.pi)
    times = np.append(1e-3 * np.repeat([0.0, 1.0, 2.0], 2) + np.tile([on, off], 3), 1.0)
    v, since, expected = 0.0, 0.0, np.zeros(run.t.size)
    for k, until in enumerate(times.tolist()):
        closed = 1e-2 if k % 2 else 1e-9
        end, rate = 10.0 * closed / (closed + 1e-3), (closed + 1e-3) / 1e-6
        now = (run.t >= since) & (run.t < until)
        expected[now] = end + (v - end) * np.exp(-rate * (run.t[now] - since))
        v, since = end + (v - end) * math.exp(-rate * (until - since)), until
    np.testing.assert_allclose(run.node_voltages["b"], expected, rtol=0, atol=1e-9)


def test_phasors_are_those_of_the_closed_forms() -> None:
    f = np.geomspace(10.0, 1e6, 41)
    s = 2j * np.pi * f
    rlc = fs.phasor(parse("V1 a 0 AC 1\nR1 a b 10\nL1 b c 1m\nC1 c 0 1u"), f)
    np.testing.assert_allclose(rlc.impedance, 10.0 + 1e-3 * s + 1e6 / s, rtol=1e-12)
    amplifier = fs.phasor(
        parse("V1 in 0 AC 1\nR1 in m 10k\nR2 m out 1meg\nC2 m out 10p\nE1 out 0 0 m 1e5\nR3 out 0 1k"), f
    )
    ratio = 1.0 / (1e-6 + 1e-11 * s) / 1e4
    gain = amplifier.v_nodes[:, amplifier.nodes.index("out")]
    np.testing.assert_allclose(gain, -ratio / (1.0 + (1.0 + ratio) / 1e5), rtol=1e-12)


def test_sources_that_only_measure_a_current_leave_phasors_to_the_one_that_drives() -> None:
    f = np.geomspace(10.0, 1e5, 9)
    text = "t\nVin in 0 SIN(0 200 1k)\n{}R5 {} top 1k\nF1 0 mon Vs 2\nR1 mon 0 10k\n" + FINGER
    measured = fs.parse_netlist(text.format("Vs in c 0\n", "c"))
    plain = fs.parse_netlist(text.format("", "in").replace("F1 0 mon Vs 2\nR1 mon 0 10k\n", ""))
    one, other = fs.phasor(measured, f), fs.phasor(plain, f)
    np.testing.assert_allclose(one.u_gap, other.u_gap, rtol=1e-10)
    np.testing.assert_allclose(one.impedance, other.impedance, rtol=1e-10)
    coil = fs.phasor(parse("V1 a 0 AC 1\nR1 a b 10\nVs b c 0\nL1 c 0 1m"), f)
    np.testing.assert_allclose(coil.impedance, 10.0 + 2e-3j * np.pi * f, rtol=1e-12)


def test_the_operating_point_has_inductors_as_wires_and_amplifiers_with_their_gain() -> None:
    lines = "V1 a 0 5\nR1 a b 10\nL1 b c 1m\nR2 c 0 40\nC1 c 0 1u\nG1 0 d c 0 1m\nR3 d 0 1k\nE1 e 0 d 0 3\nR4 e 0 1k"
    run = fs.simulate(parse(f"{lines}\n.tran 1u 1m"))
    for node, value in (("c", 4.0), ("d", 4.0), ("e", 12.0)):
        np.testing.assert_allclose(run.node_voltages[node], value, rtol=1e-9)


@every_law
def test_a_source_that_follows_another_keeps_the_exponential_steps(law: str) -> None:
    drive = "Vin in 0 SIN(0 {} 1k)\n{}Rout {} top 10k\n.tran 2u 3m uic\n"
    text = f"t\n.include fingerspice.lib\n{drive}{FINGER}.end\n"
    followed = fs.parse_netlist(text.format(2, "E1 out 0 in 0 100\n", "out"))
    own = fs.simulate(fs.parse_netlist(text.format(200, "", "in")), charge_law=law)
    run, other = fs.simulate(followed, charge_law=law), fs.simulate(followed, charge_law=law, method="radau")
    assert (run.method, other.method) == ("exponential", "radau")
    assert apart(run.u_gap, own.u_gap) <= 1e-8
    assert apart(other.u_gap, own.u_gap) <= 1e-8
    assert fs.steady_state(followed, charge_law=law).error.u_gap <= 1e-5


def test_elements_of_subcircuits_control_those_beside_them() -> None:
    coils = "L1 q x 1m\nL2 out y 1m\nK1 L1 L2 0.5\nRx x 0 50\nRy y 0 50\nRo out 0 1k"
    body = f"Vs p q 0\nF1 0 out Vs {{gain}}\nRs q 0 1k\n{coils}"
    calls = "X1 in a mirror gain=2\nX2 in b mirror\n.tran 5u 1m uic"
    circuit = parse(f"V1 in 0 SIN(0 1 1k)\n.subckt mirror p out gain=1\n{body}\n.ends\n{calls}")
    assert circuit["X1.F1"].control == ("x1.vs",)
    assert circuit["X2.K1"].control == ("x2.l1", "x2.l2")
    run = fs.simulate(circuit)
    assert np.abs(run.node_voltages["a"]).max() > np.abs(run.node_voltages["b"]).max() > 0.0
    changed = circuit.replace({"X1.F1.gain": 1.0, "X1.K1.k": 0.5})
    run = fs.simulate(changed)
    np.testing.assert_allclose(run.node_voltages["a"], run.node_voltages["b"], rtol=0, atol=1e-12)


def test_runs_of_such_circuits_go_on_are_kept_and_are_batched() -> None:
    circuit = fs.parse_netlist(deck("H-bridge"))
    whole, half = fs.simulate(circuit), fs.simulate(circuit, t_stop=0.25e-3)
    rest = fs.simulate(circuit, start=half, t_stop=0.5e-3, t_eval=whole.t[whole.t > 0.3e-3])
    assert apart(rest.u_gap, whole.u_gap[whole.t > 0.3e-3]) <= 1e-7
    for kept in (pickle.loads(pickle.dumps(whole)), copy.deepcopy(whole)):
        np.testing.assert_array_equal(kept.node_voltages["x"], whole.node_voltages["x"])
    found = fs.batch(circuit, {"Xgap.d": [3e-6, 3.5e-6]}, rtol=1e-6)
    assert float(found.f_el_mean[1]) == pytest.approx(whole.f_el_mean, rel=1e-5)
    circuit.draw()
    assert "S1" in str(circuit)


def test_recordings_drive_amplifiers_by_implicit_steps() -> None:
    rate = 20e3
    samples = fs.Samples(np.sin(2.0 * np.pi * 100.0 * np.arange(200) / rate), rate)
    circuit = fs.parse_netlist(deck("op-amp"))
    run = fs.simulate(circuit, sources={"Vin": samples}, t_stop=9e-3)
    assert run.method == "radau"
    assert fs.simulate(circuit, sources={"Vin": samples}, t_stop=9e-3, rtol=1e-10).u_gap == pytest.approx(
        run.u_gap, abs=1e-5
    )


@every_law
@pytest.mark.parametrize(("name", "periods"), [("op-amp", 20), ("H-bridge", 40)])
def test_periodic_states_are_what_long_runs_come_to(name: str, periods: int, law: str) -> None:
    circuit = fs.parse_netlist(deck(name))
    found = fs.steady_state(circuit, charge_law=law)
    period, start = found.period, found.solution.t[0]
    times = periods * period + (found.solution.t - start)
    run = fs.simulate(circuit, charge_law=law, t_stop=(periods + 1) * period, t_eval=times, rtol=1e-9)
    assert apart(run.u_gap, found.solution.u_gap) <= 2e-8
    assert found.defect <= 1e-6


def test_the_periodic_state_of_an_rlc_has_its_amplitude_and_multipliers() -> None:
    found = fs.steady_state(parse("V1 a 0 SIN(0 1 5k)\nR1 a b 10\nL1 b c 1m\nC1 c 0 1u\n.tran 1u 1m uic"), points=400)
    s = 2j * np.pi * 5e3
    t, v = found.solution.t, found.solution.node_voltages["c"]
    wanted = (1.0 / (1.0 + 10e-6 * s + 1e-9 * s * s) * np.exp(s * t)).imag
    np.testing.assert_allclose(v, wanted, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.multipliers, math.exp(-5e3 / 5e3), rtol=1e-4)


def test_an_unstable_circuit_is_refused_where_it_outgrows_all_digits() -> None:
    with pytest.raises(fs.InputError, match="the circuit is unstable: by itself a voltage grows by a factor of e"):
        fs.simulate(parse("V1 a 0 1\nR1 a b 1k\nC1 b 0 1n\nG1 0 b b 0 2m\n.tran 1u 1m uic"))
    grows = fs.simulate(parse("V1 a 0 1\nR1 a b 1k\nC1 b 0 1u\nG1 0 b b 0 2m\n.tran 10u 5m uic"))
    np.testing.assert_allclose(grows.node_voltages["b"], np.expm1(1e3 * grows.t), rtol=1e-7, atol=1e-6)


def test_plans_say_that_steps_are_implicit() -> None:
    told = fs.plan(fs.parse_netlist(deck("transformer")))
    assert told.tier == "coupled"
    assert any("implicit steps" in reason for reason in told.reasons)
    assert "an inductor, an amplifier or a switch sets no bound" in told.reasons[0]


def test_what_needs_decaying_modes_refuses() -> None:
    circuit = fs.parse_netlist(deck("op-amp"))
    with pytest.raises(fs.InputError, match="the linear tier is not for this network; allowed: auto or coupled"):
        fs.simulate(parse("V1 a 0 5\nR1 a b 10\nL1 b 0 1m\n.tran 1u 1m uic"), tier="linear")
    with pytest.raises(fs.InputError, match="an inverse drive needs modes that decay without oscillation"):
        fs.inverse_drive(circuit, force=np.full(100, 0.1), rate=1e4)


HEAD = "V1 a 0 1\nR1 a 0 1k\n"
BAD = listed("controlled")


@pytest.mark.parametrize(("lines", "line", "said"), BAD, ids=[said[:40] for _, _, said in BAD])
def test_what_is_wrong_is_a_sentence_with_its_line(lines: str, line: int, said: str) -> None:
    told = refuses("", parse, f"{HEAD}{lines}\n.tran 1u 1m uic")
    assert said in told
    assert f"<netlist>:{line}:" in told


def test_a_start_at_an_operating_point_that_does_not_exist_is_refused() -> None:
    with pytest.raises(fs.InputError, match="no DC operating point: nothing determines L1, in a loop of inductors"):
        fs.simulate(parse(f"{HEAD}L1 a 0 1m\n.tran 1u 1m"))
    with pytest.raises(fs.InputError, match="no DC operating point: nothing determines C1"):
        fs.simulate(parse(f"{HEAD}C1 a b 1n\nC2 b 0 1n\nG1 0 c b 0 1\nR2 c 0 1\n.tran 1u 1m"))
