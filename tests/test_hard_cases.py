"""The hard cases that have a solution: solved to the requested error, in a bounded number of steps, without a warning.

Long runs and tiny signals, too: no drift, no growth of memory, no underflow. Cases without a solution are in
test_hard_refusals.py. References are independent of the package.
"""

import dataclasses
import itertools
import math
import tracemalloc
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from scenes import by_turns, deck, every_law, table1

T = np.linspace(0.0, 0.0199, 57)
NS = 1e-9
CONTACT = "fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000"


def run(source: Any, law: str = "local", circuit: fs.Circuit | None = None, **options: Any) -> fs.Solution:
    circuit = table1() if circuit is None else circuit
    return fs.simulate(circuit, sources={"Vdrive": source}, charge_law=law, **{"t_stop": 0.02} | options)


def check(solution: fs.Solution, expected: ref.Transient, steps: int, rounded: float = 0.0) -> None:
    """Error within what was asked for and within what is stated, of voltage and force; few steps, little work.

    `rounded` (V) is what rounding of the output times alone makes of the source.
    """
    peak, strongest = np.abs(expected.u_gap).max(), expected.force.max()
    gap, force = np.abs(solution.u_gap - expected.u_gap).max(), np.abs(solution.f_el - expected.force).max()
    assert solution.success
    assert gap <= solution.rtol * peak
    assert gap <= solution.error.u_gap + rounded
    assert force <= solution.rtol * strongest
    assert force <= solution.error.f_el + 2.0 * rounded / peak * strongest
    assert solution.error.u_gap <= 1.001 * solution.rtol * peak
    # What the gap misses is in the other layers too, which share the same states.
    assert np.abs(solution.u_layer - expected.u).max() <= 3.0 * solution.rtol * peak + rounded
    assert solution.stats["steps"] <= steps
    # A step is some iterations of 13 nodes; none gets stuck.
    assert solution.nfev <= 30 * 13 * (solution.stats["steps"] + solution.stats["rejected"])


LEAKS = {
    "R_i = 1 ohm": (1.0, 1e6), "R_i = 1e15": (1e15, 1e6), "R_a = 1e12": (2e5, 1e12),
    "R_i = 1 ohm, R_a = 1e12": (1.0, 1e12), "coating a pure capacitor": (math.inf, 1e6),
    "gap a pure capacitor": (2e5, math.inf), "both pure capacitors": (math.inf, math.inf),
}  # fmt: skip
SHAPES = {
    "sine": (fs.Sine(200.0, 100.0), ref.sine_segments(200.0, 100.0, 0.02)),
    "square": (fs.Square(120.0, 100.0), ref.square_segments(120.0, 100.0, 2)),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("case", "law"), by_turns(LEAKS))
def test_extreme_leaks_are_solved_without_a_step_explosion(case: str, shape: str, law: str) -> None:
    (r_coat, r_gap), (source, segments) = LEAKS[case], SHAPES[shape]
    coat, gap, skin = ref.table1_layers(100.0)
    layers = (dataclasses.replace(coat, r_total=r_coat), dataclasses.replace(gap, r_total=r_gap), skin)
    # No output on a jump: the last time of each half period is just before it.
    t = T + 1e-7
    expected = ref.transient(segments, t, law=law, layers=layers, tol=1e-12, stages=20)
    left_out = {r: None if math.isinf(r) else r for r in (r_coat, r_gap)}
    circuit = table1(coat={"r": left_out[r_coat]}, gap={"r": left_out[r_gap]})
    # A square behind 1 ohm begins every half period with something over in nanoseconds.
    check(run(source, law, circuit, t_eval=t), expected, steps=1000 if r_coat == 1.0 else 100)


