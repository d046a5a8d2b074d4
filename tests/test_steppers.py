"""Radau IIA: its coefficients, and orders of the compiled step."""

import math
from functools import lru_cache

import numpy as np
import pytest

import fingerspice as fs
from analytic import sine_segments, transient
from fingerspice.engine.implicit import dense_polynomial, dense_state, guess, linearise, step
from fingerspice.engine.network import rates
from fingerspice.numerics.lobatto import Scheme, radau_scheme
from fingerspice.solve.nodal import STAGES, STAGES_BESIDE, Collocation
from fingerspice.solve.problem import Tables, joined, prepare, values_at
from scenes import every_law, table1

every_number = pytest.mark.parametrize("stages", [3, STAGES_BESIDE, STAGES])


def dense_weights(tableau: Scheme, theta: float) -> np.ndarray:
    return tableau.dense @ theta ** np.arange(1, tableau.dense.shape[1] + 1)


def test_seven_stages_meet_the_conditions_of_order_13_that_decide() -> None:
    # Butcher: order 2 s - 1 follows from quadrature of that order, and from
    # collocation, sum_j a_ij c_j^(k-1) = c_i^k / k and sum_i b_i c_i^(k-1) a_ij = b_j (1 - c_j^k) / k.
    tableau = radau_scheme(7)
    a, b, c = tableau.a, tableau.a[-1], tableau.c
    for k in range(1, 14):
        assert b @ c ** (k - 1) == pytest.approx(1.0 / k, abs=1e-14)
    assert abs(b @ c**13 - 1.0 / 14.0) > 1e-10
    for k in range(1, 8):
        np.testing.assert_allclose(a @ c ** (k - 1), c**k / k, rtol=0, atol=1e-14)
    for k in range(1, 7):
        np.testing.assert_allclose((b * c ** (k - 1)) @ a, b * (1.0 - c**k) / k, rtol=0, atol=1e-14)


@every_number
def test_the_dense_output_joins_the_ends_of_the_step(stages: int) -> None:
    tableau = radau_scheme(stages)
    np.testing.assert_allclose(dense_weights(tableau, 1.0), tableau.a[-1], rtol=0, atol=2e-13)
    np.testing.assert_allclose(dense_weights(tableau, 1e-9) / 1e-9, tableau.dense[:, 0], rtol=0, atol=1e-6)


@every_number
def test_the_method_damps_what_is_infinitely_stiff(stages: int) -> None:
    tableau = radau_scheme(stages)
    np.testing.assert_allclose(tableau.a.sum(1), tableau.c, rtol=0, atol=1e-14)
    assert tableau.c[-1] == 1.0
    one = np.ones(stages)

    def growth(z: complex) -> float:
        return abs(1.0 + z * tableau.a[-1] @ np.linalg.solve(np.eye(stages) - z * tableau.a, one))

    assert growth(-1e12) < 1e-10
    assert max(growth(1j * y) for y in np.logspace(-3, 6, 200)) <= 1.0 + 1e-12
    assert growth(-0.1) == pytest.approx(math.exp(-0.1), rel=1e-4 if stages < 5 else 1e-12)


# A sine from its phase of 25 degrees: the gap voltage is far from its kink over the longest step.
F, U0, PHASE = 300.0, 100.0, 25.0
# Steps (s) whose errors lie between rounding and where the next orders count.
LENGTHS = {3: np.geomspace(4e-5, 2e-4, 6), 4: np.geomspace(5e-5, 1.5e-4, 6)}
INSIDE = np.linspace(0.1, 0.9, 9)


@lru_cache(None)
def expected(law: str, t: tuple[float, ...]) -> np.ndarray:
    """Cell voltages (n_t, 3), V."""
    segments = sine_segments(U0, F, 0.25 / F, phase=math.radians(PHASE))
    return transient(segments, np.array(t), freq=F, law=law, tol=1e-13).u


def one_step(stages: int, law: str, h: float) -> np.ndarray:
    """Voltages of coating and gap (V) inside the first step and at its end, shape (10, 2)."""
    circuit = table1(f=F).replace({"Vdrive": fs.Sine(U0, F, phase_deg=PHASE)})
    problem = prepare(circuit, t_stop=0.25 / F, t_eval=None, charge_law=law, area="coupled", start="uncharged")
    scheme = radau_scheme(stages)
    one = Collocation(problem, scheme, 1e-14, U0)
    (tables,) = Tables(problem, 1e-14)
    sources = joined(tables)
    assert one.jump(values_at(sources, 0.0)[0])
    one.room.s[:], one.room.ds[:] = one.s_before, (U0 * 2.0 * math.pi * F * math.cos(math.radians(PHASE)),)
    assert rates(one.net, one.room, False, one.y, one.sign, one.work.rate)
    linearise(one.nodal(sources))
    guess(scheme, one.work, h, 0.0)
    # The tolerance only says when the collocation equations are solved.
    norm = step(one.nodal(sources)._replace(tol=1e-12), 0.0, h)
    assert norm > 0.0
    dense_polynomial(one.work.k, scheme.dense, h, one.work.poly)
    out = np.empty((INSIDE.size, one.y.size))
    for theta, row in zip(INSIDE, out, strict=True):
        dense_state(theta, one.y, one.work.poly, row)
    return np.vstack([out, one.work.y1])[:, :2]


@every_law
@pytest.mark.parametrize("stages", LENGTHS)
def test_the_compiled_step_has_the_local_orders_of_its_end_and_its_inside(stages: int, law: str) -> None:
    lengths = LENGTHS[stages]
    errors = []
    for h in lengths:
        off = np.abs(one_step(stages, law, float(h)) - expected(law, (*(INSIDE * h), h))[:, :2])
        errors.append((off[-1].max(), off[:-1].max()))
    # The next order told apart: error = C h^p exp(c h).
    matrix = np.column_stack([np.ones_like(lengths), np.log(lengths), lengths])
    found = np.linalg.lstsq(matrix, np.log(np.array(errors)), rcond=None)[0][1]
    assert found[0] == pytest.approx(2 * stages, abs=0.15)
    assert found[1] == pytest.approx(stages + 1, abs=0.1)


def test_the_tolerance_is_relative_to_the_source() -> None:
    # So small a voltage moves no area: the circuit is linear, and a thousandth of the source gives a thousandth of all.
    evaluations = {
        fs.simulate(table1(), sources={"Vdrive": fs.Sine(u, 100)}, t_stop=0.02, rtol=1e-6, method="radau").nfev
        for u in (1e-3, 1e-6, 1e-9)
    }
    assert max(evaluations) <= 1.02 * min(evaluations)
