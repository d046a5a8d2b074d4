"""Sweeps over grids and populations, Sobol indices, and stores: the same bytes whoever runs and kills the chunks."""

import json
import logging
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy import stats

import fingerspice as fs
from commands import tree
from fingerspice.studies import sweep as populations
from fingerspice.studies.sweep import Plan, chunks
from processes import forked, no_room_here
from scenes import CIRCUITS, DECKS, cases, listed, refuses, shipped

# How often a whole program, and a worker, is killed; each takes seconds to start.
KILLS, KILLS_OF_WORKERS = cases(20, 2), cases(20, 1)
CHUNK = chunks.CHUNK
PARAMETERS: dict[str, Any] = {
    "source.frequency": [100.0, 1000.0, 5000.0],
    "Xgap.d": stats.lognorm(0.1, scale=3.5e-6),
    "Xskin.d": stats.norm(350e-6, 50e-6),
    "Xgap.fn": 0.4,
}
HOW: dict[str, Any] = {
    "periodic": True, "outputs": ("f_el_mean_periodic",), "skin": "follow", "n": cases(4096, 1024),
    "seed": 3,
}  # fmt: skip
# Chunks of 64 draws at three frequencies.
CHUNKS = 3 * HOW["n"] // 64


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks, "CHUNK", 64)


@pytest.fixture(scope="module")
def whole(circuit: fs.Circuit, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes | None]:
    """The store that one call makes, file by file."""
    path = tmp_path_factory.mktemp("whole") / "whole.zarr"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "CHUNK", 64)
        found = fs.sweep(circuit, PARAMETERS, store=path, **HOW)
    assert (found.attrs["chunks"], found.attrs["chunks_found"], found.attrs["chunks_missing"]) == (CHUNKS, 0, 0)
    return tree(path)


def copied(whole: dict[str, bytes | None], path: Path) -> None:
    """Write a store that is given file by file."""
    for name, content in whole.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        if content is not None:
            (path / name).write_bytes(content)


def marks(store: Path) -> int:
    return sum(len(files) for _, _, files in os.walk(store / "status" / "c"))


@contextmanager
def killing(pids: Callable[[], list[int]], store: Path, most: int) -> Iterator[list[int]]:
    """Kills so many of these processes while the context lasts, each after chunks have been written since the last one.

    The list has those killed.
    """
    killed: list[int] = []
    over = threading.Event()

    def kill() -> None:
        seen = 0
        while len(killed) < most and not over.wait(0.005):
            alive, now = [pid for pid in pids() if pid not in killed], marks(store)
            if now < seen + 6 or not alive:
                continue
            seen = now
            with suppress(OSError):
                os.kill(alive[0], signal.SIGKILL)
                killed.append(alive[0])

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        thread.join()


def test_draws_in_parts_are_those_of_the_whole(circuit):
    for count in (1 << 9, 1 << 14):
        plan = Plan(circuit, PARAMETERS, 1 << 14, 5, 1 << 30)
        plan.count = count
        draws = plan.quantiles(stats.qmc.Sobol(2, scramble=True, bits=30, rng=5).random(plan.n))
        parts = [plan.draws(i) for i in range(plan.n // count)]
        for name, values in draws.items():
            np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), values)


def both(circuit: fs.Circuit, asked: dict[str, Any], path: Path, **how: Any) -> tuple[Any, Any]:
    """A sweep in memory and in a store, which have the same."""
    memory, stored = fs.sweep(circuit, asked, **how), fs.sweep(circuit, asked, store=path, **how)
    assert list(stored.data_vars) == list(memory.data_vars)
    for name in memory.variables:
        assert stored[name].dims == memory[name].dims
        assert stored[name].attrs.get("units") == memory[name].attrs.get("units")
        np.testing.assert_array_equal(stored[name].values, memory[name].values)
    return memory, stored


