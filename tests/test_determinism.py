"""The same scene gives the same bytes, independent of earlier or parallel runs and of the requested outputs.

Run as a program, this file prints a digest of every scene, for processes with other settings.
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.integrate

import fingerspice as fs
from fingerspice.plots.drawing import save
from scenes import DECKS, cases, every_law, shipped, table1

DRY = (DECKS / "dry.cir").read_text()


def wobble(t: Any) -> Any:
    return 200.0 * np.sin(600.0 * t) * np.exp(-20.0 * t)


def recorded() -> fs.Samples:
    return fs.Samples(np.random.default_rng(3).normal(size=401).cumsum(), 20e3)


# What is simulated, made anew at every call, and how; each is another way through the package.
STACKS: dict[str, tuple[Callable[[], fs.Circuit], dict[str, Any]]] = {
    "coupled": (lambda: table1(tran="50u 50m uic"), {}),
    "mobile": (lambda: table1("SQUARE(200 100)", tran="50u 50m uic"), {"charge_law": "mobile"}),
    "linear": (lambda: table1(tran="50u 20m uic"), {"area": "frozen"}),
    "linear chirp": (lambda: table1().replace({"Vdrive": fs.Chirp(200, 20, 2000, 0.02)}), {"area": 35e-6}),
    "dispersive": (lambda: shipped("fingerpad_dispersive"), {"area": "mean", "t_stop": 0.02}),
    "algebraic": (lambda: fs.parse_netlist(DRY), {}),
    "function": (lambda: table1().replace({"Vdrive": fs.Function(wobble)}), {"t_stop": 0.02}),
    "samples": (lambda: table1(), {"sources": {"Vdrive": recorded()}, "t_stop": 0.02, "rtol": 1e-6}),
    "radau": (lambda: table1(tran="50u 10m uic"), {"method": "radau", "rtol": 1e-6}),
}
NETWORKS: dict[str, tuple[Callable[[], fs.Circuit], dict[str, Any]]] = {
    "network": (lambda: shipped("two_fingers"), {"t_stop": 4e-4, "rtol": 1e-5}),
    "linear network": (lambda: shipped("two_fingers"), {"area": "frozen"}),
}
SCENES = STACKS | NETWORKS


def arrays(solution: fs.Solution) -> dict[str, np.ndarray]:
    return {"t": solution.t, **{name: value for name, (value, _, _) in solution.signals.items()}}


def digest(found: dict[str, np.ndarray], *more: object) -> str:
    content = hashlib.sha256(repr(more).encode())
    for name, value in found.items():
        content.update(name.encode() + np.ascontiguousarray(value).tobytes())
    return content.hexdigest()


def simulated(name: str, circuit: fs.Circuit | None = None, **options: Any) -> str:
    """Digest of a scene's signals and of its stated error."""
    make, how = SCENES[name]
    solution = fs.simulate(make() if circuit is None else circuit, **{**how, **options})
    return digest(arrays(solution), vars(solution.error))


def steady(circuit: fs.Circuit, law: str = "local") -> str:
    state = fs.steady_state(circuit, charge_law=law)
    return digest(arrays(state.solution), state.defect, state.periods)


def files() -> dict[str, str]:
    """Digest of every kind of file."""
    solution = fs.simulate(table1(tran="50u 20m uic"))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        solution.to_netcdf(folder / "x.nc")
        solution.to_csv(folder / "x.csv")
        save(solution.plot(), folder / "x.png")
        return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.iterdir()}


def everything() -> dict[str, str]:
    return {name: simulated(name) for name in SCENES} | {"steady": steady(table1()), **files()}


@pytest.fixture(scope="module")
def right() -> dict[str, str]:
    """Digests of fresh circuits, one after the other."""
    return everything()


