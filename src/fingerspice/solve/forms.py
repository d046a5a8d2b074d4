"""Circuits prepared for recordings: weights of the exponential Simpson steps, and 1/A of a stack as a polynomial.

They depend on the scene, the sample spacing and the error asked for only, so that they are made once for all blocks.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev as series_of
from numpy.polynomial.polynomial import polyder, polyval

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.engine import blockforms
from fingerspice.engine.blockcourse import Course, new_charges
from fingerspice.engine.blockforms import LEVELS, MIDDLE, ONE, PLACES, Coarse, Form
from fingerspice.engine.system import System
from fingerspice.numerics import chebyshev
from fingerspice.numerics.moments import weights
from fingerspice.physics.contact import N_PACKED
from fingerspice.results.outcome import State
from fingerspice.results.record import sided
from fingerspice.solve.problem import Problem
from fingerspice.solve.scenes import BEYOND_PEAK
from fingerspice.solve.stackstate import StackState, from_stack
from fingerspice.solve.track import as_recorded, on_branch, system_of

# Truncation error allowed for the polynomial of 1/A, relative to the error asked for.
AREA_SHARE = 0.003
# Largest ratio of neighbouring reference areas: the closer the reference, the fewer sweeps.
REFERENCE_RATIO = 1.015
# Time constants in a step from which on a fast mode is taken apart from the parabola, which resolves slower ones.
FADED = 5.0
# Nodes of the rules, in a step.
SIMPSON, BOOLE = (0.0, 0.5, 1.0), (0.0, 0.25, 0.5, 0.75, 1.0)
# Matrix from values at Chebyshev nodes to the Chebyshev coefficients of the antiderivative of their interpolant.
_POINTS = 40
_AT = np.cos(np.pi * (np.arange(_POINTS) + 0.5) / _POINTS)
_INTEGRAL = series_of.chebint(np.linalg.inv(series_of.chebvander(_AT, _POINTS - 1)))


def _area(system: System, tol: float) -> tuple[FloatArray, float] | None:
    """Coefficients of 1/A as a polynomial in the variable of `System`, and its relative error, at most `tol`.

    The degree is a multiple of 4, for the compiled evaluation; None if no degree up to MOST_DEGREE is enough.
    """
    series = np.asarray(system.model.curve[2 + N_PACKED :])
    if not system.scale > 0.0 or series.size < 2:
        return None
    for degree in range(4, min(blockforms.MOST_DEGREE, series.size + 2) + 1, 4):
        missed = float(np.abs(series[degree + 1 :]).sum() / np.abs(series[0]))
        if missed <= tol:
            kept = np.zeros(degree + 1)
            kept[: min(series.size, degree + 1)] = series[: degree + 1]
            out = np.empty(degree + 1)
            chebyshev.to_powers(kept, out)
            return out, missed
    return None


def _moved(system: System, area: FloatArray, at_rest: float) -> FloatArray:
    """Part of the charge (C) that is a function of the gap voltage: a polynomial in the variable of 1/A, 0 at 0 V."""
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
    """The stack's modes at its reference areas, with weights for steps of one sample spacing and its halvings."""
    model = system.model
    n, slow = model.gap.size, model.slow
    feed, taps, tap_s = system.feed, [system.gap[:, None], system.tap], [model.k_gap, *system.tap_k]
    if model.mobile:
        feed = np.concatenate([feed, system.push[:, :, None] / model.area0], axis=2)
        taps.append(np.zeros((system.q0.size, 1, n)))
        tap_s = [0.0, *system.tap_k, 1.0]
    ratio = 0.0 if model.mobile else slow[n] / model.k_gap
    taps += [(system.slow - ratio * system.gap)[:, None], system.slow[:, None]]
    tap_s += [0.0, 0.0 if model.mobile else slow[n]]
    return weighted(
        system.rates, system.gain, feed, np.concatenate(taps, axis=1), np.array(tap_s), spacing, mobile=model.mobile,
        q0=system.q0, area=area, scale=system.scale, shift=-system.lo * system.scale - 1.0, k_gap=model.k_gap,
        area0=model.area0, kappa=0.0, bend=np.zeros(0), bent=np.zeros(0),
        longest=ONE if model.mobile else 0,
    )  # fmt: skip


