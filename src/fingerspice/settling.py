"""When a run under a periodic source has settled: from there on its periods are alike, and one is enough."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.sampling import same_time
from fingerspice.networks import NetworkProblem
from fingerspice.problem import Problem

FloatArray = NDArray[np.float64]

# Shorter runs are stepped as they are: nothing would be saved.
FEWEST_PERIODS = 6.0
# What all later periods may still move, over the error allowed in a step.
_SHARE = 1.0 / 3.0
# Coupling changes the rates of the stack with its area frozen; by how much they may be too large.
_RATE_SHARE = 0.5


class Settling:
    """Looks at the state at whole periods until later periods no longer change it.

    Parameters
    ----------
    problem : Problem or NetworkProblem
    rates : ndarray
        Rates of the stack with its area frozen, 1/s.
    tol : float
        Error of the gap voltage allowed in a step, V.

    Attributes
    ----------
    next : float
        Time of the next look, s; inf where there is nothing to wait for.
    remaining : float
        Bound of what all periods after the last look still move, V.
    """

    def __init__(self, problem: Problem | NetworkProblem, rates: FloatArray, tol: float) -> None:
        self.period = problem.waveform.period or math.inf
        self.start = max(problem.t_start, problem.waveform.settled)
        self.stop = problem.t_stop
        self.charge = problem.charge
        self.allowed = _SHARE * tol
        live = rates[rates > 0.0]
        # A mode that does not leak keeps its charge: it has nothing to settle to.
        self.rate = _RATE_SHARE * float(live.min()) if live.size else math.inf
        self.next = self.start if self.periods_left(self.start) >= FEWEST_PERIODS else math.inf
        self.remaining = math.inf
        self._count = 0
        self._looked: tuple[int, FloatArray] | None = None

    def periods_left(self, t: float) -> int:
        """Whole periods from t (s) to the end of the run."""
        return max(0, math.floor((self.stop - t) / self.period * (1.0 + 1e-12)))

    def look(self, x: FloatArray, magnified: float) -> bool:
        """Compare the live voltages (n,) now, at `next`, with those of the last look; whether they have settled.

        `magnified` is the largest move of the gap voltage for a move of a live one.
        """
        self.remaining = math.inf
        left = self.periods_left(self.next)
        if self._looked is not None:
            before, y = self._looked
            passed = self._count - before
            # For a few numbers numpy's calls would cost more than the rest of the look.
            moved = magnified * max(map(abs, (x - y).tolist()), default=0.0)
            decay = min(self.rate * self.period * passed, 700.0)
            # What is left decays as a geometric series, or moves on no faster than up to now.
            self.remaining = moved * min(left / passed, max(1.0 / math.expm1(decay), 1e-3))
            if self.charge:
                # The charge of the kept period, a little off, is added up in every later one.
                self.remaining *= max(1.0, left * min(1.0, self.rate * self.period))
        self._looked = self._count, x.copy()
        settled = self.remaining <= self.allowed
        self._plan(1 if settled else self._wait(), left)
        return settled

    def _wait(self) -> int:
        """Periods until it may have settled, by the frozen rates, but no more than twice those passed."""
        per_period = self.rate / _RATE_SHARE * self.period
        if not (math.isfinite(self.remaining) and 0.0 < per_period < math.inf):
            return 1
        wait = math.ceil(0.8 * math.log(self.remaining / self.allowed) / per_period)
        return max(1, min(wait, 2 * self._count))

    def _plan(self, wait: int, left: int) -> None:
        self._count += wait
        self.next = self.start + self._count * self.period if wait < left else math.inf

    def snapped(self, edges: FloatArray) -> float:
        """Time of the next look, on the edge (ascending, s) of the source that it misses by rounding."""
        if self.next == math.inf:
            return self.next
        i = int(edges.searchsorted(self.next))
        for edge in edges[max(i - 1, 0) : i + 1].tolist():
            if abs(edge - self.next) <= same_time(edge):
                return float(edge)
        return self.next
