"""The transient's periodic state beside the phasor, and what the ripple of the area has to do with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.errors import InputError
from fingerspice.base.pages import Page, Shown
from fingerspice.circuit.arguments import Parameters, Sources, overridden
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.statespace import build_stack
from fingerspice.results.solution import Solution
from fingerspice.studies.phasors import phasor
from fingerspice.studies.steady import steady_state

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture


@dataclass(frozen=True)
class Figures:
    """Gap voltage at the fundamental, mean force and mean area of one way of solving.

    Attributes
    ----------
    amplitude : float
        V.
    phase_deg : float
        Lead over the source's fundamental, degrees.
    f_el_mean : float
        N.
    area_mean : float
        m^2.
    """

    amplitude: float
    phase_deg: float
    f_el_mean: float
    area_mean: float


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """The same scene solved three ways.

    Attributes
    ----------
    phasor : Figures
        Eqs. 9 to 15, area coupled through the mean stress.
    mean : Figures
        Transient with the phasor's area: what it differs by from `phasor` is not the area's doing.
    coupled : Figures
        Transient with the area coupled at every instant: what it differs by from `mean` is the area's ripple.
    frequency : float
        Hz.
    solution : Solution
        One period of the coupled transient.
    """

    phasor: Figures
    mean: Figures
    coupled: Figures
    frequency: float
    solution: Solution

    def _page(self) -> Page:
        from fingerspice.studies.reports import comparison_table

        return comparison_table(self)

    def plot(self) -> Picture:
        """One period of the transient over the phasor's, and the figures of both."""
        from fingerspice.studies.pictures import plot_comparison

        return plot_comparison(self)

    def rows(self) -> list[tuple[str, str, float, float, float, float, float]]:
        """Table: quantity, unit, phasor, transient at mean area, coupled, difference, share of the ripple in it."""
        out = []
        for name, unit, factor in (
            ("amplitude", "V", 1.0),
            ("phase_deg", "deg", 1.0),
            ("f_el_mean", "N", 1.0),
            ("area_mean", "mm^2", 1e6),
        ):
            p, m, c = (factor * getattr(f, name) for f in (self.phasor, self.mean, self.coupled))
            out.append((name, unit, p, m, c, c - p, c - m))
        return out

    def to_dict(self) -> dict[str, Any]:
        """The figures as plain data, SI."""
        return {
            "frequency": self.frequency,
            "phasor": vars(self.phasor),
            "transient_mean_area": vars(self.mean),
            "transient_coupled": vars(self.coupled),
        }


def compare(
    circuit: Circuit,
    *,
    sources: Sources | None = None,
    parameters: Parameters | None = None,
    charge_law: str | None = None,
    rtol: float = 1e-8,
) -> Comparison:
    """Set the periodic state of the transient beside the phasor.

    Parameters
    ----------
    circuit : Circuit
        With a GAP and a periodic source that has a fundamental.
    sources, parameters, charge_law
        As in `simulate`.
    rtol : float
        Error of the transients, relative to their peaks.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        For a circuit without GAP, or a source without period or fundamental.
    SolveError
        Where a transient fails.
    """
    circuit = overridden(circuit, sources, parameters)
    fundamental = build_stack(circuit).waveform.fundamental
    if fundamental is None:
        raise InputError("compare needs a source with a fundamental: a periodic one; this source has none")
    p = phasor(circuit)
    coupled = steady_state(circuit, charge_law=charge_law, rtol=rtol, points=2000).solution
    mean = steady_state(circuit, charge_law=charge_law, area=float(p.area[0]), rtol=rtol, points=2000).solution
    lead = float(np.degrees(np.angle(p.gain[0])))
    return Comparison(
        Figures(float(abs(p.u_gap[0])), lead, float(p.f_el_mean[0]), float(p.area[0])),
        _figures(mean, fundamental.phase),
        _figures(coupled, fundamental.phase),
        fundamental.frequency,
        coupled,
    )


def _figures(solution: Solution, phase: float) -> Figures:
    summary = solution.summary()
    lead = (summary["u_gap_phase_deg"] - np.degrees(phase) + 180.0) % 360.0 - 180.0
    return Figures(
        summary["u_gap_amplitude"], float(lead), summary["f_el_mean_periodic"], summary["area_mean_periodic"]
    )
