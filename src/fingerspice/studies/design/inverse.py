"""The drive that produces a wanted electroadhesive force or friction, checked by forward runs.

Capability of a screen: the mean and the modulation of the friction that a largest source voltage allows.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, positive_number, positive_row, real_number, real_numbers, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import heading, require_circuit
from fingerspice.plots.drawing import BLUE, caption, dress, engineering, new_figure
from fingerspice.solve.runs import Progress
from fingerspice.solve.simulation import simulate
from fingerspice.studies.design.drive import Finger, InverseDrive, Inverter, Voltages, force_curve, the_finger
from fingerspice.waveforms.files import MAX_TEXT_BYTES, checked_file, read_text_columns
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
    path = checked_file(path, MAX_TEXT_BYTES)
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
    finger = the_finger(circuit, charge_law)
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
        count = math.floor(end * rate * (1.0 + 1e-12)) + 1
        t = np.arange(self.fine * (count - 1) + 1) / (self.fine * rate)
        contact, friction, force = finger.contact, kind == "friction", wave.value(t)
        if friction:
            if contact.mu == 0.0:
                raise InputError(
                    "the GAP has mu=0, so that no voltage makes friction; allowed: mu > 0, or a wanted force"
                )
            # F_el = F_T / mu - F_N (Eq. 1 with full slip).
            force = force / contact.mu - contact.f_n
        bad = np.flatnonzero(~(force >= -1e-12 * max(1.0, float(np.abs(force).max()))))
        if bad.size:
            value, least = float(force[bad[0]]), "0 N"
            if friction:
                value = contact.mu * (value + contact.f_n)
                least = f"{contact.mu * contact.f_n:g} N, the friction without a voltage"
            raise InputError(
                f"{kind}: {value:g} N at {t[bad[0]]:g} s is reached by no voltage, which only attracts; allowed: "
                f"from {least}"
            )
        # Negative round-off becomes 0.
        self.wanted = np.maximum(force, 0.0)
        voltages = force_curve(finger, None if carrier is None else rate / carrier, float(self.wanted.max()))
        self.target = voltages(self.wanted[:: self.fine], rate, carrier, self.lead)

    def solve(self, limit: float = math.inf, slew: float = math.inf, close: float = CLOSE) -> InverseDrive:
        """The drive within limits (V, V/s), corrected by the errors of the gap voltage until they are `close`."""
        finger, target, contact = self.finger, self.target, self.finger.contact
        peak = float(np.abs(target).max())
        inverter = finger.inverter(peak)
        best, least, done = None, math.inf, -1
        wish, levelled = target.copy(), self.carrier is None
        while best is None or done < CORRECTIONS:
            values, held = inverter(wish, 1.0 / self.rate, limit, slew)
            drive = Samples(values, self.rate)
            circuit = finger.circuit.varied({finger.source.name: drive})
            u, force = self._forward(circuit, close * RTOL / CLOSE)
            miss = np.where(held, 0.0, target - finger.sign * u)
            size = float(np.abs(miss[self.lead :]).max()) / max(peak, 1e-300)
            done += 1
            stalled = size > STALLED * least
            if size < least:
                best, least = (circuit, drive, held, force, done), size
            if (size <= close or stalled) and levelled:
                break
            wish = wish + miss
            if size <= close or stalled:
                # The gap voltage is linear between samples, not a sine, which changes the mean force: now that the
                # force is known, scale the envelope once, so that the mean of each period becomes the wanted one.
                times, wanted, reached = self._compared(force)
                some = (reached > 0.5 * wanted) & (wanted > 1e-3 * wanted.max())
                factor = np.sqrt(np.divide(wanted, reached, out=np.ones_like(wanted), where=some))
                at = (np.arange(target.size) - self.lead) / self.rate
                factor, levelled, least = np.where(held, 1.0, np.interp(at, times, factor)), True, math.inf
                target, wish = target * factor, wish * factor
        assert best is not None
        circuit, drive, held, force, done = best
        lead, (times, wanted, reached) = self.lead / self.rate, self._compared(force)
        return InverseDrive(
            circuit, drive, lead + times, wanted, reached, contact.mu * (contact.f_n + wanted),
            contact.mu * (contact.f_n + reached), self.kind, self.carrier, limit, slew, lead, float(held.mean()), done,
        )  # fmt: skip

    def _forward(self, circuit: Circuit, rtol: float) -> tuple[FloatArray, FloatArray]:
        """Gap voltage at the samples (V), and force at the fine times (N), that the circuit with a drive has."""
        t = np.arange(self.fine * (self.target.size - 1) + 1) / (self.fine * self.rate)
        with warnings.catch_warnings():
            # The reader has given the deck's warnings, and warnings about an uncorrected drive do not concern the user.
            warnings.simplefilter("ignore", FingerspiceWarning)
            run = simulate(
                circuit, t_stop=float(t[-1]), t_eval=t, charge_law=self.finger.law, rtol=rtol, start="uncharged",
                charge=False,
            )  # fmt: skip
        u, force = run.u_gap, run.f_el
        assert u is not None
        assert force is not None
        return u[:: self.fine], force

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
