"""The exponential method on stacks: events at which steps must end, and runs against `analytic.py`."""

import math
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from fingerspice.numerics.lobatto import NODES
from fingerspice.solve.collocation import Track
from fingerspice.solve.problem import Tables, prepare
from fingerspice.solve.runs import integrate
from scenes import CIRCUITS, by_turns, cases, every_law, table1

# Fast enough that a step long against a period is short against the decays, and the gap voltage never changes sign.
F = 20e3
PHASES = 0.1 + 2.0 * math.pi * np.arange(16) / 16


def errors_of_one_step(amplitude: float, offset: float, phase: float, h: float, law: str) -> tuple[float, float]:
    """Error in the layer voltages over the amplitude, at the end of a single step from rest and inside it."""
    waveform = fs.Sine(amplitude, F, offset=offset, phase_deg=math.degrees(phase))
    circuit = table1(f=F).replace({"Vdrive": waveform})
    problem = prepare(circuit, t_stop=h, t_eval=None, charge_law=law, area="coupled", start="uncharged")
    t = np.append(np.linspace(0.0, h, 201)[1:-1], h)
    left = np.append(np.zeros(199, bool), True)
    exact = ref.transient(ref.sine_segments(amplitude, F, h, phase=phase, offset=offset), t[:-1], freq=F, law=law)
    u = np.vstack([exact.u, exact.at([h], side="left").u])
    problem = problem.at(t, left)
    one = Track(problem, 1e-13, 1e-13)
    one.pace = one.pace._replace(h_max=h, controlled=False)
    run = integrate(one, Tables(problem, 1e-13))
    assert run.stats["steps"] == 1
    miss = np.abs(run.record(problem).u_layer - u).max(axis=1) / amplitude
    return float(miss[-1]), float(miss.max())


@lru_cache(None)
def errors(amplitude: float, offset: float, law: str, turns: tuple[float, ...]) -> np.ndarray:
    """Rms over the phases, shape (len(turns), 2): at the end of a step of that many periods, and inside it."""
    out = [[errors_of_one_step(amplitude, offset, p, x / F, law) for x in turns] for p in PHASES]
    return np.asarray(np.sqrt(np.mean(np.square(out), axis=0)))


@every_law
def test_the_inside_of_a_step_converges_with_the_number_of_its_nodes(law: str) -> None:
    turns = tuple(np.geomspace(0.33, 0.8, 8))
    e, h = errors(20.0, 180.0, law, turns)[:, 1], np.array(turns)
    kept = (e > 5e-14) & (e < 1e-8)
    assert kept.sum() >= 6
    # The error of a sine's interpolation is C h^n (1 + c h^2 + ...), n the number of nodes.
    matrix = np.column_stack([np.ones(kept.sum()), np.log(h[kept]), h[kept] ** 2])
    order = np.linalg.lstsq(matrix, np.log(e[kept]), rcond=None)[0][1]
    assert order == pytest.approx(NODES, abs=0.2)


@every_law
def test_the_end_of_a_step_converges_faster_than_its_inside(law: str) -> None:
    # In the limit with 2 n - 1 in one step, as Lobatto's rule does; that limit is below rounding. At the lengths
    # whose error a double can hold, harmonics of the area's curve keep it at 19.
    turns = (0.6, 0.63, 0.66, 0.69, 0.72)
    e = errors(60.0, 150.0, law, turns)
    order = np.polyfit(np.log(turns), np.log(e), 1)[0]
    assert order[0] == pytest.approx(19.1, abs=0.5)
    assert np.all(e[:, 0] < 1e-3 * e[:, 1])


SOURCES = {
    "sine": fs.Sine(200.0, 100.0),
    "square": fs.Square(180.0, 100.0, duty=0.3),
    "AM": fs.AM(200.0, 1000.0, 100.0),
    "function": fs.Function(lambda t: 150.0 * np.sin(2e3 * t) + 20.0, repeat=math.pi * 1e-3),
}


