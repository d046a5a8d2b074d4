"""The result of a run: read-only signals, figures, status, error and provenance; and derivatives of it."""

from __future__ import annotations

import cmath
import json
import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray, Remembering, read_only
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import amount_text, format_si
from fingerspice.circuit.describe import head_lines
from fingerspice.numerics.lobatto import NODES
from fingerspice.results.measures import Measuring, saved_columns
from fingerspice.results.outcome import ErrorEstimate, Failure, Plan, State, Status
from fingerspice.results.record import (
    Sealed,
    Signalled,
    Signals,
    attribute,
    kept_rows,
    signal_of,
    variables,
)
from fingerspice.results.steps import Outputs, Stretch
from fingerspice.waveforms.waveform import as_waveform

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import pandas
    import xarray
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from fingerspice.circuit.circuit import Circuit
    from fingerspice.results.spectrum import Spectrum
    from fingerspice.results.steps import ClosedForm, Recorded
    from fingerspice.sets import Citation
    from fingerspice.waveforms.waveform import Fundamental, Waveform


DERIVED = ("u_gap", "area", "f_el", "f_t", "friction", "a_real")  # Signals and means that have derivatives
MEANS = ("f_el_mean", "f_t_mean", "friction_mean", "area_mean", "a_real_mean")
MOST_BETWEEN = 2_000_000  # Most numbers of the last period between the outputs that a file keeps (16 MB)
# The signals in it, and how far they may be from their polynomials, relative to their peaks.
_BETWEEN, _MISSED = ("u_source", "u_layer", "v", "u_gap", "area", "f_el", "fold_margin"), 1e-10
#: Signals that have rows in the table, in their order, and its columns of figures: heading and kind.
_ROWS = ("u_source", "u_gap", "u_layer", "v", "f_el", "f_t", "friction", "area", "a_real")
_COLUMNS = {
    "min": "min", "max": "max", "mean": "mean", "last period": "mean_periodic", "rms": "rms_periodic",
    "ripple": "ripple",
}  # fmt: skip
Value = float | FloatArray | None


@dataclass(frozen=True, repr=False)
class Sensitivity(Sealed):
    """Derivatives of a run's signals and means by one parameter, in the unit of the signal per unit of the parameter.

    Attributes
    ----------
    path, unit : str
        The parameter, as in `Circuit.parameters`, and its unit in the netlist.
    value : float
        Of the parameter, in that unit.
    u_gap, area, f_el, f_t, friction, a_real : ndarray, shape (n_t,)
        Derivatives of the signals of the same names at `Solution.t`; `a_real` is None without a ``p_sat``.
    f_el_mean, f_t_mean, friction_mean, area_mean, a_real_mean : float
        Derivatives of the means over the run, from TSTART to its end; `a_real_mean` likewise.
    """

    path: str
    unit: str
    value: float
    u_gap: FloatArray
    area: FloatArray
    f_el: FloatArray
    f_t: FloatArray
    friction: FloatArray
    f_el_mean: float
    f_t_mean: float
    friction_mean: float
    area_mean: float
    a_real: FloatArray | None = None
    a_real_mean: float | None = None

    def __repr__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        relative = f"{self.value * self.f_el_mean:.4g} N for a change of 100 %"
        return f"Sensitivity({self.path} = {self.value:g}{unit}: mean force {relative})"


@dataclass(frozen=True, repr=False)
class SampleGradient(Sealed):
    """Derivatives of a number by the samples of a source; see `Solution.sample_gradient`.

    Attributes
    ----------
    source : str
        Name of the source.
    rate, start : float
        Samples per second, and the time of the first sample, s.
    values : ndarray, shape (n_sample,)
        Derivatives, in the unit of the number per volt.
    error : float
        Error of each of them that is stated, in the same unit.
    """

    source: str
    rate: float
    start: float
    values: FloatArray
    error: float

    def __repr__(self) -> str:
        told = f"{self.values.size} samples, largest {np.abs(self.values).max(initial=0.0):.4g}, error {self.error:.1g}"
        return f"SampleGradient({self.source}: {told})"


def figure(key: str, kind: str, doc: str) -> Value:
    """A property of a result that has a method `_figure`: a figure of a signal."""
    return attribute(lambda result: result._figure(key, kind), doc=doc)  # type: ignore[no-any-return]


