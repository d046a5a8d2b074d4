"""The stated error of the node voltages, against the linear map that gives it, and its use in a run."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.engine.collocation.readout import N_PLACES
from fingerspice.engine.many_areas import error as many_error
from fingerspice.engine.one_area import rows, step
from fingerspice.numerics.lobatto import END, FIRST, MISS, POINTS, ROWS

PLACES = [0, FIRST, FIRST + 1, FIRST + 2, END]
# The gap stands on ground, so that the node above it has its voltage.
GAP_BELOW = """gap below
Vdrive drive 0 SIN(0 {volts} 200)
{above}
Xcoat {top} t0 area0 LAYER d=1u eps_r=3.9 r=5meg
Xgap t0 0 area0 GAP d=3u r=1meg
.tran 50u 10m uic
.end
"""
NETWORK = GAP_BELOW.format(volts=120, above="Rout drive low 20k\nCcable low 0 100p", top="low")
STACK = GAP_BELOW.format(volts=120, above="", top="drive")


@pytest.mark.parametrize("seed", range(3))
def test_a_network_s_nodes_are_off_by_what_the_modes_and_the_sources_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m, n_s, n_node = 4, 5, 2, 6
    node, node_s = rng.normal(size=(n_node, n)), rng.normal(size=(n_node, n_s))
    places, missed = rng.normal(size=(m, N_PLACES)), rng.normal(size=(5, m + n_s))
    off = node @ places[:n]
    off[:, 0] += node @ missed[4, :n]
    off[:, 1:4] += node_s @ missed[:3, m:].T
    peaks = np.array([0.0, 0.0, 0.1, 0.0])
    many_error.account_nodes(node, node_s, places, missed, peaks)
    assert peaks[many_error.ERROR_U] == pytest.approx(np.abs(off).max(), rel=1e-12, abs=0.0)
    # It is the largest of the run.
    before = peaks[many_error.ERROR_U]
    many_error.account_nodes(node, node_s, 0.5 * places, 0.5 * missed, peaks)
    assert peaks[many_error.ERROR_U] == before


@pytest.mark.parametrize("mobile", [False, True], ids=["local", "mobile"])
def test_a_stack_s_nodes_are_off_by_what_modes_area_and_source_are(mobile: bool) -> None:
    rng, area0 = np.random.default_rng(7), 35e-6
    gap, node, k_node = np.array([0.6, 0.3]), rng.normal(size=(3, 2)), rng.normal(size=3)
    w = np.array([30.0 + 5.0 * POINTS, -20.0 + 8.0 * POINTS])
    places, k_gap = 1e-4 * rng.normal(size=(2, N_PLACES)), 0.7
    inverse, slope = 1.05 / area0, 2e-3 / area0

    def voltages(source: np.ndarray, modes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gap voltage, 1/A, and the nodes', where 1/A = inverse + slope u and u = k U + A0 / A gap w."""
        if not mobile:
            return k_gap * source + gap @ modes, np.full(source.size, inverse), np.outer(k_node, source) + node @ modes
        along = area0 * (gap @ modes)
        u = (k_gap * source + along * inverse) / (1.0 - along * slope)
        q = inverse + slope * u
        return u, q, np.outer(k_node, source) + area0 * q * (node @ modes)

    source = 100.0 + 10.0 * POINTS
    u, q, _ = voltages(source, w)
    r = np.zeros((rows.N_FLAT, ROWS))
    r[rows.SOURCE], r[rows.U], r[rows.Q], r[rows.DQ], r[rows.X_GAP] = source, u, q, slope, gap @ w
    at = np.array(PLACES)
    want = (voltages(source[at], w[:, at] + places)[2] - voltages(source[at], w[:, at] - places)[2]) / 2.0
    found = step.node_error(mobile, area0, node, k_node, gap, w, r, places)
    assert found == pytest.approx(np.abs(want).max(), rel=1e-5, abs=0.0)
    # What a polynomial through the source's values misses is an error of the nodes too.
    r[rows.SOURCE, FIRST:] += MISS
    alone = step.node_error(False, area0, node, k_node, gap, w, r, 0.0 * places)
    assert alone == pytest.approx(np.abs(k_node).max() * np.abs(MISS).max(), rel=1e-9, abs=0.0)


@pytest.mark.parametrize("deck", [NETWORK, STACK], ids=["network", "stack"])
@pytest.mark.parametrize("law", ["local", "mobile"])
@pytest.mark.parametrize("method", ["exponential", "radau", "scipy:DOP853"])
def test_a_node_that_has_the_gap_s_voltage_has_no_smaller_error(deck: str, law: str, method: str) -> None:
    run = fs.simulate(fs.parse_netlist(deck), charge_law=law, rtol=1e-6, method=method)
    assert np.array_equal(run.node_voltages["t0"], run.u_gap) or np.allclose(run.node_voltages["t0"], run.u_gap)
    assert run.error.v_nodes >= 0.99 * run.error.u_gap > 0.0
    # No gap of these decks is slower than a node: the step that serves the one serves the other.
    assert run.error.v_nodes <= 1e-6 * 120.0 * 1.01


@pytest.mark.parametrize("area", ["frozen", "mean"])
@pytest.mark.parametrize("deck", [NETWORK, STACK], ids=["network", "stack"])
def test_closed_forms_state_rounding(deck: str, area: str) -> None:
    run = fs.simulate(fs.parse_netlist(deck), area=area)
    assert 0.0 < run.error.v_nodes <= 1e-11 * 120.0


def test_nodes_of_a_run_from_the_periodic_state_have_none() -> None:
    assert fs.simulate(fs.parse_netlist(STACK), start="periodic").error.v_nodes is None


def test_the_nodes_error_is_stated_and_does_not_refuse_a_run() -> None:
    from fingerspice.results.outcome import State, Status
    from fingerspice.solve.runs import Run

    nothing = np.zeros(0)
    run = Run(
        nothing, nothing.astype(bool), np.zeros((0, 1)), Status.SUCCESS, 0, {}, State(0.0, *[nothing] * 3, "local")
    )
    run.gaps = np.array([[50.0, 1.0, 5e-7, 1e-8]])
    assert run.excess(1e-12) == pytest.approx(1e-8)
    assert dataclasses.replace(run, node_error=2e-4).excess(1e-12) == run.excess(1e-12)
    run.node_error = 1e-5
    run.add_error(2e-5)
    assert run.error.v_nodes == pytest.approx(3e-5)
