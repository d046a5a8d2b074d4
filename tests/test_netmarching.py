"""Networks by exponential collocation against Radau: any circuit, both laws, stated errors, repeated periods."""

from __future__ import annotations

import numpy as np
import pytest

import fingerspice as fs
from scenes import deck, finger
from test_networks import LAWS, floating

SQUARE = "PULSE(120 -120 1m 0 0 1m 2m)"
CIRCUITS = {
    "two unlike fingers": (
        ["Vdrive a 0 SIN(0 200 5k)", "Rout a b 1k", *finger("b", "body", "one", "1"),
         *finger("b", "body", "two", "2", fn=0.2), "Rbody body 0 1meg", "Cbody body 0 150p"], 1e-3,
    ),
    "slow area": (["Vdrive a 0 SIN(20 120 300)", "Rout a b 1meg", *finger("b", "0", f=300.0, tau=1e-5)], 7e-3),
    "square": ([f"Vdrive a 0 {SQUARE}", "Rout a b 47k", *finger("b", "0", f=500.0), "Ccable b 0 10p"], 7e-3),
    "square without a resistor": ([f"Vdrive a 0 {SQUARE}", *finger("a", "0", f=500.0), "Ccable a 0 10p"], 7e-3),
    "current": (["Idrive 0 a SIN(0 300u 5k 0 0 90)", *finger("a", "0"), "Rload a 0 10meg"], 1e-3),
    "two tones": (
        ["Vdrive a m SIN(0 80 100)", "Vfast m 0 SIN(0 60 2k)", "Rout a b 10k", *finger("b", "0", f=100.0)], 15e-3,
    ),
}  # fmt: skip


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", CIRCUITS)
def test_the_error_stated_covers_the_difference_from_radau(name: str, law: str) -> None:
    lines, stop = CIRCUITS[name]
    circuit = deck(*lines, f".tran {stop / 500.0!r} {stop!r} uic")
    t = np.sort(np.random.default_rng(1).random(400)) * stop
    exact = fs.simulate(circuit, t_eval=t, charge_law=law, rtol=1e-10, method="radau")
    for rtol in (1e-3, 1e-6, 1e-8):
        s = fs.simulate(circuit, t_eval=t, charge_law=law, rtol=rtol)
        assert s.method == "exponential"
        assert np.abs(s.u_gap - exact.u_gap).max() <= s.error.u_gap + exact.error.u_gap
        assert np.abs(s.f_el - exact.f_el).max() <= s.error.f_el + exact.error.f_el
        assert s.error.u_gap <= 1.01 * rtol * np.abs(s.u_gap).max() * 1.2
        largest = np.abs(exact.q_source).max()
        off = np.abs(s.q_source - exact.q_source).max()
        assert off <= s.error.q_source + exact.error.q_source + 1e-12 * largest
        assert np.abs(s.i_source - exact.i_source).max() <= 300.0 * rtol * np.abs(exact.i_source).max()


def test_large_voltages_change_the_reference_areas() -> None:
    circuit = deck("Vdrive a 0 SIN(0 1500 1k)", "Rout a b 1k", *finger("b", "0", f=1000.0), ".tran 5u 3m uic")
    with pytest.warns(fs.FingerspiceWarning):
        s = fs.simulate(circuit, rtol=1e-8)
    with pytest.warns(fs.FingerspiceWarning):
        exact = fs.simulate(circuit, rtol=1e-10, method="radau")
    assert s.method == "exponential"
    # By more than what one reference serves.
    assert s.area.max() > 2.0 * s.area.min()
    assert np.abs(s.u_gap - exact.u_gap).max() <= s.error.u_gap + exact.error.u_gap


