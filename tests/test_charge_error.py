"""Parts of a step against what is derived here: the error that it adds to the charge, and what couples its cells.

The former is checked against derivatives of the charge by the voltages, the latter against dense solutions of the same
equations, row by row.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.optimize import brentq

from fingerspice.engine.collocation import readout
from fingerspice.engine.collocation.readout import N_PLACES
from fingerspice.engine.many_areas import error as many_charge
from fingerspice.engine.many_areas import form as blocks
from fingerspice.engine.many_areas.coupling import STIFF, take_coupling
from fingerspice.engine.many_areas.form import Form
from fingerspice.engine.one_area import charge, rows
from fingerspice.engine.one_area.model import Model
from fingerspice.numerics.lobatto import END, FIRST, LOBES, MISS, NODES, POINTS, ROWS
from fingerspice.numerics.modes import diagonalise

PLACES = np.array([0, FIRST, FIRST + 1, FIRST + 2, END])
A0, H = 35e-6, 1e-3
every_law = pytest.mark.parametrize("law", ["local", "mobile"])
# What a step leaves to trapezoids through five places.
ROUGH = 0.04
X, W = np.polynomial.legendre.leggauss(12)


def area_at(u: np.ndarray | float) -> np.ndarray:
    """An area that falls with the gap voltage, m^2."""
    return A0 * (1.05 - 4e-4 * np.asarray(u) - 3e-7 * np.asarray(u) ** 2)


def slope_at(u: np.ndarray) -> np.ndarray:
    """Its slope, m^2/V."""
    return A0 * (-4e-4 - 6e-7 * np.asarray(u))


def integral(f: Callable[[np.ndarray], np.ndarray], stop: float) -> float:
    """Over [0, stop] fractions of the step, of a function of the fraction; s times its unit."""
    return float(0.5 * H * stop * np.sum(W * f(0.5 * stop * (1.0 + X))))


def gentle(rng: np.random.Generator, size: float) -> Polynomial:
    """A voltage that goes by a tenth of itself in the step, nearly straight."""
    return Polynomial(
        size * np.array([1.0, rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.1), rng.uniform(-0.01, 0.01)])
    )


def slope_of(charge_by: Callable[[float], np.ndarray]) -> np.ndarray:
    """Derivative by a perturbation at nothing."""
    return (charge_by(0.5) - charge_by(-0.5)) / 1.0


# A stack ----------------------------------------------------------------------------------------------------


@dataclass
class Stack:
    """Two modes of a stack over one step, their errors, and what of the slow layer's charge counts."""

    mobile: bool
    c: float
    g_area: float
    g_total: float
    modes: list[Polynomial]
    errors: list[Polynomial]
    gap: np.ndarray
    slow: np.ndarray
    source: Polynomial
    k_gap: float = 0.6

    @property
    def s(self) -> float:
        """Sum of 1/c such that the slow layer takes 0.3 of a jump."""
        return 1.0 / (0.3 * self.c) if self.c > 0.0 else 1e6

    @property
    def model(self) -> Model:
        """As the engine takes it."""
        return Model(
            mobile=self.mobile, coupled=True, k=np.zeros(3), rate=np.zeros(3), rate0=np.zeros(3), k_gap=self.k_gap,
            gap=self.gap, s=self.s, slow=np.array([*self.slow, 0.3, self.c, self.g_area, self.g_total]), area0=A0,
            tau=1e-3, curve=np.zeros(4),
        )  # fmt: skip

    def at(self, x: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gap voltage and slow layer's voltage (V), and area (m^2), with so much of the errors on the modes."""
        w = np.array([m(x) + error * e(x) for m, e in zip(self.modes, self.errors, strict=True)])
        free, along = self.k_gap * self.source(x), self.gap @ w
        if not self.mobile:
            u = free + along
            return u, 0.3 * self.source(x) + self.slow @ w, area_at(u)
        u = np.array([
            brentq(lambda v, f=f, b=b: v - f - b * A0 / float(area_at(v)), 0.0, 500.0, xtol=1e-12)
            for f, b in zip(np.atleast_1d(free), np.atleast_1d(along), strict=True)
        ]).reshape(np.shape(free))  # fmt: skip
        area = area_at(u)
        return u, 0.3 * self.source(x) + self.slow @ w * A0 / area, area

    def charge(self, stop: float, error: float) -> tuple[float, float]:
        """Charge through the slow layer from the start to a fraction of the step, and the part that has leaked, C.

        i = C u' + u/R under `local`, (C u)' + u/R under `mobile`.
        """
        leaked = integral(lambda x: (self.g_total + self.g_area * self.at(x, error)[2]) * self.at(x, error)[1], stop)
        if self.mobile:
            ends = [self.c * a * v for _, v, a in (self.at(np.array([x]), error) for x in (0.0, stop))]
            return float(ends[1][0] - ends[0][0]) + leaked, leaked
        d = 1e-4

        def current(x: np.ndarray) -> np.ndarray:
            rate = (self.at(x + d, error)[1] - self.at(x - d, error)[1]) / (2.0 * d * H)
            return self.c * self.at(x, error)[2] * rate

        return integral(current, stop) + leaked, leaked

    def held(self, x: float) -> float:
        """What the error is worth that is stored at a fraction of the step, C."""
        at = np.array([x])
        if self.mobile:
            return float(self.c * slope_of(lambda e: self.at(at, e)[2] * self.at(at, e)[1])[0])
        return float(self.c * self.at(at, 0.0)[2][0] * slope_of(lambda e: self.at(at, e)[1])[0])


def stack(rng: np.random.Generator, law: str, parts: str) -> Stack:
    """A random step of which the slow layer stores, leaks or both, and one of the modes or both are off."""
    shares = rng.uniform(0.3, 1.0, 4) * rng.choice([-1.0, 1.0], 4)
    errors = [Polynomial([1e-3 * rng.uniform(0.5, 1.0) * rng.choice([-1.0, 1.0]), 1e-4 * rng.normal()]) for _ in "ab"]
    return Stack(
        law == "mobile", 1e-5 * ("stores" in parts), 1e-2 * ("area" in parts), 3e-7 * ("leaks" in parts),
        [gentle(rng, 20.0), gentle(rng, -15.0)], errors, shares[:2], shares[2:], gentle(rng, 150.0),
    )  # fmt: skip


def engine_account(
    step: Stack, before: float = 0.0, last_area: float = np.inf, kept: float = 0.0, missed: np.ndarray | None = None
) -> tuple[float, float]:  # fmt: skip
    """What stayed and the error after the engine's account of the step, with a jump before it from an area (m^2).

    With `missed` the modes are at rest, but for this error (V) at the points between the nodes, which is all of it.
    """
    u, _, area = step.at(POINTS, 0.0)
    if missed is None:
        w, places = np.array([m(POINTS) for m in step.modes]), np.array([e(POINTS[PLACES]) for e in step.errors])
    else:
        w = np.array([np.full(ROWS, m(0.0)) for m in step.modes])
        w[:, FIRST:] += missed
        places = np.zeros((2, N_PLACES))
        places[:, 1 : N_PLACES - 1] = missed
    work = rows.new_stack_work(2)
    work.modal.brief[:, 1 : N_PLACES - 1] = 0.0 if missed is None else missed
    r, work.modal.w[:], work.modal.places[:] = work.r, w, places
    r[rows.SOURCE], r[rows.U], r[rows.Q] = step.source(POINTS), u, 1.0 / area
    r[rows.DQ], r[rows.X_GAP] = -slope_at(u) / area**2, step.gap @ w
    control, collected = np.zeros(1, readout.CONTROL)[0], np.array([[before], [0.0]])
    control["last_q"] = 1.0 / last_area
    charge._account(step.model, step.gap, step.slow, work, H, 1.0, 0.0, kept, control, collected)
    return float(collected[0, 0]), float(control["error_q"])


def judge(step: Stack | Net, total: list[float], account: Callable[[float], tuple[float, float]]) -> float:
    """Compare the engine's account with `total`, what a unit of the errors is worth in the charge at the places, C.

    What the trapezoids miss is a share of all that was added up, whatever is left of it. What was collected before adds
    to it with its sign. Returns the scale of both, C.
    """
    held = np.array([step.held(x) for x in POINTS[PLACES]])
    stays = np.array(total) - (held - held[0])
    spread = np.abs(np.diff(stays, prepend=0.0)).sum()
    scale = float(max(np.abs(stays).max(), np.abs(held).max()))
    for before in (0.0, 3.0 * scale, -3.0 * scale):
        collected, error = account(before)
        assert collected - before == pytest.approx(stays[-1], abs=ROUGH * spread + 1e-9 * scale)
        # Since the start of the run, where nothing was off.
        want = np.max(np.abs(held + stays + before))
        assert error == pytest.approx(want, rel=0.0, abs=2.0 * ROUGH * (want + spread))
    return scale


@every_law
@pytest.mark.parametrize("parts", ["stores", "leaks", "leaks by its area", "stores and leaks, also by its area"])
@pytest.mark.parametrize("seed", range(4))
def test_what_a_stack_leaves_in_the_charge_is_its_derivative_by_the_voltages(seed: int, parts: str, law: str) -> None:
    step = stack(np.random.default_rng([seed, 3]), law, parts)
    total = [step.charge(x, 0.5)[0] - step.charge(x, -0.5)[0] for x in POINTS[PLACES]]
    scale = judge(step, total, lambda before: engine_account(step, before))
    # What stays with a sign that is not known is as likely to add as to take away.
    error, both = engine_account(step)[1], engine_account(step, kept=3.0 * scale)[1]
    assert both == pytest.approx(np.hypot(error, 3.0 * scale), rel=1e-12, abs=0.0)


def test_both_ends_of_a_jump_s_move_are_off_in_its_charge() -> None:
    # A jump's charge is the integral of A dU / S: an error of the gap voltage moves both of its ends.
    step = stack(np.random.default_rng(8), "local", "stores")
    area = float(step.at(np.array([0.0]), 0.0)[2][0])
    before = 1.1 * area
    added = engine_account(step, last_area=before)[0] - engine_account(step)[0]
    # From u1 to u2 the charge is the integral of A du / (k S): moved by d, (A(u2) - A(u1)) d / (k S).
    moved = float(step.gap @ [e(0.0) for e in step.errors])
    assert added == pytest.approx((area - before) * moved / (step.k_gap * step.s), rel=1e-9, abs=0.0)


@every_law
def test_what_a_stack_s_polynomials_miss_between_nodes_does_not_leak(law: str) -> None:
    # Modes that wriggle about their own by a polynomial that is zero at every node, and an error that is just that.
    step, size = stack(np.random.default_rng(5), law, "leaks"), 1e-3
    leaked = size * H * 3e-7 * np.abs(step.slow).sum()
    assert abs(engine_account(step, missed=size * MISS)[0]) <= 1e-6 * leaked


# A network --------------------------------------------------------------------------------------------------


@dataclass
class Net:
    """Two modes of a network over one step, their errors, and two cells on one area, of which the first is the gap."""

    mobile: bool
    slow: bool
    stored: np.ndarray
    lost: np.ndarray
    through: np.ndarray
    tap: np.ndarray
    c: np.ndarray
    g: np.ndarray
    modes: list[Polynomial]
    errors: list[Polynomial]

    def at(self, x: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Modes, cells' voltages (V) and area (m^2)."""
        w = np.array([m(x) + error * e(x) for m, e in zip(self.modes, self.errors, strict=True)])
        u = self.tap @ w[:2]
        return w[:2], u, A0 * w[2] if self.slow else area_at(u[0])

    def charge(self, stop: float, error: float) -> float:
        """Of the source since the start of the step, to a fraction of it, C."""
        (w0, u0, a0), (w1, u1, a1) = (self.at(np.array([x]), error) for x in (0.0, stop))
        total = float((self.stored @ (w1 - w0))[0])
        total += integral(lambda x: self.lost @ self.at(x, error)[0], stop)
        d = 1e-4
        for b, share in enumerate(self.through):
            total += share * integral(
                lambda x, b=b: self.g[b] * (self.at(x, error)[2] - A0) * self.at(x, error)[1][b], stop
            )
            if self.mobile:
                total += share * self.c[b] * float(((a1 - A0) * u1[b] - (a0 - A0) * u0[b])[0])
            else:
                total += share * integral(
                    lambda x, b=b: self.c[b] * (self.at(x, error)[2] - A0)
                    * (self.at(x + d, error)[1][b] - self.at(x - d, error)[1][b]) / (2.0 * d * H), stop
                )  # fmt: skip
        return total

    def held_by(self, x: float, share: float) -> float:
        """What an error of `share` of every mode is worth at a fraction of the step, per volt, C/V."""
        return dataclasses.replace(self, errors=[Polynomial([share])] * len(self.errors)).held(x)

    def leak_by(self, x: float, share: float) -> float:
        """What of it leaks, A/V."""
        at, off = np.array([x]), share * self.tap.sum(axis=1)
        _, u, a = self.at(at, 0.0)
        moved = slope_at(u[0])[0] * off[0]
        both = (a[0] - A0) * off + u[:, 0] * moved
        return float(share * self.lost.sum() + (self.through * self.g * both).sum())

    def held(self, x: float) -> float:
        """What the error is worth that is stored at a fraction of the step, C."""
        at = np.array([x])
        _, _, a = self.at(at, 0.0)
        value = float((self.stored @ slope_of(lambda e: self.at(at, e)[0]))[0])
        for b, share in enumerate(self.through):
            if self.mobile:
                change = slope_of(lambda e, b=b: (self.at(at, e)[2] - A0) * self.at(at, e)[1][b])
            else:
                change = (a - A0) * slope_of(lambda e, b=b: self.at(at, e)[1][b])
            value += share * self.c[b] * float(change[0])
        return value


def form_with(**own: object) -> Form:
    """A form with these fields alone."""
    parts = {name: np.zeros((0, 0)) for name in Form._fields}
    flat = ("numbers", "rates", "area0", "size", "c", "g", "unit", "pace", "stress", "lo", "scale")
    parts |= {name: np.zeros(0) for name in flat} | {name: np.zeros(0, np.int64) for name in ("home", "first", "slow")}
    return Form(**(parts | own))


def form_of(step: Net) -> Form:
    """What of a form the charges of a network need."""
    return form_with(
        stored=step.stored[None, :], lost=step.lost[None, :], through=step.through[None, :], tap=step.tap, c=step.c,
        g=step.g, home=np.zeros(2, np.int64), first=np.array([0, 2]), cell=np.zeros(1, np.int64), unit=np.array([A0]),
        slow=np.array([2 if step.slow else -1]), mobile=step.mobile,
    )  # fmt: skip


def engine_charge(
    step: Net, places: np.ndarray, missed: np.ndarray, before: float = 0.0, theta: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """What stayed (2,) and `control` after the engine's account of a step."""
    _, u, area = step.at(POINTS, 0.0)
    z = np.array([[step.charge(x, 0.0) for x in POINTS]])
    control, collected = np.zeros(1, readout.CONTROL)[0], np.array([[before], [0.0]])
    form = form_of(step)
    work = blocks.new_network_work(len(places), len(places), form.c.size, form.cell.size, 1, 1)
    work.areas[blocks.AREA], work.areas[blocks.MORE] = area, area - A0
    work.areas[blocks.SLOPE] = 0.0 if step.slow else slope_at(u[0])
    work.cells[blocks.CELL_U], work.modal.places[:], work.off[:, : len(places)] = u, places, missed
    many_charge.charge_error(form, work, LOBES, H, theta, z, collected, control)
    return collected[:, 0], control


def network(rng: np.random.Generator, law: str, parts: str, slow: bool) -> Net:
    def some(size: float, name: str) -> np.ndarray:
        return size * rng.uniform(0.3, 1.0, 2) * rng.choice([-1.0, 1.0], 2) * (name in parts)

    errors = [Polynomial([1e-3 * rng.uniform(0.5, 1.0) * rng.choice([-1.0, 1.0]), 1e-4 * rng.normal()]) for _ in "ab"]
    modes = [gentle(rng, 120.0), gentle(rng, -90.0)]
    if slow:
        modes.append(Polynomial([0.9, rng.choice([-0.05, 0.05])]))
        errors.append(Polynomial([2e-5, 1e-6]))
    return Net(
        law == "mobile", slow, some(3e-10, "reference"), some(1e-7, "reference"), rng.uniform(0.4, 1.0, 2),
        rng.uniform(0.2, 1.0, (2, 2)), np.abs(some(1e-5, "stores")), np.abs(some(1e-2, "leaks")), modes, errors,
    )  # fmt: skip


@every_law
@pytest.mark.parametrize("slow", [False, True], ids=["area at once", "slow area"])
@pytest.mark.parametrize("parts", ["reference", "stores", "leaks", "reference, stores, leaks"])
@pytest.mark.parametrize("seed", range(3))
def test_what_a_network_leaves_in_the_charge_is_its_derivative(seed: int, parts: str, slow: bool, law: str) -> None:
    step = network(np.random.default_rng([seed, 4]), law, parts, slow)
    places = np.array([e(POINTS[PLACES]) for e in step.errors])

    def account(before: float) -> tuple[float, float]:
        collected, control = engine_charge(step, places, np.zeros((5, len(places))), before)
        return float(collected[0]), float(control["error_q"])

    judge(step, [step.charge(x, 0.5) - step.charge(x, -0.5) for x in POINTS[PLACES]], account)


@every_law
def test_what_polynomials_miss_between_nodes_is_stored_but_stays_only_where_a_step_is_cut_short(law: str) -> None:
    step = network(np.random.default_rng(6), law, "reference, stores, leaks", False)
    size = 1e-3
    places, missed = np.zeros((2, N_PLACES)), np.zeros((5, 2))
    places[:, 1 : N_PLACES - 1] = size * MISS
    missed[:3] = size * MISS[:, None]
    whole, control = engine_charge(step, places, missed)
    stored = size * max(abs(step.held_by(x, m)) for x, m in zip(POINTS[FIRST:], MISS, strict=True))
    assert whole[0] == 0.0
    # The areas' own polynomials are exact here to rounding.
    assert np.sqrt(whole[1]) <= 1e-9 * stored
    assert control["error_q"] >= 0.99 * stored
    cut, _ = engine_charge(step, places, missed, theta=0.6)
    leak = size * max(abs(step.leak_by(x, m)) for x, m in zip(POINTS[FIRST:], MISS, strict=True))
    # The largest integral of the node polynomial from the start of the step on, over its own largest value.
    x = np.linspace(0.0, 1.0, 20_001)
    product = np.prod(x[:, None] - POINTS[:NODES], axis=1)
    lobe = np.abs(np.cumsum(product)).max() * x[1] / np.abs(product).max()
    assert np.sqrt(cut[1]) == pytest.approx(lobe * H * leak, rel=0.02)


def test_the_places_of_the_error_are_where_this_file_says() -> None:
    assert PLACES.size == N_PLACES
    assert np.all(np.diff(POINTS[PLACES]) > 0.0)
    assert POINTS[PLACES[[0, -1]]].tolist() == [0.0, 1.0]


# The coupling between the cells of variable areas ---------------------------------------------------------------


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
    tap = np.linalg.qr(rng.normal(size=(n, n)))[0][:n_f] / np.sqrt(c * A0)[:, None]
    w = rng.normal(size=(n, ROWS)) * np.sqrt(c.mean() * A0) * 50.0
    given = SimpleNamespace(
        rates=rates, tap=tap, tap_s=rng.normal(size=(n_f, 1)), c=c, g=c * rng.uniform(1e2, 1e4, n_f), home=home,
        cell=np.array([int(np.flatnonzero(home == a)[0]) for a in range(n_area)]), w=w,
        lin=rates[:, None] * w * rng.uniform(-1.0, 1.0, (n, ROWS)), d=rng.normal(size=(n, ROWS)) * 1e-5,
        s=rng.normal(size=(1, ROWS)) * 100.0, ds=rng.normal(size=(1, ROWS)) * 1e5,
        more=A0 * rng.uniform(-0.15, 0.15, (n_area, ROWS)), slope=A0 * rng.normal(size=(n_area, ROWS)) * 1e-3,
        rate=A0 * rng.normal(size=(n_area, ROWS)) * 10.0,
    )  # fmt: skip
    given.u = tap @ w + given.tap_s @ given.s
    return given


@pytest.mark.parametrize("fast", [0, 2])
@pytest.mark.parametrize("sizes", [(3,), (3, 3), (2, 4, 3)])
@pytest.mark.parametrize("seed", range(3))
def test_currents_and_the_distance_to_the_fold_under_mobile(seed: int, sizes: tuple[int, ...], fast: int) -> None:
    given = cells(seed, sizes, fast)
    n, n_f, n_area = given.tap.shape[1], len(given.c), len(sizes)
    work = blocks.new_network_work(n, n, n_f, n_area, 1, 1)
    form = form_with(
        rates=given.rates, feed=-given.tap.T.copy(), tap=given.tap, tap_s=given.tap_s, c=given.c, g=given.g,
        home=given.home, cell=given.cell, first=np.searchsorted(given.home, np.arange(n_area + 1)), mobile=True,
    )  # fmt: skip
    x = work.own
    take_coupling(x, 0, H, form)
    eta = x.from_modes @ given.w + x.from_rates @ given.lin + x.from_stiff @ given.d
    eta += x.from_slopes @ given.ds + x.from_sources @ given.s
    work.cells[blocks.ETA], work.cells[blocks.CHI] = eta, x.held @ given.w + x.from_slopes @ given.s
    work.areas[blocks.U], work.areas[blocks.MORE] = given.u[given.cell], given.more
    work.areas[blocks.SLOPE], work.areas[blocks.RATE] = given.slope, given.rate
    least = np.zeros(ROWS)
    blocks.answer_mobile(form, work, n_area > 1, work.cells, work.areas, least)
    want, distance = solved(given)
    j = x.root @ work.cells[blocks.RHO]
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