def run(source: fs.Waveform, law: str, **options: Any) -> fs.Solution:
    return fs.simulate(table1(), **{"sources": {"Vdrive": source}, "charge_law": law, "t_stop": 0.02} | options)


@every_law
def test_every_zero_of_the_gap_voltage_ends_a_step(law: str) -> None:
    segments = ref.sine_segments(200.0, 100.0, 0.03)
    expected = ref.transient(segments, [], law=law, freq=100.0)
    solution = run(fs.Sine(200.0, 100.0), law, t_stop=0.03, rtol=1e-12, t_eval=np.array(expected.zeros))
    inside = [z for z in expected.zeros if 0.0 < z < 0.03]
    assert len(inside) == 6
    assert solution.stats["zeros"] == len(inside)
    assert np.abs(solution.u_gap).max() <= 1e-11 * 200.0


@pytest.mark.parametrize("offset", [0.0, 1e-9, -1e-9])
def test_a_gap_voltage_that_only_touches_zero_is_passed(offset: float) -> None:
    source = fs.Sine(1.0, 5000.0, offset=1.0 + offset, phase_deg=-90.0) * fs.Sine(100.0, 500.0, phase_deg=90.0)
    t = np.linspace(0.0, 4e-3, 201)
    solution = run(source, "local", t_stop=4e-3, t_eval=t, rtol=1e-10)
    other = run(source, "local", t_stop=4e-3, t_eval=t, rtol=1e-10, method="radau")
    assert solution.success
    assert np.abs(solution.u_gap - other.u_gap).max() <= solution.error.u_gap + other.error.u_gap


@pytest.mark.parametrize("longest", [1e-3, 2.3e-4, 1e-5])
def test_no_step_is_longer_than_the_decks_tmax(longest: float) -> None:
    free = fs.simulate(table1("DC 50", tran="1m 20m uic"), rtol=1e-6)
    bound = fs.simulate(table1("DC 50", tran=f"1m 20m 0 {longest!r} uic"), rtol=1e-6)
    assert free.stats["steps"] < 0.02 / longest
    assert bound.stats["steps"] >= 0.02 / longest
    assert bound.stats["steps"] <= 1.2 * 0.02 / longest + 20
    assert np.abs(bound.u_gap - free.u_gap).max() <= 2e-6 * 50.0


@pytest.mark.parametrize(("r_coat", "law"), by_turns(["1e-6", "1e-3", "1", "1k", "1e9", "1e15", "inf"]))
def test_a_coating_may_be_anything_from_a_wire_to_a_perfect_insulator(r_coat: str, law: str) -> None:
    t = np.linspace(0.0, 0.0199, 57)
    plain = ref.table1_layers(100.0)
    layers = (ref.Layer(plain[0].c, r_total=float(r_coat.replace("k", "e3"))), *plain[1:])
    expected = ref.transient(ref.sine_segments(200.0, 100.0, 0.02), t, law=law, layers=layers)
    solution = fs.simulate(table1(coat={"r": r_coat}), t_eval=t, t_stop=0.02, charge_law=law, rtol=1e-11)
    assert np.abs(solution.u_layer - expected.u).max() <= 1e-11 * np.abs(expected.u_gap).max()
    assert solution.stats["steps"] < 5000


CHARGED_T = np.linspace(1e-5, 1 / 150.0 - 1e-5, 71)
CHARGED = {
    "sine": (fs.Sine(120.0, 300.0, offset=25.0), ref.sine_segments(120.0, 300.0, 1 / 150.0, offset=25.0)),
    "square": (fs.Square(100.0, 300.0, duty=0.3), ref.square_segments(100.0, 300.0, 2, duty=0.3)),
}


@lru_cache(None)
def charged(shape: str, layers: tuple[ref.Layer, ...], law: str) -> ref.Transient:
    return ref.transient(CHARGED[shape][1], CHARGED_T, law=law, layers=layers, stages=16, tol=1e-13)


