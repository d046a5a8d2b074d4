"""What a screen can do: the friction that a largest source voltage allows, and where the `mobile` law folds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, positive_number, positive_row, real_number, whole_number
from fingerspice.base.errors import InputError
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import head_lines, heading, require_circuit
from fingerspice.plots import drawing
from fingerspice.results.outcome import SolveError, Status
from fingerspice.solve.closed_form import meets_fold
from fingerspice.solve.problem import prepare
from fingerspice.solve.runs import Progress
from fingerspice.solve.simulation import run_problem
from fingerspice.studies.inverse import Finger, Task, on_carrier
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import Product, as_waveform, refuse, require

# Samples per period of the modulation and of the carrier, and the lowest sample rate, Hz; duration of a force in
# periods of the modulation, and the least, s.
_PER_PERIOD, _PER_CARRIER, _LEAST_RATE, _PERIODS, _LASTS = 64, 32, 8000.0, 3.0, 0.05
# Relative accuracy of a stack's amplitudes, and of voltages at the fold or of another network, whose drives are
# corrected this many times at most.
EXACT, MOST = 1e-3, 8
# Range of voltages that is searched for the fold, V; factor between two voltages that are tried until it is between
# them; relative error of each run.
LOWEST, HIGHEST, STEP, RTOL = 1e-3, 1e5, 0.7, 1e-5


@dataclass(frozen=True, repr=False)
class Capability(Shown):
    """Largest amplitudes of the friction that a voltage allows.

    The friction is mean + amplitude sin(2 pi f t), produced by the inverse drive from an uncharged circuit for 3
    periods, and at least 50 ms, with ``|U| <= limit`` all the time; the amplitude is at most the mean less the friction
    at 0 V. In a network other than a series stack the force first rises for 2 ms, as in `inverse_drive`.

    Attributes
    ----------
    circuit : Circuit
    limit, smallest_mean, largest_mean : float
        Largest voltage, V; smallest and largest constant friction, N.
    carrier : float or None
        Frequency of the carrier, Hz.
    frequency : ndarray, shape (n_f,)
        Frequency of the modulation, Hz.
    mean : ndarray, shape (n_m,)
        Mean friction, N.
    amplitude : ndarray, shape (n_m, n_f)
        Largest amplitude of the friction, N.
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
        columns = (self.frequency, "Hz"), (self.largest, "N"), (self.best_mean, "N")
        rows = list(zip(*([format_si(x, unit) for x in values.tolist()] for values, unit in columns), strict=True))
        limit = f"up to {format_si(self.limit, 'V')} {on_carrier(self.carrier)}"
        said = f"{limit} the friction's mean is from {self._range()}"
        return Page([heading(self.circuit), said, "", Table(("modulation", "largest amplitude", "at mean"), rows)])

    def _range(self) -> str:
        return f"{format_si(self.smallest_mean, 'N')} to {format_si(self.largest_mean, 'N')}"

    def plot(self) -> drawing.Picture:
        """Picture with a map of the amplitude over frequency and mean, and the largest amplitude over frequency."""
        figure, (left, right) = drawing.new_figure(1, 2, height=3.4, width_ratios=(1.25, 1))
        factor, unit = drawing.engineering(self.largest_mean, "N")
        f, amplitude = self.frequency, factor * self.amplitude
        if f.size == 1:
            # A map needs two frequencies: a single one is drawn as a band around it, with room for the axis to be read.
            f, amplitude = np.append(0.1 * f, 10.0 * f), np.repeat(amplitude, 2, axis=1)
        mesh = left.contourf(f, factor * self.mean, amplitude, levels=12, cmap="viridis")
        bar = figure.colorbar(mesh, ax=left, pad=0.02)
        bar.set_label(f"Largest amplitude [{unit}]", fontsize=8)
        bar.ax.tick_params(labelsize=8)
        right.plot(self.frequency, factor * self.largest, color=drawing.BLUE, marker="o", markersize=3)
        right.set_ylim(bottom=0.0)
        for ax, label in ((left, f"Mean friction [{unit}]"), (right, f"Largest amplitude, best mean [{unit}]")):
            drawing.dress(ax, label, "Modulation frequency [Hz]", xscale="log")
        drive = f"at most {format_si(self.limit, 'V')} {on_carrier(self.carrier)}"
        drawing.caption(figure, f"{heading(self.circuit)} · {drive} · mean friction {self._range()}")
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
    highest = math.inf if carrier is None else carrier / 4.0
    top = min(1000.0, 0.5 * highest)
    own = np.geomspace(min(5.0, 0.1 * top), top, 13)
    f = positive_row("frequency", own if frequency is None else frequency, "Hz")
    allowed = f"at most a quarter of the carrier's {4.0 * highest:g} Hz"
    refuse(f.max() > highest, f"frequency reaches {f.max():g} Hz; allowed: {allowed}")
    finger = Finger(circuit, charge_law)
    mu = finger.contact.mu
    refuse(mu == 0.0, f"{finger.gap.name} has mu=0 and no friction; allowed: mu > 0")
    # The charges in the layers can raise the gap voltage above the source voltage, but not to ten times the limit.
    most = 0.4 * float(finger.force(finger.reach(10.0 * limit)))
    search = _Search(finger, limit, carrier, most)
    force = np.linspace(0.0, search.largest(lambda x: search.wanted(x, 1.0 / _LASTS, 0.0), most), means)
    amplitude = np.zeros((means, f.size))
    for i, mean in enumerate(force[1:-1].tolist(), 1):
        amplitude[i] = [search.largest(partial(search.wanted, mean, x), mean) for x in f.tolist()]
        if progress is not None:
            progress(i / (means - 2))
    friction = mu * (finger.contact.f_n + force)
    return Capability(circuit, limit, carrier, f, friction, mu * amplitude, float(friction[0]), float(friction[-1]))


