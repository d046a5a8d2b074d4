"""The choice of the model: the right tier with its reason, and as accurate as the next heavier tier."""

import dataclasses
import json
import math
import pickle
import warnings
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from scenes import cases, deck, every_law, random_finger, random_waveform, refuses, table1

INSULATING = {"coat": {"r": "inf"}, "gap": {"r": "inf"}}


def dry(source: str = "SIN(0 200 100)", **gap: Any) -> fs.Circuit:
    """A finger without any leak: coating, gap, dielectric skin."""
    return stack(
        source, "Xcoat drive top area LAYER d=1u eps_r=3.9", "Xskin skin 0 area LAYER d=350u eps_r=1100", **gap
    )


def area_leaks(source: str = "SIN(0 200 100)") -> fs.Circuit:
    """A finger whose every leak scales with the area: a SLAB for the coating, and SKIN."""
    coat = "Xcoat drive top area SLAB d=1u eps_r=3.9 rho=7e6"
    return stack(source, coat, "Xskin skin 0 area SKIN d=350u f=100")


def stack(source: str, coat: str, skin: str, **gap: Any) -> fs.Circuit:
    values = {"d": "3.5u", "eps_r": 1, "fn": 0.5, "mu": 0.3, "alpha": 54.4, "m_exp": 0.52, "beta": 32, "n_exp": 1.41}
    text = " ".join(f"{k}={v}" for k, v in (values | {"c2": 5000} | gap).items())
    lines = (f"Vdrive drive 0 {source}", coat, f"Xgap top skin area GAP {text}", skin, ".tran 50u 20m uic")
    return deck(".include fingerspice.lib", *lines)


def agree(light: fs.Solution, heavy: fs.Solution) -> None:
    """Within what both say of their errors."""
    assert light.success
    assert heavy.success
    assert np.array_equal(light.t, heavy.t)
    assert np.abs(light.u_gap - heavy.u_gap).max() <= light.error.u_gap + heavy.error.u_gap
    # F goes as u^2: its error is at least twice the voltage's, relative to the peaks.
    share = 2.0 * (light.error.u_gap + heavy.error.u_gap) / np.abs(heavy.u_gap).max()
    stated = max(light.error.f_el + heavy.error.f_el, share * heavy.f_el.max())
    assert np.abs(light.f_el - heavy.f_el).max() <= stated
    scale = np.abs(heavy.u_source).max()
    assert np.abs(light.u_layer - heavy.u_layer).max() <= 4.0 * (light.error.u_gap + heavy.error.u_gap) + 1e-13 * scale
    if light.q_source is not None:
        q = np.abs(heavy.q_source).max()
        assert np.abs(light.q_source - heavy.q_source).max() <= 20.0 * heavy.rtol * q
        regular = np.abs(heavy.i_source).max()
        assert np.abs(light.i_source - heavy.i_source).max() <= 200.0 * heavy.rtol * regular


CHOICES = [
    (dry(), {}, "algebraic", "no layer leaks"),
    (dry(), {"charge_law": "mobile"}, "algebraic", "no layer leaks"),
    (dry(), {"area": "frozen"}, "algebraic", "no layer leaks"),
    (table1(**INSULATING), {}, "coupled", "only the charge needs the area"),
    (table1(), {"area": "frozen"}, "linear", "the area is frozen, so the circuit is linear"),
    (table1(), {"area": "mean", "charge_law": "mobile"}, "linear", "the area is mean"),
    (table1(), {"area": 35e-6}, "linear", "3.5e-05 m^2"),
    (table1(gap={"a_fix": 30}), {}, "linear", "(from the deck)"),
    (area_leaks(), {"charge": False}, "linear", "every leak scales with the area"),
    (area_leaks(), {}, "coupled", "only the charge needs the area"),
    (area_leaks(), {"charge": False, "charge_law": "mobile"}, "coupled", "moves the leaks"),
    (table1("SIN(0 1m 100)"), {"charge": False, "rtol": 1e-3}, "linear", "against rtol = 0.001"),
    (table1("SIN(0 1m 100)"), {"charge": False, "rtol": 1e-12}, "coupled", "moves the leaks"),
    (table1("SIN(0 1m 100)"), {"rtol": 1e-3}, "coupled", "only the charge needs the area"),
    (table1("SIN(0 1m 100)"), {"charge": False, "rtol": 1e-3, "charge_law": "mobile"}, "coupled", "moves the leaks"),
    (table1(), {}, "coupled", "the area follows the voltage and moves the leaks by up to"),
    (table1(), {"charge": False}, "coupled", "the area follows the voltage"),
]


