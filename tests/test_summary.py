"""Means, peaks and amplitudes of a run as attributes: each an integral of its own, computed once."""

from __future__ import annotations

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from fingerspice.results import steps
from fingerspice.results.summary import Figures
from scenes import deck, table1

NAMES = [
    "f_el_mean", "f_el_mean_periodic", "f_el_peak", "f_t_mean", "f_t_mean_periodic", "friction_mean", "area_mean",
    "u_gap_peak", "u_gap_rms", "u_gap_amplitude", "u_gap_phase_deg",
]  # fmt: skip


@pytest.mark.parametrize("area", ["coupled", "frozen"])
def test_every_attribute_is_the_summarys_entry_whichever_is_asked_for_first(area: str) -> None:
    run, other = (fs.simulate(table1(), area=area, t_stop=0.02) for _ in range(2))
    summary = other.summary()
    for name in NAMES:
        assert getattr(run, name) == getattr(other, name) == summary[name], name
    assert run.summary() == summary


def test_a_figure_is_computed_once_and_no_other_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    monkeypatch.setattr(Figures, "_made", lambda self, *key, make=Figures._made: made.append(key) or make(self, *key))
    run = fs.simulate(table1(), t_stop=0.02)
    assert run.f_el_mean == run.f_el_mean
    assert made == [("f_el", "mean")]


def test_a_steady_state_has_the_figures_of_its_period() -> None:
    state = fs.steady_state(table1("SIN(0 200 100)"), rtol=1e-10)
    expected = ref.periodic_state(ref.sine_segments(200.0, 100.0, 0.01), freq=100.0)
    mean = expected.mean_force(0.0, 0.01)
    assert state.f_el_mean == pytest.approx(mean, rel=1e-9)
    assert state.f_el_mean_periodic == state.f_el_mean
    assert state.u_gap_amplitude == state.solution.summary()["u_gap_amplitude"]
    assert state.period == 0.01
    # The mean of the outputs counts both ends of the period.
    few = fs.steady_state(table1("SQUARE(200 100)"), points=50)
    assert abs(few.solution.f_el.mean() / few.f_el_mean - 1.0) > 0.05  # type: ignore[union-attr, operator]
    assert few.f_el_mean == pytest.approx(fs.steady_state(table1("SQUARE(200 100)")).f_el_mean, rel=1e-7)


def test_several_fingers_have_a_figure_each() -> None:
    run = fs.simulate(fs.read_netlist("circuits/two_fingers.cir"))
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
    assert short.f_el_mean_periodic is None
    assert short.u_gap_amplitude is None


@pytest.mark.parametrize(
    "source", [fs.Square(200.0, 100.0), fs.Square(200.0, 100.0, delay=1e-3), fs.Sine(200.0, 100.0)]
)
def test_a_period_that_ends_with_a_jump_is_looked_at_a_few_times(
    source: fs.Waveform, monkeypatch: pytest.MonkeyPatch
) -> None:
    # By rounding of the time the jump fell into the last panel, which was halved two thousand times.
    looks = []
    look = steps.Recorded.values_at
    monkeypatch.setattr(steps.Recorded, "values_at", lambda *a: looks.append(a) or look(*a))
    run = fs.simulate(table1(), sources={"Vdrive": source}, t_stop=0.05, rtol=1e-8)
    assert run.summary()["figures_from"] == "steps"
    assert len(looks) < 100


def test_a_gap_alone_has_them_too() -> None:
    """A stack of one layer has no state: its voltage is the source's."""
    gap = "Xgap a 0 area GAP d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000"
    run = fs.simulate(fs.parse_netlist(f"gap\nV1 a 0 SIN(0 100 100)\n{gap}\n.tran 10u 20m uic\n.end"))
    assert run.f_el_mean == pytest.approx(np.trapezoid(run.f_el, run.t) / 0.02, rel=1e-6)
    assert run.u_gap_amplitude == pytest.approx(100.0, rel=1e-9)
