"""A run on the disk (``run --stream``): a Zarr store that grows chunk by chunk, and can be continued after a crash.

Every chunk of the run is one chunk of each array. The number of finished chunks is an attribute of the store's group,
whose file is replaced atomically after the chunk's data have reached the disk.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np

import fingerspice as fs
from fingerspice.base.announcing import paced
from fingerspice.base.compiled import STAMP
from fingerspice.base.errors import InputError
from fingerspice.base.files import settle_on_disk, write_aside, write_durably
from fingerspice.circuit.describe import digests
from fingerspice.cli.options import Job, check_output, number
from fingerspice.results import runfile
from fingerspice.results.record import SIGNALS, variables
from fingerspice.solve.runs import warn
from fingerspice.solve.streaming import Stream, stream
from fingerspice.waveforms.waveform import refuse

#: Attributes of the group: identity of the run, number of finished chunks, state to continue from, results so far, and
#: the number of columns of each array, 0 for one without.
RUN, DONE, MARK, SO_FAR, COLUMNS = "run", "chunks_done", "goes_on", "so_far", "arrays"
_PIECE = 1 << 25  # Number of bytes of the store that are copied at once


class Store:
    """A store of one run in a folder.

    `run` is its identity, all inputs that determine its results, as plain data; the run has `total` outputs, and a
    chunk `count`. Within `lock`, no other process writes the store.
    """

    def __init__(self, path: Path, run: dict[str, Any], total: int, count: int) -> None:
        self.zarr = runfile.zarr_library()
        self.run = json.loads(json.dumps({**run, "kind of checksum": runfile.CHECKSUM}))
        self.path, self.total, self.count = path, total, count
        self.chunks, self.done, self.there = -(-total // count), 0, False  # Chunks of the whole run
        self.mark: dict[str, Any] = {}
        self.so_far: dict[str, Any] = {}
        self.lock = ExitStack()
        self._busy = f"another process writes {path}; allowed: to wait for it, --name NAME, or another --out"

    def _hold(self, folder: Path) -> None:
        """Keep other processes from the store in a folder, also after it is renamed."""
        # Without locks, as on some file systems, nothing is refused.
        with suppress(OSError):
            number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            self.lock.callback(os.close, number)
            try:
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(self._busy) from None

    def open(self, overwrite: bool) -> None:
        """Open an existing store of the same run, to continue it; with `overwrite` remove any store.

        A folder that is no store is refused, as is a store that is damaged, of another run, or being written.
        """
        if not os.path.lexists(self.path):
            return
        self._hold(self.path)
        whole = False
        with suppress(OSError, ValueError, KeyError, TypeError):
            held = runfile.attributes_of(self.path)
            kinds = {RUN: dict, MARK: dict, SO_FAR: dict, COLUMNS: dict, DONE: int}
            signed = held.get(runfile.SIGNATURE, "") in ("", runfile.signature(held))
            whole = signed and all(isinstance(held[key], kind) for key, kind in kinds.items()) and held[DONE] >= 0
        refuse(not whole, f"{self.path} is there already and is no whole store of a run; allowed: --name or --out")
        if overwrite:
            shutil.rmtree(self.path)
            return
        self.there = True
        for key, own in self.run.items():
            other = held[RUN].get(key)
            said = "" if len(f"{other}{own}") > 80 else f" ({other}, and this one {own})"
            what = f"{'other' if key == 'signals' else 'another'} {key.replace('_', ' ')}{said}"
            ways = "allowed: --name NAME, another --out, or --overwrite"
            refuse(other != own, f"{self.path} holds a run of {what}; {ways}")
        self.done, self.mark, self.so_far = held[DONE], held[MARK], held[SO_FAR]
        # What a call that was killed has left.
        runfile.tidy(self.path)
        written = set(map(str, range(self.done)))
        for file in self.path.glob("*/c/**/*"):
            if file.is_file() and file.relative_to(self.path).parts[2] not in written:
                file.unlink()
        runfile.check_store(self.path)

    def write(self, chunk: int, solution: fs.Solution, signals: list[str], about: dict[str, Any], mark: Any) -> None:
        """Write a chunk, then record it as finished; `mark` is the state from which the run continues."""
        data, coords = variables(solution, np.ones(solution.t.size, bool), signals)
        data = {"time": coords["time"], **data}
        columns = {name: sum(values.shape[1:]) for name, (_, values, _) in data.items()}
        arrays = {
            name: runfile.Array(
                self.path / name, dims, (self.total, *values.shape[1:]), (self.count, *values.shape[1:]),
                said | {dim: coords[dim][1].tolist() for dim in dims[1:]},
            )
            for name, (dims, values, said) in data.items()
        }  # fmt: skip
        self.so_far = {
            "method": solution.method, "area": solution.area_mode, "tier": solution.plan.tier,
            "t_stop": solution.t_stop, "error": vars(solution.error), "fold_margin_min": solution.fold_margin_min,
        }  # fmt: skip
        try:
            if not self.there:
                blank = {RUN: self.run, DONE: 0, MARK: {}, SO_FAR: {}, COLUMNS: columns}
                # The store is locked before it has its name.
                if not runfile.create(self.path, {**about, **blank}, arrays, {}, self._hold):
                    raise InputError(self._busy)
                self.there = True
            for name, one in arrays.items():
                place = (chunk, 0)[: len(one.shape)]
                one.put(place, data[name][1])
                settle_on_disk(one.file(place).parent)
            head = json.loads((self.path / "zarr.json").read_text())
            head["attributes"] |= {DONE: chunk + 1, MARK: mark, SO_FAR: self.so_far}
            head["attributes"][runfile.SIGNATURE] = runfile.signature(head["attributes"])
            write_durably(self.path / "zarr.json", json.dumps(head, indent=1).encode())
        except OSError as error:
            done = f"{self.done} of {self.chunks} pieces are written, and the same command goes on from there"
            raise InputError(f"cannot write {self.path}: {error.strerror or error}; {done}") from None
        self.done = chunk + 1

    def to_netcdf(self, path: Path) -> Path:
        """Write the whole run as NetCDF, piece by piece."""
        import h5netcdf

        group = self.zarr.open_group(self.path, mode="r")
        # In an order of their own: that of a folder differs from machine to machine.
        arrays = dict(sorted(group.arrays()))
        size = sum(array.nbytes for array in arrays.values()) + 2**20

        def write(target: Path) -> None:
            # HDF5 ends the process on a full disk: reserve the room first, so that a full disk raises an error here.
            with target.open("wb") as room:
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(room.fileno(), 0, size)
                elif shutil.disk_usage(target.parent).free < size:
                    raise OSError(f"it takes {size / 1e9:.3g} GB, which the disk has not")
            with h5netcdf.File(target, "w") as file:
                for name, array in arrays.items():
                    lengths = dict(zip(array.metadata.dimension_names, array.shape, strict=True))
                    file.dimensions.update({key: x for key, x in lengths.items() if key not in file.dimensions})
                    variable = file.create_variable(name, tuple(lengths), dtype="f8")
                    about = array.attrs.asdict()
                    variable.attrs.update({k: x if isinstance(x, str) else json.dumps(x) for k, x in about.items()})
                    rows = max(1, _PIECE // (8 * max(1, int(np.prod(array.shape[1:])))))
                    for at in range(0, self.total, rows):
                        variable[at : at + rows] = array[at : at + rows]
                file.attrs.update({k: value for k, value in group.attrs.asdict().items() if isinstance(value, str)})

        return write_aside(path, write)


def run_streamed(
    job: Job, circuit: fs.Circuit, how: dict[str, Any], *, chunk: str | None, signals: str | None, netcdf: bool
) -> None:
    """Run a circuit, write its chunks to a store, and fill the answer; what a failed run has written stays."""
    names, answer = _names(signals, circuit), job.answer
    charge = any(name in ("q_source", "i_source") for name in names)
    run = stream(circuit, chunk=number("--chunk", chunk), charge=charge, **how)
    name = job.check_files(circuit, *([".nc"] if netcdf else []))
    path = name.with_name(f"{name.name}.zarr")
    # The store is a folder, so check that a file can be written next to it.
    check_output(path.with_suffix(".zarr.part"), job.deck)
    total, span = run.outputs.total, run.problem.t_stop - run.problem.t_start
    store = Store(path, _identity(run, circuit, how, names), total, run.count)
    with store.lock:
        store.open(job.overwrite)
        if store.done and store.done < store.chunks:
            run.go_to(store.mark, store.done * store.count)
        job.make_folder()
        begun, first = time.perf_counter(), store.done
        answer["files"].append(str(path))
        said = [f"{total:,} outputs of {span:g} s in {store.chunks:,} piece{'s' if store.chunks > 1 else ''}: {path}"]
        if first < store.chunks:
            _fill(run, store, names, {key: text for key, text in job.about.items() if key != "files"})
            speed = (store.chunks - first) / store.chunks * span / (time.perf_counter() - begun)
            said.append(f"{speed:,.3g} times real time")
        error = store.so_far["error"]
        said.append(f"stated error {error['u_gap']:.2g} V of the gap voltage, {error['f_el']:.2g} N of the force")
        if first:
            said.append(f"the first {first:,} were there already")
        found = {"chunks": store.chunks, "found": first, "outputs": total, "seconds": time.perf_counter() - begun}
        answer.update(**store.so_far, stream=found)
        job.give(lambda: "; ".join(said), {".nc": store.to_netcdf})


def _names(signals: str | None, circuit: fs.Circuit) -> list[str]:
    """Keys of the signals that are written, of those that the circuit has."""
    has = {"gap": circuit.by_device("GAP"), "layer": [e for e in circuit.elements if e.spec.is_layer]}
    allowed = [name for name, signal in SIGNALS.items() if has.get(signal.of, True)]
    if signals is None:
        return ["u_gap", "f_el"] if has["gap"] else ["u_layer"] if has["layer"] else ["v"]
    names = [name.strip() for name in signals.split(",")]
    if unknown := [name for name in names if name not in allowed]:
        raise InputError(f"--signals names {unknown[0]!r}; allowed: {', '.join(allowed)}")
    return sorted(set(names), key=list(SIGNALS).index)


def _identity(run: Stream, circuit: fs.Circuit, how: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """All inputs that determine the bytes of a store, by which a later call recognises its own store."""
    elements, sources = digests(circuit)
    o, scene = run.outputs, run.problem.scene
    return {
        "circuit": elements, "source": sources, "rtol": how["rtol"], "charge_law": scene.charge_law,
        "area": scene.area_mode, "method": how["method"], "start": str(how["start"]), "chunk": run.count,
        "signals": names, "end": run.problem.t_stop, "output_times": [o.start, o.rate or o.spacing, o.low, o.total],
        "program": f"fingerspice {fs.__version__} ({STAMP[:12]}), NumPy {np.__version__}",
    }  # fmt: skip


def _fill(run: Stream, store: Store, names: list[str], about: dict[str, str]) -> None:
    """Compute and write all missing chunks; a chunk is written while the next one is computed."""
    start, span = run.problem.t_start, run.problem.t_stop - run.problem.t_start
    first = float(run.outputs.times(run.done, run.done + 1)[0])
    with ThreadPoolExecutor(1) as writer, paced("simulating", (first - start) / span) as show:
        writing: Future[None] = writer.submit(lambda: None)
        for number, solution in enumerate(run, store.done):
            # One that comes again is not told again.
            warn(solution, 2)
            writing.result()
            writing = writer.submit(store.write, number, solution, names, about, run.mark())
            reached = solution.t_stop
            show((reached - start) / span, lambda s, t=reached: f"{(t - first) / s:,.3g} times real time,")
        writing.result()
