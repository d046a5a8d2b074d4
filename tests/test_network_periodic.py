"""Periodic states of networks, against long runs, another integrator, closed forms and the same circuit as a stack."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from commands import run_here
from network_reference import Floating
from scenes import CIRCUITS, by_turns, cases, deck, every_law, finger, floating, refuses, shipped, table1

WAVES = (fs.Sine(200.0, 5000.0), fs.Square(200.0, 5000.0), fs.Square(150.0, 5000.0, duty=0.3))
SHIPPED = ("amplifier", "ungrounded_user", "two_fingers")


@pytest.mark.parametrize(("source", "law"), by_turns(WAVES))
@pytest.mark.parametrize("name", SHIPPED)
def test_it_is_where_a_long_run_ends_within_the_error_stated(name: str, source: fs.Waveform, law: str) -> None:
    circuit = shipped(name).replace({"Vdrive": source})
    states = [fs.steady_state(circuit, charge_law=law, rtol=rtol) for rtol in (1e-6, 1e-9)]
    period = states[0].period
    t = (np.arange(100) + 0.37) / 100.0 * period
    later = math.ceil(math.log(1e-13) / math.log(states[1].multipliers.max())) * period
    # Every period stepped: a period that repeats others would carry its own error along.
    long = fs.simulate(
        circuit, t_eval=later + t, t_stop=later + period, charge_law=law, rtol=1e-11, method="exponential", charge=False
    )
    for state in states:
        run = fs.simulate(circuit, start="periodic", t_eval=t, t_stop=period, charge_law=law, rtol=state.rtol)
        true_u, true_f = (np.abs(getattr(run, key) - getattr(long, key)).max() for key in ("u_gap", "f_el"))
        assert true_u <= run.error.u_gap + long.error.u_gap
        assert true_f <= run.error.f_el + long.error.f_el
        assert run.error.u_gap <= state.rtol * np.abs(long.u_gap).max()
        assert state.error.u_gap <= 0.5 * state.rtol * np.abs(long.u_gap).max()
        assert state.defect <= state.rtol * 200.0
        assert run.error.q_source is None
        assert run.plan.start == "periodic"


@every_law
@pytest.mark.parametrize("tau", [0.0, 3e-5])
def test_an_independent_integration_leads_back_to_it_and_has_its_multipliers(law: str, tau: float) -> None:
    circuit = floating("SIN(40 120 5k)", tau=tau)
    state = fs.steady_state(circuit, charge_law=law, rtol=1e-9)
    s = state.solution
    begin = np.array([*s.u_layer[0], s.node_voltages["body"][0], *([s.area[0]] if tau else [])])
    reference, period = Floating(5000.0, 47e3, 150e-12, law == "mobile", tau), 2e-4

    def source(t: float) -> float:
        return 40.0 + 120.0 * math.sin(2.0 * math.pi * 5000.0 * t)

    def mapped(start: np.ndarray, rtol: float = 1e-12) -> np.ndarray:
        return reference.response(source, [0.0, period], rtol, start)["state"][:, -1]

    scale = np.array([200.0] * 4 + [35e-6] * bool(tau))
    back = mapped(begin)
    assert np.abs((back - begin) / scale).max() <= 3e-9
    columns = [(mapped(begin + move, 1e-9) - back) / move.sum() for move in 3e-5 * np.diag(scale)]
    want = np.sort(np.abs(np.linalg.eigvals(np.array(columns).T)))
    np.testing.assert_allclose(np.sort(state.multipliers), want, rtol=0, atol=2e-4)
    assert state.stability_margin == pytest.approx(1.0 - want[-1], abs=2e-4)


@pytest.mark.parametrize(("source", "law"), by_turns(["SIN(0 200 100)", "SIN(60 120 1k)", "SQUARE(180 200 0.2)"]))
def test_a_stack_with_a_resistor_beside_it_has_the_stacks_state(source: str, law: str) -> None:
    stack = table1(source)
    network = fs.parse_netlist(stack.text.replace("\nXcoat", "\nRload drive 0 1meg\nXcoat", 1))
    assert network["Rload"].device == "R"
    one, other = (fs.steady_state(c, charge_law=law, rtol=1e-10) for c in (stack, network))
    peak = np.abs(one.solution.u_gap).max()
    assert np.abs(one.solution.u_gap - other.solution.u_gap).max() <= 2e-10 * peak
    assert np.abs(one.solution.f_el - other.solution.f_el).max() <= 2e-10 * one.solution.f_el.max()
    np.testing.assert_allclose(np.sort(other.multipliers), np.sort(one.multipliers), rtol=0, atol=1e-4)


def test_two_sources_with_a_common_period_have_a_state_of_that_period() -> None:
    circuit = deck(
        "Vdrive amp 0 SIN(0 150 3k)", "Rout amp drive 47k", *finger("drive", "body"), "Vbody body 0 SIN(5 40 2k)",
        "Ccable drive 0 150p",
    )  # fmt: skip
    state = fs.steady_state(circuit, rtol=1e-9)
    assert state.period == pytest.approx(1e-3, rel=1e-12)
    t = state.solution.t[:-1]
    long = fs.simulate(circuit, t_eval=t + 0.02, t_stop=0.021, rtol=1e-11, start="uncharged")
    assert np.abs(state.solution.u_gap[:-1] - long.u_gap).max() <= state.solution.error.u_gap + long.error.u_gap


def test_a_source_that_settles_late_starts_its_period_there() -> None:
    circuit = shipped("amplifier").replace({"Vdrive": fs.Sine(200.0, 5000.0, delay=3.3e-4)})
    run = fs.simulate(circuit, start="periodic", t_stop=4e-4, rtol=1e-9)
    assert run.t[0] == pytest.approx(4e-4, rel=1e-12)
    plain = fs.simulate(circuit, t_eval=run.t + 4e-3, t_stop=5e-3, rtol=1e-10, start="uncharged")
    assert np.abs(run.u_gap - plain.u_gap).max() <= run.error.u_gap + plain.error.u_gap
    with pytest.raises(fs.InputError, match="where the source has settled and its periodic state exists"):
        fs.simulate(circuit, start="periodic", t_eval=[0.0, 1e-4])


@pytest.mark.parametrize("name", [*SHIPPED, "current_drive"])
def test_with_its_areas_frozen_it_is_the_phasor_with_the_multipliers_of_its_rates(name: str) -> None:
    circuit = shipped(name)
    state = fs.steady_state(circuit, area="frozen")
    rates = np.array(fs.plan(circuit, area="frozen").rates)
    np.testing.assert_allclose(np.sort(state.multipliers), np.sort(np.exp(-rates / 5e3)), rtol=0, atol=1e-12)
    gaps = state.solution.gaps
    amplitude = np.atleast_1d(state.u_gap_amplitude)
    for i, gap in enumerate(gaps):
        p = fs.phasor(circuit, area="frozen", finger=gap)
        assert amplitude[i] == pytest.approx(abs(p.u_gap[0]), rel=1e-8)
    assert state.defect <= 1e-11 * np.abs(state.solution.u_layer).max()


def test_a_charge_that_nothing_drains_stays_as_it_was() -> None:
    lines = ("Vdrive drive 0 SIN(0 200 5k)", *finger("drive", "body"), "C1 body mid 300p", "C2 mid 0 200p")
    state = fs.steady_state(deck(*lines), rtol=1e-10)
    v = state.solution.node_voltages
    # Nothing ever flows onto the plates between: none was there at the start.
    assert np.abs(300e-12 * (v["body"] - v["mid"]) - 200e-12 * v["mid"]).max() <= 1e-20
    assert state.multipliers.max() == pytest.approx(1.0, abs=1e-9)
    assert state.stability_margin == pytest.approx(0.0, abs=1e-9)
    one = fs.steady_state(deck(*lines[:-2], "C1 body 0 120p"), rtol=1e-10)
    assert np.abs(one.solution.u_gap - state.solution.u_gap).max() <= 2e-10 * 200.0


@every_law
@pytest.mark.parametrize("source", ["SIN(40 120 5k)", "SQUARE(100 5k 0.3)"])
def test_the_error_stated_holds_though_a_disturbance_would_outlast_many_periods(source: str, law: str) -> None:
    # The body leaks within a second, and the coating within a tenth.
    circuit = floating(source, "Rb body 0 5g").replace({"Xcoat.r": 1e9, "Xgap.r": 1e9})
    rough, fine = (fs.steady_state(circuit, charge_law=law, rtol=rtol) for rtol in (1e-6, 1e-9))
    assert rough.multipliers.max() > 0.999
    for key, asked in (("u_gap", "u_gap"), ("f_el", "f_el")):
        one, other = (getattr(state.solution, key) for state in (rough, fine))
        stated = sum(getattr(state.solution.error, asked) for state in (rough, fine))
        assert np.abs(one - other).max() <= stated
        assert np.abs(one - other).max() <= 1e-6 * np.abs(other).max()


def test_where_the_rounding_of_modes_is_in_the_way_an_implicit_method_goes_on() -> None:
    # A gap that nearly shorts itself, behind 10 ohm and a picofarad.
    circuit = deck("V1 amp 0 SIN(5 20 1k)", *finger("amp", "body"), "Rb body far 10", "Cb far 0 1p")
    circuit = circuit.replace({"Xgap.r": 1e4})
    t = (np.arange(60) + 0.37) / 60.0 * 1e-3
    run = fs.simulate(circuit, start="periodic", t_eval=t, t_stop=1e-3, rtol=1e-8, charge=False)
    assert run.method == "radau"
    long = fs.simulate(circuit, t_eval=0.02 + t, t_stop=0.021, rtol=1e-8, charge=False)
    assert np.abs(run.u_gap - long.u_gap).max() <= run.error.u_gap + long.error.u_gap
    assert np.abs(run.f_el - long.f_el).max() <= run.error.f_el + long.error.f_el


def test_a_charge_that_the_areas_ripple_pumps_for_ever_has_no_periodic_state() -> None:
    # Behind the insulating coating and the body's capacitance: what the law moves with the area does not come back.
    circuit = floating("SQUARE(100 5k 0.3)").replace({"Xcoat.r": math.inf})
    with pytest.raises(fs.SolveError, match="a charge that nothing drains moves by") as caught:
        fs.steady_state(circuit, charge_law="local")
    assert caught.value.failure.status is fs.Status.NOT_PERIODIC
    run = fs.simulate(circuit, t_stop=0.0402, t_eval=[0.02, 0.0202, 0.04, 0.0402], charge_law="local", rtol=1e-9)
    coat = run.u_layer[:, 0]
    assert 0.01 < abs(coat[1] - coat[0]) < 0.03
    assert coat[3] - coat[2] == pytest.approx(coat[1] - coat[0], rel=1e-3)


def test_a_current_that_charges_what_nothing_drains_has_no_periodic_state() -> None:
    circuit = deck("I1 0 a SIN(1u 1u 1k)", "C1 a 0 1n", "R1 a b 1k", "C2 b 0 1n")
    with pytest.raises(fs.SolveError, match="charges, from period to period, what nothing drains"):
        fs.steady_state(circuit)
    # Without a mean it only swings, about what it began with.
    swinging = fs.steady_state(circuit.replace({"I1": fs.Sine(1e-6, 1e3)}))
    run = fs.simulate(circuit.replace({"I1": fs.Sine(1e-6, 1e3)}), t_stop=0.02, t_eval=0.019 + swinging.solution.t[:-1])
    assert np.abs(run.node_voltages["a"] - swinging.solution.node_voltages["a"][:-1]).max() <= 1e-9


@pytest.mark.parametrize("name", [*SHIPPED, "current_drive"])
def test_the_phasor_at_the_mean_areas_explains_the_transient(name: str) -> None:
    result = fs.compare(shipped(name), rtol=1e-9)
    for i in range(len(result.gaps)):
        p, mean, coupled = (f.of_gap(i) for f in (result.phasor, result.mean, result.coupled))
        for key in p:
            # A sine: what the transient differs by is all the ripple of the area.
            assert mean[key] == pytest.approx(p[key], rel=1e-7), key
            assert 1e-6 < abs(coupled[key] / p[key] - 1.0) < 0.1, key
    assert len(result.rows()) == 4 * len(result.gaps)
    assert str(result).count("of that is the ripple of the area") == len(result.gaps)
    result.plot()


@pytest.mark.parametrize("name", SHIPPED)
def test_at_a_tiny_amplitude_the_large_signal_is_the_phasor(name: str) -> None:
    circuit = shipped(name)
    for gap in fs.steady_state(circuit).solution.gaps:
        (large,) = fs.large_signal(circuit, [1e3, 5e3], 1e-5, finger=gap, rtol=1e-9)
        small = fs.phasor(circuit, [1e3, 5e3], finger=gap, area="frozen")
        np.testing.assert_allclose(large.gain, small.gain, rtol=1e-7)
        np.testing.assert_allclose(large.layer_gain, small.layer_gain, rtol=1e-7)
        np.testing.assert_allclose(large.area, small.area, rtol=1e-7)
        np.testing.assert_allclose(large.f_el_mean, small.f_el_mean * (1e-5 / 200.0) ** 2, rtol=1e-6)
        (loud,) = fs.large_signal(circuit, [1e3, 5e3], finger=gap, rtol=1e-8)
        assert np.all(np.abs(loud.gain / small.gain - 1.0) > 1e-3)


def test_one_of_several_gaps_has_to_be_named() -> None:
    circuit = shipped("two_fingers")
    for call in (fs.phasor, lambda c: fs.large_signal(c, [5e3])):
        refuses(r"several GAPs; allowed: finger= one of Xfirm\.Xgap, Xlight\.Xgap", call, circuit)
    refuses(r"finger is 'Xgap'; allowed: the name of a GAP, Xfirm\.Xgap", fs.phasor, circuit, finger="Xgap")
    assert "of several GAPs, Xlight.Xgap" in fs.phasor(circuit, finger="xlight.xgap").notes


def test_a_phasor_of_several_sources_is_refused_by_their_names() -> None:
    circuit = deck("V1 a 0 SIN(0 9 1k)", "R1 a b 1k", *finger("b", "c"), "V2 c 0 SIN(0 9 1k)", "C1 b 0 1n")
    for call in (fs.phasor, fs.compare, lambda c: fs.large_signal(c, [1e3])):
        refuses("needs one source, whose amplitude it takes; this circuit has V1, V2", call, circuit)
    # Its periodic state exists all the same.
    assert fs.steady_state(circuit).stability_margin > 0.0


def test_the_plan_says_how_far_the_areas_change_and_that_it_is_stepped() -> None:
    loud, quiet = (fs.plan(shipped("two_fingers"), sources=fs.Sine(u, 5e3)) for u in (200.0, 2e-5))
    assert loud.tier == quiet.tier == "coupled"
    assert loud.sensitivity > 0.05
    assert quiet.sensitivity < 1e-6
    assert "a network whose areas follow the gap voltage, each by up to" in loud.reasons[0]
    unknown = fs.plan(shipped("current_drive"))
    assert math.isnan(unknown.sensitivity)
    assert "a current source sets no bound" in unknown.reasons[0]


def between_two_sources() -> fs.Circuit:
    return deck(
        "Vdrive amp 0 SIN(0 100 1k)", "Rout amp drive 47k", *finger("drive", "body"), "Vbody body 0 SIN(0 10 1k)"
    )


def spiked(t: Any) -> Any:
    """A tone with a spike that no sampling finds."""
    t = np.asarray(t)
    return 100.0 * np.sin(2e3 * np.pi * t) + np.where(np.abs(t - 3.33333e-4) < 1e-12, 50.0, 0.0)


@pytest.mark.parametrize("area", ["coupled", "frozen"])
@pytest.mark.parametrize("guilty", ["Vdrive", "Vbody"])
def test_a_source_that_was_not_seen_as_it_is_is_named(guilty: str, area: str) -> None:
    circuit = between_two_sources()
    good = "Vbody" if guilty == "Vdrive" else "Vdrive"
    given = {guilty: spiked, good: fs.Sine(10.0, 1e3)}
    with pytest.raises(fs.SolveError) as caught:
        fs.simulate(circuit, sources=given, t_stop=1e-3, t_eval=[0.0, 3.33333e-4, 1e-3], area=area)
    assert caught.value.failure.status is fs.Status.SOURCE_UNSEEN
    assert caught.value.failure.element == guilty
    assert "(by 50 V)" in caught.value.failure.cause
    assert caught.value.solution.t[-1] < 3.33333e-4


@pytest.mark.parametrize("guilty", ["Vdrive", "Vbody"])
def test_a_source_that_is_no_number_within_its_period_is_named(guilty: str) -> None:
    circuit = between_two_sources()

    def broken(t: Any) -> Any:
        return np.where(np.asarray(t) > 5e-4, np.nan, 10.0 * np.sin(2e3 * np.pi * np.asarray(t)))

    with pytest.raises(fs.SolveError, match="a source gave NaN or inf") as caught:
        fs.steady_state(circuit.replace({guilty: fs.Function(broken, repeat=1e-3)}))
    assert caught.value.failure.element == guilty


@pytest.mark.parametrize(
    ("name", "area", "off"),
    [
        *(("fingerpad", "coupled", 1e-10), ("amplifier", "coupled", 1e-10), ("amplifier", "frozen", 1e-10)),
        ("two_fingers", "coupled", 2e-10),
    ],
)
def test_a_rough_function_counts_in_both_errors_and_in_what_is_asked(name: str, area: str, off: float) -> None:
    rng, table = np.random.default_rng(3), {}

    def rough(t: float) -> float:
        # Its own rounding: a part in 1e11, anew at every time.
        return 200.0 * math.sin(3e3 * t) * (1.0 + 1e-11 * table.setdefault(t, rng.uniform(-1.0, 1.0)))

    given = {"sources": rough, "t_stop": 1e-4 * cases(4, 2), "area": area}
    met = fs.simulate(shipped(name), rtol=1e-8, **given)
    tight = fs.simulate(shipped(name), rtol=1e-13, throw=False, **given)
    assert met.success
    assert tight.status is fs.Status.ERROR_NOT_MET
    assert "the source function itself is rough by" in tight.message
    assert tight.error.u_gap >= off
    # What moves the voltage by a part moves the force of every finger by twice that.
    peak, force = np.abs(tight.u_gap).max(axis=0), tight.f_el.max(axis=0)
    assert tight.error.f_el >= np.max(2.0 * off / peak * force)


def test_the_command_sweeps_one_of_several_fingers(monkeypatch: Any, capsys: Any, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("ac", str(CIRCUITS / "two_fingers.cir"), "--sweep", "lin 2 1k 5k", "--area", "coupled", "--no-plot")
    run_here(monkeypatch, capsys, *words).refused("allowed: finger= one of Xfirm.Xgap, Xlight.Xgap")
    answer = json.loads(
        run_here(monkeypatch, capsys, *words, "--finger", "xlight.xgap", "--json", "--rtol", "1e-7").out
    )
    (want,) = fs.large_signal(shipped("two_fingers"), [1e3, 5e3], finger="Xlight.Xgap", rtol=1e-7)
    np.testing.assert_allclose(answer["sweeps"][0]["f_el_mean"], want.f_el_mean, rtol=1e-12)