@every_law
@pytest.mark.parametrize("method", ["auto", "exponential"])
def test_without_any_resistor_the_stack_is_a_divider(method: str, law: str) -> None:
    # Uncharged and without leaks nothing is stored on the interfaces: u_x = U d_x/eps_x / sum, under both laws.
    circuit = deck(
        "Vdrive drive 0 SIN(0 200 100)",
        "Xcoat drive top area LAYER d=1u eps_r=3.9",
        f"Xgap top skin area GAP d=3.5u eps_r=1 {CONTACT}",
        "Xskin skin 0 area LAYER d=350u eps_r=1000",
    )
    depth = np.array([1e-6 / 3.9, 3.5e-6, 350e-6 / 1000.0])
    u = 200.0 * np.sin(2.0 * math.pi * 100.0 * T)
    solution = fs.simulate(circuit, t_eval=T, t_stop=0.02, charge_law=law, method=method)
    want = u[:, None] * depth / depth.sum()
    assert np.abs(solution.u_layer - want).max() <= 1e-8 * np.abs(want[:, 1]).max()
    force = 8.854e-12 * want[:, 1] ** 2 / (2.0 * 3.5e-6**2) * ref.area(want[:, 1])
    assert np.abs(solution.f_el - force).max() <= 1e-8 * force.max()
    if method == "auto":
        assert solution.method == "algebraic"
        assert solution.nfev == 0
        assert np.abs(solution.u_layer - want).max() <= 1e-14 * 200.0
    else:
        assert solution.stats["steps"] <= 50


JUMPS = {
    "at t = 0": [(0.0, 0.0), (0.0, 120.0), (0.01, -30.0)],
    "at t_stop": [(0.0, 40.0), (0.01, 120.0), (0.01, -80.0), (0.02, -80.0)],
    "at t = 0 and t_stop": [(0.0, 0.0), (0.0, 120.0), (0.01, 60.0), (0.01, -60.0), (0.02, -60.0)],
    "two 1 ns apart": [(0.0, 0.0), (3e-3, 0.0), (3e-3, 150.0), (3e-3 + NS, 150.0), (3e-3 + NS, -50.0), (0.02, -50.0)],
    "on an output time": [(0.0, 0.0), (4e-3, 90.0), (4e-3, -60.0), (0.02, -60.0)],
}


@pytest.mark.parametrize("given", ["outputs of the deck", "outputs asked for"])
@pytest.mark.parametrize(("case", "law"), by_turns(JUMPS))
def test_both_one_sided_values_of_a_jump_are_right(case: str, given: str, law: str) -> None:
    points = JUMPS[case]
    source = fs.PWL(*zip(*points, strict=True))
    times = [t for t, _ in points]
    jumps = np.array(sorted({t for t in times if times.count(t) == 2 and t > 0.0}))
    expected = ref.transient(ref.pwl_segments(points), [], law=law, freq=100.0)
    circuit = table1(tran="100u 10m uic")
    if given == "outputs asked for":
        # A jump asked for by its time has its right-hand value, at the end too; just before it is its left-hand one.
        t = np.unique(np.concatenate([[0.0], jumps, np.linspace(0.0, 0.01, 41)]))
        solution = run(source, law, circuit, t_stop=0.01, t_eval=t)
        check(solution, expected.at(t), steps=60)
        return
    solution = run(source, law, circuit, t_stop=0.01)
    twice = np.flatnonzero(np.diff(solution.t) == 0.0)
    np.testing.assert_allclose(solution.t[twice], jumps, rtol=1e-15)
    left = np.zeros(solution.t.size, bool)
    left[twice] = True
    one, other = expected.at(solution.t[left], side="left"), expected.at(solution.t[~left])
    signals = {name: np.empty((left.size, *getattr(other, name).shape[1:])) for name in ("u", "area", "force", "q")}
    for name, values in signals.items():
        values[left], values[~left] = getattr(one, name), getattr(other, name)
    whole = dataclasses.replace(other, t=solution.t, **signals)
    check(solution, whole, steps=60)
    assert np.abs(solution.q_source - whole.q).max() <= 1e-8 * np.abs(whole.q).max()
    jumped = solution.u_source[twice + 1] - solution.u_source[twice]
    sizes = [b - a for (t, a), (s, b) in itertools.pairwise(points) if t == s > 0.0]
    np.testing.assert_allclose(jumped, sizes, rtol=1e-13)


def pulse(start: float, width: float) -> list[tuple[float, float]]:
    """Corners of a pulse of 200 V with edges of 1 ns, up to 10 ms."""
    rise = [(start, 0.0), (start + NS, 200.0)]
    return [(0.0, 0.0), *rise, (start + NS + width, 200.0), (start + 2.0 * NS + width, 0.0), (0.01, 0.0)]


