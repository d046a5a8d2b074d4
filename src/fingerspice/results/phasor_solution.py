"""The result of a phasor sweep, with its columns, from which its table, file and plain data follow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import ComplexArray, FloatArray
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import heading
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Column(NamedTuple):
    """A column of a result, from which its table, its file and its plain data follow."""

    key: str
    unit: str
    values: FloatArray  # In that unit, shape (n,)
    head: str = ""  # Heading in a table; a column without one only belongs into files
    factor: float = 1.0  # From its unit to that of the heading
    form: str = ".5g"


@dataclass(frozen=True, repr=False)
class PhasorSolution(Shown):
    """Phasors against frequency; arrays of shape (n_frequency,).

    Attributes
    ----------
    frequency : ndarray
        Hz.
    gain : ndarray of complex
        Ratio of gap voltage to source, with the modulus of Eq. 11 and the angle of Eq. 13 (V/A for a current source).
    layer_gain : ndarray of complex, shape (n_frequency, n_layer)
        The same ratio for every layer.
    u_gap : ndarray of complex
        Complex amplitude of the gap voltage, V; NaN for a source without fundamental or AC.
    area : ndarray
        Ridge contact area, m^2.
    f_el_mean : ndarray
        Mean electroadhesive force, N.
    amplitude : float
        Source amplitude, V (A for a current source).
    layers : tuple of str
    phase : float
        Phase of the source, rad.
    drive : str
        Where amplitude and phase come from, in words.
    notes : tuple of str
        Remarks on how the sweep was made.
    warnings : tuple of str
        Warnings of extrapolation and of implausible results.
    circuit : Circuit or None
        The circuit of the sweep.
    impedance : ndarray of complex or None
        Voltage of the source over its current, ohm; None for a large-signal sweep or several sources.
    nodes : tuple of str
        Nodes of a circuit without GAP, for which figures of a gap are NaN; empty with a GAP.
    v_nodes : ndarray of complex or None, shape (n_frequency, n_node)
        Their complex amplitudes, V.
    """

    frequency: FloatArray
    gain: ComplexArray
    layer_gain: ComplexArray
    u_gap: ComplexArray
    area: FloatArray
    f_el_mean: FloatArray
    amplitude: float
    layers: tuple[str, ...]
    phase: float = 0.0
    drive: str = ""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    circuit: Circuit | None = None
    impedance: ComplexArray | None = None
    nodes: tuple[str, ...] = ()
    v_nodes: ComplexArray | None = None

    def _columns(self) -> list[Column]:
        """The columns of its table and its file; the amplitude, without a heading, only belongs into the file."""

        def polar(key: str, phase: str, x: ComplexArray, unit: str, heads: tuple[str, str], form: str = ".5g") -> None:
            out.append(Column(key, unit, np.abs(x), heads[0], form=form))
            out.append(Column(phase, "deg", np.degrees(np.angle(x)), heads[1], form=".3f"))

        out = [Column("frequency", "Hz", self.frequency, "frequency [Hz]", form=".6g")]
        for i, node in enumerate(self.nodes):
            assert self.v_nodes is not None
            polar(f"v:{node}", f"phase_deg:{node}", self.v_nodes[:, i], "V", (f"|v({node})| [V]", "phase [deg]"))
        if not self.nodes:
            polar("gain", "phase_deg", self.gain, "1", ("|u_gap/U|", "phase [deg]"), ".5f")
            out.append(Column("u_gap", "V", np.abs(self.u_gap), "u_gap [V]"))
            out.append(Column("area", "m^2", self.area, "area [mm^2]", 1e6))
            out.append(Column("f_el_mean", "N", self.f_el_mean, "mean force [N]"))
        out.append(Column("amplitude", "V", np.full(self.frequency.size, self.amplitude)))
        if self.impedance is not None:
            polar("impedance", "impedance_phase_deg", self.impedance, "ohm", ("|Z| [ohm]", "phase of Z [deg]"))
        return out

    def _page(self, most: int = 20) -> Page:
        """A table; of a long sweep, only every n-th row, so that at most `most` rows remain."""
        rows = slice(None, None, max(1, -(-self.frequency.size // most)))
        drive = f"source amplitude {format_si(self.amplitude, 'V')}, phase {math.degrees(self.phase):.4g} deg"
        shown = [column for column in self._columns() if column.head]
        cells = [[f"{c.factor * x:{c.form}}" for x in c.values[rows].tolist()] for c in shown]
        table = Table(tuple(column.head for column in shown), [*zip(*cells, strict=True)])
        return Page([f"{drive}: {self.drive}", *self.notes, table])

    def to_dict(self) -> dict[str, Any]:
        """The sweep as plain data, SI units."""
        columns = [column for column in self._columns() if column.key != "amplitude"]
        # Phases of nodes come after all amplitudes.
        columns.sort(key=lambda column: column.key.startswith("phase_deg:"))
        found: dict[str, Any] = {column.key: column.values.tolist() for column in columns}
        found.setdefault("impedance", None)
        found.setdefault("impedance_phase_deg", None)
        return found | {
            "amplitude": self.amplitude, "source_phase_deg": math.degrees(self.phase), "drive": self.drive,
            "notes": list(self.notes), "warnings": list(self.warnings),
        }  # fmt: skip

    def plot(self) -> Figure:
        """Gain, phase, mean force and area, or without GAP the node voltages, against frequency."""
        from fingerspice.plots.traces import plot_phasor

        require(self.circuit is not None, "circuit", self.circuit, "a sweep that phasor or large_signal made")
        assert self.circuit is not None
        return plot_phasor((self,), self.circuit)


def phasor_tables(results: Sequence[PhasorSolution], circuit: Circuit) -> str:
    """Sweeps of a circuit at several amplitudes as tables."""
    return "\n\n".join([heading(circuit), *(r._page(40) for r in results)])


def phasor_csv(results: Sequence[PhasorSolution], path: Path) -> Path:
    """Write sweeps as CSV, one after the other where there are several amplitudes."""
    tables = [r._columns() for r in results]
    header = [f"{column.key} [{column.unit}]" for column in tables[0]]
    rows = (row for columns in tables for row in zip(*(c.values.tolist() for c in columns), strict=True))
    return write_csv(path, header, rows)