def test_a_store_has_what_a_sweep_in_memory_has(circuit, tmp_path):
    # 3 x 5 x 1 places and 32 draws, chunks of 2 x 32: also such that reach over the edge.
    asked = {**PARAMETERS, "Xgap.r": [5e5, 6e5, 7e5, 8e5, 9e5], "Xcoat.r": [2e5]}
    how = {**HOW, "n": 32, "outputs": ("f_el_mean_periodic", "f_el_rms_periodic")}
    memory, stored = both(circuit, asked, tmp_path / "s.zarr", **how)
    assert stored.attrs["chunks"] == 9
    known = {key: value for key, value in memory.attrs.items() if key not in ("n_ordinary", "ordinary", "failures")}
    assert known == {key: stored.attrs[key] for key in known}
    # A grid alone, and one scene alone.
    for values in ({"Xgap.d": [3e-6, 4e-6]}, {"Xgap.d": 3e-6}):
        both(circuit, values, tmp_path / f"{len(str(values))}.zarr", **how)


def test_a_network_and_several_fingers_go_into_a_store(tmp_path):
    circuit = shipped("two_fingers")
    path = next(name for name in circuit.parameters if name.endswith("ap.d"))
    how = {"outputs": ("f_el_mean",), "t_stop": 5e-3}
    _, stored = both(circuit, {path: [3e-6, 3.2e-6, 3.4e-6]}, tmp_path / "s.zarr", **how)
    assert stored.f_el_mean.dims == (path, "gap")


def test_scenes_without_a_result_are_named_by_their_number_in_the_sweep(circuit, tmp_path):
    # Adhesion that leaves no contact.
    asked = {"Xgap.r": [1e6, 2e6], "Xgap.c2": np.where(np.arange(80) == 70, 1e9, 5000.0)}
    how = {"outputs": ("f_el_mean",), "t_stop": 2e-2, "threads": 1}
    memory, stored = both(circuit, asked, tmp_path / "s.zarr", **how)
    assert np.flatnonzero(memory.status.values.ravel() >= 2).tolist() == [70, 150]
    assert stored.attrs["failures"] == memory.attrs["failures"]


def test_a_single_set_of_parameters_goes_into_a_store(circuit, tmp_path, command):
    # It is number 0 of its table, and a grid of nothing but 0 is in the store, too.
    _, stored = both(circuit, {"finger": ["moist"], "Xgap.d": [3e-6, 4e-6]}, tmp_path / "s.zarr", **HOW)
    assert stored.finger.values.tolist() == ["moist"]
    done = command("check", str(tmp_path / "s.zarr"))
    assert (done.code, done.lines) == (0, [])


@pytest.mark.usefixtures("forked_workers")
def test_workers_that_are_killed_again_and_again_cost_nothing(circuit, whole, tmp_path):
    path = tmp_path / "s.zarr"

    def children() -> list[int]:
        return [one.pid for one in multiprocessing.active_children() if one.pid]

    with killing(children, path, KILLS_OF_WORKERS) as killed:
        found = fs.sweep(circuit, PARAMETERS, store=path, workers=2, **HOW)
    assert len(killed) == KILLS_OF_WORKERS
    assert found.attrs["chunks_missing"] == 0
    assert tree(path) == whole
    assert not multiprocessing.active_children()


@pytest.fixture
def _given_up_at_once(forked_workers: None) -> Iterator[None]:
    """A scheduler gives up a chunk with the first worker that is lost with it."""
    # Its own settings come with it.
    pytest.importorskip("distributed")
    with pytest.importorskip("dask").config.set({"distributed.scheduler.allowed-failures": 0}):
        yield


class Deadly:
    """A distribution whose draws end every process but the one that started the sweep."""

    def __init__(self) -> None:
        self.pid = os.getpid()

    def ppf(self, points: Any) -> Any:
        if os.getpid() != self.pid:
            os.kill(os.getpid(), signal.SIGKILL)
        return 3e-6 + 1e-6 * np.asarray(points)


@pytest.mark.usefixtures("_given_up_at_once")
def test_chunks_that_always_cost_their_worker_end_the_sweep(circuit, tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, "MOST_LOST", 1)
    with pytest.raises(fs.InputError, match=r"one chunk after another were lost, 1 times.* what is written stays"):
        fs.sweep(circuit, {"Xgap.d": Deadly()}, store=tmp_path / "s.zarr", workers=1, **{**HOW, "n": 64})