class _Search:
    """Search for the largest forces, of up to `most` (N), whose inverse drive stays within the voltage limit."""

    def __init__(self, finger: Finger, limit: float, carrier: float | None, most: float) -> None:
        # The inverter's drive is exact for a series stack. The peak of another network's is off by a ratio, which
        # changes little from a force to the next, so that few drives have to be corrected by forward runs.
        self.finger, self.limit, self.carrier, self.ratio = finger, limit, carrier, 1.0
        self.rate = _PER_CARRIER * carrier if carrier is not None else _LEAST_RATE
        self.voltages = finger.voltages(most, self.rate, carrier)
        self.inverter = finger.inverter(10.0 * limit)

    def wanted(self, mean: float, frequency: float, amplitude: float) -> Samples:
        """A mean force (N) with a modulation (Hz, N), sampled at the rate of the drive."""
        rate = max(_PER_PERIOD * frequency, self.rate) if self.carrier is None else self.rate
        t = np.arange(math.ceil(max(_PERIODS / frequency, _LASTS) * rate)) / rate
        return Samples(np.maximum(mean + amplitude * np.sin(2.0 * np.pi * frequency * t), 0.0), rate)

    def largest(self, wanted: Callable[[float], Samples], most: float) -> float:
        """Largest number up to `most` (N) of which a force's drive is within the limit, by bisection to `EXACT`."""
        for _ in range(MOST):
            found, high, middle = 0.0, most, most
            while high - found > EXACT * max(found, 1e-3 * most):
                within = self.ratio * self._peak(wanted(middle)) <= self.limit
                found, high = (middle, high) if within else (found, middle)
                middle = 0.5 * (found + high)
            if self.finger.network.stack is not None or found == 0.0:
                break
            force = wanted(found)
            end = (force.values.size - 1) / force.rate
            peak = Task(self.finger, "force", force, end, force.rate, self.carrier).solve(close=0.3 * EXACT).peak
            before, self.ratio = self.ratio, peak / self._peak(force)
            if abs(self.ratio / before - 1.0) < 0.5 * EXACT or (found == most and peak <= self.limit):
                break
        return found

    def _peak(self, force: Samples) -> float:
        """Largest voltage (V) of the inverter's drive for a force."""
        u = self.voltages(force.values, round(self.finger.lead * force.rate))
        return float(np.abs(self.inverter(u, 1.0 / force.rate, math.inf, math.inf)[0]).max())


@dataclass(frozen=True)
class FoldSweep:
    """Voltage at which the law folds against one parameter."""

    name: str
    unit: str
    own: float  # The deck's value
    values: FloatArray  # (n,): of the parameter
    voltages: FloatArray  # (n,): the source's peak at the fold, V; NaN if there is no fold up to `HIGHEST`

    def rows(self) -> Iterator[tuple[float, float]]:
        return zip(self.values.tolist(), self.voltages.tolist(), strict=True)


