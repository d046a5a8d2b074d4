"""Steppers: order conditions of every tableau, and the orders met by the real engine with jumps and kinks."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pytest

import fingerspice as fs
from analytic import sine_segments, square_segments, transient
from fingerspice.numerics.tableaus import TABLEAUS, Tableau
from fingerspice.solve.problem import Problem, prepare
from fingerspice.solve.stepping import integrate
from scenes import table1

every_tableau = pytest.mark.parametrize("tableau", TABLEAUS.values(), ids=lambda t: t.name)

# Order conditions -------------------------------------------------------------------------------------------

Tree = tuple["Tree", ...]
"""A rooted tree: the tuple of the subtrees on its root."""


@lru_cache(None)
def trees(order: int) -> tuple[Tree, ...]:
    """All rooted trees with that many nodes: 1, 1, 2, 4, 9, 20, 48, 115, 286."""
    smaller = [(k, t) for k in range(1, order) for t in trees(k)]
    found: list[Tree] = []

    def hang(left: int, first: int, branches: Tree) -> None:
        if left == 0:
            found.append(branches)
        for i in range(first, len(smaller)):
            if smaller[i][0] <= left:
                hang(left - smaller[i][0], i, (*branches, smaller[i][1]))

    hang(order - 1, 0, ())
    return tuple(found)


def nodes(tree: Tree) -> int:
    return 1 + sum(nodes(t) for t in tree)


def density(tree: Tree) -> int:
    return nodes(tree) * math.prod(density(t) for t in tree)


def weight(tree: Tree, a: np.ndarray) -> np.ndarray:
    """The stages' elementary weights: the product over the branches of A times theirs."""
    out = np.ones(a.shape[0])
    for branch in tree:
        out = out * (a @ weight(branch, a))
    return out


def defect(b: np.ndarray, tableau: Tableau, order: int, theta: float = 1.0) -> float:
    """Largest defect of the conditions sum b_i Phi_i density = theta^order of one order."""
    return max(abs(b @ weight(t, tableau.a) * density(t) - theta**order) for t in trees(order))


def end_weights(tableau: Tableau) -> np.ndarray:
    return tableau.a[tableau.n_end]


def dense_weights(tableau: Tableau, theta: float) -> np.ndarray:
    return tableau.dense @ theta ** np.arange(1, tableau.dense.shape[1] + 1)


def test_there_are_as_many_trees_as_cayley_counted() -> None:
    assert [len(trees(k)) for k in range(1, 10)] == [1, 1, 2, 4, 9, 20, 48, 115, 286]


@every_tableau
def test_a_tableau_meets_the_conditions_up_to_its_order_and_no_further(tableau: Tableau) -> None:
    b = end_weights(tableau)
    for order in range(1, tableau.order + 1):
        assert defect(b, tableau, order) < 1e-12
    assert defect(b, tableau, tableau.order + 1) > 1e-3


@every_tableau
@pytest.mark.parametrize("theta", [0.1, 0.37, 0.5, 0.83])
def test_the_dense_output_meets_the_conditions_up_to_its_order_and_no_further(tableau: Tableau, theta: float) -> None:
    b = dense_weights(tableau, theta)
    for order in range(1, tableau.dense_order + 1):
        assert defect(b, tableau, order, theta) < 1e-12
    next_order = tableau.dense_order + 1
    assert defect(b, tableau, next_order, theta) > 1e-4 * theta**next_order


@every_tableau
def test_the_dense_output_joins_the_ends_of_the_step(tableau: Tableau) -> None:
    np.testing.assert_allclose(dense_weights(tableau, 1.0), end_weights(tableau), rtol=0, atol=2e-13)
    np.testing.assert_allclose(dense_weights(tableau, 1e-9) / 1e-9, slope_at_start(tableau), rtol=0, atol=1e-6)


