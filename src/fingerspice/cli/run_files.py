"""Files of the command `run`: data, picture and the picture of ``--feel``; and the large-signal sweep of `ac`."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fingerspice.base.errors import InputError
from fingerspice.cli.result_files import Results
from fingerspice.cli.terminal import progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fingerspice.base.arrays import FloatArray
    from fingerspice.circuit.circuit import Circuit
    from fingerspice.results.phasor_solution import PhasorSolution
    from fingerspice.results.solution import Solution
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
    from fingerspice.studies.largesignal import large_signal

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
