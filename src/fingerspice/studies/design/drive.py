"""The finger of an inverse drive: the gap voltage for a force wanted there, and the source voltage for that.

The drive that `inverse_drive` has found: its figures, page, picture and files.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import BoolArray, ComplexArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.files import write_aside, write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit, Element
from fingerspice.circuit.describe import head_lines, heading
from fingerspice.circuit.network import Network, network_of
from fingerspice.circuit.statespace import find_branches
from fingerspice.engine.inverse import drive_stack, hold
from fingerspice.physics.contact import Contact, fixed_area_curve
from fingerspice.plots import drawing
from fingerspice.results.record import Sealed
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture


#: Source voltages for gap voltages u (V, shape (n,), positive in the direction of the source) at intervals h (s), and
#: the samples at a limit: of `inverter(u, h, largest voltage (V), largest slew rate (V/s))`.
Inverter = Callable[[FloatArray, float, float, float], tuple[FloatArray, BoolArray]]
#: Gap voltages (V) at a rate (Hz) that rise in some steps, and then produce forces (N), on a carrier (Hz) if one is
#: given: of `voltages(forces, rate, carrier, steps)`.
Voltages = Callable[[FloatArray, float, float | None, int], FloatArray]

# Default time in which the force rises to its first value, for networks other than a series stack, s.
_LEAD = 2e-3
# Over the length of the Fourier transform a signal is damped by exp(-_DAMPING), so that its end does not wrap round to
# its beginning. The signal fills at most half of that length, so undoing the damping amplifies round-off by the square
# root of that factor.
_DAMPING = 14.0
# Smallest response of the gap voltage to the source, relative to the largest over all frequencies; a smaller response
# counts as none.
_DEAF = 1e-9
# Number of amplitudes of the carrier between which the mean force is interpolated.
_GRID = 80


@dataclass(frozen=True)
class Finger:
    """The one finger of a circuit with one source, under a charge law."""

    circuit: Circuit
    law: str
    gap: Element
    source: Element
    contact: Contact
    area: float | None  # Area fixed by the deck, m^2, or None
    network: Network

    @property
    def lead(self) -> float:
        """Default time in which the force rises, s: none for a stack, whose gap voltage jumps with the source."""
        return _LEAD if self.network.stack is None else 0.0

    @property
    def sign(self) -> float:
        """Sign of the GAP's voltage, from p to n, relative to the voltage along the source."""
        stack = self.network.stack
        if stack is None or stack.gap is None:
            return 1.0
        return float(stack.sign[stack.gap]) * stack.sources[0][1]

    def inverter(self, u_max: float) -> Inverter:
        """What computes the source voltage for gap voltages up to `u_max` (V).

        A stack is inverted step by step; while a limit holds the source, its layers' state follows from the source.
        """
        stack = self.network.stack
        if stack is None:
            wish = _linear_inverse(self.network)
        else:
            assert stack.contact is not None
            assert stack.gap is not None
            gap, area = stack.gap, stack.area_given
            curve = stack.contact.curve(1.2 * max(u_max, 1.0)) if area is None else fixed_area_curve(area)
            cells = np.column_stack([stack.c, stack.g_total, stack.g_area])

        def drive(u: FloatArray, h: float, limit: float, slew: float) -> tuple[FloatArray, BoolArray]:
            out, held = np.empty(u.size), np.empty(u.size, np.bool_)
            if stack is None:
                hold(wish(u, h), limit, slew * h, out, held)
            else:
                drive_stack(u, h, curve, cells, gap, self.law == "mobile", limit, slew * h, out, held)
            return out, held

        return drive


def the_finger(circuit: Circuit, charge_law: str | None) -> Finger:
    """The finger and the source of a circuit that has one of each; others, and a delayed area, are refused."""
    law = charge_law or circuit.charge_law or "local"
    require(law in CHARGE_LAWS, "charge_law", repr(law), " or ".join(map(repr, CHARGE_LAWS)))
    gaps = circuit.by_device("GAP")
    if len(gaps) != 1:
        found = ", ".join(g.name for g in gaps) or "none"
        raise InputError(f"an inverse drive is that of one finger; this circuit has the GAPs {found}; allowed: one GAP")
    sources = [e for e in find_branches(circuit)[1] if e.device in "VI"]
    if len(sources) != 1 or sources[0].device != "V":
        found = ", ".join(e.name for e in sources) or "none"
        raise InputError(f"an inverse drive is that of one V source; this circuit has {found}; allowed: one V element")
    tau = gaps[0].values["tau"]
    if tau > 0.0:
        raise InputError(f"{gaps[0].name} has tau={tau:g} s: its area follows with a delay; allowed here: tau=0")
    network = network_of(circuit)
    (place,) = network.fingers
    contact = network.contacts[place]
    assert contact is not None
    return Finger(circuit, law, gaps[0], sources[0], contact, network.areas[place].given, network)