class DeadlyOnce(Deadly):
    """As `Deadly`, for the one chunk that has the least of 256 points."""

    def ppf(self, points: Any) -> Any:
        return super().ppf(points) if np.min(points) < 1.0 / 256.0 else 3e-6 + 1e-6 * np.asarray(points)


@pytest.mark.usefixtures("_given_up_at_once")
def test_a_chunk_that_costs_its_worker_is_named_and_the_others_are_in_the_store(circuit, tmp_path):
    path = tmp_path / "s.zarr"
    said = r"chunk (\d) of the sweep were lost, 2 times.*; allowed: .* what is written stays"
    with pytest.raises(fs.InputError, match=said) as told:
        fs.sweep(circuit, {"Xgap.d": DeadlyOnce()}, store=path, workers=1, **{**HOW, "n": 256})
    named = int(re.search(said, str(told.value))[1])  # type: ignore[index]
    assert marks(path) == 3
    assert not (path / "status" / "c" / str(named)).exists()


SCRIPT = """
import sys

if __name__ == "__main__":
    import fingerspice as fs
    import test_sweepstore as here
    from fingerspice.studies.sweep import chunks

    chunks.CHUNK = 64
    circuit = fs.read_netlist(here.CIRCUITS / "fingerpad.cir")
    fs.sweep(circuit, here.PARAMETERS, store=sys.argv[1], workers=1, **here.HOW)
"""


def test_a_sweep_killed_again_and_again_comes_to_the_same_bytes(circuit, whole, tmp_path):
    path, enough = tmp_path / "s.zarr", 3 * CHUNKS // 4
    (tmp_path / "script.py").write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    for kill in range(KILLS):
        wanted = marks(path) + enough // KILLS
        # With a worker at every other time, by a program of its own: the worker ends by itself.
        process: Any = (
            subprocess.Popen([sys.executable, tmp_path / "script.py", path], env=environment) if kill % 2
            else forked(lambda: fs.sweep(circuit, PARAMETERS, store=path, **HOW))
        )  # fmt: skip
        while marks(path) < wanted:
            assert process.poll() is None if kill % 2 else process.is_alive()
            time.sleep(0.002)
        process.kill()
        process.wait() if kill % 2 else process.join()
    assert enough // KILLS * KILLS <= marks(path) < CHUNKS
    fs.sweep(circuit, PARAMETERS, store=path, **HOW)
    assert tree(path) == whole


def test_a_shard_without_chunks_does_nothing(circuit, tmp_path):
    found = fs.sweep(circuit, {"Xgap.d": [3e-6, 4e-6]}, store=tmp_path / "s.zarr", shard=(3, 3), **HOW)
    assert (found.attrs["chunks"], found.attrs["chunks_found"], found.attrs["chunks_missing"]) == (0, 0, 1)


def test_shards_by_separate_processes_make_the_whole(circuit, whole, tmp_path):
    path = tmp_path / "s.zarr"
    # At once: whichever comes first creates the store.
    shards = [forked(partial(fs.sweep, circuit, PARAMETERS, store=path, shard=(i, 3), **HOW)) for i in (1, 2)]
    for one in shards:
        one.join(120)
        assert one.exitcode == 0
    assert marks(path) == 2 * CHUNKS // 3
    last = fs.sweep(circuit, PARAMETERS, store=path, shard=(2, 3), **HOW)
    assert {last.attrs[key] for key in ("chunks", "chunks_found", "chunks_missing")} == {CHUNKS // 3}
    assert np.count_nonzero(last.status.values == 4) == 64 * CHUNKS // 3
    assert np.isnan(last.f_el_mean_periodic.values[last.status.values == 4]).all()
    fs.sweep(circuit, PARAMETERS, store=path, shard=(3, 3), **HOW)
    assert tree(path) == whole


def cluster_of(workers: int, processes: bool) -> Any:
    return pytest.importorskip("distributed").LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=processes, dashboard_address=None,
        silence_logs=logging.CRITICAL,
    )  # fmt: skip