def test_near_a_fold_radau_takes_over() -> None:
    circuit = deck("Vdrive a 0 SIN(0 200 100)", "Rload a 0 1meg", *finger("a", "0", f=100.0, fn=1e-4), ".tran 20u 10m")
    s = fs.simulate(circuit, charge_law="mobile", throw=False)
    assert s.status is fs.Status.FOLD
    assert s.method == "radau"


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("source", ["SIN(0 200 5k)", "SIN(30 120 5k)", "PULSE(120 -120 100u 0 0 100u 200u)"])
def test_a_repeated_period_is_the_one_that_would_have_been_stepped(source: str, law: str) -> None:
    circuit = deck(f"Vdrive a 0 {source}", "Rout a b 47k", *finger("b", "0"), "Ccable b 0 150p", ".tran 1u 12.1m uic")
    t = np.linspace(0.0, 12.1e-3, 3001)
    for rtol in (1e-3, 1e-8):
        run = fs.simulate(circuit, t_eval=t, charge_law=law, rtol=rtol)
        stepped = fs.simulate(circuit, t_eval=t, charge_law=law, rtol=rtol, method="exponential")
        assert run.stats["repeated"] > 20
        assert stepped.stats["repeated"] == 0
        assert np.abs(run.u_gap - stepped.u_gap).max() <= run.error.u_gap + stepped.error.u_gap
        assert np.abs(run.q_source - stepped.q_source).max() <= run.error.q_source + stepped.error.q_source
        whole = np.abs(run.i_source - stepped.i_source).max()
        assert whole <= 300.0 * rtol * np.abs(stepped.i_source).max()
        # It goes on from there.
        after = fs.simulate(circuit, t_stop=13e-3, t_eval=[12.9e-3], charge_law=law, rtol=rtol, start=run)
        direct = fs.simulate(circuit, t_stop=13e-3, t_eval=[12.9e-3], charge_law=law, rtol=rtol)
        assert abs(after.u_gap[0] - direct.u_gap[0]) <= 2.0 * (run.error.u_gap + direct.error.u_gap)
        assert abs(after.q_source[0] - direct.q_source[0]) <= 2.0 * (run.error.q_source + direct.error.q_source)


def test_windows_of_a_long_run_join() -> None:
    circuit = floating("SIN(0 200 5k)")
    late = np.linspace(1.2, 1.2 + 2e-4, 50)
    run = fs.simulate(circuit, t_stop=1.21, t_eval=late, rtol=1e-6)
    near = fs.simulate(circuit, t_stop=0.0503, t_eval=late - 1.15, rtol=1e-6)
    assert run.method == "exponential"
    assert np.abs(run.u_gap - near.u_gap).max() <= run.error.u_gap + near.error.u_gap


@pytest.mark.parametrize("lines", [["Vfast m 0 SIN(0 60 2k)"], ["Vfast m n SIN(0 60 2k)", "Rout n 0 10k"]])
def test_a_gap_voltage_that_turns_back_between_nodes_has_crossed_zero(lines: list[str]) -> None:
    circuit = deck("Vdrive a m SIN(0 80 100)", *lines, *finger("a", "0", f=100.0), ".tran 30u 15m uic")
    t = np.linspace(0.0, 15e-3, 3001)
    exact = fs.simulate(circuit, t_eval=t, rtol=1e-10)
    for rtol in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9):
        s = fs.simulate(circuit, t_eval=t, rtol=rtol)
        assert s.stats["zeros"] == exact.stats["zeros"]
        assert np.abs(s.u_gap - exact.u_gap).max() <= s.error.u_gap + exact.error.u_gap


@pytest.mark.parametrize("method", ["auto", "radau"])
@pytest.mark.parametrize("longest", [1e-3, 2.3e-4])
def test_no_step_of_a_network_is_longer_than_the_decks_tmax(method: str, longest: float) -> None:
    # A resistor and a capacitor: 50 V come with exp(-t / 0.1 ms), of which most steps see nothing.
    lines = ["Vdrive a 0 50", "Rout a b 1k", *finger("b", "0"), "Ccable b 0 100n"]
    free = fs.simulate(deck(*lines, ".tran 1m 20m uic"), rtol=1e-6, method=method)
    bound = fs.simulate(deck(*lines, f".tran 1m 20m 0 {longest!r} uic"), rtol=1e-6, method=method)
    assert free.stats["steps"] < 0.8 * 0.02 / longest
    assert 0.02 / longest <= bound.stats["steps"] <= 1.2 * 0.02 / longest + free.stats["steps"]
    assert np.abs(bound.u_gap - free.u_gap).max() <= bound.error.u_gap + free.error.u_gap