def around(points: list[tuple[float, float]]) -> np.ndarray:
    """Output times everywhere and inside every edge."""
    inside = [t + x * NS for t, _ in points[1:-1] for x in (-0.5, 0.1, 0.5)]
    return np.unique(np.concatenate([np.linspace(0.0, 9.99e-3, 101), inside]))


# An edge makes 200 V of 1 ns: at 3 ms, rounding of a time is felt.
EDGE_ROUNDED = 2.0 * float(np.spacing(3e-3)) * 200.0 / NS


@pytest.mark.parametrize(("width", "law"), by_turns([NS, 20e-6, 2e-3]))
@pytest.mark.parametrize("kind", ["PWL", "deck"])
def test_declared_edges_of_a_nanosecond_are_not_missed(kind: str, width: float, law: str) -> None:
    points = pulse(3e-3, width)
    t = around(points)
    expected = ref.transient(ref.pwl_segments(points), t, law=law, freq=100.0)
    if kind == "deck":
        solution = fs.simulate(table1(f"PULSE(0 200 3m 1n 1n {width!r} 1)"), t_stop=0.01, t_eval=t, charge_law=law)
    else:
        solution = run(fs.PWL(*zip(*points, strict=True)), law, t_stop=0.01, t_eval=t)
    check(solution, expected, steps=100, rounded=EDGE_ROUNDED)


@every_law
def test_undeclared_edges_of_a_nanosecond_are_found_and_resolved(law: str) -> None:
    points = pulse(3.00123e-3, 2e-3)
    t = around(points)
    expected = ref.transient(ref.pwl_segments(points), t, law=law, freq=100.0)
    with pytest.warns(fs.FingerspiceWarning, match=r"feature narrower than the output step .* near t = 0\.00300123"):
        solution = run(lambda t: np.interp(t, *zip(*points, strict=True)), law, t_stop=0.01, t_eval=t)
    check(solution, expected, steps=1000, rounded=EDGE_ROUNDED)


# 3 ms is where two series of this run meet: their points come no nearer than 0.6 us to such places.
def edge_at_a_cut(t: np.ndarray) -> np.ndarray:
    return np.interp(t, [3e-3, 3e-3 + NS], [0.0, 200.0])


def test_an_undeclared_edge_between_two_series_is_resolved_and_said() -> None:
    t = np.linspace(0.0, 9.99e-3, 101)
    segments = ref.pwl_segments([(0.0, 0.0), (3e-3, 0.0), (3e-3 + NS, 200.0), (0.01, 200.0)])
    expected = ref.transient(segments, t, freq=100.0)
    with pytest.warns(
        fs.FingerspiceWarning, match=r"feature narrower than the output step 1e-05 s near t = 0\.003(0000\d*)? s"
    ):
        solution = run(edge_at_a_cut, t_stop=0.01, t_eval=t)
    off = np.abs(solution.u_gap - expected.u_gap).max()
    assert off <= 1e-8 * np.abs(expected.u_gap).max()
    assert off <= solution.error.u_gap


def test_an_undeclared_pulse_that_outputs_stand_in_is_not_missed_without_a_word() -> None:
    points = pulse(3e-3, NS)
    with pytest.raises(fs.SolveError, match="a feature at this output that its samples missed"):
        run(lambda t: np.interp(t, *zip(*points, strict=True)), t_stop=0.01, t_eval=around(points))


@lru_cache(None)
def two_kilovolt(shape: str, law: str) -> ref.Transient:
    segments = {"sine": ref.sine_segments(2000.0, 100.0, 0.02), "square": ref.square_segments(2000.0, 100.0, 2)}
    return ref.transient(segments[shape], T + 1e-7, law=law, freq=100.0)


@pytest.mark.parametrize(("shape", "law"), [("sine", "local"), ("square", "local"), ("sine", "mobile")])
def test_two_kilovolt_are_solved_and_the_breakdown_of_air_is_warned_about(shape: str, law: str) -> None:
    source = {"sine": fs.Sine(2000.0, 100.0), "square": fs.Square(2000.0, 100.0)}[shape]
    with pytest.warns(fs.FingerspiceWarning) as said:
        solution = run(source, law, t_eval=T + 1e-7)
    # The square leaves a thirtieth of the contact, the sine more than a fifth.
    about = ["air breaks down", "contact area falls to 1.31 mm^2"][: 2 if shape == "square" else 1]
    assert len(said) == len(about)
    for warning, part in zip(said, about, strict=True):
        assert part in str(warning.message)
    check(solution, two_kilovolt(shape, law), steps=200)


