"""Sources that cancel, carriers that coarse samples miss, common periods, and runs whose work does not jump."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import fingerspice as fs
from scenes import DECKS, cases, every_law, quietly, table1, warns

THREE_PHASES = (DECKS / "three_phases.cir").read_text()
# A double of 50 V is rounded by 7e-15 V: no voltage of a balanced drive is more than some hundred of these.
ZERO = 1e-12


@every_law
@pytest.mark.parametrize("beside", ["", "Rload drive 0 1meg\n"], ids=["stack", "network"])
def test_a_balanced_drive_is_0_v_and_no_trouble(law: str, beside: str) -> None:
    circuit = fs.parse_netlist(THREE_PHASES.format(beside=beside))
    for rtol in (1e-4, 1e-8, 1e-11):
        run = quietly(fs.simulate, circuit, charge_law=law, rtol=rtol)
        assert run.method != "radau"
        assert np.abs(run.u_gap).max() < ZERO
        assert run.nfev < 100_000
        assert any("as good as 0" in text for text in run.warnings)


@settings(deadline=None, max_examples=cases(30, 6))
@given(
    st.integers(2, 7), st.floats(0.0, 360.0), st.sampled_from([0.3, 50.0, 1e3 / 3, 5e3]), st.sampled_from([1e-3, 1e-6])
)
def test_phases_that_balance_leave_what_is_added_to_them(n: int, phase: float, f: float, rtol: float) -> None:
    balanced = sum(
        (fs.Sine(50, f, phase_deg=phase + 360.0 * i / n) for i in range(1, n)), fs.Sine(50, f, phase_deg=phase)
    )
    nothing = quietly(fs.simulate, table1(), sources=balanced, t_stop=3.3 / f, rtol=rtol, charge=False)
    assert nothing.method != "radau"
    assert np.abs(nothing.u_gap).max() < ZERO
    alone = quietly(fs.simulate, table1(), sources=fs.Sine(100, 2 * f), t_stop=3.3 / f, rtol=rtol, charge=False)
    both = quietly(
        fs.simulate, table1(), sources=balanced + fs.Sine(100, 2 * f), t_stop=3.3 / f, rtol=rtol, charge=False
    )
    assert np.abs(both.u_gap - alone.u_gap).max() <= both.error.u_gap + alone.error.u_gap


def test_constants_that_cancel_are_0_v() -> None:
    run = quietly(fs.simulate, table1(), sources=fs.DC(0.1) + fs.DC(0.2) + fs.DC(-0.3))
    assert np.abs(run.u_gap).max() < 1e-15


@settings(deadline=None)
@given(st.integers(1, 50_000), st.integers(1, 2_000))
def test_the_period_of_whole_frequencies_is_that_of_their_greatest_common_divisor(carrier: int, envelope: int) -> None:
    common = math.gcd(carrier, envelope)
    assert fs.AM(150, carrier, envelope).period == pytest.approx(1.0 / common, rel=1e-14)
    assert (fs.Sine(1, carrier) + fs.Sine(1, envelope)).period == pytest.approx(1.0 / common, rel=1e-14)


def test_periods_that_have_nothing_in_common_give_none() -> None:
    for ratio in (math.sqrt(2.0), math.pi, math.e):
        assert (fs.Sine(1, 100.0) + fs.Sine(1, 100.0 * ratio)).period is None


@settings(deadline=None)
@given(st.integers(5, 400), st.sampled_from([1e3, 5e3, 32e3, 48e3]), st.sampled_from([7.0, 25.0, 30.0, 33.3]))
@example(12, 1e3, 30.0)
def test_the_peak_of_a_carrier_is_found_however_its_cycles_fall(eighths: int, carrier: float, envelope: float) -> None:
    peak = fs.AM(150, carrier, envelope).peak(0.0, max(eighths, 8) / 8.0 / envelope)
    assert 0.99 * 150.0 < peak <= 150.0 * (1.0 + 1e-12)


def test_the_peak_of_a_function_is_found_where_even_samples_are_all_0() -> None:
    assert fs.Function(lambda t: 150.0 * np.sin(2.0 * np.pi * 5120.0 * t)).peak(0.0, 0.1) > 149.0


@pytest.mark.parametrize("carrier", [32e3, 48e3])
@pytest.mark.parametrize("envelope", [25.0, 30.0])
def test_the_work_of_a_carrier_is_in_proportion_to_its_periods(carrier: float, envelope: float) -> None:
    circuit = table1().replace({"Xskin.f": carrier})
    work = []
    for periods in (1, 2, 3, 4, 5):
        run = fs.simulate(
            circuit, sources=fs.AM(150, carrier, envelope), t_stop=periods / envelope, rtol=1e-5, method="exponential",
            t_eval=[periods / envelope],
        )  # fmt: skip
        assert run.method == "exponential"
        work.append(run.nfev / periods)
    assert max(work) < 1.3 * min(work)


def test_a_run_that_implicit_steps_take_over_says_so_and_why(monkeypatch: pytest.MonkeyPatch) -> None:
    from fingerspice.results.outcome import Status
    from fingerspice.solve import nodal, simulation

    steps = simulation.solve_exponential

    def gives_up(*arguments: object, **how: object) -> object:
        run = steps(*arguments, **how)  # type: ignore[arg-type]
        run.status = Status.TOO_MANY_STEPS
        return run

    told: list[str] = []
    monkeypatch.setattr(simulation, "solve_exponential", gives_up)
    monkeypatch.setattr(nodal, "TELL_AFTER", 0.0)
    monkeypatch.setattr(nodal, "tell", told.append)
    said = r"exponential steps gave up at t = 0.05 s.*implicit steps took over"
    run = warns(said, fs.simulate, table1(), t_stop=0.05, rtol=1e-11)
    assert run.method == "radau"
    assert len(told) == 1
    assert "exponential steps gave up" in told[0]
    assert "s in all" in told[0]
