"""The drive that produces a wanted electroadhesive force or friction, checked by forward runs."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, positive_number, real_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Shown
from fingerspice.circuit.arguments import require_circuit
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit
from fingerspice.solve.simulation import simulate
from fingerspice.studies.inversion import Finger, Inverter, Limits, inverter_of, means, rise, the_finger
from fingerspice.studies.wanted import ForceCurve, Profile, Wanted, as_profile, check_forces, force_of_friction
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture

BoolArray = NDArray[np.bool_]

# Default rate of a drive, Hz; default and smallest number of samples in a period of the carrier.
RATE, PER_PERIOD, FEWEST = 48_000.0, 128, 20
# Largest number of samples of a drive: its Fourier transform and its run then need less than a gigabyte.
MOST_SAMPLES = 5_000_000
# Relative error of the forward run; relative error of the gap voltage at which the corrections end; largest number of
# corrections. A correction that leaves more than the fraction STALLED of the smallest error so far is the last one.
RTOL, CLOSE, CORRECTIONS, STALLED = 1e-6, 1e-5, 25, 0.7
# Largest voltage of a drive without a warning where no limit is given, V: usual amplifiers end below it.
HUGE = 1000.0
# Default time in which the force rises to its first value, for networks other than a series stack, s.
LEAD = 2e-3


@dataclass(frozen=True, repr=False)
class InverseDrive(Shown):
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
    def _miss(self) -> FloatArray:
        return self.force - self.wanted if self.kind == "force" else self.friction - self.wanted_friction

    @property
    def _scale(self) -> float:
        return float((self.wanted if self.kind == "force" else self.wanted_friction).max())

    @property
    def worst(self) -> float:
        """Largest difference between reached and wanted force or friction, N."""
        return float(np.abs(self._miss).max())

    @property
    def rms(self) -> float:
        """Root mean square of the difference between reached and wanted force or friction, N."""
        return float(np.sqrt(np.mean(self._miss**2)))

    @property
    def worst_share(self) -> float:
        """`worst` relative to the largest wanted value."""
        return self.worst / self._scale if self._scale > 0.0 else 0.0

    @property
    def rms_share(self) -> float:
        """`rms` relative to the largest wanted value."""
        return self.rms / self._scale if self._scale > 0.0 else 0.0

    @property
    def peak(self) -> float:
        """Largest voltage of the drive, V."""
        return float(np.abs(self.drive.values).max())

    def to_dict(self) -> dict[str, Any]:
        """The figures as plain data, in SI units."""
        return {
            "kind": self.kind, "rate": self.drive.rate, "samples": self.drive.values.size, "carrier": self.carrier,
            "limit": self.limit, "slew": self.slew, "lead": self.lead, "peak": self.peak, "at_limit": self.at_limit,
            "worst": self.worst, "rms": self.rms, "worst_share": self.worst_share, "rms_share": self.rms_share,
            "largest_wanted": self._scale,
            "largest_reached": float((self.force if self.kind == "force" else self.friction).max()),
            "corrections": self.corrections,
        }  # fmt: skip

    def _page(self) -> Page:
        from fingerspice.studies.drive_files import drive_page

        return drive_page(self)

    def plot(self) -> Picture:
        """Picture of the wanted and the reached quantity, their difference, and the drive, against time."""
        from fingerspice.studies.drive_files import plot_drive

        return plot_drive(self)

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
        from fingerspice.studies.drive_files import drive_wav

        return drive_wav(self, Path(path), gain)

    def to_csv(self, path: str | Path) -> Path:
        """Write the drive as CSV: time (s) and voltage (V)."""
        t = np.arange(self.drive.values.size) / self.drive.rate
        return write_csv(path, ("time (s)", "drive (V)"), zip(t, self.drive.values, strict=True))

    def friction_to_csv(self, path: str | Path) -> Path:
        """Write wanted and predicted force and friction as CSV."""
        names = ("time (s)", "wanted force (N)", "force (N)", "wanted friction (N)", "friction (N)")
        columns = self.times, self.wanted, self.force, self.wanted_friction, self.friction
        return write_csv(path, names, zip(*columns, strict=True))


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
    if (force is None) == (friction is None):
        given = "neither" if force is None else "both"
        raise InputError(f"of force and friction {given} is given; allowed: one of them")
    rate, carrier, limit, slew = (
        None if number is None else positive_number(name, number, unit)
        for name, number, unit in (
            ("rate", rate, "Hz"), ("carrier", carrier, "Hz"), ("limit", limit, "V"), ("slew", slew, "V/s")
        )
    )  # fmt: skip
    law = charge_law or circuit.charge_law or "local"
    require(law in CHARGE_LAWS, "charge_law", repr(law), " or ".join(map(repr, CHARGE_LAWS)))
    finger = the_finger(circuit)
    kind, given_profile = ("force", force) if force is not None else ("friction", friction)
    assert given_profile is not None
    profile = as_profile(given_profile, kind, rate, duration)
    rate = _rate(rate, carrier, profile)
    begin = (0.0 if finger.direct else LEAD) if lead is None else real_number("lead", lead, "a number in s")
    require(0.0 <= begin < 1e3, "lead", f"{begin:g} s", "0 or more, less than 1000")
    task = Task(circuit, finger, kind, profile, rate, carrier, round(begin * rate), law)
    found = task.solve(Limits(limit or math.inf, slew or math.inf))
    if limit is None and found.peak > HUGE:
        _warn_of(found.peak)
    return found


def _warn_of(peak: float) -> None:
    """Warn about a drive without a limit, with its largest voltage, V."""
    text = (
        f"the drive reaches {peak:.0f} V; limit= (V) keeps it within what the amplifier gives, and says what that costs"
    )
    warnings.warn(text, FingerspiceWarning, stacklevel=3)


def _rate(rate: float | None, carrier: float | None, profile: Profile) -> float:
    """The drive's rate, Hz."""
    if carrier is not None:
        if rate is not None and rate < FEWEST * carrier:
            raise InputError(
                f"a carrier of {carrier:g} Hz is too fast for a rate of {rate:g} Hz; allowed: at most a {FEWEST}th of "
                f"it, {rate / FEWEST:g} Hz, or a higher rate"
            )
        rate = PER_PERIOD * carrier if rate is None else rate
        if profile.duration * carrier < 1.0:
            raise InputError(f"{profile.duration:g} s hold no period of the carrier; allowed: 1 or more")
    rate = (profile.rate or RATE) if rate is None else rate
    count = profile.duration * rate
    allowed = f"2 to {MOST_SAMPLES:,} samples"
    require(2.0 <= count + 1.0 <= MOST_SAMPLES, "the drive", f"{count:,.0f} samples long", allowed)
    return rate


