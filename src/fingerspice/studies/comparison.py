"""The periodic state beside the phasor: what the area's ripple adds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.errors import InputError
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import Parameters, Sources, head_lines, overridden
from fingerspice.circuit.network import linear_scene
from fingerspice.plots import drawing, traces
from fingerspice.results.solution import Solution
from fingerspice.studies.steady import phasor, steady_state

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fingerspice.plots.picture import Picture


@dataclass(frozen=True)
class Figures:
    """Gap voltage at the fundamental, mean force and mean area from one method; arrays (n_gap,) of several GAPs."""

    amplitude: float | NDArray[np.float64]  # V
    phase_deg: float | NDArray[np.float64]  # Lead over the source's fundamental, degrees
    f_el_mean: float | NDArray[np.float64]  # N
    area_mean: float | NDArray[np.float64]  # m^2

    def of_gap(self, i: int) -> dict[str, float]:
        """The figures of one GAP by their names."""
        return {name: float(np.atleast_1d(value)[i]) for name, value in vars(self).items()}


# Of every figure: its unit in tables, the factor from SI to that unit, and its name on the page and in the picture.
_FIGURES = {
    "amplitude": ("V", 1.0, "gap voltage amplitude", "Gap voltage at the fundamental"),
    "phase_deg": ("deg", 1.0, "lead over the source", "Its lead over the source"),
    "f_el_mean": ("N", 1.0, "mean force", "Mean electroadhesive force"),
    "area_mean": ("mm^2", 1e6, "mean area", "Mean ridge area"),
}


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
        rows = [(f"{label} [{unit}]", *(f"{x:.6g}" for x in numbers)) for label, unit, numbers in self._labelled(2)]
        head = ("", "phasor", "transient, mean area", "transient, coupled", "coupled - phasor", "of it, ripple")
        state = f"periodic state at {format_si(self.frequency, 'Hz')}, charge law {self.solution.charge_law}"
        page: list[str | Table] = [*head_lines(self.solution.circuit), state, "", Table(head, rows), ""]
        for i, gap in enumerate(self.gaps):
            reference, mean, coupled = (f.of_gap(i)["f_el_mean"] for f in (self.phasor, self.mean, self.coupled))
            # Round before formatting, and add 0.0, so that -0.00 is not printed.
            total, waveform = (round(100.0 * (x / reference - 1.0), 2) + 0.0 for x in (coupled, mean))
            page.append(
                f"mean force{f' of {gap}' if len(self.gaps) > 1 else ''}: {total:+.2f} % against the phasor; "
                f"{total - waveform:+.2f} % of that is the ripple of the area, {waveform:+.2f} % is the waveform's "
                "(zero for a sine)"
            )
        return Page(page)

    def plot(self) -> Picture:
        """Picture of one period of the transient and of the phasor, with the figures of both."""
        # The table has four rows for each GAP.
        more = 0.53 * (len(self.gaps) - 1)
        figure, axes = drawing.new_figure(3, height=5.6 + 1.67 * more, height_ratios=[1.3, 1.3, 0.75 + more])
        solution, runs = self.solution, [(self.solution, "")]
        start, stop = float(solution.t[0]), float(solution.t[-1])
        turns = 2.0 * np.pi * self.frequency * solution.t
        turns += solution.fundamental.phase if solution.fundamental else 0.0
        t = traces.time_unit(runs)[0] * solution.t
        style: dict[str, Any] = {"color": drawing.BLACK, "linestyle": drawing.DASHES[3], "linewidth": 1.5}
        for ax, keys in zip(axes, (["u_source", "u_gap"], ["f_el"]), strict=False):
            drawn, factor, unit = traces.draw_panel(ax, runs, keys, start, stop)
            for i, trace in enumerate(drawn[-len(self.gaps) :]):
                p = self.phasor.of_gap(i)
                wave = np.sin(turns + np.radians(p["phase_deg"]))
                curve = 2.0 * p["f_el_mean"] * wave**2 if keys == ["f_el"] else p["amplitude"] * wave
                ax.plot(t, factor * curve, label=f"{trace.label}, phasor", **style)
            traces.finish_panel(ax, keys, drawn, factor, unit)
        traces.time_axis(axes[:2], runs, start, stop)
        self._draw_table(axes[2])
        drawing.caption(figure, f"{traces.about_all(runs)} · periodic state; the phasor is of the fundamental alone")
        figure.align_ylabels(axes[:2])
        return figure

    def _draw_table(self, ax: Axes) -> None:
        split = "transient,\nmean area", "transient,\ncoupled", "coupled −\nphasor", "of it, ripple\nof the area"
        cells = [["", "phasor", *split]]
        for label, unit, numbers in self._labelled(3):
            texts = [*(f"{x:.5g}" for x in numbers[:3]), *(f"{x:+.2g}" for x in numbers[3:])]
            marks = unit.replace("deg", "°").replace("^2", "²")
            cells.append([f"{label} [{marks}]", *(text.replace("-", "−") for text in texts)])
        ax.axis("off")
        # Names of GAPs need more room.
        first, size = (0.36, drawing.FONT - 0.5) if len(self.gaps) == 1 else (0.42, drawing.SMALL)
        widths = [first, *[0.2 * (1.0 - first)] * 5]
        table = ax.table(cells, cellLoc="right", loc="center", edges="horizontal", colWidths=widths)
        table.auto_set_font_size(False)
        table.set_fontsize(size)
        for (row, column), cell in table.get_celld().items():
            cell.set(edgecolor="#BBBBBB", linewidth=0.6)
            if row == 0:
                cell.set_height(1.7 * cell.get_height())
            if column == 0:
                cell.get_text().set_horizontalalignment("left")
                cell.PAD = 0.0

    def rows(self) -> list[tuple[str, str, float, float, float, float, float]]:
        """Rows of quantity, unit, phasor, transient at mean area, coupled, coupled - phasor, coupled - mean area.

        If the circuit has several GAPs, the quantity is ``name:gap``.
        """
        out = []
        for i, gap in enumerate(self.gaps):
            for name, (unit, factor, *_) in _FIGURES.items():
                p, m, c = (factor * f.of_gap(i)[name] for f in (self.phasor, self.mean, self.coupled))
                out.append((name if len(self.gaps) == 1 else f"{name}:{gap}", unit, p, m, c, c - p, c - m))
        return out

    def _labelled(self, place: int) -> Iterator[tuple[str, str, list[float]]]:
        """Rows with the names at this place of `_FIGURES`."""
        for what, unit, *numbers in self.rows():
            name, _, gap = what.partition(":")
            yield f"{_FIGURES[name][place]} {gap}".rstrip(), unit, numbers

    @property
    def gaps(self) -> tuple[str, ...]:
        """Names of the GAPs."""
        return self.solution.gaps

    def to_dict(self) -> dict[str, Any]:
        """The figures as plain data, in SI units."""
        parts = {"phasor": self.phasor, "transient_mean_area": self.mean, "transient_coupled": self.coupled}
        plain = {key: {name: np.asarray(x).tolist() for name, x in vars(part).items()} for key, part in parts.items()}
        return {"frequency": self.frequency, "gaps": list(self.gaps), **plain}


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
    fundamental = linear_scene(circuit, next(iter(names), None)).network.waveforms[0].fundamental
    if fundamental is None:
        raise InputError("compare needs a source with a fundamental: a periodic one; this source has none")
    phasors = {name: phasor(circuit, finger=name) for name in names}
    coupled, mean = (
        steady_state(circuit, charge_law=charge_law, area=area, rtol=rtol, points=2000).solution
        for area in ("coupled", "mean")
    )
    found = [phasors[name] for name in coupled.gaps]
    figures = [(abs(p.u_gap[0]), np.degrees(np.angle(p.gain[0])), p.f_el_mean[0], p.area[0]) for p in found]
    ways: list[Any] = [np.array(figures).T]
    for one in (mean, coupled):
        lead = np.asarray(one.u_gap_phase_deg, float) - np.degrees(fundamental.phase)
        area = one._figures.value("area", "mean_periodic")
        every = one.u_gap_amplitude, (lead + 180.0) % 360.0 - 180.0, one.f_el_mean_periodic, area
        ways.append(np.array(every, float).reshape(len(every), -1))
    of_phasor, of_mean, of_coupled = (Figures(*(way[:, 0].tolist() if len(found) == 1 else way)) for way in ways)
    return Comparison(of_phasor, of_mean, of_coupled, fundamental.frequency, coupled)