def slope_at_start(tableau: Tableau) -> np.ndarray:
    """An explicit method's output leaves with the first stage; a collocation polynomial with its own slope."""
    if tableau.implicit:
        return tableau.dense[:, 0]
    return np.eye(tableau.c.size)[0]


@every_tableau
def test_the_error_estimate_vanishes_to_one_order_less_than_it_claims(tableau: Tableau) -> None:
    def lowest(e: np.ndarray) -> int:
        return next(k for k in range(1, 10) if max(abs(e @ weight(t, tableau.a)) for t in trees(k)) > 1e-6)

    order = lowest(tableau.e[0])
    if tableau.e[1].any():
        # Hairer's combination e5^2 / sqrt(e5^2 + 0.01 e3^2), e5 the smaller
        order = 2 * order - lowest(tableau.e[1])
    assert order == tableau.error_order


@every_tableau
def test_stages_are_consistent_and_an_explicit_method_looks_only_back(tableau: Tableau) -> None:
    np.testing.assert_allclose(tableau.a.sum(1), tableau.c, rtol=0, atol=1e-14)
    assert tableau.c[tableau.n_end] == 1.0
    if not tableau.implicit:
        assert not np.triu(tableau.a).any()


@pytest.mark.parametrize("tableau", [t for t in TABLEAUS.values() if t.implicit], ids=lambda t: t.name)
def test_an_implicit_method_damps_what_is_infinitely_stiff(tableau: Tableau) -> None:
    assert tableau.n_end == tableau.c.size - 1, "stiffly accurate"
    one = np.ones(tableau.c.size)
    b = end_weights(tableau)

    def growth(z: complex) -> float:
        return abs(1.0 + z * b @ np.linalg.solve(np.eye(one.size) - z * tableau.a, one))

    assert growth(-1e12) < 1e-10
    assert max(growth(1j * y) for y in np.logspace(-3, 6, 200)) <= 1.0 + 1e-12
    assert growth(-0.1) == pytest.approx(math.exp(-0.1), rel=1e-12)


# Orders in the engine ---------------------------------------------------------------------------------------

# 300 Hz: slow enough that kinks, jumps and decays matter, fast enough that the step that resolves the decays
# leaves an error far above rounding. A double then has room for more than four halvings at order 5, a little
# over two at order 8 and one and a half at order 9: `ENDS` and `INSIDES` are those ranges, in steps per period.
F, U0, PERIODS = 300.0, 100.0, 1.25
T_END = PERIODS / F
NEWTON = 1e-13
"""Local tolerance: with fixed steps it only says when the collocation equations are solved."""
STEPS = (10, 12, 14, 16, 18, 20, 24, 28, 32, 40, 48, 64, 80, 96, 128, 160, 192, 256, 320, 384, 512)
ENDS = {"dp5": (24, 512), "dop853": (10, 48), "radau9": (12, 32)}
INSIDES = {"dp5": (24, 512), "dop853": (16, 96), "radau9": (16, 64)}
SINE_PHASES = tuple(22.0 * k + 3.0 for k in range(8))
SQUARE_DUTIES = tuple(0.3 + 0.4 * k / 7 for k in range(8))
TIMES = np.append(np.sort(np.modf(np.arange(1, 1501) * 0.618033988749895)[0]) * T_END, T_END)
LEFT = np.append(np.zeros(1500, bool), True)


@lru_cache(None)
def scenes(wave: str, law: str) -> tuple[tuple[Problem, np.ndarray], ...]:
    """Scenes of one kind with the reference's layer voltages (n_t, 3) at TIMES."""
    out = []
    for value in SINE_PHASES if wave == "sine" else SQUARE_DUTIES:
        if wave == "sine":
            source: fs.Waveform = fs.Sine(U0, F, phase_deg=value)
            segments = sine_segments(U0, F, T_END, phase=math.radians(value))
        else:
            source = fs.Square(U0, F, duty=value)
            segments = square_segments(U0, F, math.ceil(PERIODS), duty=value)
        circuit = table1(f=F).replace({"Vdrive": source})
        problem = prepare(circuit, t_stop=T_END, t_eval=None, charge_law=law, area="coupled", start="uncharged")
        run = transient(segments, TIMES[:-1], freq=F, law=law)
        out.append((problem, np.vstack([run.u, run.at([T_END], side="left").u])))
    return tuple(out)


