"""Figures of a run, in its summary, printed and as attributes: integrals over its steps, whatever its outputs are."""

import math
import pickle
import re
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.integrate import simpson

import analytic as ref
import fingerspice as fs
from fingerspice.results import steps
from scenes import cases, deck, every_law, listed, shipped, table1

AREA = 34.9715871843e-6
F, U, OFFSET, PHASE = 100.0, 200.0, 60.0, 140.0
STRESS = 8.854e-12 / (2.0 * 3.5e-6**2)
NAMES = [
    "f_el_mean", "f_el_mean_periodic", "f_el_peak", "f_t_mean", "f_t_mean_periodic", "friction_mean", "area_mean",
    "u_gap_peak", "u_gap_rms", "u_gap_amplitude", "u_gap_phase_deg",
]  # fmt: skip


def table1_run(source: fs.Waveform, f: float, periods: float, law: str = "local", **more: Any) -> fs.Solution:
    stop = periods / f
    how = {"t_eval": np.linspace(0.0, stop, 7), "rtol": 1e-8, **more}
    return fs.simulate(table1(f=f), sources={"Vdrive": source}, t_stop=stop, charge_law=law, **how)


@cache
def periodic(law: str) -> tuple[np.ndarray, ref.Transient]:
    """Times in a period of Table 1's sine, and the reference's state there."""
    t = np.arange(4000) / 4000.0 / F
    return t, ref.periodic_state(ref.sine_segments(U, F, 1.0 / F), freq=F, law=law, t_out=t)


def test_figures_of_a_sine_with_offset_and_phase_are_the_closed_form() -> None:
    # Of two periods of the periodic state, the area fixed.
    source = fs.Sine(U, F, offset=OFFSET, phase_deg=PHASE)
    run = fs.simulate(table1().replace({"Vdrive": source}), area=AREA, start="periodic", t_stop=2.0 / F, rtol=1e-10)
    got, layers = run.summary(), ref.table1_layers(F)
    gain = ref.phasor_gains(F, AREA, layers)[ref.GAP]
    m, a = float(ref.dc_operating_point(OFFSET, layers, frozen=AREA)[ref.GAP]), U * abs(gain)
    # Means of (m + a sin)^2 and of its square: the force goes with the square of the gap voltage.
    square, fourth, force = m**2 + 0.5 * a**2, m**4 + 3.0 * m**2 * a**2 + 0.375 * a**4, STRESS * AREA
    for over in ("", "_periodic"):
        for name, mean, amplitude in (("u_source", OFFSET, U), ("u_gap", m, a)):
            assert got[f"{name}_mean{over}"] == pytest.approx(mean, abs=1e-6 * amplitude)
            assert got[f"{name}_rms{over}"] == pytest.approx(math.sqrt(mean**2 + 0.5 * amplitude**2), rel=1e-10)
    for key, value, rel in (
        ("u_gap_max", m + a, 1e-9), ("u_gap_min", m - a, 1e-9), ("u_gap_amplitude", a, 1e-10),
        ("u_source_amplitude", U, 1e-9), ("f_el_mean", force * square, 1e-7),
        ("f_el_rms", force * math.sqrt(fourth), 1e-7), ("f_el_ripple", force * (m + a) ** 2, 1e-9),
        ("f_t_mean", 0.3 * (0.5 + force * square), 1e-7),
        ("friction_mean_periodic", 0.3 * (1.0 + force * square / 0.5), 1e-7), ("area_max", AREA, 1e-12),
    ):  # fmt: skip
        assert got[key] == pytest.approx(value, rel=rel, abs=0.0), key
    assert got["u_source_phase_deg"] == pytest.approx(PHASE, abs=1e-7)
    assert got["u_gap_phase_deg"] == pytest.approx(PHASE + math.degrees(np.angle(gain)), abs=1e-7)
    assert (got["u_gap_peak"], got["area_min"], got["fundamental"]) == (got["u_gap_max"], got["area_max"], F)


SCENES = {
    "sine 100 Hz": (fs.Sine(200.0, 100.0), ref.sine_segments(200.0, 100.0, 0.02), 100.0, 2),
    "sine 5 kHz": (fs.Sine(200.0, 5000.0), ref.sine_segments(200.0, 5000.0, 4e-4), 5000.0, 2),
    "square 100 Hz": (fs.Square(200.0, 100.0), ref.square_segments(200.0, 100.0, 2), 100.0, 2),
    "square 5 kHz": (fs.Square(200.0, 5000.0), ref.square_segments(200.0, 5000.0, 2), 5000.0, 2),
}


