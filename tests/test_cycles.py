"""A run frees its memory when it is dropped: nothing of it waits for Python's garbage collection, which is rare."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs

CIRCUITS = Path(__file__).parents[1] / "circuits"


@pytest.fixture
def kept() -> Iterator[list[object]]:
    """What garbage collection finds is kept here, and it does not start by itself."""
    yield gc.garbage
    gc.set_debug(0)
    gc.garbage.clear()
    gc.enable()


@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
@pytest.mark.parametrize("name", ["fingerpad", "fingerpad_dispersive", "two_fingers", "screen_protector", "recording"])
def test_a_run_with_changed_parameters_leaves_no_cycle(name: str, kept: list[object]) -> None:
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
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    use(1.02)
    gc.collect()
    assert [type(one).__name__ for one in kept if type(one).__module__.startswith("fingerspice")] == []


def test_garbage_collection_would_find_a_cycle(kept: list[object]) -> None:
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    run = fs.simulate(fs.read_netlist(CIRCUITS / "fingerpad.cir"), t_stop=1e-3)
    run.__dict__["own"] = run
    del run
    gc.collect()
    assert "Solution" in {type(one).__name__ for one in kept}
