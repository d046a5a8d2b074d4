"""Integrators of scipy and torchdiffeq on the right-hand side of any circuit, restarted at the edges of its sources.

Their error is measured against our own Radau collocation at a tighter tolerance. Where it is too large, the library's
tolerance is reduced and the run is repeated, because the libraries control a local error only.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit
from fingerspice.base.errors import InputError
from fingerspice.engine import implicit
from fingerspice.engine.implicit import NFEV
from fingerspice.engine.network import Net, Room, Sources, at_sources, choose_signs, rates
from fingerspice.results.outcome import Status
from fingerspice.solve.nodal import STAGES, Collocation, radau_scheme, solve_coupled
from fingerspice.solve.problem import ROUNDING, Problem, Tables, segment_index, values_at
from fingerspice.solve.runs import Progress, Run, apart, closed_form, gap_signals, integrate, nodes_apart

_QUIET = threading.Lock()
SCIPY_METHODS = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")
TORCH_METHODS = ("dopri5", "dopri8", "bosh3", "adaptive_heun", "rk4", "midpoint", "euler")
_TORCH_ORDER = {"rk4": 4, "midpoint": 2, "euler": 1}  # Of those with fixed steps
# Tolerances of our reference run and of the library's first run, relative to the error asked for; and the number of
# runs with the library's tolerance reduced each time.
REFERENCE, FIRST, ATTEMPTS = 0.03, 0.1, 6

Rate = Callable[[float, FloatArray], FloatArray]


class _FailedError(Exception):
    """A library's integrator gave up."""


@jit
def _rate(
    net: Net, room: Room, sources: Sources, index: IntArray, base: float, t: float, y: FloatArray, sign: FloatArray
) -> FloatArray:  # fmt: skip
    """y' at t (s) after `base`, NaN past a fold; the branches of the areas follow from the voltages."""
    at_sources(sources, index, base, t, room.s, room.ds)
    choose_signs(net, room, False, y, sign)
    out = np.empty(y.size)
    if not rates(net, room, False, y, sign, out):
        out[:] = np.nan
    return out


