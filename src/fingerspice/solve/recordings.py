"""A series stack under a recorded source, sample by sample; see `engine.recording`."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.polynomial import chebyshev as series_of
from numpy.polynomial.polynomial import polyval

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.engine import readout, recording, relaxation
from fingerspice.engine.blockcharge import Course, new_charges
from fingerspice.engine.blockoutput import write_end
from fingerspice.engine.relaxation import BLOCK, LEVELS, PLACES, Form
from fingerspice.engine.system import System
from fingerspice.numerics import chebyshev
from fingerspice.numerics.moments import weights
from fingerspice.physics.contact import N_PACKED
from fingerspice.results.outcome import Status
from fingerspice.results.record import Record
from fingerspice.results.refined import ClosedForm
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Progress, Run, kept_with
from fingerspice.solve.stackstate import model_of
from fingerspice.solve.track import Prepared, Track, prepare_system
from fingerspice.waveforms.ramps import Samples

# The fewest samples that are worth it.
LEAST_SAMPLES = 64
# The error allowed to come from a block, over the one asked for; what the stated error is over what was seen; runs, and
# what the area's polynomial may miss, over the error asked for.
SHARE, SAFETY, ATTEMPTS, AREA_SHARE = 0.2, 2.0, 4, 0.02
# Samples between two words of progress.
_AT_ONCE = 1 << 20
# From values at Chebyshev's points to the coefficients of the antiderivative of their series.
_POINTS = 40
_AT = np.cos(np.pi * (np.arange(_POINTS) + 0.5) / _POINTS)
_INTEGRAL = series_of.chebint(np.linalg.inv(series_of.chebvander(_AT, _POINTS - 1)))
# Forms that stay with a scene, of up to 0.2 MB: one for each tolerance, spacing of samples and thread.
MOST_FORMS = 16


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
    model, slow, n = system.model, system.model.slow, system.model.gap.size
    if model.mobile:
        return np.zeros(1)
    series = slow[n + 1] * slow[n] / model.k_gap / system.scale * (_INTEGRAL @ (1.0 / polyval(_AT, area)))
    kept = np.ascontiguousarray(series[: np.flatnonzero(np.abs(series) > 1e-16 * np.abs(series).max())[-1] + 1])
    powers = np.empty(kept.size)
    chebyshev.to_powers(kept, powers)
    powers[0] -= polyval(at_rest, powers)
    return powers


def form_of(system: System, area: FloatArray, spacing: float) -> Form:
    """A stack around its reference areas with the weights of steps of a sample's length and its halves."""
    model = system.model
    h = spacing / 2.0 ** np.arange(LEVELS)[:, None]
    z = system.rates[:, None, :] * h
    n, slow = model.gap.size, model.slow
    feed, taps, tap_s = system.feed, [system.gap[:, None], system.tap], [model.k_gap, *system.tap_k]
    if model.mobile:
        feed = np.concatenate([feed, system.push[:, :, None] / model.area0], axis=2)
        taps.append(np.zeros((system.q0.size, 1, n)))
        tap_s = [0.0, *system.tap_k, 1.0]
    ratio = 0.0 if model.mobile else slow[n] / model.k_gap
    taps += [(system.slow - ratio * system.gap)[:, None], system.slow[:, None]]
    tap_s += [0.0, 0.0 if model.mobile else slow[n]]
    every, direct = np.concatenate(taps, axis=1), np.array(tap_s)
    gain = system.gain[:, None, :, None] * h[..., None]
    drives = feed[:, None, :, :, None] * h[..., None, None]

    def within(at: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        own = every[:, None] * np.exp(-z * at)[:, :, None]
        of_s = np.einsum("rpk,rskj->rspj", every, gain * weights(z, (0.0, 1.0), at))
        of_s += direct[:, None] * np.array([1.0 - at, at])
        of_g = np.einsum("rpk,rsktj->rsptj", every, drives * weights(z, (0.0, 0.5, 1.0), at)[..., None, :])
        return own, of_s, of_g

    inner, inner_s, inner_g = (
        np.ascontiguousarray(np.stack(x, axis=2)) for x in zip(*map(within, PLACES), strict=True)
    )
    five = (0.0, 0.25, 0.5, 0.75, 1.0)
    quarters, early = (weights(z, five, until)[..., None, [1, 3]] for until in (1.0, 0.5))
    return Form(
        model.mobile, system.q0, system.rates, system.gain, np.exp(-z), gain * weights(z, (0.0, 1.0)),
        drives * weights(z, (0.0, 0.5, 1.0))[..., None, :], np.ascontiguousarray(feed), np.ascontiguousarray(every),
        direct, inner, inner_s, inner_g, np.ascontiguousarray(weights(z, (0.0, 0.5, 1.0))[..., 1:]), drives * quarters,
        np.einsum("rk,rsktj->rstj", system.gap, drives * early), area, system.scale, -system.lo * system.scale - 1.0,
        model.k_gap, model.area0,
    )  # fmt: skip


@dataclass(frozen=True)
class Followed:
    """A scene ready to be followed sample by sample, to an error of a decade.

    Attributes
    ----------
    prepared : Prepared
    area : ndarray
        See `Form.area`.
    at_rest, q_rest : float
        Its variable and 1/A (1/m^2) at 0 V.
    shown : relaxation.Shown
    """

    prepared: Prepared
    area: FloatArray
    at_rest: float
    q_rest: float
    shown: relaxation.Shown

    @property
    def system(self) -> System:
        return self.prepared.system

    def followed(self, u_gap: float) -> float:
        """The charge that follows a gap voltage (V), C."""
        return math.copysign(float(polyval(abs(u_gap) * self.system.scale + self.at_rest, self.shown.moved)), u_gap)


def _followed(problem: Problem, rtol: float) -> Followed | None:
    """The scene made ready, where a polynomial for its area is good enough."""
    prepared = prepare_system(problem.scene, rtol)
    system = prepared.system
    area = _area(system, AREA_SHARE * rtol)
    if area is None:
        return None
    at_rest = -system.lo * system.scale - 1.0
    q_rest = float(polyval(at_rest, area))
    kink = float(polyval(at_rest, area[1:] * np.arange(1, area.size))) * system.scale
    kinks = np.full(system.tap_k.size, kink)
    if system.model.mobile:
        kinks = np.append(kinks, -kink / q_rest**2)
    shown = relaxation.Shown(
        system.shown, system.k_shown, system.node, system.slow, system.live, system.project, system.stress, kinks,
        -kink / q_rest**2, _moved(system, area, at_rest), problem.charge,
    )  # fmt: skip
    return Followed(prepared, area, at_rest, q_rest, shown)


def solve(problem: Problem, rtol: float, t_out: FloatArray, left: BoolArray, progress: Progress | None) -> Run | None:
    """A run sample by sample, or None where that is not the way: no recording, or one too coarse for it."""
    parts = stretches(problem)
    if parts is None:
        return None
    decade = 10.0 ** np.floor(np.log10(rtol))
    kept, thread = problem.scene.prepared, threading.get_ident()
    one = kept_with(
        kept, ("followed", decade, problem.charge, thread), MOST_FORMS, lambda: _followed(problem, decade)
    )  # fmt: skip
    if one is None:
        return None
    forms: list[Form] = []
    for part in parts:
        make = partial(form_of, one.system, one.area, part.spacing)
        forms.append(kept_with(kept, ("form", decade, part.spacing, thread), MOST_FORMS, make))
    peak = max(float(np.abs(part.values).max()) for part in parts)
    scale = max(peak * model_of(problem.scene).k_gap, float(np.abs(problem.initial.y).max(initial=0.0)))
    tol, refused = SHARE * rtol * scale, 0
    for _ in range(ATTEMPTS):
        run = _follow(problem, one, list(zip(parts, forms, strict=True)), tol, t_out, left, progress)
        if run is None:
            return None
        refused += run.stats["rejected"]
        run.stats["rejected"] = refused
        excess = run.excess(problem.largest) / rtol
        if excess <= 1.0:
            look = partial(_look, replace(problem, charge=False), rtol)
            run.continuous = ClosedForm(
                look, problem.waveform, problem.t_start, problem.first, problem.t_stop, rtol
            )  # fmt: skip
            return run
        tol *= min(0.3, 0.5 / excess)
    return None


def _look(problem: Problem, rtol: float, t: FloatArray, left: BoolArray) -> Record:
    """The run at other times."""
    run = solve(problem, rtol, t, left, None)
    assert run is not None
    return run.record(problem)


def _follow(
    problem: Problem, one: Followed, parts: list[tuple[Stretch, Form]], tol: float, t_out: FloatArray, left: BoolArray,
    progress: Progress | None,
) -> Run | None:  # fmt: skip
    """One attempt, with an error of `tol` (V) allowed to come from each block."""
    track = Track(problem, one.prepared, tol, t_out, left, repeat=False)
    system = one.system
    m, drives = system.rates.shape[1], one.shown.kink.size
    start, r = problem.inner, int(np.argmin(np.abs(np.log(system.q0 / one.q_rest))))
    control, counters = np.zeros(relaxation.N_CONTROL), np.zeros(relaxation.N_COUNTERS, np.int64)
    control[relaxation.MARGIN], control[relaxation.REFERENCE], control[relaxation.U_GAP] = 1.0, r, start.u_gap
    control[relaxation.Z] = start.y[-1] - one.followed(start.u_gap)
    course = Course(
        system.model, parts[0][1], one.shown, relaxation.new_room(m, drives, drives + 3), new_charges(),
        np.zeros((3, max(m, drives, 3))), system.project[r] @ start.y[:-1], np.zeros(m), control, counters,
    )  # fmt: skip
    for part, form in parts:
        course = course._replace(form=form)
        if not recording.jump(course, float(part.values[0])):
            return None
        for first in range(0, part.values.size - 1, _AT_ONCE):
            last = min(first + _AT_ONCE, part.values.size - 1)
            code = recording.march(
                course, part.values, first, last, part.start, part.spacing, tol, t_out, track.out
            )  # fmt: skip
            if code != recording.DONE or control[relaxation.PEAK_U] > system.u_top:
                return None
            if progress is not None:
                progress((part.start + last * part.spacing - problem.t_start) / (problem.t_stop - problem.t_start))
    end = float(parts[-1][0].values[-1])
    write_end(course, end, _slope_after(problem), t_out, track.out)
    return _as_run(problem, one, track, course, end)


def _slope_after(problem: Problem) -> float:
    """Slope of the source right of the end of a run, V/s."""
    wave, stop = problem.waveform, problem.t_stop
    assert isinstance(wave, Samples)
    after = 1e-3 / wave.rate
    here, later = wave.value([stop, stop + after]).tolist()
    return float(later - here) / after


def _as_run(problem: Problem, one: Followed, track: Track, course: Course, u_before: float) -> Run:
    """What a march has left, as a run."""
    control, counters = course.control, course.counters
    system, u_gap = one.system, float(control[relaxation.U_GAP])
    track.y[:-1] = system.live[int(control[relaxation.REFERENCE])] @ course.w
    track.y[-1] = control[relaxation.Z] + one.followed(u_gap)
    given = track.control
    given[readout.T], given[readout.U_BEFORE], given[readout.U_GAP] = problem.t_stop, u_before, u_gap
    given[readout.SIGN] = math.copysign(1.0, u_gap)
    track.counters[readout.OUTPUT] = counters[relaxation.OUTPUT]
    rows = track.written()
    n = len(rows)
    stats = {"steps": int(counters[relaxation.STEPS]), "rejected": int(counters[relaxation.REFUSED]), "zeros": 0}
    evaluated = 2 * BLOCK * int(counters[relaxation.SWEEPS])
    run = Run(track.t_out[:n], track.left[:n], rows, Status.SUCCESS, evaluated, stats, track.state())
    peak_u, peak_f = float(control[relaxation.PEAK_U]), float(control[relaxation.PEAK_F])
    # Rounding is an error too, and what the area's polynomial misses.
    floor = 4e-16 * (peak_u + system.model.k_gap * problem.scene.u_peak)
    u_error = SAFETY * float(control[relaxation.ERROR_U]) + floor
    f_error = SAFETY * float(control[relaxation.ERROR_F]) + 2.0 * floor / (peak_u or 1.0) * peak_f
    run.gaps = np.array([[peak_u, peak_f, u_error, f_error]])
    run.node_error = SAFETY * float(control[relaxation.ERROR_V]) + 4e-16 * (peak_u + problem.scene.u_peak)
    if problem.charge:
        held = track.capacitance * (problem.scene.u_peak + peak_u)
        run.charge_error = SAFETY * float(control[relaxation.ERROR_Q]) + 4e-16 * held * (1.0 + stats["steps"])
    run.margin, run.by_layer = float(control[relaxation.MARGIN]), True
    return run
