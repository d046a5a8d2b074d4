"""Circuits: refused topologies, parameters as data, and series stacks in any order against a dense formulation."""

import math
from dataclasses import dataclass

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fingerspice as fs
from fingerspice.circuit.statespace import build_stack
from scenes import deck, listed, refuses, table1

SEARCH = settings(max_examples=50, derandomize=True, deadline=None)
# Rates twelve decades apart, squared in the characteristic polynomial, with room to spare.
DIGITS = 80
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
# Of a few decades, exactly or nearly, or anywhere.
near = st.tuples(st.sampled_from([1e-3, 1.0, 1e6]), st.sampled_from([1.0, 1.0 + 2.3e-16, 1.0 + 1e-13, 1.0 + 1e-9]))
ohms = st.one_of(near.map(lambda x: x[0] * x[1]), st.floats(-3.0, 9.0).map(lambda x: 10.0**x))
slices = st.one_of(
    st.builds(Slice, logs, st.floats(1.0, 50.0)),
    st.builds(Slice, st.just(1e-6), st.just(3.0), ohms),
    st.builds(Slice, logs, st.floats(1.0, 50.0), ohms),
    st.builds(Slice, logs, st.floats(1.0, 50.0), st.none(), st.floats(2.0, 7.0).map(lambda x: 10.0**x)),
)
Made = tuple[list[Slice], list[bool], list[int]]


def chain(layers: list[Slice], turned: list[bool], order: list[int], source: str = "Vdrive n0 0 200") -> fs.Circuit:
    """Layers X0, X1, ... in series from node n0 to ground; `order` shuffles the lines, `turned` swaps p and n."""
    lines = []
    for i, layer in enumerate(layers):
        p, n = f"n{i}", "0" if i == len(layers) - 1 else f"n{i + 1}"
        lines.append(layer.line(f"X{i}", *((n, p) if turned[i] else (p, n))))
    lines += [source, f"Varea area 0 {AREA * 1e6!r}"]
    return deck(*(lines[i] for i in order), ".tran 1u 1m uic")


@st.composite
def chains(draw: st.DrawFn) -> Made:
    layers = draw(st.lists(slices, min_size=1, max_size=8))
    turned = draw(st.lists(st.booleans(), min_size=len(layers), max_size=len(layers)))
    return layers, turned, draw(st.permutations(range(len(layers) + 2)))


def exact(layers: list[Slice], times: list[float]) -> tuple[list[mp.mpf], list[np.ndarray]]:
    """Rates (1/s, ascending, as many as layers but one) and layer voltages (V) after 200 V came on, to many digits.

    x' = (k 1^T - I) diag(r) (x + k U) where u = x + k U, nothing reduced: the whole matrix, with one rate of zero more.
    """
    with mp.workdps(DIGITS):
        n = len(layers)
        inverse = [1 / mp.mpf(x.c) for x in layers]
        share = mp.matrix([x / mp.fsum(inverse) for x in inverse])
        leaks = mp.diag([mp.mpf(x.leak(AREA)) * y for x, y in zip(layers, inverse, strict=True)])
        matrix = (share * mp.ones(1, n) - mp.eye(n)) * leaks
        rates = sorted(abs(x) for x in mp.eig(matrix)[0])[1:]
        driven = mp.zeros(n + 1)
        driven[:n, :n], driven[:n, n] = matrix, 200 * matrix * share
        moved = [mp.expm(driven * t)[:n, n] + 200 * share for t in times]
        return rates, [np.array([float(x) for x in u]) for u in moved]


@SEARCH
@given(chains())
def test_rates_and_voltages_have_their_digits_though_rates_are_decades_apart_or_coincide(made: Made) -> None:
    layers, turned, order = made
    circuit = chain(layers, turned, order)
    times = [2e-5]
    rates, voltages = exact(layers, times)
    found = sorted(fs.plan(circuit).rates)
    assert len(found) == len(rates) == len(layers) - 1
    for got, want in zip(found, rates, strict=True):
        assert abs(got - want) <= 1e-13 * want + mp.mpf(10) ** -30
    # A run that ends at the last time, so that nothing else rounds it.
    solution = fs.simulate(circuit, t_eval=times, t_stop=times[-1])
    signs = np.array([-1.0 if turned[int(name[1:])] else 1.0 for name in solution.layers])
    back = [int(name[1:]) for name in solution.layers]
    np.testing.assert_allclose(solution.u_layer * signs, np.array(voltages)[:, back], rtol=0, atol=200.0 * 1e-12)


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


