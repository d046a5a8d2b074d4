"""The coupling between the cells of variable areas, against a dense solution of the same equations, row by row."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fingerspice.engine.many_areas.coupling import (
    STIFF,
    Moving,
    answer_mobile,
    cell_currents,
    fill_coupling,
    new_coupling,
)
from fingerspice.numerics.lobatto import ROWS
from fingerspice.numerics.modes import diagonalise

H = 1e-3
AREA0 = 35e-6


def solved(given: SimpleNamespace) -> tuple[np.ndarray, np.ndarray]:
    """Currents of the cells (n_f, ROWS), and the distance to the fold (ROWS,), by elimination."""
    fast = given.rates * H > STIFF
    own = np.where(fast[:, None], given.d, given.lin - given.rates[:, None] * given.w)
    free = given.tap @ own + given.tap_s @ given.ds
    met = -given.tap[:, ~fast] @ given.tap[:, ~fast].T
    currents, distance = np.empty_like(free), np.ones(ROWS)
    one = np.eye(len(given.c))
    for i in range(ROWS):
        e, u = given.more[given.home, i], given.u[:, i]
        held = np.diag(e * given.c)
        pushed, turned = e * given.g * u + given.c * u * given.rate[given.home, i], held.copy()
        for b, a in enumerate(given.home):
            turned[b, given.cell[a]] += given.c[b] * u[b] * given.slope[a, i]
        along = np.linalg.solve(one - met @ turned, free[:, i] + met @ pushed)
        currents[:, i] = pushed + turned @ along
        distance[i] = np.linalg.det(one - met @ turned) / np.linalg.det(one - met @ held)
    return currents, distance


def cells(seed: int, sizes: tuple[int, ...], fast: int) -> SimpleNamespace:
    """Modes, sources and cells of areas at every row of a step, with numbers like those of fingers."""
    rng = np.random.default_rng(seed)
    n, n_f, n_area = sum(sizes) + 1, sum(sizes), len(sizes)
    rates = np.sort(rng.uniform(10.0, 3e4, n))
    rates[n - fast :] = rng.uniform(1.0, 9.0, fast) * 1e6
    home = np.repeat(np.arange(n_area), sizes)
    c = rng.uniform(0.5, 2.0, n_f) * 1e-5
    # Voltages of the cells from the modes, of a network whose capacitances with the areas held are one in the modes:
    # those of the cells are at most all of it.
    tap = np.linalg.qr(rng.normal(size=(n, n)))[0][:n_f] / np.sqrt(c * AREA0)[:, None]
    w = rng.normal(size=(n, ROWS)) * np.sqrt(c.mean() * AREA0) * 50.0
    given = SimpleNamespace(
        rates=rates, tap=tap, tap_s=rng.normal(size=(n_f, 1)), c=c, g=c * rng.uniform(1e2, 1e4, n_f), home=home,
        cell=np.array([int(np.flatnonzero(home == a)[0]) for a in range(n_area)]), w=w,
        lin=rates[:, None] * w * rng.uniform(-1.0, 1.0, (n, ROWS)), d=rng.normal(size=(n, ROWS)) * 1e-5,
        s=rng.normal(size=(1, ROWS)) * 100.0, ds=rng.normal(size=(1, ROWS)) * 1e5,
        more=AREA0 * rng.uniform(-0.15, 0.15, (n_area, ROWS)), slope=AREA0 * rng.normal(size=(n_area, ROWS)) * 1e-3,
        rate=AREA0 * rng.normal(size=(n_area, ROWS)) * 10.0,
    )  # fmt: skip
    given.u = tap @ w + given.tap_s @ given.s
    return given


@pytest.mark.parametrize("fast", [0, 2])
@pytest.mark.parametrize("sizes", [(3,), (3, 3), (2, 4, 3)])
@pytest.mark.parametrize("seed", range(3))
def test_currents_and_the_distance_to_the_fold_under_mobile(seed: int, sizes: tuple[int, ...], fast: int) -> None:
    given = cells(seed, sizes, fast)
    n_f, n_area = len(given.c), len(sizes)
    x = new_coupling(given.tap.shape[1], n_f, 1)
    fill_coupling(
        x, H, given.rates, -given.tap.T.copy(), given.tap, given.tap_s, given.c, given.g, given.home, given.cell
    )
    eta = x.from_modes @ given.w + x.from_rates @ given.lin + x.from_stiff @ given.d
    eta += x.from_slopes @ given.ds + x.from_sources @ given.s
    chi = np.ascontiguousarray(x.held @ given.w + x.from_slopes @ given.s)
    rho, share, known = np.zeros((n_f, ROWS)), np.zeros((n_f, ROWS)), np.zeros((n_area, ROWS))
    least, first = np.zeros(ROWS), np.searchsorted(given.home, np.arange(n_area + 1))
    moving = Moving(
        given.u[given.cell].copy(), given.more, given.slope, given.rate, chi, eta, rho, known, share
    )  # fmt: skip
    answer_mobile(
        n_area > 1, x, given.home, first, given.cell, moving, np.zeros((n_f, n_area + 1, ROWS)),
        np.zeros((n_f, n_f + 1, ROWS)), least,
    )  # fmt: skip
    want, distance = solved(given)
    j = np.empty_like(rho)
    cell_currents(x.root, rho, j)
    np.testing.assert_allclose(j, want, rtol=0.0, atol=1e-10 * np.abs(want).max())
    np.testing.assert_allclose(least, distance, rtol=1e-10)


@pytest.mark.parametrize("n", [1, 2, 3, 9])
def test_small_symmetric_matrices_are_diagonalised(n: int) -> None:
    rng = np.random.default_rng(n)
    x = rng.normal(size=(n, n)) * np.geomspace(1.0, 1e-5, n)
    matrix = x.T @ x
    values, vectors = matrix.copy(), np.empty((n, n))
    diagonalise(values, vectors)
    np.testing.assert_allclose(vectors @ vectors.T, np.eye(n), atol=1e-14)
    np.testing.assert_allclose(vectors @ np.diag(np.diag(values)) @ vectors.T, matrix, atol=1e-15)
    # Small eigenvalues too: by the singular values of the factor, to their own digits.
    np.testing.assert_allclose(np.sort(np.diag(values)), np.sort(np.linalg.svd(x)[1] ** 2), rtol=1e-9)
