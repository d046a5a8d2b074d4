"""Figures of a run: means, peaks and amplitudes of its signals, each computed on first use and cached."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.numerics.lobatto import NODES
from fingerspice.results.measures import Stretch, Weighed, weigh_outputs
from fingerspice.results.record import sealed
from fingerspice.results.signals import AnyRecord, Signals

if TYPE_CHECKING:
    from fingerspice.results.solution import Solution

Value = float | FloatArray | None

#: Most numbers of the last period between the outputs that a file keeps (16 MB).
MOST_BETWEEN = 2_000_000
# The signals in it, and how far they may be from their polynomials, relative to their peaks.
_BETWEEN, _MISSED = ("u_source", "u_layer", "v", "u_gap", "area", "f_el", "fold_margin"), 1e-10
# Signals whose summary has a ripple instead of an rms.
_RIPPLE = ("area", "f_el", "f_t", "friction")


def _read(name: str, record: AnyRecord) -> FloatArray:
    return Signals(record).one(name)


class Span(Protocol):
    """A part of a run, from which figures are computed."""

    def weigh(self, name: str) -> Weighed:
        """A signal with its weights."""

    def extremes(self, name: str) -> tuple[float, float]:
        """Smallest and largest value of a signal."""


class _Steps:
    """A part of a run whose signals are known between the outputs."""

    def __init__(self, stretch: Stretch) -> None:
        self.stretch = stretch

    def weigh(self, name: str) -> Weighed:
        return self.stretch.weigh(partial(_read, name))

    def extremes(self, name: str) -> tuple[float, float]:
        return self.stretch.extremes(partial(_read, name))


class _Outputs:
    """Outputs from number `first` on; if a time `start` (s) is given, interpolated values there come first."""

    def __init__(self, t: FloatArray, signals: Signals, first: int = 0, start: float | None = None) -> None:
        self.t, self.signals, self.first, self.start = t, signals, first, start

    def _values(self, name: str) -> tuple[FloatArray, FloatArray]:
        t, x = self.t, self.signals.one(name)
        if self.start is None:
            return t[self.first :], x[self.first :]
        return np.append(self.start, t[self.first :]), np.append(np.interp(self.start, t, x), x[self.first :])

    def weigh(self, name: str) -> Weighed:
        return weigh_outputs(*self._values(name))

    def extremes(self, name: str) -> tuple[float, float]:
        _, x = self._values(name)
        return float(x.min()), float(x.max())


class Figures:
    """Figures of a solution, each computed on first use and cached."""

    def __init__(self, solution: Solution) -> None:
        self.solution = solution
        self.signals = solution.all_signals
        self._kept: dict[tuple[str, str], Any] = {}

    def value(self, key: str, kind: str) -> Value:
        """A figure of a signal: one number, an array where several gaps or sources have it, or None.

        `kind` is mean, rms, min, max, peak, ripple, amplitude, phase_deg, or one of the first two with ``_periodic``.
        """
        found = self._kept.get((key, kind), self)
        if found is self:
            found = self._kept[key, kind] = _together([self._one(name, kind) for name in self.signals.names(key)])
        return found  # type: ignore[no-any-return]

    def _one(self, name: str, kind: str) -> float | None:
        found = self._kept.get((name, kind), self)
        if found is self:
            found = self._kept[name, kind] = self._made(name, kind)
        return found  # type: ignore[no-any-return]

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
        low, high = self._extremes(name, span)
        return {"min": low, "max": high, "peak": max(high, -low), "ripple": high - low}[kind]

    def _extremes(self, name: str, span: Span) -> tuple[float, float]:
        key = name, f"extremes {span is self.whole}"
        if key not in self._kept:
            self._kept[key] = span.extremes(name)
        return self._kept[key]  # type: ignore[no-any-return]

    @cached_property
    def _readers(self) -> Mapping[str, Callable[[Any], FloatArray]]:
        return {name: partial(_read, name) for name in self.shown}

    def _between(self, since: float, until: float) -> Span | None:
        """The run between two times (s); None where it is not known between its outputs."""
        continuous = self.solution.continuous
        run = None if continuous is None else continuous.run(self._readers, since, until)
        return None if run is None else _Steps(Stretch(run, since, until, self.solution.rtol))

    @cached_property
    def whole(self) -> Span | None:
        """The run from TSTART to its end; None where there are no outputs."""
        s = self.solution
        found = self._between(s.first, s.t_stop)
        return found if found is not None or s.t.size < 2 else _Outputs(s.t, self.signals)

    @cached_property
    def last(self) -> Span | None:
        """The last period of the source; None where the run holds none."""
        s = self.solution
        if s.period is None or not s.t.size:
            return None
        tolerance = 1e-9 * s.period
        since = s.t_stop - s.period
        if s.continuous is not None and since >= s.first - tolerance:
            if since <= s.first + tolerance:
                return self.whole
            found = self._between(since, s.t_stop)
            if found is not None:
                return found
        start = float(s.t[-1] - s.period)
        if start < s.t[0] - tolerance or np.count_nonzero(s.t >= start) < 8:
            return None
        first = int(np.searchsorted(s.t, start - tolerance, side="right"))
        if abs(s.t[first] - start) <= tolerance:
            # Of two outputs at a jump, the period starts with the right-hand one.
            return _Outputs(s.t, self.signals, int(np.searchsorted(s.t, start + tolerance, side="right")) - 1)
        return _Outputs(s.t, self.signals, first, start)

    def last_finely(self, name: str, longest: float) -> tuple[Weighed, bool]:
        """A signal with weights over the last period, and whether it is known between the outputs.

        If it is known, its panels are no longer than `longest` (s), so that the weights also integrate the product of
        the signal with an oscillation of that period.
        """
        assert self.last is not None
        if not isinstance(self.last, _Steps):
            return self.last.weigh(name), False
        coarse = self.last.stretch
        return _Steps(Stretch(coarse.run, *coarse.span, coarse.rtol, longest)).weigh(name), True

    def between(self) -> tuple[list[str], FloatArray] | None:
        """Names of the voltages, areas and forces, and a table of the last period: times (s), then these signals.

        Its rows are the nodes of panels on which all are polynomials. None where the run is not known between its
        outputs, or the table is larger than `MOST_BETWEEN`.
        """
        if not isinstance(self.last, _Steps):
            return None
        coarse = self.last.stretch
        names = [name for key in _BETWEEN for name in self.signals.names(key)]
        if coarse.panels.step.size * NODES * len(names) > MOST_BETWEEN:
            return None
        columns = Stretch(coarse.run, *coarse.span, coarse.rtol).at_nodes([partial(_read, x) for x in names], _MISSED)
        table = np.column_stack([x.ravel() for x in columns])
        return (names, table) if table.size <= MOST_BETWEEN else None

    @cached_property
    def shown(self) -> tuple[str, ...]:
        """Names of the signals in the summary: of gaps, or else of all layers, or else of all nodes."""
        names = self.signals.names
        if self.signals.gaps:
            keys = ("u_source", "u_gap", "area", "f_el", "f_t", "friction")
            return tuple(name for key in keys for name in names(key))
        return (*names("u_source"), *(names("u_layer") or names("v")), *names("area"))

    def summary(self) -> dict[str, Any]:
        """As `Solution.summary` says."""
        s, one = self.solution, self._one
        out: dict[str, Any] = {"t_stop": float(s.t[-1]) if s.t.size else None, "status": s.status.name}
        out.update({f"error_{k}": v for k, v in vars(s.error).items()})
        if self.whole is None:
            return out
        out["figures_from"] = "steps" if isinstance(self.whole, _Steps) else "outputs"
        for name in self.shown:
            kinds = ["max", "min", "peak", "mean", "rms", "mean_periodic"]
            if self.last is not None:
                kinds.append("ripple" if name.partition(":")[0] in _RIPPLE else "rms_periodic")
            out.update({f"{name}_{kind}": one(name, kind) for kind in kinds})
        if self.last is not None and s.fundamental is not None:
            for name in ("u_source", "u_gap"):
                if name in self.shown:
                    out.update({f"{name}_{kind}": one(name, kind) for kind in ("amplitude", "phase_deg")})
            out["fundamental"] = s.fundamental.frequency
        if self.signals.gaps:
            out["fold_margin_min"] = min(s.fold_margin_min, float(s.fold_margin.min(initial=1.0)))
        return out


def _together(values: list[float | None]) -> Value:
    """Figures of several gaps or sources as an array; a single one as a number; None where one is missing."""
    if len(values) < 2:
        return values[0] if values else None
    return None if None in values else sealed(np.array(values, float))


class KeptFigures:
    """Figures that were stored in a run's file, from which they cannot be computed again."""

    def __init__(self, signals: Signals, summary: Mapping[str, Any]) -> None:
        self.signals, self._summary = signals, summary

    def value(self, key: str, kind: str) -> Value:
        """As `Figures.value`."""
        return _together([self._summary.get(f"{name}_{kind}") for name in self.signals.names(key)])

    def summary(self) -> dict[str, Any]:
        """As `Solution.summary` says."""
        return dict(self._summary)