def errors(tableau: Tableau, wave: str, law: str, steps: int) -> tuple[float, float]:
    """Error in the layer voltages over U0, at the end and inside steps: rms over scenes of the largest."""
    end, inside = [], []
    for problem, exact in scenes(wave, law):
        run = integrate(problem, tableau, NEWTON, U0, TIMES, LEFT, h_fixed=1.0 / (F * steps), shadow=False)
        u = run.record(problem).u_layer
        difference = np.abs(u - exact).max(1) / U0
        end.append(difference[-1])
        inside.append(difference[:-1].max())
    return math.sqrt(np.mean(np.square(end))), math.sqrt(np.mean(np.square(inside)))


def order_seen(steps: list[int], values: list[float], next_order: bool) -> float:
    """Exponent p of error = C h^p, or C h^p exp(c h) with the next order told apart, by least squares."""
    h = 1.0 / np.array(steps)
    columns = [np.ones_like(h), np.log(h), h]
    matrix = np.column_stack(columns if next_order else columns[:2])
    return float(np.linalg.lstsq(matrix, np.log(values), rcond=None)[0][1])


@lru_cache(None)
def orders(name: str, wave: str, law: str) -> tuple[float, float]:
    """Orders at the ends of steps and inside."""
    ends, insides = ENDS[name], INSIDES[name]
    steps = [n for n in STEPS if min(ends[0], insides[0]) <= n <= max(ends[1], insides[1])]
    measured = {n: errors(TABLEAUS[name], wave, law, n) for n in steps}
    at_ends = [n for n in steps if ends[0] <= n <= ends[1]]
    inside = [n for n in steps if insides[0] <= n <= insides[1]]
    return (
        # Less than three halvings do not tell the next order apart.
        order_seen(at_ends, [measured[n][0] for n in at_ends], ends[1] >= 8 * ends[0]),
        order_seen(inside, [measured[n][1] for n in inside], True),
    )


every_scene = pytest.mark.parametrize("law", ["local", "mobile"])
every_wave = pytest.mark.parametrize("wave", ["sine", "square"])


@every_scene
@every_wave
@every_tableau
def test_the_end_of_a_step_converges_with_the_order_of_the_method(tableau: Tableau, wave: str, law: str) -> None:
    # Between kinks stand four to ten steps of radau9 and a shorter one: fewer full steps at a larger h make the
    # exponent look smaller. Order 6, without the step that ends on the kink, is far from this.
    allowed = 0.5 if (tableau.name, wave) == ("radau9", "sine") else 0.15
    assert orders(tableau.name, wave, law)[0] == pytest.approx(tableau.order, abs=allowed)


@every_scene
@every_wave
@every_tableau
def test_the_inside_of_a_step_converges_with_the_local_order_of_the_dense_output(
    tableau: Tableau, wave: str, law: str
) -> None:
    assert orders(tableau.name, wave, law)[1] == pytest.approx(tableau.dense_order + 1, abs=0.15)


def test_a_stepper_s_tolerance_is_relative_to_the_source() -> None:
    # So small a voltage moves no area: the circuit is linear, and a thousandth of the source gives a thousandth of all.
    evaluations = {
        fs.simulate(table1(), sources={"Vdrive": fs.Sine(u, 100)}, t_stop=0.02, rtol=1e-6, method="dop853").nfev
        for u in (1e-3, 1e-6, 1e-9)
    }
    assert max(evaluations) <= 1.02 * min(evaluations)
