"""A run between its outputs: steps with polynomials through their nodes, and means and extremes of its signals on them.

Steps are recorded as the run is made, or chosen for a run that can be computed at any times, or read from a file.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev, legendre

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray, Remembering
from fingerspice.engine.collocation.readout import RECORDED, Steps, new_steps
from fingerspice.numerics.chebyshev import largest
from fingerspice.numerics.lobatto import BARYCENTRIC, BETWEEN, NODES, POINTS, TO_SERIES
from fingerspice.results.record import Named, Record, Signals
from fingerspice.waveforms.sampling import same_time
from fingerspice.waveforms.waveform import Waveform, refuse

#: From times (s), a mask of left-hand values and states as rows to a record.
Make = Callable[[FloatArray, BoolArray, FloatArray], Signals]
#: Parts of steps on each of which every signal is smooth, shape (4, p): the number of the step, the part of it from low
#: to high as fractions of its length, and the duration (s), longer than the part itself if it stands for equal periods.
Panels = FloatArray

CAPACITY, _AT_ONCE = 512, 16_384  # Most steps, and numbers at their nodes, that the compiled loop records at once
MOST_NUMBERS = 8_000_000  # Most values kept of a run's steps (64 MB); figures of a longer run are those of its outputs
_KNOWN, _MOST_KNOWN = 8, 4096  # Sets of places between the steps whose record is kept, and the most places of one


class Recorder:
    """Collects the steps of one integration after each call of its compiled loop."""

    def __init__(self, columns: int) -> None:
        self.columns, self.numbers = columns, 0
        self.room: Steps = new_steps(min(CAPACITY, 1 + _AT_ONCE // max(columns, 1)), columns)
        self.parts: list[tuple[FloatArray, FloatArray]] = []  # Times and values as in `Recorded`

    def drain(self, counters: IntArray) -> None:
        """Collect the steps that the loop has recorded; none of them where there are too many."""
        count, counters[RECORDED] = int(counters[RECORDED]), 0
        self.numbers += count * self.columns * NODES
        if self.numbers > MOST_NUMBERS:
            self.parts.clear()
        elif count > 0:
            times = np.zeros((6, count))
            times[:4], times[4] = self.room.times[:count].T, 1.0
            self.parts.append((times, self.room.values[:count].copy()))

    def repeat(self, since: int, periods: int, period: float) -> None:
        """Let the parts from number `since` on also represent the `periods` periods that follow them."""
        for times, values in self.parts[since:] if periods > 0 else ():
            later = times.copy()
            later[4], later[5] = periods, period
            self.parts.append((later, values))

    def finish(self, first: float, make: Make) -> Recorded | None:
        """The run recorded since `first` (s); None where nothing, or too much, was recorded."""
        if not self.parts:
            return None
        times, values = zip(*self.parts, strict=True)
        return Recorded(np.concatenate(times, axis=1), np.concatenate(values), first, make)


@dataclass(frozen=True)
class Recorded(Remembering):
    """Consecutive steps of a run since a time (s), with its signals at any fraction of each step."""

    # (6, k): Start of each step, its length, the end reached (s), the part of the length that was reached, the number
    # of equal periods that it stands for, and the time (s) from its own to the first of them and from each to the next
    times: FloatArray
    values: FloatArray  # (k, n_column, NODES): At the nodes of the whole step, which may extend beyond the end reached
    first: float
    make: Make

    def run(self, names: Sequence[str], since: float, until: float) -> Recorded | None:
        """These steps; None where they begin after `since` (s)."""
        return self if since >= self.first - 1e-9 * (until - since) else None

    def each_once(self) -> Recorded:
        """The same steps, in which those that stand for several periods stand once for each."""
        count = self.times[4].astype(int)
        if (count == 1).all() and not self.times[5].any():
            return self
        said = f"a run of {count.sum():,} steps is too long to be taken period by period"
        refuse(count.sum() * self.values[0].size > MOST_NUMBERS, f"{said}; allowed: a shorter one")
        index = np.repeat(np.arange(count.size), count)
        later = (1.0 + np.arange(index.size) - np.repeat(np.cumsum(count) - count, count)) * self.times[5, index]
        times = self.times[:, index] + np.multiply.outer([1.0, 0.0, 1.0, 0.0, 0.0, 0.0], later)
        times[4], times[5] = 1.0, 0.0
        order = times[0].argsort(kind="stable")
        return replace(self, times=times[:, order], values=self.values[index[order]])

    def panels(self, since: float, until: float) -> Panels:
        """Parts of the steps between two times (s); equal periods are one panel with the duration of all of them."""
        start, length, reached, reach, count, period = self.times
        begin, end = start + period, reached + period
        slack, index = same_time(1.0) * np.abs(end), np.arange(float(start.size))
        if ((begin >= since - slack) & (end + (count - 1) * period <= until + slack)).all():
            return np.array([index, 0.0 * index, reach, count * reach * length])
        period = np.where(count > 1, period, 1.0)
        # Of the periods that a step represents, those from number `first` to `last` lie wholly inside.
        first = np.clip(np.ceil((since - slack - begin) / period), 0, count)
        last = np.clip(np.floor((until + slack - end) / period), -1, count - 1)
        found = [(index, 0.0 * reach, reach, np.maximum(last - first + 1.0, 0.0) * reach * length)]
        for k, once in ((first - 1.0, True), (last + 1.0, last + 1.0 != first - 1.0)):
            cut = once & (k >= 0) & (k < count)
            low = np.maximum((since - begin - k * period) / length, 0.0)
            # A part that ends with the interval, to rounding, ends where its step does: on the left of a possible jump.
            whole = end + k * period <= until + slack
            high = np.where(whole, reach, np.minimum((until - begin - k * period) / length, reach))
            found.append((index, low, high, np.where(cut & (high - low > slack / length), (high - low) * length, 0.0)))
        every = np.concatenate(found, axis=1)
        return every[:, every[3] > 0.0]

    @cached_property
    def _whole(self) -> tuple[FloatArray, Signals]:
        """Times (k, ROWS) and the record at the points of every step, up to the end that it reached."""
        columns = np.concatenate([self.values, self.values @ BETWEEN], axis=2)
        fraction = self.times[3, :, None] * POINTS
        short = np.flatnonzero(self.times[3] != 1.0)
        if short.size:
            columns[short] = np.einsum("pcn,pqn->pcq", self.values[short], basis(fraction[short]))
        return self._record(slice(None), fraction, columns.transpose(1, 0, 2))

    def _record(self, index: IntArray | slice, fraction: FloatArray, columns: FloatArray) -> tuple[FloatArray, Signals]:
        """Times at fractions of steps, and the record there of states, shape (n_column, *fraction.shape)."""
        start, length, reached, reach = self.times[:4, index, None]
        left = fraction >= reach
        t = np.where(left, reached, start + fraction * length)
        return t, self.make(t.ravel(), left.ravel(), columns.reshape(columns.shape[0], t.size).T)

    def at_points(self, name: Named, panels: Panels) -> tuple[FloatArray, FloatArray]:
        """Times (s) and a signal at the `POINTS` of panels, shape (p, ROWS) each."""
        step = panels[0].astype(int)
        cut = (panels[1] != 0.0) | (panels[2] != self.times[3, step])
        if cut.all():
            return self.values_at(name, panels, POINTS)
        # Panels that are whole steps share one record for all signals.
        t, record = self._whole
        t, x = t[step], record.one(name).reshape(t.shape)[step]
        if cut.any():
            t[cut], x[cut] = self.values_at(name, panels[:, cut], POINTS)
        return t, x

    def values_at(self, name: Named, panels: Panels, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Times (s) and a signal at places of panels, from 0 to 1, shape (n,) or (p, n); shape (p, n) each."""
        index, (low, high) = panels[0].astype(int), panels[1:3, :, None]
        # Written so that the places 0 and 1 give exactly `low` and `high`.
        fraction = low * (1.0 - places) + high * places

        def make() -> tuple[FloatArray, Signals]:
            return self._record(index, fraction, np.einsum("pcn,pqn->cpq", self.values[index], basis(fraction)))

        # Signals are mostly asked for at the same places one after another.
        key = "places", index.tobytes(), fraction.tobytes()
        t, record = self.remember(key, make, _KNOWN) if fraction.size <= _MOST_KNOWN else make()
        return t, record.one(name).reshape(t.shape)