@every_law
@pytest.mark.parametrize("scene", SCENES)
def test_means_and_extremes_are_the_references_within_the_stated_error(scene: str, law: str) -> None:
    source, segments, f, periods = SCENES[scene]
    solution = table1_run(source, f, periods, law)
    expected = ref.transient(segments, [0.0], law=law, freq=f)
    stop = periods / f
    extremes = expected.extremes(0.0, stop)
    figures, error = solution.summary(), solution.error
    assert figures["figures_from"] == "steps"
    assert abs(figures["f_el_mean"] - expected.mean_force(0.0, stop)) <= error.f_el
    assert abs(figures["f_el_mean_periodic"] - expected.mean_force(stop - 1.0 / f, stop)) <= error.f_el
    assert abs(figures["u_gap_peak"] - extremes["u_gap_max"]) <= error.u_gap
    assert abs(figures["f_el_max"] - extremes["force_max"]) <= error.f_el
    assert abs(figures["f_el_min"] - extremes["force_min"]) <= error.f_el


COLUMNS = {
    "min": "min", "max": "max", "mean": "mean", "last period": "mean_periodic", "rms": "rms_periodic",
    "ripple": "ripple",
}  # fmt: skip
ROWS = {
    "source voltage": "u_source", "gap voltage": "u_gap", "electroadhesive force": "f_el", "friction force": "f_t",
    "friction coefficient": "friction", "ridge contact area": "area",
}  # fmt: skip


def number(text: str) -> float:
    """A printed value in the unit without its prefix, mm^2 as m^2."""
    value, _, unit = text.strip().partition(" ")
    if unit == "mm^2":
        return 1e-6 * float(value)
    assert re.fullmatch(r"([kmuµn]?)[VN]|", unit), text
    return float(value) * {"": 1.0, "k": 1e3, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "n": 1e-9}[unit[:-1]]


@every_law
def test_figures_of_the_coupled_state_are_the_reference_s_and_so_are_the_printed_ones(law: str) -> None:
    run = fs.simulate(table1(), start="periodic", t_stop=1.0 / F, rtol=1e-9, charge_law=law)
    got, (t, want) = run.summary(), periodic(law)
    ends = want.extremes(0.0, 1.0 / F)
    assert got["u_gap_rms"] == pytest.approx(math.sqrt(np.mean(want.u_gap**2)), rel=1e-6)
    assert got["f_el_mean"] == pytest.approx(want.mean_force(0.0, 1.0 / F), rel=1e-6)
    assert got["f_el_max"] == pytest.approx(ends["force_max"], rel=1e-5)
    # Eq. 1: F_T = mu (F_N + F_el), of which the coefficient is F_T / F_N.
    friction = 0.3 * (0.5 + want.force)
    for name, x in (("u_gap", want.u_gap), ("area", want.area), ("f_t", friction), ("friction", friction / 0.5)):
        assert got[f"{name}_max"] == pytest.approx(x.max(), rel=1e-5, abs=0.0)
        assert got[f"{name}_min"] == pytest.approx(x.min(), rel=1e-5 if name == "u_gap" else 1e-6, abs=0.0)
        if name != "u_gap":
            assert got[f"{name}_mean"] == pytest.approx(np.mean(x), rel=1e-6, abs=0.0)
            assert got[f"{name}_ripple"] == pytest.approx(np.ptp(x), rel=6e-4, abs=0.0)
    first = 2j * np.mean(want.u_gap * np.exp(-2j * np.pi * F * t))
    assert got["u_gap_amplitude"] == pytest.approx(abs(first), rel=1e-6)
    assert got["u_gap_phase_deg"] == pytest.approx(math.degrees(np.angle(first)), abs=1e-4)
    # The table has four digits of these figures, and no others; the mean of a sine is nothing, not its rounding.
    lines = [re.split(r"  +", line.strip()) for line in str(run).splitlines()]
    table = {name: cells for name, *cells in lines if len(cells) == len(COLUMNS) and name in ROWS}
    assert table.keys() == ROWS.keys()
    assert number(table["source voltage"][2]) == 0.0
    for text, name in ROWS.items():
        for cell, kind in zip(table[text], COLUMNS.values(), strict=True):
            value = got.get(f"{name}_{kind}")
            shown = None if cell == "-" else number(cell)
            assert shown == (value and pytest.approx(value, rel=6e-4, abs=1e-12 * got[f"{name}_peak"])), (text, kind)