def _linear_inverse(net: Network) -> Callable[[FloatArray, float], FloatArray]:
    """Inverts the linear response of a network at its areas at rest: source voltages from gap voltages and interval.

    The signals are damped by exp(-a t), which evaluates the response at s = a + i omega. There it has no zero (a
    floating body passes no direct voltage, a zero at s = 0), and the end of the signal does not wrap round.
    """
    from scipy.fft import irfft, next_fast_len, rfft

    areas = net.areas_at_rest
    leak, c = net.leak(areas), net.capacitance(areas)
    gap = next(g for g in net.gaps if g is not None)

    # It takes longer than the transforms, and is asked for again and again for drives of one length.
    @lru_cache(maxsize=1)
    def response(m: int, h: float) -> ComplexArray:
        s = _DAMPING / (m * h) + 2j * np.pi * np.arange(m // 2 + 1) / (m * h)
        y = leak + s[:, None] * c
        kernel = net.k + np.einsum("ci,fc,cj->fij", net.p, y, net.p, optimize=True)
        right = net.b[:, 0] + np.einsum("ci,fc,c->fi", net.p, y, net.q[:, 0], optimize=True)
        x = np.linalg.solve(kernel, -right[:, :, None])[:, :, 0]
        gain = x @ net.p[gap] + net.q[gap, 0]
        if not np.all(np.abs(gain) > _DEAF * np.abs(gain).max(initial=0.0)):
            raise InputError(
                f"{net.sources[0].name} does not drive the gap at every frequency of the drive; allowed: a source with "
                "a path to the GAP, and a lower rate"
            )
        return np.asarray(gain)

    def wish(u: FloatArray, h: float) -> FloatArray:
        n, m = u.size, next_fast_len(2 * u.size, real=True)
        damp = np.exp(-_DAMPING / (m * h) * h * np.arange(m))
        spectrum = rfft(np.append(u, np.full(m - n, u[-1])) * damp)
        return np.asarray(irfft(spectrum / response(m, h), m)[:n] / damp[:n])

    return wish


def force_curve(finger: Finger, points: float | None, most: float) -> Voltages:
    """What computes gap voltages for forces up to `most` (N), which are means over each period of a carrier.

    `points` is the number of samples in a period of the carrier, between which the voltage is linear, or None without a
    carrier.
    """
    from scipy.interpolate import CubicSpline

    shape, weight = np.ones(1), np.ones(1)
    if points is not None:
        count = round(points) if abs(points - round(points)) < 1e-9 else round(8 * points)
        at = np.sin(2.0 * np.pi * np.arange(count + 1) / points)
        shape = np.abs(np.concatenate([at[:-1], 0.5 * (at[1:] + at[:-1])]))
        # Simpson's rule between samples: the voltage is linear there, so the force is a parabola but for the change of
        # the area.
        weight = np.repeat([1.0 / 3.0, 2.0 / 3.0], count) / count

    def force_at(u: FloatArray) -> FloatArray:
        area = finger.contact.area(u) if finger.area is None else finger.area
        return np.asarray(finger.contact.stress(u) * area)

    def mean(amplitude: FloatArray) -> FloatArray:
        return np.asarray(force_at(amplitude[:, None] * shape) @ weight)

    top = 1.0
    while mean(np.array([top]))[0] < 1.01 * most:
        if top > 1e6:
            raise InputError(
                f"the force wanted, {most:g} N, is reached by no voltage: at 1 MV the gap has "
                f"{float(mean(np.array([1e6]))[0]):.3g} N; allowed: less"
            )
        top *= 1.4
    amplitude = top * np.arange(1, _GRID + 1) / _GRID
    force = mean(amplitude)
    rising = np.concatenate([[True], np.diff(force) > 0.0])
    last = _GRID if rising.all() else int(np.argmin(rising))
    root = np.sqrt(force[:last])
    if root[-1] ** 2 < most:
        raise InputError(f"the force wanted, {most:g} N, is reached by no voltage; allowed: at most "
                         f"{root[-1] ** 2:.3g} N")  # fmt: skip
    # The voltage over the root of the force, which at 0 V is that of a small voltage.
    scale = float(force_at(np.array([1e-3]))[0]) / 1e-3**2
    at_zero = math.sqrt(1.0 / float(weight @ shape**2) / scale)
    spline = CubicSpline(np.append(0.0, root), np.append(at_zero, amplitude[:last] / root))

    def voltages(force: FloatArray, rate: float, carrier: float | None, lead: int) -> FloatArray:
        u = np.sqrt(force) * spline(np.sqrt(force))
        # The rise has zero first and second derivative at both ends.
        x = np.arange(lead) / max(lead, 1)
        u = np.append(u[0] * (x**3 * (10.0 - 15.0 * x + 6.0 * x * x)), u)
        if carrier is not None:
            u *= np.sin(2.0 * np.pi * carrier / rate * (np.arange(u.size) - lead))
        return u

    return voltages


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