@pytest.mark.parametrize(("circuit", "options", "tier", "reason"), CHOICES)
def test_the_lightest_model_that_is_right_is_chosen_and_says_why(circuit, options, tier, reason) -> None:
    plan = fs.plan(circuit, **options)
    assert plan.tier == tier
    assert reason in plan.reasons[0]
    solution = fs.simulate(circuit, **options)
    assert solution.plan.tier == tier
    assert solution.plan.reasons == plan.reasons
    assert solution.method == {"coupled": "exponential"}.get(tier, tier)


def test_a_stack_with_one_leak_that_no_area_moves_is_not_algebraic() -> None:
    assert fs.plan(table1(**INSULATING), charge=False).tier == "linear", "only SKIN leaks, by area"


def test_a_plan_is_plain_data_with_ascending_rates_and_says_whether_a_stack_is_stiff() -> None:
    easy, stiff = fs.plan(table1()), fs.plan(table1(coat={"r": 1}))
    assert len(easy.rates) == 2
    assert list(easy.rates) == sorted(easy.rates)
    assert not easy.stiff
    assert stiff.stiff
    assert "stiff: the fastest rate" in stiff.reasons[-1]
    data = easy.to_dict()
    assert json.loads(json.dumps(data)) == data
    assert data["tier"] == "coupled"
    with pytest.raises(dataclasses.FrozenInstanceError):
        easy.tier = "linear"  # type: ignore[misc]


def test_how_a_run_starts_is_in_its_plan() -> None:
    first = fs.simulate(table1(), t_stop=1e-3)
    assert first.plan.start == "deck"
    assert fs.simulate(table1(), t_stop=1e-3, start="dc").plan.start == "dc"
    assert fs.simulate(table1(), t_stop=1e-3, start="periodic").plan.start == "periodic"
    assert fs.simulate(table1(), t_stop=2e-3, start=first).plan.start == "given"


def test_a_start_with_stored_charge_takes_the_mobile_law_out_of_the_algebraic_tier() -> None:
    circuit = dry("SIN(60 100 100)")
    circuit = dataclasses.replace(circuit, initial={"top": 20.0, "skin": 10.0})
    assert fs.plan(circuit).tier == "algebraic"
    assert fs.plan(circuit, charge_law="mobile").tier == "coupled"
    refuses("a start without stored charge", fs.plan, circuit, charge_law="mobile", tier="algebraic")


def both(circuit: fs.Circuit, light: str, heavy: str, seed: int, u: float, **options: Any) -> tuple[fs.Solution, ...]:
    rng = np.random.default_rng([seed, 5])
    f = 10.0 ** rng.uniform(1.5, 4.0)
    stop = 2.0 / f
    t = np.sort(np.concatenate([rng.uniform(0.0, stop, 120), [0.0, 1.0 / f, stop]]))
    given = {"sources": {"Vdrive": random_waveform(rng, f, u)}, "t_eval": t, "t_stop": stop} | options
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the gap voltage reaches")
        a = fs.simulate(circuit, tier=light, **given)
        b = fs.simulate(circuit, tier=heavy, **given)
    assert (a.plan.tier, b.plan.tier) == (light, heavy)
    return a, b


@every_law
@pytest.mark.parametrize("seed", range(cases(12, 8)))
def test_algebraic_is_the_coupled_model_without_leaks(seed: int, law: str) -> None:
    rng = np.random.default_rng(seed)
    circuit = dry(d=f"{rng.uniform(2.0, 8.0):.6g}u", fn=rng.uniform(0.2, 1.0))
    agree(*both(circuit, "algebraic", "coupled", seed, rng.uniform(5.0, 220.0), charge_law=law, rtol=1e-11))


@pytest.mark.parametrize("seed", range(6))
def test_algebraic_keeps_what_a_start_has_stored_under_the_local_law(seed: int) -> None:
    circuit = dataclasses.replace(dry(), initial={"drive": 30.0, "top": 20.0, "skin": -40.0})
    agree(*both(circuit, "algebraic", "coupled", seed, 80.0, rtol=1e-11))


@every_law
@pytest.mark.parametrize("seed", range(cases(16, 9)))
def test_linear_is_the_coupled_model_at_a_fixed_area(seed: int, law: str) -> None:
    rng = np.random.default_rng(seed)
    area = ["frozen", 30e-6, 37.5e-6][seed % 3]
    circuit = random_finger(rng)
    light, heavy = both(circuit, "linear", "coupled", seed, 200.0, charge_law=law, rtol=1e-11, area=area)
    agree(light, heavy)
    assert light.nfev == 0