class Task:
    """The wanted force and the gap voltage that produces it, for one circuit, with the iteration for its drive."""

    def __init__(
        self, circuit: Circuit, finger: Finger, kind: str, profile: Profile, rate: float, carrier: float | None,
        lead: int, law: str,
    ) -> None:  # fmt: skip
        self.circuit, self.finger, self.kind, self.law = circuit, finger, kind, law
        self.rate, self.carrier, self.lead = rate, carrier, lead
        # With a carrier the force is also evaluated midway between samples, as Simpson's rule for its mean needs it.
        self.fine = 1 if carrier is None else 2
        count = math.floor(profile.duration * rate * (1.0 + 1e-12)) + 1
        t = np.arange(self.fine * (count - 1) + 1) / (self.fine * rate)
        values = profile.wave.value(t)
        if kind == "friction":
            values = force_of_friction(values, finger.contact)
        self.wanted = check_forces(values, t, kind, finger.contact)
        self.curve = ForceCurve(
            finger.contact, finger.area, None if carrier is None else rate / carrier, float(self.wanted.max())
        )
        u = self.curve.amplitude(self.wanted[:: self.fine])
        u = np.append(u[0] * rise(lead), u)
        if carrier is not None:
            u *= np.sin(2.0 * np.pi * carrier / rate * (np.arange(u.size) - lead))
        self.target = u

    def solve(self, limits: Limits, close: float = CLOSE) -> InverseDrive:
        """The drive, corrected by the errors of the gap voltage that forward runs show, until they are `close`."""
        peak = float(np.abs(self.target).max())
        inverter = inverter_of(self.circuit, peak, self.law)
        target, best, least, done = self.target, None, math.inf, -1
        wish, levelled = target.copy(), self.carrier is None
        while best is None or done < CORRECTIONS:
            drive, held = inverter.drive(wish, 1.0 / self.rate, limits)
            u, force = self._forward(drive, inverter, close * RTOL / CLOSE)
            miss = np.where(held, 0.0, target - u)
            size = float(np.abs(miss[self.lead :]).max()) / max(peak, 1e-300)
            done += 1
            stalled = size > STALLED * least
            if size < least:
                best, least = (drive, held, force, done), size
            if (size <= close or stalled) and levelled:
                break
            wish = wish + miss
            if size <= close or stalled:
                # The gap voltage is linear between samples, not a sine, which changes the mean force: now that the
                # force is known, scale the envelope once.
                factor, levelled, least = np.where(held, 1.0, self._level(force)), True, math.inf
                target, wish = target * factor, wish * factor
        assert best is not None
        return self._result(limits, *best)

    def _forward(self, drive: FloatArray, inverter: Inverter, rtol: float) -> tuple[FloatArray, FloatArray]:
        """Gap voltage at the samples (V), along the inverter's direction, and force at the fine times (N)."""
        t = np.arange(self.fine * (drive.size - 1) + 1) / (self.fine * self.rate)
        with warnings.catch_warnings():
            # The reader has given the deck's warnings, and warnings about an uncorrected drive do not concern the user.
            warnings.simplefilter("ignore", FingerspiceWarning)
            run = simulate(
                self._driven(drive), t_stop=float(t[-1]), t_eval=t, charge_law=self.law, rtol=rtol, start="uncharged",
                charge=False,
            )  # fmt: skip
        u, force = run.u_gap, run.f_el
        assert u is not None
        assert force is not None
        return inverter.sign * u[:: self.fine], force

    def _driven(self, drive: FloatArray) -> Circuit:
        return self.circuit.varied({self.finger.source.name: Samples(drive, self.rate)})

    def _edges(self) -> FloatArray:
        """Ends of the carrier's whole periods after the lead, s."""
        assert self.carrier is not None
        count = math.floor((self.wanted.size - 1) / (2.0 * self.rate) * self.carrier * (1.0 + 1e-12))
        return np.arange(count + 1) / self.carrier

    def _level(self, force: FloatArray) -> FloatArray:
        """Factors for the gap voltage at the samples, by which the mean force of each period becomes the wanted one."""
        edges = self._edges()
        reached, wanted = (means(x, self.rate, edges) for x in (force[2 * self.lead :], self.wanted))
        some = (reached > 0.5 * wanted) & (wanted > 1e-3 * wanted.max())
        factor = np.sqrt(np.divide(wanted, reached, out=np.ones_like(wanted), where=some))
        t = (np.arange(self.target.size) - self.lead) / self.rate
        return np.interp(t, 0.5 * (edges[1:] + edges[:-1]), factor)

    def _result(
        self, limits: Limits, drive: FloatArray, held: BoolArray, force: FloatArray, corrections: int
    ) -> InverseDrive:
        lead, begin = self.lead / self.rate, self.lead * self.fine
        reached, wanted = force[begin:], self.wanted
        if self.carrier is None:
            times = lead + np.arange(wanted.size) / self.rate
        else:
            edges = self._edges()
            reached, wanted = (means(x, self.rate, edges) for x in (reached, wanted))
            times = lead + 0.5 * (edges[1:] + edges[:-1])
        contact = self.finger.contact
        wanted_friction, friction = (contact.mu * (contact.f_n + x) for x in (wanted, reached))
        driven = self._driven(drive)
        wave = driven[self.finger.source.name].waveform
        assert isinstance(wave, Samples)
        for array in (times, wanted, reached, wanted_friction, friction):
            array.flags.writeable = False
        return InverseDrive(
            driven, wave, times, wanted, reached, wanted_friction, friction, self.kind, self.carrier, limits.voltage,
            limits.slew, lead, float(held.mean()), corrections,
        )  # fmt: skip
