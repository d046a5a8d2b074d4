"""The periodic state of any circuit, by Newton's method on the map of one period (`Search`).

The unknown z consists of the modes of the live voltages, for the areas at 0 V, and of the areas with a time constant,
relative to their values at 0 V. The first guess, and the first derivative of the map, are those of the linear circuit
with its areas at 0 V. Broyden's updates improve the derivative from period to period; finite differences, which cost a
period for each slow mode, replace it only where these updates do not lead to convergence.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.network import Modes, Network
from fingerspice.engine.collocation import readout
from fingerspice.numerics import linear
from fingerspice.physics.contact import inverse_area
from fingerspice.results.outcome import State, Status
from fingerspice.solve.collocation import GUESS, March, Track, stepping
from fingerspice.solve.nodal import pass_through
from fingerspice.solve.problem import Problem, joined, prepare, to_ends
from fingerspice.solve.runs import no_period
from fingerspice.solve.stepping import FINEST, LOCAL_SHARE, SAFETY, OutOfRangeError
from fingerspice.waveforms.sampling import source_table
from fingerspice.waveforms.waveform import OFF, Waveform, require

# Number of equidistant times of a period from which the mean of an area with a time constant is computed.
SAMPLES = 64
# Number of periods whose tables of the sources are cached with a scene.
MOST_PERIODS = 16
# Nodes and weights of Gauss-Legendre quadrature on [0, 1], for integrals over a voltage from 0 V to its value.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_GAUSS = 0.5 + 0.5 * _NODES, 0.5 * _WEIGHTS
# Tolerance of the early passes: relative to the last Newton step, and at most, relative to the voltage scale.
_CRUDE, _FIRST = 1e-3, 1e-4
# Finite differences of the map: perturbation relative to the voltage scale, and the tolerance of their passes, usual
# and least.
_SHIFT, _SLOPE_TOL, _LEAST_SLOPE_TOL = 5e-4, 1e-9, 1e-11
# A mode that decays by more powers of e than this in a period is not measured: its column is exp(-40) at most.
_FORGOTTEN = 40.0
# Passes after which the derivative is measured by finite differences, and after which the search fails.
_PATIENCE, _MOST = 14, 60
# The search has stagnated after so many passes in which no step was less than half of the smallest one before.
# Round-off is accepted as the cause if the steps are below _NOISE times the voltage scale.
_HELD_UP, _NOISE = 5, 1e-8
# If the first step is longer than this times the voltage scale, the linear circuit's derivative is not good enough.
_LONG = 0.1
# A step longer than this times the voltage scale means that the search diverges.
_ASTRAY = 1e3
CHARGING = "a current source charges, from period to period, what nothing drains"


class Period:
    """One period of a problem, or only its first half if the second half is the first with opposite sign.

    `close` finds its periodic state.
    """

    start: FloatArray  # (n + n_slow,): Live voltages just before the period, V, and relative areas
    defect: float  # Largest change of a live voltage over a further period, V
    gap_errors: FloatArray  # (n_gap, 2): Error of the state, as its effect on every gap's voltage and force, V and N
    periods: float = 1  # Number of periods integrated
    # Error of the periodic state relative to the error of one period: a slow mode accumulates the errors of the periods
    # within its memory
    memory = 1.0

    def __init__(self, problem: Problem) -> None:
        waveform, scene, net = problem.network.waveform, problem.scene, problem.scene.net
        assert waveform.period is not None
        # The first whole period after the sources have become periodic, and not before the run's start, s.
        self.begin = waveform.period * float(np.ceil(max(waveform.settled, problem.t_start) / waveform.period))
        self.contacts = {i: one for i, one in enumerate(scene.network.contacts) if one is not None}
        # Modes of the circuit with its areas at 0 V, and their number.
        self.modes: Modes = _plain(scene.network, waveform.period) if scene.network.active else scene.modes
        n = self.n = self.modes.rates.size
        # (n_s,): Sources just before the period, V or A.
        self.before = np.array([float(w.value(self.begin, "left")) for w in scene.network.waveforms])
        # (n + n_slow,): Decay rates of the modes and of the areas with a time constant, 1/s, and which of them are 0:
        # charges that nothing drains.
        self.rates = np.append(self.modes.rates, 1.0 / net.tau[net.slow >= 0])
        self.neutral: BoolArray = self.rates == 0.0
        # (n,): Amplitudes of the neutral modes when the period begins; 0 for all other modes.
        kept = self.modes.inverse @ (problem.initial.y[:n] + self.modes.follow @ problem.initial.s_before)
        self.kept = np.where(self.neutral[:n], kept, 0.0)
        pushed = np.any(self.modes.gains[self.neutral[:n]] != 0.0)
        # The integrated span is one of so many parts of the period; its length, s.
        turns = (
            scene.network.course is None
            and not pushed
            and not np.any(self.kept)
            and _turns(problem.network.waveforms, waveform.period)
        )
        self.parts = 2 if turns else 1
        self.span = waveform.period / self.parts
        # A function's table depends on the output step as well.
        key = "period", self.begin, self.span, problem.step if waveform.is_sampled else 0.0
        self.end = self.begin + self.span
        self.tables = scene.remember(key, lambda: [
            source_table(w, self.begin, self.end, 1e-13, problem.step) for w in scene.network.waveforms
        ], MOST_PERIODS)  # fmt: skip
        broken = [table.not_finite for table in self.tables if table.not_finite is not None]
        if broken:
            raise no_period(problem, Status.SOURCE_NOT_FINITE, min(broken))
        self.sources = joined(self.tables)
        if pushed and self.begin > problem.t_start:
            # Add the charge that sources drive into the neutral modes between the run's start and the period.
            for j, wave in enumerate(scene.network.waveforms):
                table = source_table(wave, problem.t_start, self.begin, 1e-13, problem.step)
                gains, still = np.where(self.neutral[:n], self.modes.gains[:, j], 0.0), np.zeros(n)
                _, moved = linear.respond(still, gains, table.edges, table.terms, table.series, still, [])
                self.kept = self.kept + moved
        # (n + n_slow,): Sign of each entry of a periodic state at the end of the span, relative to its start.
        self.turned = np.where(np.arange(self.rates.size) < n, 1.0 if self.parts == 1 else -1.0, 1.0)
        # The problem restricted to the span, without charge.
        self.problem = dataclasses.replace(
            problem, t_start=self.begin, t_stop=self.end, first=self.begin, charge=False,
            initial=State(self.begin, problem.initial.y, self.before, np.zeros(net.gap.size), scene.charge_law),
        )  # fmt: skip

    def voltages(self, z: FloatArray) -> FloatArray:
        """Live voltages just before the period begins, V, shape (n,)."""
        return np.asarray(self.modes.shape @ z[: self.n] - self.modes.follow @ self.before)

    def charges(self, z: FloatArray, held: IntArray) -> FloatArray:
        """Conserved charges of the state z, projected on the neutral modes with the indices `held`.

        Under `local` a capacitor holds the integral of C dU from 0 V to its voltage U; under `mobile` it holds C U.
        """
        scene, network, net = self.problem.scene, self.problem.network, self.problem.scene.net
        u = net.p @ self.voltages(z) + net.q @ self.before
        along, weight = (np.ones(1), np.ones(1)) if net.mobile else _GAUSS
        area, charge = scene.net.area0.copy(), np.zeros(u.size)
        for share, part in zip(along, weight, strict=True):
            for i in np.flatnonzero(net.gap >= 0).tolist():
                slow, following = net.slow[i], float(self.contacts[i].area(share * abs(u[net.gap[i]])))
                area[i] = following if slow < 0 else net.area0[i] * z[self.n + slow]
            charge += part * network.capacitance(area) * u
        return np.asarray(self.modes.shape[:, held].T @ (net.p.T @ charge))

    def linear_state(self, times: FloatArray | list[float]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Periodic state of the circuit with its areas at 0 V: its modes at the span's start, its end, and `times` (s).

        A neutral mode starts from the amplitude that it keeps; NaN where a current charges it from period to period.
        """
        rates = self.modes.rates
        start, end, along = np.zeros(self.n), np.zeros(self.n), np.zeros((len(times), self.n))
        for j, table in enumerate(self.tables):
            gains = np.ascontiguousarray(self.modes.gains[:, j])
            given = table.edges, table.terms, table.series
            if self.parts == 1:
                v = linear.periodic_state(rates, gains, *given)
            else:
                _, moved = linear.respond(rates, gains, *given, np.zeros(self.n), [])
                v = -moved / (1.0 + np.exp(-rates * (table.edges[-1] - table.edges[0])))
            rows, last = linear.respond(rates, gains, *given, v, times)
            start, end, along = start + v, end + last, along + rows
        if not np.all(np.isfinite(start)):
            raise no_period(self.problem, Status.NOT_PERIODIC, cause=CHARGING)
        return start, end, along

    def close(self) -> None:
        """Find the periodic state of a circuit with fixed areas."""
        start, end, _ = self.linear_state([])
        defect = float(np.abs(self.modes.shape @ (self.turned[: self.n] * end - start)).max(initial=0.0))
        self.start, self.defect = self.voltages(start + self.kept), self.parts * defect
        # The only error of the closed form is round-off, which the run adds to its stated error itself.
        self.gap_errors = np.zeros((len(self.problem.network.fingers), 2))

    def map_slope(self) -> FloatArray:
        """The Jacobian matrix of the period map, to about 1e-5, by the modes and the areas with a time constant."""
        return np.diag(np.exp(-self.rates * self.span * self.parts))


