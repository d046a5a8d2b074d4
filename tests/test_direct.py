"""The tiers without time steps, linear and algebraic, against closed forms and the independent reference.

Also what they make of samples: the response of linear modes, against extended precision, mpmath and ramps.
"""

import itertools
import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from scipy.signal import lfilter

import analytic as ref
import fingerspice as fs
from fingerspice.numerics.linear import first_order_hold
from fingerspice.solve import closed_form
from scenes import by_turns, cases, deck, every_law, refuses, table1

AREA = 34.9715871843e-6
F = 100.0


def linear(source: fs.Waveform | str, t: np.ndarray, stop: float, f: float = F, **options: Any) -> fs.Solution:
    circuit = table1(source, f) if isinstance(source, str) else table1(f=f).replace({"Vdrive": source})
    solution = fs.simulate(circuit, **({"t_eval": t, "t_stop": stop, "area": AREA} | options))
    assert (solution.plan.tier, solution.method, solution.nfev) == ("linear", "linear", 0)
    assert solution.success
    return solution


@every_law
@pytest.mark.parametrize("f", [10.0, 100.0, 5e3, 1e5])
@pytest.mark.parametrize("phase", [0.0, 1.1])
def test_a_sine_from_rest_is_its_phasor_and_what_decays(f: float, phase: float, law: str) -> None:
    t = np.linspace(0.0, 2.5 / f, 67)
    expected = ref.sine_frozen_from_rest(f, 200.0, AREA, t, ref.table1_layers(f), phase=phase)
    source = fs.Sine(200.0, f, phase_deg=math.degrees(phase))
    solution = linear(source, t, 2.5 / f, f, charge_law=law)
    assert np.abs(solution.u_layer - expected).max() <= 1e-12 * 200.0
    assert solution.error.u_gap <= 1e-12 * 200.0


# Whole periods of the settled state: 45 time constants of the slowest mode, 1.1 kHz at least; and a hundred thousand.
@pytest.mark.parametrize(("f", "first"), [(10.0, 1), (100.0, 5), (5e3, 250), (5e3, 99_999), (1e5, 5000)])
def test_a_sine_settles_at_equation_11(f: float, first: int) -> None:
    t = (first + np.linspace(0.0, 1.0, 41)) / f
    solution = linear(f"SIN(0 200 {f!r})", t, (first + 1.0) / f, f)
    expected = ref.periodic_sine_frozen(f, 200.0, AREA, within_a_period(t, f))
    rounded_phase = float(2.0 * math.pi * np.spacing(f * t.max()))
    assert np.abs(solution.u_layer - expected).max() <= (1e-12 + rounded_phase) * 200.0


def within_a_period(t: np.ndarray, f: float) -> np.ndarray:
    """Times since the last whole period, without the rounding of a long phase."""
    return np.array([float((Fraction(float(x)) * Fraction(f)) % 1) / f for x in t])


@every_law
@pytest.mark.parametrize(("f", "duty"), [(100.0, 0.5), (5000.0, 0.3)])
def test_a_square_is_its_matrix_exponential_on_both_sides_of_every_jump(f: float, duty: float, law: str) -> None:
    edges, levels = [0.0], []
    for k in range(4):
        edges += [(k + duty) / f, (k + 1.0) / f]
        levels += [200.0, -200.0]
    solution = fs.simulate(table1(f"SQUARE(200 {f!r} {duty!r})", f), t_stop=4.0 / f, area=AREA, charge_law=law)
    assert solution.method == "linear"
    layers = ref.table1_layers(f)
    jump = np.flatnonzero(np.diff(solution.t) == 0.0)
    assert jump.size == 8
    np.testing.assert_allclose(solution.t[jump], edges[1:], rtol=1e-14)
    # Levels as they are just before, and just after, each edge.
    before = [
        ref.piecewise_constant_frozen(edges[: i + 2], levels[: i + 1], [edges[i + 1]], AREA, layers)[0]
        for i in range(8)
    ]
    divider = 1.0 / np.array([x.c for x in layers])
    divider /= divider.sum()
    assert np.abs(solution.u_layer[jump] - before).max() <= 1e-12 * 200.0
    change = np.array([-2.0 * level for level in levels])
    assert np.abs(solution.u_layer[jump + 1] - before - change[:, None] * divider).max() <= 1e-12 * 200.0
    inside = np.setdiff1d(np.arange(0, solution.t.size, 97), [*jump, *(jump + 1)])
    expected = ref.piecewise_constant_frozen(edges, levels, solution.t[inside], AREA, layers)
    assert np.abs(solution.u_layer[inside] - expected).max() <= 1e-12 * 200.0


