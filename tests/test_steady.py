"""Periodic states by Newton's method: the state, its defect and its stability."""

import math
import pickle
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from scenes import CIRCUITS, by_turns, deck, every_law, refuses, shipped, table1

AREA = 34.9715871843e-6


def trapezoids(f: float) -> list[Any]:
    """The shipped decks' square with edges of 1 ns, from a falling edge's end of period on."""
    half = 0.5 / f
    points = [(0.0, -200.0), (1e-9, 200.0), (half, 200.0), (half + 1e-9, -200.0), (2.0 * half, -200.0)]
    return ref.pwl_segments(points)


SHIPPED = {
    "fingerpad.cir": (ref.sine_segments(200.0, 100.0, 0.01), 100.0),
    "fingerpad_5khz.cir": (ref.sine_segments(200.0, 5000.0, 2e-4), 5000.0),
    "fingerpad_square.cir": (trapezoids(100.0), 100.0),
    "fingerpad_square_5khz.cir": (trapezoids(5000.0), 5000.0),
}


def alone(t: np.ndarray) -> np.ndarray:
    """Which outputs have a time of their own: left-hand and right-hand values of a jump share one."""
    apart = np.diff(t) > 0.0
    return np.append(apart, True) & np.append(True, apart)


def leaking(coat: float, gap: float) -> tuple[ref.Layer, ...]:
    """The reference's layers of Table 1 with these resistances (ohm) of coat and gap."""
    one, other, skin = ref.table1_layers(100.0)
    return ref.Layer(one.c, r_total=coat), ref.Layer(other.c, r_total=gap), skin


SCENES: dict[str, tuple[fs.Waveform, Any]] = {
    "offset": (
        fs.Sine(120.0, 300.0, offset=70.0, phase_deg=40.0),
        ref.sine_segments(120.0, 300.0, 1 / 300.0, phase=math.radians(40.0), offset=70.0),
    ),
    "duty": (fs.Square(180.0, 200.0, duty=0.2), ref.square_segments(180.0, 200.0, 1, duty=0.2)),
    "delay": (
        fs.Sine(150.0, 200.0, delay=0.0125),
        # From the first whole period after the delay, 15 ms: half a period into the sine.
        ref.sine_segments(150.0, 200.0, 5e-3, phase=math.pi),
    ),
    "AM": (
        fs.AM(200.0, 600.0, 200.0, depth=0.7),
        [(0.0, 5e-3, lambda t: 200.0 / 1.7 * (1.0 + 0.7 * np.sin(400.0 * np.pi * t)) * np.sin(1.2e3 * np.pi * t))],
    ),
    "sum": (
        fs.Sine(150.0, 200.0) + fs.Sine(60.0, 600.0, phase_deg=90.0),
        [(0.0, 5e-3, lambda t: 150.0 * np.sin(400.0 * np.pi * t) + 60.0 * np.cos(1200.0 * np.pi * t))],
    ),
    "triangle": (
        fs.Triangle(200.0, 200.0),
        ref.pwl_segments([(0.0, 0.0), (1.25e-3, 200.0), (3.75e-3, -200.0), (5e-3, 0.0)]),
    ),
    "function": (
        fs.Function(lambda t: 150.0 * np.sin(400.0 * np.pi * t) / (1.2 + np.cos(400.0 * np.pi * t)), repeat=5e-3),
        [(0.0, 5e-3, lambda t: 150.0 * np.sin(400.0 * np.pi * t) / (1.2 + np.cos(400.0 * np.pi * t)))],
    ),
}