def _plain(network: Network, period: float) -> Modes:
    """In place of modes that may be complex, the live voltages themselves: what they forget in a period is measured."""
    n, n_s = network.b.shape
    nothing = np.zeros((n, n_s))
    return Modes(np.full(n, 1.0 / period), nothing, np.eye(n), np.eye(n), nothing, np.zeros((n, len(network.cells))))


def _turns(waves: tuple[Waveform, ...], period: float) -> bool:
    """Whether the second half period of every source is the first with opposite sign; then so are all voltages.

    The circuit itself has this symmetry: it is linear except for the areas, which depend on the modulus of a voltage.
    """
    # How often a source repeats itself in the period; 0 for one that does not turn in half of its own.
    counts = [period / wave.period if wave.half_wave and wave.period else 0.0 for wave in waves if wave != OFF]
    return all(round(count) % 2 == 1 and abs(count - round(count)) <= 1e-9 for count in counts)


class _Pass(NamedTuple):
    """One pass over the period: state and sources at its end, the signed error of that state, and its figures.

    State and error are first the live voltages and relative areas, and in the answer of `Search.passed` the image of z.
    """

    end: FloatArray
    sources: FloatArray
    error: FloatArray
    met: FloatArray  # (n_gap, 4): Columns of `LoopState.peaks`
    magnified: float
    # (n_gap,): Round-off of the gap voltages in units of the machine precision times the largest voltage
    rounding: FloatArray