@every_law
def test_linear_is_the_coupled_model_at_the_mean_area(law: str) -> None:
    given = {"charge_law": law, "rtol": 1e-11, "area": "mean"}
    agree(fs.simulate(table1(), tier="linear", **given), fs.simulate(table1(), tier="coupled", **given))


@pytest.mark.parametrize("tier", ["linear", "coupled"])
def test_the_force_at_a_fixed_area_has_its_error_stated(tier: str) -> None:
    solution = fs.simulate(table1(), tier=tier, area="frozen", rtol=1e-6)
    exact = fs.simulate(table1(), tier="linear", area="frozen", rtol=1e-12)
    assert np.abs(solution.f_el - exact.f_el).max() <= solution.error.f_el
    assert solution.error.f_el >= solution.error.u_gap / np.abs(exact.u_gap).max() * exact.f_el.max()


@pytest.mark.parametrize("seed", range(cases(10, 6)))
def test_leaks_that_scale_with_the_area_feel_nothing_of_it_under_the_local_law(seed: int) -> None:
    light, heavy = both(area_leaks(), "linear", "coupled", seed, 200.0, rtol=1e-11, charge=False)
    agree(light, heavy)
    assert light.plan.error_bound == 0.0
    assert np.ptp(light.area) > 0.05 * light.area.max(), "the area still follows the voltage"


@pytest.mark.parametrize("seed", range(cases(24, 12)))
def test_at_small_voltages_the_linear_tier_is_as_near_as_it_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    circuit, rtol = random_finger(rng), 10.0 ** rng.uniform(-5.0, -2.0)
    # The area moves by 0.04 % per volt across the gap near zero.
    light, heavy = both(circuit, "linear", "coupled", seed, 300.0 * rtol, rtol=rtol, charge=False)
    assert light.plan.sensitivity <= 0.2 * rtol
    assert fs.plan(circuit, rtol=rtol, charge=False).tier in ("linear", "coupled")
    exact = both(circuit, "coupled", "coupled", seed, 300.0 * rtol, rtol=1e-11, charge=False)[1]
    assert np.abs(light.u_gap - exact.u_gap).max() <= light.error.u_gap
    assert np.abs(light.f_el - exact.f_el).max() <= light.error.f_el
    agree(light, heavy)


@pytest.mark.parametrize(("d", "amplitude"), [("20n", 0.2), ("5n", 0.2), ("1u", 0.05), ("3.5u", 0.05)])
def test_a_gap_that_takes_more_than_its_share_of_a_jump_is_not_taken_as_linear_too_soon(d: str, amplitude) -> None:
    # A thin gap without a leak takes nearly all of a slow source, and 1 % of a jump of it.
    circuit = table1(f"SIN(0 {amplitude} 5)", 10.0, gap={"d": d, "r": "inf"})
    given = {"t_stop": 0.5, "t_eval": np.linspace(0.0, 0.5, 200), "charge": False}
    solution = fs.simulate(circuit, rtol=1e-4, **given)
    exact = fs.simulate(circuit, rtol=1e-10, tier="coupled", **given)
    peak = np.abs(exact.u_gap).max()
    assert np.abs(solution.u_gap - exact.u_gap).max() <= 1e-4 * peak
    if solution.plan.tier == "linear":
        assert np.abs(solution.u_gap - exact.u_gap).max() <= solution.error.u_gap


@pytest.mark.parametrize("tier", ["algebraic", "linear", "coupled"])
def test_a_heavier_model_may_always_be_asked_for(tier: str) -> None:
    solution = fs.simulate(dry(), tier=tier, area="frozen", rtol=1e-10)
    assert solution.success
    assert solution.plan.tier == tier
    if tier != "algebraic":
        assert "asked for; the lightest that is right would be algebraic: no layer leaks" in solution.plan.reasons[0]
    assert fs.simulate(table1(), tier="coupled", area="frozen", t_stop=1e-3).method == "exponential"


UNKNOWN = "allowed: auto, algebraic, linear, coupled"


