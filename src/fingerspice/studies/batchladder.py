"""Scenes of a batch in lockstep; the number of steps is doubled for the scenes whose error is too large."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.engine.lockcard import Lengths, march_on_card
from fingerspice.engine.lockmarch import march, new_stepping, put_traces, trace_changes
from fingerspice.engine.locksamples import N_PORTION, march_samples
from fingerspice.engine.lockscenes import CELL_ROWS, LOAD, LOSS, N_OTHERS, OMEGA, REST, STRESS, new_block
from fingerspice.engine.lockstep import ALL_MOMENTS, START_TIMES, marks_of
from fingerspice.studies.batchscenes import Curves, LockstepForm, curves_of, peak_of, table_of
from fingerspice.studies.batchtask import LOCKSTEP, Answers, Task

# By the smallest rtol served: initial number of steps per period, with which nearly all scenes meet it, under one tone
# and (of the highest) under several; and initial degree of the area's polynomial, of which each takes the compiler 8 s.
_RUNGS = ((5e-4, 40, 32, 8), (5e-5, 64, 48, 8), (5e-6, 96, 96, 12), (5e-7, 144, 144, 12), (0.0, 144, 144, 24))
HIGHEST_DEGREE, MOST_STEPS = 24, 8192
# Under a recording: initial number of steps a sample, and the largest.
_PARTS = (2, 16)
# Largest gap voltage that the area's polynomial covers, as a ratio to its estimate: the second one for scenes that the
# first did not cover. It is the same for all numbers of steps, whose results are compared, because the linear part of
# the equations has the area of its middle, so that the error of a step depends on it.
COVERED = 1.2, 1.8
# Allowed defect of the periodic state relative to rtol, that of a run from rest that ends when it has settled, and the
# relative round-off added to every stated error.
CLOSING, SETTLED, ROUNDING = 0.02, 0.05, 1e-11
# The error is estimated as this share of the change from half the steps to all steps, by the smallest rtol served. The
# order is 4, which would give a fifteenth. But the kink of 1/A where the gap voltage is 0 has order 2, with a factor
# that depends on where between two steps it falls: that is most of a small error. Pieces of 4 and of 8 steps are still
# far from the order. As the change may be small by chance, doubling the steps may not reduce the estimate by more than
# the factor _MOST_GAIN.
_STATED, _STATED_JUMPING = ((5e-6, 0.25), (5e-7, 0.5), (0.0, 0.8)), 0.5
# Where a step is longer than this many of the fastest time constants, the start of a run from rest is not resolved, and
# the change is no larger than the error; it is smaller where that start is most of the error.
_STIFF, _STATED_STIFF = 2.0, ((5e-6, 0.8), (0.0, 2.5))
# A gap voltage shows the kinks at its zeros more than means do.
_STATED_TRACED = 0.8
# Under a recording the order is 3, which would give a seventh, and 2 for what the zeros of the gap voltage leave; but
# 1, which gives 1, for a dispersive skin, some of whose modes decay from each sample on within a part of a step.
_STATED_RECORDED, _STATED_DISPERSIVE = 0.5, 1.0
# What decays after a start away from 0 V meets steps of several lengths, whose errors may cancel with half the steps.
_STATED_STARTED = 2.0
_MOST_GAIN = 24.0
# Under sines and below this rtol, where the kinks are most of the error, no scene is accepted before the steps have
# been doubled once, with a smaller such factor.
_DOUBTFUL, _GAIN_IN_DOUBT = 5e-7, 12.0
# Longest first step after a jump of a square, and longest step at all of a run whose source is not 0 V at its start, in
# time constants of the fastest cell; and the voltage at the start that counts as 0 V, over all tones. Also from
# there a leaking gap's voltage jumps, as it leads the source: below this rtol the first step is as short as a square's.
_LONGEST_STEP, _FROM_ZERO, _LEADING = 1.0, 1e-12, 5e-6
# Steps of a piece of a square's half period by the smallest rtol served; and the number by which the first step, with
# `_PIECE_START` steps a piece, is shorter than the fastest cell's time constant.
_PIECES = ((5e-5, 8), (5e-7, 12), (0.0, 24))
_PIECE_START, MOST_PIECES = 2, 20
# A scene is accepted if its estimate is at most this fraction of rtol; the error stated is the estimate divided by it.
ENOUGH = 0.7
_Figure = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
#: For each figure, the indices of the moments that it needs, and the function that gives it from the moments (4, n),
#: the load, the stress at 1 V and the friction coefficient.
FIGURES: dict[str, tuple[tuple[int, ...], _Figure]] = {
    "f_el_mean": ((0,), lambda m, load, stress, mu: stress * m[0]),
    "f_el_rms": ((1,), lambda m, load, stress, mu: stress * np.sqrt(m[1])),
    "f_t_mean": ((0,), lambda m, load, stress, mu: mu * (load + stress * m[0])),
    "f_t_rms": ((0, 1), lambda m, load, stress, mu: mu * _loaded(m, load, stress)),
    "friction_mean": ((0,), lambda m, load, stress, mu: mu * (load + stress * m[0]) / load),
    "friction_rms": ((0, 1), lambda m, load, stress, mu: mu * _loaded(m, load, stress) / load),
    "u_gap_rms": ((2,), lambda m, load, stress, mu: np.sqrt(m[2])),
}


def _loaded(m: FloatArray, load: FloatArray, stress: FloatArray) -> FloatArray:
    """Root mean square of the sum of load and electroadhesive force, N."""
    return np.asarray(np.sqrt(load * load + 2.0 * load * stress * m[0] + stress * stress * m[1]))


def in_lockstep(name: str) -> bool:
    """Whether an output can be computed from the moments and gap voltages of a lockstep."""
    return name == "u_gap" or name.removesuffix("_periodic") in FIGURES


def _waves(n: int, form: LockstepForm) -> FloatArray:
    """Sine and cosine of every tone at the times that `engine.lockstep.run` needs; a square's value in both halves."""
    if n == 0 or form.jumping:
        return np.array([[1.0], [-1.0]])[: 2 * n]
    # The phase in turns is reduced before it is multiplied by 2 pi, so that high tones keep their accuracy.
    times = np.concatenate([np.arange(n), START_TIMES])
    turns = np.outer(times, form.multiples) % n * (2.0 * np.pi / n)
    return np.stack([np.sin(turns), np.cos(turns)], axis=2).reshape(times.size, -1)


