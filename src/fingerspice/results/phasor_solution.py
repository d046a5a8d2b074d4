"""The result of a phasor sweep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from fingerspice.base.arrays import ComplexArray, FloatArray
from fingerspice.base.pages import Page, Shown
from fingerspice.circuit.circuit import Circuit
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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

    def _page(self) -> Page:
        from fingerspice.results.report import phasor_table

        return phasor_table(self, most=20)

    def plot(self) -> Figure:
        """Gain, phase, mean force and area, or without GAP the node voltages, against frequency."""
        from fingerspice.plots.traces import plot_phasor

        require(self.circuit is not None, "circuit", self.circuit, "a sweep that phasor or large_signal made")
        assert self.circuit is not None
        return plot_phasor((self,), self.circuit)
