"""Comparison of the transient's periodic state with the phasor, and the part that the area's ripple has in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.errors import InputError
from fingerspice.base.pages import Page, Shown
from fingerspice.circuit.arguments import Parameters, Sources, overridden
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.response import linear_scene
from fingerspice.results.phasor_solution import PhasorSolution
from fingerspice.results.solution import Solution
from fingerspice.results.summary import Value
from fingerspice.studies.phasors import phasor
from fingerspice.studies.steady import steady_state

if TYPE_CHECKING:
    from fingerspice.plots.drawing import Picture


@dataclass(frozen=True)
class Figures:
    """Gap voltage at the fundamental, mean force and mean area from one method.

    Each is a number, or an array (n_gap,) if the circuit has several GAPs.
    """

    amplitude: float | NDArray[np.float64]  # V
    phase_deg: float | NDArray[np.float64]  # Lead over the source's fundamental, degrees
    f_el_mean: float | NDArray[np.float64]  # N
    area_mean: float | NDArray[np.float64]  # m^2

    def of_gap(self, i: int) -> dict[str, float]:
        """The figures of one GAP by their names."""
        return {name: float(np.atleast_1d(value)[i]) for name, value in vars(self).items()}


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """The same scene solved by three methods.

    Attributes
    ----------
    phasor : Figures
        Eqs. 9 to 15, with every area coupled through its mean stress.
    mean : Figures
        Transient with the phasor's constant areas; its difference from `phasor` is due to the source's harmonics.
    coupled : Figures
        Transient with the areas coupled at every instant; its difference from `mean` is due to the areas' ripple.
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
        """Picture of one period of the transient and of the phasor, with the figures of both."""
        from fingerspice.studies.reports import plot_comparison

        return plot_comparison(self)

    def rows(self) -> list[tuple[str, str, float, float, float, float, float]]:
        """Rows of quantity, unit, phasor, transient at mean area, coupled, coupled - phasor, coupled - mean area.

        If the circuit has several GAPs, the quantity is ``name:gap``.
        """
        out = []
        for i, gap in enumerate(self.gaps):
            for name, unit, factor in (
                ("amplitude", "V", 1.0),
                ("phase_deg", "deg", 1.0),
                ("f_el_mean", "N", 1.0),
                ("area_mean", "mm^2", 1e6),
            ):
                p, m, c = (factor * f.of_gap(i)[name] for f in (self.phasor, self.mean, self.coupled))
                out.append((name if len(self.gaps) == 1 else f"{name}:{gap}", unit, p, m, c, c - p, c - m))
        return out

    @property
    def gaps(self) -> tuple[str, ...]:
        """Names of the GAPs."""
        return self.solution.gaps

    def to_dict(self) -> dict[str, Any]:
        """The figures as plain data, in SI units."""

        def plain(figures: Figures) -> dict[str, Any]:
            return {name: np.asarray(value).tolist() for name, value in vars(figures).items()}

        return {
            "frequency": self.frequency,
            "gaps": list(self.gaps),
            "phasor": plain(self.phasor),
            "transient_mean_area": plain(self.mean),
            "transient_coupled": plain(self.coupled),
        }


def compare(
    circuit: Circuit,
    *,
    sources: Sources | None = None,
    parameters: Parameters | None = None,
    charge_law: str | None = None,
    rtol: float = 1e-8,
) -> Comparison:
    """Compare the periodic state of the transient with the phasor.

    Parameters
    ----------
    circuit : Circuit
        A circuit with at least one GAP and one periodic source with a fundamental; a stack may have several sources.
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
        If the circuit has no GAP, a network has several sources, or the source has no period or fundamental.
    SolveError
        If a transient fails.
    """
    circuit = overridden(circuit, sources, parameters)
    names = [e.name for e in circuit.by_device("GAP")]
    fundamental = linear_scene(circuit, next(iter(names), None)).fundamental
    if fundamental is None:
        raise InputError("compare needs a source with a fundamental: a periodic one; this source has none")
    phasors = {name: phasor(circuit, finger=name) for name in names}
    coupled = steady_state(circuit, charge_law=charge_law, rtol=rtol, points=2000).solution
    mean = steady_state(circuit, charge_law=charge_law, area="mean", rtol=rtol, points=2000).solution
    return Comparison(
        _phasor_figures([phasors[name] for name in coupled.gaps]),
        _figures(mean, fundamental.phase),
        _figures(coupled, fundamental.phase),
        fundamental.frequency,
        coupled,
    )


def _phasor_figures(found: list[PhasorSolution]) -> Figures:
    """Figures from the phasors of every GAP."""
    amplitude = [float(abs(p.u_gap[0])) for p in found]
    lead = [float(np.degrees(np.angle(p.gain[0]))) for p in found]
    return _together(amplitude, lead, [float(p.f_el_mean[0]) for p in found], [float(p.area[0]) for p in found])


def _figures(solution: Solution, phase: float) -> Figures:
    """Figures of a period of the transient; `phase` (rad) is that of the source's fundamental."""
    found = solution._figures
    lead = np.asarray(solution.u_gap_phase_deg, float) - np.degrees(phase)
    return _together(
        solution.u_gap_amplitude,
        (lead + 180.0) % 360.0 - 180.0,
        solution.f_el_mean_periodic,
        found.value("area", "mean_periodic"),
    )


def _together(*values: Value | list[float]) -> Figures:
    """Figures as arrays over the GAPs, or as numbers if there is one GAP."""
    arrays = [np.atleast_1d(np.asarray(value, float)) for value in values]
    return Figures(*(float(x[0]) if x.size == 1 else x for x in arrays))
