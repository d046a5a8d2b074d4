"""A run between its outputs: recorded steps with the periods that each stands for, or panels refined until they fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
from numpy.polynomial import chebyshev

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.engine.readout import RECORDED, Steps, new_steps
from fingerspice.numerics.lobatto import BARYCENTRIC, BETWEEN, NODES, POINTS, TO_SERIES
from fingerspice.results.measures import Panels, Read
from fingerspice.results.record import Record, bare_record
from fingerspice.waveforms.sampling import same_time
from fingerspice.waveforms.waveform import Waveform

#: Most steps recorded by the compiled loop before Python collects them, and most numbers at their nodes.
CAPACITY, _AT_ONCE = 512, 16_384
#: Largest number of values kept of a run's steps (64 MB); figures of a longer run are computed from its outputs.
MOST_NUMBERS = 8_000_000
#: Sets of places between the steps whose record is kept, and the most places of one.
_KNOWN, _MOST_KNOWN = 8, 4096
_NODES = POINTS[:NODES]


@dataclass(frozen=True)
class Block:
    """Consecutive steps, and the periods that they represent."""

    # (k, 4): Start and length of each step and the end reached, s, and the part of the length that was reached
    times: FloatArray
    # (k, n_column, NODES): Values at the nodes of the whole step, which may extend beyond the end reached
    values: FloatArray
    count: int = 1  # Number of equal periods
    # shift, period: The first of these periods is `shift` (s) after the steps' own times, each further one `period` (s)
    # later
    shift: float = 0.0
    period: float = 0.0


@dataclass
class Recorder:
    """Collects the steps of one integration after each call of its compiled loop."""

    columns: int
    room: Steps = field(init=False)
    parts: list[Block] = field(default_factory=list)
    numbers: int = 0
    full: bool = False

    def __post_init__(self) -> None:
        self.room = new_steps(min(CAPACITY, 1 + _AT_ONCE // max(self.columns, 1)), self.columns)

    def drain(self, counters: IntArray) -> None:
        """Collect the steps that the loop has recorded, as a block; none of them where there are too many."""
        count = int(counters[RECORDED])
        counters[RECORDED] = 0
        self.numbers += count * self.columns * NODES
        self.full = self.full or self.numbers > MOST_NUMBERS
        if self.full:
            self.parts.clear()
        elif count > 0:
            self.parts.append(Block(self.room.times[:count].copy(), self.room.values[:count].copy()))

    def repeat(self, since: int, periods: int, period: float) -> None:
        """Let the blocks from number `since` on also represent the `periods` periods that follow them."""
        if periods > 0:
            self.parts += [Block(b.times, b.values, periods, period, period) for b in self.parts[since:]]

    def finish(self, first: float, stop: float, make: Callable[..., Record]) -> Recorded | None:
        """The recorded run from `first` to `stop` (s); None where nothing, or too much, was recorded."""
        return None if self.full or not self.parts else Recorded(tuple(self.parts), first, stop, make)


@dataclass(frozen=True)
class Recorded:
    """Recorded steps; `make` builds a record from times, a mask of left-hand values, and states as columns."""

    parts: tuple[Block, ...]
    first: float
    stop: float
    make: Callable[[FloatArray, BoolArray, FloatArray], Record]

    def run(self, readers: Mapping[str, Read], since: float, until: float) -> Stretches:
        """The steps as one array."""
        return self._stretches

    @cached_property
    def _stretches(self) -> Stretches:
        return Stretches(self.parts, self.make)


class Stretches:
    """Steps of a run, with its signals at any fraction of each step."""

    def __init__(self, blocks: Sequence[Block], make: Callable[[FloatArray, BoolArray, FloatArray], Record]) -> None:
        sizes = [len(b.times) for b in blocks]
        self._make = make
        self._known: dict[tuple[bytes, bytes], tuple[FloatArray, Record]] = {}
        self.start, self.length, self.reached, self.reach = np.concatenate([b.times for b in blocks]).T
        self.values = np.concatenate([b.values for b in blocks])
        self.count = np.repeat([b.count for b in blocks], sizes)
        self.shift = np.repeat([b.shift for b in blocks], sizes)
        self.period = np.repeat([b.period for b in blocks], sizes)

    def panels(self, since: float, until: float) -> Panels:
        """Parts of the steps between two times (s); equal periods are one panel with the duration of all of them."""
        begin, end = self.start + self.shift, self.reached + self.shift
        slack = same_time(1.0) * np.abs(end)
        last_end = end + (self.count - 1) * self.period
        index = np.arange(self.start.size)
        if ((begin >= since - slack) & (last_end <= until + slack)).all():
            return Panels(index, np.zeros(index.size), self.reach, self.count * self.reach * self.length)
        period = np.where(self.count > 1, self.period, 1.0)
        # Of the periods that a step represents, those from number `first` to `last` lie wholly inside.
        first = np.clip(np.ceil((since - slack - begin) / period), 0, self.count)
        last = np.clip(np.floor((until + slack - end) / period), -1, self.count - 1)
        inside = np.maximum(last - first + 1.0, 0.0)
        found = [(np.zeros_like(self.reach), self.reach, inside)]
        for k, once in ((first - 1.0, True), (last + 1.0, last + 1.0 != first - 1.0)):
            cut = once & (k >= 0) & (k < self.count)
            low = np.maximum((since - begin - k * period) / self.length, 0.0)
            # A part that ends with the interval, to rounding, ends where its step does: on the left of a possible jump.
            whole = end + k * period <= until + slack
            high = np.where(whole, self.reach, np.minimum((until - begin - k * period) / self.length, self.reach))
            found.append((low, high, np.where(cut & (high - low > slack / self.length), 1.0, 0.0)))
        index = np.tile(index, 3)
        low, high, weight = (np.concatenate(x) for x in zip(*found, strict=True))
        some = weight > 0.0
        return Panels(index[some], low[some], high[some], (weight * (high - low))[some] * self.length[index[some]])

    @cached_property
    def _whole(self) -> tuple[FloatArray, Record]:
        """Times (k, ROWS) and the record at the points of every step, up to the end that it reached."""
        columns = np.concatenate([self.values, self.values @ BETWEEN], axis=2)
        fraction = self.reach[:, None] * POINTS
        short = np.flatnonzero(self.reach != 1.0)
        if short.size:
            columns[short] = np.einsum("pcn,pqn->pcq", self.values[short], basis(fraction[short]))
        t, left = self._times(slice(None), fraction)
        return t, self._make(t.ravel(), left.ravel(), columns.transpose(1, 0, 2).reshape(columns.shape[1], t.size))

    def _times(self, index: IntArray | slice, fraction: FloatArray) -> tuple[FloatArray, BoolArray]:
        t = self.start[index, None] + fraction * self.length[index, None]
        left = fraction >= self.reach[index, None]
        return np.where(left, self.reached[index, None], t), left

    def at_points(self, read: Read, panels: Panels) -> tuple[FloatArray, FloatArray]:
        """See `measures.Run`; panels that are whole steps share one record for all signals."""
        own = (panels.low == 0.0) & (panels.high == self.reach[panels.step])
        if not own.any():
            return self.values_at(read, panels.step, panels.fractions(POINTS))
        t_own, record = self._whole
        x_own = read(record).reshape(t_own.shape)
        if own.all():
            every = panels.step.size == t_own.shape[0]
            return (t_own, x_own) if every else (t_own[panels.step], x_own[panels.step])
        t, x = t_own[panels.step], x_own[panels.step]
        t[~own], x[~own] = self.values_at(read, panels.step[~own], panels.fractions(POINTS)[~own])
        return t, x

    def values_at(self, read: Read, index: IntArray, fraction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `measures.Run`; evaluates the polynomials of the steps."""
        # The signals of a run are mostly asked for at the same places, one signal after another.
        key = index.tobytes(), fraction.tobytes()
        found = self._known.get(key)
        if found is None:
            t, left = self._times(index, fraction)
            columns = np.einsum("pcn,pqn->cpq", self.values[index], basis(fraction))
            record = self._make(t.ravel(), left.ravel(), columns.reshape(columns.shape[0], t.size))
            found = t, record
            if t.size <= _MOST_KNOWN:
                while len(self._known) >= _KNOWN:
                    self._known.pop(next(iter(self._known)), None)
                self._known[key] = found
        t, record = found
        return t, read(record).reshape(t.shape)


def basis(fraction: FloatArray) -> FloatArray:
    """Weights (p, q, NODES) for interpolating values at the nodes to fractions (p, q) of a step."""
    distance = fraction[:, :, None] - _NODES
    hit = distance == 0.0
    weight = np.where(hit.any(axis=2, keepdims=True), hit, BARYCENTRIC / np.where(hit, 1.0, distance))
    weight /= weight.sum(axis=2, keepdims=True)
    return np.asarray(weight)


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
