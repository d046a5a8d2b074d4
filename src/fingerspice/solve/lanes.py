"""Recordings of one finger under `local`: a block of samples as pieces in lanes, with stated errors.

Once all pieces of a block are followed (`solve.laneblock`), a window of each, where the source moves most, is followed
by steps half as long. The difference is the error of the window; a piece adds as much more as it is longer, and hands
it on to the pieces after it, as the modes decay: once as if all errors were alike, and once as if they came by chance.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.engine.blockrows import largest_of
from fingerspice.engine.lanerows import NODES
from fingerspice.engine.lanes import flow, show
from fingerspice.results.outcome import State, Status
from fingerspice.solve.following import Following, Outcome
from fingerspice.solve.laneblock import Block
from fingerspice.solve.laneform import LANES, LaneForm, Shown
from fingerspice.solve.marching import solve as solve_ordinary
from fingerspice.solve.pieces import Piece
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import excess_of

# Steps of a sample, by level.
PARTS = (1, 2, 4, 8, 16, 32, 64)
# Stated over seen errors, of voltages and charges, and of the force.
SAFETY, OF_FORCE = 2.0, 1.5
# Changes of starts that may be left, over the error asked for, and in pieces of fewer samples less; and over the
# voltages, as rounding leaves so much.
OF_STARTS, LEAST_CHANGE, SHORT = 0.01, 1e-14, 1024
# Excess below which the next block has steps twice as long, and what half the length divides an error by at least: in a
# stack, and in a network.
COARSER, FINER = 1.0 / 60.0, (5.0, 12.0)
# Error allowed in a piece that the ordinary engine integrates, over the error asked for, and at most.
LED_SHARE, LED_MOST = 0.003, 1e-8
# Relative change of a voltage over that of the area which causes it, at most: what scales with the area divides the
# voltage with what does not.
DIVIDED = 0.5
# What leaks by the error of the polynomial of 1/A over what is stored, times that error: as seen in offset recordings.
LEAKED = 0.1
# Errors by chance look alike to so many times what they add up to, as windows show a part of them only.
LUCK = 2.0
_ONE_ROW = np.zeros(1, np.int64)


class LaneMarch(Following):
    """A recording of one finger under `local` in progress, block by block."""

    def __init__(self, problem: Problem, form: LaneForm, rtol: float, share: float = 1.0) -> None:
        super().__init__(problem, rtol, share, form.gain, form.width(problem))
        self.form, m = form, form.lanes.rates.size
        self.z, self.u_last = form.start(problem)
        self.level, self.outputs, self.steps, self.refused, self.evaluated = 0, 0, 0, 0, 0
        # Errors of the modes so far, as if they were alike, and products of two, as if they came by chance.
        self.alike, self.chance = np.zeros(m), np.zeros((m, m))
        # Largest |xi| (V), and errors seen of gap voltage (V), force (N), nodes (V) and charges (C); errors that are
        # stated of the piece that the ordinary engine has integrated.
        self.peak, self.errors, self.led = 0.0, np.zeros(4), np.zeros(4)

    def follow(self, piece: Piece, values: FloatArray, t_out: FloatArray, out: FloatArray) -> Outcome:
        self.heard(values)
        if piece.led:
            return self._lead(piece, values, t_out, out)
        h = np.array([piece.spacing]) if piece.times is None else np.diff(piece.times)
        block = Block(self.form, values, h, self.steps == 0)
        while True:
            parts, excess = PARTS[self.level], math.inf
            # Another sweep over short pieces costs little.
            left = max(OF_STARTS * min(block.count / SHORT, 1.0) * self.rtol, LEAST_CHANGE)
            solved = block.solve(self.z, parts, left * self.scale)
            self.evaluated += (NODES - 1) * parts * block.n * block.sweeps
            if solved:
                peak = float(largest_of(block.n + 1, block.xi))
                if not self.form.gap(np.array(peak)) <= self.form.u_top:
                    return Outcome.LOST
                excess, errors, handed = self._judge(block, parts, max(peak, self.peak))
            if excess <= 1.0:
                break
            self.refused += parts * block.n
            if self.level + 1 == len(PARTS):
                return Outcome.NOT_MET
            divides = FINER[1] if block.marks.bend else FINER[0]
            finer = math.ceil(math.log(excess) / math.log(divides)) if excess < math.inf else 1
            self.level = min(self.level + max(1, finer), len(PARTS) - 1)
        self.peak, self.errors = max(peak, self.peak), np.maximum(errors, self.errors)
        self.alike, self.chance = handed
        self.steps += parts * block.n
        self._write(piece, block, parts, t_out, out)
        self.z, self.t, self.u_last = block.end(), piece.stop, float(values[-1])
        if excess < COARSER and self.level > 0:
            self.level -= 1
        return Outcome.MET

    def _lead(self, piece: Piece, values: FloatArray, t_out: FloatArray, out: FloatArray) -> Outcome:
        """Integrate a piece by the ordinary engine, and take over its state."""
        count = int(np.searchsorted(t_out, piece.stop - 1e-9 * piece.spacing))
        problem = replace(self.problem, t_start=piece.start, t_stop=piece.stop, first=piece.start)
        run = solve_ordinary(
            problem, min(LED_SHARE * self.rtol, LED_MOST), t_out[:count], np.zeros(count, bool), repeat=False
        )  # fmt: skip
        if run.status is not Status.SUCCESS:
            return Outcome.LOST
        out[:, :count] = run.rows.T[: self.width]
        self.z, _ = self.form.start(replace(self.problem, initial=run.state))
        self.outputs, self.t, self.u_last = count, piece.stop, float(values[-1])
        self.peak, error = abs(self.form.xi(self.z, self.u_last)), run.error
        self.led = np.array([error.u_gap, error.f_el, error.v_nodes or 0.0, error.q_source or 0.0])
        return Outcome.MET

    def _judge(self, block: Block, parts: int, peak: float) -> tuple[float, FloatArray, tuple[FloatArray, FloatArray]]:
        """Excess of the stated over the allowed error, the errors seen so far, and those that the block hands on."""
        form, active = self.form, block.active
        off, xi, share, of_products = block.check(parts)
        own = off[:, :, -1]
        products = own[:, None] * own
        alike, chance = block.hand_on(own * share, self.alike), block.hand_on(products * of_products, self.chance)
        # At the end of a piece, with what it adds beyond its window.
        alike_there = alike[:, :LANES] + own * (share - 1.0)
        chance_there = chance[..., :LANES] + products * (of_products - 1.0)

        def added(columns: FloatArray) -> FloatArray:
            """Of a sum of the modes: by chance, or by errors that are alike where chance does not explain them."""
            lucky = np.sqrt(np.maximum(np.einsum("k,l,kli->i", columns, columns, chance_there), 0.0))
            more = np.maximum(lucky, np.abs(columns @ alike_there) - LUCK * lucky)
            return np.asarray(more + np.abs(columns[:active]) @ block.left[:active] / SAFETY)

        c, errors = form.lanes, np.zeros(4)
        dxi = np.einsum("k,kij->ij", c.shape, off)
        over, dn = added(c.shape), form.bend(xi + dxi) - form.bend(xi) if form.rows.bends.any() else dxi
        # What the gap voltage, N and the force change by with xi, at most in each piece: at its peak, or at rest.
        top = np.maximum(block.peaks, 1e-9 * peak)
        e = 1.0 / form.inverse_area(np.stack([np.zeros(LANES), top])) - 1.0 / c.q0
        u_steep, n_steep = (np.abs(x / (1.0 + c.kappa * e)).max(axis=0) for x in (1.0, e))
        steep = (form.force(1.001 * top) - form.force(top)) / (1e-3 * top + 1e-300)
        errors[0] = (np.abs(dxi - c.kappa * dn).max(axis=1) + u_steep * over).max()
        errors[1] = (np.abs(form.force(xi + dxi) - form.force(xi)).max(axis=1) + steep * over).max()
        first = form.rows.k.size - form.flows
        charges = Shown(form.rows.columns[first:], form.rows.k[first:], form.rows.bends[first:])
        for i, shown in ((2, form.nodes), (3, charges)):
            for columns, bend in zip(shown.columns, shown.bends, strict=True):
                seen = np.abs(np.einsum("k,kij->ij", columns, off) + bend * dn).max(axis=1)
                errors[i] = max(errors[i], (seen + added(columns) + abs(bend) * n_steep * over).max())
        excess = self._excess(np.maximum(errors, self.errors), peak)
        if self.share < 1.0:
            alone = np.abs(dxi).max() + np.abs(c.shape @ (own * (share - 1.0))).max()
            excess = max(excess, SAFETY * alone / (self.share * self.rtol * max(peak, self.least)))
        return excess, errors, (alike[:, LANES], chance[..., LANES])

    def _excess(self, errors: FloatArray, peak: float) -> float:
        gaps, _, _ = self._stated(errors, peak)
        least = self.least, float(self.form.force(np.array(self.least)))
        gaps[0, :2] = np.maximum(gaps[0, :2], least)
        return excess_of(gaps, self.problem.rounding) / self.rtol

    def _write(self, piece: Piece, block: Block, parts: int, t_out: FloatArray, out: FloatArray) -> None:
        """Write the outputs before the end of a block."""
        first, n = self.outputs, block.n
        slack = 8e-16 * (abs(piece.start) + n * piece.spacing)
        last = first + int(np.searchsorted(t_out[first:], piece.stop - slack))
        if last == first:
            return
        t, self.outputs, rows = t_out[first:last], last, out[:, first:last]
        times = piece.times
        samples = piece.start + piece.spacing * np.arange(n) if times is None else times[:-1]
        if t.size == n and largest_of(n, t - samples) <= slack:
            slope = np.diff(block.x[: n + 1]) / block.h[:n] if self.form.flows else block.x
            self._show(block.x, slope, block.first, block.kept, rows)
            return
        number = np.clip(np.searchsorted(samples, t + slack, side="right") - 1, 0, n - 1)
        length = np.broadcast_to(block.h[:n], n)[number]
        since = t - samples[number]
        since[np.abs(since) <= slack] = 0.0
        x, z = block.at(number, np.clip(since, 0.0, length), length, parts)
        self._show(x, (block.x[number + 1] - block.x[number]) / length, _ONE_ROW, z[:, None], rows)

    def _show(self, x: FloatArray, slope: FloatArray, first: IntArray, kept: FloatArray, out: FloatArray) -> None:
        """Write outputs into the columns of `out`: from the source, its slope (1/s), and modes as in `Block`."""
        form, c, n = self.form, self.form.lanes, out.shape[1]
        count, shown, first_flow = n if first.size == 1 else int(first[1]), form.rows, form.rows.k.size - form.flows
        if shown.bends.any():
            xi = np.empty(n)
            show(c.k, c.shape, x, first, count, n, kept, xi)
            bend = form.bend(xi)
        for i, (k, share) in enumerate(zip(shown.k.tolist(), shown.bends.tolist(), strict=True)):
            show(k, shown.columns[i], x, first, count, n, kept, out[i])
            if share != 0.0:
                out[i] += share * bend
            if i >= first_flow:
                flow(c, k, shown.columns[i], share, x, slope, first, count, n, kept, out[i + form.flows])

    def finish(self, t_out: FloatArray, out: FloatArray) -> None:
        count = t_out.size - self.outputs
        if count:
            here, slope = np.full(count, self.u_last), np.full(count, self.slope_after)
            z = np.repeat(self.z[:, None, None], count, axis=2)
            self._show(here, slope, _ONE_ROW, z, out[:, self.outputs :])
        self.outputs = t_out.size

    def rows(self, t: FloatArray, left: BoolArray, out: FloatArray) -> FloatArray:
        return self.form.recorded(self.problem, out[:, : t.size])

    def state(self) -> State:
        return self.form.state(self.problem, self.z, self.t, self.u_last)

    def stated(self) -> tuple[FloatArray, float, float | None]:
        return self._stated(self.errors, self.peak)

    def _stated(self, errors: FloatArray, peak: float) -> tuple[FloatArray, float, float | None]:
        form, u_peak = self.form, self.problem.scene.u_peak
        missed, at, led = form.missed, np.array(peak), self.led.tolist()
        u, force = float(form.gap(at)), float(form.force(at))
        floor = 4e-16 * (peak + form.gain * max(u_peak, self.loudest)) + DIVIDED * missed * peak
        floor += form.lanes.kappa * form.missed_bend
        u_error = SAFETY * float(errors[0]) + floor + led[0]
        f_error = OF_FORCE * float(errors[1]) + (2.0 * floor / (u or 1.0) + missed) * force + led[1]
        node_error = SAFETY * float(errors[2]) + 4e-16 * (peak + u_peak) + floor + led[2]
        charge_error = None
        if form.flows:
            charge_error = SAFETY * float(errors[3]) + led[3]
            charge_error += form.missed_bend * float(np.abs(form.rows.bends[-form.flows :]).max())
            charge_error += (LEAKED * missed + 4e-16 * (1.0 + self.steps)) * form.held * (self.problem.largest + peak)
        return np.array([[u, force, u_error, f_error]]), node_error, charge_error

    @property
    def stats(self) -> tuple[int, int, int]:
        return self.steps, self.refused, self.evaluated

    def mark(self) -> dict[str, Any]:
        names = ("t", "loudest", "u_last", "share", "level", "steps", "refused", "evaluated", "peak")
        arrays = {name: getattr(self, name).tolist() for name in ("z", "alike", "chance", "errors", "led")}
        return {name: getattr(self, name) for name in names} | arrays

    def stand(self, mark: dict[str, Any]) -> None:
        for name, value in mark.items():
            setattr(self, name, np.array(value) if isinstance(value, list) else value)