@pytest.mark.filterwarnings("ignore:the sources are 0 all the time", "ignore:the source is a function")
@every_law
@pytest.mark.parametrize("source", [fs.DC(0.0), fs.Sine(0.0, 5000.0), fs.Square(0.0, 100.0), lambda t: 0.0 * t])
def test_zero_volt_for_ever_is_exactly_nothing_at_once(source: Any, law: str) -> None:
    solution = run(source, law, t_stop=100.0, t_eval=np.linspace(0.0, 100.0, 11), circuit=table1(tran="1 100 uic"))
    for value in (solution.u_layer, solution.f_el, solution.q_source, solution.i_source):
        assert np.all(value == 0.0)
    # What is left is the load's friction, mu F_N.
    np.testing.assert_allclose(solution.f_t, 0.3 * 0.5, rtol=1e-15)
    assert solution.error.u_gap == 0.0
    assert solution.stats["steps"] <= 100


@every_law
@pytest.mark.parametrize("volt", [1e-12, 1e-150, 1e-300])
def test_next_to_no_voltage_is_the_linear_circuit(volt: float, law: str) -> None:
    # 1e-12 V move the area by 4e-16 of itself. Under 1e-154 V the force is below what a double holds.
    scaled = ref.sine_frozen_from_rest(100.0, 1.0, float(ref.area(0.0)), T, ref.table1_layers(100.0))
    solution = run(fs.Sine(volt, 100.0), law, t_eval=T)
    assert np.abs(solution.u_layer / volt - scaled).max() <= 1e-8 * np.abs(scaled[:, 1]).max()
    force = 8.854e-12 / (2.0 * 3.5e-6**2) * (volt * scaled[:, 1]) ** 2 * float(ref.area(0.0))
    assert np.abs(solution.f_el - force).max() <= 1e-8 * force.max()
    assert solution.stats["steps"] <= 50


@every_law
def test_a_million_time_constants_of_direct_voltage_take_a_few_steps(law: str) -> None:
    # The slowest of Table 1's modes decays within 1 ms.
    early = np.linspace(0.0, 0.01, 21)
    t = np.concatenate([early, np.geomspace(0.02, 1000.0, 11)])
    solution = run(fs.DC(50.0), law, t_stop=1000.0, t_eval=t)
    first = ref.transient([(0.0, 0.02, 50.0)], early, law=law, freq=100.0)
    peak = np.abs(first.u_gap).max()
    assert np.abs(solution.u_layer[:21] - first.u).max() <= 1e-8 * peak
    rest = ref.dc_operating_point(50.0, ref.table1_layers(100.0))
    assert np.abs(solution.u_layer[22:] - rest).max() <= 1e-8 * peak
    assert solution.stats["steps"] <= 50


@every_law
def test_what_decays_for_a_million_time_constants_passes_the_smallest_numbers(law: str) -> None:
    points = [(0.0, 200.0), (1e-3, 200.0), (1e-3, 0.0), (1000.0, 0.0)]
    early = np.linspace(0.0, 0.02, 41) + 1e-7
    late = np.geomspace(0.1, 1000.0, 21)
    solution = run(fs.PWL(*zip(*points, strict=True)), law, t_stop=1000.0, t_eval=np.concatenate([early, late]))
    expected = ref.transient(ref.constant_segments([0.0, 1e-3, 0.03], [200.0, 0.0]), early, law=law, freq=100.0)
    assert np.abs(solution.u_layer[:41] - expected.u).max() <= 1e-8 * np.abs(expected.u_gap).max()
    assert np.abs(solution.u_layer[41:]).max() <= 1e-8 * np.abs(expected.u_gap).max()
    # 1e6 time constants: a step is a hundred of them at least.
    assert solution.stats["steps"] <= 10_000


