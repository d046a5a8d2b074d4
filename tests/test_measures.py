"""Figures of a run are integrals over the run's steps, and do not depend on the requested outputs."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.integrate import simpson

import analytic as ref
import fingerspice as fs
from fingerspice.numerics.chebyshev import largest
from fingerspice.numerics.lobatto import NODES, POINTS
from fingerspice.results import steps
from scenes import cases, deck, table1

LAWS = pytest.mark.parametrize("law", ["local", "mobile"])
FIGURES = ("u_gap_peak", "u_gap_rms", "f_el_max", "f_el_mean", "f_el_mean_periodic", "area_min", "area_mean")


def table1_run(source, f, periods, law="local", *, outputs=7, rtol=1e-8, **more):
    stop = periods / f
    return fs.simulate(
        table1(f=f), sources={"Vdrive": source}, t_stop=stop, t_eval=np.linspace(0.0, stop, outputs), rtol=rtol,
        charge_law=law, **more,
    )  # fmt: skip


SCENES = {
    "sine 100 Hz": (fs.Sine(200.0, 100.0), ref.sine_segments(200.0, 100.0, 0.02), 100.0, 2),
    "sine 5 kHz": (fs.Sine(200.0, 5000.0), ref.sine_segments(200.0, 5000.0, 6e-4), 5000.0, 3),
    "square 100 Hz": (fs.Square(200.0, 100.0), ref.square_segments(200.0, 100.0, 2), 100.0, 2),
    "square 5 kHz": (fs.Square(200.0, 5000.0), ref.square_segments(200.0, 5000.0, 3), 5000.0, 3),
}


@LAWS
@pytest.mark.parametrize("scene", SCENES)
def test_means_and_extremes_are_the_references_within_the_stated_error(scene, law):
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


def test_the_papers_square_of_100_hz_has_its_mean_whatever_the_output_step():
    # 2.4 % off with TSTEP 1 ms, from the outputs.
    means = [
        fs.simulate(table1(tran=f"{step} 50m uic"), sources={"Vdrive": fs.Square(200.0, 100.0)}).f_el_mean_periodic
        for step in ("10u", "300u", "1m", "7m")
    ]
    expected = ref.transient(ref.square_segments(200.0, 100.0, 5), [0.0], freq=100.0).mean_force(0.04, 0.05)
    np.testing.assert_allclose(means, expected, rtol=1e-8)


RANDOM = [
    ("local", "SIN(0 200 100)", "fingerpad"), ("mobile", "SIN(0 200 5k)", "fingerpad"),
    ("local", "PULSE(-150 150 0 1u 1u 99u 200u)", "fingerpad"), ("local", "SIN(20 100 1k 0.3m 500 30)", "fingerpad"),
    ("mobile", "PWL(0 0 1m 200 2m -50 2.5m 120)", "fingerpad"), ("local", "EXP(0 200 0.2m 0.1m 2m 0.3m)", "fingerpad"),
    ("local", "SIN(0 200 5k)", "amplifier"), ("mobile", "SIN(0 200 5k)", "amplifier"),
    ("local", "SIN(0 200 5k)", "two_fingers"), ("local", "SIN(0 200 3k)", "screen_protector"),
    ("local", "SIN(0 200 1k)", "ungrounded_user"), ("local", "SIN(0 150 1k)", "fingerpad_dispersive"),
]  # fmt: skip


@pytest.mark.filterwarnings("ignore:sources names")
@pytest.mark.parametrize(("law", "source", "name"), RANDOM)
def test_figures_are_the_same_whatever_tstep(law, source, name):
    rng = np.random.default_rng(len(source) + len(name))
    circuit = fs.read_netlist(f"circuits/{name}.cir")
    drive = circuit.by_device("V")[0].name
    waveform = fs.parse_netlist(f"t\nV1 a 0 {source}\nR1 a 0 1\n.tran 1u 3m\n")["V1"].waveform
    seen = []
    for step in (3e-3, *rng.uniform(1e-6, 1e-3, cases(3, 1))):
        outputs = np.append(np.arange(0.0, 3e-3, step), 3e-3)
        figures = fs.simulate(
            circuit, sources={drive: waveform}, t_stop=3e-3, t_eval=outputs, charge_law=law, rtol=1e-7, throw=False
        ).summary()
        assert figures.pop("figures_from") == "steps"
        seen.append({k: v for k, v in figures.items() if not k.startswith("fold_margin")})
    assert all(other == seen[0] for other in seen[1:])
    # And a much tighter run of many outputs, by parabolas through them, gives the same.
    outputs = np.linspace(0.0, 3e-3, 60_001)
    fine = fs.simulate(
        circuit, sources={drive: waveform}, t_stop=3e-3, t_eval=outputs, charge_law=law, rtol=1e-10, throw=False
    )
    signals = {name: fine.record.one(name) for name in fine._figures.shown}
    for key in (k for k in signals if k.startswith(("u_gap", "f_el"))):
        x = signals[key]
        error = fine.error.u_gap + 1e-7 * np.abs(x).max()
        assert abs(seen[0][f"{key}_max"] - x.max()) <= 3e-6 * np.ptp(x) + error
        assert abs(seen[0][f"{key}_rms"] - np.sqrt(simpson(x**2, x=fine.t) / 3e-3)) <= 3e-6 * np.abs(x).max()


@pytest.mark.filterwarnings("ignore:sources names")
@LAWS
def test_a_run_of_many_periods_has_the_figures_of_its_stepped_twin(law):
    # A period that stands for many, where the skin remembers for dozens of them.
    circuit = fs.read_netlist("circuits/fingerpad_dispersive.cir")
    source = {circuit.by_device("V")[0].name: fs.Sine(150.0, 5000.0)}
    times = np.array([0.0, 0.2])
    fast, slow = (
        fs.simulate(circuit, sources=source, t_stop=0.2, t_eval=times, rtol=1e-8, method=method, charge_law=law)
        for method in ("auto", "exponential")
    )
    assert fast.stats["repeated"] > 50
    assert slow.stats["repeated"] == 0
    a, b = fast.summary(), slow.summary()
    assert a["figures_from"] == b["figures_from"] == "steps"
    for key in FIGURES:
        peak = b[f"{key.rpartition('_')[0].removesuffix('_mean')}_max"]
        assert abs(a[key] - b[key]) <= 2e-8 * peak


def test_the_last_period_may_begin_in_the_middle_of_steps_and_of_repeated_periods():
    whole, odd = (table1_run(fs.Sine(200.0, 100.0), 100.0, periods, rtol=1e-9) for periods in (40, 40.37))
    assert odd.stats["repeated"] > 20
    for key in ("f_el_mean_periodic", "u_gap_amplitude", "u_gap_phase_deg", "u_source_phase_deg", "f_el_ripple"):
        assert odd.summary()[key] == pytest.approx(whole.summary()[key], rel=1e-7, abs=1e-7)


def test_no_figure_and_no_output_depends_on_how_many_steps_are_recorded_at_once(monkeypatch):
    how = {"method": "exponential", "outputs": 1001}
    whole = table1_run(fs.AM(200.0, 5000.0, 50.0), 5000.0, 60, **how)
    monkeypatch.setattr(steps, "_AT_ONCE", 6)
    pieces = table1_run(fs.AM(200.0, 5000.0, 50.0), 5000.0, 60, **how)
    assert pieces.summary() == whole.summary()
    assert pieces.u_gap.tobytes() == whole.u_gap.tobytes()
    assert pieces.q_source.tobytes() == whole.q_source.tobytes()
    assert pieces.nfev == whole.nfev


def test_a_network_without_layers_has_figures_of_its_own():
    # Current through R charges C: u = U (1 - exp(-t / RC)), mean and rms by hand.
    circuit = deck("V1 a 0 5", "R1 a b 1k", "C1 b 0 1u", ".tran 5m 5m uic")
    figures = fs.simulate(circuit).summary()
    x = 5.0  # times the time constant
    assert figures["figures_from"] == "steps"
    assert figures["v:b_mean"] == pytest.approx(5.0 * (1.0 - (1.0 - np.exp(-x)) / x), rel=1e-11)
    square = 1.0 - 2.0 * (1.0 - np.exp(-x)) / x + (1.0 - np.exp(-2.0 * x)) / (2.0 * x)
    assert figures["v:b_rms"] == pytest.approx(5.0 * np.sqrt(square), rel=1e-11)
    assert figures["v:b_max"] == pytest.approx(5.0 * (1.0 - np.exp(-x)), rel=1e-12)


def test_tstart_is_where_figures_begin():
    expected = ref.transient(ref.sine_segments(200.0, 100.0, 0.05), [0.0], freq=100.0)
    assert fs.simulate(table1(tran="1m 50m 30m uic")).f_el_mean == pytest.approx(
        expected.mean_force(0.03, 0.05), rel=1e-8
    )


def test_weights_of_outputs_integrate_cubics_between_jumps_and_lines_where_points_are_few():
    rng = np.random.default_rng(3)
    t = np.sort(np.concatenate([[0.0, 1.0, 1.0, 1.5, 1.5, 3.0], rng.uniform(0.0, 1.0, 9), rng.uniform(1.5, 3.0, 5)]))
    first = t <= 1.0
    first[np.flatnonzero(t == 1.0)[1]] = False
    cubic = np.where(first, t**3 - t, np.where(t <= 1.5, 2.0 * t, t**2))
    second_half = np.flatnonzero(t == 1.5)[1]
    cubic[second_half] = 1.5**2
    exact = (0.25 - 0.5) + (1.5**2 - 1.0) + (27.0 - 1.5**3) / 3.0
    assert 3.0 * steps.weigh_outputs(t, cubic).mean() == pytest.approx(exact, rel=1e-13)


def test_weights_of_four_hundred_thousand_outputs_with_a_jump_at_every_tenth():
    # A loop over the pieces in Python took 18 s.
    t = np.repeat(np.linspace(0.0, 1.0, 360_001), np.where(np.arange(360_001) % 9 == 8, 2, 1))
    weighed = steps.weigh_outputs(t, np.sin(7.0 * t))
    assert weighed.mean() == pytest.approx((1.0 - np.cos(7.0)) / 7.0, rel=1e-12)


def test_a_pickled_solution_has_the_same_figures():
    for one in (table1_run(fs.Square(200.0, 100.0), 100.0, 20), fs.simulate(table1(), area="frozen")):
        assert pickle.loads(pickle.dumps(one)).summary() == one.summary()


@pytest.mark.parametrize("side", [0, -1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_summit_between_a_panel_s_last_two_nodes_is_found_behind_another_one(side: int, sign: float) -> None:
    # Both nodes lie alike on its two sides, below the summit of the panel that is looked at first.
    x = POINTS[:NODES]
    middle = 0.5 * (x[0] + x[1]) if side == 0 else 0.5 * (x[-1] + x[-2])
    half = middle if side == 0 else 1.0 - middle
    height = 1.0 + 0.5 * half**2
    values = np.array([1.0 - (x - x[6]) ** 2, height - (x - middle) ** 2])
    assert values[1].max() < 1.0
    panel, place, top = largest(sign * values, sign)
    assert panel == 1
    assert place == pytest.approx(middle, abs=1e-7)
    assert top == pytest.approx(height, rel=1e-14)