def smooth(stop: float, u: Callable[[np.ndarray], np.ndarray], *cuts: float) -> list[tuple[Any, ...]]:
    edges = [0.0, *cuts, stop]
    return [(a, b, u) for a, b in itertools.pairwise(edges)]


def chirp(t: np.ndarray) -> np.ndarray:
    return 150.0 * np.sin(2.0 * math.pi * (50.0 + 0.5 * 1950.0 / 0.02 * t) * t)


def envelope(t: np.ndarray) -> np.ndarray:
    return 120.0 * (1.0 + 0.8 * np.sin(200.0 * math.pi * t)) / 1.8 * np.sin(2000.0 * math.pi * t)


def rise(t: np.ndarray) -> np.ndarray:
    up = -np.expm1(-np.maximum(t - 1e-3, 0.0) / 4e-4)
    down = -np.expm1(-np.maximum(t - 6e-3, 0.0) / 3e-3)
    return 10.0 + 140.0 * (up - down)


def bell(t: np.ndarray) -> np.ndarray:
    return 100.0 / (1.0 + (np.asarray(t) - 8e-3) ** 2 / 1e-6) + 20.0 * np.cos(900.0 * np.asarray(t))


POINTS = [(0.0, 20.0), (2e-3, 150.0), (2e-3, -120.0), (5e-3, -40.0), (7e-3, 90.0), (7.3e-3, -60.0), (15e-3, -60.0)]
SCENES = {
    "chirp": (fs.Chirp(150.0, 50.0, 2000.0, 0.02), smooth(0.02, chirp), 0.02),
    "AM": (fs.AM(120.0, 1000.0, 100.0, depth=0.8), smooth(0.012, envelope), 0.012),
    "Exp": (fs.Exp(10.0, 150.0, 1e-3, 4e-4, 6e-3, 3e-3), smooth(0.015, rise, 1e-3, 6e-3), 0.015),
    "PWL": (fs.PWL(*zip(*POINTS, strict=True)), ref.pwl_segments(POINTS), 0.015),
    "function": (fs.Function(bell), smooth(0.015, bell), 0.015),
    "sum": (
        fs.Sine(80.0, 300.0) + fs.Square(40.0, 100.0),
        [
            (a, min(b, 0.012), lambda t, x=x: 80.0 * np.sin(600.0 * math.pi * np.asarray(t)) + x(t))
            for a, b, x in ref.square_segments(40.0, 100.0, 2)[:3]
        ],
        0.012,
    ),
}


@pytest.mark.parametrize(("name", "law"), by_turns(SCENES))
def test_any_source_gives_the_reference_s_voltages_charge_and_current(name: str, law: str) -> None:
    source, segments, stop = SCENES[name]
    t = np.sort(np.append(np.random.default_rng(2).uniform(0.0, stop, 80), [0.0, 0.999 * stop]))
    expected = ref.transient(segments, t, freq=F, law=law, area_mode=AREA)
    solution = linear(source, t, stop, charge_law=law)
    peak = np.abs(expected.u).sum(axis=1).max()
    assert np.abs(solution.u_layer - expected.u).max() <= 1e-11 * peak
    assert np.abs(solution.q_source - expected.q).max() <= 1e-11 * np.abs(expected.q).max()
    assert np.abs(solution.f_el - expected.force).max() <= 1e-11 * expected.force.max()
    if name in ("chirp", "AM", "Exp", "function"):
        slope = [(segments[0][2](x + 1e-7) - segments[0][2](x - 1e-7)) / 2e-7 for x in t[1:]]
        current = np.array([expected.current(float(x), float(s)) for x, s in zip(t[1:], slope, strict=True)])
        assert np.abs(solution.i_source[1:] - current).max() <= 1e-6 * np.abs(current).max()


