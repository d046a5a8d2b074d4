"""Integrators of scipy and torchdiffeq on the right-hand side of any circuit, restarted at the edges of its sources.

Their error is measured against our own Radau collocation at a tighter tolerance. Where it is too large, the library's
tolerance is reduced and the run is repeated, because the libraries control a local error only.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.base.compiled import jit
from fingerspice.base.errors import InputError
from fingerspice.engine import collocation
from fingerspice.engine.network import Net, Room, Sources, at_sources, choose_signs, gap_voltage, rates
from fingerspice.engine.radau import NFEV
from fingerspice.results.outcome import Status
from fingerspice.results.record import Record
from fingerspice.solve.nodal import STAGES, Collocation, radau_scheme, solve_coupled
from fingerspice.solve.problem import ROUNDING, Problem
from fingerspice.solve.runs import Progress, Run, closed_form, gap_signals, integrate, nodes_apart
from fingerspice.solve.sources import Tables, values_at

_QUIET = threading.Lock()
SCIPY_METHODS = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")
TORCH_METHODS = ("dopri5", "dopri8", "bosh3", "adaptive_heun", "rk4", "midpoint", "euler")
_TORCH_FIXED = {"rk4": 4, "midpoint": 2, "euler": 1}
# Tolerances of our reference run and of the library's first run, relative to the error asked for; and the number of
# runs with the library's tolerance reduced each time.
REFERENCE, FIRST, ATTEMPTS = 0.03, 0.1, 6


class _FailedError(Exception):
    """A library's integrator gave up at time `t` (s, from the start of the piece)."""

    def __init__(self, t: float, text: str) -> None:
        self.t = t
        self.text = text
        super().__init__(text)


@jit
def _rate(
    net: Net, room: Room, sources: Sources, index: IntArray, base: float, t: float, y: FloatArray, sign: FloatArray,
    chooses: bool,
) -> FloatArray:  # fmt: skip
    """y' at t (s) after `base`, NaN past a fold; with `chooses`, the branches of the areas follow from the voltages."""
    at_sources(sources, index, base, t, room.s, room.ds)
    if chooses:
        choose_signs(net, room, False, y, sign)
    out = np.empty(y.size)
    if not rates(net, room, False, y, sign, out):
        out[:] = np.nan
    return out


@jit
def _gap(
    net: Net, room: Room, sources: Sources, index: IntArray, base: float, t: float, y: FloatArray, area: int
) -> float:  # fmt: skip
    """Gap voltage (V) on which an area depends, at t (s) after `base`."""
    at_sources(sources, index, base, t, room.s, room.ds)
    return gap_voltage(net, room, area, y)


@dataclass
class _Piece:
    """A smooth part of a run for a library to integrate: `length` seconds from state `y`, with outputs at `times`.

    `rate` is y'(t, y). `gaps` are the gap voltages times the signs of their branches; the piece ends where one becomes
    0 V, because the area has a kink there.
    """

    rate: Callable[[float, FloatArray], FloatArray]
    gaps: Sequence[Callable[[float, FloatArray], float]]
    length: float
    y: FloatArray
    times: FloatArray
    tol: float
    scale: FloatArray
    tau: float


# Result of a library: time reached (s) and state there, states at the output times reached, number of evaluations.
_Result = tuple[float, FloatArray, FloatArray, int]


def _scipy_piece(piece: _Piece, name: str) -> _Result:
    from scipy.integrate import solve_ivp

    for gap in piece.gaps:
        gap.terminal, gap.direction = True, -1.0  # type: ignore[attr-defined]
    # Warning filters belong to the whole process: change them in one thread at a time, for scipy's warnings only.
    with _QUIET, warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"scipy\.")
        try:
            result = solve_ivp(
                piece.rate, (0.0, piece.length), piece.y, method=name, dense_output=True, events=piece.gaps or None,
                rtol=max(piece.tol, 3e-14), atol=piece.tol * piece.scale,
            )  # fmt: skip
        except ValueError as error:
            # Past a fold y' is NaN, and scipy's implicit methods refuse to factor a matrix with NaN.
            raise _FailedError(0.0, f"scipy: {error}") from None
    end = result.y[:, -1]
    # LSODA reports success even if the state is NaN.
    if result.status < 0 or not np.all(np.isfinite(end)):
        raise _FailedError(float(result.t[-1]), str(result.message))
    t_end = float(result.t[-1]) if result.status == 1 else piece.length
    times = piece.times[piece.times <= t_end]
    return t_end, end, result.sol(times).T if times.size else np.empty((0, end.size)), int(result.nfev)


