"""The drive that `inverse_drive` has found: its figures, page, picture and files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.files import write_aside, write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import head_lines, heading
from fingerspice.plots import drawing
from fingerspice.results.signals import Sealed
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture

_FULL = 2.0**31


@dataclass(frozen=True, repr=False)
class InverseDrive(Sealed, Shown):
    """A drive, the force and friction wanted from it, and those that a forward run gives.

    Attributes
    ----------
    circuit : Circuit
        The circuit with the drive as its source.
    drive : Samples
        Voltage of the source, V.
    times : ndarray, shape (n,)
        Times at which wanted and reached values are compared, s: the samples, or the middles of the carrier's periods.
    wanted, force : ndarray, shape (n,)
        Wanted electroadhesive force, and that of the forward run, N; with a carrier the means over its periods.
    wanted_friction, friction : ndarray, shape (n,)
        Wanted friction F_T = mu (F_N + F_el), and that of the forward run, N.
    kind : str
        The quantity asked for, ``"force"`` or ``"friction"``.
    carrier : float or None
        Frequency of the carrier, Hz.
    limit, slew : float
        Largest voltage (V) and slew rate (V/s) of the source; inf for no limit.
    lead : float
        Time in which the drive rises to the first wanted value, s; it is left out of the comparison.
    at_limit : float
        Fraction of the samples at which a limit holds the drive.
    corrections : int
        Number of forward runs after the first.
    """

    circuit: Circuit
    drive: Samples
    times: FloatArray
    wanted: FloatArray
    force: FloatArray
    wanted_friction: FloatArray
    friction: FloatArray
    kind: str
    carrier: float | None
    limit: float
    slew: float
    lead: float
    at_limit: float
    corrections: int

    @property
    def _asked(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The quantity asked for, as wanted and as reached, and the difference, N."""
        force = self.kind == "force"
        wanted, reached = (self.wanted, self.force) if force else (self.wanted_friction, self.friction)
        return wanted, reached, reached - wanted

    @property
    def worst(self) -> float:
        """Largest difference between reached and wanted force or friction, N."""
        return float(np.abs(self._asked[2]).max())

    @property
    def rms(self) -> float:
        """Root mean square of the difference between reached and wanted force or friction, N."""
        return float(np.sqrt(np.mean(self._asked[2] ** 2)))

    @property
    def worst_share(self) -> float:
        """`worst` relative to the largest wanted value."""
        return self.worst / (float(self._asked[0].max()) or math.inf)

    @property
    def rms_share(self) -> float:
        """`rms` relative to the largest wanted value."""
        return self.rms / (float(self._asked[0].max()) or math.inf)

    @property
    def peak(self) -> float:
        """Largest voltage of the drive, V."""
        return float(np.abs(self.drive.values).max())

    def to_dict(self) -> dict[str, Any]:
        """The figures as plain data, in SI units."""
        wanted, reached, _ = self._asked
        figures = ["carrier", "limit", "slew", "lead", "peak", "at_limit", "worst", "rms", "worst_share", "rms_share"]
        return {
            "kind": self.kind, "rate": self.drive.rate, "samples": self.drive.values.size,
            **{name: getattr(self, name) for name in figures}, "largest_wanted": float(wanted.max()),
            "largest_reached": float(reached.max()), "corrections": self.corrections,
        }  # fmt: skip

    def _page(self) -> Page:
        wanted, reached, _ = self._asked
        wave = "without a carrier" if self.carrier is None else f"on a carrier of {format_si(self.carrier, 'Hz')}"
        rows = [
            ("peak of the drive", format_si(self.peak, "V")),
            ("samples", f"{self.drive.values.size:,} at {format_si(self.drive.rate, 'Hz')}"),
            (f"largest {self.kind} wanted", format_si(float(wanted.max()), "N")),
            (f"largest {self.kind} reached", format_si(float(reached.max()), "N")),
            ("worst miss", f"{format_si(self.worst, 'N')}, {100.0 * self.worst_share:.2g} %"),
            ("rms miss", f"{format_si(self.rms, 'N')}, {100.0 * self.rms_share:.2g} %"),
            ("time at a limit", f"{100.0 * self.at_limit:.3g} %"),
        ]
        if self.lead > 0.0:
            rows.append(("rise before it", format_si(self.lead, "s")))
        said = f"drive for a wanted {self.kind}, {wave}: {self._verdict()}"
        return Page([*head_lines(self.circuit), said, "", Table(("", ""), rows)])

    def _verdict(self) -> str:
        if self.at_limit == 0.0:
            return f"met to {100.0 * self.worst_share:.2g} % of its largest value"
        limits = [format_si(x, unit) for x, unit in ((self.limit, "V"), (self.slew, "V/s")) if math.isfinite(x)]
        worst, rms = format_si(self.worst, "N"), format_si(self.rms, "N")
        return f"the limits ({', '.join(limits)}) cost {worst} at worst, {rms} rms"

    def plot(self) -> Picture:
        """Picture of the wanted and the reached quantity, their difference, and the drive, against time."""
        figure, (top, middle, bottom) = drawing.new_figure(3, height=5.2, sharex=True, height_ratios=(3, 1.4, 2))
        wanted, reached, miss = self._asked
        volts = self.drive.values
        at = np.arange(volts.size) / self.drive.rate
        scale, unit = drawing.engineering(float(at[-1]), "s")
        force, newton = drawing.engineering(float(wanted.max(initial=0.0)) or 1.0, "N")
        small, milli = drawing.engineering(max(self.worst, 1e-12), "N")
        dashes, t = (0, (4, 1.5)), scale * self.times
        top.plot(*drawing.thin(t, force * wanted), color=drawing.BLACK, linewidth=2.2, label="wanted")
        top.plot(*drawing.thin(t, force * reached), color=drawing.ORANGE, linewidth=1.2, ls=dashes, label="reached")
        middle.plot(*drawing.thin(t, small * miss), color=drawing.VERMILION, linewidth=1.0)
        bottom.plot(*drawing.thin(scale * at, volts), color=drawing.BLUE, linewidth=0.9)
        drawing.dress(top, f"{self.kind.capitalize()} [{newton}]")
        drawing.legend_above(top, 2)
        drawing.dress(middle, f"Miss [{milli}]")
        drawing.dress(bottom, "Drive [V]", f"Time [{unit}]")
        limit = ""
        if math.isfinite(self.limit):
            limit = "; dashed: limit"
            for level in {math.copysign(self.limit, side) for side in (volts.min(), volts.max())}:
                bottom.axhline(level, color=drawing.GREY, linewidth=0.9, linestyle="--")
        mean = "" if self.carrier is None else f" · means over periods of the carrier, {format_si(self.carrier, 'Hz')}"
        drawing.caption(figure, f"{heading(self.circuit)} · {self._verdict()}{mean}{limit}")
        return figure

    def to_wav(self, path: str | Path, gain: float | None = None) -> Path:
        """Write the drive as a WAV file of 32-bit integers.

        Parameters
        ----------
        path : str or Path
        gain : float, optional
            V at full scale; the drive's own peak by default. ``WAV(path gain=...)`` reads it back.

        Raises
        ------
        InputError
            If the rate is not a whole number of Hz, the gain is below the peak, or the path cannot be written.
        """
        from scipy.io import wavfile

        rate, peak = self.drive.rate, self.peak
        if abs(rate - round(rate)) > 1e-9 * rate or not 1.0 <= rate < 2**32:
            raise InputError(f"a WAV file has a whole number of samples a second, and the drive has {rate:g}; allowed: "
                             "rate= a whole number of Hz")  # fmt: skip
        full = (peak or 1.0) if gain is None else gain
        require(full >= peak, "gain", f"{full:g} V at full scale", f"the drive's peak, {peak:.6g} V, or more")
        data = np.clip(np.rint(_FULL / full * self.drive.values), -_FULL, _FULL - 1.0).astype("<i4")

        def write(target: Path) -> None:
            with target.open("wb") as stream:
                wavfile.write(stream, round(rate), data)

        return write_aside(Path(path), write)

    def to_csv(self, path: str | Path) -> Path:
        """Write the drive as CSV: time (s) and voltage (V)."""
        t = np.arange(self.drive.values.size) / self.drive.rate
        return write_csv(path, ("time (s)", "drive (V)"), zip(t, self.drive.values, strict=True))

    def friction_to_csv(self, path: str | Path) -> Path:
        """Write wanted and predicted force and friction as CSV."""
        names = ("time (s)", "wanted force (N)", "force (N)", "wanted friction (N)", "friction (N)")
        columns = self.times, self.wanted, self.force, self.wanted_friction, self.friction
        return write_csv(path, names, zip(*columns, strict=True))
