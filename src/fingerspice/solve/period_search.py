"""The periodic state of any circuit, by Newton's method on the map of one period.

The map is that of z: the modes of the live voltages with the areas as at 0 V, then the areas with dynamics of their own
over their value at 0 V. Its derivative is at first that of the circuit with its areas held at their means, which
Broyden's updates better from period to period; only where these do not close the period is it measured.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.network import network_modes
from fingerspice.engine import netassess, readout
from fingerspice.results.outcome import SolveError, Status
from fingerspice.solve.diagnosis import period_failure
from fingerspice.solve.marching import GUESS
from fingerspice.solve.netmarching import March
from fingerspice.solve.nodal import pass_through
from fingerspice.solve.period import CHARGING, Found, Period, Stopped
from fingerspice.solve.problem import Problem
from fingerspice.solve.stepping import FINEST, LOCAL_SHARE, SAFETY

# Of the passes before the last ones: what they may be off, over what the state moved last.
_CRUDE, _FIRST = 1e-3, 1e-4
# What a measured derivative is moved by, over the voltage scale, and the error allowed in its periods.
_SHIFT, _SLOPE_TOL, _LEAST_SLOPE_TOL = 5e-4, 1e-9, 1e-11
# A mode that decays by so many powers of e in a period leaves nothing to measure.
_FORGOTTEN = 40.0
# Passes until the derivative is measured, and until the search is given up.
_PATIENCE, _MOST = 14, 60
# Passes without a step of less than half of the smallest before, and what such steps may be over the voltage scale.
_HELD_UP, _NOISE = 5, 1e-8
# A first step this many times the voltage scale is not trusted to the linear circuit's derivative.
_LONG = 0.1
# A step of the search this many times the voltage scale leads nowhere.
_ASTRAY = 1e3
# How often the areas are averaged over the period of the linear circuit.
_AVERAGES = 3


@dataclass(frozen=True)
class _Pass:
    """What a period made of z: its end, the error of that (signed), and its figures.

    `met` is (n_area, 4) as `netassess` has it, `rounding` (n_area,) that of the gap voltages over the largest voltage.
    """

    end: FloatArray
    error: FloatArray
    met: FloatArray
    magnified: float
    rounding: FloatArray


# State and sources at the end of a pass, the error of the state, and what else is known of it.
_Made = tuple[FloatArray, FloatArray, FloatArray, _Pass]


class Search:
    """Newton's method on the map of a period."""

    def __init__(self, period: Period, rtol: float) -> None:
        self.period, self.rtol, self.passes = period, rtol, 0
        self.implicit = False
        # A charge that nothing drains stays as it is; that half a period turns its sign says that there is none.
        self.free = ~period.neutral if period.parts == 1 else np.ones(period.rates.size, bool)
        self.slow = np.arange(period.rates.size) >= period.n
        problem = period.problem
        self.fingers = list(problem.network.fingers)
        self.z, slope = self._guess()
        largest = float(np.abs(period.voltages(self.z)).max(initial=0.0))
        self.scale = max(problem.scene.u_peak, largest) or GUESS
        self.solver = self._inverse(slope)
        self.z = self._holding(self.z)
        cells = [problem.network.gaps[i] for i in self.fingers]
        gap = problem.network.p[np.array(cells, int)] @ period.modes.shape
        # Voltage of every gap by z: a slow area is no voltage.
        self.gap = np.hstack([gap, np.zeros((gap.shape[0], int(self.slow.sum())))])

    def _guess(self) -> tuple[FloatArray, FloatArray]:
        """The periodic state with every area held at its mean over the period, and the map's derivative there."""
        period, problem = self.period, self.period.problem
        network, net = problem.network, problem.scene.net
        area, s = problem.scene.area0.copy(), period.sampled()
        for _ in range(_AVERAGES):
            modes = network_modes(network, area)
            start, _, along = period.linear_state(modes)
            if not np.all(np.isfinite(start)):
                raise SolveError(period_failure(problem, Status.NOT_PERIODIC, None, CHARGING))
            x = along @ modes.shape.T - s @ modes.follow.T
            for i in np.flatnonzero(net.gap >= 0):
                contact = network.contacts[i]
                assert contact is not None
                u = x @ net.p[net.gap[i]] + s @ net.q[net.gap[i]]
                area[i] = float(np.mean(contact.area(np.abs(u))))
        v = period.modes_of(modes.shape @ start - modes.follow @ period.before)
        v = np.where(period.neutral[: period.n], period.kept, v)
        # The same decay seen in the modes of the areas at 0 V.
        turn = period.modes.inverse @ modes.shape
        decay = np.exp(-modes.rates * period.span)
        slope = np.diag(np.exp(-period.rates * period.span))
        slope[: period.n, : period.n] = turn @ (decay[:, None] * np.linalg.inv(turn))
        slow = np.flatnonzero(net.slow >= 0)
        return np.append(v, (area / problem.scene.area0)[slow]), period.turned[:, None] * slope

    def _inverse(self, slope: FloatArray) -> FloatArray:
        """Inverse of 1 - slope on what decays, zero on the rest."""
        out = np.zeros_like(slope)
        free = np.ix_(self.free, self.free)
        out[free] = np.linalg.inv(np.eye(int(self.free.sum())) - slope[free])
        return out

    def _largest(self, z: FloatArray) -> float:
        """Largest voltage that a change of z makes, V; an area counts as its share of the scale."""
        x = float(np.abs(self.period.modes.shape @ z[~self.slow]).max(initial=0.0))
        return max(x, self.scale * float(np.abs(z[self.slow]).max(initial=0.0)))

    def passed(self, z: FloatArray, tol: float) -> _Pass:
        """One pass over the period at an error of `tol` of the scale in every step."""
        period, n = self.period, self.period.n
        y = np.concatenate([period.voltages(z), z[n:], np.zeros(period.before.size)])
        initial = dataclasses.replace(period.problem.initial, y=y)
        problem = dataclasses.replace(period.problem, initial=initial)
        self.passes += 1
        made = None if self.implicit else self._marched(problem, tol)
        if made is None:
            # Whether exponentials find no way on or there is none, the implicit method tells.
            self.implicit, made = True, self._collocated(problem, tol)
        x, s, error_x, figures = made
        # The sources end as they began, but for the sign and rounding.
        end = np.append(period.modes.inverse @ (x[:n] + period.modes.follow @ s), x[n : z.size])
        error = np.append(period.modes.inverse @ error_x[:n], error_x[n : z.size])
        return dataclasses.replace(figures, end=period.turned * end, error=error)

    def _marched(self, problem: Problem, tol: float) -> _Made | None:
        """State and sources at the end by exponential steps, the state's error, and the figures; None for no way on."""
        none, n = np.zeros(0), self.period.n
        one = March(problem, max(tol, FINEST), self.rtol, self.scale, none, none.astype(bool), False)
        if one.through(self.period.sources, self.period.end) is not Status.SUCCESS:
            return None
        error = np.append(one.form.shape @ one.error[:n], one.error[n:])
        magnified = max(1.0, float(one.control[readout.MAGNIFIED]))
        return one.y, one.s_before, error, _Pass(none, none, one.met.copy(), magnified, one.references.magnified)

    def _collocated(self, problem: Problem, tol: float) -> _Made:
        """The same by an implicit method, its error from a coarser pass."""
        none, scene, network = np.zeros(0), problem.scene, problem.network
        status, one, error = pass_through(problem, self.period.sources, tol, self.scale)
        if status is not Status.SUCCESS:
            raise Stopped(status, one.t)
        met = np.zeros((one.peaks.size, 4))
        for i in network.fingers:
            peak, contact = float(one.peaks[i]), network.contacts[i]
            assert contact is not None
            area = float(contact.area(peak)) if scene.net.gap[i] >= 0 else float(scene.area0[i])
            met[i, :2] = peak, float(contact.stress(peak)) * area
        gap = np.array([network.p[0 if cell is None else cell] for cell in network.gaps]) @ self.period.modes.shape
        rounding = (np.abs(gap) @ np.abs(self.period.modes.inverse)).sum(axis=1)
        return one.y, one.s_before, error, _Pass(none, none, met, 1.0, 10.0 + rounding)

    def close(self) -> tuple[FloatArray, FloatArray, Found]:
        """Live voltages (V) and slow areas that a period leads back to, to the error asked for or as rounding lets."""
        period = self.period
        tol = LOCAL_SHARE * self.rtol
        while True:
            last, step, defect = self._newton(tol)
            errors, memory, excess, rounding = self._errors(last, step)
            if excess <= 1.0:
                break
            if excess > 2.0 * rounding and tol > FINEST:
                tol = max(tol * min(0.3, 0.5 / excess), FINEST)
            elif not self.implicit:
                # The modes' rounding is in the way, which an implicit method has less of.
                self.implicit, tol = True, LOCAL_SHARE * self.rtol
            else:
                break
        slope = self._slope()
        slope = slope @ slope if period.parts == 2 else slope
        found = Found(period.parts * defect, slope, memory, errors, self.passes / period.parts)
        return period.voltages(self.z), self.z[period.n :], found

    def _newton(self, tol: float) -> tuple[_Pass, FloatArray, float]:
        """Close the period; returns its last pass, the last step of z, and the largest change over that pass, V."""
        moved = self.scale * (_FIRST / _CRUDE if self.passes == 0 else 0.0)
        change_before, before, step = None, _FIRST, np.zeros(self.z.size)
        here, smallest, since = _FIRST, math.inf, 0
        for count in range(1, _MOST + 1):
            # What a pass misses the solver makes larger.
            memory = self._memory()
            here = max(tol, min(here, _CRUDE * moved / self.scale / memory, _FIRST / memory))
            last = self.passed(self.z, here)
            change = last.end - self.z
            if change_before is not None:
                fell = change_before - np.where(self.free, change, 0.0)
                # From what two passes miss nothing is to be learnt.
                if self._largest(fell) > before * self.scale:
                    self._update(step, fell)
            if count % _PATIENCE == 0:
                self.solver = self._inverse(self._slope())
            change_before, before = np.where(self.free, change, 0.0), here
            step = self.solver @ change_before
            if count == 1 and self._largest(step) > _LONG * self.scale:
                # A slow mode, whose few decays the areas' ripple may outdo.
                self.solver = self._inverse(self._slope())
                step = self.solver @ change_before
            self.z = self._holding(self.z + step)
            moved = self._largest(step)
            defect = self._largest(change)
            if not moved < _ASTRAY * self.scale:
                break
            # Rounding may hold the steps up before: what they are then is part of the error.
            smallest, since = (moved, 0) if moved < 0.5 * smallest or here > tol else (smallest, since + 1)
            held_up = since >= _HELD_UP and moved <= _NOISE * self.scale
            closed = moved <= tol * self.scale or self._largest(change_before) <= 1e-15 * self.scale
            if here == tol and (closed or held_up):
                self._mind_wandering(last, change, tol)
                return last, step, defect
        cause = f"{Status.NOT_PERIODIC.cause}: {defect:.3g} V are left after a period"
        raise SolveError(period_failure(self.period.problem, Status.NOT_PERIODIC, None, cause))

    def _memory(self) -> float:
        """Largest factor by which an error of the voltages that is made in every period grows; 1 or more."""
        n, modes = self.period.n, self.period.modes
        grown = modes.shape @ self.solver[:n, :n] @ modes.inverse
        return max(1.0, float(np.abs(grown).sum(axis=1).max(initial=0.0)))

    def _update(self, step: FloatArray, fell: FloatArray) -> None:
        """Broyden's update of the solver: the last step made the change over a period fall by so much."""
        answered = self.solver @ fell
        along = float(step @ answered)
        # Without this nothing would be learnt from a step that was all rounding.
        if abs(along) > 1e-3 * float(step @ step) > 0.0:
            self.solver = self.solver + np.outer((step - answered) / along, step @ self.solver)

    def _mind_wandering(self, last: _Pass, change: FloatArray, tol: float) -> None:
        """Refuse a state whose charges that nothing drains move in the period: an area's ripple pumps them, for ever.

        Under `local` it does so where an insulating layer has another voltage over the area than the gap.
        """
        held = ~self.free
        allowed = SAFETY * self._largest(np.where(held, np.abs(last.error), 0.0)) + 10.0 * tol * self.scale
        moved = self._largest(np.where(held, change, 0.0))
        if moved > allowed:
            cause = f"a charge that nothing drains moves by {moved:.3g} V in every period"
            raise SolveError(period_failure(self.period.problem, Status.NOT_PERIODIC, None, cause))

    def _holding(self, z: FloatArray) -> FloatArray:
        """z with the charge that nothing drains as it began: its modes alone tell it only while areas are as at 0 V."""
        held = np.flatnonzero(~self.free)
        if not held.size:
            return z
        z = z.copy()
        for _ in range(_MOST):
            missing = self.period.charges(z, held) - self.period.kept[held]
            z[held] -= missing
            if np.abs(missing).max() <= 1e-15 * np.abs(z).max():
                break
        return z

    def _slope(self) -> FloatArray:
        """Derivative of the pass's end by z, to about 1e-5, from one pass for every mode that outlasts the period."""
        period = self.period
        decaying = period.rates[~period.neutral]
        # What a mode forgets in a period must show in its slope.
        forgets = min(1.0, float(decaying.min(initial=math.inf)) * period.span)
        tol = max(_SLOPE_TOL * forgets, _LEAST_SLOPE_TOL)
        base = self.passed(self.z, tol).end
        slope = np.diag(period.turned * np.exp(-period.rates * period.span))
        for k in np.flatnonzero(period.rates * period.span < _FORGOTTEN):
            if not self.free[k]:
                continue
            unit = np.zeros(self.z.size)
            unit[k] = 1.0
            by = _SHIFT * self.scale / max(self._largest(unit), 1e-300)
            slope[:, k] = (self.passed(self.z + by * unit, tol).end - base) / by
        return slope

    def _errors(self, last: _Pass, step: FloatArray) -> tuple[FloatArray, float, float, float]:
        """Error of every gap's voltage and force (n_gap, 2), the memory, and the largest error over that asked for.

        The last figure is that of rounding alone. An error made in every period grows to what the solver makes of it.
        """
        period, solver = self.period, np.abs(self.solver)
        memory = self._memory()
        grown = solver @ np.abs(last.error)
        met = last.met[self.fingers]
        peak, force = met[:, netassess.PEAK_U], met[:, netassess.PEAK_F]
        largest = float(peak.max(initial=0.0))
        gap = np.abs(self.gap)
        # Rounding is an error too; what was moved last is more than what would be moved next.
        once = np.abs(period.modes.inverse).sum(axis=1)
        often = solver[: period.n, : period.n] @ once
        grows = np.maximum(1.0, (gap[:, : period.n] @ often) / (gap[:, : period.n] @ once))
        floor = 4e-16 * grows * (last.rounding[self.fingers] * (largest + self.scale) + peak)
        u_error = last.magnified * (SAFETY * (gap @ grown) + gap @ np.abs(step)) + floor
        f_error = 2.0 * force / np.where(peak > 0.0, peak, math.inf) * u_error
        slow = period.problem.scene.net.slow[self.fingers]
        off = (SAFETY * grown + np.abs(step))[period.n :]
        share = np.array([off[i] if i >= 0 else 0.0 for i in slow])
        u_error, f_error = u_error + peak * share, f_error + 3.0 * force * share
        live = peak > 4e-15 * self.scale
        over = np.append((u_error / np.where(live, peak, 1.0))[live], (f_error / np.where(live, force, 1.0))[live])
        rounding = float((2.0 * floor / np.where(live, peak, 1.0))[live].max(initial=0.0))
        return (
            np.column_stack([u_error, f_error]),
            memory,
            float(over.max(initial=0.0)) / self.rtol,
            rounding / self.rtol,
        )