def climb(
    task: Task, form: LockstepForm, scenes: Mapping[str, FloatArray], halves: int, members: NDArray[np.int64],
    found: Answers,
) -> None:  # fmt: skip
    """Integrate scenes in lockstep, doubling the steps; scenes whose error stays too large stay not done.

    Parameters
    ----------
    task : Task
    form : LockstepForm
    scenes : mapping of str to ndarray, shape (n,)
        Values by path in lower case.
    halves : int
        Length of the runs in half periods.
    members : ndarray, shape (n,)
        Their places among the answers.
    found : Answers
        Takes the results.
    """
    table = table_of(form, scenes)
    mu = friction_of(form, scenes)
    mesh = mesh_of(task, form, table, most=1 if task.traced else MOST_PIECES)
    # Scenes that settle after about as many periods share a block, which ends when all of its scenes have settled.
    order = np.argsort(_leakage_rates(form, table).min(axis=0)) if halves > 4 else np.arange(mu.size)
    every = _Scenes(table, mu, mesh, members)
    for count in np.unique(mesh.pieces[mesh.touching]).tolist():
        pending = order[(mesh.touching & (mesh.pieces == count))[order]]
        for covered in COVERED:
            pending = _climb_one(task, form, every, (halves, count), covered, pending, found)


def friction_of(form: LockstepForm, scenes: Mapping[str, FloatArray]) -> FloatArray:
    """Friction coefficient of every scene, shape (n,)."""
    mu = np.asarray(scenes.get(f"{form.layer.name.lower()}.mu", form.layer.values["mu"]))
    return np.broadcast_to(mu, next(iter(scenes.values())).shape)


