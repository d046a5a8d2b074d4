"""Invalid circuits are refused with the names of the elements at fault; circuits as data."""

import math

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.circuit.statespace import build_stack
from scenes import deck, table1

V = "Vdrive n0 0 SIN(0 200 100)"
COAT = "Xcoat n0 n1 area LAYER d=1u eps_r=3.9 r=0.2meg"
SLAB = "Xslab n1 0 area SLAB d=350u eps_r=1000 rho=1e4"
GAP_VALUES = "GAP d=3.5u eps_r=1 fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000"
GAP = f"Xgap n1 0 area {GAP_VALUES}"
AREA = "Varea area 0 35"

X = "LAYER d=1u eps_r=2"
ISLAND = "is floating: nothing connects it to ground"
REFUSALS = {
    "area driven by nothing": ([V, COAT, SLAB], "node 'area' gives Xcoat its area, but no GAP and no DC source"),
    "area driven twice": ([V, COAT, SLAB, AREA, "Vmore area 0 35"], "more than one source drives it"),
    "area that varies": ([V, COAT, SLAB, "Varea area 0 SIN(35 1 100)"], "Varea drives an area: allowed is a DC value"),
    "area upside down": ([V, COAT, SLAB, "Varea 0 area 35"], "Varea drives an area: allowed is a DC value"),
    "area of zero": ([V, COAT, SLAB, "Varea area 0 0"], "Varea drives an area: allowed is a DC value above 0"),
    "island": ([V, COAT, GAP, f"Xlost q r area {X}", f"Xmore q r area {X}"], ISLAND),
    "no ground": ([V.replace(" 0 ", " n9 ", 1), COAT, GAP.replace("n1 0", "n1 n9")], "no element touches ground"),
    "area node as a conductor": ([V, "Xcoat n0 area area LAYER d=1u eps_r=3.9", GAP], "is floating"),
    "antiparallel sources": ([V, "Vsecond 0 n0 5", COAT, GAP], "Vdrive and Vsecond are voltage sources in parallel"),
    "source loop": (
        [V, "Vb n0 n5 5", "Vc n5 0 5", COAT, GAP],
        "Vc closes a loop of voltage sources with Vdrive, Vb",
    ),
    "current source into nothing": (
        ["Idrive 0 drive 1m", "Ia drive 0 2m"],
        "Idrive is a current source without a path: node 'drive' is reached through current sources only",
    ),
    "area node under a resistor": ([V, COAT, GAP, "Rx area 0 1k"], "Rx and Xgap both drive the area node 'area'"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_topology_that_is_not_a_driven_stack_is_refused_by_name_and_with_its_place(case: str) -> None:
    lines, message = REFUSALS[case]
    with pytest.raises(fs.InputError) as caught:
        deck(*lines)
    assert message in str(caught.value)
    if ("X" in message or "V" in message[:6]) and not message.startswith("the circuit"):
        assert caught.value.where is not None
        name = lines[caught.value.where.line - 2].split()[0]
        assert name in str(caught.value), f"line {caught.value.where.line} is {name}"


NETWORKS = {
    "two gaps two areas": [V, f"Xone n0 n1 left {GAP_VALUES}", f"Xtwo n1 0 right {GAP_VALUES}"],
    "resistor across": [V, COAT, GAP, "Rbody n1 0 1k"],
    "capacitor across": [V, COAT, GAP, "Cbody n1 0 100p"],
    "current source": ["Idrive n0 0 1u", COAT, GAP],
    "resistor in series": [V.replace("n0", "n7"), "Rline n7 n0 1k", COAT, GAP],
    "parallel layers": [V, COAT, GAP, "Xside n0 n1 area LAYER d=1u eps_r=2"],
    "two loops": [V, COAT, GAP, "Vb m0 0 5", "Xb m0 0 area LAYER d=1u eps_r=2"],
    "area with dynamics of its own": [V, COAT, GAP + " tau=1m"],
    "no layer at all": [V, "R1 n0 n1 1k", "C1 n1 0 1n"],
}


@pytest.mark.parametrize("case", NETWORKS)
def test_what_is_not_a_stack_is_a_network(case: str) -> None:
    circuit = deck(*NETWORKS[case])
    with pytest.raises(fs.InputError, match="needs a series chain of LAYER, SLAB, SKIN and GAP"):
        build_stack(circuit)
    options = {"t_stop": 1e-4, "t_eval": np.linspace(1e-5, 1e-4, 10)}
    solution = fs.simulate(circuit, rtol=1e-6, **options)
    exact = fs.simulate(circuit, rtol=1e-9, method="radau", **options)
    largest = max(float(np.abs(v).max()) for v in exact.node_voltages.values())
    assert largest > 1e-3
    for node, v in exact.node_voltages.items():
        assert np.abs(solution.node_voltages[node] - v).max() <= 3e-6 * largest


# Circuits as data -------------------------------------------------------------------------------------------


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
    circuit = table1(source)
    for path, parameter in circuit.parameters.items():
        other = 1e8 if math.isinf(parameter.value) else parameter.value * 1.01 if parameter.value else 1e-4
        changed = circuit.replace({path: other})
        assert changed.parameters[path].value != parameter.value
        others = {p: v for p, v in changed.parameters.items() if p != path}
        assert others == {p: v for p, v in circuit.parameters.items() if p != path}
        assert changed.replace({path: parameter.value}).elements == circuit.elements
        assert circuit.parameters[path].value == parameter.value
        assert path in changed.overrides
