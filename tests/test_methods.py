"""Every method on every circuit: the package's own steppers, and scipy's and torchdiffeq's on one right-hand side."""

import pickle
import re
from functools import lru_cache

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.solve.nodal import SCIPY_METHODS, TORCH_METHODS
from scenes import cases, deck, every_law, finger, listed, refuses, shipped, table1

OWN = ("exponential", "radau")
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


# Each method under each waveform and each law, and our own ones under both at once; those of torchdiffeq, which take
# longest, under one of each by turns.
EVERY = [
    (method, shape, law)
    for i, method in enumerate(OWN + FOREIGN) for shape in WAVEFORMS for law in ("local", "mobile")
    if method in OWN or cases(1, 0)
    or ((shape == "sine") == (law == "local") and ("torch" not in method or (shape == "sine") == (i % 2 == 0)))
]  # fmt: skip


@pytest.mark.parametrize(("method", "shape", "law"), EVERY)
def test_every_method_meets_its_error(method, shape, law, exact):
    want, peak = exact[shape, law], np.abs(exact[shape, law].u_gap).max()
    for rtol in (1e-3, 1e-5, 1e-9) if method in OWN else (1e-2 if method in LOOSE else 1e-5,):
        given = {"sources": WAVEFORMS[shape], "t_stop": 0.011, "charge_law": law}
        solution = fs.simulate(table1(), rtol=rtol, method=method, **given)
        assert solution.method == method
        assert solution.success
        assert solution.nfev > 0
        assert np.array_equal(solution.t, want.t)
        assert np.abs(solution.u_gap - want.u_gap).max() <= rtol * peak
        assert np.abs(solution.f_el - want.f_el).max() <= rtol * want.f_el.max()
        assert solution.error.u_gap <= rtol * peak * (1.0 + rtol)


@pytest.mark.parametrize("circuit", [table1(), shipped("amplifier")], ids=["stack", "network"])
@pytest.mark.parametrize(("how", "said"), listed("methods"), ids=str)
def test_requests_that_cannot_be_run_are_refused_with_what_is_allowed(circuit, how, said):
    refuses(re.escape(said), fs.simulate, circuit, **how)


# With two sources, with an area that has dynamics of its own, and with two areas that follow.
NETWORKS = {
    "amplifier": (shipped("amplifier"), 1e-4),
    "two fingers": (shipped("two_fingers"), 4e-4),
    "slow area": (
        deck(
            "Vdrive drive 0 SQUARE(150 100)", "Rs drive coat 20k", *finger("coat", "0", f=100.0, tau="2m"),
            ".tran 50u 12m uic",
        ),
        12e-3,
    ),
}  # fmt: skip


@lru_cache(None)
def stepped(name, law):
    circuit, t_stop = NETWORKS[name]
    return fs.simulate(circuit, t_stop=t_stop, rtol=1e-9, charge_law=law, method="exponential")


# The other libraries' methods take longer: on each circuit under one law, and under both on different ones.
ON_NETWORKS = [
    (method, name, law)
    for method in ("radau", "scipy:DOP853", "scipy:LSODA", "scipy:Radau", "torchdiffeq:dopri5")
    for name in NETWORKS for law in ("local", "mobile")
    if method == "radau" or cases(1, 0) or (name == "two fingers") == (law == "mobile")
]  # fmt: skip


@pytest.mark.parametrize(("method", "name", "law"), ON_NETWORKS)
def test_every_kind_of_method_meets_its_error_on_any_circuit(method, name, law):
    circuit, t_stop = NETWORKS[name]
    want = stepped(name, law)
    assert want.method == "exponential"
    solution = fs.simulate(circuit, t_stop=t_stop, rtol=1e-5, charge_law=law, method=method)
    assert (solution.method, solution.success) == (method, True)
    assert np.array_equal(solution.t, want.t)
    off = np.abs(solution.u_gap - want.u_gap).reshape(solution.t.size, -1).max(axis=0)
    assert np.all(off <= 1e-5 * np.abs(want.u_gap).reshape(solution.t.size, -1).max(axis=0))
    assert off.max() <= solution.error.u_gap + want.error.u_gap
    # No error is asked of area and charge: they follow the voltages.
    assert np.abs(solution.area / want.area - 1.0).max() <= 1e-4
    assert np.abs(solution.q_source - want.q_source).max() <= 1e-4 * np.abs(want.q_source).max()


@every_law
@pytest.mark.parametrize("first", ["radau", "scipy:LSODA"])
def test_a_run_goes_on_from_one_by_another_method(first, law):
    # The square jumps at 5 ms: the first run ends just before, inside a half period, or with it.
    whole = fs.simulate(table1("SQUARE(150 100)", tran="50u 12m uic"), rtol=1e-9, charge_law=law)
    circuit = table1("SQUARE(150 100)", tran="50u 12m uic")
    for stop in (2.3e-3, 5e-3):
        one = fs.simulate(circuit, t_stop=stop, rtol=1e-8, charge_law=law, method=first)
        for second in ("auto", "radau"):
            two = fs.simulate(
                circuit, start=one, t_eval=whole.t[whole.t > stop], rtol=1e-8, charge_law=law, method=second
            )
            late = whole.t > stop
            # At the later jump the run given its times has right-hand values alone.
            smooth = np.append(np.diff(whole.t[late]) > 0.0, True) & np.append(True, np.diff(whole.t[late]) > 0.0)
            for name in ("u_gap", "q_source"):
                theirs, ours = getattr(whole, name)[late][smooth], getattr(two, name)[smooth]
                assert np.abs(ours - theirs).max() <= 1e-7 * np.abs(getattr(whole, name)).max(), (stop, second, name)


@pytest.mark.parametrize("method", ["radau", "scipy:DOP853"])
def test_a_run_travels_with_what_it_is_between_its_outputs(method):
    run = fs.simulate(table1(), t_stop=1e-4, rtol=1e-4, method=method)
    assert pickle.loads(pickle.dumps(run)).f_el_mean == run.f_el_mean


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