@pytest.mark.usefixtures("forked_workers")
def test_dask_workers_that_are_killed_again_and_again_cost_nothing(circuit, whole, tmp_path, monkeypatch):
    path = tmp_path / "s.zarr"

    def workers() -> list[int]:
        return [one.pid for one in cluster.workers.values() if one.pid]

    with cluster_of(2, processes=True) as cluster:
        with killing(workers, path, KILLS_OF_WORKERS) as killed:
            found = fs.sweep(circuit, PARAMETERS, store=path, scheduler=cluster.scheduler_address, **HOW)
        assert len(killed) == KILLS_OF_WORKERS
        assert found.attrs["chunks_missing"] == 0
        assert tree(path) == whole
        # What a worker refuses is told as it is.
        monkeypatch.setattr(chunks, "programs", lambda: "fingerspice 0.0")
        with pytest.raises(fs.InputError, match="a worker has fingerspice"):
            fs.sweep(circuit, PARAMETERS, store=tmp_path / "o.zarr", scheduler=cluster.scheduler_address, **HOW)


def test_a_dask_worker_computes_the_next_chunk_while_it_writes_one(circuit, whole, tmp_path, monkeypatch):
    path, part, write = tmp_path / "s.zarr", Plan.draws, chunks.Work._write
    begun, written, at_once = 0, 0, 0

    def computing(*given: Any) -> Any:
        nonlocal begun
        begun += 1
        return part(*given)

    def writing(*given: Any) -> None:
        nonlocal written, at_once
        until = time.monotonic() + 10.0
        # Every chunk but the last waits here until its worker, which has one thread, computes another one.
        while begun < written + 2 and written < CHUNKS - 1 and time.monotonic() < until:
            time.sleep(1e-3)
        at_once = max(at_once, begun - written)
        assert time.monotonic() < until
        written += 1
        write(*given)

    monkeypatch.setattr(Plan, "draws", computing)
    monkeypatch.setattr(chunks.Work, "_write", writing)
    with cluster_of(1, processes=False) as cluster:
        fs.sweep(circuit, PARAMETERS, store=path, scheduler=cluster.scheduler_address, **HOW)
    assert (begun, written) == (CHUNKS, CHUNKS)
    # One is written, one waits to be written, one is computed: not more, however slow the disk is.
    assert at_once <= 3
    assert tree(path) == whole