class Mesh(NamedTuple):
    """What scenes need of their steps, each of shape (n,)."""

    touching: BoolArray  # Whether there is contact
    pieces: NDArray[np.int64]  # Pieces of a half period; 0 for a source that is no square
    decays: FloatArray  # Half a period in time constants of the fastest cell
    # Least number of steps a period (sample), so that steps after a jump of the source are short enough; else 0
    least: FloatArray


def mesh_of(task: Task, form: LockstepForm, table: FloatArray, most: int) -> Mesh:
    """What the scenes of a table (n_row, n) need of their steps, with at most so many pieces of a half period.

    Each piece is twice as long as the one before, so that gap voltages at equal distances need a single one.
    """
    others = CELL_ROWS * form.cells
    touching = table[others + REST] ** 2 > table[others + LOSS] * table[others + LOAD] ** 2
    pieces = np.zeros(table.shape[1], int)
    # The largest leakage rate of a cell is an upper bound of the rates of the modes.
    decays = np.max(_leakage_rates(form, table), axis=0) * np.pi
    if form.jumping:
        pieces = np.ceil(np.log2(1.0 + _PIECE_START * decays)).clip(1, most).astype(int)
        first = pieces / (2.0**pieces - 1.0)
    elif task.periodic:
        first = 0.0
    elif form.recording is not None:
        first = 0.5 * (form.recording.between(0, 1)[0] != 0.0)
    else:
        sines, cosines = table[others + N_OTHERS :: 2], table[others + N_OTHERS + 1 :: 2]
        from_zero = abs(cosines.sum(axis=0)) <= _FROM_ZERO * np.hypot(sines, cosines).sum(axis=0)
        first = np.where(from_zero, START_TIMES[1] if task.rtol < _LEADING else 0.0, 1.0)
    return Mesh(touching, pieces, decays, 2.0 * first * decays / _LONGEST_STEP)


def _leakage_rates(form: LockstepForm, table: FloatArray) -> FloatArray:
    """Leakage rate of every cell with its area at rest, in periods over 2 pi: shape (n_cell, n)."""
    others, cells = CELL_ROWS * form.cells, form.cells
    leaks = table[cells : 2 * cells] / table[others + REST] + table[2 * cells : 3 * cells]
    return np.asarray(leaks / (table[:cells] * table[others + OMEGA]))


def first_level(rtol: float, form: LockstepForm, pieces: int) -> tuple[int, int]:
    """Steps a period and degree of the area's polynomial to begin with."""
    highest = max(form.multiples)
    _, one, several, degree = next(rung for rung in _RUNGS if rtol >= rung[0])
    steps = one if highest == 1 else several * highest
    if pieces > 1:
        steps = 2 * pieces * next(s for least, s in _PIECES if rtol >= least)
    return steps, degree


class _Scenes(NamedTuple):
    """Table of scenes, friction coefficient, what they need of their steps, places of answers."""

    table: FloatArray
    mu: FloatArray
    mesh: Mesh
    members: NDArray[np.int64]