# Resistances of coating and gap, tolerances, and what the charge may be off and be said to be off, over the tolerance:
# as exact as the voltages; and layers that leak fast and slowly, in every order, where what is off may stay or decay.
LEAKS = [
    *((r_coat, r_gap, rtol, 1.0, math.inf) for r_gap in (1e6, 1e10) for r_coat in (3.0, 1e3, 2e5)
      for rtol in (1e-4, 1e-8, 1e-11)),
    *((*both, rtol, 10.0, 10.0) for both in ((1e3, 2e3), (3.0, 2e4), (1e6, 2e6), (3e7, 4e9)) for rtol in (1e-4, 1e-8)),
]  # fmt: skip

# The suite has each of them with either source, and with either law.
CHARGES = [
    (*leak, shape, law)
    for i, leak in enumerate(LEAKS) for shape in CHARGED for law in ("local", "mobile")
    if cases(1, 0) or (shape == "sine") == ((law == "local") == (i % 2 == 0))
]  # fmt: skip


@pytest.mark.parametrize(("r_coat", "r_gap", "rtol", "off", "said", "shape", "law"), CHARGES)
def test_the_charge_is_as_exact_as_its_error_says_whatever_the_leaks(r_coat, r_gap, rtol, off, said, shape, law):
    plain, peak = ref.table1_layers(100.0), lambda x: np.abs(x).max()
    layers = (ref.Layer(plain[0].c, r_total=r_coat), ref.Layer(plain[1].c, r_total=r_gap), plain[2])
    expected = charged(shape, layers, law)
    solution = fs.simulate(
        table1(coat={"r": r_coat}, gap={"r": r_gap}), sources=CHARGED[shape][0], t_eval=CHARGED_T, t_stop=1 / 150.0,
        charge_law=law, rtol=rtol,
    )  # fmt: skip
    assert peak(solution.u_gap - expected.u_gap) <= rtol * peak(expected.u_gap)
    true = peak(solution.q_source - expected.q)
    assert true <= off * rtol * peak(expected.q)
    assert true <= solution.error.q_source <= said * rtol * peak(expected.q)


def test_only_a_charge_that_was_followed_step_by_step_has_an_error_stated() -> None:
    circuit = table1()
    given = {"t_stop": 0.01, "rtol": 1e-6}
    assert fs.simulate(circuit, **given).error.q_source > 0.0
    assert fs.simulate(circuit, charge=False, **given).error.q_source is None
    assert fs.simulate(circuit, method="scipy:DOP853", **given).error.q_source is None
    assert fs.simulate(circuit, start="periodic", **given).error.q_source is None


# Between jumps of the square, and at either of them.
CUTS = [("sine", 0.0063), ("square", 0.0063), ("square", 0.01), ("square", 0.013), ("AM", 0.01), ("function", 0.013)]


@every_law
@pytest.mark.parametrize(("name", "cut"), CUTS)
def test_a_run_goes_on_from_where_another_stopped(name: str, cut: float, law: str) -> None:
    source = SOURCES[name]
    t = np.linspace(0.0, 0.02, 201)
    whole = run(source, law, t_eval=t, rtol=1e-12)
    first = run(source, law, t_stop=cut, rtol=1e-12)
    later = t >= cut
    second = run(source, law, start=first, t_eval=t[later], rtol=1e-12)
    assert second.t[0] >= cut
    assert np.abs(second.u_layer - whole.u_layer[later]).max() <= 1e-10 * 200.0
    assert np.abs(second.q_source - whole.q_source[later]).max() <= 1e-10 * np.abs(whole.q_source).max()
    assert np.abs(second.i_source - whole.i_source[later]).max() <= 1e-9 * np.abs(whole.i_source).max()
    again = run(source, law, t_stop=0.02, rtol=1e-12, start=run(source, law, t_stop=0.015, start=first, rtol=1e-12))
    assert np.abs(again.u_layer[-1] - whole.u_layer[-1]).max() <= 1e-10 * 200.0
    assert abs(again.q_source[-1] - whole.q_source[-1]) <= 1e-10 * np.abs(whole.q_source).max()


