"""Capability of a screen: the mean and the modulation of the friction that a largest source voltage allows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, positive_number, positive_row, whole_number
from fingerspice.base.errors import InputError
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.arguments import require_circuit
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import heading
from fingerspice.plots.drawing import BLUE, caption, dress, engineering, new_figure
from fingerspice.solve.runs import Progress
from fingerspice.studies.design.finger import Finger, Inverter, Voltages, force_curve, the_finger
from fingerspice.studies.design.inverse import Task
from fingerspice.waveforms.samples import Samples

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture

# Samples per period of the modulation and of the carrier, and the lowest sample rate, Hz.
_PER_PERIOD, _PER_CARRIER, _LEAST_RATE = 64, 32, 8000.0
# Duration of a force: this many periods of the modulation, and at least this many seconds.
_PERIODS, _LASTS = 3.0, 0.05
# Relative accuracy of the amplitudes of a stack, and of the voltage of another network, whose drives are corrected this
# many times at most.
_EXACT = 1e-3
_MOST = 8


@dataclass(frozen=True, repr=False)
class Capability(Shown):
    """Largest amplitudes of the friction that a voltage allows.

    The friction is mean + amplitude sin(2 pi f t), produced by the inverse drive from an uncharged circuit for 3
    periods, and at least 50 ms, with ``|U| <= limit`` all the time; the amplitude is at most the mean less the friction
    at 0 V. In a network other than a series stack the force first rises for 2 ms, as in `inverse_drive`.

    Attributes
    ----------
    circuit : Circuit
    limit : float
        V.
    carrier : float or None
        Frequency of the carrier, Hz.
    frequency : ndarray, shape (n_f,)
        Frequency of the modulation, Hz.
    mean : ndarray, shape (n_m,)
        Mean friction, N.
    amplitude : ndarray, shape (n_m, n_f)
        Largest amplitude of the friction, N.
    smallest_mean, largest_mean : float
        Smallest and largest constant friction, N.
    """

    circuit: Circuit
    limit: float
    carrier: float | None
    frequency: FloatArray
    mean: FloatArray
    amplitude: FloatArray
    smallest_mean: float
    largest_mean: float

    @property
    def largest(self) -> FloatArray:
        """Largest amplitude at each frequency, over all means, N, shape (n_f,)."""
        return np.asarray(self.amplitude.max(axis=0))

    @property
    def best_mean(self) -> FloatArray:
        """Mean friction at which the amplitude is largest, N, shape (n_f,)."""
        return np.asarray(self.mean[self.amplitude.argmax(axis=0)])

    def to_dict(self) -> dict[str, Any]:
        """Plain data, SI units."""
        names = ("limit", "carrier", "frequency", "mean", "amplitude", "largest", "best_mean", "smallest_mean")
        return {name: np.asarray(getattr(self, name)).tolist() for name in (*names, "largest_mean")}

    def _page(self) -> Page:
        wave = "without a carrier" if self.carrier is None else f"on a carrier of {format_si(self.carrier, 'Hz')}"
        rows = [
            (format_si(f, "Hz"), format_si(a, "N"), format_si(m, "N"))
            for f, a, m in zip(*(x.tolist() for x in (self.frequency, self.largest, self.best_mean)), strict=True)
        ]
        said = (
            f"up to {format_si(self.limit, 'V')} {wave} the friction's mean is from "
            f"{format_si(self.smallest_mean, 'N')} to {format_si(self.largest_mean, 'N')}"
        )
        return Page([heading(self.circuit), said, "", Table(("modulation", "largest amplitude", "at mean"), rows)])

    def plot(self) -> Picture:
        """Picture with a map of the amplitude over frequency and mean, and the largest amplitude over frequency."""
        figure, (left, right) = new_figure(1, 2, height=3.4, width_ratios=(1.25, 1))
        factor, unit = engineering(self.largest_mean, "N")
        f, amplitude = self.frequency, factor * self.amplitude
        if f.size == 1:
            # A map needs two frequencies: a single one is drawn as a band around it, with room for the axis to be read.
            f, amplitude = np.append(0.1 * f, 10.0 * f), np.repeat(amplitude, 2, axis=1)
        mesh = left.contourf(f, factor * self.mean, amplitude, levels=12, cmap="viridis")
        bar = figure.colorbar(mesh, ax=left, pad=0.02)
        bar.set_label(f"Largest amplitude [{unit}]", fontsize=8)
        bar.ax.tick_params(labelsize=8)
        right.plot(self.frequency, factor * self.largest, color=BLUE, marker="o", markersize=3)
        right.set_ylim(bottom=0.0)
        for ax, label in ((left, f"Mean friction [{unit}]"), (right, f"Largest amplitude, best mean [{unit}]")):
            ax.set_xscale("log")
            dress(ax, label, "Modulation frequency [Hz]")
        wave = "unipolar drive" if self.carrier is None else f"carrier {format_si(self.carrier, 'Hz')}"
        caption(
            figure,
            f"{heading(self.circuit)} · at most {format_si(self.limit, 'V')}, {wave} · mean friction "
            f"{format_si(self.smallest_mean, 'N')} to {format_si(self.largest_mean, 'N')}",
        )
        return figure

    def to_csv(self, path: str | Path) -> Path:
        """Write the map as CSV: one row for each frequency and mean."""
        mean, f = np.meshgrid(self.mean, self.frequency, indexing="ij")
        header = "frequency (Hz)", "mean friction (N)", "largest amplitude (N)"
        return write_csv(path, header, zip(f.ravel(), mean.ravel(), self.amplitude.ravel(), strict=True))


def capability(
    circuit: Circuit,
    limit: float,
    *,
    carrier: float | None = None,
    frequency: ArrayLike | None = None,
    means: int = 13,
    charge_law: str | None = None,
    progress: Progress | None = None,
) -> Capability:
    """Map the friction that a screen can produce with a source of at most `limit` (V).

    Parameters
    ----------
    circuit : Circuit
        A circuit with one GAP and one V source. A series stack takes seconds, and another network up to minutes,
        because its drives are corrected by forward runs.
    limit : float
        Largest voltage of the source, V.
    carrier : float, optional
        Hz; without it the drive is unipolar.
    frequency : array_like, optional
        Frequencies of the modulation, Hz; by default 13 from 5 Hz to 1 kHz, or to an eighth of a carrier below 8 kHz.
    means : int
        Number of mean frictions, from the smallest to the largest, 3 or more.
    charge_law : str, optional
        As in `simulate`.
    progress : callable, optional
        Called with the fraction done.

    Raises
    ------
    InputError
        If the circuit is not such a one, if its source does not drive the gap, or if a number is out of range.
    SolveError
        If a forward run fails.
    """
    require_circuit(circuit)
    limit, means = positive_number("limit", limit, "V"), whole_number("means", means, 3, 1000)
    carrier = None if carrier is None else positive_number("carrier", carrier, "Hz")
    top = 1000.0 if carrier is None else min(1000.0, carrier / 8.0)
    own = np.geomspace(min(5.0, 0.1 * top), top, 13)
    f = positive_row("frequency", own if frequency is None else frequency, "Hz")
    if carrier is not None and f.max() > carrier / 4.0:
        raise InputError(
            f"frequency reaches {f.max():g} Hz; allowed: at most a quarter of the carrier's {carrier:g} Hz"
        )
    finger = the_finger(circuit, charge_law)
    contact = finger.contact
    if contact.mu == 0.0:
        raise InputError(f"{finger.gap.name} has mu=0 and no friction; allowed: mu > 0")
    # The charges in the layers can raise the gap voltage above the source voltage, but not to ten times the limit.
    area = float(contact.area(10.0 * limit)) if finger.area is None else finger.area
    most = 0.4 * float(contact.stress(10.0 * limit)) * area
    voltages = force_curve(finger, None if carrier is None else float(_PER_CARRIER), most)
    search = _Search(finger, voltages, finger.inverter(10.0 * limit), limit, carrier)
    largest = search.largest(lambda x: search.wanted(x, 1.0 / _LASTS, 0.0), most)
    force = np.linspace(0.0, largest, means)
    amplitude = np.zeros((means, f.size))
    for i, mean in enumerate(force[1:-1].tolist(), 1):
        amplitude[i] = [search.largest(partial(search.wanted, mean, x), mean) for x in f.tolist()]
        if progress is not None:
            progress(i / (means - 2))
    friction = contact.mu * (contact.f_n + force)
    return Capability(
        circuit, limit, carrier, f, friction, contact.mu * amplitude, float(friction[0]), float(friction[-1])
    )


@dataclass
class _Search:
    """Search for the largest forces whose inverse drive stays within the voltage limit.

    For a series stack the inverter's drive is exact. For another network it is that of the linear response, whose peak
    is off by `ratio`: this changes little from a force to the next, so that few drives have to be corrected by forward
    runs.
    """

    finger: Finger
    voltages: Voltages
    inverter: Inverter
    limit: float  # V
    carrier: float | None  # Hz
    ratio: float = 1.0

    def wanted(self, mean: float, frequency: float, amplitude: float) -> Samples:
        """A mean force (N) with a modulation (Hz, N), sampled at the rate of the drive."""
        rate = max(_PER_PERIOD * frequency, _LEAST_RATE) if self.carrier is None else _PER_CARRIER * self.carrier
        t = np.arange(math.ceil(max(_PERIODS / frequency, _LASTS) * rate)) / rate
        return Samples(np.maximum(mean + amplitude * np.sin(2.0 * np.pi * frequency * t), 0.0), rate)

    def largest(self, wanted: Callable[[float], Samples], most: float) -> float:
        """Largest number up to `most` (N) for which the drive of the wanted force stays within the limit.

        By bisection, to `_EXACT` times itself or 1e-3 `_EXACT` times `most`.
        """
        for _ in range(_MOST):
            found, high = 0.0, most
            if self.ratio * self._peak(wanted(most)) <= self.limit:
                found = most
            while high - found > _EXACT * max(found, 1e-3 * most):
                middle = 0.5 * (found + high)
                within = self.ratio * self._peak(wanted(middle)) <= self.limit
                found, high = (middle, high) if within else (found, middle)
            if self.finger.network.stack is not None or found == 0.0:
                break
            force = wanted(found)
            end = (force.values.size - 1) / force.rate
            task = Task(self.finger, "force", force, end, force.rate, self.carrier, self.finger.lead)
            peak = task.solve(close=0.3 * _EXACT).peak
            before, self.ratio = self.ratio, peak / self._peak(force)
            if abs(self.ratio / before - 1.0) < 0.5 * _EXACT or (found == most and peak <= self.limit):
                break
        return found

    def _peak(self, force: Samples) -> float:
        """Largest voltage (V) of the inverter's drive for a force."""
        u = self.voltages(force.values, force.rate, self.carrier, round(self.finger.lead * force.rate))
        return float(np.abs(self.inverter(u, 1.0 / force.rate, math.inf, math.inf)[0]).max())