def test_a_scheduler_that_does_not_answer_is_refused_within_seconds(circuit, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    assert chunks.PATIENCE <= 5.0
    monkeypatch.setattr(chunks, "PATIENCE", 0.5)
    begun = time.perf_counter()
    for address in ("tcp://127.0.0.1:1", "nowhere"):
        with pytest.raises(fs.InputError, match=f"no scheduler answers at {address}") as told:
            fs.sweep(circuit, PARAMETERS, store=tmp_path / "s.zarr", scheduler=address, **HOW)
        assert "\n" not in str(told.value)
    assert time.perf_counter() - begun < 15.0 - 2.0 * 4.5
    assert not list(tmp_path.iterdir())


def test_a_half_written_store_of_another_sweep_is_refused_and_kept(circuit, tmp_path):
    path = tmp_path / "s.zarr"
    fs.sweep(circuit, PARAMETERS, store=path, shard=(1, 2), **HOW)
    before = tree(path)
    other = {**PARAMETERS, "Xgap.d": stats.lognorm(0.11, scale=3.5e-6)}
    cases: list[tuple[fs.Circuit, dict[str, Any], dict[str, Any], str]] = [
        (circuit, PARAMETERS, {"seed": 4}, r"another seed \(3, and this one 4\)"),
        (circuit, PARAMETERS, {"rtol": 1e-5}, "another rtol"),
        (circuit, PARAMETERS, {"n": 512}, "another n"),
        (circuit, PARAMETERS, {"skin": "own"}, "another skin"),
        (circuit, other, {}, r"another range of Xgap\.d"),
        (circuit, {**PARAMETERS, "Xgap.fn": 0.5}, {}, r"another range of Xgap\.fn"),
        (circuit, {**PARAMETERS, "Xgap.r": 1e6}, {}, "another list of parameters"),
        (circuit.replace({"Xcoat.r": 3e5}), PARAMETERS, {}, "another circuit"),
    ]
    for own, parameters, change, said in cases:
        with pytest.raises(fs.InputError, match=said) as told:
            fs.sweep(own, parameters, store=path, **{**HOW, **change})
        assert "\n" not in str(told.value)
    assert tree(path) == before
    # An option that is given as it is by default is the same sweep.
    found = fs.sweep(circuit, PARAMETERS, store=path, shard=(1, 2), rtol=1e-4, threads=1, **HOW)
    assert found.attrs["chunks_found"] == found.attrs["chunks"]
    shutil.rmtree(path)
    path.mkdir()
    (path / "mine.txt").write_text("mine")
    refuses("is there already and is no store of a sweep", fs.sweep, circuit, PARAMETERS, store=path, **HOW)
    assert (path / "mine.txt").read_text() == "mine"


def test_a_chunk_that_is_cut_short_or_not_marked_is_run_again(circuit, whole, tmp_path):
    path = tmp_path / "s.zarr"
    copied(whole, path)
    os.truncate(path / "error" / "c" / "1" / "7", 100)
    (path / "f_el_mean_periodic" / "c" / "0" / "3").unlink()
    (path / "status" / "c" / "2" / "9").unlink()
    (path / "Xgap.d" / "c" / "5").unlink()
    # Left by a process that was killed.
    (path / "status" / ".fingerspice-0123").write_bytes(b"half")
    found = fs.sweep(circuit, PARAMETERS, store=path, **HOW)
    assert found.attrs["chunks"] - found.attrs["chunks_found"] == 4
    assert tree(path) == whole


def test_a_chunk_of_which_a_bit_has_changed_is_run_again(circuit, whole, tmp_path, command):
    path, rng = tmp_path / "s.zarr", np.random.default_rng(5)
    copied(whole, path)
    assert "chunks of 6 arrays are as they were written" in command("check", str(path)).out
    for name in ("f_el_mean_periodic/c/0/3", "error/c/1/7", "status/c/2/9", "Xgap.d/c/5", "Xskin.d/c/15"):
        content = bytearray((path / name).read_bytes())
        content[rng.integers(len(content))] ^= 1 << rng.integers(8)
        (path / name).write_bytes(content)
        said = command("check", str(path)).refused()
        assert f"{path} is damaged: {path / name} has changed since it was written" in said.lines[-1]
        found = fs.sweep(circuit, PARAMETERS, store=path, **HOW)
        assert found.attrs["chunks"] - found.attrs["chunks_found"] == 1
        assert tree(path) == whole
    (path / "error/c/1/7").unlink()
    assert f"{path / 'error'} has {CHUNKS - 1} of {CHUNKS} chunks" in command("check", str(path)).lines[-1]


@pytest.mark.parametrize(
    ("parameters", "how", "said"),
    [
        *listed("stored_sweeps"),
        ({"Xgap.d": stats.norm(1e-6, 1e-6)}, {}, r"the distribution of Xgap\.d"),
        *(
            ({}, {"store": None, **how}, "without store")
            for how in ({"workers": 2}, {"scheduler": "a"}, {"shard": (1, 2)})
        ),
    ],
)
def test_bad_requests_are_refused_before_anything_is_written(circuit, parameters, how, said, tmp_path):
    with pytest.raises(fs.InputError, match=said) as told:
        fs.sweep(circuit, {**PARAMETERS, **parameters}, **{"store": tmp_path / "s.zarr", **HOW, **how})
    assert "\n" not in str(told.value)
    assert not list(tmp_path.iterdir())


FILE, SMALL = ((DECKS / name).read_text() for name in ("fingers.toml", "fingers_with_indices.toml"))


def described(folder: Path, text: str) -> Path:
    """The file of a sweep beside its deck."""
    for name in ("fingerpad.cir", "fingerspice.lib"):
        (folder / name).write_bytes((CIRCUITS / name).read_bytes())
    (folder / "fingers.toml").write_text(text)
    return folder / "fingers.toml"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return described(tmp_path, FILE)


@pytest.mark.usefixtures("forked_workers")
def test_the_command_fills_a_store_shard_by_shard(file, command):
    store = file.parent / "o.zarr"
    words = ("sweep", str(file), "--store", str(store))
    first = command(*words, "--shard", "1/2", "--json")
    answer = json.loads(first.out)
    assert first.code == 0, first.err
    assert (answer["scenes"], answer["failed"], answer["figures"]) == (384, None, None)
    assert {key: answer["store"][key] for key in ("chunks", "chunks_found", "chunks_missing")} == {
        "chunks": 3, "chunks_found": 0, "chunks_missing": 3,
    }  # fmt: skip
    assert answer["files"] == [str(store)]
    assert "3 pieces of other parts are missing" in command(*words, "--shard", "1/2").out
    last = command(*words, "--workers", "1", "--json")
    answer = json.loads(last.out)
    assert last.code == 0, last.err
    assert (answer["failed"], answer["store"]["chunks_found"], answer["store"]["chunks_missing"]) == (0, 3, 0)
    row = answer["figures"][0]
    found = fs.sweep(
        fs.read_netlist(file.parent / "fingerpad.cir"),
        {"source.frequency": np.geomspace(20, 2000, 6), "Xgap.d": stats.lognorm(0.1, scale=3.5e-6)},
        n=64, seed=1, outputs=("f_el_mean_periodic",), periodic=True,
    )  # fmt: skip
    assert row["median"] == float(found.f_el_mean_periodic.median())
    assert "median" in command(*words).out


@pytest.mark.parametrize(("words", "said"), listed("sweep_commands"))
def test_bad_commands_are_refused_in_one_sentence(file, command, words, said, monkeypatch):
    monkeypatch.chdir(file.parent)
    before = tree(file.parent)
    done = command("sweep", str(file), *words).refused(said)
    assert len(done.lines) == 1
    assert tree(file.parent) == before


def test_a_full_disk_ends_in_one_sentence_and_the_sweep_goes_on_from_there(file, command, monkeypatch):
    monkeypatch.chdir(file.parent)
    words = ("sweep", str(file), "--store", "o.zarr")
    monkeypatch.setattr(chunks, "CHUNK", CHUNK)
    with no_room_here(2500):
        refused = command(*words)
    assert refused.code == 2
    (line,) = [line for line in refused.lines if not line.startswith("fingerspice: warning")]
    assert "cannot write" in line
    assert "goes on from there" in line
    again = command(*words).ok()
    assert all(line.startswith("fingerspice: warning") for line in again.lines)


SWEPT = {"periodic": True, "outputs": ("f_el_mean_periodic",), "rtol": 1e-4}


def test_a_grid_has_a_dimension_for_each_array(circuit):
    gaps, loads = [3e-6, 3.5e-6, 4e-6], [0.3, 0.5]
    found = fs.sweep(circuit, {"xgap.D": gaps, "Xgap.fn": loads}, **SWEPT)
    assert found.f_el_mean_periodic.dims == ("Xgap.d", "Xgap.fn")
    for i, d in enumerate(gaps):
        for j, load in enumerate(loads):
            mean = fs.steady_state(circuit.replace({"Xgap.d": d, "Xgap.fn": load}), rtol=1e-6).solution.f_el_mean
            assert float(found.f_el_mean_periodic[i, j]) == pytest.approx(mean, rel=2e-4)


def test_a_population_is_the_same_at_every_place_and_for_every_seed(circuit):
    law = stats.lognorm(0.1, scale=3.5e-6)
    asked: dict[str, Any] = {"source.frequency": [100.0, 1000.0], "Xgap.d": law}
    found, again, other = (fs.sweep(circuit, asked, n=64, seed=seed, **SWEPT) for seed in (3, 3, 4))
    xr.testing.assert_identical(found, again)
    assert not np.array_equal(found["Xgap.d"], other["Xgap.d"])
    assert found.f_el_mean_periodic.dims == ("Vdrive.frequency", "scene")
    # Sobol points: one in each of 64 equal parts of the distribution.
    np.testing.assert_array_equal(np.sort(np.floor(64.0 * law.cdf(found["Xgap.d"].values))), np.arange(64))
    alone = fs.sweep(circuit.replace({"Vdrive.frequency": 1000.0}), {"Xgap.d": law}, n=64, seed=3, **SWEPT)
    np.testing.assert_array_equal(alone.f_el_mean_periodic, found.f_el_mean_periodic[1])


def test_indices_are_those_of_the_ishigami_function(circuit, monkeypatch):
    def function(x: np.ndarray) -> np.ndarray:
        return np.asarray(np.sin(x[0]) + 7.0 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0]))

    def ishigami(_circuit: fs.Circuit, scenes: Any, **_options: Any) -> xr.Dataset:
        value = function(np.array([scenes[path] for path in ("Xgap.d", "Xgap.r", "Xskin.d")]))
        status = np.zeros(value.size, np.int8)
        return xr.Dataset({"f_el_mean": ("scene", value), "status": ("scene", status)}, attrs={"failures": []})

    monkeypatch.setattr(populations, "batch", ishigami)
    law = stats.uniform(-np.pi, 2.0 * np.pi)
    found = fs.sobol(circuit, dict.fromkeys(("Xgap.d", "Xgap.r", "Xskin.d"), law), n=4096)
    # Ishigami and Homma 1990, a = 7, b = 0.1.
    first, total = [0.3139, 0.4424, 0.0], [0.5576, 0.4424, 0.2437]
    np.testing.assert_allclose(found.f_el_mean_first, first, atol=0.02)
    np.testing.assert_allclose(found.f_el_mean_total, total, atol=0.02)
    for kind, exact in (("first", first), ("total", total)):
        assert np.all(found[f"f_el_mean_{kind}_low"] <= np.array(exact) + 0.01)
        assert np.all(found[f"f_el_mean_{kind}_high"] >= np.array(exact) - 0.01)
    theirs = stats.sobol_indices(func=function, n=4096, dists=[law] * 3, rng=0)
    np.testing.assert_allclose(found.f_el_mean_first, theirs.first_order, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.f_el_mean_total, theirs.total_order, rtol=0, atol=1e-12)
    assert np.all(found.f_el_mean_first_low <= found.f_el_mean_first)
    assert np.all(found.f_el_mean_first_high >= found.f_el_mean_first)
    assert float(found.f_el_mean_mean) == pytest.approx(3.5, abs=0.05)
    rows = populations.ranking(found, "f_el_mean")
    assert [row["parameter"] for row in rows] == ["Xgap.d", "Xgap.r", "Xskin.d"]
    assert all(row["low"] <= row["total"] <= row["high"] for row in rows)