@pytest.mark.parametrize(("name", "law"), by_turns([*SHIPPED, *SCENES]))
def test_a_periodic_source_has_the_reference_s_periodic_state(name: str, law: str) -> None:
    shipped = name in SHIPPED
    circuit = fs.read_netlist(CIRCUITS / name) if shipped else table1().replace({"Vdrive": SCENES[name][0]})
    segments, f = SHIPPED.get(name) or (SCENES[name][1], 100.0)
    state = fs.steady_state(circuit, charge_law=law, rtol=1e-11)
    (wave,) = (e.waveform for e in circuit.by_device("V"))
    solution, period = state.solution, wave.period
    assert solution.t[0] == pytest.approx(period * math.ceil(wave.settled / period), rel=1e-12)
    assert solution.t[-1] - solution.t[0] == pytest.approx(period, rel=1e-12)
    phase = solution.t - solution.t[0]
    # At a jump the reference has the right-hand values alone; the last output is the first of the next period. On the
    # ramps of the edges of 1 ns a rounding of the time is some microvolts.
    edges = np.array([s[0] for s in segments if shipped and len(segments) > 1])
    kept = alone(phase) & (np.abs(phase[:, None] - edges).min(axis=1, initial=1.0) > 2e-9)
    kept[-1] = False
    assert kept.sum() >= 190
    want = ref.periodic_state(segments, law=law, freq=f, t_out=phase[kept])
    peak = np.abs(want.u_gap).max()
    assert np.abs(solution.u_layer[kept] - want.u).max() <= 1e-10 * peak
    assert np.abs(solution.f_el[kept] - want.force).max() <= 1e-10 * want.force.max()
    q = solution.q_source[kept] - solution.q_source[kept][0]
    assert np.abs(q - (want.q - want.q[0])).max() <= 1e-9 * np.abs(want.q - want.q[0]).max()
    assert state.defect <= 1e-11 * 200.0
    assert state.periods <= (12 if shipped else 20)


# The certificate --------------------------------------------------------------------------------------------


@every_law
@pytest.mark.parametrize("name", ["offset", "duty", "AM"])
@pytest.mark.parametrize("rtol", [1e-6, 1e-10])
def test_another_period_by_another_method_changes_no_more_than_the_defect_says(name, law, rtol):
    waveform, _ = SCENES[name]
    circuit = table1().replace({"Vdrive": waveform})
    state = fs.steady_state(circuit, charge_law=law, rtol=rtol)
    solution = state.solution
    stop = solution.state.t + waveform.period
    given = {"charge_law": law, "start": solution, "t_stop": stop, "rtol": 1e-12}
    t = solution.t[1:-1] + waveform.period
    more = fs.simulate(circuit, method="radau", t_eval=t[t <= stop], **given)
    allowed = 2.0 * (state.defect + solution.error.u_gap + more.error.u_gap)
    assert np.abs(more.u_gap - solution.u_gap[1:-1])[alone(solution.t)[1:-1]].max() <= allowed
    assert state.defect <= rtol * 200.0


@pytest.mark.parametrize(("r", "law"), by_turns(["1e6", "1e9", "1e12"]))
def test_the_error_stated_holds_though_a_disturbance_would_outlast_many_periods(r: str, law: str) -> None:
    # What a period's steps miss, a slow mode collects over as many periods as it remembers.
    state = fs.steady_state(table1(coat={"r": r}, gap={"r": r}), charge_law=law, rtol=1e-9)
    phase = (state.solution.t - state.solution.t[0])[:-1]
    segments = ref.sine_segments(200.0, 100.0, 0.01)
    want = ref.periodic_state(segments, law=law, layers=leaking(float(r), float(r)), t_out=phase)
    # A sine's half periods are alike but for the sign, so the mean is zero: what the reference's is not, the same
    # memory has collected from its rounding.
    own = abs(want.u_gap.mean())
    assert own <= 1e-11 * np.abs(want.u_gap).max()
    assert abs(state.solution.u_gap[:-1].mean()) <= state.solution.error.u_gap
    true = np.abs(state.solution.u_gap[:-1] - want.u_gap).max()
    assert true <= state.solution.error.u_gap + own
    assert true <= 1e-9 * np.abs(want.u_gap).max()


