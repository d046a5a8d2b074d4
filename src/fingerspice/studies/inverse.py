"""The drive that produces a wanted electroadhesive force or friction, checked and corrected by forward runs."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, positive_number, real_number, real_numbers
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.files import write_aside, write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import head_lines, heading, require_circuit
from fingerspice.plots import drawing
from fingerspice.results.record import Sealed
from fingerspice.solve.simulation import simulate
from fingerspice.studies.finger import Finger
from fingerspice.waveforms.files import read_text_columns
from fingerspice.waveforms.periodic import PWL
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import Waveform, as_waveform, require

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture

#: Types that may be given as a wanted force.
Wanted = ArrayLike | Waveform | Callable[[float], float]
# Default rate of a drive, Hz; default and smallest number of samples in a period of the carrier.
RATE, PER_PERIOD, FEWEST = 48_000.0, 128, 20
# Largest number of samples of a drive: its Fourier transform and its run then need less than a gigabyte.
MOST_SAMPLES = 5_000_000
# Relative error of the forward run; relative error of the gap voltage at which the corrections end; largest number of
# corrections. A correction that leaves more than the fraction STALLED of the smallest error so far is the last one.
RTOL, CLOSE, CORRECTIONS, STALLED = 1e-6, 1e-5, 25, 0.7
# Largest voltage of a drive without a warning where no limit is given, V: usual amplifiers end below it.
HUGE = 1000.0
# Full scale of a WAV file's integers.
_FULL = 2.0**31


def on_carrier(carrier: float | None) -> str:
    """The carrier of a drive (Hz) in words."""
    return "without a carrier" if carrier is None else f"on a carrier of {format_si(carrier, 'Hz')}"


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
        wanted, reached = self.wanted_friction, self.friction
        if self.kind == "force":
            wanted, reached = self.wanted, self.force
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
        names = ("carrier", "limit", "slew", "lead", "peak", "at_limit", "worst", "rms", "worst_share", "rms_share")
        wanted, reached, _ = self._asked
        return {
            "kind": self.kind, "rate": self.drive.rate, "samples": self.drive.values.size,
            **{name: getattr(self, name) for name in names}, "largest_wanted": float(wanted.max()),
            "largest_reached": float(reached.max()), "corrections": self.corrections,
        }  # fmt: skip

    def _page(self) -> Page:
        wanted, reached, _ = self._asked
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
        said = f"drive for a wanted {self.kind}, {on_carrier(self.carrier)}: {self._verdict()}"
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
        (wanted, reached, miss), volts = self._asked, self.drive.values
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
        return write_aside(Path(path), lambda target: wavfile.write(target, round(rate), data))

    def to_csv(self, path: str | Path) -> Path:
        """Write the drive as CSV: time (s) and voltage (V)."""
        t = np.arange(self.drive.values.size) / self.drive.rate
        return write_csv(path, ("time (s)", "drive (V)"), zip(t, self.drive.values, strict=True))

    def friction_to_csv(self, path: str | Path) -> Path:
        """Write wanted and predicted force and friction as CSV."""
        names = ("time (s)", "wanted force (N)", "force (N)", "wanted friction (N)", "friction (N)")
        columns = self.times, self.wanted, self.force, self.wanted_friction, self.friction
        return write_csv(path, names, zip(*columns, strict=True))


def _wave_of(given: Wanted, what: str, rate: float | None, duration: float | None) -> tuple[Waveform, float]:
    """What a caller wants (N) against time, and until when (s).

    An array needs its `rate`, and a waveform without an end a `duration`.
    """
    if isinstance(given, Waveform) or callable(given):
        wave, end = as_waveform(given), duration
        if end is None and isinstance(wave, Samples):
            end = wave.start + (wave.values.size - 1) / wave.rate
        elif end is None and isinstance(wave, PWL) and wave.period is None:
            end = float(np.asarray(wave.times)[-1])
        if end is None:
            raise InputError(f"{what} is a waveform without an end; allowed: with duration= in s")
        return wave, positive_number("duration", end, "s")
    values = real_numbers(what, given, "numbers in N, a waveform or a function")
    if rate is None:
        raise InputError(f"{what} is an array without a rate; allowed: with rate= in Hz, or fs.Samples({what}, rate)")
    require(values.ndim == 1 and values.size >= 2, what, f"an array of shape {values.shape}", "a row of two or more")
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise InputError(f"{what}: row {bad[0]} is {values[bad[0]]}; allowed: finite numbers in N")
    return Samples(values, rate), (values.size - 1) / rate


def read_wanted(path: str | Path, rate: float | None = None) -> tuple[str, Waveform, float]:
    """The wanted quantity of a table, ``"force"`` or ``"friction"``, its course from time 0 on, and its end, s.

    The header names a column ``force`` or ``friction`` (N or mN), and a column of times, ``t`` or ``time``, unless a
    `rate` (Hz) is given: ``time (ms), friction (N)``. Time 0 of the course is the first of the table's times.
    """
    found = read_text_columns(path)
    if not found.names:
        raise InputError(f"'{path}' has no header; allowed: a first line such as 'time (s), friction (N)'")
    kinds = [name.lower() for name in found.names]
    named = [kind for kind in ("force", "friction") if kind in kinds]
    if len(named) != 1:
        has = "columns force and friction" if named else "no column named force or friction"
        raise InputError(f"'{path}' has {has}; it has {found.listed()}; allowed: one column of these names")
    values = found.scaled(kinds.index(named[0]), "N")
    if values.size < 2:
        raise InputError(f"'{path}' has one row; allowed: two or more")
    timed = next((i for i, name in enumerate(kinds) if name in ("t", "time")), None)
    if timed is None:
        if rate is None:
            raise InputError(f"'{path}' has no column of times and no rate; allowed: a column time, or a rate in Hz")
        return named[0], *_wave_of(values, named[0], rate, None)
    t = found.scaled(timed, "s")
    back = np.flatnonzero(np.diff(t) <= 0.0)
    if back.size:
        i = int(back[0])
        raise InputError(f"{found.place(i + 1)}: the time {t[i + 1]:g} s follows {t[i]:g} s; allowed: rising times")
    t = t - t[0]
    end = float(t[-1])
    own = (t.size - 1) / end
    if not np.all(np.abs(t * own - np.arange(t.size)) < 1e-3):
        if rate is not None:
            raise InputError(f"'{path}': its times are uneven, and a rate is given; allowed: one of them")
        return named[0], PWL(tuple(t.tolist()), tuple(values.tolist())), end
    if rate is not None and abs(rate - own) > 1e-3 * own:
        raise InputError(
            f"'{path}': its times are at {own:g} Hz, and the rate given is {rate:g} Hz; allowed: one of them"
        )
    return named[0], Samples(values, own), end


def inverse_drive(
    circuit: Circuit,
    *,
    force: Wanted | None = None,
    friction: Wanted | None = None,
    rate: float | None = None,
    carrier: float | None = None,
    limit: float | None = None,
    slew: float | None = None,
    duration: float | None = None,
    lead: float | None = None,
    charge_law: str | None = None,
) -> InverseDrive:
    """Find the source voltage that produces a wanted electroadhesive force or friction, starting uncharged.

    Parameters
    ----------
    circuit : Circuit
        A circuit with one GAP and one V source, whose own waveform is not used.
    force, friction : array_like, waveform or function of time (s)
        Wanted force, or wanted friction, N; one of the two. An array has the sample rate `rate`. The force is Eq. 2
        times the area, and the friction is mu (F_N + force).
    rate : float, optional
        Samples per second of the drive, which is linear between them. By default it is the rate of the wanted samples,
        or else 48 kHz; with a carrier it is 128 times the carrier's frequency.
    carrier : float, optional
        Hz: the gap voltage is then an envelope times a sine, such that the mean force over each period of the sine is
        the wanted one. Without a carrier the gap voltage does not change its sign.
    limit : float, optional
        Largest voltage of the source, V.
    slew : float, optional
        Largest slew rate of the source, V/s.
    duration : float, optional
        Length of a waveform or function without an end, s.
    lead : float, optional
        Time in which the gap voltage rises to its first value, s; by default 0 for a series stack, whose gap voltage
        jumps with the source, and 2 ms for another network.
    charge_law : str, optional
        As in `simulate`.

    Returns
    -------
    InverseDrive

    Raises
    ------
    InputError
        If no voltage produces the force, if the circuit has several fingers or sources, or if arguments contradict each
        other.
    SolveError
        If the forward run fails.

    Warns
    -----
    FingerspiceWarning
        If no limit is given and the drive exceeds 1000 V.

    Notes
    -----
    While a limit holds the drive, the drive stays at the limit and the layers' state follows from it; the force is the
    wanted one again as soon as the limits allow. The drive does not act in advance of a limit that it will reach later.
    """
    require_circuit(circuit)
    asked = [(kind, wanted) for kind, wanted in (("force", force), ("friction", friction)) if wanted is not None]
    if len(asked) != 1:
        raise InputError(f"of force and friction {'both' if asked else 'neither'} is given; allowed: one of them")
    ((kind, wanted),) = asked
    rate, carrier, limit, slew = (
        None if number is None else positive_number(name, number, unit)
        for name, number, unit in (
            ("rate", rate, "Hz"), ("carrier", carrier, "Hz"), ("limit", limit, "V"), ("slew", slew, "V/s")
        )
    )  # fmt: skip
    finger = Finger(circuit, charge_law)
    wave, end = _wave_of(wanted, kind, rate, duration)
    if carrier is not None:
        if rate is not None and rate < FEWEST * carrier:
            raise InputError(
                f"a carrier of {carrier:g} Hz is too fast for a rate of {rate:g} Hz; allowed: at most a {FEWEST}th of "
                f"it, {rate / FEWEST:g} Hz, or a higher rate"
            )
        rate = rate or PER_PERIOD * carrier
        if end * carrier < 1.0:
            raise InputError(f"{end:g} s hold no period of the carrier; allowed: 1 or more")
    rate = rate or (wave.rate if isinstance(wave, Samples) else RATE)
    count, allowed = end * rate, f"2 to {MOST_SAMPLES:,} samples"
    require(1.0 <= count <= MOST_SAMPLES - 1, "the drive", f"{count:,.0f} samples long", allowed)
    begin = finger.lead if lead is None else real_number("lead", lead, "a number in s")
    require(0.0 <= begin < 1e3, "lead", f"{begin:g} s", "0 or more, less than 1000")
    found = Task(finger, kind, wave, end, rate, carrier, begin).solve(limit or math.inf, slew or math.inf)
    if limit is None and found.peak > HUGE:
        text = (
            f"the drive reaches {found.peak:.0f} V; limit= (V) keeps it within what the amplifier gives, and says what "
            "that costs"
        )
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    return found


class Task:
    """The gap voltage for a wanted force or friction (`kind`) until `end` (s), and the iteration for its drive.

    The force first rises for `lead` (s). `rate` and `carrier` (Hz) are those of `inverse_drive`.
    """

    def __init__(
        self, finger: Finger, kind: str, wave: Waveform, end: float, rate: float, carrier: float | None, lead: float
    ) -> None:
        self.finger, self.kind, self.rate, self.carrier, self.lead = finger, kind, rate, carrier, round(lead * rate)
        # With a carrier the force is also evaluated midway between samples, as Simpson's rule for its mean needs it.
        self.fine = 1 if carrier is None else 2
        t = np.arange(self.fine * math.floor(end * rate * (1.0 + 1e-12)) + 1) / (self.fine * rate)
        contact, force, least, scale, rest = finger.contact, wave.value(t), "0 N", 1.0, 0.0
        if kind == "friction":
            if contact.mu == 0.0:
                raise InputError(
                    "the GAP has mu=0, so that no voltage makes friction; allowed: mu > 0, or a wanted force"
                )
            # F_el = F_T / mu - F_N (Eq. 1 with full slip).
            force = force / contact.mu - contact.f_n
            scale, rest = contact.mu, contact.f_n
            least = f"{contact.mu * contact.f_n:g} N, the friction without a voltage"
        bad = np.flatnonzero(~(force >= -1e-12 * max(1.0, float(np.abs(force).max()))))
        if bad.size:
            raise InputError(
                f"{kind}: {scale * (float(force[bad[0]]) + rest):g} N at {t[bad[0]]:g} s is reached by no voltage, "
                f"which only attracts; allowed: from {least}"
            )
        # Negative round-off becomes 0.
        self.wanted = np.maximum(force, 0.0)
        self.target = finger.voltages(float(self.wanted.max()), rate, carrier)(self.wanted[:: self.fine], self.lead)

    def solve(self, limit: float = math.inf, slew: float = math.inf, close: float = CLOSE) -> InverseDrive:
        """The drive within limits (V, V/s), corrected by the errors of the gap voltage until they are `close`."""
        finger, target, contact, fine = self.finger, self.target, self.finger.contact, self.fine
        peak = float(np.abs(target).max())
        inverter = finger.inverter(peak)
        t = np.arange(fine * (target.size - 1) + 1) / (fine * self.rate)
        wish, least, levelled = target.copy(), math.inf, self.carrier is None
        for done in range(CORRECTIONS + 1):
            values, held = inverter(wish, 1.0 / self.rate, limit, slew)
            drive = Samples(values, self.rate)
            circuit = finger.circuit.varied({finger.source.name: drive})
            with warnings.catch_warnings():
                # The reader has given the deck's warnings, and those of an uncorrected drive do not concern the user.
                warnings.simplefilter("ignore", FingerspiceWarning)
                run = simulate(
                    circuit, t_stop=float(t[-1]), t_eval=t, charge_law=finger.law, rtol=close * RTOL / CLOSE,
                    start="uncharged", charge=False,
                )  # fmt: skip
            force = run.record.one("f_el")
            miss = np.where(held, 0.0, target - finger.sign * run.record.one("u_gap")[::fine])
            size = float(np.abs(miss[self.lead :]).max()) / max(peak, 1e-300)
            stalled = size > STALLED * least
            if size < least:
                best, least = (circuit, drive, held, force, done), size
            wish = wish + miss
            if size <= close or stalled:
                if levelled:
                    break
                # The gap voltage is linear between samples, not a sine, which changes the mean force: now that the
                # force is known, scale the envelope once, so that the mean of each period becomes the wanted one.
                times, wanted, reached = self._compared(force)
                some = (reached > 0.5 * wanted) & (wanted > 1e-3 * wanted.max())
                factor = np.sqrt(np.divide(wanted, reached, out=np.ones_like(wanted), where=some))
                at = (np.arange(target.size) - self.lead) / self.rate
                factor, levelled, least = np.where(held, 1.0, np.interp(at, times, factor)), True, math.inf
                target, wish = target * factor, wish * factor
        circuit, drive, held, force, done = best
        lead, (times, wanted, reached) = self.lead / self.rate, self._compared(force)
        return InverseDrive(
            circuit, drive, lead + times, wanted, reached, contact.mu * (contact.f_n + wanted),
            contact.mu * (contact.f_n + reached), self.kind, self.carrier, limit, slew, lead, float(held.mean()), done,
        )  # fmt: skip

    def _compared(self, force: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times after the lead (s), and the wanted and the reached force there (N), from the force at the fine times.

        With a carrier they are means over its whole periods, by Simpson's rule.
        """
        reached = force[self.lead * self.fine :]
        if self.carrier is None:
            return np.arange(reached.size) / self.rate, self.wanted, reached
        count = math.floor((self.wanted.size - 1) / (2.0 * self.rate) * self.carrier * (1.0 + 1e-12))
        edges = np.arange(count + 1) / self.carrier

        def means(fine: FloatArray) -> FloatArray:
            parts = (fine[:-2:2] + 4.0 * fine[1::2] + fine[2::2]) / (6.0 * self.rate)
            total = np.append(0.0, np.cumsum(parts))
            at_edges = np.interp(edges, np.arange(total.size) / self.rate, total)
            return np.asarray(np.diff(at_edges) / np.diff(edges))

        return 0.5 * (edges[1:] + edges[:-1]), means(self.wanted), means(reached)
