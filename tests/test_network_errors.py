"""Stated errors of random networks cover the true errors. `python tests/network_errors.py` tests a hundred networks."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import fingerspice as fs
import network_errors
from network_errors import Beside

NETWORKS = 32


@pytest.fixture(scope="module")
def judged() -> list[Beside]:
    found, refused = network_errors.measure(range(NETWORKS))
    assert not refused
    return found


@pytest.mark.parametrize("quantity", network_errors.QUANTITIES)
def test_stated_errors_cover_the_true_ones_on_95_percent_of_random_networks_and_are_not_far_above(
    judged: list[Beside], quantity: str
) -> None:
    these = [x for x in judged if x.quantity == quantity]
    assert network_errors.coverage(these) >= 0.95
    # A third of what is stated would not do, and nine of ten are at most ten times the true ones.
    assert network_errors.coverage(dataclasses.replace(x, stated=x.stated / 3.0) for x in these) < 0.95
    ratios = [x.ratio for x in these if x.ratio is not None]
    assert len(ratios) > 50
    assert np.mean(np.array(ratios) <= 10.0) >= 0.9


@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
@pytest.mark.parametrize("number", [2, 7, 13])
def test_what_counts_as_true_is_what_radau_s_method_finds_too(number: int) -> None:
    network = network_errors.draw(number)
    t = np.linspace(0.0, network.stop, 102)[1:-1] + 1e-6 * network.stop
    tight, other = (
        fs.simulate(network.circuit, t_stop=network.stop, t_eval=t, charge_law=network.law, rtol=rtol, method=method)
        for rtol, method in ((network_errors.TIGHT, "auto"), (1e-8, "radau"))
    )
    for name in ("u_gap", "f_el", "q_source"):
        ours, theirs = getattr(tight, name), getattr(other, name)
        assert np.abs(ours - theirs).max() <= (5e-8 if name == "q_source" else 1e-8) * np.abs(ours).max()


def test_the_networks_are_of_every_kind() -> None:
    drawn = [network_errors.draw(number) for number in range(NETWORKS)]
    for part, least in (("around", 4), ("source", 4), ("law", 2), ("fingers", 4), ("area", 2)):
        assert len({network.kind[part] for network in drawn}) >= least, part


def test_an_error_that_is_stated_too_small_is_counted(judged: list[Beside]) -> None:
    x = max(judged, key=lambda x: x.true)
    assert x.covered
    assert not dataclasses.replace(x, stated=0.9 * x.true).covered
    # Near rounding there is no ratio.
    assert dataclasses.replace(x, unknown=x.true).ratio is None
    lines = network_errors.table([x, dataclasses.replace(x, stated=0.5 * x.true)], lambda x: x.quantity)
    assert "1 of     2 covered" in lines[0]