class Figured:
    """A result with figures: each is a number, an array (n_gap,) with several gaps, or None where it does not exist.

    Figures are integrals and extremes of the run itself, not of its outputs.
    """

    f_el_mean = figure("f_el", "mean", "Mean electroadhesive force over the run, N.")
    f_el_mean_periodic = figure("f_el", "mean_periodic", "Mean of `f_el` over the last period, N; None without one.")
    f_el_peak = figure("f_el", "peak", "Largest electroadhesive force, N.")
    f_t_mean = figure("f_t", "mean", "Mean friction force over the run, N.")
    f_t_mean_periodic = figure("f_t", "mean_periodic", "Mean of `f_t` over the last period, N; None without one.")
    friction_mean = figure("friction", "mean", "Mean friction coefficient over the run.")
    area_mean = figure("area", "mean", "Mean ridge contact area over the run, m^2.")
    a_real_mean = figure("a_real", "mean", "Mean real contact area over the run, m^2; None without a ``p_sat``.")
    u_gap_peak = figure("u_gap", "peak", "Largest modulus of the gap voltage, V.")
    u_gap_rms = figure("u_gap", "rms", "Root of the mean square of the gap voltage over the run, V.")
    u_gap_amplitude = figure(
        "u_gap", "amplitude", "Amplitude of `u_gap` at the fundamental, over the last period, V; None without one."
    )
    u_gap_phase_deg = figure("u_gap", "phase_deg", "Phase of `u_gap` at the fundamental, relative to a sine, degrees.")


