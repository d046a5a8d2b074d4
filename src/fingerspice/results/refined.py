"""A run in closed form between its outputs, evaluated on panels that are refined until polynomials represent it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.numerics.lobatto import BETWEEN, NODES, POINTS, TO_SERIES
from fingerspice.results.measures import Panels, Read
from fingerspice.results.record import Record
from fingerspice.waveforms.waveform import Waveform

#: Largest interpolation error of a panel between its nodes, relative to the signal's peak.
_MISSED = 1e-11
#: Largest number of panels, beyond which figures are computed from the outputs; and of halvings of one panel.
MOST_PANELS, _MOST_ROUNDS = 20_000, 60
#: Largest number of the source's segments that an evaluation may pass; length of the first panels relative to the
#: source's shortest time.
_MOST_PASSED, _LONGEST = 200_000, 0.5


@dataclass(frozen=True)
class ClosedForm:
    """A run in closed form, which can be evaluated at any time.

    Attributes
    ----------
    look : callable
        Function of times (s, ascending), and of whether the left-hand limit is wanted at each, that returns a record.
    waveform : Waveform
        Waveform with the breakpoints of all sources.
    t_start, first, stop : float
        Start of the run, and the interval for figures, s.
    error : float
        Error of the records of `look`, relative to the peaks; the panels' polynomials need not be more accurate.
    """

    look: Callable[[FloatArray, BoolArray], Record]
    waveform: Waveform
    t_start: float
    first: float
    stop: float
    error: float = 0.0

    def run(self, readers: Mapping[str, Read], since: float, until: float) -> Refined | None:
        """Panels between two times (s), on each of which a polynomial represents every voltage; None if too many.

        `readers` gives, by name, the functions that read signals from a record.
        """
        longest = _LONGEST * self.waveform.shortest_time()
        rate = self.waveform.breakpoint_rate() + 1.0 / longest
        # Each evaluation computes the run from its start, so that the segments before `since` count too.
        if (until - since) * rate > MOST_PANELS or (until - self.t_start) * rate > _MOST_PASSED:
            return None
        inner = self.waveform.breakpoints(since, until)
        edges = np.unique(np.concatenate([[since], inner[(inner > since) & (inner < until)], [until]]))
        pieces = np.maximum(np.ceil(np.diff(edges) / longest), 1.0)
        if pieces.sum() > MOST_PANELS:
            return None
        count = pieces.astype(int)
        number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        marks = np.append(np.repeat(edges[:-1], count) + number * np.repeat(np.diff(edges) / count, count), edges[-1])
        begin, end = marks[:-1], marks[1:]
        done: list[tuple[FloatArray, FloatArray]] = []
        peaks: dict[str, float] = {}
        for _ in range(_MOST_ROUNDS):
            wrong = self._is_rough(readers, begin, end, peaks)
            done.append((begin[~wrong], end[~wrong]))
            if not wrong.any():
                break
            middle = 0.5 * (begin[wrong] + end[wrong])
            begin, end = np.sort(np.append(begin[wrong], middle)), np.sort(np.append(middle, end[wrong]))
            if begin.size + sum(x.size for x, _ in done) > MOST_PANELS:
                return None
        begin, end = (np.sort(np.concatenate(x)) for x in zip(*done, strict=True))
        return self._cut_at_zeros(readers, Refined(self.look, begin, end))

    def _is_rough(
        self, readers: Mapping[str, Read], begin: FloatArray, end: FloatArray, peaks: dict[str, float]
    ) -> BoolArray:
        """Whether some voltage's interpolation error on a panel is too large, shape (p,)."""
        every = Refined(self.look, begin, end)
        wrong = np.zeros(begin.size, bool)
        for name, read in readers.items():
            if not name.startswith(("u_", "v:")):
                # Signals that follow from the gap voltage are smooth where it is, except at its zeros.
                continue
            _, values = every.at_own_points(read)
            peaks[name] = max(peaks.get(name, 0.0), float(np.abs(values).max(initial=0.0)))
            missed = np.abs(values[:, :NODES] @ BETWEEN - values[:, NODES:]).max(axis=1)
            wrong |= missed > max(_MISSED, self.error) * peaks[name]
        return wrong & (0.5 * (begin + end) > begin) & (0.5 * (begin + end) < end)

    def _cut_at_zeros(self, readers: Mapping[str, Read], run: Refined) -> Refined:
        """The panels cut at the zeros of gap voltages, where the area has a kink."""
        zeros = []
        for name, read in readers.items():
            if name.partition(":")[0] != "u_gap":
                continue
            values = run.at_own_points(read)[1][:, :NODES]
            for i in np.flatnonzero((values.max(axis=1) > 0.0) & (values.min(axis=1) < 0.0)):
                roots = chebyshev.chebroots(values[i] @ TO_SERIES[:, :NODES])
                inside = roots.real[(np.abs(roots.imag) < 1e-8) & (np.abs(roots.real) < 1.0)]
                zeros.append(run.begin[i] + (run.end[i] - run.begin[i]) * 0.5 * (1.0 + inside))
        if not zeros:
            return run
        marks = np.unique(np.concatenate([run.begin, run.end[-1:], *zeros]))
        return Refined(self.look, marks[:-1], marks[1:])


@dataclass(frozen=True)
class Refined:
    """Consecutive panels of a run in closed form; see `measures.Run`."""

    look: Callable[[FloatArray, BoolArray], Record]
    begin: FloatArray
    end: FloatArray

    def panels(self, since: float, until: float) -> Panels:
        """The panels between two times (s); the first and last are cut off at these times."""
        length = self.end - self.begin
        low = np.maximum((since - self.begin) / length, 0.0)
        high = np.minimum((until - self.begin) / length, 1.0)
        some = np.flatnonzero(high > low)
        return Panels(some, low[some], high[some], (high - low)[some] * length[some])

    @cached_property
    def _own(self) -> tuple[FloatArray, IntArray, Record]:
        """Times at the points of all panels, shape (p, ROWS), their ascending order, and the record in that order."""
        return self._looked_at(slice(None), np.broadcast_to(POINTS, (self.begin.size, POINTS.size)))

    def _looked_at(self, index: IntArray | slice, fraction: FloatArray) -> tuple[FloatArray, IntArray, Record]:
        begin, end = self.begin[index, None], self.end[index, None]
        left = fraction >= 1.0
        t = np.where(left, end, begin + fraction * (end - begin))
        order = np.lexsort((~left.ravel(), t.ravel()))
        return t, order, self.look(t.ravel()[order], left.ravel()[order])

    def at_own_points(self, read: Read) -> tuple[FloatArray, FloatArray]:
        """Times (s) and a signal at the points of every panel, shape (p, ROWS) each."""
        return _in_place(read, *self._own)

    def at_points(self, read: Read, panels: Panels) -> tuple[FloatArray, FloatArray]:
        """See `measures.Run`; the record at the points of all panels is computed only once."""
        if panels.step.size == self.begin.size and not panels.low.any() and (panels.high == 1.0).all():
            return self.at_own_points(read)
        return self.values_at(read, panels.step, panels.fractions(POINTS))

    def values_at(self, read: Read, index: IntArray, fraction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `measures.Run`; evaluates the closed form."""
        return _in_place(read, *self._looked_at(index, fraction))


def _in_place(read: Read, t: FloatArray, order: IntArray, record: Record) -> tuple[FloatArray, FloatArray]:
    """Times, and a signal of a record, whose times ascend, rearranged to the order of these times."""
    x = np.empty(t.size)
    x[order] = read(record)
    return t, x.reshape(t.shape)
