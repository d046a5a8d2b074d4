"""Limits of memory and time, checked before a run: a request that is too large gets one sentence with the number.

A run frees its memory when it is dropped: nothing of it waits for Python's garbage collection, which is rare.
"""

import contextlib
import gc
import os
import platform
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from deck_edits import edited
from fingerspice.engine.collocation import readout
from fingerspice.solve.problem import MOST_BYTES
from fingerspice.waveforms import periodic
from processes import ended, start
from scenes import CIRCUITS, listed, refuses, shipped, table1
from waveform_cases import CASES, Case

GIB = 2**30
#: What the engine, compiled, and the libraries take; not a tenth of what these requests would.
ROOM = 4 * GIB
SOURCE = "SIN(0 200 100)"


def test_a_request_without_an_end_is_refused_in_little_memory(tmp_path: Path) -> None:
    endless = listed("endless")
    for name, source, tran, _ in endless:
        text = edited((SOURCE, source), (".tran 10u 50m uic", tran))
        (tmp_path / f"{name}.cir").write_text(text)
    code = (
        "import sys, warnings, fingerspice as fs\nwarnings.simplefilter('ignore')\nfor name in sys.argv[1:]:\n"
        "    try:\n        fs.simulate(fs.read_netlist(name + '.cir'))\n    except fs.InputError as error:\n"
        "        print(error)\n    else:\n        print('it ran')\n"
    )
    limit = lambda: resource.setrlimit(resource.RLIMIT_AS, (ROOM, ROOM))  # noqa: E731
    names = [name for name, *_ in endless]
    done, lines, out = ended(start(tmp_path, *names, entry=[sys.executable, "-c", code], preexec_fn=limit))
    assert (done, lines) == (0, [])
    for said, (*_, expected) in zip(out.splitlines(), endless, strict=True):
        assert expected in said


def test_the_bound_on_outputs_is_not_met_by_times_that_are_given() -> None:
    circuit = fs.parse_netlist(edited((".tran 10u 50m uic", ".tran 10n 1 uic")))
    solution = fs.simulate(circuit, t_eval=[0.01, 1.0])
    assert solution.t.size == 2
    # What a run may hold fits a computer of today three times.
    assert MOST_BYTES * 3 < 8e9


def test_ten_values_in_a_year_of_squares_need_no_list_of_its_edges() -> None:
    square = fs.Square(200.0, 5000.0)
    t = np.array([0.0, 3e7 + 2.5e-5, 3e7 + 1.25e-4, 1.0, 1.00005])
    np.testing.assert_array_equal(square.value(t), [200.0, 200.0, -200.0, 200.0, 200.0])
    refuses(r"7\.5e\+11 breakpoints from 0 s to 3e\+07 s", square.breakpoints, 0.0, 3e7)
    edges = np.array([1e-4, 3e7 + 1e-4])
    np.testing.assert_array_equal(square.value(edges, "left") - square.value(edges), [400.0, 400.0])


@pytest.mark.parametrize(
    "case", [c for c in CASES if c.period and isinstance(c.waveform, periodic.Ramps)], ids=lambda c: c.name
)
def test_values_do_not_depend_on_the_windows_they_are_looked_up_in(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    wave = case.waveform
    rng = np.random.default_rng(7)
    t = np.concatenate([rng.uniform(-0.01, 0.5, 300), wave.breakpoints(0.0, 0.5)]).reshape(-1, 1)
    whole = [wave.value(t, side) for side in ("left", "right")]
    monkeypatch.setattr(periodic, "_WINDOW", 7)
    assert len(list(periodic.in_windows(t.ravel(), wave.breakpoint_rate()))) > 20
    for expected, side in zip(whole, ("left", "right"), strict=True):
        np.testing.assert_array_equal(wave.value(t, side), expected)


def test_the_peak_of_a_periodic_source_is_looked_for_in_one_period() -> None:
    assert fs.Square(200.0, 1e6, delay=1e-3).peak(0.0, 1e6) == 200.0
    assert fs.Pulse(5.0, 1.0, 1.0, 0.0, 0.0, 1e-3, 2e-3).peak(0.0, 1e9) == 5.0


def test_an_error_asked_for_that_underflows_is_met() -> None:
    solution = fs.simulate(table1("SIN(0 1e-300 100)"), rtol=1e-13, throw=False)
    assert np.isfinite(solution.error.u_gap)


@pytest.mark.parametrize(("source", "r_gap"), [("SIN(0 200 1k)", "10g"), ("SQUARE(200 1k)", "1meg")])
def test_no_result_depends_on_where_a_walk_is_cut(source: str, r_gap: str, monkeypatch: pytest.MonkeyPatch) -> None:
    circuit = fs.parse_netlist(edited((SOURCE, source), ("r=1meg", f"r={r_gap}"), ("f=100", "f=1k")))
    t = np.linspace(0.0, 3.0, 4001)
    calls: list[int] = []
    whole = fs.simulate(circuit, t_eval=t, t_stop=3.0, rtol=1e-6)
    assert whole.stats["repeated"] > 1000
    part = readout._repeat
    monkeypatch.setattr(readout, "AT_ONCE", 100)
    monkeypatch.setattr(readout, "_repeat", lambda *a: calls.append(1) or part(*a))
    again = fs.simulate(circuit, t_eval=t, t_stop=3.0, rtol=1e-6)
    assert len(calls) > 1
    for name, (values, _, _) in whole.signals.items():
        np.testing.assert_array_equal(again.signals[name][0], values, err_msg=name)
    np.testing.assert_array_equal(again.state.y, whole.state.y)


FAULTS = """
import resource, sys
import numpy as np
from fingerspice.base.arrays import keep_freed_memory
if "keep" in sys.argv:
    keep_freed_memory()
for _ in range(3):
    np.ones(1 << 17)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(100):
    np.ones(1 << 17)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the parameters are those of glibc's malloc")
def test_freed_memory_is_kept_where_the_environment_asks_to_give_it_back() -> None:
    def faults(*arguments: str) -> int:
        environment = os.environ | {"MALLOC_TRIM_THRESHOLD_": "65536"}
        command = [sys.executable, "-c", FAULTS, *arguments]
        return int(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)

    # A megabyte is 256 pages, and a hundred of them are used one after another.
    assert faults() > 20_000
    assert faults("keep") < 500


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
        run = fs.simulate(shipped("fingerpad"), t_stop=1e-3)
        run.__dict__["own"] = run
        del run
    assert "Solution" in {type(one).__name__ for one in found}