def whole_steps(begin: FloatArray, end: FloatArray) -> FloatArray:
    """Times, as in `Recorded`, of steps that were reached whole and stand for themselves."""
    one = np.ones(begin.size)
    return np.array([begin, end - begin, end, one, one, 0.0 * one])


def basis(fraction: FloatArray) -> FloatArray:
    """Weights (p, q, NODES) for interpolating values at the nodes to fractions (p, q) of a step."""
    distance = fraction[:, :, None] - POINTS[:NODES]
    hit = distance == 0.0
    weight = np.where(hit.any(axis=2, keepdims=True), hit, BARYCENTRIC / np.where(hit, 1.0, distance))
    return np.asarray(weight / weight.sum(axis=2, keepdims=True))


def missed(x: FloatArray) -> FloatArray:
    """Largest interpolation error found between the nodes of each panel, from values (p, ROWS), shape (p,)."""
    return np.asarray(np.abs(x[:, :NODES] @ BETWEEN - x[:, NODES:]).max(axis=1, initial=0.0))


_MISSED = 1e-11  # Largest interpolation error of a panel between its nodes, relative to the signal's peak
MOST_PANELS, _MOST_ROUNDS = 20_000, 60  # Most panels, beyond which figures are those of the outputs; halvings of one
_ROUNDINGS = 32.0  # Length of a panel that is a straight line at all events, in units of the last place of the time
_MOST_PASSED, _LONGEST = 200_000, 0.5  # Segments an evaluation may pass; first panels, in the source's shortest times