CYCLES = 100_000
LONG = {
    "sine with offset": (fs.Sine(150.0, 5000.0, offset=40.0), ref.sine_segments(150.0, 5000.0, 2e-4, offset=40.0)),
    "square": (fs.Square(200.0, 5000.0), ref.square_segments(200.0, 5000.0, 1)),
}


@pytest.mark.parametrize(("shape", "method"), [(shape, method) for shape in LONG for method in ("auto", "exponential")])
def test_a_hundred_thousand_cycles_do_not_drift(shape: str, method: str) -> None:
    # With an offset the leaked charges grow for ever, in a direction that no voltage feels.
    source, segments = LONG[shape]
    phase = np.linspace(0.0, 2e-4, 33)[1:-1] + 1e-8
    t = (CYCLES - 1.0) / 5000.0 + phase
    solution = run(source, "local", table1(f=5000.0), t_stop=CYCLES / 5000.0, t_eval=t, rtol=1e-9, method=method)
    want = ref.periodic_state(segments, freq=5000.0, t_out=phase)
    peak = np.abs(want.u_gap).max()
    # The reference's phase is exact, that of the run is rounded at 20 s: 4e-15 s of the steepest change.
    rounded = 4e-15 * 2.0 * math.pi * 5000.0 * 190.0
    assert np.abs(solution.u_layer - want.u).max() <= 1e-9 * peak + rounded
    assert solution.error.u_gap <= 1e-9 * peak * 1.001
    # The charge that every cycle sends through goes on being what it is in one.
    swing = want.q[1:] - want.q[:-1]
    lost = 4.0 * np.spacing(np.abs(solution.q_source).max())
    assert np.abs(np.diff(solution.q_source) - swing).max() <= 2e-9 * np.abs(swing).max() + lost
    assert solution.stats["steps"] <= 8 * CYCLES


@pytest.mark.parametrize(("shape", "law"), by_turns(LONG))
def test_ten_million_cycles_end_like_the_first_settled_one(shape: str, law: str) -> None:
    source, segments = LONG[shape]
    cycles = 100 * CYCLES
    phase = np.linspace(0.0, 2e-4, 33)[1:-1] + 1e-8
    t = (cycles - 1.0) / 5000.0 + phase
    solution = run(source, law, table1(f=5000.0), t_stop=cycles / 5000.0, t_eval=t, rtol=1e-6)
    want = ref.periodic_state(segments, freq=5000.0, t_out=phase, law=law)
    peak = np.abs(want.u_gap).max()
    # 2000 s are known to 2e-13 s.
    rounded = 4e-13 * 2.0 * math.pi * 5000.0 * 190.0
    assert np.abs(solution.u_layer - want.u).max() <= 1e-6 * peak + rounded
    assert solution.stats["steps"] <= 2000


@pytest.mark.parametrize("source", [fs.Sine(200.0, 5000.0), fs.Square(200.0, 5000.0)], ids=["sine", "square"])
def test_ten_million_cycles_need_no_more_memory_than_a_thousand(source: fs.Waveform) -> None:
    peaks = []
    for cycles in (1000, 100 * CYCLES):
        t = (cycles - 1.0) / 5000.0 + np.linspace(0.0, 2e-4, 33)
        tracemalloc.start()
        run(source, circuit=table1(f=5000.0), t_stop=cycles / 5000.0, t_eval=t, rtol=1e-4)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # One window of the source's edges.
    assert peaks[1] <= 1.1 * peaks[0] + 5e6


@every_law
def test_an_amplitude_that_jumps_up_and_down_inside_one_carrier_cycle(law: str) -> None:
    cycle, on, off = 2e-4, 1.3 * 2e-4, 1.8 * 2e-4
    burst = ref.sine_segments(200.0, 5000.0, off, t_start=on)[0]
    segments = [(0.0, on, 0.0), burst, (off, 6.0 * cycle, 0.0)]
    gate = fs.PWL((0.0, on, on, off, off), (0.0, 0.0, 1.0, 1.0, 0.0))
    source = fs.Sine(200.0, 5000.0) * gate
    t = np.linspace(0.0, 5.9 * cycle, 131)
    expected = ref.transient(segments, t, law=law, freq=5000.0)
    check(run(source, law, table1(f=5000.0), t_eval=t, t_stop=6.0 * cycle), expected, steps=60)
    # The burst begins and ends with a jump, neither of them on the other half wave's zero.
    assert abs(float(burst[2](np.float64(on)))) > 150.0
    assert abs(float(burst[2](np.float64(off)))) > 150.0


