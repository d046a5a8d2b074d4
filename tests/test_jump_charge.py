"""The charge of an ideal jump under `local`: the integral of the area over the gap's voltage."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from scenes import deck, table1

VOLTS = [1e-6, 30.0, 200.0, 1e3, 1e4, 1e5, 1e6]


def expected_charge(levels, layers, gap):
    """Charge (C) that the terminals take when the source of layers without leaks goes through these levels, V."""
    elastance = sum(1.0 / layer.c for layer in layers)
    share = 1.0 / layers[gap].c / elastance
    primitive = [ref.area_primitive(share * u) for u in levels]
    return [(b - primitive[0]) / share / elastance for b in primitive]


def quietly(circuit, **more):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fs.FingerspiceWarning)
        return fs.simulate(circuit, **more)


@pytest.mark.parametrize("volts", VOLTS)
def test_a_dc_step_takes_the_integral_of_the_area_within_its_stated_error(volts):
    # 4.9e-5 off at 10 kV and 4 % at 100 kV, where 6e-10 was stated.
    solution = quietly(table1(), sources={"Vdrive": volts}, t_stop=1e-4, t_eval=[0.0], rtol=1e-10, throw=False)
    layers = ref.table1_layers(100.0)
    (_, charge) = expected_charge([0.0, volts], layers, 1)
    assert abs(solution.q_source[0] - charge) <= solution.error.q_source
    assert solution.q_source[0] == pytest.approx(charge, rel=1e-13)


NO_LEAK = """stack without leaks
Vdrive drive 0 {source}
Xcoat drive top area LAYER d=1u eps_r=3.9
Xgap top skin area GAP d=3.5u eps_r=1 fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000
Xskin skin 0 area LAYER d=350u eps_r=1500
.tran 0.1m 1m uic
"""


@pytest.mark.parametrize("volts", VOLTS)
def test_every_output_of_the_algebraic_tier_has_the_charge_of_its_way(volts):
    circuit = fs.parse_netlist(NO_LEAK.format(source=f"PWL(0 0 0.5m {volts} 1m {-volts})"))
    solution = quietly(circuit)
    assert solution.plan.tier == "algebraic"
    layers = [ref.Layer(8.854e-12 * eps / d) for eps, d in ((3.9, 1e-6), (1.0, 3.5e-6), (1500.0, 350e-6))]
    charge = np.array(expected_charge(np.append(0.0, solution.u_source), layers, 1)[1:])
    off = np.abs(solution.q_source - charge).max()
    assert off <= solution.error.q_source
    assert off <= 1e-12 * np.abs(charge).max()
    assert solution.error.q_source <= 1e-11 * np.abs(charge).max()


@pytest.mark.parametrize("volts", [300.0, 5e4])
def test_a_stack_and_its_twin_as_a_network_agree_on_the_charge_of_their_jumps(volts):
    # The network follows a jump by collocation, with an error of its own.
    lines = [
        "Vdrive drive 0 0", "Xcoat drive top area LAYER d=1u eps_r=3.9 r=0.2meg",
        "Xgap top skin area GAP d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000",
        "Xskin skin 0 area SKIN d=350u f=100", ".tran 10u 1m uic",
    ]  # fmt: skip
    source = {"Vdrive": fs.PWL((0.0, 3e-4, 3e-4, 1e-3), (0.0, 0.0, volts, volts))}
    stack, network = (quietly(deck(*more), sources=source, rtol=1e-9) for more in (lines, [*lines, "R1 drive 0 1g"]))
    leak = np.where(network.t > 3e-4, (network.t - 3e-4) * volts / 1e9, 0.0)
    off = np.abs(stack.q_source - (network.q_source - leak)).max()
    assert off <= stack.error.q_source + network.error.q_source
    assert off <= 1e-7 * np.abs(stack.q_source).max()