@dataclass(frozen=True)
class ClosedForm:
    """A run in closed form, or by a method that computes it anew for any times."""

    # Function of times (s, ascending), and of whether the left-hand limit is wanted at each, that returns a record
    look: Callable[[FloatArray, BoolArray], Record]
    waveform: Waveform  # Waveform with the breakpoints of all sources
    t_start: float  # Start of the run, s
    error: float = 0.0  # Of the records of `look`, relative to the peaks; the polynomials need not be more accurate
    rounding: float = 0.0  # Round-off of a voltage, V, below which the polynomials need not be accurate

    def run(self, names: Sequence[str], since: float, until: float) -> Recorded | None:
        """Steps between two times (s), on each of which a polynomial represents every voltage; None if too many."""
        if (marks := self._marks(since, until)) is None:
            return None
        begin, end = marks[:-1], marks[1:]
        done: list[FloatArray] = []
        peaks: dict[str, float] = {}
        for _ in range(_MOST_ROUNDS):
            record, place = self._at_points(begin, end)
            middle, wrong = 0.5 * (begin + end), np.zeros(begin.size, bool)
            # Signals that follow from the gap voltage are smooth where it is, except at its zeros.
            for name in (name for name in names if name.startswith(("u_", "v:"))):
                x = record.one(name)[place]
                peaks[name] = max(peaks.get(name, 0.0), float(np.abs(x).max(initial=0.0)))
                wrong |= missed(x) > max(max(_MISSED, self.error) * peaks[name], self.rounding)
            wrong &= (middle > begin) & (middle < end)
            done.append(begin[~wrong])
            if not wrong.any():
                break
            begin, end = (np.sort(np.append(side[wrong], middle[wrong])) for side in (begin, end))
            if begin.size + sum(x.size for x in done) > MOST_PANELS:
                return None
        marks = np.append(np.sort(np.concatenate(done)), marks[-1])
        record, place = self._at_points(marks[:-1], marks[1:])
        if zeros := list(self._zeros(names, marks, record, place)):
            marks = np.unique(np.concatenate([marks, *zeros]))
            record, place = self._at_points(marks[:-1], marks[1:])
        begin, end = marks[:-1], marks[1:]
        values = record.rows[place[:, :NODES]].transpose(0, 2, 1)
        # Within some roundings of the time nodes are not apart, and a polynomial through them may be anything.
        short = np.flatnonzero(end - begin <= _ROUNDINGS * np.spacing(np.abs(end)))
        first, last = values[short, :, :1], values[short, :, -1:]
        values[short] = first + POINTS[:NODES] * (last - first)
        return Recorded(whole_steps(begin, end), values, since, partial(Record, record.network, record.net))

    def _marks(self, since: float, until: float) -> FloatArray | None:
        """Ends of the first panels, s; None if they are too many."""
        longest = _LONGEST * self.waveform.shortest_time()
        rate = self.waveform.breakpoint_rate() + 1.0 / longest
        # Each evaluation computes the run from its start, so that the segments before `since` count too.
        if (until - since) * rate > MOST_PANELS or (until - self.t_start) * rate > _MOST_PASSED:
            return None
        inner = self.waveform.breakpoints(since, until)
        edges = np.unique(np.concatenate([[since], inner[(inner > since) & (inner < until)], [until]]))
        count = np.maximum(np.ceil(np.diff(edges) / longest), 1.0).astype(int)
        if count.sum() > MOST_PANELS:
            return None
        return np.asarray(np.interp(np.arange(count.sum() + 1), np.append(0, np.cumsum(count)), edges))

    def _at_points(self, begin: FloatArray, end: FloatArray) -> tuple[Record, IntArray]:
        """The record at the points of all panels, and the row of each, shape (p, ROWS)."""
        left = np.broadcast_to(POINTS >= 1.0, (begin.size, POINTS.size))
        t = np.where(left, end[:, None], begin[:, None] + POINTS * (end - begin)[:, None])
        order = np.lexsort((~left.ravel(), t.ravel()))
        return self.look(t.ravel()[order], left.ravel()[order]), np.argsort(order).reshape(t.shape)

    def _zeros(self, names: Sequence[str], marks: FloatArray, record: Record, place: IntArray) -> Iterator[FloatArray]:
        """Zeros of gap voltages (s) within panels, where the area has a kink."""
        for name in (name for name in names if name.startswith("u_gap")):
            values = record.one(name)[place[:, :NODES]]
            for i in np.flatnonzero((values.max(axis=1) > self.rounding) & (values.min(axis=1) < -self.rounding)):
                roots = chebyshev.chebroots(values[i] @ TO_SERIES[:, :NODES])
                inside = roots.real[(np.abs(roots.imag) < 1e-8) & (np.abs(roots.real) < 1.0)]
                yield marks[i] + (marks[i + 1] - marks[i]) * 0.5 * (1.0 + inside)


