"""Recordings of one finger, block by block in lanes (`solve.recordings.block`), with stated errors.

A run is followed in pieces of fixed length. The error of each is judged at its end, independently of later pieces. Its
outputs are therefore the same however long the run is, and whether all are held in one array or streamed in chunks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.engine.lanes.loops import flow, show
from fingerspice.results.outcome import Status
from fingerspice.solve.problem import Problem
from fingerspice.solve.recordings.block import OF_FORCE, Block, Piece, driving, pieces_of, ready
from fingerspice.solve.recordings.form import PIECES, LaneForm, StackForm
from fingerspice.solve.runs import Progress, Run, closed_form, excess_of
from fingerspice.waveforms.sampling import on_grid

# Stated over seen errors, of voltages and of charges: as seen in recordings of tests/recording_errors.py.
SAFETY, OF_CHARGE = 2.25, 2.5
# Steps of a sample, by level.
PARTS = (1, 2, 4, 8, 16, 32, 64)
# Changes of starts that may be left, over the error asked for, and in pieces of fewer samples less; and over the
# voltages, as rounding leaves so much.
OF_STARTS, LEAST_CHANGE, SHORT = 0.01, 1e-14, 1024
# Excess below which the next block has steps twice as long, and what half the length divides an error by at least: in a
# stack, and in a network.
COARSER, FINER = 1.0 / 60.0, (8.0, 12.0)
# Steps of a piece that grows in each lane, and the first one over the shortest time constant.
GROWN, EARLY = 4, 0.05
# Relative change of a voltage over that of the area which causes it, at most, under `local`: what scales with the area
# divides the voltage with what does not.
DIVIDED = 0.5
# How fine steps must be is found on so many samples at the start of a run, below these relative errors: in a stack, and
# in a network. For larger ones steps of a sample mostly do.
FIRST, AT_ONCE = 1 << 14, (3e-7, 3e-6)
# What leaks by the error of the polynomial of 1/A over what is stored, times that error: as seen in offset recordings.
LEAKED = 0.1
_ONE_ROW = np.zeros(1, np.int64)
# The error of a piece is related to the peaks up to its end, or to this share of the largest gap voltage that the
# source may cause: noise before the first loud sound need not be exact relative to itself.
LEAST_PEAK = 1e-3
# In the first sample of a network it is this share, as the errors of the polynomials stand beside a small peak there.
LEAST_AT_START = 0.1
# Share of the blocks' allowed error in the first and in the second attempt at the whole run: where errors decay slowly
# and add up, a later piece cannot make up for errors of the earlier ones.
BEGINNINGS = (1.0, 0.03)


class LostError(Exception):
    """A piece cannot be followed in lanes, however short their steps are."""


class NotMetError(LostError):
    """The error of a piece is not met: with less error from the pieces before it, it may be."""


class LaneMarch:
    """A recording of one finger in progress, piece by piece."""

    # What follows from the run alone, or is counted anew: all else changes from piece to piece.
    _SETTLED = ("problem", "form", "rtol", "pieces", "wave", "expected", "least", "outputs")

    def __init__(self, problem: Problem, pieces: list[Piece], form: LaneForm, rtol: float, share: float = 1.0) -> None:
        # The error allowed is reduced to a `share` where errors of earlier pieces add up.
        self.problem, self.form, self.rtol, self.share = problem, form, rtol, share
        self.pieces, self.place = pieces, 0  # The next piece is number `place`
        _, wave = driving(problem)
        assert wave is not None
        # Time reached (s), and largest |U| of the source so far, V.
        self.wave, self.t, self.loudest = wave, problem.t_start, 0.0
        # Of a source of current the scene knows no peak.
        self.expected = form.gain * (problem.scene.u_peak or wave.peak(0.0, problem.t_stop))
        self.least = max(float(np.abs(problem.initial.y).max(initial=0.0)), LEAST_PEAK * self.expected)
        # Modes, behind them under `mobile` the gap voltage, and the source.
        self.z, self.u_last = form.start(problem)
        # The number of `outputs` so far is that in the array they are written to.
        self.level, self.outputs, self.steps, self.refused, self.evaluated, self.margin = 0, 0, 0, 0, 0, 1.0
        # Errors of the modes so far, as if they were alike, and products of two, as if they came by chance.
        m = form.lanes.rates.size
        self.alike, self.chance = np.zeros(m), np.zeros((m, m))
        # Largest |xi| (V), and errors seen of gap voltage (V), force (N), nodes (V) and charges (C).
        self.peak, self.errors = 0.0, np.zeros(4)

    def outputs_at(self, t_out: FloatArray) -> FloatArray:
        """An array for outputs at these times, which begin to be counted from 0."""
        self.outputs = 0
        return np.empty((self.form.rows.k.size + self.form.flows, t_out.size))

    def follow(self, t_out: FloatArray, out: FloatArray) -> None:
        """Integrate the next piece, and write the outputs before its end as rows of `out`; `LostError` where it cannot.

        After the last piece the outputs at the end of the run follow. Where a run of a network starts, the source may
        jump, after which fast modes decay that no step of a sample resolves: there the steps, on one line of the
        source, grow from a part of the shortest time constant on.
        """
        piece, grows = self.pieces[self.place], self.place == 0 and self.problem.network.stack is None
        values = piece.values(self.wave)
        self.loudest = max(self.loudest, float(values.max()), -float(values.min()))
        if grows:
            span = piece.stop - piece.start
            shortest = min(EARLY / float(self.form.lanes.rates.max()), span / (PIECES * GROWN))
            share = np.append(0.0, np.geomspace(shortest / span, 1.0, PIECES * GROWN))
            share[-1] = 1.0
            piece = replace(piece, times=piece.start + share * span)
            values = values[0] + share * (values[-1] - values[0])
        h = np.array([piece.spacing]) if piece.times is None else np.diff(piece.times)
        tries = self.steps == 0 and self.rtol < AT_ONCE[self.form.bent] and values.size > 4 * FIRST
        for size in (FIRST, values.size - 1)[0 if tries else 1 :]:
            block = Block(self.form, values[: size + 1], h[:size], self.steps == 0)
            excess = self._climb(block, LEAST_AT_START if grows else LEAST_PEAK)
        parts, self.peak = PARTS[self.level], max(float(block.peaks.max()), self.peak)
        self.errors = np.maximum(block.errors, self.errors)
        self.alike, self.chance, self.margin = block.alike, block.chance, min(self.margin, block.margin)
        self.steps += parts * block.n
        self._write(piece, block, parts, t_out, out)
        self.z, self.t, self.u_last = block.end(), piece.stop, float(values[-1])
        self.level = 0 if grows else max(self.level - int(excess < COARSER), 0)
        self.place += 1
        if self.place == len(self.pieces):
            # The outputs at the end of the run, with the source's slope after it.
            count, after = t_out.size - self.outputs, 1e-3 * max(piece.spacing for piece in self.pieces)
            (rise,) = np.diff(self.wave.value([self.problem.t_stop, self.problem.t_stop + after])) / after
            at_end = np.repeat(self.z[:, None, None], count, axis=2)
            self._show(np.full(count, self.u_last), np.full(count, rise), at_end, out)

    def _climb(self, block: Block, share: float) -> float:
        """Solve a block, with ever more steps until its error is met; the excess of the errors stated."""
        form = self.form
        while True:
            parts, excess = PARTS[self.level], math.inf
            # Another sweep over short pieces costs little.
            left = max(OF_STARTS * min(block.count / SHORT, 1.0) * self.rtol, LEAST_CHANGE)
            solved = block.solve(self.z, parts, left * max(self.loudest * form.gain, self.least))
            self.evaluated += (form.inner + 1) * parts * block.n * block.sweeps
            if solved:
                peak = float(block.peaks.max())
                # Under `mobile` the run stays on the branch on which it starts.
                near = not (form.mobile and isinstance(form, StackForm)) or (
                    abs(block.xi[0] - form.after(self.z, float(block.x[0]))) <= 0.01 * peak
                )
                if not (near and block.on_one_branch and form.gap(np.array(peak)) <= form.u_top):
                    raise LostError
                peak = max(peak, self.peak)
                block.judge(parts, peak, self.alike, self.chance)
                gaps, _, _ = self._stated(np.maximum(block.errors, self.errors), peak)
                # Errors are related to a share of the largest gap voltage to expect at least.
                least = max(self.least, share * self.expected)
                gaps[0, :2] = np.maximum(gaps[0, :2], [least, float(form.force(np.array(least)))])
                excess = excess_of(gaps, self.problem.rounding) / self.rtol
                if self.share < 1.0:
                    excess = max(excess, SAFETY * block.alone / (self.share * self.rtol * max(peak, self.least)))
                if excess <= 1.0:
                    return excess
            self.refused += parts * block.n
            if self.level + 1 == len(PARTS):
                raise NotMetError
            finer = math.ceil(math.log(excess) / math.log(FINER[form.bent])) if excess < math.inf else 1
            self.level = min(self.level + max(1, finer), len(PARTS) - 1)

    def _write(self, piece: Piece, block: Block, parts: int, t_out: FloatArray, out: FloatArray) -> None:
        """Write the outputs before the end of a block."""
        first, n = self.outputs, block.n
        slack = 8e-16 * (abs(piece.start) + n * piece.spacing)
        last = first + int(np.searchsorted(t_out[first:], piece.stop - slack))
        t, times = t_out[first:last], piece.times
        if t.size == n and (
            on_grid(t, piece.start, piece.spacing, slack) if times is None else np.abs(t - times[:-1]).max() <= slack
        ):
            slope = np.diff(block.x[: n + 1]) / block.h[:n] if self.form.flows else block.x
            self._show(block.x, slope, block.kept, out, block.first, block.xi[:n])
            return
        samples = piece.start + piece.spacing * np.arange(n) if times is None else times[:-1]
        number = np.clip(np.searchsorted(samples, t + slack, side="right") - 1, 0, n - 1)
        length = np.broadcast_to(block.h[:n], n)[number]
        since = t - samples[number]
        since[np.abs(since) <= slack] = 0.0
        x, z = block.at(number, np.clip(since, 0.0, length), length, parts)
        self._show(x, (block.x[number + 1] - block.x[number]) / length, z[:, None], out)

    def _show(
        self, x: FloatArray, slope: FloatArray, kept: FloatArray, out: FloatArray, first: IntArray = _ONE_ROW,
        xi: FloatArray | None = None,
    ) -> None:  # fmt: skip
        """Write the next outputs into columns of `out`: from source, slope (V/s), states as in `Block`, and xi (n,)."""
        form, shown, start, n = self.form, self.form.rows, self.outputs, x.size if xi is None else xi.size
        if xi is None:
            xi = np.empty(n)
            show(form.xi[None], x, first, n, 0, n, kept, xi[None])
        count, charges, self.outputs = n if first.size == 1 else int(first[1]), len(shown.k) - form.flows, start + n
        show(form.shown, x, first, count, start, n, kept, out)
        rows = out[:, start : self.outputs]
        if shown.by_area.any():
            inverse = form.inverse_area(xi)
            for i in np.flatnonzero(shown.by_area):
                rows[i] = rows[i] * inverse + shown.k[i] * x[:n]
        if shown.bends.any():
            moved = form.moved(xi, x[:n])
            for i in np.flatnonzero(shown.bends):
                rows[i] += shown.bends[i] * moved
        for by, share, own in zip(form.shown[charges:], shown.bends[charges:], rows[len(shown.k) :], strict=True):
            flow(form.lanes, by, float(share), x, slope, first, count, kept, xi, own)

    def _stated(self, errors: FloatArray, peak: float) -> tuple[FloatArray, float, float | None]:
        """Peaks and stated errors as in `Run.gaps`, and stated errors of the nodes (V) and the charge (C)."""
        form, u_peak = self.form, self.problem.scene.u_peak
        missed, at = form.missed, np.array(peak)
        u, force = float(form.gap(at)), float(form.force(at))
        floor = 4e-16 * (peak + form.gain * max(u_peak, self.loudest))
        floor += (1.0 / self.margin if form.mobile else DIVIDED) * missed * peak
        floor += form.lanes.kappa * form.missed_bend
        u_error = SAFETY * float(errors[0]) + floor
        f_error = OF_FORCE * float(errors[1]) + (2.0 * floor / (u or 1.0) + missed) * force
        node_error = SAFETY * float(errors[2]) + 4e-16 * (peak + u_peak) + floor
        charge_error = None
        if form.flows:
            charge_error = OF_CHARGE * float(errors[3])
            charge_error += form.missed_bend * float(np.abs(form.rows.bends[-form.flows :]).max())
            charge_error += (LEAKED * missed + 4e-16 * (1.0 + self.steps)) * form.held * (self.problem.largest + peak)
        return np.array([[u, force, u_error, f_error]]), node_error, charge_error

    def mark(self) -> dict[str, Any]:
        """The state of the integration: attributes, which another march through the same run may be given."""
        return {name: value for name, value in vars(self).items() if name not in self._SETTLED}

    def run(self, t: FloatArray, left: BoolArray, rows: FloatArray) -> Run:
        """The run so far, with the given outputs."""
        stats = {"steps": self.steps, "rejected": self.refused, "zeros": 0}
        state = self.form.state(self.problem, self.z, self.t, self.u_last)
        run = Run(t, left, rows, Status.SUCCESS, self.evaluated, stats, state)
        run.gaps, run.node_error, run.charge_error = self._stated(self.errors, self.peak)
        run.margin, run.by_layer = self.margin, self.problem.network.stack is not None
        return run


def prepared(problem: Problem, rtol: float) -> tuple[list[Piece], LaneForm] | None:
    """The pieces of a run and the scene prepared for them; None where this method does not apply."""
    pieces = pieces_of(problem)
    form = ready(problem, rtol) if pieces else None
    return (pieces, form) if pieces and form else None


def solve(problem: Problem, rtol: float, progress: Progress | None = None) -> Run | None:
    """A run sample by sample; None where this method does not apply (no recording) or does not meet the error."""
    found, refused, t_out = prepared(problem, rtol), 0, problem.t_out
    if found is None:
        return None
    for share in BEGINNINGS:
        march = LaneMarch(problem, *found, rtol, share)
        out = march.outputs_at(t_out)
        try:
            while march.place < len(march.pieces):
                march.follow(t_out, out)
                if progress is not None:
                    progress(problem.done(march.t))
        except NotMetError:
            refused += march.refused
            continue
        except LostError:
            return None
        run = march.run(t_out, problem.left, out.T)
        run.stats["rejected"] += refused
        # Else the peaks stayed below LEAST_PEAK of the expected one, to which the pieces' errors related.
        if excess_of(run.gaps, problem.rounding) <= rtol:
            again = cast("Callable[[Problem], Run]", partial(solve, rtol=rtol))
            run.continuous = closed_form(replace(problem, charge=False), again, rtol)
            return run
    return None
