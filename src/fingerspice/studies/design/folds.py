"""Source voltage at which the `mobile` charge law folds, against load, gap and frequency."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray, real_number, whole_number
from fingerspice.base.errors import InputError
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import head_lines, heading, require_circuit
from fingerspice.plots.drawing import BLUE, FONT, GREY, VERMILION, caption, dress, engineering, new_figure
from fingerspice.results.outcome import SolveError, Status
from fingerspice.solve.closed_form import meets_fold
from fingerspice.solve.problem import prepare
from fingerspice.solve.runs import Progress
from fingerspice.solve.simulation import run_problem
from fingerspice.waveforms.waveform import Product, as_waveform, require

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture

# Range of voltages that is searched, V; factor between two voltages that are tried until the fold is between them;
# relative accuracy of the voltage at the fold; relative error of each run.
LOWEST, HIGHEST = 1e-3, 1e5
STEP = 0.7
EXACT = 1e-3
RTOL = 1e-5


@dataclass(frozen=True)
class FoldSweep:
    """Voltage at which the law folds against one parameter.

    Attributes
    ----------
    name, unit : str
    own : float
        The deck's value.
    values, voltages : ndarray, shape (n,)
        The parameter, and the source's peak voltage at the fold (V); NaN if there is no fold up to `HIGHEST`.
    """

    name: str
    unit: str
    own: float
    values: FloatArray
    voltages: FloatArray

    @property
    def rows(self) -> list[tuple[float, float | None]]:
        """Every value with the voltage at its fold, or None without one."""
        pairs = zip(self.values.tolist(), self.voltages.tolist(), strict=True)
        return [(x, u if math.isfinite(u) else None) for x, u in pairs]


@dataclass(frozen=True, repr=False)
class FoldLimits(Shown):
    """Source voltages at which a circuit folds under the `mobile` law.

    Attributes
    ----------
    circuit : Circuit
    peak : float
        The deck's own source voltage, V.
    voltage : float
        Peak source voltage at the fold with the deck's values, V; NaN if there is no fold up to `HIGHEST`.
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
            rows = [(format_si(x, sweep.unit), "none" if u is None else format_si(u, "V")) for x, u in sweep.rows]
            lines += ["", Table((sweep.name, "folds at"), rows)]
        return Page(lines)

    def plot(self) -> Picture:
        """Picture of the fold's voltage against every parameter, with a mark at the deck's own point."""
        figure, axes = new_figure(1, len(self.sweeps), height=3.2, sharey=True)
        for ax, sweep in zip(axes, self.sweeps, strict=True):
            factor, unit = engineering(sweep.own, sweep.unit)
            x, own = factor * sweep.values, factor * sweep.own
            ax.plot(x, sweep.voltages, color=BLUE, marker="o", markersize=3, label="fold of the mobile law")
            ax.fill_between(x, sweep.voltages, 1e6, color=GREY, alpha=0.2, linewidth=0, label="no solution")
            ax.plot([own], [self.peak], color=VERMILION, marker="D", linestyle="none", label="this deck")
            ax.set(xscale="log", yscale="log")
            dress(ax, "Peak source voltage [V]" if ax is axes[0] else "", f"{sweep.name.capitalize()} [{unit}]")
        shown = np.concatenate([s.voltages[np.isfinite(s.voltages)] for s in self.sweeps] + [[self.peak]])
        axes[0].set_ylim(0.5 * shown.min(), 2.0 * shown.max())
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=3, fontsize=FONT - 0.5, frameon=False)
        caption(figure, f"{heading(self.circuit)} · charge law mobile; the other parameters as in the deck")
        return figure

    def to_dict(self) -> dict[str, Any]:
        """Plain data, SI units."""
        sweeps = [{name: np.asarray(x).tolist() for name, x in vars(sweep).items()} for sweep in self.sweeps]
        return {"peak": self.peak, "voltage": self.voltage, "sweeps": sweeps}

    def to_csv(self, path: str | Path) -> Path:
        """Write the map as CSV; a row without a fold has an empty voltage."""
        rows = [(one.name, x, one.unit, "" if u is None else u) for one in self.sweeps for x, u in one.rows]
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
    if len(gaps) != 1:
        found = ", ".join(g.name for g in gaps) or "none"
        raise InputError(f"a map of the fold needs one GAP whose area follows it; this circuit has {found}")
    if circuit.tran is None:
        raise InputError("a map of the fold needs a .tran line that says how long a run is")
    sources = circuit.by_device("V")
    t_stop = circuit.tran.stop
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
            changed = circuit.varied(dict.fromkeys(paths, own * x))
            voltages[i] = fold_voltage(changed, peak, t_stop / x if name == "frequency" else t_stop, guess)
            # The next search starts at this voltage.
            guess = voltages[i] if math.isfinite(voltages[i]) else HIGHEST
        # The fold at the deck's own value is known: the bisection of the sweep may end 1e-3 beside it.
        voltages[np.abs(factors - 1.0) <= 1e-12] = around
        sweeps.append(FoldSweep(name, unit, own, own * factors, voltages))
    told(1.0)
    return FoldLimits(circuit, peak, around, tuple(sweeps))


def fold_voltage(circuit: Circuit, peak: float, t_stop: float, guess: float | None = None) -> float:
    """Peak source voltage (V) at which a run up to `t_stop` (s) reaches the fold; NaN for no fold up to `HIGHEST`.

    It is found by bisection to a relative 1e-3. The run starts as the deck's run does. `peak` is the present peak
    voltage of the circuit's sources (V), and `guess` the voltage where the search starts (V).
    """

    def folds(voltage: float) -> bool:
        by = as_waveform(voltage / peak)
        raised = circuit.varied(
            {e.name: Product((by, e.waveform)) for e in circuit.by_device("V") if e.waveform is not None}
        )
        try:
            problem = prepare(
                raised, t_stop=t_stop, t_eval=None, charge_law="mobile", area="coupled", start="deck", charge=False,
                rtol=RTOL,
            )  # fmt: skip
            if problem.scene.stack is not None:
                return meets_fold(problem, RTOL)
            # Not by `simulate`, which would warn about voltages that the user did not ask for.
            run = run_problem(problem, np.array([0.0, problem.t_stop]), RTOL)
        except InputError as error:
            # An operating point depends on the raised source, and may itself be past the fold, which counts as a fold.
            # A start given by .ic does not depend on the source: report the error.
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
        while high < HIGHEST:
            low, high = high, min(high / STEP, HIGHEST)
            if folds(high):
                break
        else:
            return math.nan
    while high > low * (1.0 + EXACT):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if folds(middle) else (middle, high)
    return math.sqrt(low * high)