@pytest.mark.parametrize(
    ("circuit", "tier", "options", "message"),
    [
        (table1(), "algebraic", {}, "a stack without leaks; here Xcoat, Xgap, Xskin leak"),
        (table1(), "algebraic", {"area": "frozen"}, "a stack without leaks"),
        (table1(**INSULATING), "algebraic", {"charge": False}, "here Xskin leak"),
        (table1(), "linear", {}, r"the charge \(charge=False leaves it out\) needs the one that follows"),
        (table1(), "linear", {"charge": False, "charge_law": "mobile"}, "the mobile law needs the one that follows"),
        (dry(), "linear", {"charge_law": "mobile"}, "the mobile law"),
        *(
            (table1(extra="Rbeside drive 0 1meg"), tier, {}, f"the {tier} tier is not for this network; allowed: auto")
            for tier in ("algebraic", "linear")
        ),
        *((table1(), tier, {}, UNKNOWN) for tier in ("exact", "Linear", "", "dispersive")),
    ],
)
def test_an_unknown_model_and_one_that_cannot_describe_the_circuit_are_refused(circuit, tier, options, message) -> None:
    refuses(message, fs.simulate, circuit, tier=tier, t_stop=1e-3, **options)
    refuses(message, fs.plan, circuit, tier=tier, **options)


def test_a_lighter_model_that_errs_more_than_asked_says_so() -> None:
    given = {"tier": "linear", "charge": False, "t_stop": 0.02}
    solution = fs.simulate(table1(), rtol=1e-3, throw=False, **given)
    assert solution.status is fs.Status.ERROR_NOT_MET
    assert solution.plan.error_bound > 1e-3
    assert "estimate" in solution.message
    assert solution.t[-1] == 0.02
    exact = fs.simulate(table1(), rtol=1e-10, tier="coupled", t_stop=0.02)
    assert np.abs(solution.u_gap - exact.u_gap).max() <= solution.error.u_gap
    assert np.abs(solution.f_el - exact.f_el).max() <= solution.error.f_el
    with pytest.raises(fs.SolveError, match="the error estimate stayed above the error asked for"):
        fs.simulate(table1(), rtol=1e-3, **given)
    assert fs.simulate(table1("SIN(0 1 100)"), rtol=0.1, **given).success


def test_a_method_steps_whatever_the_model_could_have_been() -> None:
    solution = fs.simulate(dry(), method="radau", t_stop=2e-3, rtol=1e-9)
    assert (solution.plan.tier, solution.method) == ("coupled", "radau")
    agree(fs.simulate(dry(), t_stop=2e-3), solution)


def test_a_plan_is_made_once_for_the_same_request() -> None:
    circuit = table1()
    first = fs.simulate(circuit, t_stop=1e-3).plan
    assert fs.simulate(circuit, t_stop=1e-3).plan is first
    assert fs.plan(circuit, t_stop=1e-3) is first
    for other in ({"rtol": 1e-5}, {"charge": False}, {"charge_law": "mobile"}, {"tier": "coupled"}, {"t_stop": 2e-3}):
        assert fs.plan(circuit, **({"t_stop": 1e-3} | other)) is not first
    assert fs.plan(circuit.replace({"Xgap.d": 4e-6}), t_stop=1e-3) is not first


def test_a_circuit_travels_without_its_memory_and_gives_the_same_bits_there() -> None:
    circuit = table1()
    blank = len(pickle.dumps(circuit))
    here = fs.simulate(circuit, t_stop=5e-3)
    assert circuit.kept
    text = pickle.dumps(circuit)
    assert len(text) == blank
    there = pickle.loads(text)
    assert there == circuit
    assert not there.kept
    again = fs.simulate(there, t_stop=5e-3)
    np.testing.assert_array_equal(again.u_layer, here.u_layer)
    np.testing.assert_array_equal(again.q_source, here.q_source)


def test_a_changed_circuit_does_not_remember_the_one_it_came_from() -> None:
    circuit = table1()
    before = fs.simulate(circuit, t_stop=5e-3)
    changed = circuit.replace({"Vdrive.amplitude": 100.0})
    after = fs.simulate(changed, t_stop=5e-3)
    fresh = fs.simulate(table1("SIN(0 100 100)"), t_stop=5e-3)
    np.testing.assert_array_equal(after.u_layer, fresh.u_layer)
    assert np.abs(after.u_gap).max() < 0.6 * np.abs(before.u_gap).max()
    for stop in np.linspace(1e-3, 5e-3, 40):
        fs.plan(circuit, t_stop=float(stop))
    assert sum(key[0] == "scene" for key in circuit.kept) <= 16
    assert math.isclose(fs.simulate(circuit, t_stop=5e-3).u_gap[-1], before.u_gap[-1], rel_tol=0.0)