@dataclass(frozen=True, repr=False)
class Solution(Remembering, Sealed, Shown, Signalled, Figured, Measuring):
    """Time response of a circuit.

    Signals are read-only arrays in SI units, computed when they are first asked for. A jump of the source has two rows
    with the same time. Where a circuit has several GAPs, their signals (`u_gap`, `area`, `sigma_el`, `f_el`, `f_t`,
    `friction`, `a_real`) have the shape (n_t, n_gap), in the order of `gaps`. Likewise `u_source`, `q_source` and
    `i_source` have a column for each of several sources, in the order of `sources`.

    Attributes
    ----------
    t : ndarray, shape (n_t,)
        s.
    record : Record or StoredRecord
        Outputs of the run, from which all signals follow.
    status : Status
    failure : Failure or None
        Why, when and where the run failed, and what to change.
    nfev : int
        Evaluations of the right-hand side.
    stats : dict
        Numbers of steps, rejected steps, zeros of the gap voltage and repeated periods; the wall time (s).
    error, rtol : ErrorEstimate, float
        Error stated, and error asked for relative to the peaks.
    charge_law, area_mode, method : str
    plan : Plan
        The model that was run, and the reasons for it.
    circuit, state : Circuit, State
    warnings : tuple of str
        Of the deck and of the run; and which options of the deck have no effect, of which Python gives no warning.
    first, t_stop : float
        TSTART and the end of the run, s.
    start : str
        How the run started, as in `simulate`; ``"given"`` where it went on from another one.
    continuous : Recorded or ClosedForm or None
        The run between its outputs, or the last period of one from a file; None where only its outputs are known.
    fundamental, period : Fundamental or None, float or None
        Fundamental and period (s) of the source; None where it has none.
    fold_margin_min : float
        Smallest distance to the fold in the run's steps.
    sensitivities : mapping of str to Sensitivity
        By the path of each parameter that was asked for.
    stored : mapping or None
        The summary of a run that was read from a file.
    """

    t: FloatArray
    record: Signals
    status: Status
    failure: Failure | None
    nfev: int
    stats: dict[str, Any]
    error: ErrorEstimate
    rtol: float
    charge_law: str
    area_mode: str
    method: str
    plan: Plan
    circuit: Circuit
    state: State
    fundamental: Fundamental | None = None
    period: float | None = None
    fold_margin_min: float = 1.0
    warnings: tuple[str, ...] = field(default=())
    first: float = 0.0
    t_stop: float = 0.0
    start: str = "deck"
    continuous: Recorded | ClosedForm | None = None
    stored: Mapping[str, Any] | None = None
    sensitivities: Mapping[str, Sensitivity] = field(default_factory=dict)

    def _page(self) -> Page:
        """The figures as a table, and below it errors, the distance to the fold, and how the run ended."""
        s, error = self.summary(), self.error
        end = format_si(float(self.t[-1]), "s") if self.t.size else "nothing"
        how = f"charge law {self.charge_law}, area {self.area_mode}, method {self.method}, rtol {self.rtol:g}"
        out: list[str | Table] = [*head_lines(self.circuit), f"{end} simulated; {how}", ""]
        if self.t.size >= 2:
            names = [name for key in _ROWS for name in self.record.names(key) if f"{name}_max" in s]
            out.append(Table(("", *_COLUMNS), [_row(name, s) for name in names]))
            if any(s.get(f"{name}_mean_periodic") is not None for name in ("u_source", "f_el")):
                out += ["last period: the mean over it; rms and ripple (max - min) are those of the last period, too"]
            if "u_gap_amplitude" in s:
                lead = (s["u_gap_phase_deg"] - s["u_source_phase_deg"] + 180.0) % 360.0 - 180.0
                share = s["u_gap_amplitude"] / s["u_source_amplitude"] if s["u_source_amplitude"] else math.nan
                told = f"at {format_si(s['fundamental'], 'Hz')}: gap voltage {format_si(s['u_gap_amplitude'], 'V')}"
                out += ["", f"{told}, {100.0 * share:.2f} % of the source, leading by {lead:.2f} deg"]
        of = "gap" if self.gaps else "layer" if self.layers else "capacitor"
        told = f"estimated error: {of} voltage {error.u_gap:.2g} V"
        told = f"{told}, force {error.f_el:.2g} N" if self.gaps else f"no GAP, no forces; {told}"
        out += self._measures_shown()
        out += ["", told if error.v_nodes is None else f"{told}, node voltages {error.v_nodes:.2g} V"]
        if s.get("figures_from") == "outputs":
            out.append("figures are those of the outputs: what lies between them is not known")
        if self.charge_law == "mobile" and "fold_margin_min" in s:
            out.append(f"distance to the fold: {s['fold_margin_min']:.3g} at least (1 far, 0 at the fold)")
        out.append(f"status: {self.message}")
        if self.failure is not None and self.failure.tried:
            out += ["", "last steps tried:", self.failure.history()]
        return Page(out)

    @property
    def message(self) -> str:
        """How the run ended, in words."""
        return self.status.cause if self.failure is None else str(self.failure)

    @property
    def success(self) -> bool:
        """Whether the run reached its end with the error met."""
        return self.status is Status.SUCCESS

    def _figure(self, key: str, kind: str) -> Value:
        """A figure of a signal, as in `summary`: a number, an array of several gaps or sources, or None."""
        values = [self._one(name, kind) for name in self.record.names(key)]
        if len(values) < 2:
            return values[0] if values else None
        return None if None in values else read_only(np.array(values, float))

    def _one(self, name: str, kind: str) -> float | None:
        if self.stored is not None:
            return self.stored.get(f"{name}_{kind}")
        return self.remember((name, kind), lambda: self._made(name, kind))

    def _made(self, name: str, kind: str) -> float | None:
        kind, periodic, _ = kind.partition("_periodic")
        span = self._last if periodic or kind in ("ripple", "amplitude", "phase_deg") else self._whole
        if span is None:
            return None
        if kind in ("mean", "rms"):
            return span.weigh(name).mean() if kind == "mean" else math.sqrt(span.weigh(name).mean(2))
        if kind in ("amplitude", "phase_deg"):
            if self.fundamental is None:
                return None
            p = span.weigh(name).phasor(self.fundamental.frequency)
            return abs(p) if kind == "amplitude" else math.degrees(cmath.phase(p))
        (_, low), (_, high) = self.remember((name, span is self._whole), lambda: span.extremes(name))
        figures: dict[str, float] = {"min": low, "max": high, "peak": max(high, -low), "ripple": high - low}
        return figures[kind]

    def slide(self, speed: Waveform | float | Callable[[float], float]) -> Solution:
        """The same run with its fingers sliding at a speed: a waveform, a number or a function of time (s), in m/s.

        Friction with a ``slip`` of the GAP follows at this speed in place of its ``v``: F_t' = (v / slip) (F_c - F_t).

        Raises
        ------
        InputError
            If no GAP has a slip, the speed is below 0, or the run is not known between its outputs from its start on.
        """
        from fingerspice.results.slide import slid

        return slid(self, as_waveform(speed))

    def _stretch(self, since: float, until: float) -> Stretch | None:
        """The run between two times (s); None where it is not known between its outputs."""
        run = None if self.continuous is None else self.continuous.run(self._shown, since, until)
        return None if run is None else Stretch(run, since, until, self.rtol)

    @cached_property
    def _whole(self) -> Stretch | Outputs | None:
        """The run from TSTART to its end; None where there are no outputs."""
        return self._stretch(self.first, self.t_stop) or (None if self.t.size < 2 else Outputs(self.record))

    @cached_property
    def _last(self) -> Stretch | Outputs | None:
        """The last period of the source; None where the run holds none."""
        if self.period is None or not self.t.size:
            return None
        since = self.t_stop - self.period
        if self.continuous is None or since < self.first - 1e-9 * self.period:
            return self._last_outputs
        if since <= self.first + 1e-9 * self.period:
            return self._whole
        return self._stretch(since, self.t_stop) or self._last_outputs

    @cached_property
    def _last_outputs(self) -> Outputs | None:
        """The outputs of the source's last period; None where they are too few."""
        assert self.period is not None
        start, tolerance = float(self.t[-1] - self.period), 1e-9 * self.period
        too_few = start < self.t[0] - tolerance or np.count_nonzero(self.t >= start) < 8
        return None if too_few else Outputs(self.record, start, tolerance)

    def _between(self) -> tuple[list[str], FloatArray] | None:
        """Names of signals, and a table of times (s) and these signals at the nodes of the last period's panels.

        None where the run is not known between its outputs, or the table is larger than `MOST_BETWEEN`.
        """
        names = [name for key in _BETWEEN for name in self.record.names(key)]
        if not isinstance(self._last, Stretch) or self._last.panels.shape[1] * NODES * len(names) > MOST_BETWEEN:
            return None
        t, *columns = self._last.at_nodes(names, _MISSED)
        # Steps that stand for equal periods have the times of the one that was integrated.
        assert self.period is not None
        t = t + self.period * np.maximum(np.ceil((self._last.span[0] - t[:, :1]) / self.period - 1e-9), 0.0)
        table = np.column_stack([x.ravel() for x in (t, *columns)])
        return (names, table) if table.size <= MOST_BETWEEN else None

    @cached_property
    def _shown(self) -> tuple[str, ...]:
        """Names of the signals in the summary: of gaps, or else of all layers, or else of all nodes."""
        of_gaps = ("u_gap", "area", "f_el", "f_t", "friction", "a_real")
        keys = of_gaps if self.gaps else ("u_layer" if self.layers else "v", "area")
        return tuple(name for key in ("u_source", *keys) for name in self.record.names(key))

    def summary(self) -> dict[str, Any]:
        """Figures of the run: peak, rms, mean, ripple, amplitude and phase at the fundamental; SI units.

        Figures are computed from the run itself, from TSTART to its end, whatever outputs were asked for;
        ``figures_from`` is then ``"steps"``. It is ``"outputs"`` where the run between its outputs is not known,
        because a method does not record it, the run failed, or it is too long: means are then integrals of cubics
        through the outputs, and extremes are those of the outputs. `f_el_mean` is the mean over the whole run, and
        `f_el_mean_periodic` the mean over the last period of the source; figures of a period are None where the run is
        shorter. A circuit without GAP has figures of its layer voltages (``u_layer:Xcoat_max``) instead.
        """
        if self.stored is not None:
            return dict(self.stored)
        out: dict[str, Any] = {"t_stop": float(self.t[-1]) if self.t.size else None, "status": self.status.name}
        out |= {f"error_{k}": v for k, v in vars(self.error).items()}
        if self._whole is None:
            return out
        out["figures_from"] = "steps" if isinstance(self._whole, Stretch) else "outputs"
        for name in self._shown:
            kinds = ["max", "min", "peak", "mean", "rms", "mean_periodic"]
            kinds += ["ripple" if signal_of(name).ripple else "rms_periodic"] if self._last is not None else []
            out |= {f"{name}_{kind}": self._one(name, kind) for kind in kinds}
        if self._last is not None and self.fundamental is not None:
            for name in (name for name in ("u_source", "u_gap") if name in self._shown):
                out |= {f"{name}_{kind}": self._one(name, kind) for kind in ("amplitude", "phase_deg")}
            out["fundamental"] = self.fundamental.frequency
        if self.gaps:
            out["fold_margin_min"] = min(self.fold_margin_min, float(self.fold_margin.min(initial=1.0)))
        return out

    def provenance(self) -> dict[str, str]:
        """The data needed to repeat the run, as text."""
        from fingerspice import __version__

        circuit, error = self.circuit, self.error
        return {
            "program": f"fingerspice {__version__}", "title": circuit.title, "file": str(circuit.path or ""),
            "deck": circuit.text, "overrides": json.dumps(dict(circuit.overrides)),
            "sets": json.dumps({n: {path: repr(x) for path, x in s.items()} for n, s in circuit.sets.items()}),
            "charge_law": self.charge_law, "area": self.area_mode, "method": self.method, "rtol": repr(self.rtol),
            "error_u_gap_V": repr(error.u_gap), "error_f_el_N": repr(error.f_el),
            "error_q_source_C": repr(error.q_source), "error_v_nodes_V": repr(error.v_nodes),
            "status": self.status.name, "message": self.message, "measures": json.dumps(self.measures),
        }  # fmt: skip

    def to_csv(self, path: str | Path) -> Path:
        """Write every signal, or those of the deck's `.save`, as CSV with names and units in the header.

        A jump has both its rows.

        Raises
        ------
        InputError
            Where the folder cannot be written.
        """
        columns = saved_columns(self)
        header = ["t [s]", *(f"{name} [{unit}]" for name, (_, unit) in columns.items())]
        table = np.column_stack([self.t, *(value for value, _ in columns.values())])
        return write_csv(path, header, (row.tolist() for row in table))

    def to_xarray(self, *, jumps: str = "right") -> xarray.Dataset:
        """The run as an xarray Dataset with units and provenance.

        Signals of several GAPs have the dimension ``gap`` besides ``time``, and those of several sources ``source``;
        layer voltages have ``layer`` and node voltages ``node``.

        Parameters
        ----------
        jumps : str
            ``"right"``: times are unique, with the right-hand value at a jump; ``"both"``: as in the arrays.

        Raises
        ------
        InputError
            For another value of `jumps`.
        """
        import xarray

        data, coords = variables(self, kept_rows(self, jumps))
        return xarray.Dataset(data, coords=coords, attrs=self.provenance())

    def to_dataframe(self, *, jumps: str = "right") -> pandas.DataFrame:
        """The run as a pandas DataFrame: a row for each time (s, the index), a column for each of `signals`.

        Parameters
        ----------
        jumps : str
            As in `to_xarray`.

        Raises
        ------
        InputError
            For another value of `jumps`.
        """
        import pandas

        keep = kept_rows(self, jumps)
        index = pandas.Index(self.t[keep], name="time")
        return pandas.DataFrame({name: x[keep] for name, (x, _, _) in self.signals.items()}, index=index)

    def to_raw(self, path: str | Path) -> Path:
        """Write the run as a raw file of SPICE (binary, doubles): nodes, sources' currents, devices' own signals."""
        from fingerspice.results.rawfile import write_raw

        return write_raw(self, Path(path))

    def to_netcdf(self, path: str | Path, *, jumps: str = "right") -> Path:
        """Write `to_xarray` as a NetCDF file, without the cost of loading xarray; `fs.load` reads it back.

        The file also has the circuit, with up to 8 million samples of its sources (64 MB), and the last period between
        the outputs, up to 2 million numbers (16 MB), beyond which a loaded run's lines are those of its outputs.

        Raises
        ------
        InputError
            Where the folder cannot be written, or for another value of `jumps`.
        """
        from fingerspice.results.runfile import write_netcdf

        return write_netcdf(self, Path(path), jumps)

    def spectrum(
        self, signal: str = "f_t", *, method: str = "auto", highest: float | None = None,
        resolution: float | None = None, since: float | None = None,
    ) -> Spectrum:  # fmt: skip
        """Spectrum of a signal: lines where the source is periodic, else a density by Welch's method.

        The lines are Fourier integrals over the last period of the source, whatever outputs were asked for; the density
        is that of the outputs, with Hann windows that overlap by half.

        Parameters
        ----------
        signal : str
            A key of `signals`; the friction force by default.
        method : str
            ``"auto"``, ``"lines"`` or ``"welch"``.
        highest : float, optional
            Frequency up to which the spectrum goes, Hz; by default 1000 lines, or half the rate of the outputs.
        resolution : float, optional
            Width of the density's bins, Hz; by default that of 8 segments.
        since : float, optional
            Start of the outputs used for a density, s; the first output by default.

        Raises
        ------
        InputError
            For an unknown signal, a signal of several elements, or a value out of range; for ``"lines"`` of a run
            without a whole period, and for a density of outputs that are too few or not evenly spaced.
        """
        from fingerspice.results.spectrum import spectrum_of

        return spectrum_of(self, signal, method, highest, resolution, since)

    def plot(
        self, signals: str | Sequence[str] | None = None, *, window: tuple[float, float] | None = None,
        others: Solution | Sequence[Solution] | Mapping[str, Solution] = (),
    ) -> Figure:  # fmt: skip
        """Draw signals against time: a notebook shows the figure, and from a script ``plot().show()`` opens a window.

        ``plot().savefig("x.pdf")`` saves it. More than about 30 oscillations are drawn as envelopes, and a second
        column shows the last few of them enlarged; it also shows a short event enlarged.

        Parameters
        ----------
        signals : str or sequence of str, optional
            Keys of `signals`, such as ``"f_el"``, ``"u_layer:Xcoat"``, or ``"u_layer"`` for all layers; signals of the
            same quantity share a panel. The default is source and gap voltage, force, area and friction.
        window : tuple of float, optional
            Start and end, s; the whole run by default.
        others : Solution, sequence or mapping of str to Solution, optional
            Runs to draw over this one; without names they are called by the facts in which they differ.

        Raises
        ------
        InputError
            For an unknown signal, or a window without outputs.
        """
        from fingerspice.plots.traces import plot_solution

        return plot_solution(self, signals, window, others)

    def explore(self) -> Any:
        """Show the circuit as it was run on a local page, as `fs.explore` does, whose `Explorer` it gives."""
        from fingerspice.explorer import explore

        return explore(self)

    def sample_gradient(self, **of: ArrayLike) -> SampleGradient:
        """Derivatives of a number that follows from this run by every sample of its source (docs/sensitivities.md).

        For ``J = sum((run.f_t - wanted) ** 2)`` that is ``run.sample_gradient(f_t=2.0 * (run.f_t - wanted))``. The run
        has one GAP whose area follows its voltage, under one recording: `Samples`, or a PWL on an even grid. One way
        back through the run's steps gives the derivatives by all samples.

        Parameters
        ----------
        **of : array_like
            Derivatives of J by signals of the run, shape (n_t,): ``u_gap``, ``area``, ``f_el``, ``f_t``, ``friction``;
            and by its means, numbers: ``area_mean``, ``f_el_mean``, ``f_t_mean``, ``friction_mean``.

        Raises
        ------
        InputError
            For another circuit, source or run, or an unknown signal.
        SolveError
            If the run cannot be followed sample by sample.
        """
        from fingerspice.solve.derivatives import sample_gradient

        return sample_gradient(self, of)

    def cite(self) -> Citation:
        """What to cite for this run: the model's paper, the program, and the sets of parameters that were applied.

        ``print`` shows the text and the BibTeX, which is also in `Citation.bibtex`.
        """
        from fingerspice.sets import cite

        return cite(self.circuit, self.method)


def _row(name: str, s: dict[str, Any]) -> tuple[str, ...]:
    """Name and figures of a signal, as the table has them."""
    key, _, element = name.partition(":")
    signal = signal_of(name)
    label = {"u_layer": f"{element} voltage", "v": f"node {element}", "friction": f"friction coefficient {element}"}
    cells = [label.get(key, f"{signal.text} {element}").rstrip()]
    for kind in _COLUMNS.values():
        if (value := s.get(f"{name}_{kind}")) is None:
            cells.append("-")
            continue
        # A mean that is 0 to round-off is written as 0.
        value = 0.0 if abs(value) <= 1e-12 * s[f"{name}_peak"] else value
        cells.append(amount_text(value, signal.unit))
    return tuple(cells)