@dataclass(frozen=True, repr=False)
class FoldLimits(Shown):
    """Source voltages at which a circuit folds under the `mobile` law.

    Attributes
    ----------
    circuit : Circuit
    peak, voltage : float
        The deck's own source voltage, and that at the fold with the deck's values, V; NaN for none up to `HIGHEST`.
    sweeps : tuple of FoldSweep
        Sweeps of load, gap, and frequency if the source has one.
    """

    circuit: Circuit
    peak: float
    voltage: float
    sweeps: tuple[FoldSweep, ...]

    def _page(self) -> Page:
        how, share = "does not fold", ""
        if math.isfinite(self.voltage):
            how = f"folds at {format_si(self.voltage, 'V')} peak"
            share = f", {100.0 * self.peak / self.voltage:.3g} % of that"
        head = f"under the mobile law this deck {how}; its source reaches {format_si(self.peak, 'V')}{share}"
        lines: list[str | Table] = [*head_lines(self.circuit), head]
        for sweep in self.sweeps:
            rows = [(format_si(x, sweep.unit), format_si(u, "V") if u > 0.0 else "none") for x, u in sweep.rows()]
            lines += ["", Table((sweep.name, "folds at"), rows)]
        return Page(lines)

    def plot(self) -> drawing.Picture:
        """Picture of the fold's voltage against every parameter, with a mark at the deck's own point."""
        figure, axes = drawing.new_figure(1, len(self.sweeps), height=3.2, sharey=True)
        for ax, sweep in zip(axes, self.sweeps, strict=True):
            factor, unit = drawing.engineering(sweep.own, sweep.unit)
            x, own = factor * sweep.values, factor * sweep.own
            ax.plot(x, sweep.voltages, color=drawing.BLUE, marker="o", markersize=3, label="fold of the mobile law")
            ax.fill_between(x, sweep.voltages, 1e6, color=drawing.GREY, alpha=0.2, linewidth=0, label="no solution")
            ax.plot([own], [self.peak], color=drawing.VERMILION, marker="D", linestyle="none", label="this deck")
            label = "Peak source voltage [V]" if ax is axes[0] else ""
            drawing.dress(ax, label, f"{sweep.name.capitalize()} [{unit}]", xscale="log", yscale="log")
        shown = np.concatenate([s.voltages[np.isfinite(s.voltages)] for s in self.sweeps] + [[self.peak]])
        axes[0].set_ylim(0.5 * shown.min(), 2.0 * shown.max())
        known = axes[0].get_legend_handles_labels()
        figure.legend(*known, loc="outside upper left", ncols=3, fontsize=drawing.FONT - 0.5, frameon=False)
        drawing.caption(figure, f"{heading(self.circuit)} · charge law mobile; the other parameters as in the deck")
        return figure

    def to_dict(self) -> dict[str, Any]:
        """Plain data, SI units."""
        sweeps = [{name: np.asarray(x).tolist() for name, x in vars(sweep).items()} for sweep in self.sweeps]
        return {"peak": self.peak, "voltage": self.voltage, "sweeps": sweeps}

    def to_csv(self, path: str | Path) -> Path:
        """Write the map as CSV; a row without a fold has an empty voltage."""
        rows = [(one.name, x, one.unit, u if u > 0.0 else "") for one in self.sweeps for x, u in one.rows()]
        return write_csv(path, ("parameter", "value [SI]", "unit", "fold [V]"), rows)


def grid_of(points: int, span: float) -> tuple[int, float]:
    """Values of each parameter, and the factor to either side; those that `fold_limits` takes."""
    points, span = whole_number("points", points, 3, 1000), real_number("span", span, "more than 1, at most 1e6")
    require(1.0 < span <= 1e6, "span", span, "more than 1, at most 1e6")
    return points, span


