"""A copied or unpickled Solution is as read-only as the original."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs

CIRCUITS = Path(__file__).parents[1] / "circuits"
COPIES: dict[str, Callable[[fs.Solution], fs.Solution]] = {
    "pickle": lambda s: pickle.loads(pickle.dumps(s)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("deck", ["fingerpad", "two_fingers"])
@pytest.mark.parametrize("looked_at", [True, False], ids=["signals made", "signals not yet made"])
def test_a_copys_arrays_are_read_only_and_the_same(deck: str, how: str, looked_at: bool) -> None:
    solution = fs.simulate(fs.read_netlist(CIRCUITS / f"{deck}.cir"), t_stop=2e-3)
    before = solution.signals if looked_at else {}
    copied = COPIES[how](solution)
    arrays = {name: values for name, (values, _, _) in copied.signals.items()}
    record = {name: x for name, x in vars(copied.record).items() if isinstance(x, np.ndarray) and name[0] != "_"}
    for name, values in {**arrays, **record, "t": copied.t}.items():
        assert not values.flags.writeable, name
    for name, (values, _, _) in before.items():
        np.testing.assert_array_equal(arrays[name], values)


@pytest.mark.parametrize("area", ["coupled", "frozen"])
def test_the_times_asked_for_stay_the_callers_own(area: str) -> None:
    circuit = fs.read_netlist(CIRCUITS / "fingerpad.cir")
    t = np.arange(49) / 48e3
    solution = fs.simulate(
        circuit, sources=fs.Samples(np.sin(np.arange(49.0)), 48e3), t_stop=1e-3, t_eval=t, area=area, charge=False
    )
    t += 1.0
    np.testing.assert_array_equal(solution.t, np.arange(49) / 48e3)
    np.testing.assert_array_equal(solution.u_source, np.sin(np.arange(49.0)))


def test_samples_stay_read_only_in_a_copy() -> None:
    samples = pickle.loads(pickle.dumps(fs.Samples(np.arange(3.0), 1e3)))
    assert not samples.values.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        samples.values[0] = 1.0