_FINEST = 1e-12  # Smallest tolerance of the interpolation error of a panel, relative to the signal's peak
_MOST_CUT = 4096  # Most halves of panels that are evaluated, in addition to four for each panel
_MOST_SEARCHES = 60  # Most times that one panel is halved
#: Gauss-Lobatto weights on [0, 1]: exact for polynomials of degree 23.
WEIGHTS = 1.0 / (NODES * (NODES - 1) * legendre.Legendre.basis(NODES - 1)(2.0 * POINTS[:NODES] - 1.0) ** 2)


@dataclass(frozen=True)
class Weighed:
    """Values of a signal with quadrature weights."""

    t: FloatArray  # (n,): s
    weight: FloatArray  # (n,): Their sum is 1
    x: FloatArray  # (n,): In the signal's unit

    def mean(self, power: int = 1) -> float:
        """Mean of the signal, or of a power of it."""
        # Without BLAS, whose threads cost more than the sum and may round differently.
        return float((self.weight * (self.x if power == 1 else self.x**power)).sum())

    def phasor(self, frequency: float) -> complex:
        """Complex amplitude P of a signal x ~ Im(P exp(i 2 pi f t)); the times cover whole periods."""
        return complex(2j * (self.weight * np.exp(-2j * np.pi * frequency * self.t) * self.x).sum())


