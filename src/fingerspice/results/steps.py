"""A run between its outputs: the recorded steps, and the number of equal periods that each represents."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.engine.readout import RECORDED, Steps, new_steps
from fingerspice.numerics.lobatto import BARYCENTRIC, BETWEEN, NODES, POINTS
from fingerspice.results.measures import Panels, Read
from fingerspice.results.record import Record
from fingerspice.waveforms.sampling import same_time

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