@pytest.mark.parametrize("phase", [0.0, 33.0, 175.0, -120.0])
@pytest.mark.parametrize("f", [100.0, 5000.0])
def test_the_printed_lead_is_that_of_the_gap_over_the_source(f: float, phase: float) -> None:
    # A source that starts elsewhere in its period leads and lags by the same; past half a turn too.
    circuit = table1(f=f).replace({"Vdrive": fs.Sine(200.0, f, phase_deg=phase)})
    page = str(fs.simulate(circuit, area=35e-6, start="periodic", t_stop=1.0 / f))
    gain = ref.phasor_gains(f, 35e-6, ref.table1_layers(f))[ref.GAP]
    said = re.search(r"at (\S+ k?Hz): gap voltage (\S+ V), (\S+) % of the source, leading by (\S+) deg", page)
    assert said[1] == {100.0: "100 Hz", 5000.0: "5 kHz"}[f]
    assert number(said[2]) == pytest.approx(200.0 * abs(gain), rel=6e-4)
    assert float(said[3]) == pytest.approx(100.0 * abs(gain), abs=5.1e-3)
    assert float(said[4]) == pytest.approx(math.degrees(np.angle(gain)), abs=5.1e-3)


@pytest.mark.parametrize(
    ("method", "t_eval"),
    [("radau", [0.02]), ("radau", None), ("radau", [0.003, 0.0071, 0.02]), ("scipy:DOP853", [0.003, 0.0071, 0.02])],
)
def test_figures_of_every_method_are_integrals_of_the_run(method: str, t_eval: list[float] | None) -> None:
    # Of the area held the last period is the closed form, of the coupled one the independent reference.
    how: dict[str, Any] = {"t_stop": 0.02, "t_eval": t_eval, "method": method, "rtol": 1e-6}
    held = fs.simulate(table1().replace({"Vdrive": fs.Sine(U, F)}), area=AREA, start="periodic", **how)
    amplitude = U * abs(ref.phasor_gains(F, AREA, ref.table1_layers(F))[ref.GAP])
    assert held.f_el_mean == pytest.approx(STRESS * AREA * amplitude**2 / 2.0, rel=3e-6)
    assert held.u_gap_peak == pytest.approx(amplitude, rel=2e-6)
    exact = ref.transient(ref.sine_segments(U, F, 0.02), [0.0, 0.02], freq=F)
    run = fs.simulate(table1(), **how)
    assert run.summary()["figures_from"] == "steps"
    assert run.f_el_mean == pytest.approx(exact.mean_force(0.0, 0.02), rel=3e-6)
    assert run.summary()["f_el_max"] >= run.f_el.max()


def test_a_network_without_layers_has_figures_of_its_own() -> None:
    # Current through R charges C: u = U (1 - exp(-t / RC)), mean and rms by hand.
    figures = fs.simulate(deck("V1 a 0 5", "R1 a b 1k", "C1 b 0 1u", ".tran 5m 5m uic")).summary()
    x = 5.0  # times the time constant
    assert figures["figures_from"] == "steps"
    assert figures["v:b_mean"] == pytest.approx(5.0 * (1.0 - (1.0 - np.exp(-x)) / x), rel=1e-11)
    square = 1.0 - 2.0 * (1.0 - np.exp(-x)) / x + (1.0 - np.exp(-2.0 * x)) / (2.0 * x)
    assert figures["v:b_rms"] == pytest.approx(5.0 * np.sqrt(square), rel=1e-11)
    assert figures["v:b_max"] == pytest.approx(5.0 * (1.0 - np.exp(-x)), rel=1e-12)


def test_tstart_is_where_figures_begin() -> None:
    expected = ref.transient(ref.sine_segments(200.0, 100.0, 0.05), [0.0], freq=100.0).mean_force(0.03, 0.05)
    assert fs.simulate(table1(tran="1m 50m 30m uic")).f_el_mean == pytest.approx(expected, rel=1e-8)


def test_a_gap_alone_has_them_too() -> None:
    """A stack of one layer has no state: its voltage is the source's."""
    gap = "Xgap a 0 area GAP d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000"
    run = fs.simulate(deck("V1 a 0 SIN(0 100 100)", gap, ".tran 10u 20m uic"))
    assert run.f_el_mean == pytest.approx(np.trapezoid(run.f_el, run.t) / 0.02, rel=1e-6)
    assert run.u_gap_amplitude == pytest.approx(100.0, rel=1e-9)


