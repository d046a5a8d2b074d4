"""A series stack under a recorded source, sample by sample; see `engine.recording`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev as series_of
from numpy.polynomial.polynomial import polyval

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.engine import readout, recording, relaxation
from fingerspice.engine.relaxation import BLOCK, LEVELS, PLACES, Form
from fingerspice.engine.system import System
from fingerspice.numerics import chebyshev
from fingerspice.numerics.moments import weights
from fingerspice.physics.contact import N_PACKED
from fingerspice.results.outcome import Status
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Progress, Run
from fingerspice.solve.stackstate import model_of
from fingerspice.solve.track import Prepared, Track, prepare_system
from fingerspice.waveforms.ramps import Samples

# The fewest samples that are worth it.
LEAST_SAMPLES = 64
# The error allowed to come from a block, over the one asked for; what the stated error is over what was seen; runs, and
# what the area's polynomial may miss, over the error asked for.
SHARE, SAFETY, ATTEMPTS, AREA_SHARE = 0.2, 1.5, 4, 0.02
# Samples between two words of progress.
_AT_ONCE = 1 << 20
# From values at Chebyshev's points to the coefficients of a series.
_FIT = np.cos(np.pi * (np.arange(40) + 0.5) / 40)
_TO_SERIES = np.linalg.inv(series_of.chebvander(_FIT, 39))


@dataclass(frozen=True)
class Stretch:
    """Samples `values` (V) from `start` (s) on, `spacing` (s) apart."""

    start: float
    spacing: float
    values: FloatArray

    @property
    def stop(self) -> float:
        return self.start + (self.values.size - 1) * self.spacing


def stretches(problem: Problem) -> list[Stretch] | None:
    """The run's source as samples, where it is a recording; else None."""
    wave = problem.waveform
    if problem.scene.stack is None or not problem.scene.coupled or not isinstance(wave, Samples):
        return None
    spacing, t0, t1 = 1.0 / wave.rate, problem.t_start, problem.t_stop
    first, last = math.ceil((t0 - wave.start) * wave.rate - 1e-6), math.floor((t1 - wave.start) * wave.rate + 1e-6)
    if last - first < LEAST_SAMPLES:
        return None
    index = np.clip(np.arange(first, last + 1), 0, wave.values.size - 1)
    begin, end = wave.start + first * spacing, wave.start + last * spacing
    out = [Stretch(begin, spacing, np.ascontiguousarray(wave.values[index]))]
    if begin - t0 > 1e-6 * spacing:
        out.insert(0, Stretch(t0, begin - t0, wave.value(np.array([t0, begin]))))
    if t1 - end > 1e-6 * spacing:
        out.append(Stretch(end, t1 - end, wave.value(np.array([end, t1]))))
    return out


def _area(system: System, tol: float) -> FloatArray | None:
    """1/A as a polynomial of degree 4 k in System's variable, to an error of `tol` (relative), where one is enough."""
    series = np.asarray(system.model.curve[2 + N_PACKED :])
    if not system.scale > 0.0 or series.size < 2:
        return None
    for degree in range(4, min(relaxation.MOST_DEGREE, series.size + 2) + 1, 4):
        if np.abs(series[degree + 1 :]).sum() <= tol * np.abs(series[0]):
            kept = np.zeros(degree + 1)
            kept[: min(series.size, degree + 1)] = series[: degree + 1]
            out = np.empty(degree + 1)
            chebyshev.to_powers(kept, out)
            return out
    return None


def _moved(system: System, area: FloatArray, at_rest: float) -> FloatArray:
    """What follows the gap voltage of the charge, C: a polynomial as that of 1/A, 0 at 0 V."""
    model, (low, high) = system.model, (at_rest, (system.u_top - system.lo) * system.scale - 1.0)
    x = 0.5 * (high + low) + 0.5 * (high - low) * _FIT
    series = series_of.Chebyshev(_TO_SERIES @ (1.0 / polyval(x, area)), (low, high)).integ(lbnd=at_rest)
    slow, n = model.slow, model.gap.size
    by = slow[n + 1] * slow[n] / model.k_gap / system.scale
    kept = np.flatnonzero(np.abs(series.coef) > 1e-16 * np.abs(series.coef).max())[-1] + 1
    return np.asarray(by * series.truncate(kept).convert(kind=np.polynomial.Polynomial, domain=[-1, 1]).coef)