def test_a_start_from_another_stack_or_law_is_refused() -> None:
    first = run(SOURCES["sine"], "local")
    with pytest.raises(fs.InputError, match=r"the solution to start from has layers .* and the local law"):
        run(SOURCES["sine"], "mobile", start=first, t_stop=0.03)


def test_a_gap_voltage_at_the_end_of_the_areas_curve_is_not_crept_up_to() -> None:
    # The jump takes the gap to 219.4 V, the very end of the curve prepared for this source.
    circuit = table1(coat={"r": 1.648}, gap={"r": 20016.0}).replace(
        {"Vdrive": fs.Square(112.504, 215.957, duty=0.46255)}
    )
    run = fs.simulate(circuit, t_stop=5e-3, rtol=1e-11, charge_law="mobile")
    assert run.stats["steps"] + run.stats["rejected"] < 3000


CHIRP_T = 0.01


def chirp_segments() -> list[Any]:
    rate = (2000.0 - 50.0) / CHIRP_T

    def phase(t: np.ndarray) -> np.ndarray:
        return 2.0 * math.pi * (50.0 + 0.5 * rate * t) * t

    return [(0.0, CHIRP_T, lambda t: 150.0 * np.sin(phase(t)))]


POINTS = [(0.0, 20.0), (2e-3, 150.0), (2e-3, -120.0), (5e-3, -40.0), (7e-3, 90.0), (7.3e-3, -60.0), (12e-3, -60.0)]
BIASED = fs.Sine(150.0, 5000.0, offset=40.0, phase_deg=30.0)
SCENES = {
    "sine 100 Hz": (fs.Sine(200.0, 100.0), ref.sine_segments(200.0, 100.0, 0.03), 100.0),
    "sine 5 kHz with offset": (BIASED, ref.sine_segments(150.0, 5000.0, 2e-3, phase=math.pi / 6, offset=40.0), 5000.0),
    "square 100 Hz": (fs.Square(200.0, 100.0), ref.square_segments(200.0, 100.0, 3), 100.0),
    "square 5 kHz, duty 0.3": (fs.Square(200.0, 5000.0, 0.3), ref.square_segments(200.0, 5000.0, 4, duty=0.3), 5000.0),
    "chirp 50 Hz to 2 kHz": (fs.Chirp(150.0, 50.0, 2000.0, CHIRP_T), chirp_segments(), 500.0),
    "PWL with a jump": (fs.PWL(*zip(*POINTS, strict=True)), ref.pwl_segments(POINTS), 100.0),
}


def output_times(segments: list[Any]) -> np.ndarray:
    # Off the grid of periods, plus both sides of every jump (whose own time the two sides round differently).
    end = segments[-1][1]
    edges = np.array([s[0] for s in segments[1:]])
    grid = np.linspace(0.0, end, 301)[:-1] + 1e-3 * end / 301.0
    return np.unique(np.concatenate([[0.0], grid, edges - 1e-12, edges + 1e-12]))


RESPONSES: dict[str, tuple[fs.Circuit, list[Any], dict[str, Any]]] = {
    name: (table1(f=f).replace({"Vdrive": wave}), segments, {"freq": f}) for name, (wave, segments, f) in SCENES.items()
} | {
    "from the operating point": (
        table1("SIN(80 100 100)", tran="10u 20m"), ref.sine_segments(100.0, 100.0, 0.02, offset=80.0),
        {"freq": 100.0, "start": "dc"},
    ),
    "work of adhesion at total voltage held": (
        table1(extra=".options work=total"), ref.sine_segments(200.0, 100.0, 0.02),
        {"freq": 100.0, "k": ref.work_factor(100.0)},
    ),
}  # fmt: skip