def test_one_parameter_alone_has_the_whole_variance(circuit):
    found = fs.sobol(circuit, {"Xgap.d": stats.lognorm(0.1, scale=3.5e-6)}, n=64, skin="follow", **SWEPT)
    for kind in ("first", "total"):
        np.testing.assert_allclose(found[f"f_el_mean_periodic_{kind}"], [1.0], atol=0.05)


def test_what_matters_to_the_force_is_named_at_every_place(circuit):
    asked = {
        "source.frequency": [100.0, 5000.0], "Xgap.d": stats.lognorm(0.1, scale=3.5e-6),
        "Xcoat.r": stats.lognorm(1e-3, scale=2e5),
    }  # fmt: skip
    found = fs.sobol(circuit, asked, n=64, skin="follow", **SWEPT)
    assert found.f_el_mean_periodic_total.dims == ("Vdrive.frequency", "parameter")
    # A resistance that hardly varies hardly matters.
    assert np.all(found.f_el_mean_periodic_total.sel(parameter="Xgap.d") > 0.95)
    assert np.all(found.f_el_mean_periodic_total.sel(parameter="Xcoat.r") < 0.05)
    rows = populations.ranking(found, "f_el_mean_periodic")
    assert [(row["place"]["Vdrive.frequency"], row["parameter"]) for row in rows] == [
        (100.0, "Xgap.d"), (100.0, "Xcoat.r"), (5000.0, "Xgap.d"), (5000.0, "Xcoat.r")
    ]  # fmt: skip
    # One parameter at a quantile and the other at its median is a scene like any other.
    place = {
        "Vdrive.frequency": 5000.0,
        "Xgap.d": float(found["at"].sel(parameter="Xgap.d", quantile=0.95)),
        "Xcoat.r": 2e5,
    }
    alone = fs.batch(circuit, place, skin="follow", **SWEPT).f_el_mean_periodic
    assert float(found.f_el_mean_periodic_alone.sel(parameter="Xgap.d", quantile=0.95)[1]) == float(alone[0])


