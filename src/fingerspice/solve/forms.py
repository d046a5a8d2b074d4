"""Circuits prepared for recordings: weights of the exponential Simpson steps, and stacks under `mobile`.

They depend on the scene, the sample spacing and the error asked for only, so that they are made once for all blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
# Nodes of the rules, in a step.
SIMPSON, BOOLE = (0.0, 0.5, 1.0), (0.0, 0.25, 0.5, 0.75, 1.0)


def form_of(system: System, area: FloatArray, spacing: float) -> Form:
    """The stack's modes at its reference areas, with weights for steps of one sample spacing and its halvings."""
    model = system.model
    # The last drive is (1/q - 1/q0) U, and the last projection the slowest layer's voltage.
    feed = np.concatenate([system.feed, system.push[:, :, None] / model.area0], axis=2)
    nothing = np.zeros((system.q0.size, 1, model.gap.size))
    taps = np.concatenate([system.gap[:, None], system.tap, nothing, system.slow[:, None]], axis=1)
    rates, gain, tap_s = system.rates, system.gain, np.array([0.0, *system.tap_k, 1.0, 0.0])
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
    quarters, simpson = weights(z, BOOLE)[..., None, [1, 3]], weights(z, SIMPSON)
    return Form(
        rates=np.ascontiguousarray(rates), gain=np.ascontiguousarray(gain), decay=np.exp(-z),
        source=by_step * weights(z, (0.0, 1.0)), drive=drives * simpson[..., None, :],
        feed=np.ascontiguousarray(feed), taps=np.ascontiguousarray(taps), tap_s=tap_s, within=inner, within_s=inner_s,
        within_g=inner_g, share=np.ascontiguousarray(simpson[..., 1:]), defect=drives * quarters, q0=system.q0,
        area=area, scale=system.scale, shift=-system.lo * system.scale - 1.0, k_gap=model.k_gap, area0=model.area0,
    )  # fmt: skip


@dataclass(frozen=True)
class Followed:
    """A stack under `mobile` prepared for recordings, for all tolerances of one decade."""

    system: System
    area: FloatArray  # Polynomial of 1/A, see `Form.area`
    at_rest: float  # Variable of that polynomial at 0 V
    shown: blockforms.Shown
    q_rest: float  # 1/A at 0 V, 1/m^2
    missed: float  # Relative error of the polynomial

    @property
    def width(self) -> int:
        """Number of rows that the compiled loop writes."""
        return int(self.shown.k.size) + (2 if self.shown.charge else 0)

    def form(self, spacing: float) -> Form:
        """The form for steps of one sample spacing (s) and its halvings."""
        return form_of(self.system, self.area, spacing)

    def course(self, problem: Problem, form: Form) -> Course:
        """State and scratch arrays at the start of a run."""
        system, start = self.system, problem.inner
        m, drives = system.rates.shape[1], self.shown.kink.size
        r = int(np.argmin(np.abs(np.log(system.q0 / self.q_rest))))
        control, counters = blockforms.new_control(), np.zeros(blockforms.N_COUNTERS, np.int64)
        control[blockforms.REFERENCE], control[blockforms.U_GAP] = r, start.u_gap
        control[blockforms.Z] = start.y[-1]
        return Course(
            system.model, form, self.shown, blockforms.new_room(m, drives, drives + 2, self.shown), new_charges(),
            np.zeros((3, max(m, drives, 5))), system.project[r] @ start.y[:-1], np.zeros((2, m)), control, counters,
            blockforms.new_checks(),
        )  # fmt: skip

    def rows(self, problem: Problem, t: FloatArray, left: BoolArray, out: FloatArray) -> FloatArray:
        """Outputs at times `t` (s), as the compiled loop has written them, as rows of a record."""
        u = sided(problem.waveform, t, left) if problem.charge else np.empty(0)
        return as_recorded(problem, self.system.model, out[:, : t.size].T, u)

    def state(self, problem: Problem, course: Course, t: float, u_last: float) -> State:
        """The state reached at `t` (s), where the source has the value `u_last` (V)."""
        control, system, offset = course.control, self.system, problem.inner.offset
        u_gap = float(control[blockforms.U_GAP])
        live = system.live[int(control[blockforms.REFERENCE])] @ course.w
        y = np.append(live, control[blockforms.Z])
        state = StackState(t, y, u_last, u_gap, offset)
        return from_stack(problem.scene, on_branch(system.model, state, math.copysign(1.0, u_gap)))

    def charge_error(self, problem: Problem, course: Course, peak_u: float) -> float:
        """Error of the charge by rounding so far, C."""
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
        system.shown, system.k_shown, system.node, system.slow, system.live, system.project, system.stress, kinks,
        -kink / q_rest**2, problem.charge,
    )  # fmt: skip
    return Followed(system, area, at_rest, shown, q_rest, missed)
