"""Every method on the same right-hand side: own steppers, scipy's, torchdiffeq's."""

from __future__ import annotations

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.numerics.tableaus import TABLEAUS
from fingerspice.solve.foreign import SCIPY_METHODS, TORCH_METHODS
from scenes import deck, table1

OWN = ("exponential", *TABLEAUS)
FOREIGN = tuple(f"scipy:{m}" for m in SCIPY_METHODS) + tuple(f"torchdiffeq:{m}" for m in TORCH_METHODS)
# First- and second-order methods get a tolerance they can meet in reasonable time.
LOOSE = {"scipy:RK23", "torchdiffeq:bosh3", "torchdiffeq:adaptive_heun", "torchdiffeq:midpoint", "torchdiffeq:euler"}


@pytest.fixture(scope="module")
def exact():
    return {
        (shape, law): fs.simulate(table1(), sources={"Vdrive": waveform}, t_stop=0.011, rtol=1e-12, charge_law=law)
        for shape, waveform in WAVEFORMS.items()
        for law in ("local", "mobile")
    }


WAVEFORMS = {"sine": fs.Sine(200.0, 100.0), "square": fs.Square(200.0, 100.0)}


@pytest.mark.parametrize("law", ["local", "mobile"])
@pytest.mark.parametrize("shape", WAVEFORMS)
@pytest.mark.parametrize("method", OWN + FOREIGN)
def test_every_method_meets_its_error(method, shape, law, exact):
    rtol = 1e-2 if method in LOOSE else 1e-5
    solution = fs.simulate(
        table1(), sources={"Vdrive": WAVEFORMS[shape]}, t_stop=0.011, rtol=rtol, method=method, charge_law=law
    )
    want = exact[shape, law]
    assert solution.method == method
    assert solution.success
    assert solution.nfev > 0
    assert np.array_equal(solution.t, want.t)
    assert np.abs(solution.u_gap - want.u_gap).max() <= rtol * np.abs(want.u_gap).max()
    assert np.abs(solution.f_el - want.f_el).max() <= rtol * want.f_el.max()
    assert solution.error.u_gap <= rtol * np.abs(want.u_gap).max() * (1.0 + rtol)


@pytest.mark.parametrize("method", ["scipy:RK99", "torchdiffeq:gl4", "euler", "scipy:", "numpy:RK45"])
def test_unknown_methods_are_refused_with_what_is_allowed(method):
    with pytest.raises(fs.InputError, match="allowed: "):
        fs.simulate(table1(), method=method)


@pytest.mark.parametrize("rtol", [1e-3, 1e-8, 1e-12])
@pytest.mark.parametrize("r_coat", ["1", "0.2meg", "1e15"])
def test_the_automatic_method_of_a_coupled_scene_is_exponential_however_stiff(rtol, r_coat):
    solution = fs.simulate(table1(coat={"r": r_coat}), rtol=rtol, t_stop=1e-3)
    assert solution.method == "exponential"
    assert solution.plan.tier == "coupled"
    assert solution.plan.stiff == (r_coat == "1")


def test_what_needs_no_steps_is_not_stepped():
    frozen = fs.simulate(table1(), area="frozen", t_stop=1e-3)
    assert (frozen.method, frozen.plan.tier, frozen.nfev) == ("linear", "linear", 0)
    free = fs.simulate(table1(gap={"r": "inf"}, coat={"r": "inf"}, skin=None), t_stop=1e-3)
    assert free.method == "exponential", "the skin leaks"
    lines = ("V1 in 0 SIN(0 10 500)", "X1 in m area LAYER d=1u eps_r=4", "X2 m 0 area LAYER d=3u eps_r=1")
    dry = fs.simulate(deck(*lines, "Varea area 0 40", ".tran 10u 1m uic"))
    assert (dry.method, dry.plan.tier, dry.nfev) == ("algebraic", "algebraic", 0)


def test_a_method_that_is_named_steps_the_coupled_model_whatever_the_scene():
    solution = fs.simulate(table1(), area="frozen", t_stop=1e-3, method="dp5")
    assert (solution.method, solution.plan.tier) == ("dp5", "coupled")
    assert solution.nfev > 0


def test_an_explicit_method_of_torchdiffeq_that_gives_up_is_explained(monkeypatch):
    import torchdiffeq

    def gives_up(*args, **options):
        raise AssertionError("underflow in dt nan")

    monkeypatch.setattr(torchdiffeq, "odeint", gives_up)
    solution = fs.simulate(table1(), t_stop=1e-3, method="torchdiffeq:dopri5", throw=False)
    assert solution.status is fs.Status.METHOD_FAILED
    assert "too stiff" in solution.message


def test_lsoda_s_nan_is_not_a_success():
    solution = fs.simulate(
        table1().replace({"Xgap.d": 10e-9}), charge_law="mobile", method="scipy:LSODA", throw=False, rtol=1e-4
    )
    assert solution.status is fs.Status.FOLD
    assert not solution.success
    assert np.all(np.isfinite(solution.u_gap))


@pytest.mark.parametrize("rtol", [0.0, 1e-14, 0.5, -1.0, float("nan")])
def test_tolerances_out_of_range_are_refused(rtol):
    with pytest.raises(fs.InputError, match=r"1e-13 to 0\.1"):
        fs.simulate(table1(), rtol=rtol)
