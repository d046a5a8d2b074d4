"""Files of `run`: data, pictures and the store of ``--stream``; and the large-signal sweep of `ac`."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice import __version__
from fingerspice.base.announcing import paced
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.cli.options import check_output, time_from_text
from fingerspice.cli.result_files import Results
from fingerspice.cli.terminal import Answering, progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fingerspice.base.arrays import FloatArray
    from fingerspice.circuit.circuit import Circuit
    from fingerspice.cli.store import Store
    from fingerspice.results.phasor_solution import PhasorSolution
    from fingerspice.results.solution import Solution
    from fingerspice.solve.streaming import Stream
    from fingerspice.studies.feel import Feel


def written(
    solution: Solution, data: Path, picture: Path | None, results: Results, schematic: Path | None
) -> list[Callable[[], Path]]:
    """Functions that write the files of a run: the data, then the picture and the schematic where they have a path."""
    if not solution.t.size:
        return []
    results.open()
    writes: list[Callable[[], Path]] = [partial(solution.to_csv if data.suffix == ".csv" else solution.to_netcdf, data)]
    writes += results.pictures(picture, lambda: _pictured(solution, results, schematic))
    if schematic is not None:
        # An SVG file knows no names of our own, and keeps all of them as one text.
        about = {"Description": json.dumps(results.about)}
        writes.append(lambda: results.circuit.draw().write(schematic, about))
    return writes


def _pictured(solution: Solution, results: Results, schematic: Path | None) -> Figure:
    """The picture of a run, with the circuit beside it where the circuit is drawn, too."""
    from fingerspice.plots.schematic import put_beside

    return solution.plot() if schematic is None else put_beside(solution.plot(), results.circuit)


def large_sweep(
    circuit: Circuit, frequencies: FloatArray, amplitude: list[float] | None, **how: Any
) -> tuple[PhasorSolution, ...]:
    """The sweep with ``--area coupled``: the periodic state at every frequency (Hz) and amplitude (V)."""
    from fingerspice.studies.comparison import large_signal

    with progress("sweeping") as update:
        return large_signal(circuit, frequencies, amplitude, progress=update, **how)


class Touch:
    """Estimated perception of a run, for ``--feel``: one picture of all fingers, and a page for each.

    Parameters
    ----------
    circuit : Circuit
        A circuit with at least one GAP.
    results : Results or None
        Files of the command, which get the picture; None for no picture.
    """

    def __init__(self, circuit: Circuit, results: Results | None) -> None:
        if not circuit.by_device("GAP"):
            raise InputError("--feel: the circuit has no GAP, so there is no friction to feel")
        self.results = results
        self.picture = None if results is None else results.file("_feel.png")
        self.fingers: list[Feel] = []
        self.failed: InputError | None = None

    def look(self, solution: Solution) -> list[dict[str, Any]] | None:
        """The answer for each finger of a run; None, with the reason in `failed`, if outputs are too few or uneven."""
        from fingerspice.studies.feel import feel

        try:
            self.fingers = [feel(solution, name) for name in solution.all_signals.names("f_t")]
        except InputError as error:
            # The error is raised later, after the files of the run have been written.
            self.failed = error
            return None
        return [one.to_dict() for one in self.fingers]

    @property
    def said(self) -> list[str]:
        """A page for each finger."""
        return list(map(str, self.fingers))

    @property
    def writes(self) -> list[Callable[[], Path]]:
        """The function that writes the picture; empty if no picture is wanted."""
        if self.results is None or not self.fingers:
            return []
        return self.results.pictures(self.picture, lambda: self.fingers[0].plot(self.fingers[1:]))


def run_streamed(
    answer: Answering, results: Results, circuit: Circuit, how: dict[str, Any], *, chunk: str | None,
    signals: str | None, netcdf: bool,
) -> None:  # fmt: skip
    """Run a circuit, write its chunks to a store, and fill the answer.

    Raises
    ------
    InputError
        If the request cannot be run, the store is damaged or holds another run, or the disk is full.
    SolveError
        If the run fails; the chunks before the failure are in the store.
    """
    from fingerspice.cli.store import Store
    from fingerspice.solve.streaming import stream

    path = results.folder / f"{results.name}.zarr"
    # The store is a folder, so check that a file can be written next to it.
    check_output(path.with_suffix(".zarr.part"), results.deck)
    names = _names(signals, circuit)
    charge = any(name in ("q_source", "i_source") for name in names)
    run = stream(circuit, chunk=time_from_text("--chunk", chunk), charge=charge, **how)
    data = results.file(".nc") if netcdf else None
    store = Store(path, _identity(run, circuit, how, names), run.outputs.total, run.count)
    store.open(results.overwrite)
    if store.done and store.done < store.chunks:
        run.go_to(store.mark, store.done * store.count)
    results.open()
    begun, first = time.perf_counter(), store.done
    answer.data["files"].append(str(path))
    if first < store.chunks:
        _fill(run, store, names, results)
    answer.update(**store.so_far)
    took, made = time.perf_counter() - begun, (store.chunks - first) / store.chunks
    span = run.problem.t_stop - run.problem.t_start
    pieces = f"{store.chunks:,} piece{'s' if store.chunks > 1 else ''}"
    said = [f"{run.outputs.total:,} outputs of {span:g} s in {pieces}: {path}"]
    if made > 0.0:
        said.append(f"{made * span / took:,.3g} times real time")
    error = store.so_far["error"]
    said.append(f"stated error {error['u_gap']:.2g} V of the gap voltage, {error['f_el']:.2g} N of the force")
    if first:
        said.append(f"the first {first:,} were there already")
    answer.update(stream={"chunks": store.chunks, "found": first, "outputs": run.outputs.total, "seconds": took})
    answer.give(lambda: "; ".join(said), [] if data is None else [lambda: store.to_netcdf(data)])


def _names(signals: str | None, circuit: Circuit) -> list[str]:
    """Keys of the signals that are written."""
    from fingerspice.results.signals import SIGNALS

    if signals is None:
        return ["u_gap", "f_el"] if circuit.by_device("GAP") else ["u_layer"] if _layers(circuit) else ["v"]
    names = [name.strip() for name in signals.split(",")]
    for name in names:
        if name not in SIGNALS:
            raise InputError(f"--signals names {name!r}; allowed: {', '.join(SIGNALS)}")
    return sorted(set(names), key=list(SIGNALS).index)


def _layers(circuit: Circuit) -> bool:
    return any(element.spec.is_layer for element in circuit.elements)


def _identity(run: Stream, circuit: Circuit, how: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """All inputs that determine the bytes of a store, by which a later call recognises its own store."""
    from fingerspice.base.compiled import STAMP
    from fingerspice.circuit.describe import digests

    elements, sources = digests(circuit)
    o = run.outputs
    return {
        "circuit": elements, "source": sources, "rtol": how["rtol"],
        "charge_law": run.problem.scene.charge_law, "area": run.problem.scene.area_mode, "method": how["method"],
        "start": str(how["start"]), "chunk": run.count, "signals": names, "end": run.problem.t_stop,
        "output_times": [o.start, o.over, o.low, o.total],
        "program": f"fingerspice {__version__} ({STAMP[:12]}), NumPy {np.__version__}",
    }  # fmt: skip


def _fill(run: Stream, store: Store, names: list[str], results: Results) -> None:
    """Compute and write all missing chunks; a chunk is written while the next one is computed."""
    about = {key: text for key, text in results.about.items() if key != "files"}
    known: set[str] = set()
    writing: Future[None] | None = None
    start, stop = run.problem.t_start, run.problem.t_stop
    first = float(run.outputs.times(run.done, run.done + 1)[0])
    with ThreadPoolExecutor(1) as writer, paced("simulating", (first - start) / (stop - start)) as show:
        for number, solution in enumerate(run, store.done):
            for text in solution.warnings:
                if text not in known:
                    known.add(text)
                    warnings.warn(text, FingerspiceWarning, stacklevel=2)
            if writing is not None:
                writing.result()
            writing = writer.submit(store.write, number, solution, names, about, run.mark())
            reached = solution.t_stop
            show((reached - start) / (stop - start), lambda s, t=reached: f"{(t - first) / s:,.3g} times real time,")
        if writing is not None:
            writing.result()
