"""A block of a recording in lanes: its pieces followed from starts that are corrected, and windows of them checked.

All pieces are followed at once (`engine.lanes.loops`). Their starts are first those of the circuit with its area held;
after each sweep they are corrected by what the modes decay by in a piece, until xi no longer changes.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.engine.lanes.loops import begin, show, span, within
from fingerspice.engine.lanes.rows import rows_of
from fingerspice.engine.lanes.weights import along
from fingerspice.solve.recordings.form import PIECES, LaneForm

# A window over its piece, and the fewest samples in one.
WINDOW, FEWEST = 1.0 / 16.0, 32
# In a network, factor of the steps to a time between two samples, which no window checks.
BETWEEN = 4
# The rate that stands for 0, 1/s.
_STILL = 1e-9


class _OfThread(threading.local):
    """Arrays of the present thread, which its next block overwrites: memory that is new to a process costs time."""

    def __init__(self) -> None:
        self.arrays: dict[str, FloatArray] = {}

    def get(self, name: str, *shape: int) -> FloatArray:
        size = math.prod(shape)
        if name not in self.arrays or self.arrays[name].size < size:
            self.arrays[name] = np.empty(size)
        return self.arrays[name][:size].reshape(shape)


_SCRATCH = _OfThread()


@dataclass(frozen=True)
class Window:
    """What steps half as long change in a window of every piece."""

    # z, off (rows, pieces, width + 1): States of the steps that are checked, and the differences; 0 in pieces that are
    # not checked
    z: FloatArray
    off: FloatArray
    # source, xi (pieces, width + 1): V
    source: FloatArray
    xi: FloatArray
    share: FloatArray  # (m, pieces): What a piece adds over what its window does, if all errors are alike
    of_products: FloatArray  # (m, m, pieces): The same of products of two errors, if they come by chance


class Block:
    """A row of samples, at once in as many pieces as the form goes in.

    Parameters
    ----------
    form : LaneForm
    x : ndarray, shape (n + 1,)
        The source at the samples, V.
    h : ndarray, shape (n,) or (1,)
        Distances of the samples, or their common distance, s.
    starts_run : bool
        Whether the run starts here, perhaps with a jump: the first piece is then checked at its start.
    """

    def __init__(self, form: LaneForm, x: FloatArray, h: FloatArray, starts_run: bool) -> None:
        self.form, self.n, self.own, self.pieces = form, x.size - 1, h.size > 1, PIECES
        self.count = -(-self.n // self.pieces)
        beyond = self.count * self.pieces - self.n
        # The source stays at its last value behind the end.
        self.x = _SCRATCH.get("x", x.size + beyond)
        self.x[: x.size], self.x[x.size :] = x, x[-1]
        self.h = np.concatenate([h, np.zeros(beyond)]) if self.own and beyond else h
        self.first = self.count * np.arange(self.pieces)
        self.starts_run, self.marks, self.active = starts_run, form.marks(self.own), form.active
        self.rates = np.maximum(form.lanes.rates, _STILL)
        self.room, self.scratch = form.room(self.own)
        self.still = form.weights(np.zeros(self.pieces if self.own else 1))
        self.m = self.rates.size
        # States at the samples: the modes, and under `mobile` the gap voltage.
        self.kept = _SCRATCH.get("kept", self.m + int(form.mobile), self.pieces, self.count + 1)
        self.left = np.zeros(self.rates.size)

    @cached_property
    def lengths(self) -> FloatArray:
        """Durations of the pieces, s."""
        if not self.own:
            return np.full(self.pieces, self.count * self.h[0])
        return np.asarray(self.h.reshape(self.pieces, self.count).sum(axis=1))

    @cached_property
    def handed(self) -> FloatArray:
        """What is left at the start of each piece of the modes at the start of the block and the ends of the pieces.

        Shape (m, pieces, 1 + pieces).
        """
        ends = np.concatenate([[0.0], np.cumsum(self.lengths)])
        since = ends[: self.pieces, None] - ends[None, :]
        left = np.exp(-self.rates[:, None, None] * np.maximum(since, 0.0))
        return np.asarray(np.where(np.tri(self.pieces, 1 + self.pieces, dtype=bool), left, 0.0))

    def _weights(self, parts: int) -> FloatArray:
        return self.scratch if self.own else self.form.weights(self.h / parts)

    def _span(self, first: IntArray, count: int, parts: int, tol: float, kept: FloatArray) -> bool:
        return bool(span(
            self.marks, self.form.lanes, self._weights(parts), self.h, self.x, first, count, parts, tol, self.room,
            kept, self.left,
        ))  # fmt: skip

    def _begin(self, starts: FloatArray, first: IntArray, kept: FloatArray) -> None:
        begin(self.marks, self.form.lanes, self.still, np.ascontiguousarray(starts), self.x[first], self.room)
        kept[: self.m, :, 0], kept[self.m :, :, 0] = starts, self._row(rows_of(self.marks).xi)

    def _row(self, number: int) -> FloatArray:
        return self.room[number * self.pieces :][: self.pieces]

    @property
    def on_one_branch(self) -> bool:
        """Whether the gap voltage at the end of a piece is that at the start of the next one, but for a percent."""
        off = self.kept[self.m :, :-1, -1] - self.kept[self.m :, 1:, 0]
        return bool(np.all(np.abs(off) <= 0.01 * np.abs(self.kept[self.m :]).max(initial=0.0)))

    def solve(self, start: FloatArray, parts: int, tol: float) -> bool:
        """Follow all pieces from `start` (m,), until xi is known to `tol` (V); False where it is not.

        The states at the samples go into `kept`.
        """
        form, active, self.sweeps = self.form, self.active, 0
        # Least distances to the fold; the last sweep may stop before the end of the pieces.
        margins = [1.0]
        self.__dict__.pop("xi", None)
        self.__dict__.pop("peaks", None)
        own = np.zeros((self.m, self.pieces))
        along(form.lanes, self.h, self.x, self.first, self.count, own)
        starts = np.einsum("kij,kj->ki", self.handed, np.concatenate([start[: self.m, None], own], axis=1))
        starts[active:] = 0.0
        for sweep in range(self.pieces + 1):
            self._begin(starts, self.first, self.kept)
            stops = self._span(self.first, self.count, parts, WINDOW * tol if sweep else -1.0, self.kept)
            self.sweeps += 1
            margins.append(1.0 - float(self._row(rows_of(self.marks).fold).max()) if form.mobile else 1.0)
            self.margin = min(margins[-2:])
            if stops:
                break
            off = self.kept[:active, :, -1] - np.roll(starts[:active], -1, axis=1)
            off[:, -1] = 0.0
            change = np.einsum("kij,kj->ki", self.handed[:active, :, 1:], off)
            self.left[:active] = np.abs(change).max(axis=1)
            most = float(np.abs(form.lanes.shape) @ self.left)
            if not most < np.inf:
                return False
            if most <= tol:
                break
            starts[:active] += change
        else:
            return False
        for k in range(active, self.m):
            # Passive modes have begun at 0 in every piece.
            self.kept[k] += np.cumsum(np.append(start[k], self.kept[k, :-1, -1]))[:, None]
        return True

    @cached_property
    def xi(self) -> FloatArray:
        """xi (V) at the samples, shape (n + 1,), after `solve`."""
        (k, columns), out = self.form.xi, _SCRATCH.get("xi", self.n + 1)
        show(k, columns, self.x, self.first, self.count, self.n + 1, self.kept, out)
        return out

    @property
    def _by_piece(self) -> FloatArray:
        """|xi| (V) at the samples of each piece, shape (pieces, count)."""
        out = _SCRATCH.get("sizes", self.pieces, self.count)
        np.abs(self.xi[:-1], out=out.reshape(-1)[: self.n])
        out.reshape(-1)[self.n :] = 0.0
        return out

    @cached_property
    def peaks(self) -> FloatArray:
        """Largest |xi| (V) at the samples of each piece, and at the next one."""
        own = self._by_piece.max(axis=1)
        return np.asarray(np.maximum(own, np.append(own[1:], abs(self.xi[-1]))))

    def end(self) -> FloatArray:
        """The state at the last sample."""
        lane = (self.n - 1) // self.count
        return np.array(self.kept[:, lane, self.n - lane * self.count])

    def check(self, parts: int) -> Window:
        """Follow a window of every piece by twice as many steps."""
        width = min(self.count, max(FEWEST, round(self.count * WINDOW / (1 + self.form.bent))))
        lanes = np.arange(self.pieces)
        off, z, at = np.empty(0), np.empty(0), lanes
        for number, place in enumerate(self._windows(width)):
            first = np.maximum(place, 0)
            coarse = self.kept[:, lanes[:, None], first[:, None] + np.arange(width + 1)]
            fine = np.empty(coarse.shape)
            self._begin(coarse[: self.m, :, 0], self.first + first, fine)
            self._span(self.first + first, width, 2 * parts, -1.0, fine)
            found = fine - coarse
            found[:, place < 0] = 0.0
            if number == 0:
                off, z, at = found, coarse, first
                continue
            worse = self._in_xi(found) > self._in_xi(off)
            off[:, worse], z[:, worse], at[worse] = found[:, worse], coarse[:, worse], first[worse]
        index = np.minimum((self.first + at)[:, None] + np.arange(width + 1), self.n)
        took = np.full(self.pieces, width * self.h[0])
        if self.own:
            took = self.h[(self.first + at)[:, None] + np.arange(width)].sum(axis=1)
        y, window = self.rates[:, None] * self.lengths, self.rates[:, None] * np.maximum(took, 1e-30)
        share, of_products = (
            np.expm1(-a) / np.expm1(-b) for a, b in ((y, window), (y[:, None] + y, window[:, None] + window))
        )
        if not self.form.bent:
            # Nothing of passive modes decays: other windows add less than the one where the source moves most.
            share[self.active :], of_products[self.active :, self.active :] = self.busy
        return Window(z, off, self.x[index], self.xi[index], share, of_products)

    def _windows(self, width: int) -> list[IntArray]:
        """Where windows begin in each piece, -1 for none: where the source moves most, and at the start of a run.

        With N as a drive, errors are large where |xi| is, too.
        """
        moves, whole = _SCRATCH.get("moves", self.pieces * self.count), self.count - self.count % width
        np.abs(np.subtract(self.x[1:], self.x[:-1], out=moves), out=moves)
        most = moves.reshape(self.pieces, self.count)[:, :whole].reshape(self.pieces, -1, width).max(axis=-1)
        # Windows end before the last sample.
        most[self.first[:, None] + width * np.arange(1, most.shape[1] + 1) > self.n] = -1.0
        place = np.where(most.max(axis=1) >= 0.0, width * np.argmax(most, axis=1), -1)
        # Windows of a piece, each by how much the source moves in it: the errors of kinks grow with its square.
        squares = (np.maximum(most, 0.0) / np.maximum(most.max(axis=1, keepdims=True), 1e-300)) ** 2
        self.busy = np.maximum(self.count / (width * most.shape[1]) * np.stack([squares, squares**2]).sum(axis=-1), 1.0)
        if self.starts_run:
            place[0] = 0
        if not self.form.bent:
            return [place]
        largest = np.minimum(
            np.argmax(self._by_piece, axis=1) - width // 2, np.minimum(self.count, self.n - self.first) - width
        )
        return [place, np.where(place >= 0, np.maximum(largest, 0), -1)]

    def _in_xi(self, off: FloatArray) -> FloatArray:
        """Largest changes of xi (V) in each lane by changes of the modes (m, pieces, width + 1)."""
        return np.asarray(np.abs(np.einsum("k,kij->ij", self.form.xi[1], off)).max(axis=1))

    def hand_on(self, added: FloatArray, before: FloatArray) -> FloatArray:
        """Errors at the start of each piece, and at the end of the block, shape (*kinds, pieces + 1).

        Pieces add `added` (*kinds, pieces), and `before` (*kinds,) is there at the start. Of one error for each mode,
        or of the products of two.
        """
        handed, lane = self.handed, (self.n - 1) // self.count
        left = np.exp(-self.rates * self.lengths[lane])
        if before.ndim == 2:
            handed, left = handed[:, None] * handed, left[:, None] * left
        at_starts = np.einsum("...ij,...j->...i", handed, np.concatenate([before[..., None], added], axis=-1))
        return np.append(at_starts, (left * at_starts[..., lane] + added[..., lane])[..., None], axis=-1)

    def at(self, number: IntArray, since: FloatArray, length: FloatArray, parts: int) -> tuple[FloatArray, FloatArray]:
        """Source (V; n,) and states (rows, n) `since` (s) after samples with these numbers, in `parts` steps."""
        lane = number // self.count
        z = np.ascontiguousarray(self.kept[:, lane, number - lane * self.count])
        x = self.x[number]
        if not since.any():
            return x, z
        to, out, form = x + (self.x[number + 1] - x) * (since / length), np.empty_like(z), self.form
        parts *= BETWEEN if self.form.bent else 1
        still, (room, _) = form.weights(np.zeros(self.pieces)), form.room(True)
        within(form.marks(True), form.lanes, still, z, x, to, since, parts, room, out)
        return to, out
