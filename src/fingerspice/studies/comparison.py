"""The periodic state beside the phasor: what the area's ripple adds, and the response to sines of given amplitude."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, positive_row
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.pages import Page, Shown
from fingerspice.circuit.arguments import Parameters, Sources, overridden, require_circuit
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.response import LinearScene, linear_scene
from fingerspice.circuit.usual import beyond_fingers
from fingerspice.results.measures import weigh_outputs
from fingerspice.results.phasor_solution import PhasorSolution
from fingerspice.results.solution import Solution
from fingerspice.results.summary import Value
from fingerspice.solve.runs import Progress
from fingerspice.studies.phasors import Drive, phasor, sweep_drive, sweep_notes
from fingerspice.studies.steady import steady_state
from fingerspice.waveforms.waveform import Sine, Waveform

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture


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


# Number of outputs in a period; cubics through them interpolate a sine with an error of 1e-9 of its amplitude.
POINTS = 400


def large_signal(
    circuit: Circuit,
    frequency: ArrayLike,
    amplitude: ArrayLike | None = None,
    *,
    charge_law: str | None = None,
    rtol: float = 1e-8,
    finger: str | None = None,
    progress: Progress | None = None,
) -> tuple[PhasorSolution, ...]:
    """Periodic states under sines, for each frequency and amplitude; SKIN is evaluated at each frequency.

    Parameters
    ----------
    circuit : Circuit
        A circuit with a GAP and one source.
    frequency : array_like
        Hz, positive.
    amplitude : array_like, optional
        V (A for a current source), positive; by default the amplitude of the source's ``AC``, or without AC that of its
        fundamental.
    charge_law, rtol, progress
        As in `simulate`.
    finger : str, optional
        Name of the GAP whose figures are wanted; needed if the circuit has several.

    Returns
    -------
    tuple of PhasorSolution
        One per amplitude. Gains are those of the fundamental; area and force are means over the period.

    Raises
    ------
    InputError
        If the circuit has no GAP or several sources, if none of several GAPs is named, or if a frequency or amplitude
        is not positive.
    SolveError
        If there is no periodic state.
    """
    require_circuit(circuit)
    scene = linear_scene(circuit, finger)
    if len(scene.sources) != 1:
        names = ", ".join(e.name for e, _ in scene.sources)
        raise InputError(f"a large-signal sweep drives one source, and this circuit has {names}")
    own = sweep_drive(scene.sources, scene.fundamental, swept=True)
    if amplitude is None and math.isnan(own.amplitude):
        raise InputError("the source has no fundamental to take the amplitude of: give the amplitudes in V")
    given = positive_row("amplitude", own.amplitude if amplitude is None else amplitude, "V")
    f = positive_row("frequency", frequency, "Hz")
    for text in sweep_notes(circuit, f)[1]:
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    drives = [own] if amplitude is None else [Drive(float(a), 0.0, "the amplitude given") for a in given]
    found = itertools.count(1)

    def one() -> None:
        if progress is not None:
            progress(next(found) / (f.size * len(drives)))

    return tuple(_sweep(circuit, scene, f, drive, charge_law, rtol, one) for drive in drives)


def _sweep(
    circuit: Circuit, scene: LinearScene, frequency: FloatArray, drive: Drive, charge_law: str | None, rtol: float,
    one: Callable[[], None],
) -> PhasorSolution:  # fmt: skip
    (source, sign), *_ = scene.sources
    name = scene.layers[scene.gap]
    skins = [e.name for e in circuit.by_device("SKIN")]
    gains, areas, forces, amplitude = [], [], [], drive.amplitude
    for f in frequency:
        changes: dict[str, float | Waveform] = {f"{name}.f": float(f) for name in skins}
        changes[source.name] = Sine(amplitude, float(f))
        state = steady_state(
            circuit.varied(changes), charge_law=charge_law, rtol=rtol, points=POINTS, charge=False
        )  # fmt: skip
        s = state.solution
        # The output starts at a multiple of the period, so that phases from its start are phases relative to the
        # source.
        period = s.t - s.t[0]
        area, force = (s.by_name(key)[key if len(s.gaps) == 1 else f"{key}:{name}"] for key in ("area", "f_el"))
        gains.append([weigh_outputs(period, u).phasor(float(f)) * sign / amplitude for u in s.u_layer.T])
        areas.append(weigh_outputs(period, area).mean())
        forces.append(weigh_outputs(period, force).mean())
        one()
    gain = np.array(gains, np.complex128)
    u_gap = gain[:, scene.gap] * amplitude * np.exp(1j * drive.phase)
    notes, warned = sweep_notes(circuit, frequency)
    notes = (*notes, scene.note) if scene.note else notes
    largest = max(forces), float(scene.contact.stress(np.abs(u_gap)).max()), max(areas)
    return PhasorSolution(
        frequency, gain[:, scene.gap], gain, u_gap, np.array(areas), np.array(forces), amplitude, s.layers, drive.phase,
        drive.text, notes, (*warned, *beyond_fingers("", *largest)), circuit,
    )  # fmt: skip