@pytest.fixture
def switching() -> Iterator[None]:
    """Threads take turns as often as they can."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


def test_one_thread_of_every_library_or_two_give_the_same_in_a_process_of_its_own(right: dict[str, str]) -> None:
    for threads in "12":
        names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        environment = os.environ | dict.fromkeys(names, threads)
        done = subprocess.run([sys.executable, __file__], env=environment, capture_output=True, text=True, check=True)
        assert json.loads(done.stdout) == right


@pytest.mark.parametrize("name", SCENES)
def test_a_circuit_that_was_used_before_gives_what_a_new_one_gives(right: dict[str, str], name: str) -> None:
    make, how = SCENES[name]
    circuit = make()
    for other in ({"rtol": 1e-3}, {"rtol": 1e-9}, {"charge": False}, {"t_eval": [0.0, 3e-4]}, {"charge_law": "mobile"}):
        fs.simulate(circuit, **{**how, **other})
    assert simulated(name, circuit) == right[name]
    assert simulated(name, circuit) == right[name]


def test_a_periodic_state_does_not_depend_on_how_finely_it_was_asked_for_before(right: dict[str, str]) -> None:
    circuit = table1()
    for points, rtol in ((7, 1e-3), (1000, 1e-10)):
        fs.steady_state(circuit, points=points, rtol=rtol)
    assert steady(circuit) == right["steady"]
    # A function is looked at as finely as the outputs are.
    repeated = [table1().replace({"Vdrive": fs.Function(ripple, repeat=0.01)}) for _ in range(2)]
    fs.steady_state(repeated[0], points=20)
    assert steady(repeated[0]) == steady(repeated[1])


def ripple(t: Any) -> Any:
    return 200.0 * np.sin(200.0 * np.pi * t) + 30.0 * np.abs(np.sin(200.0 * np.pi * t)) ** 9


@pytest.mark.parametrize("name", SCENES)
def test_a_value_does_not_depend_on_which_others_or_whether_the_charge_are_asked_for(name: str) -> None:
    make, how = SCENES[name]
    circuit, rng = make(), np.random.default_rng(1)
    assert circuit.tran is not None
    stop = how.get("t_stop", circuit.tran.stop)
    times = np.unique(np.concatenate([np.linspace(0.0, stop, 300), rng.uniform(0.0, stop, 150)]))
    full = arrays(fs.simulate(circuit, **{**how, "t_eval": times, "t_stop": stop}))
    for count in (1, 2, 5, 171):
        picked = np.sort(rng.choice(times.size, count, replace=False))
        some = arrays(fs.simulate(circuit, **{**how, "t_eval": times[picked], "t_stop": stop}))
        for signal, values in some.items():
            np.testing.assert_array_equal(values, full[signal][picked], err_msg=f"{signal}, {count} outputs")
    if name in STACKS:
        # In a network the charge's own error has a say in the steps where it is wanted.
        with_charge = fs.simulate(make(), **how)
        without = fs.simulate(make(), **how, charge=False, tier=with_charge.plan.tier)
        expected = arrays(with_charge)
        for signal, values in arrays(without).items():
            np.testing.assert_array_equal(values, expected[signal], err_msg=signal)


def at_once(work: list[Callable[[], str]], threads: int = 8) -> list[str]:
    """Results of functions that begin together."""
    barrier = threading.Barrier(threads)

    def begin(function: Callable[[], str]) -> str:
        barrier.wait(timeout=60)
        return function()

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(begin, work))


@pytest.mark.usefixtures("switching")
@pytest.mark.parametrize("name", SCENES)
def test_threads_may_share_a_circuit(right: dict[str, str], name: str) -> None:
    for _ in range(cases(2, 1)):
        circuit = SCENES[name][0]()
        assert at_once([lambda c=circuit: simulated(name, c) for _ in range(8)]) == 8 * [right[name]]


@pytest.mark.usefixtures("switching")
def test_threads_may_run_different_scenes_and_tolerances_of_shared_circuits(right: dict[str, str]) -> None:
    names = list(STACKS)
    circuit = table1(tran="50u 50m uic")
    expected = {rtol: simulated("coupled", rtol=rtol) for rtol in (1e-4, 1e-6, 1e-10)}
    stops = [0.011 + 1e-3 * i for i in range(8)]
    alone = [simulated("coupled", t_stop=stop) for stop in stops]
    for _ in range(cases(3, 1)):
        assert at_once([lambda n=n: simulated(n) for n in names[:8]]) == [right[n] for n in names[:8]]
        rtols = 2 * [1e-4, 1e-6, 1e-10, 1e-8]
        assert at_once([lambda r=r: simulated("coupled", circuit, rtol=r) for r in rtols]) == [
            expected.get(r, right["coupled"]) for r in rtols
        ]
        assert at_once([lambda s=s: simulated("coupled", circuit, t_stop=s) for s in stops]) == alone


@pytest.mark.usefixtures("switching")
@every_law
def test_threads_may_ask_for_the_periodic_state_of_one_circuit(law: str) -> None:
    expected = steady(table1(), law)
    circuit = table1()
    assert at_once(8 * [lambda: steady(circuit, law)]) == 8 * [expected]


def test_what_a_circuit_remembers_may_go_while_another_thread_asks_for_it() -> None:
    circuit = table1()

    class Key:
        def __init__(self, moment: int) -> None:
            self.asked, self.moment = 0, moment

        def __hash__(self) -> int:
            self.asked += 1
            if self.asked == self.moment:
                # As another thread would between two looks at it.
                circuit.kept.clear()
            return 7

    for moment in range(2, 9):
        key = Key(moment)
        assert [circuit.remember(("any", key), lambda: None) for _ in range(3)] == 3 * [None]


def test_scipys_methods_in_threads_leave_the_warning_filters_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    solve_ivp = scipy.integrate.solve_ivp

    def slow(*arguments: Any, **options: Any) -> Any:
        time.sleep(0.01)
        return solve_ivp(*arguments, **options)

    monkeypatch.setattr(scipy.integrate, "solve_ivp", slow)
    circuit = table1(tran="100u 1m uic")

    def one() -> str:
        return digest(arrays(fs.simulate(circuit, method="scipy:RK23", rtol=1e-3)))

    # Loading scipy changes them.
    expected = one()
    before = list(warnings.filters)
    assert at_once(8 * [one]) == 8 * [expected]
    assert warnings.filters == before


def test_nothing_is_left_in_shared_arrays(right: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    from fingerspice.solve.collocation import Track, scratch_of

    march, calls = Track.march, []

    def spoilt(self: Track, *arguments: Any) -> int:
        calls.append(1)
        tables, work = scratch_of(self.system)
        for array in (*work.modal, *(part for part in work if isinstance(part, np.ndarray))):
            array[:] = np.nan
        # Tables of steps may be thrown out at any time.
        tables.h[:] = 0.0
        tables.level[:] = -1
        return march(self, *arguments)

    monkeypatch.setattr(Track, "march", spoilt)
    for name in ("coupled", "mobile", "function"):
        assert simulated(name) == right[name]
    assert len(calls) > 3


if __name__ == "__main__":
    print(json.dumps(everything()))