def test_several_paths_are_scaled_together(circuit):
    both = fs.sweep(circuit, {"Xgap.alpha, xgap.beta": [0.8, 1.2], "Xgap.fn": 0.3}, **SWEPT)
    assert both.f_el_mean_periodic.dims == ("Xgap.alpha,Xgap.beta",)
    for i, factor in enumerate((0.8, 1.2)):
        scaled = {path: factor * circuit.parameters[path].value for path in ("Xgap.alpha", "Xgap.beta")}
        mean = fs.steady_state(circuit.replace({**scaled, "Xgap.fn": 0.3}), rtol=1e-6).solution.f_el_mean
        assert float(both.f_el_mean_periodic[i]) == pytest.approx(mean, rel=2e-4)
    with pytest.raises(fs.InputError, match=r"Xgap\.alpha is given twice"):
        fs.sweep(circuit, {"Xgap.alpha, Xgap.beta": [0.8], "Xgap.alpha": 54.4}, **SWEPT)


def test_the_shipped_sweep_of_fig_3_says_what_matters_where(tmp_path, command):
    done = command("sweep", str(CIRCUITS / "fig3.toml"), "--out", str(tmp_path), "--json").ok()
    shares: dict[float, dict[str, float]] = {}
    for row in json.loads(done.out)["shares"]:
        shares.setdefault(row["place"]["Vdrive.frequency"], {})[row["parameter"]] = row["total"]
    slow, fast = shares[10.0], shares[10000.0]
    # Section 4 of the paper: the gap's thickness matters at all frequencies, its resistance at low ones, and the area
    # more than the skin's thickness.
    assert all(max(one, key=one.__getitem__) == "Xgap.d" for one in shares.values())
    assert slow["Xgap.r"] > 0.25
    assert fast["Xgap.r"] < 0.01
    assert all(one["Xgap.alpha,Xgap.beta"] > 3.0 * one["Xskin.d"] for one in shares.values())
    with xr.open_dataset(tmp_path / "fig3.nc", engine="h5netcdf") as kept:
        assert kept.f_el_mean_periodic.dims == ("Vdrive.frequency", "scene")


