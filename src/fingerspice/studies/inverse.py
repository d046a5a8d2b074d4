"""The drive that produces a wanted electroadhesive force or friction of one finger, corrected by forward runs."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import BoolArray, ComplexArray, FloatArray, positive_number, real_number, real_numbers
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.files import write_aside, write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit
from fingerspice.circuit.describe import head_lines, heading, require_circuit
from fingerspice.circuit.network import Network, linear_scene
from fingerspice.circuit.statespace import find_branches
from fingerspice.engine.inverse import drive_stack
from fingerspice.physics.contact import fixed_area_curve
from fingerspice.plots import drawing
from fingerspice.results.record import Sealed, attribute
from fingerspice.solve.simulation import simulate
from fingerspice.waveforms.files import read_text_columns
from fingerspice.waveforms.periodic import PWL
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import Waveform, as_waveform, refuse, require

#: Types that may be given as a wanted force.
Wanted = ArrayLike | Waveform | Callable[[float], float]
# Default rate of a drive, Hz; default and smallest number of samples in a period of the carrier.
RATE, PER_PERIOD, FEWEST = 48_000.0, 128, 20
# Largest number of samples of a drive, whose Fourier transform and run then need less than a gigabyte; largest voltage
# without a warning where no limit is given, V: usual amplifiers end below it.
MOST_SAMPLES, HUGE = 5_000_000, 1000.0
# Relative errors of the forward run, and of the gap voltage at which the corrections end; largest number of these. One
# that leaves more than the fraction STALLED of the smallest error so far is the last.
RTOL, CLOSE, CORRECTIONS, STALLED = 1e-6, 1e-5, 25, 0.7
# Over the length of the Fourier transform a signal is damped by exp(-_DAMPING), so that its end does not wrap round to
# its beginning; as the signal fills at most half of it, round-off grows by the square root of that factor.
_DAMPING = 14.0
# Response of the gap voltage to the source, relative to the largest over all frequencies, that counts as none.
_DEAF = 1e-9
# Number of amplitudes of the carrier between which the mean force is interpolated.
_GRID = 80


class Finger:
    """The one finger of a circuit with one V source, under a charge law; others, and a delayed area, are refused."""

    def __init__(self, circuit: Circuit, charge_law: str | None) -> None:
        self.circuit, self.law = circuit, charge_law or circuit.charge_law or "local"
        require(self.law in CHARGE_LAWS, "charge_law", repr(self.law), " or ".join(map(repr, CHARGE_LAWS)))
        gaps, sources = circuit.by_device("GAP"), [e for e in find_branches(circuit)[1] if e.device in "VI"]
        one, has = "an inverse drive is that of one", [", ".join(e.name for e in x) or "none" for x in (gaps, sources)]
        refuse(len(gaps) != 1, f"{one} finger; this circuit has the GAPs {has[0]}; allowed: one GAP")
        other = [e.device for e in sources] != ["V"]
        refuse(other, f"{one} V source; this circuit has {has[1]}; allowed: one V element")
        (self.gap,), (self.source,) = gaps, sources
        tau = self.gap.values["tau"]
        refuse(tau > 0.0, f"{self.gap.name} has tau={tau:g} s: its area follows with a delay; allowed here: tau=0")
        p_sat, slip = (self.gap.values[name] for name in ("p_sat", "slip"))
        said = f"{self.gap.name} has p_sat={p_sat:g} Pa, slip={slip:g} m"
        refuse(p_sat < math.inf or slip > 0.0, f"{said}: friction is not mu times its load; allowed here: inf and 0")
        scene = linear_scene(circuit)
        amplified = "an inverse drive needs modes that decay without oscillation, and this circuit has inductors"
        refuse(scene.network.active, f"{amplified} or amplifiers; allowed: the drive behind them, by a V element")
        follows = f"{self.gap.name} has a height, or a leak, that follows its voltage"
        refuse(scene.network.owned, f"{follows}; allowed here: another contact law, and r_exp=0")
        self.network, self.contact, stack = scene.network, scene.contact, scene.network.stack
        self.area = scene.network.areas[scene.finger].given  # Fixed by the deck, m^2, or None
        # Time in which the force rises to its first value, s: by default none in a stack, which jumps with the source.
        self.lead = 2e-3 if stack is None else 0.0
        # Sign of the GAP's voltage, from p to n, relative to the voltage along the source.
        self.sign = 1.0 if stack is None else float(stack.sign[stack.gap]) * stack.sources[0][1]

    def force(self, u: FloatArray | float) -> FloatArray:
        """Electroadhesive force (N) at gap voltages (V), same shape."""
        return np.asarray(self.contact.stress(u) * (self.contact.area(u) if self.area is None else self.area))

    def voltages(self, most: float, rate: float, carrier: float | None) -> Callable[[FloatArray, int], FloatArray]:
        """What computes gap voltages (V) for forces of up to `most` (N), after a rise in some steps.

        The forces are means over each period of a carrier (Hz); between samples, at `rate` (Hz), the voltage is linear.
        """
        from scipy.interpolate import CubicSpline

        shape, weight = np.ones(1), np.ones(1)
        if carrier is not None:
            points = rate / carrier
            count = round(points) if abs(points - round(points)) < 1e-9 else round(8 * points)
            at = np.sin(2.0 * np.pi * np.arange(count + 1) / points)
            shape = np.abs(np.concatenate([at[:-1], 0.5 * (at[1:] + at[:-1])]))
            # Simpson's rule between samples: of a linear voltage the force is a parabola but for the area's change.
            weight = np.repeat([1.0 / 3.0, 2.0 / 3.0], count) / count

        def mean(amplitude: FloatArray) -> FloatArray:
            return np.asarray(self.force(amplitude[:, None] * shape) @ weight)

        top, end = 1.0, self.reach(1e6)
        while top <= end and mean(np.array([min(top, end)]))[0] < 1.01 * most:
            top *= 1.4
        top = min(top, end)
        amplitude = top * np.arange(1, _GRID + 1) / _GRID
        force = mean(amplitude)
        rising = np.append(np.diff(force) > 0.0, False)
        amplitude, root = amplitude[: rising.argmin() + 1], np.sqrt(force[: rising.argmin() + 1])
        if (best := root[-1] ** 2) < most:
            raise InputError(f"the force wanted, {most:g} N, is reached by no voltage; allowed: at most {best:.3g} N")
        # The voltage over the root of the force, which at 0 V is that of a small voltage.
        at_zero = math.sqrt(1.0 / float(weight @ shape**2) / (float(self.force(1e-3)) / 1e-3**2))
        spline = CubicSpline(np.append(0.0, root), np.append(at_zero, amplitude / root))

        def voltages(force: FloatArray, lead: int) -> FloatArray:
            u = np.sqrt(force) * spline(np.sqrt(force))
            # The rise has zero first and second derivative at both ends.
            x = np.arange(lead) / max(lead, 1)
            u = np.append(u[0] * (x**3 * (10.0 - 15.0 * x + 6.0 * x * x)), u)
            if carrier is not None:
                u *= np.sin(2.0 * np.pi * carrier / rate * (np.arange(u.size) - lead))
            return u

        return voltages

    def reach(self, u_max: float) -> float:
        """The gap voltage (V) up to which there is an area, at most `u_max`."""
        return u_max if self.area is not None else self.contact.reach(u_max)

    def inverter(self, u_max: float) -> Callable[[FloatArray, float, float, float], tuple[FloatArray, BoolArray]]:
        """What computes source voltages (V), and which a limit holds, for gap voltages of up to `u_max` (V).

        It takes the gap voltages in the direction of the source, their interval (s), and the source's largest voltage
        (V) and slew rate (V/s). A stack is inverted step by step: where a limit holds, its layers' state follows.
        """
        stack = self.network.stack
        if stack is None:
            # The source as it is, within its limits: a stack of nothing but a gap.
            wish, gap, cells, curve = _linear_inverse(self.network), 0, np.eye(1, 3), fixed_area_curve(1.0)
        else:
            assert stack.gap is not None
            wish, gap, cells = (lambda u, _: u), stack.gap, np.column_stack([stack.c, stack.g_total, stack.g_area])
            curve = fixed_area_curve(self.area) if self.area is not None else self.contact.curve(1.2 * max(u_max, 1.0))

        def drive(u: FloatArray, h: float, limit: float, slew: float) -> tuple[FloatArray, BoolArray]:
            out, held = np.empty(u.size), np.empty(u.size, np.bool_)
            drive_stack(wish(u, h), h, curve, cells, gap, self.law == "mobile", limit, slew * h, out, held)
            return out, held

        return drive


def _linear_inverse(net: Network) -> Callable[[FloatArray, float], FloatArray]:
    """Inverts the linear response of a network at its areas at rest: source voltages from gap voltages and interval.

    The signals are damped by exp(-a t), so that the response, at s = a + i omega, has no zero (a floating body passes
    no direct voltage, a zero at s = 0).
    """
    from scipy.fft import irfft, next_fast_len, rfft

    leak, c = net.leak(net.areas_at_rest), net.capacitance(net.areas_at_rest)
    gap = next(g for g in net.gaps if g is not None)

    # It takes longer than the transforms, and is asked for again and again for drives of one length.
    @lru_cache(maxsize=1)
    def response(m: int, h: float) -> ComplexArray:
        s = _DAMPING / (m * h) + 2j * np.pi * np.arange(m // 2 + 1) / (m * h)
        k, b = net.stiffness(leak + s[:, None] * c)
        gain = np.linalg.solve(k, -b)[..., 0] @ net.p[gap] + net.q[gap, 0]
        if not np.all(np.abs(gain) > _DEAF * np.abs(gain).max(initial=0.0)):
            deaf = f"{net.sources[0].name} does not drive the gap at every frequency of the drive"
            raise InputError(f"{deaf}; allowed: a source with a path to the GAP, and a lower rate")
        return np.asarray(gain)

    def wish(u: FloatArray, h: float) -> FloatArray:
        n, m = u.size, next_fast_len(2 * u.size, real=True)
        damp = np.exp(-_DAMPING / (m * h) * h * np.arange(m))
        spectrum = rfft(np.append(u, np.full(m - n, u[-1])) * damp)
        return np.asarray(irfft(spectrum / response(m, h), m)[:n] / damp[:n])

    return wish


def on_carrier(carrier: float | None) -> str:
    """The carrier of a drive (Hz) in words."""
    return "without a carrier" if carrier is None else f"on a carrier of {format_si(carrier, 'Hz')}"


def _figure(key: str, doc: str) -> float:
    return attribute(lambda found: found._figures[key], doc=doc)  # type: ignore[no-any-return]


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
    lead, at_limit : float
        Time in which the drive rises to the first wanted value, s, left out of the comparison; and the fraction of the
        samples at which a limit holds the drive.
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

    worst = _figure("worst", "Largest difference between reached and wanted force or friction, N.")
    rms = _figure("rms", "Root mean square of the difference between reached and wanted force or friction, N.")
    worst_share = _figure("worst_share", "`worst` relative to the largest wanted value.")
    rms_share = _figure("rms_share", "`rms` relative to the largest wanted value.")

    @property
    def _asked(self) -> tuple[FloatArray, FloatArray]:
        """The quantity asked for, as wanted and as reached, N."""
        return (self.wanted, self.force) if self.kind == "force" else (self.wanted_friction, self.friction)

    @cached_property
    def _figures(self) -> dict[str, float]:
        (wanted, reached), miss = self._asked, np.subtract(*self._asked)
        most, size = float(wanted.max()), {"worst": float(np.abs(miss).max()), "rms": float(np.sqrt(np.mean(miss**2)))}
        shares = {f"{name}_share": x / (most or math.inf) for name, x in size.items()}
        return {**size, **shares, "largest_wanted": most, "largest_reached": float(reached.max())}

    @property
    def peak(self) -> float:
        """Largest voltage of the drive, V."""
        return float(np.abs(self.drive.values).max())

    def to_dict(self) -> dict[str, Any]:
        """The figures as plain data, in SI units."""
        own = {name: getattr(self, name) for name in ("carrier", "limit", "slew", "lead", "peak", "at_limit")}
        head = {"kind": self.kind, "rate": self.drive.rate, "samples": self.drive.values.size}
        return {**head, **own, **self._figures, "corrections": self.corrections}

    def _page(self) -> Page:
        rows = [
            ("peak of the drive", format_si(self.peak, "V")),
            ("samples", f"{self.drive.values.size:,} at {format_si(self.drive.rate, 'Hz')}"),
            (f"largest {self.kind} wanted", format_si(self._figures["largest_wanted"], "N")),
            (f"largest {self.kind} reached", format_si(self._figures["largest_reached"], "N")),
            ("worst miss", f"{format_si(self.worst, 'N')}, {100.0 * self.worst_share:.2g} %"),
            ("rms miss", f"{format_si(self.rms, 'N')}, {100.0 * self.rms_share:.2g} %"),
            ("time at a limit", f"{100.0 * self.at_limit:.3g} %"),
            *([("rise before it", format_si(self.lead, "s"))] if self.lead > 0.0 else []),
        ]
        said = f"drive for a wanted {self.kind}, {on_carrier(self.carrier)}: {self._verdict()}"
        return Page([*head_lines(self.circuit), said, "", Table(("", ""), rows)])

    def _verdict(self) -> str:
        if self.at_limit == 0.0:
            return f"met to {100.0 * self.worst_share:.2g} % of its largest value"
        limits = [format_si(x, unit) for x, unit in ((self.limit, "V"), (self.slew, "V/s")) if math.isfinite(x)]
        worst, rms = format_si(self.worst, "N"), format_si(self.rms, "N")
        return f"the limits ({', '.join(limits)}) cost {worst} at worst, {rms} rms"

    def plot(self) -> drawing.Picture:
        """Picture of the wanted and the reached quantity, their difference, and the drive, against time."""
        figure, (top, middle, bottom) = drawing.new_figure(3, height=5.2, sharex=True, height_ratios=(3, 1.4, 2))
        (wanted, reached), (at, volts) = self._asked, self.drive.knots
        scale, unit = drawing.engineering(float(at[-1]), "s")
        force, newton = drawing.engineering(float(wanted.max(initial=0.0)) or 1.0, "N")
        small, milli = drawing.engineering(max(self.worst, 1e-12), "N")
        for ax, t, y, color, linewidth, ls, label in (
            (top, self.times, force * wanted, drawing.BLACK, 2.2, "-", "wanted"),
            (top, self.times, force * reached, drawing.ORANGE, 1.2, (0, (4, 1.5)), "reached"),
            (middle, self.times, small * (reached - wanted), drawing.VERMILION, 1.0, "-", None),
            (bottom, at, volts, drawing.BLUE, 0.9, "-", None),
        ):
            ax.plot(*drawing.thin(scale * t, y), color=color, linewidth=linewidth, ls=ls, label=label)
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
            said = f"a WAV file has a whole number of samples a second, and the drive has {rate:g}"
            raise InputError(f"{said}; allowed: rate= a whole number of Hz")
        full, most = (peak or 1.0) if gain is None else gain, 2.0**31
        require(full >= peak, "gain", f"{full:g} V at full scale", f"the drive's peak, {peak:.6g} V, or more")
        data = np.clip(np.rint(most / full * self.drive.values), -most, most - 1.0).astype("<i4")
        return write_aside(Path(path), lambda target: wavfile.write(target, round(rate), data))

    def to_csv(self, path: str | Path) -> Path:
        """Write the drive as CSV: time (s) and voltage (V)."""
        return write_csv(path, ("time (s)", "drive (V)"), zip(*self.drive.knots, strict=True))

    def friction_to_csv(self, path: str | Path) -> Path:
        """Write wanted and predicted force and friction as CSV."""
        names = ("time (s)", "wanted force (N)", "force (N)", "wanted friction (N)", "friction (N)")
        columns = self.times, self.wanted, self.force, self.wanted_friction, self.friction
        return write_csv(path, names, zip(*columns, strict=True))


def _wave_of(given: Wanted, what: str, rate: float | None, duration: float | None) -> tuple[Waveform, float]:
    """What a caller wants (N), an array at a `rate` or a waveform until a `duration`, and until when (s)."""
    if isinstance(given, Waveform) or callable(given):
        wave, end = as_waveform(given), duration
        if end is None and (isinstance(wave, Samples) or (isinstance(wave, PWL) and wave.period is None)):
            end = float(wave.knots[0][-1])
        require(end is not None, what, "a waveform without an end", "with duration= in s")
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
    refuse(not found.names, f"'{path}' has no header; allowed: a first line such as 'time (s), friction (N)'")
    kinds = [name.lower() for name in found.names]
    named = [kind for kind in ("force", "friction") if kind in kinds]
    has = "columns force and friction" if named else "no column named force or friction"
    refuse(len(named) != 1, f"'{path}' has {has}; it has {found.listed()}; allowed: one column of these names")
    values = found.scaled(kinds.index(named[0]), "N")
    refuse(values.size < 2, f"'{path}' has one row; allowed: two or more")
    timed = next((i for i, name in enumerate(kinds) if name in ("t", "time")), None)
    if timed is None:
        refuse(rate is None, f"'{path}' has no column of times and no rate; allowed: a column time, or a rate in Hz")
        return named[0], *_wave_of(values, named[0], rate, None)
    t = found.scaled(timed, "s")
    back = np.flatnonzero(np.diff(t) <= 0.0)
    if back.size:
        i = int(back[0])
        raise InputError(f"{found.place(i + 1)}: the time {t[i + 1]:g} s follows {t[i]:g} s; allowed: rising times")
    t, end = t - t[0], float(t[-1] - t[0])
    own = (t.size - 1) / end
    even = bool(np.all(np.abs(t * own - np.arange(t.size)) < 1e-3))
    if rate is not None and not (even and abs(rate - own) <= 1e-3 * own):
        said = f"at {own:g} Hz, and the rate given is {rate:g} Hz" if even else "uneven, and a rate is given"
        raise InputError(f"'{path}': its times are {said}; allowed: one of them")
    return named[0], Samples(values, own) if even else PWL(tuple(t.tolist()), tuple(values.tolist())), end


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
    limit, slew : float, optional
        Largest voltage (V) and slew rate (V/s) of the source.
    duration : float, optional
        Length of a waveform or function without an end, s.
    lead : float, optional
        Time in which the gap voltage rises to its first value, s; by default 0 for a series stack, whose gap voltage
        jumps with the source, and 2 ms for another network.
    charge_law : str, optional
        As in `simulate`.

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
    require(len(asked) == 1, f"of force and friction {'both' if asked else 'neither'}", "given", "one of them")
    ((kind, wanted),) = asked
    given = ("rate", rate, "Hz"), ("carrier", carrier, "Hz"), ("limit", limit, "V"), ("slew", slew, "V/s")
    rate, carrier, limit, slew = (None if x is None else positive_number(name, x, unit) for name, x, unit in given)
    finger = Finger(circuit, charge_law)
    wave, end = _wave_of(wanted, kind, rate, duration)
    if carrier is not None:
        rate = rate or PER_PERIOD * carrier
        fast = f"a carrier of {carrier:g} Hz is too fast for a rate of {rate:g} Hz; allowed: at most a {FEWEST}th of it"
        refuse(rate < FEWEST * carrier, f"{fast}, {rate / FEWEST:g} Hz, or a higher rate")
        refuse(end * carrier < 1.0, f"{end:g} s hold no period of the carrier; allowed: 1 or more")
    rate = rate or (wave.rate if isinstance(wave, Samples) else RATE)
    count, allowed = end * rate, f"2 to {MOST_SAMPLES:,} samples"
    require(1.0 <= count <= MOST_SAMPLES - 1, "the drive", f"{count:,.0f} samples long", allowed)
    finger.lead = finger.lead if lead is None else real_number("lead", lead, "a number in s")
    require(0.0 <= finger.lead < 1e3, "lead", f"{finger.lead:g} s", "0 or more, less than 1000")
    found = Task(finger, kind, wave, end, rate, carrier).solve(limit or math.inf, slew or math.inf)
    if limit is None and found.peak > HUGE:
        kept = "limit= (V) keeps it within what the amplifier gives, and says what that costs"
        warnings.warn(f"the drive reaches {found.peak:.0f} V; {kept}", FingerspiceWarning, stacklevel=2)
    return found


class Task:
    """The gap voltage for a wanted force or friction (`kind`) until `end` (s), after the lead, and its drive."""

    def __init__(
        self, finger: Finger, kind: str, wave: Waveform, end: float, rate: float, carrier: float | None
    ) -> None:
        self.finger, self.kind, self.rate, self.carrier = finger, kind, rate, carrier
        # With a carrier the force is also evaluated midway between samples, as Simpson's rule for its mean needs it.
        self.lead, self.fine = round(finger.lead * rate), 1 if carrier is None else 2
        t = np.arange(self.fine * math.floor(end * rate * (1.0 + 1e-12)) + 1) / (self.fine * rate)
        mu, load, least, force = finger.contact.mu, finger.contact.f_n, "0 N", (asked := wave.value(t))
        if kind == "friction":
            refuse(mu == 0.0, "the GAP has mu=0, so that no voltage makes friction; allowed: mu > 0, or a wanted force")
            # F_el = F_T / mu - F_N (Eq. 1 with full slip).
            force, least = asked / mu - load, f"{mu * load:g} N, the friction without a voltage"
        bad = np.flatnonzero(~(force >= -1e-12 * max(1.0, float(np.abs(force).max()))))
        if bad.size:
            said = f"{kind}: {asked[bad[0]]:g} N at {t[bad[0]]:g} s is reached by no voltage, which only attracts"
            raise InputError(f"{said}; allowed: from {least}")
        # Negative round-off becomes 0.
        self.wanted = np.maximum(force, 0.0)
        self.target = finger.voltages(float(self.wanted.max()), rate, carrier)(self.wanted[:: self.fine], self.lead)
        # Ends of the carrier's periods; and times after the lead at which forces are compared, s.
        self.edges, self.times = np.empty(0), t
        if carrier is not None:
            self.edges = np.arange(math.floor(t[-1] * carrier * (1.0 + 1e-12)) + 1) / carrier
            self.times = 0.5 * (self.edges[1:] + self.edges[:-1])

    def solve(self, limit: float = math.inf, slew: float = math.inf, close: float = CLOSE) -> InverseDrive:
        """The drive within limits (V, V/s), corrected by the errors of the gap voltage until they are `close`."""
        finger, target, contact, fine = self.finger, self.target, self.finger.contact, self.fine
        peak, wanted = float(np.abs(target).max()), self._compared(self.wanted)
        inverter = finger.inverter(peak)
        t = np.arange(fine * (target.size - 1) + 1) / (fine * self.rate)
        how: dict[str, Any] = {"t_stop": float(t[-1]), "charge_law": finger.law, "rtol": close * RTOL / CLOSE}
        wish, least, levelled = target.copy(), math.inf, self.carrier is None
        for done in range(CORRECTIONS + 1):
            values, held = inverter(wish, 1.0 / self.rate, limit, slew)
            drive = Samples(values, self.rate)
            circuit = finger.circuit.varied({finger.source.name: drive})
            # The reader has given the deck's warnings, and those of an uncorrected drive do not concern the user.
            with warnings.catch_warnings(action="ignore", category=FingerspiceWarning):
                run = simulate(circuit, t_eval=t, start="uncharged", charge=False, **how)
            reached = self._compared(run.record.one("f_el")[self.lead * fine :])
            miss = np.where(held, 0.0, target - finger.sign * run.record.one("u_gap")[::fine])
            size = float(np.abs(miss[self.lead :]).max()) / max(peak, 1e-300)
            stalled = size > STALLED * least
            if size < least:
                best, least = (circuit, drive, held, reached, done), size
            wish = wish + miss
            if size <= close or stalled:
                if levelled:
                    break
                # The gap voltage is linear between samples, not a sine, which changes the mean force: now that the
                # force is known, scale the envelope once, so that the mean of each period becomes the wanted one.
                some = (reached > 0.5 * wanted) & (wanted > 1e-3 * wanted.max())
                factor = np.sqrt(np.divide(wanted, reached, out=np.ones_like(wanted), where=some))
                at = (np.arange(target.size) - self.lead) / self.rate
                factor, levelled, least = np.where(held, 1.0, np.interp(at, self.times, factor)), True, math.inf
                target, wish = target * factor, wish * factor
        (circuit, drive, held, reached, done), lead = best, self.lead / self.rate
        return InverseDrive(
            circuit, drive, lead + self.times, wanted, reached, contact.mu * (contact.f_n + wanted),
            contact.mu * (contact.f_n + reached), self.kind, self.carrier, limit, slew, lead, float(held.mean()), done,
        )  # fmt: skip

    def _compared(self, force: FloatArray) -> FloatArray:
        """Of a force (N) after the lead what is compared: with a carrier, its means over the periods."""
        if self.carrier is None:
            return force
        total = np.append(0.0, np.cumsum((force[:-2:2] + 4.0 * force[1::2] + force[2::2]) / (6.0 * self.rate)))
        at_edges = np.interp(self.edges, np.arange(total.size) / self.rate, total)
        return np.asarray(np.diff(at_edges) / np.diff(self.edges))