def form_of(system: System, area: FloatArray, spacing: float) -> Form:
    """A stack around its reference areas with the weights of steps of a sample's length and its halves."""
    model = system.model
    h = spacing / 2.0 ** np.arange(LEVELS)[:, None]
    z = system.rates[:, None, :] * h
    n, slow = model.gap.size, model.slow
    feed, taps, tap_s = system.feed, [system.gap[:, None], system.tap], [[model.k_gap], system.tap_k]
    if model.mobile:
        feed = np.concatenate([feed, system.push[:, :, None] / model.area0], axis=2)
        taps.append(np.zeros((system.q0.size, 1, n)))
        tap_s = [[0.0], system.tap_k, [1.0]]
    ratio = 0.0 if model.mobile else slow[n] / model.k_gap
    taps += [(system.slow - ratio * system.gap)[:, None], system.slow[:, None]]
    tap_s.append([0.0, 0.0 if model.mobile else slow[n]])
    every, direct = np.concatenate(taps, axis=1), np.concatenate(tap_s)
    gain = system.gain[:, None, :, None] * h[..., None]
    drives = feed[:, None, :, :, None] * h[..., None, None]

    def within(at: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        own = every[:, None] * np.exp(-z * at)[:, :, None]
        of_s = np.einsum("rpk,rskj->rspj", every, gain * weights(z, (0.0, 1.0), at))
        of_s += direct[:, None] * np.array([1.0 - at, at])
        of_g = np.einsum("rpk,rsktj->rsptj", every, drives * weights(z, (0.0, 0.5, 1.0), at)[..., None, :])
        return own, of_s, of_g

    inner, inner_s, inner_g = (np.ascontiguousarray(np.stack(x, axis=2)) for x in zip(*map(within, PLACES), strict=True))
    five = (0.0, 0.25, 0.5, 0.75, 1.0)
    quarters, early = (weights(z, five, until)[..., None, [1, 3]] for until in (1.0, 0.5))
    return Form(
        model.mobile, system.q0, system.rates, system.gain, np.exp(-z), gain * weights(z, (0.0, 1.0)),
        drives * weights(z, (0.0, 0.5, 1.0))[..., None, :], np.ascontiguousarray(feed), np.ascontiguousarray(every),
        direct, inner, inner_s, inner_g, drives * quarters,
        np.einsum("rk,rsktj->rstj", system.gap, drives * early), area, system.scale, -system.lo * system.scale - 1.0,
        model.k_gap, model.area0,
    )  # fmt: skip


def solve(
    problem: Problem, rtol: float, t_out: FloatArray, left: BoolArray, progress: Progress | None
) -> Run | None:
    """A run sample by sample, or None where that is not the way: no recording, or one too coarse for it."""
    parts = stretches(problem)
    if parts is None:
        return None
    prepared = prepare_system(problem.scene, rtol)
    area = _area(prepared.system, AREA_SHARE * rtol)
    if area is None:
        return None
    peak = max(float(np.abs(part.values).max()) for part in parts)
    scale = max(peak * model_of(problem.scene).k_gap, float(np.abs(problem.initial.y).max(initial=0.0)))
    tol, refused = SHARE * rtol * scale, 0
    for _ in range(ATTEMPTS):
        run = _follow(problem, prepared, area, parts, tol, rtol, t_out, left, progress)
        if run is None:
            return None
        refused += run.stats["rejected"]
        run.stats["rejected"] = refused
        excess = run.excess(problem.largest) / rtol
        if excess <= 1.0:
            return run
        tol *= min(0.3, 0.5 / excess)
    return None


def _follow(
    problem: Problem, prepared: Prepared, area: FloatArray, parts: list[Stretch], tol: float, rtol: float,
    t_out: FloatArray, left: BoolArray, progress: Progress | None,
) -> Run | None:  # fmt: skip
    """One attempt, with an error of `tol` (V) allowed to come from each block."""
    one = Track(problem, prepared, tol, t_out, left, repeat=False)
    system, model = prepared.system, prepared.system.model
    at_rest = -system.lo * system.scale - 1.0
    kink = float(polyval(at_rest, area[1:] * np.arange(1, area.size)))
    kink *= system.scale
    q_rest = float(polyval(at_rest, area))
    drives = system.tap_k.size + (1 if model.mobile else 0)
    kinks = np.full(drives, kink)
    if model.mobile:
        kinks[-1] = -kink / q_rest**2
    moved = _moved(system, area, at_rest)
    shown = recording.Shown(
        system.shown, system.k_shown, system.slow, system.live, system.project, system.stress, kinks, -kink / q_rest**2,
        moved, problem.charge
    )  # fmt: skip
    m = system.rates.shape[1]
    room, own = relaxation.new_room(m, drives, drives + 3), recording.new_charges()
    control, counters = np.zeros(recording.N_CONTROL), np.zeros(4, np.int64)
    control[recording.MARGIN] = 1.0
    start = problem.inner
    x = start.u_gap * system.scale
    followed = 0.0 if model.mobile else math.copysign(polyval(abs(x) + at_rest, moved), x)
    control[recording.Z], control[recording.U_GAP] = start.y[-1] - followed, start.u_gap
    r = int(np.argmin(np.abs(np.log(system.q0 / q_rest))))
    control[recording.REFERENCE] = r
    w, error, spare = system.project[r] @ start.y[:-1], np.zeros(m), np.zeros((3, max(m, drives, 3)))
    before = start.u_before
    for part in parts:
        form = form_of(system, area, part.spacing)
        if not recording.jump(model, form, float(part.values[0]), w, control):
            return None
        for first in range(0, part.values.size - 1, _AT_ONCE):
            last = min(first + _AT_ONCE, part.values.size - 1)
            code = recording.march(
                model, form, shown, room, own, part.values, first, last, part.start, part.spacing, tol, w, error,
                control, counters, spare, t_out, one.out,
            )  # fmt: skip
            if code != recording.DONE or control[recording.PEAK_U] > system.u_top:
                return None
            if progress is not None:
                progress((part.start + last * part.spacing - problem.t_start) / (problem.t_stop - problem.t_start))
        before = float(part.values[-1])
    slope = _slope_after(problem)
    recording.write_end(
        model, form, shown, room, own, before, slope, w, control, counters, spare, problem.t_stop, t_out, left, True,
        one.out,
    )  # fmt: skip
    x = float(control[recording.U_GAP]) * system.scale
    followed = 0.0 if model.mobile else math.copysign(polyval(abs(x) + at_rest, moved), x)
    z = float(control[recording.Z]) + followed
    return _as_run(problem, one, system, w, before, control, counters, z, t_out, left)


def _slope_after(problem: Problem) -> float:
    """Slope of the source right of the end of a run, V/s."""
    wave, stop = problem.waveform, problem.t_stop
    _, slope = wave.terms(np.array([stop]), np.array([stop + 1e-3 / wave.rate]))[0, :, 0]  # type: ignore[attr-defined, index]
    return float(slope)


def _as_run(
    problem: Problem, one: Track, system: System, w: FloatArray, u_before: float, control: FloatArray,
    counters: IntArray, z: float, t_out: FloatArray, left: BoolArray,
) -> Run:  # fmt: skip
    """What a march has left, as a run."""
    r = int(control[recording.REFERENCE])
    one.y[:-1], one.y[-1] = system.live[r] @ w, z
    u_gap = float(control[recording.U_GAP])
    one.control[readout.T], one.control[readout.U_BEFORE], one.control[readout.U_GAP] = problem.t_stop, u_before, u_gap
    one.control[readout.SIGN] = math.copysign(1.0, u_gap)
    one.counters[readout.OUTPUT] = counters[recording.OUTPUT]
    rows = one.written()
    stats = {"steps": int(counters[recording.STEPS]), "rejected": int(counters[recording.REFUSED]), "zeros": 0}
    evaluated = 2 * BLOCK * int(counters[recording.SWEEPS])
    run = Run(t_out[: len(rows)], left[: len(rows)], rows, Status.SUCCESS, evaluated, stats, one.state())
    peak_u, peak_f = float(control[recording.PEAK_U]), float(control[recording.PEAK_F])
    # Rounding is an error too, and what the area's polynomial misses.
    floor = 4e-16 * (peak_u + system.model.k_gap * problem.scene.u_peak)
    u_error = SAFETY * float(control[recording.ERROR_U]) + floor
    f_error = SAFETY * float(control[recording.ERROR_F]) + 2.0 * floor / (peak_u or 1.0) * peak_f
    run.gaps = np.array([[peak_u, peak_f, u_error, f_error]])
    if problem.charge:
        held = one.capacitance * (problem.scene.u_peak + peak_u)
        run.charge_error = 2.0 * SAFETY * float(control[recording.ERROR_Q]) + 4e-16 * held * (1.0 + stats["steps"])
    run.margin = float(control[recording.MARGIN])
    run.by_layer = True
    return run
