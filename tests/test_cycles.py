"""A run frees its memory when it is dropped: nothing of it waits for Python's garbage collection, which is rare."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs

CIRCUITS = Path(__file__).parents[1] / "circuits"


@contextlib.contextmanager
def collected() -> Iterator[list[object]]:
    """What garbage collection finds of what is made inside; all that is there before is left aside, as it is much."""
    gc.disable()
    gc.freeze()
    gc.set_debug(gc.DEBUG_SAVEALL)
    found: list[object] = []
    try:
        yield found
        gc.collect()
        found.extend(gc.garbage)
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.unfreeze()
        gc.enable()


@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
@pytest.mark.parametrize("name", ["fingerpad", "fingerpad_dispersive", "two_fingers", "screen_protector", "recording"])
def test_a_run_with_changed_parameters_leaves_no_cycle(name: str) -> None:
    circuit = fs.read_netlist(CIRCUITS / f"{'fingerpad' if name == 'recording' else name}.cir")
    gap = next(path for path in circuit.parameters if path.endswith("ap.d"))
    if name == "recording":
        circuit = circuit.replace({"Vdrive": fs.Samples(100.0 * np.sin(np.arange(480) * 0.1), 48e3)})

    def use(change: float) -> None:
        run = fs.simulate(circuit, parameters={gap: circuit.parameters[gap].value * change}, t_stop=9e-3)
        assert run.summary()["status"] == "SUCCESS"
        assert len(run.signals) > 3
        assert run.warnings is not None

    # The first run compiles, and fills caches.
    use(1.01)
    with collected() as found:
        use(1.02)
    assert [type(one).__name__ for one in found if type(one).__module__.startswith("fingerspice")] == []


def test_garbage_collection_would_find_a_cycle() -> None:
    with collected() as found:
        run = fs.simulate(fs.read_netlist(CIRCUITS / "fingerpad.cir"), t_stop=1e-3)
        run.__dict__["own"] = run
        del run
    assert "Solution" in {type(one).__name__ for one in found}