@pytest.mark.filterwarnings("ignore:sources names")
@pytest.mark.parametrize(("law", "source", "name"), listed("figures"))
def test_figures_are_the_same_whatever_tstep(law: str, source: str, name: str) -> None:
    rng = np.random.default_rng(len(source) + len(name))
    circuit = shipped(name).replace({"Vdrive": source})

    def run(outputs: np.ndarray, rtol: float = 1e-7) -> fs.Solution:
        return fs.simulate(circuit, t_stop=3e-3, t_eval=outputs, charge_law=law, rtol=rtol, throw=False)

    seen = []
    for step in (3e-3, *rng.uniform(1e-6, 1e-3, cases(3, 1))):
        figures = run(np.append(np.arange(0.0, 3e-3, step), 3e-3)).summary()
        assert figures.pop("figures_from") == "steps"
        seen.append({k: v for k, v in figures.items() if not k.startswith("fold_margin")})
    assert all(other == seen[0] for other in seen[1:])
    # And a much tighter run of many outputs, by parabolas through them, gives the same.
    fine = run(np.linspace(0.0, 3e-3, 60_001), 1e-10)
    for key in (key for key in fine._shown if key.startswith(("u_gap", "f_el"))):
        x = fine.record.one(key)
        error = fine.error.u_gap + 1e-7 * np.abs(x).max()
        assert abs(seen[0][f"{key}_max"] - x.max()) <= 3e-6 * np.ptp(x) + error
        assert abs(seen[0][f"{key}_rms"] - np.sqrt(simpson(x**2, x=fine.t) / 3e-3)) <= 3e-6 * np.abs(x).max()


@every_law
def test_a_run_of_many_periods_has_the_figures_of_its_stepped_twin(law: str) -> None:
    # A period that stands for many, where the skin remembers for dozens of them.
    circuit = shipped("fingerpad_dispersive").replace({"Vdrive": fs.Sine(150.0, 5000.0)})
    times = np.array([0.0, 0.2])
    fast, slow = (
        fs.simulate(circuit, t_stop=0.2, t_eval=times, rtol=1e-8, method=method, charge_law=law)
        for method in ("auto", "exponential")
    )
    assert fast.stats["repeated"] > 50
    assert slow.stats["repeated"] == 0
    a, b = fast.summary(), slow.summary()
    assert a["figures_from"] == b["figures_from"] == "steps"
    for signal, kinds in {
        "u_gap": ("peak", "rms"), "f_el": ("max", "mean", "mean_periodic"), "area": ("min", "mean")
    }.items():  # fmt: skip
        for kind in kinds:
            assert abs(a[f"{signal}_{kind}"] - b[f"{signal}_{kind}"]) <= 2e-8 * b[f"{signal}_max"], (signal, kind)


