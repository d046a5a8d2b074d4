"""Integrators of scipy and torchdiffeq on the same right-hand side, split at the same breakpoints.

Their error is measured against our own stepper at a tighter tolerance, and met by tightening theirs.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.compiled import jit
from fingerspice.base.errors import InputError
from fingerspice.engine import advance as loop
from fingerspice.engine.model import Model, choose_branch, dot, right_hand_side, write_row
from fingerspice.engine.segment import Segment, source
from fingerspice.results.outcome import ErrorEstimate, State, Status
from fingerspice.solve.marching import solve as solve_marching
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Run, Tables, after_the_end, from_rows, row_width
from fingerspice.waveforms.sampling import SourceTable

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_QUIET = threading.Lock()
SCIPY_METHODS = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")
TORCH_METHODS = ("dopri5", "dopri8", "bosh3", "adaptive_heun", "rk4", "midpoint", "euler")
_TORCH_FIXED = {"rk4": 4, "midpoint": 2, "euler": 1}


class _FailedError(Exception):
    """A library's integrator gave up; `t` (s) is how far it got."""

    def __init__(self, t: float, text: str) -> None:
        self.t = t
        self.text = text
        super().__init__(text)


@jit
def _slope(model: Model, segment: Segment, t: float, y: FloatArray, sign: float) -> FloatArray:
    """y' at time t; sign 0 takes the branch of the gap voltage itself."""
    u_source, du_source = source(segment, t - segment.start)
    zero = model.k_gap * u_source + dot(model.gap, y)
    if sign == 0.0:
        sign = choose_branch(model, u_source, y)
    out = np.empty(y.size)
    right_hand_side(model, u_source, du_source, y, sign, zero, out)
    return out


@jit
def _zero(model: Model, segment: Segment, t: float, y: FloatArray) -> float:
    u_source, _ = source(segment, t - segment.start)
    return model.k_gap * u_source + dot(model.gap, y)


@dataclass
class _Piece:
    """A smooth stretch of the run, handed to a library."""

    model: Model
    segment: Segment
    sign: float
    t0: float
    t1: float
    y: FloatArray
    times: FloatArray
    tol: float
    scale: FloatArray


# What a library gives back: end time, end state, states at the times reached, evaluations.
_Result = tuple[float, FloatArray, FloatArray, int]


def _scipy_piece(piece: _Piece, name: str) -> _Result:
    from scipy.integrate import solve_ivp

    def zero(t: float, y: FloatArray) -> float:
        return float(_zero(piece.model, piece.segment, t, y)) if piece.model.coupled else 1.0

    zero.terminal = True  # type: ignore[attr-defined]
    zero.direction = -piece.sign  # type: ignore[attr-defined]
    # Filters are of the whole process: one thread at a time changes them, and only for scipy's own.
    with _QUIET, warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"scipy\.")
        result = solve_ivp(
            lambda t, y: _slope(piece.model, piece.segment, t, y, piece.sign),
            (piece.t0, piece.t1), piece.y, method=name, dense_output=True, events=zero,
            rtol=max(piece.tol, 3e-14), atol=piece.tol * piece.scale,
        )  # fmt: skip
    end = result.y[:, -1]
    # LSODA calls NaN a success.
    if result.status < 0 or not np.all(np.isfinite(end)):
        raise _FailedError(float(result.t[-1]), str(result.message))
    t_end = float(result.t[-1]) if result.status == 1 else piece.t1
    times = piece.times[piece.times <= t_end]
    return t_end, end, result.sol(times).T if times.size else np.empty((0, end.size)), int(result.nfev)