def test_a_given_area_that_is_replaced_counts_after_the_circuit_has_run() -> None:
    text = "t\nV1 a 0 SIN(0 20 1k)\nX1 a b area LAYER d=1u eps_r=3.9 r=1meg\nX2 b 0 area SLAB d=100u eps_r=10 rho=1e4\n"
    first = fs.parse_netlist(f"{text}Varea area 0 35\n.tran 1u 1m uic\n")
    fresh = fs.parse_netlist(f"{text}Varea area 0 70\n.tran 1u 1m uic\n")
    fs.simulate(first)
    for changed in (first.replace({"Varea": 70.0}), first.replace({"Varea.level": 70.0})):
        np.testing.assert_array_equal(fs.simulate(changed).i_source, fs.simulate(fresh).i_source)
        assert fs.phasor(changed, frequency=1e3).impedance == fs.phasor(fresh, frequency=1e3).impedance


VALUES = "GAP d=3.5u eps_r=1 fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000"
LINES = {
    "V": "Vdrive n0 0 SIN(0 200 100)",
    "COAT": "Xcoat n0 n1 area LAYER d=1u eps_r=3.9 r=0.2meg",
    "SLAB": "Xslab n1 0 area SLAB d=350u eps_r=1000 rho=1e4",
    "GAP": f"Xgap n1 0 area {VALUES}",
    "VALUES": VALUES,
}
TOPOLOGIES, NO_STACKS = listed("topologies"), listed("no_stacks")


def filled(lines: list[str]) -> list[str]:
    return [line.format(**LINES) for line in lines]


@pytest.mark.parametrize(("lines", "message"), [row[1:] for row in TOPOLOGIES], ids=[row[0] for row in TOPOLOGIES])
def test_a_topology_that_is_not_a_driven_stack_is_refused_by_name_and_with_its_place(lines, message: str) -> None:
    lines = filled(lines)
    with pytest.raises(fs.InputError) as caught:
        deck(*lines)
    assert message in str(caught.value)
    if ("X" in message or "V" in message[:6]) and not message.startswith("the circuit"):
        assert caught.value.where is not None
        name = lines[caught.value.where.line - 2].split()[0]
        assert name in str(caught.value), f"line {caught.value.where.line} is {name}"


@pytest.mark.parametrize("lines", [lines for _, lines in NO_STACKS], ids=[name for name, _ in NO_STACKS])
def test_what_is_not_a_stack_is_a_network(lines: list[str]) -> None:
    circuit = deck(*filled(lines))
    refuses("needs a series chain of LAYER, SLAB, SKIN and GAP", build_stack, circuit)
    options = {"t_stop": 1e-4, "t_eval": np.linspace(1e-5, 1e-4, 10)}
    solution = fs.simulate(circuit, rtol=1e-6, **options)
    exact = fs.simulate(circuit, rtol=1e-9, method="radau", **options)
    largest = max(float(np.abs(v).max()) for v in exact.node_voltages.values())
    assert largest > 1e-3
    for node, v in exact.node_voltages.items():
        assert np.abs(solution.node_voltages[node] - v).max() <= 3e-6 * largest


def test_every_parameter_is_listed_by_path_with_value_and_unit() -> None:
    parameters = table1().parameters
    expected = {
        "Vdrive.amplitude": (200.0, "V"), "Vdrive.frequency": (100.0, "Hz"), "Xcoat.eps_r": (3.9, ""),
        "Xcoat.r": (2e5, "ohm"), "Xgap.d": (3.5e-6, "m"), "Xgap.fn": (0.5, "N"), "Xgap.alpha": (54.4, "mm^2/N^m"),
        "Xgap.beta": (32.0, "mm^(2-n)"), "Xgap.c2": (5000.0, "mm^4/N^2"), "Xgap.a_fix": (0.0, "mm^2"),
    }  # fmt: skip
    assert {path: (parameters[path].value, parameters[path].unit) for path in expected} == expected
    with pytest.raises(TypeError):
        parameters["Xgap.d"] = 1.0  # type: ignore[index]


@pytest.mark.parametrize(
    "source",
    ["SIN(1 200 100 1m 3 20)", "SQUARE(200 100 0.3)", "PULSE(0 5 1m 1u 1u 2m 10m)", "EXP(0 1 1m 1m 5m 1m)", "5"],
)
def test_replace_changes_one_parameter_and_changing_it_back_restores_the_circuit(source: str) -> None:
    circuit = table1(source, gap={"v": 0.02})
    for path, parameter in circuit.parameters.items():
        other = 1e8 if math.isinf(parameter.value) else parameter.value * 1.01 if parameter.value else 1e-4
        changed = circuit.replace({path: other})
        assert changed.parameters[path].value != parameter.value
        others = {p: v for p, v in changed.parameters.items() if p != path}
        assert others == {p: v for p, v in circuit.parameters.items() if p != path}
        assert changed.replace({path: parameter.value}).elements == circuit.elements
        assert circuit.parameters[path].value == parameter.value
        assert path in changed.overrides