def halved(panels: Panels) -> Panels:
    """Both halves of panels."""
    step, low, high, duration = panels
    middle, half = 0.5 * (low + high), 0.5 * duration
    return np.concatenate([(step, low, middle, half), (step, middle, high, half)], axis=1)


class Stretch:
    """A run between two times (s), with weights and extremes of every signal, more exact than its error `rtol`.

    A panel is halved where the polynomial through its nodes differs from the signal between them: steps resolve the gap
    voltage, and the area may change within a small part of the voltage's range.
    """

    def __init__(self, run: Recorded, since: float, until: float, rtol: float) -> None:
        self.run, self.span, self.rtol = run, (since, until), rtol
        self.panels = run.panels(since, until)

    def weigh(self, name: Named, longest: float = math.inf) -> Weighed:
        """A signal with weights for its means, on panels as short as `longest` (s)."""
        panels = self.panels
        while (long := panels[3] > longest).any():
            panels = np.concatenate([panels[:, ~long], halved(panels[:, long])], axis=1)
        t, x = self.run.at_points(name, panels)
        error = missed(x) / (float(np.abs(x).max(initial=0.0)) or 1.0)
        share = panels[3] / panels[3].sum()
        # Gauss-Lobatto weights are exact up to twice the degree of the interpolant: if the terms of the series fall
        # geometrically, the quadrature error is about the interpolation error to the power 1.85, and 1.5 is safe.
        if float((share * error**1.5).sum()) <= max(_FINEST, 1e-3 * self.rtol):
            return Weighed(t[:, :NODES], share[:, None] * WEIGHTS, x[:, :NODES])
        return self._cut(name, _FINEST, panels)[0]

    def extremes(self, name: Named) -> tuple[tuple[float, float], tuple[float, float]]:
        """Time (s) and value of a signal's smallest and largest value, where its polynomials have their extremes."""
        # An interpolation error shifts the place of an extreme, which changes the signal there by its square only.
        weighed, panels = self._cut(name, max(_FINEST, 1e-3 * self.rtol), self.panels)
        found = [largest(weighed.x, sign) for sign in (-1.0, 1.0)]
        places = np.array([[place] for _, place, _ in found])
        t, exact = self.run.values_at(name, panels[:, [panel for panel, _, _ in found]], places)
        # A node may lie higher than the summit between nodes, by rounding.
        (low, high), nodes = zip(t[:, 0].tolist(), exact[:, 0].tolist(), strict=True), weighed.x.ravel()
        pairs = [(float(weighed.t.ravel()[i]), float(nodes[i])) for i in (nodes.argmin(), nodes.argmax())]
        return min(low, pairs[0], key=itemgetter(1)), max(high, pairs[1], key=itemgetter(1))

    def at_nodes(self, names: Sequence[str], tol: float) -> list[FloatArray]:
        """Times (s) and signals at the nodes (p, NODES) of panels on which each misses its polynomial by `tol`."""
        # Panels on which the rounding of the time alone is as much, as on an edge of 1 ns, are not cut.
        shortest, panels = np.finfo(float).eps * abs(self.span[1]) / tol, self.panels
        for name in names:
            panels = self._cut(name, tol, panels, shortest)[1]
        found = [self.run.at_points(name, panels) for name in names]
        return [x[:, :NODES] for x in (found[0][0], *(x for _, x in found))]

    def resolved(self, name: Named, tol: float) -> Panels:
        """Panels on each of which a signal misses its polynomial by at most `tol` of its peak."""
        return self._cut(name, tol, self.panels, np.finfo(float).eps * abs(self.span[1]) / tol)[1]

    def _cut(self, name: Named, tol: float, panels: Panels, shortest: float = 0.0) -> tuple[Weighed, Panels]:
        """A signal, and panels on which its interpolation error is at most `tol` of its peak, or as short as told."""
        parts = []
        t, x = self.run.at_points(name, panels)
        smooth = tol * float(np.abs(x).max(initial=0.0))
        most = _MOST_CUT + 4 * len(t)
        for left in range(_MOST_SEARCHES, 0, -1):
            # Panels that are not smooth at the end hold round-off, or a jump that round-off has shifted across an end.
            wrong = (missed(x) > smooth) & (panels[3] > shortest) & (most > 0 and left > 1)
            parts.append((panels[:, ~wrong].T, t[~wrong, :NODES], x[~wrong, :NODES]))
            if not wrong.any():
                break
            panels = halved(panels[:, wrong])
            t, x = self.run.at_points(name, panels)
            most -= len(t)
        every, t, x = map(np.concatenate, zip(*parts, strict=True))
        share = every[:, 3] / every[:, 3].sum()
        return Weighed(t, share[:, None] * WEIGHTS, x), every.T


