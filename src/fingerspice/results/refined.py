"""A run that can be computed at any time, on panels that are refined until polynomials represent it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.polynomial import chebyshev

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.numerics.lobatto import BETWEEN, NODES, POINTS, TO_SERIES
from fingerspice.results.measures import Read
from fingerspice.results.record import Record, bare_record
from fingerspice.results.steps import Block, Stretches
from fingerspice.waveforms.waveform import Waveform

#: Largest interpolation error of a panel between its nodes, relative to the signal's peak.
_MISSED = 1e-11
#: Largest number of panels, beyond which figures are computed from the outputs; and of halvings of one panel.
MOST_PANELS, _MOST_ROUNDS = 20_000, 60
# Length of a panel that is a straight line at all events, in units of the last place of the time.
_ROUNDINGS = 32.0
#: Largest number of the source's segments that an evaluation may pass; length of the first panels relative to the
#: source's shortest time.
_MOST_PASSED, _LONGEST = 200_000, 0.5


@dataclass(frozen=True)
class ClosedForm:
    """A run in closed form, or by a method that computes it anew for any times."""

    # Function of times (s, ascending), and of whether the left-hand limit is wanted at each, that returns a record
    look: Callable[[FloatArray, BoolArray], Record]
    waveform: Waveform  # Waveform with the breakpoints of all sources
    # t_start, first, stop: Start of the run, and the interval for figures, s
    t_start: float
    first: float
    stop: float
    # Error of the records of `look`, relative to the peaks; the panels' polynomials need not be more accurate
    error: float = 0.0
    rounding: float = 0.0  # Round-off of a voltage, V, below which the polynomials need not be accurate

    def run(self, readers: Mapping[str, Read], since: float, until: float) -> Stretches | None:
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
        found = self._at_points(begin, end)
        if zeros := list(self._zeros(readers, begin, end, *found)):
            marks = np.unique(np.concatenate([begin, end[-1:], *zeros]))
            begin, end = marks[:-1], marks[1:]
            found = self._at_points(begin, end)
        _, order, record = found
        columns = np.empty((order.size, record.rows.shape[1]))
        columns[order] = record.rows
        values = columns.reshape(begin.size, POINTS.size, -1)[:, :NODES].transpose(0, 2, 1)
        # Within some roundings of the time nodes are not apart, and a polynomial through them may be anything.
        short = np.flatnonzero(end - begin <= _ROUNDINGS * np.spacing(np.abs(end)))
        first, last = values[short, :, :1], values[short, :, -1:]
        values[short] = first + POINTS[:NODES] * (last - first)
        times = np.column_stack([begin, end - begin, end, np.ones(begin.size)])
        return Stretches([Block(times, values)], partial(bare_record, record.network, record.net))

    def _at_points(self, begin: FloatArray, end: FloatArray) -> tuple[tuple[int, int], IntArray, Record]:
        """Shape of the points of all panels, their ascending order, and the record in that order."""
        t = begin[:, None] + POINTS * (end - begin)[:, None]
        left = np.broadcast_to(POINTS >= 1.0, t.shape)
        t[left] = np.broadcast_to(end[:, None], t.shape)[left]
        order = np.lexsort((~left.ravel(), t.ravel()))
        return (begin.size, POINTS.size), order, self.look(t.ravel()[order], left.ravel()[order])

    def _is_rough(
        self, readers: Mapping[str, Read], begin: FloatArray, end: FloatArray, peaks: dict[str, float]
    ) -> BoolArray:
        """Whether some voltage's interpolation error on a panel is too large, shape (p,)."""
        shape, order, record = self._at_points(begin, end)
        wrong = np.zeros(begin.size, bool)
        for name, read in readers.items():
            if not name.startswith(("u_", "v:")):
                # Signals that follow from the gap voltage are smooth where it is, except at its zeros.
                continue
            values = _in_place(read(record), order, shape)
            peaks[name] = max(peaks.get(name, 0.0), float(np.abs(values).max(initial=0.0)))
            missed = np.abs(values[:, :NODES] @ BETWEEN - values[:, NODES:]).max(axis=1)
            wrong |= missed > max(max(_MISSED, self.error) * peaks[name], self.rounding)
        return wrong & (0.5 * (begin + end) > begin) & (0.5 * (begin + end) < end)

    def _zeros(
        self, readers: Mapping[str, Read], begin: FloatArray, end: FloatArray, shape: tuple[int, int], order: IntArray,
        record: Record,
    ) -> Iterator[FloatArray]:  # fmt: skip
        """Zeros of gap voltages (s) within panels, where the area has a kink."""
        for name, read in readers.items():
            if name.partition(":")[0] != "u_gap":
                continue
            values = _in_place(read(record), order, shape)[:, :NODES]
            for i in np.flatnonzero((values.max(axis=1) > self.rounding) & (values.min(axis=1) < -self.rounding)):
                roots = chebyshev.chebroots(values[i] @ TO_SERIES[:, :NODES])
                inside = roots.real[(np.abs(roots.imag) < 1e-8) & (np.abs(roots.real) < 1.0)]
                yield begin[i] + (end[i] - begin[i]) * 0.5 * (1.0 + inside)


def _in_place(x: FloatArray, order: IntArray, shape: tuple[int, int]) -> FloatArray:
    """Values at ascending times, rearranged to the order and shape of the panels' points."""
    out = np.empty(x.size)
    out[order] = x
    return out.reshape(shape)
