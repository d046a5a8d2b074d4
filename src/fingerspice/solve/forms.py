"""Circuits prepared for recordings: weights of the exponential Simpson steps, and stacks under `mobile`.

They depend on the scene, the sample spacing and the error asked for only, so that they are made once for all blocks.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyval

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.engine import blockforms
from fingerspice.engine.blockcourse import Course, new_charges
from fingerspice.engine.blockforms import LEVELS, PLACES, Form
from fingerspice.engine.system import System
from fingerspice.numerics.moments import weights
from fingerspice.results.outcome import State
from fingerspice.results.record import sided
from fingerspice.solve.laneform import AREA_SHARE, area_powers, rounded_peak
from fingerspice.solve.problem import Problem
from fingerspice.solve.scenes import BEYOND_PEAK
from fingerspice.solve.stackstate import StackState, from_stack
from fingerspice.solve.track import as_recorded, on_branch, system_of

# Largest ratio of neighbouring reference areas: the closer the reference, the fewer sweeps.
REFERENCE_RATIO = 1.015
# Time constants in a step from which on a fast mode is taken apart from the parabola, which resolves slower ones.
FADED = 5.0
# Nodes of the rules, in a step.
SIMPSON, BOOLE = (0.0, 0.5, 1.0), (0.0, 0.25, 0.5, 0.75, 1.0)


def form_of(system: System, area: FloatArray, spacing: float) -> Form:
    """The stack's modes at its reference areas, with weights for steps of one sample spacing and its halvings."""
    model = system.model
    # The last drive is (1/q - 1/q0) U, and the last projection the slowest layer's voltage.
    feed = np.concatenate([system.feed, system.push[:, :, None] / model.area0], axis=2)
    nothing = np.zeros((system.q0.size, 1, model.gap.size))
    taps = np.concatenate([system.gap[:, None], system.tap, nothing, system.slow[:, None]], axis=1)
    return weighted(
        system.rates, system.gain, feed, taps, np.array([0.0, *system.tap_k, 1.0, 0.0]), spacing, mobile=True,
        q0=system.q0, area=area, scale=system.scale, shift=-system.lo * system.scale - 1.0, k_gap=model.k_gap,
        area0=model.area0, kappa=0.0, bend=np.zeros(0), bent=np.zeros(0),
    )  # fmt: skip


def weighted(
    rates: FloatArray, gain: FloatArray, feed: FloatArray, taps: FloatArray, tap_s: FloatArray, spacing: float,
    fast: int = -1, **others: Any,
) -> Form:  # fmt: skip
    """The form with these parts and `others` (see `Form`), and the weights that follow from them for a spacing (s)."""
    h = spacing * 2.0 ** -np.arange(LEVELS)[:, None]
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
    quarters, simpson = weights(z, BOOLE)[..., None, [1, 3]], weights(z, SIMPSON)
    return Form(
        rates=np.ascontiguousarray(rates), gain=np.ascontiguousarray(gain), decay=np.exp(-z),
        source=by_step * weights(z, (0.0, 1.0)), drive=drives * simpson[..., None, :],
        feed=np.ascontiguousarray(feed), taps=np.ascontiguousarray(taps), tap_s=tap_s, within=inner, within_s=inner_s,
        within_g=inner_g, share=np.ascontiguousarray(simpson[..., 1:]), defect=drives * quarters,
        fast=fast, faded=faded, pulse=pulse, pulse_within=pulse_within,
        **others,
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

    def form(self, spacing: float) -> Form:
        return form_of(self.system, self.area, spacing)

    def course(self, problem: Problem, form: Form) -> Course:
        system, start = self.system, problem.inner
        m, drives = system.rates.shape[1], self.shown.kink.size
        r = int(np.argmin(np.abs(np.log(system.q0 / self.q_rest))))
        control, counters = blockforms.new_control(), np.zeros(blockforms.N_COUNTERS, np.int64)
        control[blockforms.REFERENCE], control[blockforms.U_GAP] = r, start.u_gap
        control[blockforms.Z] = start.y[-1]
        return Course(
            system.model, form, self.shown, blockforms.new_room(m, drives, drives + 2, self.shown), new_charges(),
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
        y = np.append(live, control[blockforms.Z])
        state = StackState(t, y, u_last, u_gap, offset)
        return from_stack(problem.scene, on_branch(system.model, state, math.copysign(1.0, u_gap)))

    def charge_error(self, problem: Problem, course: Course, peak_u: float) -> float:
        model = self.system.model
        held = float(model.slow[-3]) * model.area0 * (problem.scene.u_peak + peak_u)
        return 4e-16 * held * (1.0 + int(course.counters[blockforms.STEPS]))


def followed(problem: Problem, rtol: float) -> Followed | None:
    """The scene prepared for recordings with about its peak; None where no polynomial represents 1/A well enough."""
    scene, decade = problem.scene, int(np.floor(np.log10(rtol)))
    peak = rounded_peak(scene.u_peak)
    system = system_of(scene, decade, BEYOND_PEAK * peak, REFERENCE_RATIO, peak)
    found = area_powers(system, AREA_SHARE * rtol)
    if found is None:
        return None
    area, missed = found
    at_rest = -system.lo * system.scale - 1.0
    q_rest = float(polyval(at_rest, area))
    kink = float(polyval(at_rest, area[1:] * np.arange(1, area.size))) * system.scale
    kinks = np.append(np.full(system.tap_k.size, kink), -kink / q_rest**2)
    shown = blockforms.Shown(
        system.shown, system.k_shown, system.node, np.zeros(0), system.slow, system.live, system.project,
        system.stress, kinks, -kink / q_rest**2, problem.charge, np.zeros(0), 0, 0.0, np.array([1.0, 0.0]),
    )  # fmt: skip
    return Followed(shown, system.model.k_gap, system.u_top, q_rest, missed, 0.0, system, area, at_rest)