def test_a_modulated_carrier_with_a_memory_of_hundreds_of_periods_is_the_reference_s() -> None:
    def source(t: np.ndarray) -> np.ndarray:
        return 100.0 * (1.0 + np.sin(200.0 * np.pi * t)) * np.sin(800.0 * np.pi * t)

    circuit = table1(coat={"r": 2e9}, gap={"r": 1e11}).replace({"Vdrive": fs.AM(200.0, 400.0, 100.0)})
    state = fs.steady_state(circuit, rtol=1e-10, points=40, charge=False)
    assert state.memory > 100.0
    t = np.linspace(0.0, 0.01, 41)[:-1]
    want = ref.periodic_state([(0.0, 0.01, source)], layers=leaking(2e9, 1e11), t_out=t)
    true = np.abs(state.solution.u_gap[:-1] - want.u_gap).max()
    assert true <= min(state.solution.error.u_gap, 1e-10 * np.abs(want.u_gap).max())


@pytest.mark.parametrize("coat", [2e5, 2e9, 1e11])
@pytest.mark.parametrize("gap", [1e11, 1e13])
@pytest.mark.parametrize("source", [fs.AM(200.0, 5000.0, 20.0), fs.Sum((fs.Sine(200.0, 100.0), fs.Sine(100.0, 5e3)))])
def test_two_tones_and_hardly_any_leaks_meet_what_is_asked(source: fs.Waveform, gap: float, coat: float) -> None:
    circuit = table1(coat={"r": coat}, gap={"r": gap}).replace({"Vdrive": source})
    runs = [fs.steady_state(circuit, rtol=rtol, points=40, charge=False).solution for rtol in (1e-10, 1e-8)]
    off = np.abs(runs[0].u_gap - runs[1].u_gap).max()
    assert runs[0].error.u_gap <= 1e-10 * runs[0].u_gap_peak
    assert off <= runs[0].error.u_gap + runs[1].error.u_gap


@lru_cache(None)
def little(r_coat: float, r_gap: float, law: str) -> tuple[np.ndarray, ref.Transient]:
    """Times over the period and the reference's state there, of a gap that nearly shorts itself."""
    t = np.linspace(0.0, 1.0 / 139.0, 60)[:-1]
    segments = ref.sine_segments(150.0, 139.0, 1.0 / 139.0, offset=20.0)
    return t, ref.periodic_state(segments, law=law, layers=leaking(r_coat, r_gap), t_out=t)


@pytest.mark.parametrize(("r", "law"), by_turns([(25e6, 1.7e3), (2e5, 1e3), (5e6, 1e4)]))
@pytest.mark.parametrize("rtol", [1e-5, 1e-10])
@pytest.mark.parametrize("way", ["steady_state", "simulate", "simulate by radau"])
def test_a_gap_that_takes_little_of_the_voltage_has_its_own_error_met(way, rtol, r, law):
    # Of 150 V a few tenths of a volt are left, or one: what is asked is relative to that.
    circuit = table1("SIN(20 150 139)", coat={"r": r[0]}, gap={"r": r[1]})
    t, want = little(*r, law)
    if way == "steady_state":
        run = fs.steady_state(circuit, charge_law=law, rtol=rtol, points=59).solution
    else:
        method = "radau" if way.endswith("radau") else "auto"
        options = {"start": "periodic", "charge_law": law, "rtol": rtol, "method": method}
        run = fs.simulate(circuit, t_eval=t, t_stop=1.0 / 139.0, **options)
    true_u = np.abs(run.u_gap[: t.size] - want.u_gap).max()
    true_f = np.abs(run.f_el[: t.size] - want.force).max()
    assert true_u <= rtol * np.abs(want.u_gap).max()
    assert true_f <= rtol * want.force.max()
    assert true_u <= run.error.u_gap <= rtol * np.abs(run.u_gap).max() * 1.01
    assert true_f <= run.error.f_el <= rtol * run.f_el.max() * 1.01