class Foreign(Collocation):
    """One integration by a library, piece by piece; jumps of the sources are integrated as in `Collocation`."""

    detail = ""

    def __init__(self, problem: Problem, method: str, tol: float, u_scale: float) -> None:
        super().__init__(problem, radau_scheme(STAGES), tol, u_scale)
        library, _, self.name = method.partition(":")
        self.by = self._by_scipy if library == "scipy" else self._by_torch
        # Without a request for charge its scale is infinite, which libraries cannot take: 1 C is as good as infinite.
        self.scale = np.where(np.isfinite(self.scale), self.scale, 1.0)

    def _by_scipy(self, rate: Rate, times: FloatArray) -> tuple[FloatArray, int]:
        """States at `times` (s, ascending from 0) of y' = rate(t, y), and the number of evaluations."""
        from scipy.integrate import solve_ivp

        y, tol = self.y.copy(), self.tol
        # Warning filters belong to the whole process: change them in one thread at a time, for scipy's warnings only.
        with _QUIET, warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"scipy\.")
            try:
                span = 0.0, times[-1]
                result = solve_ivp(rate, span, y, self.name, times, rtol=max(tol, 3e-14), atol=tol * self.scale)
            except ValueError as error:
                # Past a fold y' is NaN, and scipy's implicit methods refuse to factor a matrix with NaN.
                raise _FailedError(f"scipy: {error}") from None
        # LSODA reports success even if the state is NaN.
        if result.status < 0 or not np.all(np.isfinite(result.y[:, -1])):
            raise _FailedError(str(result.message))
        return result.y.T, int(result.nfev)

    def _by_torch(self, rate: Rate, times: FloatArray) -> tuple[FloatArray, int]:
        """As `_by_scipy`."""
        import torch
        from torchdiffeq import odeint

        count, length, tol, scale, order = 0, float(times[-1]), self.tol, self.scale, _TORCH_ORDER.get(self.name)

        def slope(t: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
            nonlocal count
            count += 1
            # torchdiffeq takes one atol for all entries, so each entry is integrated in units of its scale.
            found = rate(float(t), z.numpy() * scale) / scale
            # Past a fold y' is NaN, which would make torchdiffeq's step NaN; it rejects the step if y' is huge.
            return torch.from_numpy(np.where(np.isfinite(found), found, 1e9 / length))

        options = {}
        if order is not None:
            # A fixed step h from the tolerance, with the error model (h / tau)^order, tau the shortest time constant.
            longest = min(1.0 / max(float(self.problem.scene.rates.max(initial=0.0)), 1e-300), length / 4.0)
            options = {"step_size": min(longest, 2.0 * longest * tol ** (1.0 / order))}
        begin, at = torch.from_numpy(self.y / scale), torch.from_numpy(times)
        how = {"method": self.name, "rtol": max(tol, 3e-14), "atol": tol, "options": options}
        try:
            with torch.no_grad():
                states = odeint(slope, begin, at, **how).numpy() * scale
        except AssertionError as error:
            short = "torchdiffeq's step underflowed: its methods are explicit, and this scene may be too stiff for them"
            raise _FailedError(short if "underflow in dt" in str(error) else str(error)) from None
        if not np.all(np.isfinite(states[-1])):
            raise _FailedError("torchdiffeq returned NaN")
        return states, count

    def through(self, sources: Sources, t_end: float) -> Status:
        edges = np.unique(sources.edges)
        for stop in np.append(edges[(edges > self.t) & (edges < t_end)], t_end):
            after = values_at(sources, self.t)
            jumps = np.abs(after - self.s_before) > implicit.ROUNDING * np.maximum(abs(after), abs(self.s_before))
            if np.any(jumps) and not self.jump(after):
                return self.stuck()
            try:
                self._piece(sources, float(stop))
            except _FailedError as error:
                self.detail = str(error)
                return Status.METHOD_FAILED
        return Status.SUCCESS

    def _piece(self, sources: Sources, stop: float) -> None:
        """Integrate to `stop` (s)."""
        base, n_s, index = self.t, self.s_before.size, segment_index(sources, self.t, "right")

        def rate(t: float, y: FloatArray) -> FloatArray:
            return np.asarray(_rate(self.net, self.room, sources, index, base, t, np.ascontiguousarray(y), self.sign))

        done = int(self.counters[implicit.OUTPUT])
        inside = (self.t_out < stop) | ((self.t_out == stop) & self.left)
        times = self.t_out[done : int(np.count_nonzero(inside))] - base
        every = np.unique(np.concatenate([[0.0], times, [stop - base]]))
        states, used = self.by(rate, every)
        for row, since, state in zip(self.rows[done:], times, states[np.searchsorted(every, times)], strict=False):
            row[: state.size] = state
            if self.problem.charge:
                row[state.size :] = rate(float(since), state)[-n_s:]
        self.counters[implicit.OUTPUT] += len(times)
        self.counters[NFEV] += used
        self.counters[implicit.ACCEPTED] += 1
        self.y[:] = states[-1]
        # The last call leaves the branches as they are at the end.
        rate(stop - base, self.y)
        self.s_before[:] = self.room.s
        self.control[implicit.BASE] = stop


def solve_foreign(problem: Problem, method: str, rtol: float, progress: Progress | None = None) -> Run:
    """Integrate with a library's method until the error against our own Radau is within `rtol` of the peaks."""
    library, _, name = method.partition(":")
    known = SCIPY_METHODS if library == "scipy" else TORCH_METHODS
    if name not in known:
        allowed = ", ".join(f"{library}:{m}" for m in known)
        raise InputError(f"unknown method '{method}'; allowed: {allowed}")
    if library == "torchdiffeq" and not all(map(find_spec, ("torch", "torchdiffeq"))):
        raise InputError(f"method '{method}' needs torchdiffeq; pip install 'fingerspice[torch]'")
    reference = solve_coupled(problem, max(REFERENCE * rtol, 1e-13))
    ours = reference.record(problem)
    u_scale = float(reference.gaps[:, 0].max(initial=0.0)) or 1.0
    tol, nfev = FIRST * rtol, 0
    for _ in range(ATTEMPTS):
        one = Foreign(problem, method, tol, u_scale)
        run = integrate(one, Tables(problem, tol), progress)
        theirs, nfev = run.record(problem), nfev + run.nfev
        run.nfev, run.margin, run.detail, run.gaps = nfev, reference.margin, one.detail, reference.gaps.copy()
        for gap, mine, other in zip(run.gaps, gap_signals(ours), gap_signals(theirs), strict=True):
            gap[2:] += list(map(apart, mine, other))
        run.node_error = (reference.node_error or 0.0) + nodes_apart(ours, theirs)
        worst = run.excess(max(ROUNDING * u_scale, problem.rounding)) / rtol
        if run.status is not Status.SUCCESS:
            if reference.status is Status.FOLD:
                run.status, run.t_failed = reference.status, reference.t_failed
            return run
        if worst <= 1.0:

            def again(other: Problem, tol: float = tol) -> Run:
                return integrate(Foreign(other, method, tol, u_scale), Tables(other, tol))

            run.continuous = closed_form(problem, again, rtol)
            return run
        tol = max(tol * min(0.3, 0.5 / worst), 1e-16)
    run.status = Status.ERROR_NOT_MET
    return run
