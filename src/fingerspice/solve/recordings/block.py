"""Which runs are followed in lanes, and in which pieces; and a block of such a piece, followed and judged.

All pieces of a block are followed at once (`engine.lanes.loops`). Their starts are first those of the circuit with its
area held; after each sweep they are corrected by what the modes decay by in a piece, until xi no longer changes.

A window of each piece, where the source moves most, is followed by steps half as long. The difference is the error of
the window; a piece adds as much more as it is longer, and hands it on to the pieces after it, as the modes decay: once
as if all errors were alike, and once as if they came by chance.
"""

from __future__ import annotations

import itertools
import math
import threading
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.engine.lanes.loops import MORE, hand_on, lead, show, span
from fingerspice.engine.lanes.rows import along, rows_of
from fingerspice.solve.problem import Problem
from fingerspice.solve.recordings.form import PIECES, LaneForm, finger, rounded_peak, stack
from fingerspice.waveforms.periodic import PWL
from fingerspice.waveforms.samples import MOST_PER_POINT, Samples, as_samples
from fingerspice.waveforms.waveform import DC

# A window over its piece, and the fewest samples in one.
WINDOW, FEWEST = 1.0 / 16.0, 32
# In a network, factor of the steps to a time between two samples, which no window checks.
BETWEEN = 4
# The rate that stands for 0, 1/s.
_STILL = 1e-9
# Least distance to the fold that is followed.
LEAST_MARGIN = 0.2
# Stated over seen errors of the force, as seen in recordings of tests/recording_errors.py.
OF_FORCE = 1.75
# Errors by chance look alike to so many times what they add up to, as windows show a part of them only.
LUCK = 2.0
# Arrays of the present thread, which its next block overwrites: memory that is new to a process costs time.
_OF_THREAD = threading.local()
# Fewest samples for which this method pays, and the samples of a piece; pieces begin at multiples of that number.
LEAST_SAMPLES, PIECE = 64, 1 << 18
# Fewest points of a PWL at uneven times for which its own steps pay, whose loop has to be compiled once.
LEAST_POINTS = 1000
# Longest step on a line between two points, over their median distance.
LONGEST = 4.0
# Number of forms cached with a scene or a stack, of up to 0.2 MB each: one for each tolerance, peak and thread.
MOST_FORMS = 16


def _scratch(name: str, *shape: int) -> FloatArray:
    size, kept = math.prod(shape), vars(_OF_THREAD)
    if name not in kept or kept[name].size < size:
        kept[name] = np.empty(size)
    return np.asarray(kept[name][:size].reshape(shape))


