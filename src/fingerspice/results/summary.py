"""Figures of a run: means, peaks and amplitudes of its signals, each computed on first use; and their table."""

from __future__ import annotations

import cmath
import math
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray, read_only
from fingerspice.base.pages import Page, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.describe import head_lines
from fingerspice.numerics.lobatto import NODES
from fingerspice.results.record import attribute, signal_of
from fingerspice.results.steps import Outputs, Stretch

if TYPE_CHECKING:
    from fingerspice.results.solution import Solution

Value = float | FloatArray | None

MOST_BETWEEN = 2_000_000  # Most numbers of the last period between the outputs that a file keeps (16 MB)
# The signals in it, and how far they may be from their polynomials, relative to their peaks.
_BETWEEN, _MISSED = ("u_source", "u_layer", "v", "u_gap", "area", "f_el", "fold_margin"), 1e-10
#: Signals that have rows in the table, in their order, and its columns of figures: heading and key.
_ROWS = ("u_source", "u_gap", "u_layer", "v", "f_el", "f_t", "friction", "area")
_COLUMNS = {
    "min": "min", "max": "max", "mean": "mean", "last period": "mean_periodic", "rms": "rms_periodic",
    "ripple": "ripple",
}  # fmt: skip


class Figures:
    """Figures of a solution, each computed on first use and cached, or those that its file holds."""

    def __init__(self, solution: Solution) -> None:
        self.solution = solution
        self._kept: dict[str, Any] = dict(solution.stored or {})
        self._extremes: dict[tuple[str, bool], tuple[float, float]] = {}

    def value(self, key: str, kind: str) -> Value:
        """A figure of a kind that `_made` knows: a number, an array of several gaps or sources, or None."""
        values = [self._one(name, kind) for name in self.solution.record.names(key)]
        if len(values) < 2:
            return values[0] if values else None
        return None if None in values else read_only(np.array(values, float))

    def _one(self, name: str, kind: str) -> float | None:
        key = f"{name}_{kind}"
        if key not in self._kept and self.solution.stored is None:
            self._kept[key] = self._made(name, kind)
        return self._kept.get(key)

    def _made(self, name: str, kind: str) -> float | None:
        kind, periodic, _ = kind.partition("_periodic")
        span = self.last if periodic or kind in ("ripple", "amplitude", "phase_deg") else self.whole
        if span is None:
            return None
        if kind in ("mean", "rms"):
            return span.weigh(name).mean() if kind == "mean" else math.sqrt(span.weigh(name).mean(2))
        if kind in ("amplitude", "phase_deg"):
            if self.solution.fundamental is None:
                return None
            p = span.weigh(name).phasor(self.solution.fundamental.frequency)
            return abs(p) if kind == "amplitude" else math.degrees(cmath.phase(p))
        key = name, span is self.whole
        if key not in self._extremes:
            self._extremes[key] = span.extremes(name)
        low, high = self._extremes[key]
        figures: dict[str, float] = {"min": low, "max": high, "peak": max(high, -low), "ripple": high - low}
        return figures[kind]

    def _between(self, since: float, until: float) -> Stretch | None:
        """The run between two times (s); None where it is not known between its outputs."""
        continuous = self.solution.continuous
        run = None if continuous is None else continuous.run(self.shown, since, until)
        return None if run is None else Stretch(run, since, until, self.solution.rtol)

    @cached_property
    def whole(self) -> Stretch | Outputs | None:
        """The run from TSTART to its end; None where there are no outputs."""
        s = self.solution
        return self._between(s.first, s.t_stop) or (None if s.t.size < 2 else Outputs(s.record))

    @cached_property
    def last(self) -> Stretch | Outputs | None:
        """The last period of the source; None where the run holds none."""
        s = self.solution
        if s.period is None or not s.t.size:
            return None
        since = s.t_stop - s.period
        if s.continuous is None or since < s.first - 1e-9 * s.period:
            return self.last_outputs
        if since <= s.first + 1e-9 * s.period:
            return self.whole
        return self._between(since, s.t_stop) or self.last_outputs

    @cached_property
    def last_outputs(self) -> Outputs | None:
        """The outputs of the source's last period; None where they are too few."""
        s = self.solution
        assert s.period is not None
        tolerance = 1e-9 * s.period
        start = float(s.t[-1] - s.period)
        if start < s.t[0] - tolerance or np.count_nonzero(s.t >= start) < 8:
            return None
        first, after = (int(i) for i in np.searchsorted(s.t, [start - tolerance, start + tolerance], side="right"))
        # Of two outputs at a jump, the period starts with the right-hand one.
        return Outputs(s.record, after - 1) if abs(s.t[first] - start) <= tolerance else Outputs(s.record, first, start)

    def between(self) -> tuple[list[str], FloatArray] | None:
        """Names of signals, and a table of times (s) and these signals at the nodes of the last period's panels.

        None where the run is not known between its outputs, or the table is larger than `MOST_BETWEEN`.
        """
        names = [name for key in _BETWEEN for name in self.solution.record.names(key)]
        if not isinstance(self.last, Stretch) or self.last.panels.shape[1] * NODES * len(names) > MOST_BETWEEN:
            return None
        t, *columns = self.last.at_nodes(names, _MISSED)
        # Steps that stand for equal periods have the times of the one that was integrated.
        period = self.solution.period
        assert period is not None
        t = t + period * np.maximum(np.ceil((self.last.span[0] - t[:, :1]) / period - 1e-9), 0.0)
        table = np.column_stack([x.ravel() for x in (t, *columns)])
        return (names, table) if table.size <= MOST_BETWEEN else None

    @cached_property
    def shown(self) -> tuple[str, ...]:
        """Names of the signals in the summary: of gaps, or else of all layers, or else of all nodes."""
        of_gaps = ("u_gap", "area", "f_el", "f_t", "friction")
        keys = of_gaps if self.solution.record.gaps else ("u_layer" if self.solution.record.layers else "v", "area")
        return tuple(name for key in ("u_source", *keys) for name in self.solution.record.names(key))

    def summary(self) -> dict[str, Any]:
        """As `Solution.summary` says."""
        s, one = self.solution, self._one
        if s.stored is not None:
            return dict(s.stored)
        out: dict[str, Any] = {"t_stop": float(s.t[-1]) if s.t.size else None, "status": s.status.name}
        out |= {f"error_{k}": v for k, v in vars(s.error).items()}
        if self.whole is None:
            return out
        out["figures_from"] = "steps" if isinstance(self.whole, Stretch) else "outputs"
        for name in self.shown:
            kinds = ["max", "min", "peak", "mean", "rms", "mean_periodic"]
            kinds += ["ripple" if signal_of(name).ripple else "rms_periodic"] if self.last is not None else []
            out |= {f"{name}_{kind}": one(name, kind) for kind in kinds}
        if self.last is not None and s.fundamental is not None:
            for name in (name for name in ("u_source", "u_gap") if name in self.shown):
                out |= {f"{name}_{kind}": one(name, kind) for kind in ("amplitude", "phase_deg")}
            out["fundamental"] = s.fundamental.frequency
        if self.solution.record.gaps:
            out["fold_margin_min"] = min(s.fold_margin_min, float(s.fold_margin.min(initial=1.0)))
        return out

    def page(self) -> Page:
        """The figures as a table, and below it errors, the distance to the fold, and how the run ended."""
        run, s, error = self.solution, self.summary(), self.solution.error
        end = format_si(float(run.t[-1]), "s") if run.t.size else "nothing"
        how = f"charge law {run.charge_law}, area {run.area_mode}, method {run.method}, rtol {run.rtol:g}"
        out: list[str | Table] = [*head_lines(run.circuit), f"{end} simulated; {how}", ""]
        if run.t.size >= 2:
            names = [name for key in _ROWS for name in self.solution.record.names(key) if f"{name}_max" in s]
            out.append(Table(("", *_COLUMNS), [_row(name, s) for name in names]))
            if any(s.get(f"{name}_mean_periodic") is not None for name in ("u_source", "f_el")):
                out += ["last period: the mean over it; rms and ripple (max - min) are those of the last period, too"]
            if "u_gap_amplitude" in s:
                lead = (s["u_gap_phase_deg"] - s["u_source_phase_deg"] + 180.0) % 360.0 - 180.0
                share = s["u_gap_amplitude"] / s["u_source_amplitude"] if s["u_source_amplitude"] else math.nan
                told = f"at {format_si(s['fundamental'], 'Hz')}: gap voltage {format_si(s['u_gap_amplitude'], 'V')}"
                out += ["", f"{told}, {100.0 * share:.2f} % of the source, leading by {lead:.2f} deg"]
        of = "gap" if run.gaps else "layer" if run.layers else "capacitor"
        told = f"estimated error: {of} voltage {error.u_gap:.2g} V"
        told = f"{told}, force {error.f_el:.2g} N" if run.gaps else f"no GAP, no forces; {told}"
        out += ["", told if error.v_nodes is None else f"{told}, node voltages {error.v_nodes:.2g} V"]
        if s.get("figures_from") == "outputs":
            out.append("figures are those of the outputs: what lies between them is not known")
        if run.charge_law == "mobile" and "fold_margin_min" in s:
            out.append(f"distance to the fold: {s['fold_margin_min']:.3g} at least (1 far, 0 at the fold)")
        out.append(f"status: {run.message}")
        if run.failure is not None and run.failure.tried:
            out += ["", "last steps tried:", run.failure.history()]
        return Page(out)


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
        # An area takes no prefix, which would be squared with its unit, and a coefficient has none.
        plain = {"m^2": f"{1e6 * value:.4g} mm^2", "1": f"{value:.4g}"}
        cells.append(plain.get(signal.unit) or format_si(value, signal.unit))
    return tuple(cells)


def figure(key: str, kind: str, doc: str) -> Value:
    """A property of a result that has `_figures`: a figure of a signal."""
    return attribute(lambda result: result._figures.value(key, kind), doc=doc)  # type: ignore[no-any-return]


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
    u_gap_peak = figure("u_gap", "peak", "Largest modulus of the gap voltage, V.")
    u_gap_rms = figure("u_gap", "rms", "Root of the mean square of the gap voltage over the run, V.")
    u_gap_amplitude = figure(
        "u_gap", "amplitude", "Amplitude of `u_gap` at the fundamental, over the last period, V; None without one."
    )
    u_gap_phase_deg = figure("u_gap", "phase_deg", "Phase of `u_gap` at the fundamental, relative to a sine, degrees.")