@every_law
def test_an_error_that_rounding_of_the_source_s_voltage_forbids_is_not_claimed(law: str) -> None:
    # A hundred-thousandth of the 150 V is left across the gap: no double holds it to 1e-13.
    circuit = table1("SIN(20 150 139)", coat={"r": 1e9}, gap={"r": 10.0})
    with pytest.raises(fs.SolveError, match="the error estimate stayed above the error asked for"):
        _ = fs.steady_state(circuit, charge_law=law, rtol=1e-13).solution


@pytest.mark.parametrize(("r", "law"), by_turns(["1e8", "1e9"]))
def test_a_run_from_the_periodic_state_states_the_error_of_its_start_too(r: str, law: str) -> None:
    circuit = table1("SQUARE(60 4k 0.3)", coat={"r": r}, gap={"r": r})
    t = (np.arange(40) + 0.5) / 40.0 / 4e3
    segments = ref.square_segments(60.0, 4e3, 1, duty=0.3)
    want = ref.periodic_state(segments, law=law, layers=leaking(float(r), float(r)), t_out=t).u_gap
    run = fs.simulate(circuit, start="periodic", t_eval=t, t_stop=2.5e-4, charge_law=law, rtol=1e-6)
    true = np.abs(run.u_gap - want).max()
    assert true <= 1e-6 * np.abs(want).max()
    assert true <= run.error.u_gap


@every_law
@pytest.mark.parametrize("f", [10.0, 100.0, 5e3, 1e5])
def test_a_frozen_circuit_has_the_multipliers_of_its_rates(f: float, law: str) -> None:
    circuit = table1(f"SIN(0 200 {f!r})", f)
    state = fs.steady_state(circuit, area=AREA, charge_law=law)
    rates = np.array(fs.plan(circuit, area=AREA, charge_law=law).rates)
    np.testing.assert_allclose(np.sort(state.multipliers)[::-1], np.exp(-rates / f), rtol=0, atol=1e-8)
    assert state.stability_margin == pytest.approx(-math.expm1(-rates[0] / f), rel=1e-7)
    phase = state.solution.t - state.solution.t[0]
    want = ref.periodic_sine_frozen(f, 200.0, AREA, phase)
    assert np.abs(state.solution.u_layer - want).max() <= 1e-12 * 200.0


@every_law
def test_the_multipliers_are_the_eigenvalues_of_the_map_of_one_period(law: str) -> None:
    segments = ref.sine_segments(200.0, 1000.0, 1e-3)
    state = fs.steady_state(table1("SIN(0 200 1k)"), charge_law=law, rtol=1e-9)
    moves = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]]).T * 1e-2

    def end(move: np.ndarray) -> np.ndarray:
        start = state.solution.u_layer[0] + move
        return ref.transient(segments, [], law=law, freq=100.0, start=start, tol=1e-11).steps[-1].u_end

    ends = [0.5 * (end(move) - end(-move)) for move in moves.T]
    slope = np.linalg.lstsq(moves, np.array(ends).T, rcond=None)[0]
    want = np.sort(np.abs(np.linalg.eigvals(slope)))
    np.testing.assert_allclose(np.sort(state.multipliers), want, rtol=0, atol=1e-3)


@pytest.mark.parametrize("start", [0.0, 0.02], ids=["before it settles", "after"])
def test_a_source_that_settles_late_gives_no_output_that_is_not_periodic(start: float) -> None:
    # The sine is held until 12.5 ms: its periodic state exists from 15 ms on, and is asked for from `start` on.
    circuit = table1().replace({"Vdrive": SCENES["delay"][0]})
    t = start + np.linspace(0.0, 0.02, 41)
    try:
        run = fs.simulate(circuit, start="periodic", t_eval=t, t_stop=0.04)
    except fs.InputError:
        assert start == 0.0, "times before 15 ms may be refused, not answered wrongly"
        return
    want = ref.periodic_state(SCENES["delay"][1], freq=100.0, t_out=np.modf((t + 5e-3) / 5e-3)[0] * 5e-3)
    kept = t >= 0.015
    assert np.abs(run.u_layer - want.u)[kept].max() <= 1e-7 * 150.0
    assert np.all(kept), "an output before the periodic state"