def _torch_piece(piece: _Piece, name: str) -> _Result:
    import torch
    from torchdiffeq import odeint

    counts = [0]

    def slope(t: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        counts[0] += 1
        # The state is in units of its scale: torchdiffeq takes one atol for all.
        state = y.numpy() * piece.scale
        rate = _slope(piece.model, piece.segment, float(t), state, 0.0) / piece.scale
        # Past a fold there is no slope, and torchdiffeq turns a NaN into a step of NaN; a huge slope is refused.
        rate = np.where(np.isfinite(rate), rate, 1e9 / (piece.t1 - piece.t0))
        return torch.from_numpy(rate)

    times = np.unique(np.concatenate([[piece.t0], piece.times, [piece.t1]]))
    options = {}
    if name in _TORCH_FIXED:
        # A fixed step from the tolerance: local error ~ (h / tau)^order.
        longest = min(piece.model.tau, (piece.t1 - piece.t0) / 4.0)
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
        raise _FailedError(piece.t0, text) from None
    if not np.all(np.isfinite(y[-1])):
        raise _FailedError(piece.t0, "torchdiffeq returned NaN")
    return piece.t1, y[-1], y[np.searchsorted(times, piece.times)], counts[0]


def _integrate(
    problem: Problem, run_piece: Callable[[_Piece, str], _Result], name: str, tol: float, scale: FloatArray,
    t_out: FloatArray, left: BoolArray,
) -> Run:  # fmt: skip
    model = problem.model
    y = problem.initial.y.copy()
    control = np.zeros(loop.N_CONTROL)
    control[loop.T] = problem.t_start
    control[loop.U_BEFORE] = problem.initial.u_before
    rows = np.full((t_out.size, row_width(problem)), np.nan)
    done, nfev, pieces = 0, 0, 0
    status, detail, t_failed = Status.SUCCESS, "", None
    table: SourceTable | None = None
    tables = Tables(problem, tol, t_out=t_out)
    try:
        for table in tables:
            for i in range(table.edges.size - 1):
                start, stop = float(table.edges[i]), float(table.edges[i + 1])
                segment = Segment(start, stop - start, table.terms[i], table.series[i])
                while control[loop.T] < stop:
                    t = float(control[loop.T])
                    loop.enter(model, segment, t - start, y, control)
                    sign = float(control[loop.SIGN])
                    last = done
                    while last < t_out.size and (t_out[last] < stop or (t_out[last] == stop and left[last])):
                        last += 1
                    piece = _Piece(model, segment, sign, t, stop, y, t_out[done:last], tol, scale)
                    t_end, y_end, states, used = run_piece(piece, name)
                    for state in states:
                        u, du = source(segment, t_out[done] - start)
                        here = sign if name in SCIPY_METHODS else float(choose_branch(model, u, state))
                        write_row(model, u, du, np.ascontiguousarray(state), here, u, rows[done])
                        done += 1
                    y = np.ascontiguousarray(y_end)
                    control[loop.T] = t_end
                    control[loop.U_BEFORE], _ = source(segment, t_end - start)
                    control[loop.SIGN] = -sign if t_end < stop else 0.0
                    nfev += used
                    pieces += 1
            if table.not_finite is not None:
                status, t_failed = Status.SOURCE_NOT_FINITE, table.not_finite
                break
    except _FailedError as error:
        status, detail, t_failed = Status.METHOD_FAILED, error.text, error.t
    if status is Status.SUCCESS and table is not None and done < t_out.size:
        segment, tau = after_the_end(problem, table)
        u, du = loop.enter(model, segment, tau, y, control)
        for i in range(done, t_out.size):
            write_row(model, u, du, y, control[loop.SIGN], u, rows[i])
        done = t_out.size
    state = State(float(control[loop.T]), y, float(control[loop.U_BEFORE]), problem.initial.charge_offset,
                  problem.scene.charge_law)  # fmt: skip
    return Run(
        t_out[:done],
        left[:done],
        *from_rows(problem, rows[:done]),
        status=status,
        error=ErrorEstimate(0.0, 0.0),
        peak_u=0.0,
        peak_f=0.0,
        nfev=nfev,
        stats={"pieces": pieces},
        state=state,
        t_failed=t_failed,
        detail=detail,
        unseen=tables.unseen,
    )


def solve_foreign(problem: Problem, library: str, name: str, rtol: float, t_out: FloatArray, left: BoolArray) -> Run:
    """Integrate with a library's method until the error against our own stepper is within `rtol` of the peaks.

    Raises
    ------
    InputError
        For an unknown method, or torchdiffeq where it is not installed.
    """
    known = SCIPY_METHODS if library == "scipy" else TORCH_METHODS
    if name not in known:
        allowed = ", ".join(f"{library}:{m}" for m in known)
        raise InputError(f"unknown method '{library}:{name}'; allowed: {allowed}")
    if library == "torchdiffeq":
        try:
            import torchdiffeq  # noqa: F401
        except ImportError:
            raise InputError(
                f"method 'torchdiffeq:{name}' needs torchdiffeq; pip install 'fingerspice[torch]'"
            ) from None
    run_piece = _scipy_piece if library == "scipy" else _torch_piece
    fine = max(0.03 * rtol, 1e-13)
    reference = solve_marching(problem, fine, t_out, left)
    z_scale = reference.peak_u * problem.model.area0 / problem.model.s
    scale = np.append(np.full(problem.stack.c.size - 1, reference.peak_u), z_scale)
    scale = np.where(scale > 0.0, scale, 1.0)
    ours_u, ours_f = _gap(problem, reference)
    tol, nfev = 0.1 * rtol, 0
    for _attempt in range(6):
        run = _integrate(problem, run_piece, name, tol, scale, t_out, left)
        nfev += run.nfev
        run.nfev, run.peak_u, run.peak_f, run.margin = nfev, reference.peak_u, reference.peak_f, reference.margin
        theirs_u, theirs_f = _gap(problem, run)
        n = min(ours_u.size, theirs_u.size)
        run.error = ErrorEstimate(
            float(np.abs(theirs_u[:n] - ours_u[:n]).max(initial=0.0)) + reference.error.u_gap,
            float(np.abs(theirs_f[:n] - ours_f[:n]).max(initial=0.0)) + reference.error.f_el,
        )
        if run.status is not Status.SUCCESS:
            if reference.status is Status.FOLD:
                run.status, run.t_failed = reference.status, reference.t_failed
            return run
        worst = run.excess(rtol)
        if worst <= 1.0:
            return run
        tol = max(tol * min(0.3, 0.5 / worst), 1e-16)
    run.status = Status.ERROR_NOT_MET
    return run


def _gap(problem: Problem, run: Run) -> tuple[FloatArray, FloatArray]:
    """Voltage of the layer that errors are measured on, and the force."""
    record = run.record(problem)
    if problem.stack.contact is None:
        return record.u_layer[:, problem.scene.probe_layer], np.zeros(run.t.size)
    return record.u_gap, np.asarray(problem.stack.contact.stress(record.u_gap) * record.area)