@pytest.mark.parametrize(("r_coat", "law"), by_turns(["0.2meg", "1", "inf"]))
@pytest.mark.parametrize("name", ["chirp", "AM", "Exp"])
def test_the_charge_is_what_every_layer_stores_and_leaks(name: str, r_coat: str, law: str) -> None:
    source, segments, stop = SCENES[name]
    x, w = np.polynomial.legendre.leggauss(20)
    # Finer and finer towards the start of a segment, where fast modes are.
    graded = np.unique(np.concatenate([[0.0], np.geomspace(1e-9, 0.02, 40), np.linspace(0.02, 1.0, 41)]))
    cuts = np.concatenate([a + (b - a) * graded[:-1] for a, b, _ in segments] + [[stop]])
    half, middle = 0.5 * np.diff(cuts)[:, None], 0.5 * (cuts[1:] + cuts[:-1])[:, None]
    times = (middle + half * x).ravel()
    circuit = table1(coat={"r": r_coat}).replace({"Vdrive": source})
    given = {"t_stop": stop, "area": AREA, "charge_law": law}
    inside = fs.simulate(circuit, t_eval=times, charge=False, **given).u_layer.reshape(half.size, x.size, 3)
    ends = fs.simulate(circuit, t_eval=cuts, **given)
    plain = ref.table1_layers(F)
    layers = (ref.Layer(plain[0].c, r_total=float(r_coat.replace("meg", "e6"))), *plain[1:])
    for i, layer in enumerate(layers):
        if layer.r_total < 1e3:
            # Through a near short circuit the leak is a small difference: its charge comes from the others.
            continue
        conductance = 1.0 / layer.r_total + AREA / layer.r_area
        leaked = conductance * np.cumsum((half * w * inside[:, :, i]).sum(axis=1))
        q = AREA * layer.c * ends.u_layer[1:, i] + leaked
        assert np.abs(ends.q_source[1:] - q).max() <= 1e-12 * np.abs(q).max()


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Lengths of the inputs given to the hold recursion."""
    calls: list[int] = []
    recursion = closed_form.linear.first_order_hold

    def counted(u: Any, *arguments: Any, **options: Any) -> Any:
        calls.append(len(u))
        return recursion(u, *arguments, **options)

    monkeypatch.setattr(closed_form.linear, "first_order_hold", counted)
    return calls


@every_law
@pytest.mark.parametrize("rate", [1e4, 48e3, 1e6])
def test_samples_at_their_own_times_are_the_closed_form_by_a_recursion(rate: float, law: str, held: list[int]) -> None:
    count = cases(400, 100)
    values = np.random.default_rng(8).normal(0.0, 60.0, count)
    stop = (count - 1) / rate
    t = np.arange(count) / rate
    source = fs.Samples(values, rate)
    quick = linear(source, t, stop, charge=False, charge_law=law)
    assert held == [count]
    slow = linear(source, t, stop, charge_law=law)
    assert held == [count]
    scale = np.abs(values).max()
    assert np.abs(quick.u_layer - slow.u_layer).max() <= 1e-12 * scale
    segments = ref.pwl_segments([*zip(t.tolist(), values.tolist(), strict=True)])
    expected = ref.transient(segments, t[:-1], freq=F, law=law, area_mode=AREA)
    assert np.abs(quick.u_layer[:-1] - expected.u).max() <= 1e-12 * scale
    assert np.abs(quick.u_layer[-1] - expected.at([stop], "left").u).max() <= 1e-12 * scale
    for name in ("u_source", "f_el", "area"):
        np.testing.assert_allclose(getattr(quick, name), getattr(slow, name), rtol=0, atol=1e-11 * scale)
    later = linear(source, np.array([1.1 * stop]), 1.1 * stop, charge=False, charge_law=law, start=quick)
    whole = linear(source, np.array([1.1 * stop]), 1.1 * stop, charge=False, charge_law=law)
    assert np.abs(later.u_layer - whole.u_layer).max() <= 1e-12 * scale


@pytest.mark.parametrize("shift", [1e-9, 4e-7, 1e-5, 0.3])
def test_samples_at_other_times_are_taken_there(shift: float) -> None:
    values = np.random.default_rng(8).normal(0.0, 60.0, 400)
    t = np.arange(400) / 48e3
    t[1:-1] += shift / 48e3
    source = fs.Samples(values, 48e3)
    quick, slow = (linear(source, t, 399 / 48e3, charge=x) for x in (False, True))
    assert np.abs(quick.u_layer - slow.u_layer).max() <= quick.error.u_gap + slow.error.u_gap + 1e-12 * 60.0


def layered(rng: np.random.Generator, layers: int) -> tuple[fs.Circuit, list[ref.Layer]]:
    """A stack of random layers at a sine of 10 V and 500 Hz, and its layers as the reference takes them."""
    d, eps, r = rng.uniform(1e-6, 1e-4, layers), rng.uniform(1.0, 50.0, layers), 10.0 ** rng.uniform(5.0, 7.0, layers)
    nodes = ["in", *(f"n{i}" for i in range(layers - 1)), "0"]
    lines = [
        f"X{i} {nodes[i]} {nodes[i + 1]} area LAYER d={d[i]:.17g} eps_r={eps[i]:.17g} r={r[i]:.17g}"
        for i in range(layers)
    ]
    circuit = deck("V1 in 0 SIN(0 10 500)", *lines, "Varea area 0 40", ".tran 10u 5m uic")
    return circuit, [ref.Layer(8.854e-12 * e / x, r_total=y) for e, x, y in zip(eps, d, r, strict=True)]


# Stretches of the recursion begin after the first sample, every 500.
@pytest.mark.parametrize("count", [2, 3, 62, 499, 500, 501, 502, 1517])
@pytest.mark.parametrize("layers", [1, 2, 4, 9])
def test_any_number_of_samples_and_of_layers_is_the_closed_form(layers: int, count: int) -> None:
    rng = np.random.default_rng([layers, count])
    circuit, _ = layered(rng, layers)
    values, t = rng.normal(0.0, 60.0, count), np.arange(count) / 48e3
    given = {"sources": {"V1": fs.Samples(values, 48e3)}, "t_eval": t, "t_stop": t[-1]}
    quick, slow = (fs.simulate(circuit, charge=charge, **given) for charge in (False, True))
    assert quick.method == slow.method == "linear"
    assert np.abs(quick.u_layer - slow.u_layer).max() <= 2e-14 * np.abs(values).max()


CIRCUITS = {
    tier: (f"X1 in m area LAYER d=1u eps_r=4{r1}", f"X2 m 0 area LAYER d=3u eps_r=1{r2}", "Varea area 0 40",
           ".tran 10u 12m uic")
    for tier, r1, r2 in (("algebraic", "", ""), ("linear", " r=0.3meg", " r=1meg"))
}  # fmt: skip


@every_law
@pytest.mark.parametrize("tier", CIRCUITS)
def test_a_jump_at_the_very_end_has_both_sides(tier: str, law: str) -> None:
    circuit = deck("V1 in 0 SQUARE(10 100)", *CIRCUITS[tier])
    ending = fs.simulate(circuit, t_stop=0.005, charge_law=law)
    passing = fs.simulate(circuit, t_stop=0.006, charge_law=law)
    assert ending.method == tier
    at = np.flatnonzero(passing.t == 0.005)
    assert at.size == 2
    assert ending.t[-2:].tolist() == [0.005, 0.005]
    assert ending.u_source[-2:].tolist() == [10.0, -10.0]
    for name in ("u_layer", "q_source", "i_source"):
        whole = getattr(passing, name)
        got = getattr(ending, name)
        np.testing.assert_allclose(got[-2:], whole[at], rtol=0, atol=1e-13 * np.abs(whole).max(), err_msg=name)
    # Asked for by its time alone it is the right-hand value.
    asked = fs.simulate(circuit, t_eval=np.array([0.002, 0.005]), charge_law=law)
    np.testing.assert_array_equal(asked.u_layer[-1], ending.u_layer[-1])
    assert asked.q_source[-1] == ending.q_source[-1]


@every_law
@pytest.mark.parametrize("cut", [0.0032, 0.005], ids=["between jumps", "at a jump"])
@pytest.mark.parametrize(("tier", "start"), [("algebraic", "uncharged"), ("linear", "uncharged"), ("linear", "dc")])
def test_a_run_goes_on_from_where_another_stopped(tier: str, cut: float, start: str, law: str) -> None:
    circuit = deck("V1 in 0 1", *CIRCUITS[tier]).replace({"V1": fs.Square(10.0, 100.0, offset=3.0)})
    t = np.linspace(0.0, 0.012, 121)
    whole = fs.simulate(circuit, t_eval=t, charge_law=law, start=start)
    first = fs.simulate(circuit, t_stop=cut, charge_law=law, start=start)
    second = fs.simulate(circuit, t_eval=t[t >= cut], t_stop=0.012, charge_law=law, start=first)
    assert first.method == second.method == tier
    assert np.abs(second.u_layer - whole.u_layer[t >= cut]).max() <= 1e-12 * 13.0
    q = np.abs(whole.q_source).max()
    assert np.abs(second.q_source - whole.q_source[t >= cut]).max() <= 1e-12 * q


@every_law
@pytest.mark.parametrize("at", [0.004, 0.00412345, 0.011], ids=["on an output", "between", "late"])
@pytest.mark.parametrize("tier", [*CIRCUITS, "coupled"])
def test_a_run_goes_on_from_where_the_source_stopped_being_finite(tier: str, at: float, law: str) -> None:
    def broken(t: Any) -> Any:
        return np.where(np.asarray(t) < at, 3.0 + np.sin(2e3 * np.asarray(t)), np.nan)

    def whole(t: Any) -> Any:
        return 3.0 + np.sin(2e3 * np.asarray(t))

    circuit = table1() if tier == "coupled" else deck("V1 in 0 1", *CIRCUITS[tier])
    given = {"charge_law": law, "rtol": 1e-11, "t_stop": 0.012}
    first = fs.simulate(circuit, sources=broken, throw=False, **given)
    assert first.status is fs.Status.SOURCE_NOT_FINITE
    t = np.linspace(at + 1e-6, 0.012, 37)
    later, want = (fs.simulate(circuit, sources=whole, t_eval=t, start=start, **given) for start in (first, "deck"))
    assert np.abs(later.u_layer - want.u_layer).max() <= 1e-9 * 4.0
    assert np.abs(later.q_source - want.q_source).max() <= 1e-9 * np.abs(want.q_source).max()


@pytest.mark.parametrize("tier", [*CIRCUITS, "coupled"])
def test_a_source_that_is_never_finite_leaves_the_state_as_it_was(tier: str) -> None:
    circuit = table1() if tier == "coupled" else deck("V1 in 0 1", *CIRCUITS[tier])
    solution = fs.simulate(circuit, sources=lambda t: np.full(np.shape(t), np.nan), t_stop=0.012, throw=False)
    assert solution.status is fs.Status.SOURCE_NOT_FINITE
    assert solution.t.size == 0
    assert solution.state.t == 0.0
    assert solution.state.s_before[0] == 0.0
    assert not solution.state.y.any()


def test_mean_and_frozen_areas_are_what_their_names_say() -> None:
    frozen = fs.simulate(table1(), area="frozen")
    assert frozen.area == pytest.approx(34.9715871843e-6, rel=1e-11, abs=0.0)
    mean = fs.simulate(table1(), area="mean")
    assert mean.area == pytest.approx(ref.coupled_phasor(100.0, 200.0).area, rel=1e-12, abs=0.0)
    refuses("this source has none", fs.simulate, table1(), sources={"Vdrive": fs.DC(10.0)}, area="mean")


@every_law
@pytest.mark.parametrize("layers", [1, 2, 6, 12])
def test_any_number_of_layers_from_rest_and_in_the_periodic_state(layers: int, law: str) -> None:
    circuit, stack = layered(np.random.default_rng(layers), layers)
    t = np.linspace(0.0, 5e-3, 41)
    run = fs.simulate(circuit, t_eval=t, rtol=1e-10, charge_law=law)
    assert np.abs(run.u_layer - ref.sine_frozen_from_rest(500.0, 10.0, 40e-6, t, stack)).max() <= 1e-9 * 10.0
    state = fs.steady_state(circuit, charge_law=law, rtol=1e-11)
    assert state.multipliers.shape == (layers - 1,)
    want = ref.periodic_sine_frozen(500.0, 10.0, 40e-6, state.solution.t, stack)
    assert np.abs(state.solution.u_layer - want).max() <= 1e-11 * 10.0


# Response of linear modes to sampled input -------------------------------------------------------------------

DT = 1e-6


def run(u, modes, dt=DT):
    """The one output of these modes, and their state at the last sample."""
    rates, gains, direct, weights, w0 = modes
    y, w_end = first_order_hold(u, dt, rates, gains, np.array([direct]), weights[None], w0)
    return y[0], w_end


def weights_to_40_digits(z):
    with mp.workdps(80):
        z = mp.mpf(z)
        if z < 1e-20:
            return mp.mpf(1) / 2, mp.mpf(1) / 2
        return (1 - (1 + z) * mp.exp(-z)) / z**2, (z - 1 + mp.exp(-z)) / z**2


def extended(u, modes, dt=DT):
    """y, w at the last sample and the largest |w|, by the serial recursion in extended precision."""
    rates, gains, direct, weights, w0 = modes
    u = np.asarray(u, np.longdouble)
    y, states, peaks = np.longdouble(direct) * u, [], []
    for rate, gain, weight, w in zip(rates, gains, weights, w0, strict=True):
        with mp.workdps(40):
            z = mp.mpf(float(rate)) * mp.mpf(dt)
            scale = mp.mpf(dt) * mp.mpf(float(gain))
            start, end = (np.longdouble(mp.nstr(x * scale, 25)) for x in weights_to_40_digits(z))
            fall = np.longdouble(mp.nstr(mp.exp(-z), 25)) if z < 1000 else np.longdouble(0)
        x = np.concatenate([[np.longdouble(w)], start * u[:-1] + end * u[1:]])
        history = lfilter(np.array([1], np.longdouble), np.array([1, -fall], np.longdouble), x)
        y = y + np.longdouble(weight) * history
        states.append(float(history[-1]))
        peaks.append(float(np.abs(history).max()))
    return y, np.array(states), np.array(peaks)


def deviation(y, expected):
    return float(np.abs(y - expected).max() / np.abs(expected).max())


@pytest.mark.parametrize(
    "rates", [[0.0, 1e-3], [0.0, 1.0, 1.0, 10.0], [1e3, 3e4], [1e5], [1e6, 2e6, 1e12, 1e18, 0.1]], ids=lambda r: f"{r}"
)
def test_a_million_samples_add_up_no_rounding(rates):
    m = 1_000_000
    rng = np.random.default_rng(0)
    n = len(rates)
    modes = np.array(rates), np.array(rates) + 1.0, 0.3, rng.uniform(0.5, 1.0, n), rng.standard_normal(n)
    for u in (rng.standard_normal(m), np.full(m, 0.1), np.sin(1e-3 * np.arange(m))):
        y, w_end = run(u, modes)
        expected, state, peak = extended(u, modes)
        assert deviation(y, expected) <= 1e-13
        assert np.all(np.abs(w_end - state) <= 1e-13 * peak)


def test_silence_after_a_pulse_ends_in_zeros_not_in_denormals():
    u = np.zeros(1_000_000)
    u[:10] = 1.0
    for z in (0.01, 0.4, 0.7, 5.0):
        y, w_end = run(u, (np.array([z / DT]), np.array([1.0]), 0.0, np.array([1.0]), np.array([1.0])))
        assert w_end[0] == 0.0
        assert y[-1] == 0.0
        denormal = (y != 0.0) & (np.abs(y) < 2.3e-308)
        # A stretch may end in a few, none begins with them.
        assert np.count_nonzero(denormal) <= 125