@pytest.mark.parametrize("charge", [True, False])
def test_the_area_follows_the_voltage_of_a_source_that_is_held_at_first(charge: bool) -> None:
    # Up to 12.5 ms there is no voltage at all: what a period is worth must not be judged by its first 5 ms.
    circuit = table1().replace({"Vdrive": SCENES["delay"][0]})
    state = fs.steady_state(circuit, rtol=1e-9, charge=charge)
    assert state.solution.plan.tier == "coupled"
    assert state.solution.plan.sensitivity > 0.01
    assert state.solution.circuit["Xgap"].device == "GAP"
    want = ref.area(np.abs(state.solution.u_gap))
    np.testing.assert_allclose(state.solution.area, want, rtol=1e-10)


@every_law
def test_a_stack_without_leaks_is_in_its_periodic_state_from_the_start(law: str) -> None:
    lines = ("X1 in m area LAYER d=1u eps_r=4", "X2 m 0 area LAYER d=3u eps_r=1", "Varea area 0 40")
    state = fs.steady_state(deck("V1 in 0 SIN(3 10 500)", *lines), charge_law=law)
    np.testing.assert_allclose(state.multipliers, 1.0, rtol=0, atol=1e-12)
    assert state.stability_margin == pytest.approx(0.0, abs=1e-12)
    assert state.defect <= 1e-12
    assert state.solution.method == "algebraic"
    share = np.array([0.25e-6, 3e-6]) / 3.25e-6
    np.testing.assert_allclose(state.solution.u_layer, np.outer(state.solution.u_source, share), rtol=0, atol=1e-12)


@every_law
def test_two_layers_without_a_leak_leave_a_direction_that_nothing_decides(law: str) -> None:
    # The charge between coating and gap stays as it was at the start: none.
    state = fs.steady_state(table1("SIN(0 200 100)", coat={"r": "inf"}, gap={"r": "inf"}), charge_law=law, rtol=1e-10)
    assert state.multipliers.max() == pytest.approx(1.0, abs=1e-3)
    assert state.defect <= 1e-10 * 200.0
    plain = ref.table1_layers(100.0)
    coat, gap = state.solution.u_layer[:, 0] * plain[0].c, state.solution.u_layer[:, 1] * plain[1].c
    assert np.abs(coat - gap).max() <= 1e-9 * np.abs(gap).max(), "the same charge on either side of the node"


@pytest.mark.parametrize(
    "waveform",
    [
        fs.DC(100.0),
        fs.Chirp(100.0, 50.0, 500.0, 0.02),
        fs.Exp(0.0, 100.0, 0.0, 1e-3, 5e-3, 1e-3),
        fs.PWL((0.0, 1e-3), (0.0, 10.0)),
        fs.Function(lambda t: 100.0 * np.sin(300.0 * np.asarray(t))),
        fs.Sine(100.0, 100.0) + fs.Sine(50.0, 100.0 * math.sqrt(2.0)),
        fs.Sine(100.0, 100.0, damping=3.0),
    ],
    ids=lambda w: type(w).__name__,
)
def test_a_source_without_a_period_has_no_periodic_state(waveform: fs.Waveform) -> None:
    circuit = table1().replace({"Vdrive": waveform})
    refuses("the source has no period, so there is no periodic state to find", fs.steady_state, circuit)
    refuses("the source has no period", fs.simulate, circuit, start="periodic")