class Block:
    """A row of samples, at once in as many pieces as the form goes in.

    The source at the samples is x (V; n + 1,), their distances h (n,), or their common distance (1,), s. If the run
    starts here, perhaps with a jump, the first piece is checked at its start.
    """

    def __init__(self, form: LaneForm, x: FloatArray, h: FloatArray, starts_run: bool) -> None:
        self.form, self.n, self.own, self.starts_run = form, x.size - 1, h.size > 1, starts_run
        self.count = -(-self.n // PIECES)
        # The source stays at its last value behind the end.
        self.x = _scratch("x", self.count * PIECES + 1)
        self.x[: x.size], self.x[x.size :] = x, x[-1]
        self.h = np.append(h, np.zeros(self.x.size - x.size)) if self.own else h
        self.first = self.count * np.arange(PIECES)
        # Samples of a window, and the source's largest move in each window of each piece, V.
        self.width = min(self.count, max(FEWEST, round(self.count * WINDOW / (1 + form.bent))))
        self.moves = np.empty((self.count // self.width, PIECES))
        self.marks, self.active = form.marks(self.own), form.active
        self.rates = np.maximum(form.lanes.rates, _STILL)
        self.room, self.weights = form.room(self.own)
        self.m = self.rates.size
        # States at the samples: the modes, and under `mobile` the gap voltage.
        self.kept = _scratch("kept", self.m + int(form.mobile), PIECES, self.count + 1)
        self.left = np.zeros(self.m)
        # Durations of the pieces, s.
        self.lengths = self.h.reshape(PIECES, -1).sum(axis=1) if self.own else np.full(PIECES, self.count * self.h[0])
        self.decay = np.exp(-self.rates[:, None] * self.lengths)  # (m, pieces): Left of modes after each piece

    def _span(self, first: IntArray, count: int, parts: int, tol: float, kept: FloatArray) -> bool:
        """`engine.lanes.loops.span` from the modes in `kept` at the samples `first`."""
        if not self.own:
            self.form.weigh(self.h / parts, self.weights[1])
        return bool(span(
            self.marks, self.form.lanes, self.weights, self.h, self.x, first, count, parts, tol, self.room, kept,
            self.left,
        ))  # fmt: skip

    @property
    def on_one_branch(self) -> bool:
        """Whether the gap voltage stays clear of folds, and is the same in the next piece, but for a percent."""
        off = self.kept[self.m :, :-1, -1] - self.kept[self.m :, 1:, 0]
        near = np.all(np.abs(off) <= 0.01 * np.abs(self.kept[self.m :]).max(initial=0.0))
        return bool(near) and self.margin > LEAST_MARGIN

    def solve(self, start: FloatArray, parts: int, tol: float) -> bool:
        """Follow all pieces from `start` (m,), until xi is known to `tol` (V); False where it is not.

        The states at the samples go into `kept`, xi (V; n + 1,) into `xi`, its largest sizes in each piece and at the
        next sample into `peaks`.
        """
        form, active, self.sweeps = self.form, self.active, 0
        # Least distances to the fold; the last sweep may stop before the end of the pieces.
        margins, folds = [1.0], rows_of(self.marks).fold * PIECES
        own = np.zeros((self.m, PIECES))
        along(form.lanes, self.h, self.x, self.first, self.count, own, self.width, self.moves)
        starts = self._handed_on(own, start[: self.m])[:, :-1]
        starts[active:] = 0.0
        for sweep in range(PIECES + 1):
            self.kept[: self.m, :, 0] = starts
            stops = self._span(self.first, self.count, parts, WINDOW * tol if sweep else -1.0, self.kept)
            self.sweeps += 1
            fold = self.room[folds:][:PIECES] if form.mobile else np.zeros(1)
            margins.append(1.0 - float(fold.max()))
            self.margin = min(margins[-2:])
            if stops:
                break
            off = self.kept[:active, :, -1] - np.append(starts[:active, 1:], starts[:active, :1], axis=1)
            change = self._handed_on(off, np.zeros(active))[:, :-1]
            self.left[:active] = np.abs(change).max(axis=1)
            most = float(np.abs(form.lanes.shape) @ self.left)
            if not most < np.inf:
                return False
            if most <= tol:
                break
            starts[:active] += change
        else:
            return False
        # Passive modes have begun at 0 in every piece.
        passive = self.kept[active : self.m]
        passive += np.cumsum(np.column_stack([start[active : self.m], passive[:, :-1, -1]]), axis=1)[..., None]
        self.xi = _scratch("xi", self.x.size)
        show(form.xi[None], self.x, self.first, self.count, 0, self.n + 1, self.kept, self.xi[None])
        self.xi[self.n + 1 :] = self.xi[self.n]
        sizes = np.abs(self.xi)
        self.peaks = np.maximum(sizes[:-1].reshape(PIECES, self.count).max(axis=1), sizes[self.count :: self.count])
        return True

    def end(self) -> FloatArray:
        """The state at the last sample."""
        lane = (self.n - 1) // self.count
        return np.array(self.kept[:, lane, self.n - lane * self.count])

    def judge(self, parts: int, peak: float, alike: FloatArray, chance: FloatArray) -> None:
        """Errors, without safety, of the block as followed in `parts` steps a sample; `peak` is of |xi|, V.

        Those of gap voltage (V), force (N), nodes (V) and charges (C) go into `errors` (4,), that of xi (V) in a single
        piece into `alone`. With errors of the modes at the start (m,), as if they were alike, and products of two
        (m, m), as if they came by chance, `alike` and `chance` take those at the end.
        """
        form, c, (z, off, window), active, m = self.form, self.form.lanes, self._check(parts), self.active, self.m
        took = self.h[window[:, :-1]].sum(axis=1) if self.own else np.full(PIECES, self.width * self.h[0])
        y, of_window = (self.rates[:, None] * t for t in (self.lengths, np.maximum(took, 1e-30)))
        # What a piece adds over what its window does, if all errors are alike, and of products of two, if they come by
        # chance.
        share, of_products = (
            np.expm1(-a) / np.expm1(-b) for a, b in ((y, of_window), (y[:, None] + y, of_window[:, None] + of_window))
        )
        if not form.bent:
            # Nothing of passive modes decays: other windows add less than the one where the source moves most.
            share[active:], of_products[active:, active:] = self.busy
        own = off[:m, :, -1]
        products = own[:, None] * own
        handed, lucky = self._handed_on(own * share, alike), self._handed_on(products * of_products, chance)
        last = (self.n - 1) // self.count
        # What the sweeps leave of the starts is left of the end, too.
        self.alike = handed[:, last + 1] + np.copysign(self.left / OF_FORCE, handed[:, last + 1])
        self.chance, handed, lucky = lucky[..., last + 1], handed[:, :-1], lucky[..., :-1]

        def added(columns: FloatArray, left: FloatArray) -> FloatArray:
            """Of sums of the modes (C, m): by chance, or by errors that are alike where chance does not explain them.

            `left` (m, pieces) is left of each mode of what a piece starts with, to which its own part is added.
            """
            there = lucky * left[:, None] * left + products * (of_products - 1.0)
            by_chance = np.sqrt(np.maximum(np.einsum("ck,cl,kli->ci", columns, columns, there), 0.0))
            there = np.abs(columns @ (handed * left + own * (share - 1.0)))
            swept = np.abs(columns[:, :active]) * (self.left[:active] / OF_FORCE)
            return np.asarray(np.maximum(by_chance, there - LUCK * by_chance) + swept @ left[:active])

        over = added(np.vstack([c.shape, form.judged.columns]), np.ones(own.shape))
        # An error that a fast mode brings into a piece changes the force as much as xi at the first sample allows.
        decay = np.exp(-self.rates[:, None] * (self.h[self.first] if self.own else self.h))
        later = added(c.shape[None], decay * np.ones(own.shape))[0]
        alone = np.abs(np.einsum("k,kij->ij", c.shape, off[:m])).max()
        self.alone = float(alone + np.abs(c.shape @ (own * (share - 1.0))).max())
        self.errors = self._errors(z[:m], off, window, over, later, 1e-9 * peak + 1e-300)

    def _handed_on(self, added: FloatArray, before: FloatArray) -> FloatArray:
        """What is there at the start of each piece and at the end (*kinds, pieces + 1), of modes or of products of two.

        `before` (*kinds,) is there at the start of the block, of which a part is left, and pieces add `added`.
        """
        left, out = self.decay[: len(before)], np.empty((before.size, PIECES + 1))
        if before.ndim == 2:
            left = left[:, None] * left
        hand_on(left.reshape(-1, PIECES), added.reshape(-1, PIECES), before.ravel(), out)
        return out.reshape(*before.shape, PIECES + 1)

    def _errors(
        self, z: FloatArray, off: FloatArray, window: IntArray, over: FloatArray, later: FloatArray, least: float
    ) -> FloatArray:
        """`errors` from windows as in `_check`, from errors of xi and of what `LaneForm.judged` shows (1 + C, pieces),
        and of xi after the first sample (pieces,); `least` is the least |xi| (V) at which slopes are taken."""
        form, c, shown, (over, *others) = self.form, self.form.lanes, self.form.judged, over
        source, before = self.x[window], self.xi[window]
        xi = before + np.einsum("k,kij->ij", form.xi[1:], off)
        top = np.maximum(self.peaks, least)
        first = np.maximum(np.abs(self.xi[self.first]) + over, least)
        rises, rises_at_first = ((form.force(1.001 * xi) - form.force(xi)) / (1e-3 * xi) for xi in (top, first))
        # What an error of xi changes at most, between 0 V and the peak: gap voltages, what `Shown.bends` multiplies
        # (m^2), and 1/A (1/m^2/V).
        between = np.stack([np.zeros(PIECES), top])
        inverse = form.inverse_area(between)
        if form.mobile:
            u = inverse.max(axis=0) / c.q0 / self.margin
            of_inverse = np.abs(form.polynomial(c.slope, between)) * u
            moved = (float(np.abs(self.x).max()) * of_inverse / inverse**2).max(axis=0)
            of_inverse, rises, rises_at_first = of_inverse.max(axis=0), rises * u, rises_at_first * u
        else:
            e, of_inverse = 1.0 / inverse - 1.0 / c.q0, np.zeros(PIECES)
            u, moved = (np.abs(x / (1.0 + c.kappa * e)).max(axis=0) for x in (1.0, e))
        of_force = np.maximum(rises_at_first * over, rises * later)
        errors = [
            (np.abs(of(xi) - of(before)).max(axis=1) + more).max()
            for of, more in ((form.gap, u * over), (form.force, of_force))
        ]
        found = np.einsum("ck,kij->cij", shown.columns, off[: self.m])
        more = np.reshape(others, (-1, PIECES))
        if shown.by_area.any():
            whole = np.einsum("ck,kij->cij", shown.columns, z)
            other = form.inverse_area(xi)
            changed = other * found + (other - form.inverse_area(before)) * whole
            found = np.where(shown.by_area[:, None, None], changed, found)
            largest = np.abs(whole).max(axis=-1)
            more = np.where(shown.by_area[:, None], more * u * c.q0 + largest * of_inverse * over, more)
        if shown.bends.any():
            found += shown.bends[:, None, None] * (form.moved(xi, source) - form.moved(before, source))
        found = np.abs(found).max(axis=-1, initial=0.0) + (more + np.abs(shown.bends)[:, None] * moved * over)
        nodes = shown.k.size - form.flows
        return np.array([*errors, found[:nodes].max(initial=0.0), found[nodes:].max(initial=0.0)])

    def _check(self, parts: int) -> tuple[FloatArray, FloatArray, IntArray]:
        """Follow a window of every piece by twice as many steps: at large moves of the source, under N at large |xi|.

        The states there, what the steps change of them (rows, pieces, width + 1), which is 0 in pieces that are not
        checked, and the samples' numbers (pieces, width + 1).
        """
        most, width, lanes = self.moves.T, self.width, np.arange(PIECES)
        # Windows end before the last sample.
        most[self.first[:, None] + width * np.arange(1, most.shape[1] + 1) > self.n] = -1.0
        # Where windows begin in each piece, -1 for none.
        place = np.where(most.max(axis=1) >= 0.0, width * np.argmax(most, axis=1), -1)
        # Windows of a piece, each by how much the source moves in it: the errors of kinks grow with its square.
        squares = (np.maximum(most, 0.0) / np.maximum(most.max(axis=1, keepdims=True), 1e-300)) ** 2
        self.busy = np.maximum(self.count / (width * most.shape[1]) * np.stack([squares, squares**2]).sum(axis=-1), 1.0)
        if self.starts_run:
            place[0] = 0
        places = [place]
        if self.form.bent:
            ends = np.minimum(self.count, self.n - self.first) - width
            largest = np.argmax(np.abs(self.xi[:-1]).reshape(PIECES, self.count), axis=1)
            largest = np.minimum(largest - width // 2, ends)
            places.append(np.where(place >= 0, np.maximum(largest, 0), -1))
        found: list[tuple[FloatArray, FloatArray, IntArray]] = []
        for place in places:
            inside = np.maximum(place, 0)[:, None] + np.arange(width + 1)
            coarse = self.kept[:, lanes[:, None], inside]
            fine = np.empty(coarse.shape)
            fine[..., 0] = coarse[..., 0]
            self._span(self.first + inside[:, 0], width, 2 * parts, -1.0, fine)
            fine -= coarse
            fine[:, place < 0] = 0.0
            found.append((coarse, fine, self.first[:, None] + inside))
        if len(found) > 1:
            first, second = (np.abs(np.einsum("k,kij->ij", self.form.xi[1:], off)).max(axis=1) for _, off, _ in found)
            for one, other in zip(*found, strict=True):
                one[..., second > first, :] = other[..., second > first, :]
        return found[0]

    def at(self, number: IntArray, since: FloatArray, length: FloatArray, parts: int) -> tuple[FloatArray, FloatArray]:
        """Source (V; n,) and states (rows, n) `since` (s) after samples with these numbers, in `parts` steps."""
        lane = number // self.count
        z = np.ascontiguousarray(self.kept[:, lane, number - lane * self.count])
        x = self.x[number]
        if not since.any():
            return x, z
        to, form, (room, weights) = x + (self.x[number + 1] - x) * (since / length), self.form, self.form.room(True)
        parts *= BETWEEN if form.bent else 1
        still, out = np.zeros((1, self.m + 2)), np.empty((1, self.m + MORE, x.size))
        lead(form.marks(True), form.lanes, weights, z[: self.m], x, to, since, parts, still, room, out)
        return to, out[0, : len(z)]


@dataclass(frozen=True)
class Piece:
    """A part of a run with evenly spaced samples, or with the points of a PWL."""

    # start, spacing: Time of the first sample and (mean) distance of the samples, s
    start: float
    spacing: float
    # first, last: Numbers of the first and the last sample
    first: int = 0
    last: int = 0
    # (n,): Of the points of a PWL at uneven times, or of two times that are no samples, s; None for samples
    times: FloatArray | None = None

    @property
    def stop(self) -> float:
        return self.start + (self.last - self.first) * self.spacing if self.times is None else float(self.times[-1])

    def values(self, wave: Samples | PWL) -> FloatArray:
        """The source at the limits of the steps, V."""
        if self.times is not None:
            return wave.value(self.times)
        assert isinstance(wave, Samples)
        return wave.between(self.first, self.last + 1)


def driving(problem: Problem) -> tuple[int, Samples | PWL | None]:
    """Number and waveform of the one source that is a recording, where all others are at 0; else None.

    For a stack it may also be a PWL with many points, without jump in the run.
    """
    network, wave = problem.network, problem.network.waveform
    if network.stack is not None and isinstance(wave, PWL) and wave.repeat is None and as_samples(wave) is None:
        return 0, wave if _points(problem, wave).size else None
    on = [(i, as_samples(w)) for i, w in enumerate(network.waveforms) if not (isinstance(w, DC) and w.level == 0.0)]
    return on[0] if len(on) == 1 else (0, None)


def ready(problem: Problem, rtol: float) -> LaneForm | None:
    """The scene prepared for recordings, and cached; None where lanes do not apply to it."""
    scene, decade = problem.scene, float(10.0 ** np.floor(np.log10(rtol)))
    key: tuple[Any, ...] = "followed", decade, problem.charge, threading.get_ident()
    if scene.network.stack is not None:
        key = *key, scene.charge_law, rounded_peak(scene.u_peak)
        return scene.network.stack.remember(key, lambda: stack(problem, decade), MOST_FORMS)
    if scene.network.active:
        return None
    source, wave = driving(problem)
    assert isinstance(wave, Samples)
    return scene.remember(key, partial(finger, problem, decade, source, wave), MOST_FORMS)


def _points(problem: Problem, wave: PWL) -> FloatArray:
    """Times (s) of a run's points and ends, and more on long lines, kept for the last run; empty if not dense."""
    t0, t1 = problem.t_start, problem.t_stop

    def dense() -> FloatArray:
        t, slack = wave.knots[0], 1e-6 * (t1 - t0) / wave.knots[0].size
        inside = np.concatenate([[t0], t[(t > t0 + slack) & (t < t1 - slack)], [t1]])
        intervals = np.diff(inside)
        if inside.size < LEAST_POINTS or not np.all(intervals > 0.0):
            return np.empty(0)
        parts = np.cumsum(np.append(0.0, np.ceil(intervals / (LONGEST * np.median(intervals)))))
        few = parts[-1] <= 2 * inside.size
        return np.interp(np.arange(parts[-1] + 1.0), parts, inside) if few else np.empty(0)

    return wave.remember(("points", t0, t1), dense, 1)


def pieces_of(problem: Problem) -> list[Piece]:
    """The pieces of a run with a moving area that is driven by a recording of enough samples; else none."""
    _, wave = driving(problem) if problem.scene.coupled else (0, None)
    if wave is None:
        return []
    if isinstance(wave, PWL):
        points = _points(problem, wave)
        spacing, edges = float(np.diff(points).mean()), [*range(0, points.size - 1, PIECE), points.size - 1]
        return [Piece(float(points[a]), spacing, times=points[a : b + 1]) for a, b in itertools.pairwise(edges)]
    spacing, t0, t1 = 1.0 / wave.rate, problem.t_start, problem.t_stop
    first, last = math.ceil((t0 - wave.start) * wave.rate - 1e-6), math.floor((t1 - wave.start) * wave.rate + 1e-6)
    of_samples = any(isinstance(one, Samples) for one in problem.network.waveforms)
    # In a PWL with few points the source is one long line in most of the run, of which other methods need few steps.
    if last - first < LEAST_SAMPLES or not (of_samples or last - first <= MOST_PER_POINT * problem.breakpoints().size):
        return []
    begin, end = wave.start + first * spacing, wave.start + last * spacing
    early = begin - t0 > 1e-6 * spacing
    edges = [first, *range((first // PIECE + 1) * PIECE, last, PIECE), last]
    if problem.network.stack is None and not early:
        # The first step of a network is a piece of its own: see `LaneMarch.follow`.
        edges.insert(1, first + 1)
    out = [Piece(wave.start + a * spacing, spacing, a, b) for a, b in itertools.pairwise(edges) if a < b]
    if early:
        out.insert(0, Piece(t0, begin - t0, times=np.array([t0, begin])))
    if t1 - end > 1e-6 * spacing:
        out.append(Piece(end, t1 - end, times=np.array([end, t1])))
    return out