def weighted(
    rates: FloatArray, gain: FloatArray, feed: FloatArray, taps: FloatArray, tap_s: FloatArray, spacing: float,
    fast: int = -1, **others: Any,
) -> Form:  # fmt: skip
    """The form with these parts and `others` (see `Form`), and the weights that follow from them for a spacing (s)."""
    h = spacing * 2.0 ** (ONE - np.arange(LEVELS)[:, None])
    z = rates[:, None, :] * h
    by_step = gain[:, None, :, None] * h[..., None]
    drives = feed[:, None, :, :, None] * h[..., None, None]

    def within(at: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        own = taps[:, None] * np.exp(-z * at)[:, :, None]
        of_s = np.einsum("rpk,rskj->rspj", taps, by_step * weights(z, (0.0, 1.0), at))
        of_s += tap_s[:, None] * np.array([1.0 - at, at])
        of_g = np.einsum("rpk,rsktj->rsptj", taps, drives * weights(z, SIMPSON, at)[..., None, :])
        return own, of_s, of_g

    inner, inner_s, inner_g = (
        np.ascontiguousarray(np.stack(x, axis=2)) for x in zip(*map(within, PLACES), strict=True)
    )
    faded = np.zeros(z.shape[:2]) if fast < 0 else np.where(z[..., fast] > FADED, z[..., fast], 0.0)
    # To the modes at fractions of a step, from the part exp(-faded x) of the last drive.
    pulse, *pulses = [np.zeros(z.shape)] * 4
    if faded.any():
        pulse, *pulses = (feed[:, None, :, -1] * h * _pulse(z, faded, at) for at in (1.0, *PLACES))
    pulse_within = np.stack([np.einsum("rpk,rsk->rsp", taps, one) for one in pulses], axis=2)
    several = slice(others["longest"], ONE)
    quarters, simpson = weights(z, BOOLE)[..., None, [1, 3]], weights(z, SIMPSON)
    return Form(
        rates=np.ascontiguousarray(rates), gain=np.ascontiguousarray(gain), decay=np.exp(-z),
        source=by_step * weights(z, (0.0, 1.0)), drive=drives * simpson[..., None, :],
        feed=np.ascontiguousarray(feed), taps=np.ascontiguousarray(taps), tap_s=tap_s, within=inner, within_s=inner_s,
        within_g=inner_g, share=np.ascontiguousarray(simpson[..., 1:]), defect=drives * quarters,
        fast=fast, faded=faded, pulse=pulse, pulse_within=pulse_within,
        coarse=_coarse(z[:, several], by_step[:, several], drives[:, several], taps, tap_s, _derivative(others)),
        **others,
    )  # fmt: skip


def _derivative(form: dict[str, Any]) -> FloatArray:
    """The derivative of 1/A by |u|, with as many coefficients as 1/A has."""
    return np.append(form["scale"] * polyder(form["area"]), 0.0)


def _coarse(
    z: FloatArray, by_step: FloatArray, drives: FloatArray, taps: FloatArray, tap_s: FloatArray, slope: FloatArray
) -> Coarse:
    """Weights of steps of several samples: z (r, ONE, m) are the modes' rates per step, the others as in `weighted`."""

    def triangles(until: float) -> FloatArray:
        # A triangle is the sum of three straight lines that begin at its corners.
        lines = np.zeros((5, *z.shape))
        for i in range(5):
            if until > 0.25 * i:
                lines[i] = weights(z, (0.0, 1.0), until - 0.25 * i)[..., 1]
        first = [round(4.0 * place) - 1 for place in PLACES]
        return np.stack([4.0 * (lines[i] - 2.0 * lines[i + 1] + lines[i + 2]) for i in first], axis=-1)

    def hats(until: float) -> FloatArray:
        shown = triangles(until)
        shown[..., MIDDLE] -= weights(z, SIMPSON, until)[..., 1]
        return np.asarray(drives * shown[..., None, :])

    def to_places(make: Callable[[float], FloatArray]) -> FloatArray:
        return np.ascontiguousarray(np.stack([make(at) for at in PLACES], axis=2))

    bump_to = to_places(lambda at: by_step * triangles(at))
    within = np.einsum("rpk,rslkj->rslpj", taps, bump_to) + tap_s[:, None] * np.eye(3)[:, None]
    return Coarse(
        bump=by_step * triangles(1.0), bump_within=within, decay=to_places(lambda at: np.exp(-z * at)),
        source=to_places(lambda at: by_step * weights(z, (0.0, 1.0), at)), bump_to=bump_to,
        drive=to_places(lambda at: drives * weights(z, SIMPSON, at)[..., None, :]),
        defect=to_places(lambda at: drives * weights(z, BOOLE, at)[..., None, [1, 3]]),
        share=to_places(lambda at: weights(z, SIMPSON, at)[..., 1:]),
        hat=np.ascontiguousarray(hats(1.0)), hat_to=to_places(hats), slope=slope,
    )  # fmt: skip


def _pulse(z: FloatArray, faded: FloatArray, at: float) -> FloatArray:
    """Integral of exp(-z (at - x)) times what a parabola misses of exp(-faded x), x from 0 to `at`."""
    gone = np.exp(-z * at)
    rate = faded[..., None]
    apart = np.where(z == rate, 1.0, z - rate)
    true = np.where(z == rate, at * gone, (np.exp(-rate * at) - gone) / apart)
    at_nodes = np.exp(-rate[..., None] * np.array([0.0, 0.5, 1.0]))
    shown = (weights(z, SIMPSON, at) * at_nodes).sum(axis=-1)
    return np.asarray(np.where(rate > 0.0, true - shown, 0.0))


@dataclass(frozen=True)
class Follower(ABC):
    """A scene prepared for recordings, for all tolerances of one decade."""

    shown: blockforms.Shown
    share: float  # Largest gap voltage to expect for a peak of the source of 1, V/V or V/A
    u_top: float  # Largest gap voltage that the polynomials cover, V
    q_rest: float  # 1/A at 0 V, 1/m^2
    # missed, missed_u: Error of the polynomials: of 1/A, relative, and of the gap voltage in addition, V
    missed: float
    missed_u: float

    @abstractmethod
    def form(self, spacing: float) -> Form:
        """The form for steps of one sample spacing (s) and its halvings."""

    @abstractmethod
    def course(self, problem: Problem, form: Form) -> Course:
        """State and scratch arrays at the start of a run."""

    @abstractmethod
    def rows(self, problem: Problem, t: FloatArray, left: BoolArray, out: FloatArray) -> FloatArray:
        """Outputs at times `t` (s), as the compiled loop has written them, as rows of a record."""

    @abstractmethod
    def state(self, problem: Problem, course: Course, t: float, u_last: float) -> State:
        """The state reached at `t` (s), where the source has the value `u_last`."""

    @abstractmethod
    def charge_error(self, problem: Problem, course: Course, peak_u: float) -> float:
        """Error of the charge by rounding and by the polynomials so far, C."""

    @property
    def width(self) -> int:
        """Number of rows that the compiled loop writes."""
        return int(self.shown.k.size) + (2 if self.shown.charge else self.shown.flows)


@dataclass(frozen=True)
class Followed(Follower):
    """A stack prepared for recordings."""

    system: System
    area: FloatArray  # Polynomial of 1/A, see `Form.area`
    at_rest: float  # Variable of that polynomial at 0 V

    def _charge_with(self, u_gap: float) -> float:
        """Part of the charge (C) that is a function of the gap voltage (V)."""
        return math.copysign(float(polyval(abs(u_gap) * self.system.scale + self.at_rest, self.shown.moved)), u_gap)

    def form(self, spacing: float) -> Form:
        return form_of(self.system, self.area, spacing)

    def course(self, problem: Problem, form: Form) -> Course:
        system, start = self.system, problem.inner
        m, drives = system.rates.shape[1], self.shown.kink.size
        r = int(np.argmin(np.abs(np.log(system.q0 / self.q_rest))))
        control, counters = blockforms.new_control(), np.zeros(blockforms.N_COUNTERS, np.int64)
        control[blockforms.REFERENCE], control[blockforms.U_GAP] = r, start.u_gap
        control[blockforms.Z] = start.y[-1] - self._charge_with(start.u_gap)
        rooms = [blockforms.new_room(m, drives, drives + 3, self.shown) for _ in range(2)]
        return Course(
            system.model, form, self.shown, rooms[0], rooms[1], new_charges(),
            np.zeros((3, max(m, drives, 5))), system.project[r] @ start.y[:-1], np.zeros((2, m)), control, counters,
            blockforms.new_checks(self.shown),
        )  # fmt: skip

    def rows(self, problem: Problem, t: FloatArray, left: BoolArray, out: FloatArray) -> FloatArray:
        model = self.system.model
        u = sided(problem.waveform, t, left) if problem.charge and model.mobile else np.empty(0)
        return as_recorded(problem, model, out[:, : t.size].T, u)

    def state(self, problem: Problem, course: Course, t: float, u_last: float) -> State:
        control, system, offset = course.control, self.system, problem.inner.offset
        u_gap = float(control[blockforms.U_GAP])
        live = system.live[int(control[blockforms.REFERENCE])] @ course.w
        y = np.append(live, control[blockforms.Z] + self._charge_with(u_gap))
        state = StackState(t, y, u_last, u_gap, offset)
        return from_stack(problem.scene, on_branch(system.model, state, math.copysign(1.0, u_gap)))

    def charge_error(self, problem: Problem, course: Course, peak_u: float) -> float:
        model = self.system.model
        held = float(model.slow[-3]) * model.area0 * (problem.scene.u_peak + peak_u)
        return 4e-16 * held * (1.0 + int(course.counters[blockforms.STEPS]))


def rounded_peak(peak: float) -> float:
    """A peak (V) rounded up to one of four values an octave, so that recordings of about the same peak share forms."""
    return 2.0 ** (math.ceil(4.0 * math.log2(peak)) / 4.0) if peak > 0.0 else 0.0


def followed(problem: Problem, rtol: float) -> Followed | None:
    """The scene prepared for recordings with about its peak; None where no polynomial represents 1/A well enough."""
    scene, decade = problem.scene, int(np.floor(np.log10(rtol)))
    peak = rounded_peak(scene.u_peak)
    system = system_of(scene, decade, BEYOND_PEAK * peak, REFERENCE_RATIO, peak)
    found = _area(system, AREA_SHARE * rtol)
    if found is None:
        return None
    area, missed = found
    at_rest = -system.lo * system.scale - 1.0
    q_rest = float(polyval(at_rest, area))
    kink = float(polyval(at_rest, area[1:] * np.arange(1, area.size))) * system.scale
    kinks = np.full(system.tap_k.size, kink)
    if system.model.mobile:
        kinks = np.append(kinks, -kink / q_rest**2)
    shown = blockforms.Shown(
        system.shown, system.k_shown, system.node, np.zeros(0), system.slow, system.live, system.project,
        system.stress, kinks, -kink / q_rest**2, _moved(system, area, at_rest), problem.charge, np.zeros(0), 0, 0.0,
        np.array([1.0 if system.model.mobile else 0.0, 0.0]),
    )  # fmt: skip
    return Followed(shown, system.model.k_gap, system.u_top, q_rest, missed, 0.0, system, area, at_rest)
