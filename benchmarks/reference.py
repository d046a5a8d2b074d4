"""Reference solutions of the benchmark problems, by two methods that share no formula.

One method is collocation of the paper's equations, by `tests/analytic.py` or, for networks, `network_collocation.py`.
The other method integrates the peers' right-hand side at the tightest tolerance, split at jumps and at the zeros of the
gap voltage: by DOP853, or by Radau if the problem is stiff. No error below the difference of the two is claimed.
"""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from network_collocation import Collocation, Network
from network_problems import NetworkProblem
from problems import AMPLITUDE, Problem, split_times
from right_hand_side import compiled

FloatArray = NDArray[np.float64]
HERE = Path(__file__).resolve().parent
ANALYTIC = HERE.parent / "tests" / "analytic.py"
CACHE = HERE / ".cache"
AGREEMENT = 1e-12
"""Agreement asked of the two methods, relative to the peak."""


@dataclass(frozen=True)
class Reference:
    """The reference solution at the outputs of a problem's whole run.

    Attributes
    ----------
    u_gap, f_el : ndarray, shape (n,), or (n, 2) for two fingers
        Gap voltage (V) and electroadhesive force (N).
    zeros : ndarray
        Times of the zeros of the gap voltages, s.
    signs : ndarray
        Signs of the gap voltages on each piece between jumps and zeros; for several gaps see `network_rates.code`.
    agreement : float
        Largest difference of the two methods, of voltage or force, relative to the peak.
    second : str
        The second method, besides the collocation.
    """

    u_gap: FloatArray
    f_el: FloatArray
    zeros: FloatArray
    signs: FloatArray
    agreement: float
    second: str

    def errors(self, u_gap: FloatArray, f_el: FloatArray) -> tuple[float, float]:
        """Largest errors of voltage and force, relative to their peaks; the run may be shorter than this one."""
        n = len(u_gap)
        pairs = ((u_gap, self.u_gap), (f_el, self.f_el))
        # The errors of each finger are relative to its own peak.
        off = [np.max(np.abs(found - true[:n]).max(axis=0) / np.abs(true).max(axis=0)) for found, true in pairs]
        return float(off[0]), float(off[1])


@lru_cache(maxsize=1)
def _analytic() -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark_analytic", ANALYTIC)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look up their module by name in `sys.modules`.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _segments(problem: Problem) -> list[tuple[float, float, Callable[[FloatArray], FloatArray]]]:
    u = problem.drive(np.sin)
    return [
        (piece.t0, piece.t1, lambda t, level=piece.level: u(np.asarray(t), level) + 0.0 * np.asarray(t))
        for piece in problem.pieces(problem.periods)
    ]


def _network_collocation(problem: NetworkProblem) -> Reference:
    network = Network(_analytic(), problem.deck, problem.skin_frequency, problem.law == "mobile")
    run = Collocation(network, AMPLITUDE, problem.t_eval(problem.periods))
    x = np.zeros(network.size)
    for t0, t1, source in _segments(problem):
        x = run.segment(t0, t1, x, source)
    u_gap = run.out[:, network.gaps]
    force = network.forces(u_gap)
    zeros = np.sort(run.zeros)
    edges = split_times(problem, problem.periods, zeros)
    since, codes = np.array(run.branches).T
    signs = codes[np.searchsorted(since, 0.5 * (edges[1:] + edges[:-1])) - 1]
    shape = (-1, len(network.gaps)) if len(network.gaps) > 1 else -1
    return Reference(u_gap.reshape(shape), force.reshape(shape), zeros, signs, np.inf, "")


def _collocation(problem: Problem) -> Reference:
    if isinstance(problem, NetworkProblem):
        return _network_collocation(problem)
    analytic = _analytic()
    run = analytic.transient(
        _segments(problem),
        problem.t_eval(problem.periods),
        law=problem.law,
        freq=problem.skin_frequency,
        params=replace(analytic.TABLE1, r_i=problem.r_coat),
    )
    zeros = np.asarray(run.zeros)
    edges = split_times(problem, problem.periods, zeros)
    signs = np.sign(run.at(0.5 * (edges[1:] + edges[:-1])).u_gap)
    return Reference(run.u_gap, run.force, zeros, signs, np.inf, "")


def _peers_way(problem: Problem, zeros: FloatArray, signs: FloatArray) -> tuple[FloatArray, FloatArray, str]:
    rhs = compiled(problem)
    # The fast modes of networks force an explicit method to short steps: it only solves the first ten periods.
    network = isinstance(problem, NetworkProblem)
    periods = min(10, problem.periods) if network else problem.periods
    method = "Radau" if problem.stiff else "DOP853"
    rtol = 1e-13 if problem.stiff else 3e-14
    t_eval = problem.t_eval(periods)
    states = np.empty((t_eval.size, rhs.size))
    x = np.zeros(rhs.size)
    for piece in problem.pieces(periods, zeros[zeros < problem.t_stop(periods)], signs):
        times = np.append(t_eval[piece.first : piece.last], piece.t1)
        args = (piece.sign, piece.level)
        extra = {"jac": rhs.jacobian} if problem.stiff else {}
        # Limit the steps, because outputs come from the interpolant, whose order is lower than that of the method.
        run = solve_ivp(rhs.rates, (piece.t0, piece.t1), x, method, times, args=args, rtol=rtol, atol=1e-14 * 200.0,
                        max_step=(piece.t1 - piece.t0) / (300.0 if network else 12.0), **extra)  # fmt: skip
        states[piece.first : piece.last] = run.y.T[:-1]
        x = run.y[:, -1]
    u_source = problem.waveform.value(t_eval)
    return (*rhs.observe(u_source, states), f"{method} at rtol {rtol:g}")


def reference(problem: Problem, second: bool = True) -> Reference:
    """The reference of a problem, from the cache unless the problem or the references' sources have changed.

    `second` False leaves out the second method, for short checks; the result is then not cached.
    """
    if not second:
        return _collocation(problem)
    files = (ANALYTIC, HERE / "problems.py", HERE / "right_hand_side.py", Path(__file__))
    text = "\n".join([problem.name, repr(problem), *(f.read_text(encoding="utf-8") for f in files)])
    path = CACHE / f"{problem.name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"
    if path.is_file():
        with np.load(path) as kept:
            return Reference(kept["u_gap"], kept["f_el"], kept["zeros"], kept["signs"], float(kept["agreement"]),
                             str(kept["second"]))  # fmt: skip
    found = _collocation(problem)
    u_gap, f_el, name = _peers_way(problem, found.zeros, found.signs)
    found = replace(found, agreement=max(found.errors(u_gap, f_el)), second=name)
    CACHE.mkdir(exist_ok=True)
    (CACHE / ".gitignore").write_text("*\n")
    np.savez(path, **{name: np.asarray(value) for name, value in vars(found).items()})
    return found
