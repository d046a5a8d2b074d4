"""Spectrum of a signal: lines of its last period, or a density by Welch's method; and the result of a phasor sweep."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import ComplexArray, FloatArray, positive_number, real_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import NOTABLE, energy_outside
from fingerspice.circuit.network import network_of
from fingerspice.results.measures import Measured, measures_table
from fingerspice.results.record import Sealed, signal_of
from fingerspice.results.steps import Outputs
from fingerspice.waveforms.waveform import refuse, require

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fingerspice.results.solution import Solution


METHODS = ("auto", "lines", "welch")
_LINES, _MOST_LINES = 1000, 10_000  # Number of lines unless a highest frequency is given, and the largest number
#: Fewest outputs of a density; half-overlapping segments into which they are divided unless a resolution is given.
_FEWEST, _SEGMENTS = 64, 8
_EVEN = 1e-5  # Largest deviation of output times from evenly spaced ones, relative to their distance
CONFIDENCE = 0.95  # Probability that the interval of a density contains the true density
_CLOSED = 0.01  # Largest change of a signal over its last period, over its range, without a warning about it
_SHOWN = 12  # Number of lines in a report


@dataclass(frozen=True, repr=False)
class Spectrum(Sealed, Shown):
    """Spectrum of a signal about its mean: lines of a periodic signal, or a density with its uncertainty.

    Attributes
    ----------
    signal, unit : str
    frequency : ndarray, shape (n,)
        Hz.
    amplitude : ndarray, shape (n,), or None
        Peak amplitude of each line, in the signal's unit; half their squares add up to the variance.
    density : ndarray, shape (n,), or None
        One-sided power spectral density, in the unit's square per Hz; its integral is the variance.
    lower, upper : ndarray, shape (n,), or None
        Ends of the interval that contains the true density with a probability of 95 %, if the signal is Gaussian noise
        whose density changes little within the resolution.
    mean, variance : float
        Mean and variance of the signal, over the period or over the outputs used.
    resolution : float
        Distance of the lines, or width of the bins, Hz.
    segments : float
        Number of independent segments equivalent to the overlapping segments of a density; 1 for lines.
    """

    signal: str
    unit: str
    frequency: FloatArray
    amplitude: FloatArray | None
    density: FloatArray | None
    lower: FloatArray | None
    upper: FloatArray | None
    mean: float
    variance: float
    resolution: float
    segments: float

    @property
    def shown_variance(self) -> float:
        """Variance in the spectrum: less than `variance` where the signal has frequencies beyond the highest one."""
        if self.density is not None:
            return float(self.density.sum()) * self.resolution
        return 0.5 * float((np.asarray(self.amplitude) ** 2).sum())

    def _page(self) -> Page:
        name = f"{signal_of(self.signal).text} ({self.signal})"
        rms = format_si(math.sqrt(self.variance), self.unit)
        head = f"spectrum of the {name}: mean {format_si(self.mean, self.unit)}, rms about it {rms}"
        if self.amplitude is not None:
            strongest = np.sort(np.argsort(self.amplitude)[::-1][:_SHOWN])
            pairs = zip(self.frequency[strongest].tolist(), self.amplitude[strongest].tolist(), strict=True)
            rows = [(format_si(f, "Hz"), format_si(amplitude, self.unit)) for f, amplitude in pairs]
            share = 100.0 * self.shown_variance / self.variance if self.variance > 0.0 else 100.0
            last = f"the strongest of {self.frequency.size} lines, which hold {share:.4g} % of the variance"
            return Page([head, "", Table(("line", "amplitude"), rows), "", last])
        lines = f"density at {self.frequency.size} frequencies up to {format_si(float(self.frequency[-1]), 'Hz')}"
        return Page([head, f"{lines}, {self.resolution:.4g} Hz apart, as of {self.segments:.3g} independent segments"])

    def plot(self) -> Figure:
        """Draw the lines, or the density with its interval, against frequency, as a figure like `Solution.plot`'s."""
        from fingerspice.plots.traces import plot_spectrum

        return plot_spectrum(self)


def spectrum_of(
    solution: Solution, signal: str, method: str, highest: float | None, resolution: float | None, since: float | None
) -> Spectrum:
    """See `Solution.spectrum`."""
    require(method in METHODS, "method", repr(method), ", ".join(map(repr, METHODS)))
    highest = None if highest is None else positive_number("highest", highest, "Hz")
    resolution = None if resolution is None else positive_number("resolution", resolution, "Hz")
    since = None if since is None else real_number("since", since, "a number in s")
    names = solution.record.names(signal)
    if len(names) != 1:
        known = ", ".join(names) or "signals of elements that the circuit has"
        raise InputError(f"signal {signal!r} has {len(names)} columns and a spectrum is of one; allowed: {known}")
    welch_only = resolution is not None or since is not None
    if method == "lines" and welch_only:
        raise InputError("resolution and since go with method 'welch'; the lines are those of the last period")
    found = None if method == "welch" or welch_only else _lines(solution, names[0], highest)
    if method == "lines" and found is None:
        raise InputError("the run holds no whole period of its source; allowed: a longer run, or method 'welch'")
    return found or _density(solution, names[0], highest, resolution, since)