def fold_limits(
    circuit: Circuit, *, points: int = 9, span: float = 10.0, progress: Progress | None = None
) -> FoldLimits:
    """Find the source voltage at which runs under the `mobile` law reach their fold, to a relative 1e-3.

    Every run starts as the deck's run does (uncharged, from the operating point of the raised source, or from the
    deck's .ic) and has as many periods. Each parameter goes from its own value divided by `span` to its own value times
    `span`, with the others as in the deck; SKIN is evaluated at each frequency.

    Parameters
    ----------
    circuit : Circuit
        A circuit with one GAP, a source and a .tran line.
    points : int
        Number of values of each parameter, 3 or more.
    span : float
        Factor between a parameter's own value and the ends of its range, above 1.
    progress : callable, optional
        Called with the fraction done.

    Raises
    ------
    InputError
        If the circuit lacks one of these, or its .ic is already past the fold.
    SolveError
        If a run fails for another reason than a fold.
    """
    require_circuit(circuit)
    points, span = grid_of(points, span)
    gaps = circuit.by_device("GAP")
    found = ", ".join(g.name for g in gaps) or "none"
    refuse(len(gaps) != 1, f"a map of the fold needs one GAP whose area follows it; this circuit has {found}")
    if circuit.tran is None:
        raise InputError("a map of the fold needs a .tran line that says how long a run is")
    sources, t_stop = circuit.by_device("V"), circuit.tran.stop
    peak = max((e.waveform.peak(0.0, t_stop) for e in sources if e.waveform is not None), default=0.0)
    if not 0.0 < peak < math.inf:
        raise InputError("a map of the fold needs a V element with a voltage to raise; this circuit has none")
    # Each parameter's name and unit, its path, and the paths of what changes along with it.
    varied = [("load", "N", [f"{gaps[0].name}.fn"]), ("gap", "m", [f"{gaps[0].name}.d"])]
    if len(sources) == 1 and f"{sources[0].name}.frequency" in circuit.parameters:
        skins = [f"{e.name}.f" for e in circuit.by_device("SKIN")]
        varied.append(("frequency", "Hz", [f"{sources[0].name}.frequency", *skins]))
    factors = np.geomspace(1.0 / span, span, points)
    around, told = fold_voltage(circuit, peak, t_stop), progress or (lambda _: None)
    sweeps: list[FoldSweep] = []
    for name, unit, paths in varied:
        own, voltages, guess = float(circuit.parameters[paths[0]].value), np.zeros(points), peak
        for i, x in enumerate(factors):
            told((1 + i + points * len(sweeps)) / (1 + points * len(varied)))
            stop, fold = t_stop / x if name == "frequency" else t_stop, around
            if abs(x - 1.0) > 1e-12:
                fold = fold_voltage(circuit.varied(dict.fromkeys(paths, own * x)), peak, stop, guess)
            # The next search starts at this voltage.
            voltages[i], guess = fold, fold if math.isfinite(fold) else HIGHEST
        sweeps.append(FoldSweep(name, unit, own, own * factors, voltages))
    told(1.0)
    return FoldLimits(circuit, peak, around, tuple(sweeps))


def fold_voltage(circuit: Circuit, peak: float, t_stop: float, guess: float | None = None) -> float:
    """Peak source voltage (V) at which a run up to `t_stop` (s) reaches the fold; NaN for no fold up to `HIGHEST`.

    `peak` is the present peak voltage of the circuit's sources (V), and `guess` the voltage where the search starts.
    """
    waves = {e.name: e.waveform for e in circuit.by_device("V") if e.waveform is not None}

    def folds(voltage: float) -> bool:
        raised = circuit.varied({name: Product((as_waveform(voltage / peak), wave)) for name, wave in waves.items()})
        try:
            problem = prepare(raised, t_stop=t_stop, charge_law="mobile", charge=False, rtol=RTOL)
            if problem.network.stack is not None and (met := meets_fold(problem, RTOL)) is not None:
                return met
            # Not by `simulate`, which would warn about voltages that the user did not ask for.
            run = run_problem(problem, np.array([0.0, problem.t_stop]), RTOL)
        except InputError as error:
            # An operating point of the raised source may itself be past the fold, which counts; a start given by .ic
            # does not depend on the source: report the error.
            if circuit.initial or "past the fold" not in str(error):
                raise
            return True
        if run.failure is not None and run.status is not Status.FOLD:
            raise SolveError(run.failure, run)
        return run.status is Status.FOLD

    low = high = min(max(guess or peak, LOWEST), HIGHEST)
    if folds(high):
        while folds(low := STEP * high):
            if low < LOWEST:
                return low
            high = low
    else:
        while low == high or not folds(high):
            if high >= HIGHEST:
                return math.nan
            low, high = high, min(high / STEP, HIGHEST)
    while high > low * (1.0 + EXACT):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if folds(middle) else (middle, high)
    return math.sqrt(low * high)