@pytest.mark.parametrize(
    ("parameters", "how", "said"),
    [
        *listed("sweeps"),
        ({"Xgap.d": stats.norm(1e-6, 1e-6)}, {}, "in scene"),
        ({"Xgap.d": stats.lognorm(0.1, scale=3e-6)}, {"n": 1000}, "a power of two"),
    ],
)
def test_bad_sweeps_are_refused_in_one_sentence(circuit, parameters, how, said):
    with pytest.raises(fs.InputError, match=said) as told:
        fs.sweep(circuit, parameters, **how)
    assert "\n" not in str(told.value)
    if not any(hasattr(value, "ppf") for value in parameters.values()):
        with pytest.raises(fs.InputError):
            fs.sobol(circuit, parameters, **how)


def test_the_command_writes_scenes_indices_and_a_picture(tmp_path, command):
    file = str(described(tmp_path, SMALL))
    done = command("sweep", file, "--out", str(tmp_path / "o"), "--json")
    answer = json.loads(done.out)
    assert done.code == 0, done.err
    assert (answer["scenes"], answer["failed"], answer["n"]) == (32, 0, 32)
    assert answer["figures"][0]["p5"] < answer["figures"][0]["median"] < answer["figures"][0]["p95"]
    assert answer["shares"][0]["parameter"] == "Xgap.d"
    with xr.open_dataset(tmp_path / "o" / "fingers.nc", engine="h5netcdf") as kept:
        assert kept.f_el_mean_periodic.shape == (32,)
        assert kept.f_el_mean_periodic_total.shape == (2,)
    assert (tmp_path / "o" / "fingers.png").stat().st_size > 10_000
    # Of the same deck: replaced without a question.
    assert command("sweep", file, "--out", str(tmp_path / "o"), "--no-plot").code == 0


@pytest.mark.parametrize(("change", "said"), listed("sweep_files"))
def test_bad_files_are_refused_in_one_sentence(tmp_path, command, change, said):
    done = command("sweep", str(described(tmp_path, SMALL.replace(*change))), "--out", str(tmp_path / "o")).refused()
    assert said in done.err
    assert "Traceback" not in done.err
    assert not (tmp_path / "o").exists()