def _lines(solution: Solution, name: str, highest: float | None) -> Spectrum | None:
    """Lines of the source's last period; None where the run holds none."""
    period = solution.period
    if period is None or solution._last is None:
        return None
    count = _LINES if highest is None else int(highest * period * (1.0 + 1e-12))
    allowed = f"{1.0 / period:g} Hz, the lowest line, to {_MOST_LINES / period:g} Hz"
    require(1 <= count <= _MOST_LINES, "highest", f"{highest} Hz", allowed)
    # Charges and currents are those of the outputs alone.
    if (last := solution._last_outputs if name.startswith(("q_", "i_")) else solution._last) is None:
        return None
    weighed = last.weigh(name, period / count)
    if isinstance(last, Outputs):
        # The outputs alone determine no frequency beyond half their rate.
        count = max(min(count, (weighed.t.size - 1) // 2), 1)
    mean = weighed.mean()
    weight, x = weighed.weight.ravel(), weighed.x.ravel() - mean
    if abs(x[weighed.t.argmax()] - x[weighed.t.argmin()]) > _CLOSED * float(np.ptp(x)):
        # The signal is not periodic yet, unless a source has a breakpoint at the end, where it may jump.
        ends = solution.t_stop - 1e-6 * period, solution.t_stop + 1e-6 * period
        if not any(w.breakpoints(*ends).size for w in network_of(solution.circuit).waveforms):
            told = "so its lines are not those of the periodic state; a longer run, or start='periodic', has it"
            changes = f"{name} changes over the last period by more than {100 * _CLOSED:g} % of its range, {told}"
            warnings.warn(changes, FingerspiceWarning, stacklevel=4)
    turn = np.exp(-2j * np.pi * np.remainder(weighed.t.ravel() / period, 1.0))
    turning, amplitude = 2.0 * (weight * x) + 0j, np.empty(count)
    for k in range(count):
        turning *= turn
        amplitude[k] = abs(turning.sum())
    return Spectrum(
        name, signal_of(name).unit, np.arange(1, count + 1) / period, amplitude, None, None, None, mean,
        float((weight * x**2).sum()), 1.0 / period, 1.0,
    )  # fmt: skip


def _density(
    solution: Solution, name: str, highest: float | None, resolution: float | None, since: float | None
) -> Spectrum:
    """Welch's density of the outputs from `since` (s) on."""
    from scipy.signal import get_window, welch

    t, x = _even_outputs(solution, name, since)
    rate = (t.size - 1) / (t[-1] - t[0])
    size = 2 * t.size // (_SEGMENTS + 1) if resolution is None else round(rate / resolution)
    allowed = f"{rate / t.size:.4g} Hz, one over the length of the run, to {rate / 8:.4g} Hz"
    require(8 <= size <= t.size, "resolution", f"{resolution} Hz", allowed)
    mean = float(x.mean())
    window = get_window("hann", size)
    f, density = welch(x - mean, rate, window=window, noverlap=size // 2, detrend=False)
    segments = equivalent_segments(window, size - size // 2, 1 + (t.size - size) // (size - size // 2))
    low, high = interval(segments)
    variance = float(np.mean((x - mean) ** 2))
    # The band of a voltage is that of the sources; areas and forces follow the voltage's square, with twice that band.
    wide = 1.0 if name.partition(":")[0] in ("u_source", "u_layer", "u_gap", "v", "i_source", "q_source") else 2.0
    half, waves = 0.5 * rate / wide, network_of(solution.circuit).waveforms
    # `energy_outside` samples the source at four times the given frequency. The second call, at a higher frequency,
    # finds energy that the first one's own sampling would alias.
    share = max((energy_outside(w, solution.t_stop, (0.0, f))[1] for w in waves for f in (half, 8.0 * half)), default=0)
    if share > NOTABLE:
        told = (
            f"{name} has frequencies beyond half the rate of the outputs, {0.5 * rate:g} Hz, which are folded into its "
            f"spectrum ({100.0 * share:.0f} % of the source's energy lie above {half:g} Hz); a shorter step of the "
            "outputs, at most half a period of the highest frequency, keeps them apart"
        )
        warnings.warn(told, FingerspiceWarning, stacklevel=4)
    kept = slice(None) if highest is None else f <= highest
    require(bool(np.any(f[kept])), "highest", f"{highest} Hz", f"{f[1]:.4g} Hz or more")
    return Spectrum(
        name, signal_of(name).unit, f[kept], None, density[kept], low * density[kept],
        high * density[kept], mean, variance, float(f[1]), segments,
    )  # fmt: skip


def _even_outputs(solution: Solution, name: str, since: float | None) -> tuple[FloatArray, FloatArray]:
    """Times (s) and values of a signal's outputs, evenly spaced, without the additional ones at jumps of the source."""
    t, x = solution.t, solution.record.one(name)
    require(since is None or (t.size > 0 and since < t[-1]), "since", since, "a time before the end of the run, s")
    # Of the two rows of a jump keep the right-hand one if the jump is at an even output time, else none.
    kept = np.append(np.diff(t) > 0.0, True)[: t.size] & (t >= (-math.inf if since is None else since))
    jump = np.append(False, np.diff(t) == 0.0)[: t.size][kept]
    t, x = t[kept], x[kept]
    ways = "a shorter step on the .tran line, or more times in t_eval"
    refuse(t.size < _FEWEST, f"a density needs {_FEWEST} outputs or more, and there are {t.size}; allowed: {ways}")
    place = (t - t[0]) / (t[-1] - t[0])
    place *= np.rint(1.0 / np.median(np.diff(place)))
    on = ~jump | (np.abs(place - np.rint(place)) <= _EVEN)
    uneven = np.any(np.abs(np.diff(place[on]) - 1.0) > _EVEN)
    ways = "the even outputs of the .tran line's step, or even times in t_eval"
    refuse(uneven, f"the outputs are not evenly spaced, and a density needs them so; allowed: {ways}")
    return t[on], x[on]


def equivalent_segments(window: FloatArray, step: int, count: int) -> float:
    """Number of independent segments whose mean density has the same variance as `count` overlapping ones (Welch 1967).

    They have a window (size,) and begin `step` samples apart.
    """
    power = float(window @ window)
    shifts = range(1, min(count, -(-window.size // step)))
    overlap = [float(window[m * step :] @ window[: window.size - m * step]) / power for m in shifts]
    return count / (1.0 + 2.0 * sum((1.0 - m / count) * r**2 for m, r in zip(shifts, overlap, strict=True)))


def interval(segments: float) -> tuple[float, float]:
    """Factors from an estimated density to the ends of its interval: chi-square, two degrees of freedom per segment."""
    from scipy.stats import chi2

    degrees, tail = 2.0 * segments, 0.5 * (1.0 - CONFIDENCE)
    return float(degrees / chi2.ppf(1.0 - tail, degrees)), float(degrees / chi2.ppf(tail, degrees))


class Column(NamedTuple):
    """A column of a result, from which its table, its file and its plain data follow."""

    key: str
    unit: str
    values: FloatArray  # In that unit, shape (n,)
    head: str = ""  # Heading in a table; a column without one only belongs into files
    factor: float = 1.0  # From its unit to that of the heading
    form: str = ".5g"


@dataclass(frozen=True, repr=False)
class PhasorSolution(Shown):
    """Phasors against frequency; arrays of shape (n_frequency,).

    Attributes
    ----------
    frequency : ndarray
        Hz.
    gain : ndarray of complex
        Ratio of gap voltage to source, with the modulus of Eq. 11 and the angle of Eq. 13 (V/A for a current source).
    layer_gain : ndarray of complex, shape (n_frequency, n_layer)
        The same ratio for every layer.
    u_gap : ndarray of complex
        Complex amplitude of the gap voltage, V; NaN for a source without fundamental or AC.
    area : ndarray
        Ridge contact area, m^2.
    f_el_mean : ndarray
        Mean electroadhesive force, N.
    amplitude : float
        Source amplitude, V (A for a current source).
    layers : tuple of str
    phase : float
        Phase of the source, rad.
    drive : str
        Where amplitude and phase come from, in words.
    notes : tuple of str
        Remarks on how the sweep was made.
    warnings : tuple of str
        Warnings of extrapolation and of implausible results.
    circuit : Circuit
        Of the sweep.
    impedance : ndarray of complex or None
        Voltage of the source over its current, ohm; None for a large-signal sweep or several sources.
    nodes : tuple of str
        Nodes of the circuit; none of a large signal. Without a GAP the figures of a gap are NaN.
    v_nodes : ndarray of complex or None, shape (n_frequency, n_node)
        Their complex amplitudes, V.
    """

    frequency: FloatArray
    gain: ComplexArray
    layer_gain: ComplexArray
    u_gap: ComplexArray
    area: FloatArray
    f_el_mean: FloatArray
    amplitude: float
    layers: tuple[str, ...]
    phase: float
    drive: str
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    circuit: Circuit
    impedance: ComplexArray | None = None
    nodes: tuple[str, ...] = ()
    v_nodes: ComplexArray | None = None
    measured: Mapping[str, Measured] = field(default_factory=dict)

    @property
    def measures(self) -> dict[str, float]:
        """Values of the deck's `.meas ac` lines by name, NaN where there is none; `measured` says why and where."""
        return {name: one.value for name, one in self.measured.items()}

    @property
    def shown_nodes(self) -> tuple[str, ...]:
        """The nodes of a circuit without GAP, which stand in tables and pictures."""
        return () if self.circuit.by_device("GAP") else self.nodes

    def _columns(self) -> list[Column]:
        """The columns of its table and its file; the amplitude, without a heading, only belongs into the file."""

        def polar(key: str, phase: str, x: ComplexArray, unit: str, heads: tuple[str, str], form: str = ".5g") -> None:
            out.append(Column(key, unit, np.abs(x), heads[0], form=form))
            out.append(Column(phase, "deg", np.degrees(np.angle(x)), heads[1], form=".3f"))

        out = [Column("frequency", "Hz", self.frequency, "frequency [Hz]", form=".6g")]
        for i, node in enumerate(self.shown_nodes):
            v = np.asarray(self.v_nodes)[:, i]
            polar(f"v:{node}", f"phase_deg:{node}", v, "V", (f"|v({node})| [V]", "phase [deg]"))
        if not self.shown_nodes:
            polar("gain", "phase_deg", self.gain, "1", ("|u_gap/U|", "phase [deg]"), ".5f")
            out.append(Column("u_gap", "V", np.abs(self.u_gap), "u_gap [V]"))
            out.append(Column("area", "m^2", self.area, "area [mm^2]", 1e6))
            out.append(Column("f_el_mean", "N", self.f_el_mean, "mean force [N]"))
        out.append(Column("amplitude", "V", np.full(self.frequency.size, self.amplitude)))
        if self.impedance is not None:
            polar("impedance", "impedance_phase_deg", self.impedance, "ohm", ("|Z| [ohm]", "phase of Z [deg]"))
        return out

    def _page(self, most: int = 20) -> Page:
        """A table; of a long sweep, only every n-th row, so that at most `most` rows remain."""
        rows = slice(None, None, max(1, -(-self.frequency.size // most)))
        drive = f"source amplitude {format_si(self.amplitude, 'V')}, phase {math.degrees(self.phase):.4g} deg"
        shown = [column for column in self._columns() if column.head]
        cells = [[f"{c.factor * x:{c.form}}" for x in c.values[rows].tolist()] for c in shown]
        table = Table(tuple(column.head for column in shown), [*zip(*cells, strict=True)])
        return Page([f"{drive}: {self.drive}", *self.notes, table, *measures_table(self.measured, "Hz")])

    def to_dict(self) -> dict[str, Any]:
        """The sweep as plain data, SI units."""
        columns = [column for column in self._columns() if column.key != "amplitude"]
        # Phases of nodes come after all amplitudes.
        columns.sort(key=lambda column: column.key.startswith("phase_deg:"))
        found: dict[str, Any] = {column.key: column.values.tolist() for column in columns}
        found.setdefault("impedance", None)
        found.setdefault("impedance_phase_deg", None)
        return found | {
            "amplitude": self.amplitude, "source_phase_deg": math.degrees(self.phase), "drive": self.drive,
            "notes": list(self.notes), "warnings": list(self.warnings),
            "measures": [{"name": name, **one._asdict()} for name, one in self.measured.items()],
        }  # fmt: skip

    def plot(self) -> Figure:
        """Gain, phase, mean force and area, or without GAP the node voltages, against frequency."""
        from fingerspice.plots.traces import plot_phasor

        return plot_phasor((self,), self.circuit)

    def plot_impedance(self, name: str = "", **others: PhasorSolution) -> Figure:
        """Bode and Nyquist pictures of the impedance, with those of other sweeps by their names.

        ``sliding.plot_impedance("sliding", standing=standing)`` shows two states of a finger.

        Raises
        ------
        InputError
            If a sweep has no impedance: of a large signal, or of several sources.
        """
        from fingerspice.plots.traces import plot_impedance

        sweeps = {name: self, **others}
        missing = [one for one, sweep in sweeps.items() if sweep.impedance is None]
        refuse(bool(missing), f"the sweep {missing} has no impedance; allowed: fs.phasor of a circuit with one source")
        return plot_impedance(sweeps)


def phasor_csv(results: Sequence[PhasorSolution], path: Path) -> Path:
    """Write sweeps as CSV, one after the other where there are several amplitudes."""
    tables = [r._columns() for r in results]
    rows = (row for columns in tables for row in zip(*(c.values.tolist() for c in columns), strict=True))
    return write_csv(path, [f"{column.key} [{column.unit}]" for column in tables[0]], rows)