class Search(Period):
    """Newton's method on the map of a period."""

    def __init__(self, problem: Problem, rtol: float) -> None:
        super().__init__(problem)
        problem, self.rtol, self.passes, self.implicit = (
            self.problem,
            rtol,
            0,
            self.problem.network.owned or self.problem.network.active,
        )
        self.one: Track | March | None = None  # Integrates every pass by exponential steps
        # The gap voltage that a stack's area curve reaches, V; 0: that of its scene.
        self.top = 0.0
        # A conserved charge is no unknown. If half a period is used, all voltages change sign: such a charge is 0.
        self.free = ~self.neutral if self.parts == 1 else np.ones(self.rates.size, bool)
        self.fingers = list(problem.network.fingers)
        self.z = self._guess()
        largest = float(np.abs(self.voltages(self.z)).max(initial=0.0))
        self.scale = max(problem.scene.u_peak, largest) or GUESS
        self.decay = self.turned * np.exp(-self.rates * self.span)
        self._solve_by(np.diag(1.0 / np.where(self.free, 1.0 - self.decay, math.inf)))
        self.z = self._holding(self.z)
        gap = problem.network.p[np.array(problem.network.finger_cells, int)] @ self.modes.shape
        # Derivative of every gap's voltage by z; its columns for areas with a time constant are 0.
        self.gap = np.hstack([gap, np.zeros((gap.shape[0], self.rates.size - self.n))])

    def _guess(self) -> FloatArray:
        """The periodic state with every area held at its value at 0 V; areas with a time constant at their mean."""
        problem = self.problem
        net, modes, slow = problem.scene.net, self.modes, np.flatnonzero(problem.scene.net.slow >= 0)
        times = self.begin + self.span * (np.arange(SAMPLES if slow.size else 0) + 0.5) / SAMPLES
        start, _, along = self.linear_state(times)
        relative = np.ones(slow.size)
        if slow.size:
            s = np.column_stack([wave.value(times) for wave in problem.network.waveforms])
            x = along @ modes.shape.T - s @ modes.follow.T
            for k, i in enumerate(slow.tolist()):
                u = x @ net.p[net.gap[i]] + s @ net.q[net.gap[i]]
                relative[k] = float(np.mean(self.contacts[i].area(np.abs(u)))) / problem.scene.net.area0[i]
        return np.append(np.where(self.neutral[: self.n], self.kept, start), relative)

    def _solve_by(self, solver: FloatArray) -> None:
        """Take an inverse of 1 - slope for the entries of z that decay, which is zero for the neutral modes."""
        self.solver = solver
        # Largest ratio of the periodic state's error to an error of the voltages made in every period; 1 or more.
        grown = self.modes.shape @ solver[: self.n, : self.n] @ self.modes.inverse
        self.memory = max(1.0, float(np.abs(grown).sum(axis=1).max(initial=0.0)))

    def _measure(self) -> None:
        """Solve by the measured slope."""
        slope = self._slope()
        solver, free = np.zeros_like(slope), np.ix_(self.free, self.free)
        solver[free] = np.linalg.inv(np.eye(int(self.free.sum())) - slope[free])
        self._solve_by(solver)

    def _largest(self, z: FloatArray) -> float:
        """Largest voltage in a change of z, V; the relative change of an area counts as that share of the scale."""
        x, areas = self.modes.shape @ z[: self.n], self.scale * z[self.n :]
        return max(map(abs, [*x.tolist(), *areas.tolist()]), default=0.0)

    def passed(self, z: FloatArray, tol: float) -> _Pass:
        """One pass over the period from z, with an error of `tol` times the voltage scale in every step."""
        n, self.passes = self.n, self.passes + 1
        y = np.concatenate([self.voltages(z), z[n:], np.zeros(self.before.size)])
        initial = dataclasses.replace(self.problem.initial, y=y)
        made = None if self.implicit else self._stepped(initial, max(tol, FINEST))
        if made is None:
            # The exponential steps failed: the implicit method either succeeds or tells that no solution exists.
            self.implicit, made = True, self._collocated(dataclasses.replace(self.problem, initial=initial), tol)
        # Use the sources at the end of the pass: they equal those at the start only up to the sign and round-off.
        x = self.modes.inverse @ (made.end[:n] + self.modes.follow @ made.sources)
        error = np.concatenate([self.modes.inverse @ made.error[:n], made.error[n : z.size]])
        return made._replace(end=self.turned * np.concatenate([x, made.end[n : z.size]]), error=error)

    def _stepped(self, initial: State, tol: float) -> _Pass | None:
        """One pass by exponential steps; None where they fail before the end."""
        one = self.one = self.one or stepping(self.problem, self.rtol, tol, self.scale, self.top)
        one.begin(initial, tol * self.scale)
        try:
            if one.through(self.sources, self.end) is not Status.SUCCESS:
                return None
        except OutOfRangeError as left:
            self.top, self.one = 1.5 * left.args[0], None
            return self._stepped(initial, tol)
        n, magnified = self.n, max(1.0, float(one.control["magnified"]))
        if isinstance(one, March):
            error, rounding = np.append(one.form.shape @ one.error[:n], one.error[n:]), one.references.magnified
        else:
            system, model = one.system, one.system.model
            error, rounding = system.live[int(one.error[n])] @ one.error[:n], np.array([model.k_gap])
            if model.mobile:
                error *= model.area0 * inverse_area(abs(float(one.control["u_gap"])), model.curve)[0]
            error = self.problem.scene.turn * error
        end = one.state()
        return _Pass(end.y, end.s_before, error, one.peaks[self.fingers], magnified, rounding[self.fingers])

    def _collocated(self, problem: Problem, tol: float) -> _Pass:
        """One pass by the implicit method, with its error from a coarser pass."""
        status, one, error = pass_through(problem, self.sources, tol, self.scale)
        if status is not Status.SUCCESS:
            raise no_period(problem, status, one.t)
        rounding = (np.abs(self.gap[:, : self.n]) @ np.abs(self.modes.inverse)).sum(axis=1)
        return _Pass(one.y, one.s_before, error, one.met, 1.0, 10.0 + rounding)

    def close(self) -> None:
        """Find the periodic state, to `rtol` or as far as round-off permits."""
        tol = LOCAL_SHARE * self.rtol
        while True:
            last, step, defect = self._newton(tol)
            self.gap_errors, excess, rounding = self._errors(last, step)
            if excess <= 1.0:
                break
            if excess > 2.0 * rounding and tol > FINEST:
                tol = max(tol * min(0.3, 0.5 / excess), FINEST)
            elif not self.implicit:
                # The round-off of the modes dominates; the implicit method works without them and has less.
                self.implicit, tol = True, LOCAL_SHARE * self.rtol
            else:
                break
        # Its records are views of its arrays, which a copy of what is found would separate.
        self.one, self.start = None, np.append(self.voltages(self.z), self.z[self.n :])
        self.defect, self.periods = self.parts * defect, self.passes / self.parts

    def map_slope(self) -> FloatArray:
        slope = self._slope()
        return slope @ slope if self.parts == 2 else slope

    def _newton(self, tol: float) -> tuple[_Pass, FloatArray, float]:
        """Solve for the periodic z; returns the last pass, the last step of z, and the defect of that pass, V."""
        moved = self.scale * (_FIRST / _CRUDE if self.passes == 0 else 0.0)
        change_before, before, step = None, _FIRST, np.zeros(self.z.size)
        here, smallest, since = _FIRST, math.inf, 0
        for count in range(1, _MOST + 1):
            # The solver enlarges the error of a pass by up to `memory`, so the pass needs a tolerance smaller by that.
            here = max(tol, min(here, _CRUDE * moved / self.scale / self.memory, _FIRST / self.memory))
            last = self.passed(self.z, here)
            change = last.end - self.z
            wanted = np.where(self.free, change, 0.0)
            if change_before is not None:
                fell = change_before - wanted
                # Skip Broyden's update of the solver if the change is within the errors of the two passes.
                if self._largest(fell) > before * self.scale:
                    answered = self.solver @ fell
                    along = float(step @ answered)
                    # A tiny denominator means that round-off dominates the step: it would spoil the solver.
                    if abs(along) > 1e-3 * float(step @ step) > 0.0:
                        self._solve_by(self.solver + np.outer((step - answered) / along, step @ self.solver))
            if count % _PATIENCE == 0:
                self._measure()
            change_before, before, step = wanted, here, self.solver @ wanted
            if count == 1 and self._largest(step) > _LONG * self.scale:
                # For a mode that hardly decays in a period, the effect of the areas' ripple may exceed the decay, and
                # the derivative of the linear circuit is wrong: measure it.
                self._measure()
                step = self.solver @ wanted
            self.z = self._holding(self.z + step)
            moved, defect = self._largest(step), self._largest(change)
            if not moved < _ASTRAY * self.scale:
                break
            # Round-off may prevent smaller steps; the size of the last step is then part of the stated error.
            smallest, since = (moved, 0) if moved < 0.5 * smallest or here > tol else (smallest, since + 1)
            held_up = since >= _HELD_UP and moved <= _NOISE * self.scale
            closed = moved <= tol * self.scale or self._largest(wanted) <= 1e-15 * self.scale
            if here == tol and (closed or held_up):
                self._mind_wandering(last, change, tol)
                return last, step, defect
        cause = f"{Status.NOT_PERIODIC.cause}: {defect:.3g} V are left after a period"
        raise no_period(self.problem, Status.NOT_PERIODIC, cause=cause)

    def _mind_wandering(self, last: _Pass, change: FloatArray, tol: float) -> None:
        """Refuse a state whose conserved charges change over the period: an area's ripple would pump them for ever.

        Under `local` this happens where an insulating layer has the area of the gap but another voltage waveform.
        """
        held = ~self.free
        allowed = SAFETY * self._largest(np.where(held, np.abs(last.error), 0.0)) + 10.0 * tol * self.scale
        moved = self._largest(np.where(held, change, 0.0))
        if moved > allowed:
            cause = f"a charge that nothing drains moves by {moved:.3g} V in every period"
            raise no_period(self.problem, Status.NOT_PERIODIC, cause=cause)

    def _holding(self, z: FloatArray) -> FloatArray:
        """z with its neutral modes adjusted so that the conserved charges have their initial values.

        These modes are the conserved charges themselves only with the areas at 0 V, hence the iteration.
        """
        held = np.flatnonzero(~self.free)
        if not held.size:
            return z
        z = z.copy()
        for _ in range(_MOST):
            missing = self.charges(z, held) - self.kept[held]
            z[held] -= missing
            if np.abs(missing).max() <= 1e-15 * np.abs(z).max():
                break
        return z

    def _slope(self) -> FloatArray:
        """Derivative of the map by z, to about 1e-5, from one pass for every mode that does not decay in a period."""
        decaying = self.rates[~self.neutral]
        # A slow mode's 1 - slope is about its rate times the period: the passes' errors must be smaller than that.
        forgets = min(1.0, float(decaying.min(initial=math.inf)) * self.span)
        tol = max(_SLOPE_TOL * forgets, _LEAST_SLOPE_TOL)
        base = self.passed(self.z, tol).end
        slope = np.diag(self.decay)
        for k in np.flatnonzero(self.free & (self.rates * self.span < _FORGOTTEN)):
            unit = np.eye(self.z.size)[k]
            by = _SHIFT * self.scale / max(self._largest(unit), 1e-300)
            slope[:, k] = (self.passed(self.z + by * unit, tol).end - base) / by
        return slope

    def _errors(self, last: _Pass, step: FloatArray) -> tuple[FloatArray, float, float]:
        """Errors of the gaps' voltages and forces (n_gap, 2); their largest share of `rtol`, and that of round-off.

        An error made in every period leads to an error of the periodic state equal to the solver times it.
        """
        solver = np.abs(self.solver)
        grown = solver @ np.abs(last.error)
        peak, force = last.met[:, readout.PEAK_U], last.met[:, readout.PEAK_F]
        gap = np.abs(self.gap)
        # Add round-off, and the last Newton step as a bound of the error that remains after it.
        once = np.abs(self.modes.inverse).sum(axis=1)
        often = solver[: self.n, : self.n] @ once
        grows = np.maximum(1.0, (gap[:, : self.n] @ often) / (gap[:, : self.n] @ once))
        largest = float(peak.max(initial=0.0)) + self.scale
        floor = 4e-16 * grows * (last.rounding * largest + peak)
        u_error = last.magnified * (SAFETY * (gap @ grown) + gap @ np.abs(step)) + floor
        f_error = 2.0 * force / np.where(peak > 0.0, peak, math.inf) * u_error
        slow = self.problem.scene.net.slow[self.fingers]
        # An area without a time constant has the place -1, the 0 at the end.
        share = np.append((SAFETY * grown + np.abs(step))[self.n :], 0.0)[slow]
        u_error, f_error = u_error + peak * share, f_error + 3.0 * force * share
        live = peak > 4e-15 * self.scale
        over = np.append(u_error[live] / peak[live], f_error[live] / force[live])
        rounding = float((2.0 * floor[live] / peak[live]).max(initial=0.0))
        return np.column_stack([u_error, f_error]), float(over.max(initial=0.0)) / self.rtol, rounding / self.rtol