@pytest.mark.parametrize(
    "circuit",
    [
        table1("SIN(0 200 100)", gap={"fn": 1e-4}),
        table1("SIN(0 200 100)", gap={"d": "10n"}),
        table1("SQUARE(200 100)", gap={"d": "10n"}),
        table1("SQUARE(2000 100)"),
        shipped("amplifier").replace({"Xgap.d": 50e-9}),
    ],
)
def test_past_the_fold_there_is_no_periodic_state_and_a_sentence_says_so(circuit: fs.Circuit) -> None:
    text = "no periodic state was reached: the mobile charge law has no solution"
    with pytest.raises(fs.SolveError, match=text) as caught:
        fs.steady_state(circuit, charge_law="mobile")
    assert (caught.value.failure.status, caught.value.failure.element) == (fs.Status.FOLD, "Xgap")


@pytest.mark.parametrize("options", [{"points": 0}, {"rtol": 0.5}, {"rtol": 0.0}])
def test_what_cannot_be_asked_for_is_refused(options: dict[str, Any]) -> None:
    refuses(next(iter(options)), fs.steady_state, table1(), **options)


ALIKE = {
    "sine": fs.Sine(200.0, 300.0, phase_deg=40.0, delay=1e-3),
    "square": fs.Square(200.0, 300.0, phase_deg=70.0),
    "triangle": fs.Triangle(200.0, 300.0),
    "pulse": fs.Pulse(-150.0, 150.0, delay=2e-4, rise=1e-5, fall=1e-5, width=1.99e-3, pulse_period=4e-3),
}
NOT_ALIKE = {
    "offset": fs.Sine(200.0, 300.0, offset=1e-3),
    "duty": fs.Square(200.0, 300.0, duty=0.51),
    "slower fall": fs.Pulse(-150.0, 150.0, rise=1e-5, fall=2e-5, width=1.985e-3, pulse_period=4e-3),
    "unlike levels": fs.Pulse(-150.0, 151.0, rise=1e-5, fall=1e-5, width=1.99e-3, pulse_period=4e-3),
    "sawtooth": fs.Sawtooth(200.0, 300.0),
}


@pytest.mark.parametrize("waveform", [*ALIKE.values(), *NOT_ALIKE.values()], ids=[*ALIKE, *NOT_ALIKE])
def test_half_waves_are_what_their_values_say(waveform: fs.Waveform) -> None:
    t = waveform.settled + waveform.period * (3.0 + np.linspace(0.0, 0.5, 4001)[1:-1])
    alike = np.abs(waveform.value(t + 0.5 * waveform.period) + waveform.value(t)).max() <= 1e-9
    assert waveform.half_wave == alike


HALVED = [
    *(("", waveform, law) for waveform in ALIKE.values() for law in ("local", "mobile")),
    *((name, tone, None) for name in ("amplifier", "ungrounded_user", "two_fingers")
      for tone in (fs.Sine(200.0, 5000.0, phase_deg=30.0), fs.Square(200.0, 5000.0))),
]  # fmt: skip


@pytest.mark.parametrize(("name", "waveform", "law"), HALVED)
def test_a_state_found_by_half_a_period_is_that_of_the_whole_one(name, waveform, law):
    circuit = shipped(name) if name else table1()
    half = fs.steady_state(circuit, sources=waveform, charge_law=law, rtol=1e-10)
    # A product with a constant is a source whose half waves nobody vouches for.
    whole = fs.steady_state(circuit, sources=waveform * 1.0, charge_law=law, rtol=1e-10)
    assert half.periods < whole.periods
    assert np.abs(half.solution.u_layer - whole.solution.u_layer).max() <= 2e-10 * 200.0
    np.testing.assert_allclose(half.multipliers, whole.multipliers, rtol=0, atol=1e-4)


@pytest.mark.parametrize("area", ["coupled", "frozen"])
def test_a_copy_of_a_periodic_state_has_its_multipliers(area: str) -> None:
    state = fs.steady_state(table1(), area=area, rtol=1e-7)
    copied = pickle.loads(pickle.dumps(state))
    np.testing.assert_array_equal(copied.multipliers, state.multipliers)