class Outputs(NamedTuple):
    """Outputs of a record since a time (s); those at that time itself are interpolated where there are none."""

    record: Signals
    since: float = -math.inf
    tolerance: float = 0.0  # Distance (s) up to which an output is one at that time

    def _values(self, name: Named) -> tuple[FloatArray, FloatArray]:
        t, x, ends = self.record.t, self.record.one(name), (self.since - self.tolerance, self.since + self.tolerance)
        first, after = np.searchsorted(t, ends, side="right").tolist()
        if first == after > 0:
            return np.append(self.since, t[first:]), np.append(np.interp(self.since, t, x), x[first:])
        # Of two outputs at a jump, the right-hand one is the first.
        return t[max(after - 1, 0) :], x[max(after - 1, 0) :]

    def weigh(self, name: Named, longest: float = math.inf) -> Weighed:
        """A signal with weights for its means, whatever `longest` is: nothing is known between the outputs."""
        return weigh_outputs(*self._values(name))

    def extremes(self, name: Named) -> tuple[tuple[float, float], tuple[float, float]]:
        """Time (s) and value of a signal's smallest and largest value."""
        t, x = self._values(name)
        low, high = ((float(t[i]), float(x[i])) for i in (x.argmin(), x.argmax()))
        return low, high


def weigh_outputs(t: FloatArray, x: FloatArray) -> Weighed:
    """A signal's outputs at times t (s, ascending), with weights that are exact for cubics; a repeated time is a jump.

    Where fewer than four values lie between two jumps, the trapezoidal rule is used.
    """
    weight, step = np.zeros(t.size), np.diff(t)
    begins = np.flatnonzero(np.append(True, step == 0.0))
    sizes = np.diff(np.append(begins, t.size))
    begin, size = np.repeat(begins, sizes), np.repeat(sizes, sizes)
    i = np.flatnonzero(step > 0.0)
    few = i[size[i] < 4]
    for side in (0, 1):
        np.add.at(weight, few + side, 0.5 * step[few])
    i = i[size[i] >= 4]
    index = np.clip(i - 1, begin[i], begin[i] + size[i] - 4)[:, None] + np.arange(4)
    nodes = t[index]
    half, middle = 0.5 * step[i], 0.5 * (t[i + 1] + t[i])
    # Two Gauss points integrate a cubic exactly; it is evaluated there in Lagrange's form.
    for at, j in itertools.product((middle - half / np.sqrt(3.0), middle + half / np.sqrt(3.0)), range(4)):
        share = half
        for m in (m for m in range(4) if m != j):
            share = share * ((at - nodes[:, m]) / (nodes[:, j] - nodes[:, m]))
        weight += np.bincount(index[:, j], share, t.size)
    return Weighed(t, weight / weight.sum(), x)