class Figured:
    """A result with figures: each is a number, an array (n_gap,) with several gaps, or None where it does not exist.

    Figures are integrals and extremes of the run itself, not of its outputs.
    """

    @property
    def _figures(self) -> Figures | KeptFigures:
        raise NotImplementedError

    @property
    def f_el_mean(self) -> Value:
        """Mean electroadhesive force over the run, N."""
        return self._figures.value("f_el", "mean")

    @property
    def f_el_mean_periodic(self) -> Value:
        """Mean electroadhesive force over the source's last period, N; None where the run holds none."""
        return self._figures.value("f_el", "mean_periodic")

    @property
    def f_el_peak(self) -> Value:
        """Largest electroadhesive force, N."""
        return self._figures.value("f_el", "peak")

    @property
    def f_t_mean(self) -> Value:
        """Mean friction force over the run, N."""
        return self._figures.value("f_t", "mean")

    @property
    def f_t_mean_periodic(self) -> Value:
        """Mean friction force over the source's last period, N; None where the run holds none."""
        return self._figures.value("f_t", "mean_periodic")

    @property
    def friction_mean(self) -> Value:
        """Mean friction coefficient over the run."""
        return self._figures.value("friction", "mean")

    @property
    def area_mean(self) -> Value:
        """Mean ridge contact area over the run, m^2."""
        return self._figures.value("area", "mean")

    @property
    def u_gap_peak(self) -> Value:
        """Largest modulus of the gap voltage, V."""
        return self._figures.value("u_gap", "peak")

    @property
    def u_gap_rms(self) -> Value:
        """Root of the mean square of the gap voltage over the run, V."""
        return self._figures.value("u_gap", "rms")

    @property
    def u_gap_amplitude(self) -> Value:
        """Amplitude of the gap voltage at the source's fundamental, over its last period, V; None without one."""
        return self._figures.value("u_gap", "amplitude")

    @property
    def u_gap_phase_deg(self) -> Value:
        """Phase of the gap voltage at the source's fundamental, relative to a sine, degrees."""
        return self._figures.value("u_gap", "phase_deg")