def _torch_piece(piece: _Piece, name: str) -> _Result:
    import torch
    from torchdiffeq import odeint

    counts = [0]

    def slope(t: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        counts[0] += 1
        # torchdiffeq takes one atol for all entries, so each entry is integrated in units of its scale.
        rate = piece.rate(float(t), y.numpy() * piece.scale) / piece.scale
        # Past a fold y' is NaN, which would make torchdiffeq's step length NaN; it rejects the step if y' is huge.
        return torch.from_numpy(np.where(np.isfinite(rate), rate, 1e9 / piece.length))

    times = np.unique(np.concatenate([[0.0], piece.times, [piece.length]]))
    options = {}
    if name in _TORCH_FIXED:
        # A fixed step h from the tolerance, with the error model (h / tau)^order.
        longest = min(piece.tau, piece.length / 4.0)
        options = {"step_size": float(min(longest, 2.0 * longest * piece.tol ** (1.0 / _TORCH_FIXED[name])))}
    try:
        with torch.no_grad():
            y = odeint(
                slope, torch.from_numpy(piece.y / piece.scale), torch.from_numpy(times), method=name,
                rtol=max(piece.tol, 3e-14), atol=piece.tol, options=options,
            ).numpy() * piece.scale  # fmt: skip
    except AssertionError as error:
        text = str(error)
        if "underflow in dt" in text:
            text = "torchdiffeq's step underflowed: its methods are explicit, and this scene may be too stiff for them"
        raise _FailedError(0.0, text) from None
    if not np.all(np.isfinite(y[-1])):
        raise _FailedError(0.0, "torchdiffeq returned NaN")
    return piece.length, y[-1], y[np.searchsorted(times, piece.times)], counts[0]


class Foreign(Collocation):
    """One integration by a library, piece by piece; jumps of the sources are integrated as in `Collocation`."""

    def __init__(
        self, problem: Problem, library: str, name: str, tol: float, u_scale: float, t_out: FloatArray,
        left: BoolArray,
    ) -> None:  # fmt: skip
        super().__init__(problem, radau_scheme(STAGES), tol, u_scale, t_out, left)
        self.library, self.name, self.detail = library, name, ""
        # Without a request for charge its scale is infinite, which libraries cannot take: 1 C is as good as infinite.
        self.scale = np.where(np.isfinite(self.scale), self.scale, 1.0)
        fastest = float(problem.scene.rates.max(initial=0.0))
        self.tau = 1.0 / fastest if fastest > 0.0 else np.inf

    def through(self, sources: Sources, t_end: float) -> Status:
        edges = np.unique(sources.edges)
        stuck = 0
        for stop in np.append(edges[(edges > self.t) & (edges < t_end)], t_end):
            after = values_at(sources, self.t)
            jumps = np.abs(after - self.s_before) > collocation.ROUNDING * np.maximum(abs(after), abs(self.s_before))
            if np.any(jumps) and not self.jump(after):
                return self.stuck()
            while self.t < stop:
                before = self.t
                try:
                    self._piece(sources, float(stop))
                except _FailedError as error:
                    self.detail = error.text
                    return Status.METHOD_FAILED
                # Give up if every branch has changed sign without progress: on either side of 0 V the area's branch
                # leads back to 0 V at once.
                stuck = stuck + 1 if self.t == before else 0
                if stuck > 2 * self.sign.size:
                    return self.stuck()
        return Status.SUCCESS

    def _piece(self, sources: Sources, stop: float) -> None:
        """Integrate to the next zero of a gap voltage, at most to `stop` (s)."""
        net, room, base, sign, n_s = self.net, self.room, self.t, self.sign, self.s_before.size
        first = sources.first
        index = np.array([
            np.searchsorted(sources.edges[first[i] : first[i + 1]], base, side="right") - 1 for i in range(n_s)
        ])  # fmt: skip
        torch = self.library == "torchdiffeq"

        def rate(t: float, y: FloatArray) -> FloatArray:
            found: FloatArray = _rate(net, room, sources, index, base, t, np.ascontiguousarray(y), sign, torch)
            return found

        _rate(net, room, sources, index, base, 0.0, self.y, sign, bool(np.any(sign == 0.0)))
        follows = [int(i) for i in np.flatnonzero(net.gap >= 0)]
        gaps = [lambda t, y, i=i, s=float(sign[i]): s * _gap(net, room, sources, index, base, t, y, i) for i in follows]
        done = int(self.counters[collocation.OUTPUT])
        inside = (self.t_out < stop) | ((self.t_out == stop) & self.left)
        times = self.t_out[done : int(np.count_nonzero(inside))] - base
        piece = _Piece(rate, gaps, stop - base, self.y.copy(), times, self.tol, self.scale, self.tau)
        t, y, states, used = (_torch_piece if torch else _scipy_piece)(piece, self.name)
        for row, since, state in zip(self.rows[done:], times, states, strict=False):
            row[: state.size] = state
            if self.problem.charge:
                row[state.size :] = rate(float(since), state)[-n_s:]
        self.counters[collocation.OUTPUT] += len(states)
        self.counters[NFEV] += used
        self.counters[collocation.ACCEPTED] += 1
        at = [_gap(net, room, sources, index, base, t, y, i) for i in follows]
        if t < piece.length:
            met = follows[int(np.argmin([sign[i] * u for i, u in zip(follows, at, strict=True)]))]
            sign[met] = -sign[met]
        at_sources(sources, index, base, t, self.s_before, room.ds)
        self.y[:] = y
        self.control[collocation.BASE] = stop if t == piece.length else base + t


def solve_foreign(
    problem: Problem, method: str, rtol: float, t_out: FloatArray, left: BoolArray,
    progress: Progress | None = None,
) -> Run:  # fmt: skip
    """Integrate with a library's method until the error against our own Radau is within `rtol` of the peaks.

    Raises
    ------
    InputError
        For an unknown method, or for torchdiffeq if it is not installed.
    """
    library, _, name = method.partition(":")
    known = SCIPY_METHODS if library == "scipy" else TORCH_METHODS
    if name not in known:
        allowed = ", ".join(f"{library}:{m}" for m in known)
        raise InputError(f"unknown method '{method}'; allowed: {allowed}")
    if library == "torchdiffeq":
        try:
            import torchdiffeq  # noqa: F401
        except ImportError:
            raise InputError(f"method '{method}' needs torchdiffeq; pip install 'fingerspice[torch]'") from None
    reference = solve_coupled(problem, max(REFERENCE * rtol, 1e-13), t_out, left)
    ours = list(gap_signals(reference.record(problem)))
    u_scale = float(reference.gaps[:, 0].max(initial=0.0)) or 1.0
    tol, nfev = FIRST * rtol, 0
    for attempt in range(ATTEMPTS):
        one = Foreign(problem, library, name, tol, u_scale, t_out, left)
        run = integrate(one, Tables(problem, tol, t_out=t_out), progress)
        nfev += run.nfev
        run.nfev, run.margin, run.detail = nfev, reference.margin, one.detail
        gaps = reference.gaps.copy()
        for gap, mine, theirs in zip(gaps, ours, gap_signals(run.record(problem)), strict=True):
            n = min(mine[0].size, theirs[0].size)
            gap[2:] += [np.abs(a[:n] - b[:n]).max(initial=0.0) for a, b in zip(mine, theirs, strict=True)]
        run.gaps = gaps
        run.node_error = (reference.node_error or 0.0) + nodes_apart(reference.record(problem), run.record(problem))
        worst = run.excess(max(ROUNDING * u_scale, problem.rounding)) / rtol
        if run.status is not Status.SUCCESS:
            if reference.status is Status.FOLD:
                run.status, run.t_failed = reference.status, reference.t_failed
            return run
        if worst <= 1.0:

            def look(t: FloatArray, left: BoolArray, tol: float = tol) -> Record:
                again = Foreign(problem, library, name, tol, u_scale, t, left)
                return integrate(again, Tables(problem, tol), None).record(problem)

            run.continuous = closed_form(problem, look, rtol)
            return run
        if attempt < ATTEMPTS - 1:
            tol = max(tol * min(0.3, 0.5 / worst), 1e-16)
    run.status = Status.ERROR_NOT_MET
    return run