def _climb_one(
    task: Task, form: LockstepForm, scenes: _Scenes, mesh: tuple[int, int], covered: float,
    pending: NDArray[np.int64], found: Answers,
) -> NDArray[np.int64]:  # fmt: skip
    """Integrate the scenes `pending`, and return those whose gap voltage the area's polynomial does not serve.

    `mesh` is the number of half periods, and of pieces of each (0: no jumps).
    """
    others, table = CELL_ROWS * form.cells, scenes.table
    figures = [name for name in task.outputs if name != "u_gap"]
    needed = sorted({i for name in figures for i in FIGURES[name.removesuffix("_periodic")][0]} or {0})
    traced, pieces = len(figures) < len(task.outputs), mesh[1]
    steps, degree = first_level(task.rtol, form, pieces)
    most = MOST_STEPS * max(form.multiples)
    if form.recording is not None:
        steps, most = _PARTS
    if traced:
        steps = task.points * -(-steps // task.points)
    doubtful = task.rtol < _DOUBTFUL and not form.jumping and form.recording is None
    gain = _GAIN_IN_DOUBT if doubtful else _MOST_GAIN
    before, last, outside = None, np.full(pending.size, np.inf), [pending[:0]]
    while pending.size and steps <= most:
        curves = curves_of(form.layer.values["m_exp"], form.layer.values["n_exp"], degree)
        if curves is None:
            break
        level = Level(task, form, mesh, steps, degree, covered, ALL_MOMENTS if needed[-1] else 1, traced)
        now = level.run(table, pending, curves, before)
        error = level.error(now, needed, scenes.mesh.decays[pending], scenes.mesh.least[pending])
        error = np.where(np.isfinite(last), np.maximum(error, last / gain), error)
        resolved = scenes.mesh.least[pending] <= steps
        good = (error <= ENOUGH * task.rtol) & resolved
        good &= before is not None or not doubtful
        at = pending[good]
        places = scenes.members[at]
        for name in figures:
            part = 1 if name.endswith("_periodic") or task.periodic else 0
            moments = now.fine[part * level.moments : (part + 1) * level.moments, good]
            figure = FIGURES[name.removesuffix("_periodic")][1]
            load, stress = table[others + LOAD, at], table[others + STRESS, at]
            found.values[name][places] = figure(moments, load, stress, scenes.mu[at])
        if traced:
            put_traces(now.trace, np.flatnonzero(good), steps // task.points, places, found.values["u_gap"])
        found.error[places], found.status[places], found.done[places] = error[good] / ENOUGH, LOCKSTEP, True
        # More steps are no help where the area's polynomial of the highest degree is what limits the error.
        # A scene whose estimate grows from twice the steps, too: the explicit steps may be unstable around that area.
        beyond = np.isinf(now.fine[-1]) | ~good & resolved & (error > last)
        outside.append(pending[beyond])
        left = ~good & ~beyond & ((degree < HIGHEST_DEGREE) | (before is None) | (now.fine[-1] <= ENOUGH * task.rtol))
        before = Run(now.fine[:, left], now.fine[:, left], now.trace[left], now.trace[left])
        last = error[left]
        pending, steps, degree = pending[left], 2 * steps, HIGHEST_DEGREE
    return np.concatenate(outside)


class Run(NamedTuple):
    """Results of `march` with half the steps and with all steps, and the gap voltages of both."""

    coarse: FloatArray
    fine: FloatArray
    trace_coarse: FloatArray
    trace: FloatArray


class Level(NamedTuple):
    """An integration with a given number of steps per period (sample), and the area's polynomial."""

    task: Task
    form: LockstepForm
    mesh: tuple[int, int]
    steps: int
    degree: int
    covered: float
    moments: int
    traced: bool

    def run(self, table: FloatArray, pending: NDArray[np.int64], curves: Curves, before: Run | None) -> Run:
        """Integrate the scenes `pending`; the results with half the steps come from `before`, or are computed, too."""
        sizes = (self.steps // 2 if before is None else 0, self.steps)
        if self.form.recording is not None:
            return self._recorded(table, pending, curves, sizes, before)
        halves, pieces = self.mesh
        places = self.form.gap_cell, np.array(self.form.leaks)
        waves = _waves(sizes[0], self.form), _waves(sizes[1], self.form)
        source = np.array(self.form.multiples, float), waves
        tol = (CLOSING if self.task.periodic else SETTLED) * self.task.rtol
        how = halves, self.steps // 2, pieces, self.task.periodic, tol, self.covered
        widths = [halves * n // 2 if self.traced else 0 for n in sizes]
        traces = np.empty((pending.size, widths[0])), np.empty((pending.size, widths[1]))
        lengths = self._lengths(waves[1].shape[1])
        if self.task.on_card(recorded=False):
            most = MOST_PIECES if self.form.jumping else 0
            out = march_on_card(table, pending, places, curves, source, how, most, lengths)
        else:
            marks, out = marks_of(*lengths), np.empty((2, 2 * self.moments + 3, pending.size))
            block, stepping = new_block(table.shape[0], marks), new_stepping(pieces, marks)
            march(table, pending, places, curves, source, how, block, stepping, out, traces, marks)
        if before is None:
            return Run(out[0], out[1], traces[0], traces[1])
        return Run(before.fine, out[1], before.trace, traces[1])

    def _lengths(self, waves: int) -> Lengths:
        """Numbers of modes, waves, leaks, powers and moments."""
        return self.form.cells - 1, waves, len(self.form.leaks), self.degree + 1, self.moments

    def _recorded(
        self, table: FloatArray, pending: NDArray[np.int64], curves: Curves, sizes: tuple[int, int],
        before: Run | None,
    ) -> Run:  # fmt: skip
        """As `run`, under a recording."""
        recording = self.form.recording
        assert recording is not None
        rows = (1 + N_PORTION) * self.moments + 3
        marks, out = marks_of(*self._lengths(1)), np.empty((2, rows, pending.size))
        places, block = (self.form.gap_cell, np.array(self.form.leaks)), new_block(table.shape[0], marks)
        values = recording.between(0, self.mesh[0] + 1) / peak_of(recording)
        march_samples(table, pending, places, curves, values, (sizes, self.covered), block, out, marks)
        none = np.empty((pending.size, 0))
        return Run(out[0] if before is None else before.fine, out[1], none, none)

    def error(self, run: Run, needed: list[int], decays: FloatArray, fewest: FloatArray) -> FloatArray:
        """Largest estimated relative error of the outputs, for each scene; see `Mesh` for `decays`, and `least`."""
        peak, closing, tail = run.fine[-3:]
        changes = [np.zeros(peak.size)]
        for row in needed:
            size, change = np.abs(run.fine[row]), np.abs(run.fine[row] - run.coarse[row])
            later = row + self.moments
            if self.form.recording is not None:
                # Each zero of the gap voltage adds an error as if by chance, so that the sum of all may be small by
                # chance with half the steps, and not with all of them. The root of the sum of their squares is not.
                portions = slice(later, -3, self.moments)
                change = np.maximum(change, np.linalg.norm(run.fine[portions] - run.coarse[portions], axis=0))
            elif self.mesh[0] > 1:
                last = np.abs(run.fine[later])
                changes.append(np.abs(run.fine[later] - run.coarse[later]) / np.where(last > 0.0, last, 1.0))
            changes.append(change / np.where(size > 0.0, size, 1.0))
        if self.traced:
            off = np.empty(peak.size)
            trace_changes(run.trace, run.trace_coarse, off)
            changes.append(off / np.where(peak > 0.0, peak, 1.0))
        # The area's polynomial of the run with half the steps may be another one.
        change = np.max(changes, axis=0) + run.coarse[-1]
        least, stiff = (next(s for rtol, s in shares if self.task.rtol >= rtol) for shares in (_STATED, _STATED_STIFF))
        least = _STATED_TRACED if self.traced else least
        share = np.where(2.0 * decays > _STIFF * self.steps, max(least, stiff), least)
        # A start away from 0 V asks for more steps than there are decays in a half period, any other for fewer.
        share = np.where(fewest > decays, _STATED_STARTED, share)
        if self.form.jumping:
            share = np.full(peak.size, _STATED_JUMPING)
        if self.form.recording is not None:
            own = _STATED_RECORDED if self.form.cells == len(self.form.layers) else _STATED_DISPERSIVE
            share = np.full(peak.size, own)
        return np.asarray(share * change + tail + 2.0 * closing + ROUNDING)
