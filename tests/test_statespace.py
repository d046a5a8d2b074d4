"""State space of series stacks, written in any order and direction, against a dense formulation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fingerspice as fs
from fingerspice.circuit.statespace import Stack, build_stack
from fingerspice.numerics.modes import modes
from scenes import deck, table1

SEARCH = settings(max_examples=50, derandomize=True, deadline=None)
EPS0 = 8.854e-12
AREA = 35e-6


@dataclass(frozen=True)
class Slice:
    """One layer of a random stack: thickness (m), permittivity, and r (ohm), rho (ohm m), or neither."""

    d: float
    eps_r: float
    r: float | None = None
    rho: float | None = None

    def line(self, name: str, p: str, n: str) -> str:
        if self.rho is not None:
            return f"{name} {p} {n} area SLAB d={self.d!r} eps_r={self.eps_r!r} rho={self.rho!r}"
        leak = "" if self.r is None else f" r={self.r!r}"
        return f"{name} {p} {n} area LAYER d={self.d!r} eps_r={self.eps_r!r}{leak}"

    @property
    def c(self) -> float:
        return EPS0 * self.eps_r / self.d

    def leak(self, area: float) -> float:
        """Leak current density over voltage at that area, S/m^2."""
        if self.rho is not None:
            return 1.0 / (self.rho * self.d)
        return 0.0 if self.r is None else 1.0 / (self.r * area)


logs = st.floats(-7.0, -4.0).map(lambda x: 10.0**x)
slices = st.one_of(
    st.builds(Slice, logs, st.floats(1.0, 50.0)),
    st.builds(Slice, logs, st.floats(1.0, 50.0), st.floats(3.0, 8.0).map(lambda x: 10.0**x)),
    st.builds(Slice, logs, st.floats(1.0, 50.0), st.none(), st.floats(2.0, 7.0).map(lambda x: 10.0**x)),
)


def chain(layers: list[Slice], turned: list[bool], order: list[int], source: str = "Vdrive n0 0 200") -> fs.Circuit:
    """Layers X0, X1, ... in series from node n0 to ground; `order` shuffles the lines, `turned` swaps p and n."""
    lines = []
    for i, layer in enumerate(layers):
        p, n = f"n{i}", "0" if i == len(layers) - 1 else f"n{i + 1}"
        lines.append(layer.line(f"X{i}", *((n, p) if turned[i] else (p, n))))
    lines += [source, f"Varea area 0 {AREA * 1e6!r}"]
    return deck(*(lines[i] for i in order), ".tran 1u 1m uic")


@st.composite
def chains(draw: st.DrawFn) -> tuple[list[Slice], list[bool], list[int]]:
    layers = draw(st.lists(slices, min_size=1, max_size=8))
    turned = draw(st.lists(st.booleans(), min_size=len(layers), max_size=len(layers)))
    return layers, turned, draw(st.permutations(range(len(layers) + 2)))


def dense_rates(layers: list[Slice], u: np.ndarray) -> tuple[np.ndarray, float]:
    """Rates of the layer voltages under a constant source, and of sum(lambda/c)/S, by the leaked charges.

    d lambda_x / dt = leak_x u_x; u_x = (D - lambda_x) / c_x; D = (U + sum lambda/c) / S. Nothing is reduced.
    """
    c = np.array([x.c for x in layers])
    rate = np.array([x.leak(AREA) for x in layers]) * u
    d_rate = np.sum(rate / c) / np.sum(1.0 / c)
    return (d_rate - rate) / c, d_rate


# Incidence --------------------------------------------------------------------------------------------------


def reduced(stack: Stack) -> tuple[np.ndarray, ...]:
    """The stack's modes at `AREA`, rows in loop order: w' = -rates w + gain U, x = shape @ w, u = k U + x; and feed."""
    order = list(stack.state_order)
    rates, gain, feed, shape = modes(stack.leak_rates(AREA)[order], stack.k[order])
    back = np.argsort(order)
    return rates, gain, shape[back], feed[back]


@SEARCH
@given(chains(), st.integers(0, 2**32 - 1))
def test_the_reduced_system_has_the_rates_of_the_dense_one(made, seed: int) -> None:
    layers, turned, order = made
    stack = build_stack(chain(layers, turned, order))
    n = len(layers)
    rates, gain, shape, feed = reduced(stack)
    assert shape.shape == feed.shape == (n, n - 1)
    start = np.random.default_rng(seed).uniform(-100.0, 100.0, n)
    start -= start.sum() * stack.k
    u_source = 137.0
    # `feed` takes -p + k sum(p) to modes; here p = -start, and sum(start) is zero
    w = -start @ feed
    u = stack.k * u_source + shape @ w
    np.testing.assert_allclose(shape @ w, start, rtol=0, atol=1e-12 * 100.0)
    assert u.sum() == pytest.approx(u_source, abs=1e-10)
    got = shape @ (-rates * w + gain * u_source)
    dense, d_rate = dense_rates(layers, u)
    # Rounding is that of the leaks, which may cancel (in a single layer they do so exactly).
    scale = float(max(abs(x.leak(AREA) * v / x.c) for x, v in zip(layers, u, strict=True))) + 1e-300
    np.testing.assert_allclose(got, dense, rtol=0, atol=1e-12 * scale)
    # What is left of D' after every layer's own c u' is the leak: any layer gives it.
    leaks = stack.leak_rates(AREA) * stack.c * u
    bound = 1e-13 * float((stack.c * scale).max())
    np.testing.assert_allclose(stack.c * got + leaks, d_rate, rtol=1e-11, atol=100.0 * bound)


@pytest.mark.parametrize("n", range(1, 9))
def test_n_layers_have_n_voltages_and_n_minus_one_live_states(n: int) -> None:
    layers = [Slice(1e-6 * (i + 1), 2.0 + i, r=1e6) for i in range(n)]
    circuit = chain(layers, [False] * n, list(range(n + 2)), "Vdrive n0 0 SIN(0 10 1k)")
    solution = fs.simulate(circuit, rtol=1e-6)
    assert solution.u_layer.shape == (solution.t.size, n)
    assert solution.state.y.size == n, "n - 1 voltages and the charge"
    np.testing.assert_allclose(solution.u_layer.sum(1), solution.u_source, rtol=0, atol=1e-12 * 10.0)


@pytest.mark.parametrize("n", [1, 3, 8])
def test_without_resistors_the_voltages_split_by_the_inverse_capacitances_for_ever(n: int) -> None:
    layers = [Slice(1e-6 * (i + 1), 2.0 + i) for i in range(n)]
    circuit = chain(layers, [False] * n, list(range(n + 2)), "Vdrive n0 0 SQUARE(10 1k)")
    solution = fs.simulate(circuit)
    share = np.array([1.0 / x.c for x in layers]) / sum(1.0 / x.c for x in layers)
    np.testing.assert_allclose(solution.u_layer, np.outer(solution.u_source, share), rtol=0, atol=1e-14 * 10.0)
    assert np.all(reduced(build_stack(circuit))[0] == 0.0)


# Sources ----------------------------------------------------------------------------------------------------


def test_sources_in_series_add_with_their_directions_and_their_nodes_have_their_potentials() -> None:
    layers = ("Xcoat n1 n2 area LAYER d=1u eps_r=3.9 r=0.2meg", "Xair n3 0 area LAYER d=3.5u eps_r=1 r=1meg")
    circuit = deck("Va n0 0 7", "Vb n1 n0 3", *layers, "Vc n2 n3 SIN(0 2 1k)", "Varea area 0 35", ".tran 20u 1m uic")
    stack = build_stack(circuit)
    t = np.linspace(0.0, 1e-3, 11)
    np.testing.assert_allclose(stack.waveform.value(t), 10.0 - 2.0 * np.sin(2e3 * math.pi * t), atol=1e-13)
    solution = fs.simulate(circuit, rtol=1e-6)
    v = solution.node_voltages | {"0": np.zeros(solution.t.size)}
    np.testing.assert_allclose(v["n0"], 7.0)
    np.testing.assert_allclose(v["n1"] - v["n0"], 3.0)
    np.testing.assert_allclose(v["n2"] - v["n3"], 2.0 * np.sin(2e3 * math.pi * solution.t), atol=1e-12)
    assert_every_layer_spans_its_nodes(circuit, solution)


def assert_every_layer_spans_its_nodes(circuit: fs.Circuit, solution: fs.Solution) -> None:
    v = {k.lower(): x for k, x in solution.node_voltages.items()} | {"0": np.zeros(solution.t.size)}
    for name, u in zip(solution.layers, solution.u_layer.T, strict=True):
        p, n = circuit[name].nodes[:2]
        np.testing.assert_allclose(v[p] - v[n], u, rtol=0, atol=1e-11)


@settings(max_examples=12, derandomize=True, deadline=None)
@given(chains(), st.booleans())
def test_every_layer_spans_its_own_nodes_and_turning_one_turns_its_sign(made, backwards: bool) -> None:
    layers, turned, order = made
    n = len(layers)
    source = "Vdrive 0 n0 SIN(0 10 1k)" if backwards else "Vdrive n0 0 SIN(0 10 1k)"
    circuit = chain(layers, turned, order, source)
    straight = chain(layers, [False] * n, list(range(n + 2)), "Vdrive n0 0 SIN(0 10 1k)")
    t = [1e-5, 1e-4, 2e-4]
    a, b = (fs.simulate(x, t_eval=t, rtol=1e-8) for x in (circuit, straight))
    # The loop is walked from the source's positive side, whatever the order of lines and the direction of each layer.
    assert a.layers == tuple(f"X{i}" for i in range(n))[:: -1 if backwards else 1]
    assert_every_layer_spans_its_nodes(circuit, a)
    for i in range(n):
        sign = (-1.0 if turned[i] else 1.0) * (-1.0 if backwards else 1.0)
        mine, reference = (s.u_layer[:, s.layers.index(f"X{i}")] for s in (a, b))
        np.testing.assert_allclose(sign * mine, reference, rtol=0, atol=2e-7)


# Table 1 ----------------------------------------------------------------------------------------------------


def test_an_area_fixed_by_the_gap_or_by_a_source_is_the_stacks_area() -> None:
    assert build_stack(table1(gap={"a_fix": 30})).area_given == pytest.approx(30e-6, rel=1e-15)
    assert build_stack(table1(gap={"a_fix": 0})).area_given is None


def test_a_given_area_that_is_replaced_counts_after_the_circuit_has_run() -> None:
    text = "t\nV1 a 0 SIN(0 20 1k)\nX1 a b area LAYER d=1u eps_r=3.9 r=1meg\nX2 b 0 area SLAB d=100u eps_r=10 rho=1e4\n"
    first = fs.parse_netlist(f"{text}Varea area 0 35\n.tran 1u 1m uic\n")
    fresh = fs.parse_netlist(f"{text}Varea area 0 70\n.tran 1u 1m uic\n")
    fs.simulate(first)
    for changed in (first.replace({"Varea": 70.0}), first.replace({"Varea.level": 70.0})):
        np.testing.assert_array_equal(fs.simulate(changed).i_source, fs.simulate(fresh).i_source)
        assert fs.phasor(changed, frequency=1e3).impedance == fs.phasor(fresh, frequency=1e3).impedance
