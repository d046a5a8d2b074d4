"""The drive that produces a wanted electroadhesive force or friction, checked by forward runs."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, positive_number, real_number, real_numbers
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.arguments import require_circuit
from fingerspice.circuit.circuit import Circuit
from fingerspice.solve.simulation import simulate
from fingerspice.studies.design.drive import InverseDrive
from fingerspice.studies.design.finger import Finger, force_curve, the_finger
from fingerspice.waveforms.columns import read_text_columns
from fingerspice.waveforms.files import MAX_TEXT_BYTES, checked_file
from fingerspice.waveforms.ramps import PWL
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import Waveform, as_waveform, require

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