def fast_and_slow(t: np.ndarray) -> np.ndarray:
    """Carrier of 20 kHz under an envelope of 1 Hz, 200 V at most, V."""
    return 100.0 * (1.0 + np.sin(2.0 * np.pi * t)) * np.sin(2.0 * np.pi * 20e3 * t)


def test_a_carrier_of_20_khz_under_an_envelope_of_1_hz() -> None:
    begin, top, still = (np.linspace(a, a + 2e-4, 21) for a in (0.0, 0.2498, 0.7498))
    circuit = table1(f=20e3)
    solution = run(fs.AM(200.0, 20e3, 1.0), circuit=circuit, t_stop=1.0, t_eval=np.concatenate([begin, top, still]))
    first = ref.transient([(0.0, 2.1e-4, fast_and_slow)], begin, freq=20e3)
    # What was 5 ms ago is felt by less than a tenth of the error asked for; where the envelope is 0, still less.
    late = {"freq": 20e3, "tol": 1e-12, "stages": 20}
    high = ref.transient([(0.245, 0.25001, fast_and_slow)], top, **late)
    other = ref.transient([(0.245, 0.25001, fast_and_slow)], top, start=[50.0, -50.0, 0.0], **late | {"tol": 1e-10})
    peak = np.abs(high.u_gap).max()
    assert np.abs(high.u - other.u).max() <= 1e-9 * peak
    low = ref.transient([(0.748, 0.75001, fast_and_slow)], still, **late)
    expected = np.concatenate([first.u, high.u, low.u])
    # The two write the carrier's phase differently: roundings of 1e5 rad.
    rounded = 200.0 * 2.0 * np.spacing(2.0 * np.pi * 20e3)
    assert np.abs(solution.u_layer - expected).max() <= 1e-8 * peak + rounded
    assert solution.error.u_gap <= 1.001e-8 * peak
    assert solution.stats["steps"] <= 5 * 20_000


# A fast mode behind the kink: a decay of a hundredth of a step, or a zero that is soon taken back ---------------

HIDDEN = {
    "decay": (851.0, fs.Sine(25.27, 851.0, offset=7.7), {"Xcoat.r": 1817.0, "Xgap.r": 4.6e8, "Xgap.d": 1.3865e-5}),
    "zeros": (
        1406.0,
        fs.Sine(36.55, 1406.0) + fs.Sine(21.93, 2812.0),
        {"Xcoat.r": 36973.62608915747, "Xgap.r": 697266.7456424526, "Xgap.d": 6.889344375310366e-06},
    ),
}


def hidden(case: str, law: str, **options: Any) -> fs.Solution:
    """A late stretch of a scene, looked at closely."""
    f, source, changes = HIDDEN[case]
    t = np.linspace(78.0 / f, 81.0 / f, 20_001)[1:-1]
    circuit = table1().replace({"Vdrive": source, **changes})
    return fs.simulate(circuit, t_stop=81.0 / f, t_eval=t, charge_law=law, charge=False, **options)


@lru_cache(None)
def stepped_otherwise(case: str, law: str) -> fs.Solution:
    """The same by Radau collocation, which sees every zero by other means."""
    return hidden(case, law, rtol=1e-11, method="radau")


@pytest.mark.parametrize("rtol", [1e-5, 1e-7, 1e-9])
@pytest.mark.parametrize(("case", "law"), by_turns(HIDDEN))
def test_nothing_hides_between_the_nodes_of_a_step(case: str, law: str, rtol: float) -> None:
    solution, other = hidden(case, law, rtol=rtol), stepped_otherwise(case, law)
    peak = np.abs(other.u_gap).max()
    off = np.abs(solution.u_gap - other.u_gap).max()
    assert off <= solution.error.u_gap + other.error.u_gap
    assert off <= rtol * peak
    assert np.abs(solution.area / other.area - 1.0).max() <= 10.0 * rtol
