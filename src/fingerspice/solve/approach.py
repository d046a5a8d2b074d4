"""Periods on the way to the periodic state: near it, one affine map gives them all, and they need no steps.

With x the live voltages at the start of a period, x' those at its end and y(t) its outputs,

    x' = x_b' + S (x - x_b),    y(s) = y_b(s) + D(s) (x - x_b)

up to the square of the distance between x and x_b, where s counts from one zero of the gap voltage or edge of the
source to the next: a zero moves with x, and what is not smooth there moves with it. Period x_b is where the run will be
at its end; S and D are differences of neighbouring periods, and what the map misses where the run stands now is its
error at worst.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.engine import march, readout
from fingerspice.engine import repeat as repetition
from fingerspice.engine.network import Sources
from fingerspice.numerics.lobatto import NODES, POINTS, TO_SERIES
from fingerspice.results.steps import Leap, Recorder
from fingerspice.solve.settling import Settling
from fingerspice.solve.stepping import FINEST, KEPT_STEPS, SAFETY
from fingerspice.solve.track import Track

# Tolerance of its steps, over that of others: what it is off is off in every period that is made of it.
_FINER = 0.01
# Steps of a period over those of another.
_ROOM = 4
# What a leap is taken to be off, over what is allowed, if a period on its way could not be integrated.
_LOST = 10.0
# Periods that start nearer to one another than that, over what is allowed, are the same.
_STILL = 1e-3


class _LostError(Exception):
    """A period could not be integrated, or is not like the others."""


@dataclass(frozen=True)
class _Period:
    """A period that has been integrated.

    Attributes
    ----------
    track : Track
        As the period has left it; its charge is what the period has added.
    marks : ndarray, shape (n_step + 1,)
        Where its steps begin and end, s.
    fixed : ndarray of float, shape (n_step + 1,)
        What stands there: AT_ZERO, AT_EDGE or 0.
    """

    track: Track
    marks: FloatArray
    fixed: FloatArray

    @property
    def off(self) -> FloatArray:
        """Estimated error of the live voltages at its end, by its own steps, V."""
        error = self.track.error
        return np.asarray(self.track.prepared.system.live[int(error[-1])] @ error[:-1])

    def series(self, marks: FloatArray) -> FloatArray:
        """Chebyshev coefficients (n_step, n_column, ROWS) of the outputs between marks (s) of a period."""
        t = marks[:-1, None] + np.diff(marks)[:, None] * POINTS[:NODES]
        t[:, -1] = marks[1:]
        left = np.zeros(t.shape, bool)
        left[:, -1] = True
        out = np.empty((self.track.out.shape[0], t.size))
        kept, count = self.track.kept, self.marks.size - 1
        # Its steps' series are used up by that.
        if repetition.repeat(kept, count, 0.0, 1, np.zeros(len(out)), 0, t.ravel(), left.ravel(), out) < t.size:
            raise _LostError
        return np.ascontiguousarray(out.reshape(-1, *t.shape).swapaxes(0, 1) @ TO_SERIES)

    def marks_like(self, other: _Period) -> FloatArray:
        """Marks of this period that stand to its zeros and edges as those of another stand to its own, s."""
        mine, its = self.marks[self.fixed > 0.0], other.marks[other.fixed > 0.0]
        if not np.array_equal(self.fixed[self.fixed > 0.0], other.fixed[other.fixed > 0.0]):
            raise _LostError
        return np.interp(other.marks, its, mine)


def _period(track: Track, sources: Sources, stop: float, x: FloatArray, steps: int = KEPT_STEPS) -> _Period:
    """A period of so many steps at most from live voltages x on, integrated to `stop` (s) by a copy of the track."""
    probe = copy.copy(track)
    probe.y = np.append(x, 0.0)
    probe.error, probe.control, probe.tried = np.zeros_like(track.error), track.control.copy(), track.tried.copy()
    probe.error[-1] = track.error[-1]
    probe.counters = np.zeros_like(track.counters)
    finest = FINEST * float(track.control[readout.PEAK_U])
    probe.pace = track.pace._replace(tol=max(_FINER * track.pace.tol, finest))
    probe.recorder = Recorder(track.shown, 0)
    probe.t_out, probe.left, probe.out = np.zeros(0), np.zeros(0, bool), np.empty((track.out.shape[0], 0))
    probe.keep(steps)
    code = probe.advance(sources, stop)
    track.counters[: readout.OUTPUT] += probe.counters[: readout.OUTPUT]
    if code != march.DONE or not probe.keeps_all:
        raise _LostError
    times = probe.kept.times[: int(probe.counters[readout.KEPT])]
    return _Period(probe, np.append(times[:1, 0], times[:, 2]), np.append(repetition.AT_EDGE, times[:, 3]))


def _moved(slope: FloatArray, shift: FloatArray, periods: int) -> FloatArray:
    """Sum over i < periods of slope^i shift."""
    n = shift.size
    return np.asarray(np.linalg.matrix_power(np.block([[slope, shift[:, None]], [np.zeros(n), 1.0]]), periods)[:n, n])


def leap(track: Track, sources: Sources, settling: Settling) -> None:
    """Let the periods that follow come from one map, if its error allows it; see `Settling.may_leap`."""
    stop = settling.snapped(sources.edges, track.t + settling.period)
    if stop > sources.edges[-1]:
        return
    try:
        _leap(track, sources, settling, stop)
    except _LostError:
        settling.stumbled(_LOST)


def _leap(track: Track, sources: Sources, settling: Settling, stop: float) -> None:
    left = settling.periods_left(track.t)
    x0 = track.y[:-1].copy()
    n = x0.size
    here = _period(track, sources, stop, x0)
    series_here, end = here.series(here.marks), here.track.y
    slope = np.empty((n + 1, n))
    marks_by = np.empty((here.marks.size, n))
    by = np.empty((n, *series_here.shape))
    offs = []
    room = _ROOM * len(series_here)
    for k in range(n):
        x = x0.copy()
        x[k] += settling.probe
        probe = _period(track, sources, stop, x, room)
        offs.append(probe.off)
        marks = probe.marks_like(here)
        slope[:, k] = (probe.track.y - end) / settling.probe
        marks_by[:, k] = (marks - here.marks) / settling.probe
        by[k] = (probe.series(marks) - series_here) / settling.probe
    base_x = x0 + _moved(slope[:n], end[:n] - x0, left)
    base = _period(track, sources, stop, base_x, room)
    marks = base.marks_like(here)
    series = base.series(marks)
    # What the map misses where the run stands.
    delta = x0 - base_x
    missed = end - base.track.y - slope @ delta
    marks_missed = here.marks - marks - marks_by @ delta
    missed_series = series_here - series - np.tensordot(delta, by, 1)
    # A polynomial is nowhere larger than the sum of its coefficients.
    off = float(np.abs(missed_series[:, : track.shown]).sum(axis=-1).max(initial=0.0))
    steepest = np.abs(series[:, : track.shown]) @ np.arange(series.shape[-1]) * 2.0 / np.diff(marks)[:, None]
    late = float((steepest.max(axis=1) * np.maximum(abs(marks_missed[1:]), abs(marks_missed[:-1]))).max())
    later = max(float(np.abs(missed[:n]).max()), float(np.abs(_moved(slope[:n], missed[:n], left)).max()))
    slowest = np.abs(np.linalg.eigvals(slope[:n]))
    slowest = float(slowest[slowest < 1.0 - 1e-9].max(initial=0.0))
    # What the map misses of a period's charge goes with the square of the distance.
    owed = abs(float(missed[n])) * min(left, 1.0 / (1.0 - slowest**2))
    # What steps are off goes into the map, and is collected for as long as it is remembered.
    noise = base.off + (np.array(offs) - here.off).T @ (delta / settling.probe)
    later += SAFETY * max(float(np.abs(noise).max()), float(np.abs(_moved(slope[:n], noise, left)).max()))
    still = _STILL * settling.allowed
    error = max(float(track.control[readout.MAGNIFIED]) * (later + still) + off + late, owed / track.capacitance)
    if not error <= settling.allowed:
        settling.stumbled(error / settling.allowed)
        return
    state = np.append(x0, track.y[n])
    shown = slice(0, track.shown)
    track.recorder.drain(track.counters)
    track.recorder.parts.append(Leap(
        marks, marks_by, series[:, shown].copy(), by[:, :, shown].copy(), slope, base_x, base.track.y.copy(),
        x0.copy(), still, settling.period, left,
    ))  # fmt: skip
    track.counters[readout.OUTPUT] = repetition.approach(
        marks, marks_by, series, by, slope, base_x, base.track.y, state, track.shown, still,
        settling.period, left, int(track.counters[readout.OUTPUT]), track.t_out, track.left, track.out,
    )  # fmt: skip
    control, before = base.track.control, here.track.control
    for peak in (readout.PEAK_U, readout.PEAK_F, readout.PEAK_Q, readout.ERROR_U, readout.ERROR_F, readout.ERROR_V):
        control[peak] = max(control[peak], before[peak])
    control[readout.MARGIN] = min(control[readout.MARGIN], before[readout.MARGIN])
    track.land(base.track, state, left, error, owed)
    settling.leapt(left, state[:n])
