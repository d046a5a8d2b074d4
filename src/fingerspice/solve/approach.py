"""Extrapolation of the period map: near the periodic state one affine map gives all later periods without steps.

With x the live voltages at the start of a period, x' those at its end and y(t) its outputs,

    x' = x_b' + S (x - x_b),    y(s) = y_b(s) + D(s) (x - x_b)

with an error of second order in x - x_b. The variable s counts from one zero of the gap voltage or edge of the source
to the next: a zero moves with x, and so does the kink of y(t) there. The base period x_b is the last period of the run,
predicted by the map itself; S and D are finite differences of neighbouring periods. The run starts farthest from x_b,
so that the map's defect at the present state bounds its error in all later periods.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray, read_only
from fingerspice.engine import loopstate, readout
from fingerspice.engine import repeat as repetition
from fingerspice.engine.network import Sources
from fingerspice.engine.settling import no_looks
from fingerspice.numerics.lobatto import NODES, POINTS, TO_SERIES
from fingerspice.results.steps import Leap, Recorder
from fingerspice.solve.settling import Settling
from fingerspice.solve.stepping import FINEST, KEPT_STEPS, SAFETY
from fingerspice.solve.track import Track
from fingerspice.waveforms.sampling import same_time

# Step tolerance within the integrated periods, relative to the run's: their error recurs in every extrapolated period.
_FINER = 0.01
# Most steps of a perturbed period, relative to the number of steps of the unperturbed one.
_ROOM = 4
# Ratio of error to tolerance assumed for an extrapolation that failed because a period could not be integrated.
_LOST = 10.0
# Periods whose start states differ by less than this fraction of the allowed error are treated as equal.
_STILL = 1e-3


class _LostError(Exception):
    """A period could not be integrated, or its zeros and edges are not those of the other periods."""


@dataclass(frozen=True)
class _Period:
    """A period that has been integrated."""

    track: Track  # The integration at the end of the period; its charge is the charge delivered within the period
    marks: FloatArray  # (n_step + 1,): Limits of the steps, s
    # (n_step + 1,): AT_ZERO or AT_EDGE for a limit at a zero of the gap voltage or at an edge of the source, 0 for any
    # other
    fixed: FloatArray

    @property
    def off(self) -> FloatArray:
        """Error of the live voltages at the end of the period, estimated from the period's own steps, V."""
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
        outputs = readout.Outputs(read_only(t.ravel()), read_only(left.ravel()), out)
        # `repeat` overwrites the steps' series, so that this method can be called only once.
        if repetition.repeat(kept, count, 0.0, 1, np.zeros(len(out)), 0, outputs) < t.size:
            raise _LostError
        return np.ascontiguousarray(out.reshape(-1, *t.shape).swapaxes(0, 1) @ TO_SERIES)

    def marks_like(self, other: _Period) -> FloatArray:
        """Marks of another period, mapped piecewise linearly from its zeros and edges to those of this period, s."""
        mine, its = self.marks[self.fixed > 0.0], other.marks[other.fixed > 0.0]
        if not np.array_equal(self.fixed[self.fixed > 0.0], other.fixed[other.fixed > 0.0]):
            raise _LostError
        return np.interp(other.marks, its, mine)


def _period(track: Track, sources: Sources, stop: float, x: FloatArray, steps: int = KEPT_STEPS) -> _Period:
    """Integrate one period from live voltages x to `stop` (s) in at most `steps` steps, with a copy of the track."""
    probe = copy.copy(track)
    probe.y = np.append(x, 0.0)
    probe.error, probe.control, probe.tried = np.zeros_like(track.error), track.control.copy(), track.tried.copy()
    probe.error[-1] = track.error[-1]
    probe.counters = np.zeros_like(track.counters)
    finest = FINEST * float(track.control[readout.PEAK_U])
    probe.pace = track.pace._replace(tol=max(_FINER * track.pace.tol, finest))
    probe.recorder = Recorder(track.shown, 0)
    probe.t_out, probe.left, probe.out = track.t_out[:0], track.left[:0], np.empty((track.out.shape[0], 0))
    probe.keep(steps)
    code = probe.march(sources, stop, no_looks())
    track.counters[: readout.OUTPUT] += probe.counters[: readout.OUTPUT]
    if code != loopstate.DONE or not probe.keeps_all:
        raise _LostError
    times = probe.kept.times[: int(probe.counters[readout.KEPT])]
    return _Period(probe, np.append(times[:1, 0], times[:, 2]), np.append(repetition.AT_EDGE, times[:, 3]))