def close_period(problem: Problem, rtol: float) -> tuple[Problem, Period]:
    """A problem, with its length, that starts from its periodic state, when the source has become periodic.

    `rtol` bounds the error of the state alone, relative to the peaks over the period; where round-off exceeds it, the
    stated error is larger. Sources without a common period are refused; a period that cannot be integrated, or that
    leads to no periodic state, is a `SolveError`.
    """
    if problem.network.waveform.period is None:
        raise InputError("the source has no period, so there is no periodic state to find")
    follows = problem.scene.coupled or problem.network.active
    period = Search(problem, rtol) if follows else Period(problem)
    period.close()
    y, moved = np.append(period.start, np.zeros(period.before.size)), period.begin - problem.t_start
    started = dataclasses.replace(
        problem, t_start=period.begin, t_stop=problem.t_stop + moved, first=problem.first + moved,
        initial=dataclasses.replace(period.problem.initial, y=y), begun=period.gap_errors,
    )  # fmt: skip
    return started, period


def asked(circuit: Circuit, *, rtol: float, t_eval: FloatArray | None = None, **how: Any) -> Problem:
    """The problem that a call of `simulate` asks for, with arguments as `check_arguments` leaves them."""
    problem = prepare(circuit, t_eval=t_eval, rtol=rtol, **how)
    if problem.start == "periodic":
        problem, _ = close_period(problem, 0.5 * rtol)
        if t_eval is not None:
            to_ends(t_eval, problem.t_start, problem.t_stop)
            allowed = f"from {problem.t_start:g} s on, where the source has settled and its periodic state exists"
            require(t_eval[0] >= problem.t_start, "the first of t_eval", f"{t_eval[0]:g} s", allowed)
    return problem