@every_law
@pytest.mark.parametrize("scene", RESPONSES)
def test_coupled_response_equals_the_reference_to_1e_9(scene: str, law: str) -> None:
    circuit, segments, how = RESPONSES[scene]
    t = output_times(segments)
    expected = ref.transient(segments, t, law=law, **how)
    given = {"t_eval": t, "t_stop": segments[-1][1], "charge_law": law, "rtol": 1e-10}
    solution = fs.simulate(circuit, **given)
    peak_u, peak_f = np.abs(expected.u_gap).max(), expected.force.max()
    assert expected.fold is None
    assert np.abs(solution.u_layer - expected.u).max() <= 1e-9 * peak_u
    assert np.abs(solution.f_el - expected.force).max() <= 1e-9 * peak_f
    np.testing.assert_allclose(solution.area, expected.area, rtol=1e-9)
    assert np.abs(solution.q_source - expected.q).max() <= 1e-9 * np.abs(expected.q).max()
    assert solution.error.u_gap <= 1e-10 * np.abs(solution.u_gap).max() * 1.001
    if circuit.work == "total":
        assert np.abs(solution.u_gap - fs.simulate(table1(), **given).u_gap).max() > 1e-5 * peak_u
    if scene == "sine 100 Hz":
        slope = 200.0 * 200.0 * math.pi * np.cos(200.0 * math.pi * t)
        current = np.array([expected.current(x, dx) for x, dx in zip(t, slope, strict=True)])
        assert np.abs(solution.i_source - current).max() <= 1e-8 * np.abs(current).max()


@pytest.mark.parametrize("deck", ["fingerpad.cir", "amplifier.cir"])
@pytest.mark.parametrize("options", [{}, {"area": "frozen"}, {"method": "radau"}, {"charge_law": "mobile"}], ids=str)
@pytest.mark.parametrize("periods", [3, 7])
def test_a_run_that_ends_at_a_jump_but_for_rounding_ends_after_it(deck, options, periods):
    # Three periods of 0.2 ms are 0.6000000000000001 ms: the source is past its jump there, and so is the gap.
    circuit = fs.read_netlist(CIRCUITS / deck).replace({"Vdrive": fs.Square(200.0, 5000.0)})
    stop = periods * 2e-4
    for t in (np.linspace(0.0, stop, 31), np.array([0.0, periods * 0.2 / 1000.0])):
        short = fs.simulate(circuit, t_stop=max(stop, t[-1]), t_eval=t, rtol=1e-6, **options)
        longer = fs.simulate(circuit, t_stop=stop + 1e-5, t_eval=t, rtol=1e-6, **options)
        assert short.u_source[-1] == longer.u_source[-1] == 200.0
        assert abs(short.u_gap[-1] - longer.u_gap[-1]) <= 2e-6 * np.abs(longer.u_gap).max()


@every_law
def test_a_gap_behind_an_insulating_coating_rests_at_zero_volt(law: str) -> None:
    # At DC the coating takes it all: what is left in the gap is the rounding of 100 V.
    circuit = table1().replace({"Vdrive": fs.DC(100.0), "Xcoat.r": math.inf})
    with pytest.warns(fs.FingerspiceWarning, match="no more than rounding of the source's voltage"):
        solution = fs.simulate(circuit, t_stop=0.01, start="dc", charge_law=law)
    assert np.abs(solution.u_gap).max() <= 1e-12
    assert solution.error.u_gap >= np.abs(solution.u_gap).max()


@every_law
def test_a_run_may_start_from_a_gap_at_rest_behind_an_insulating_coating(law: str) -> None:
    circuit = table1().replace({"Vdrive": fs.Sine(50.0, 100.0, offset=100.0), "Xcoat.r": math.inf})
    t = np.linspace(0.0, 0.01, 101)[:-1]
    solution = fs.simulate(circuit, t_eval=t, t_stop=0.01, start="dc", charge_law=law)
    assert abs(solution.u_gap[0]) <= 1e-12
    # The offset stands on the coating alone.
    coat, *others = ref.table1_layers(100.0)
    segments = ref.sine_segments(50.0, 100.0, 0.01, offset=100.0)
    expected = ref.transient(segments, t, law=law, layers=(ref.Layer(coat.c), *others), start=[100.0, 0.0, 0.0])
    assert np.abs(solution.u_layer - expected.u).max() <= 1e-8 * np.abs(expected.u_gap).max()
    assert np.abs(solution.f_el - expected.force).max() <= 1e-8 * expected.force.max()