def _moved(slope: FloatArray, shift: FloatArray, periods: int) -> FloatArray:
    """Sum of slope^i shift for i = 0 ... periods - 1."""
    n = shift.size
    return np.asarray(np.linalg.matrix_power(np.block([[slope, shift[:, None]], [np.zeros(n), 1.0]]), periods)[:n, n])


def _missed_within(
    one: repetition.PeriodMap, marks: FloatArray, series: FloatArray, delta: FloatArray, shown: int
) -> float:
    """Bound of the error of the map within a period, V, whose start differs by `delta` (V) and which was integrated.

    `marks` and `series` are those of that period; `shown` columns are voltages.
    """
    missed = series - one.series - np.tensordot(delta, one.by, 1)
    marks_missed = marks - one.marks - one.marks_by @ delta
    # The sum of the moduli of its Chebyshev coefficients bounds a polynomial.
    off = float(np.abs(missed[:, :shown]).sum(axis=-1).max(initial=0.0))
    steepest = np.abs(one.series[:, :shown]) @ np.arange(series.shape[-1]) * 2.0 / np.diff(one.marks)[:, None]
    return off + float((steepest.max(axis=1) * np.maximum(abs(marks_missed[1:]), abs(marks_missed[:-1]))).max())


def leap(track: Track, sources: Sources, settling: Settling) -> None:
    """Extrapolate all following periods with one affine map, if its error allows it; see `Settling.may_leap`."""
    stop = track.t + settling.period
    edge = float(sources.edges[np.abs(sources.edges - stop).argmin()])
    # An edge may differ from the end of the period by rounding only.
    stop = edge if abs(edge - stop) <= same_time(edge) else stop
    if stop > sources.edges[-1]:
        return
    try:
        _leap(track, sources, settling, stop)
    except _LostError:
        settling.stumbled(_LOST)


def _leap(track: Track, sources: Sources, settling: Settling, stop: float) -> None:
    left = settling.left
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
    # Defect of the map at the present state: the integrated period minus the period that the map predicts.
    delta = x0 - base_x
    missed = end - base.track.y - slope @ delta
    one = repetition.PeriodMap(marks, marks_by, series, by, slope, base_x, base.track.y)
    within = _missed_within(one, here.marks, series_here, delta, track.shown)
    later = max(float(np.abs(missed[:n]).max()), float(np.abs(_moved(slope[:n], missed[:n], left)).max()))
    slowest = np.abs(np.linalg.eigvals(slope[:n]))
    slowest = float(slowest[slowest < 1.0 - 1e-9].max(initial=0.0))
    # The charge defect of a period falls with the square of the distance to the periodic state: a geometric series.
    owed = abs(float(missed[n])) * min(left, 1.0 / (1.0 - slowest**2))
    # The truncation errors of the steps perturb the map itself; their effect accumulates over the circuit's memory.
    noise = base.off + (np.array(offs) - here.off).T @ (delta / settling.probe)
    later += SAFETY * max(float(np.abs(noise).max()), float(np.abs(_moved(slope[:n], noise, left)).max()))
    still = _STILL * settling.allowed
    error = max(float(track.control[readout.MAGNIFIED]) * (later + still) + within, owed / track.capacitance)
    if not error <= settling.allowed:
        settling.stumbled(error / settling.allowed)
        return
    state = np.append(x0, track.y[n])
    shown = slice(0, track.shown)
    track.recorder.drain(track.counters)
    recorded = one._replace(series=series[:, shown].copy(), by=by[:, :, shown].copy(), end=one.end.copy())
    track.recorder.parts.append(Leap(recorded, x0.copy(), still, settling.period, left))
    track.counters[readout.OUTPUT] = repetition.approach(
        one, state, track.shown, still, settling.period, left, int(track.counters[readout.OUTPUT]), track.outputs
    )  # fmt: skip
    control, before = base.track.control, here.track.control
    for peak in (readout.PEAK_U, readout.PEAK_F, readout.PEAK_Q, readout.ERROR_U, readout.ERROR_F, readout.ERROR_V):
        control[peak] = max(control[peak], before[peak])
    control[readout.MARGIN] = min(control[readout.MARGIN], before[readout.MARGIN])
    track.land(base.track, state, left, error, owed)
    settling.leapt(left, state[:n])