def test_the_last_period_may_begin_in_the_middle_of_steps_and_of_repeated_periods() -> None:
    whole, odd = (table1_run(fs.Sine(200.0, 100.0), 100.0, periods, rtol=1e-9) for periods in (40, 40.37))
    assert odd.stats["repeated"] > 20
    for key in ("f_el_mean_periodic", "u_gap_amplitude", "u_gap_phase_deg", "u_source_phase_deg", "f_el_ripple"):
        assert odd.summary()[key] == pytest.approx(whole.summary()[key], rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("name", ["fingerpad_dispersive", "am_carrier", "amplifier", "two_fingers"])
def test_where_the_recorded_steps_fill_their_arrays_changes_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # With room for one step they are full, too, where a period ends within the present window of the source.
    stop = 0.02 if name in ("amplifier", "two_fingers") else 0.1
    circuit, how = shipped(name), {"charge": name == "am_carrier", "t_stop": stop}
    plain = fs.simulate(circuit, rtol=1e-6, **how)
    for setting, capacity in (("CAPACITY", 1), ("CAPACITY", 7), ("_AT_ONCE", 6)):
        with monkeypatch.context() as patch:
            patch.setattr(steps, setting, capacity)
            run = fs.simulate(circuit, rtol=1e-6, **how)
        assert (run.stats["steps"], run.nfev) == (plain.stats["steps"], plain.nfev)
        for signal in ("u_gap", "q_source"):
            np.testing.assert_array_equal(getattr(run, signal), getattr(plain, signal))
        np.testing.assert_allclose(run.f_el_mean, plain.f_el_mean, rtol=1e-13)
        assert name != "am_carrier" or run.summary() == plain.summary()


@pytest.mark.parametrize(
    "source", [fs.Square(200.0, 100.0), fs.Square(200.0, 100.0, delay=1e-3), fs.Sine(200.0, 100.0)]
)
def test_a_period_that_ends_with_a_jump_is_looked_at_a_few_times(source, monkeypatch):
    # By rounding of the time the jump fell into the last panel, which was halved two thousand times.
    looks = []
    look = steps.Recorded.values_at
    monkeypatch.setattr(steps.Recorded, "values_at", lambda *a: looks.append(a) or look(*a))
    run = fs.simulate(table1(), sources={"Vdrive": source}, t_stop=0.05, rtol=1e-8)
    assert run.summary()["figures_from"] == "steps"
    assert len(looks) < 100


def test_weights_of_outputs_integrate_cubics_between_jumps_and_lines_where_points_are_few() -> None:
    rng = np.random.default_rng(3)
    t = np.sort(np.concatenate([[0.0, 1.0, 1.0, 1.5, 1.5, 3.0], rng.uniform(0.0, 1.0, 9), rng.uniform(1.5, 3.0, 5)]))
    first = t <= 1.0
    first[np.flatnonzero(t == 1.0)[1]] = False
    cubic = np.where(first, t**3 - t, np.where(t <= 1.5, 2.0 * t, t**2))
    cubic[np.flatnonzero(t == 1.5)[1]] = 1.5**2
    exact = (0.25 - 0.5) + (1.5**2 - 1.0) + (27.0 - 1.5**3) / 3.0
    assert 3.0 * steps.weigh_outputs(t, cubic).mean() == pytest.approx(exact, rel=1e-13)
    # Of 400,000 outputs with a jump at every tenth a loop over the pieces in Python took 18 s.
    t = np.repeat(np.linspace(0.0, 1.0, 360_001), np.where(np.arange(360_001) % 9 == 8, 2, 1))
    assert steps.weigh_outputs(t, np.sin(7.0 * t)).mean() == pytest.approx((1.0 - np.cos(7.0)) / 7.0, rel=1e-12)


@pytest.mark.parametrize("area", ["coupled", "frozen"])
def test_every_attribute_is_the_summarys_entry_whichever_is_asked_for_first(area, monkeypatch):
    made = []
    make = fs.Solution._made
    monkeypatch.setattr(fs.Solution, "_made", lambda self, *key: made.append(key) or make(self, *key))
    run, other = (fs.simulate(table1(), area=area, t_stop=0.02) for _ in range(2))
    assert run.f_el_mean == run.f_el_mean
    assert made == [("f_el", "mean")]
    summary = other.summary()
    for name in NAMES:
        assert getattr(run, name) == getattr(other, name) == summary[name], name
    assert run.summary() == pickle.loads(pickle.dumps(run)).summary() == summary


def test_a_steady_state_has_the_figures_of_its_period() -> None:
    state = fs.steady_state(table1("SIN(0 200 100)"), rtol=1e-10)
    assert state.f_el_mean == pytest.approx(periodic("local")[1].mean_force(0.0, 0.01), rel=1e-9)
    assert state.f_el_mean_periodic == state.f_el_mean
    assert state.u_gap_amplitude == state.solution.summary()["u_gap_amplitude"]
    assert state.period == 0.01
    # The mean of the outputs counts both ends of the period.
    few = fs.steady_state(table1("SQUARE(200 100)"), points=50)
    assert abs(few.solution.f_el.mean() / few.f_el_mean - 1.0) > 0.05  # type: ignore[union-attr, operator]
    assert few.f_el_mean == pytest.approx(fs.steady_state(table1("SQUARE(200 100)")).f_el_mean, rel=1e-7)


def test_several_fingers_have_a_figure_each() -> None:
    run = fs.simulate(shipped("two_fingers"))
    summary = run.summary()
    for name in NAMES:
        signal = next(k for k in ("f_el", "f_t", "friction", "area", "u_gap") if name.startswith(f"{k}_"))
        kept = [summary.get(f"{signal}:{gap}{name.removeprefix(signal)}") for gap in run.gaps]
        if None not in kept:
            np.testing.assert_array_equal(getattr(run, name), kept)
            assert not getattr(run, name).flags.writeable
    assert run.f_el_mean.shape == (2,)  # type: ignore[union-attr]


def test_there_is_none_without_a_gap_and_without_a_period() -> None:
    flat = fs.simulate(deck("V1 a 0 SIN(0 5 100)", "R1 a b 1k", "C1 b 0 1u", ".tran 100u 20m uic"))
    assert [getattr(flat, name) for name in NAMES] == [None] * len(NAMES)
    short = fs.simulate(table1(), t_stop=5e-3)
    assert short.f_el_mean is not None
    assert short.f_el_mean_periodic is short.summary()["f_el_mean_periodic"] is short.u_gap_amplitude is None
    assert "u_gap_amplitude" not in short.summary()
