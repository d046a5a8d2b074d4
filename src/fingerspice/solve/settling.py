"""When a run under a periodic source has settled: from there on its periods are alike, and one is enough."""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray
from fingerspice.solve.problem import Problem
from fingerspice.waveforms.sampling import same_time

# Shorter runs are stepped as they are: nothing would be saved.
FEWEST_PERIODS = 6.0
# What all later periods may still move, over the error allowed in a step.
_SHARE = 1.0 / 3.0
# Distance to the periodic state, over the root of allowed error and peak, at which the map of a period may be linear
# enough; found out by trying.
_NEAR = 10.0
# How far it is looked around, over that distance, at least: nearer by, differences of periods are rounding.
_PROBE = 0.1
# Steps that a leap's calls cost, in all and in each of its periods: one per live voltage and three more.
_CALLS, _CALL = 50, 10
# Coupling changes the rates of the stack with its area frozen; by how much they may be too large.
_RATE_SHARE = 0.5


class Settling:
    """Looks at the state at whole periods until later periods no longer change it.

    Parameters
    ----------
    problem : Problem
    rates : ndarray
        Rates of the stack with its area frozen, 1/s.
    tol : float
        Error of the gap voltage allowed in a step, V.

    Attributes
    ----------
    next : float
        Time of the next look, s; inf where there is nothing to wait for.
    distance, remaining : float
        Bound of what all periods after the last look still move, V; and of that with what it adds to the charge.
    near : float
        Distance at which the map of a period may pass for a linear one, V.
    """

    def __init__(self, problem: Problem, rates: FloatArray, tol: float) -> None:
        self.period = problem.waveform.period or math.inf
        self.start = max(problem.t_start, problem.waveform.settled)
        self.stop = problem.t_stop
        self.charge = problem.charge
        self.allowed = _SHARE * tol
        live = rates[rates > 0.0]
        # A mode that does not leak keeps its charge: it has nothing to settle to.
        self.rate = _RATE_SHARE * float(live.min()) if live.size else math.inf
        self.next = self.start if self.periods_left(self.start) >= FEWEST_PERIODS else math.inf
        self.distance = self.remaining = math.inf
        self.near = math.inf
        self._modes = live.size
        self._steps = 0.0
        self._count = 0
        self._looked: tuple[int, FloatArray] | None = None

    def periods_left(self, t: float) -> int:
        """Whole periods from t (s) to the end of the run."""
        return max(0, math.floor((self.stop - t) / self.period * (1.0 + 1e-12)))

    def look(self, x: FloatArray, magnified: float, peak: float = 0.0, steps: int = 0) -> bool:
        """Compare the live voltages (n,) now, at `next`, with those of the last look; whether they have settled.

        `magnified` is the largest move of the gap voltage for a move of a live one. Where a leap may come of it: the
        gap voltage's peak (V), and the steps taken so far.
        """
        self._steps = steps / max(self._count, 1)
        if peak > 0.0:
            self.near = max(self.allowed, min(self.near, _NEAR * math.sqrt(self.allowed * peak)))
        self.distance = self.remaining = math.inf
        left = self.periods_left(self.next)
        if self._looked is not None:
            before, y = self._looked
            passed = self._count - before
            # For a few numbers numpy's calls would cost more than the rest of the look.
            moved = magnified * max(map(abs, (x - y).tolist()), default=0.0)
            decay = min(self.rate * self.period * passed, 700.0)
            # What is left decays as a geometric series, or moves on no faster than up to now.
            self.distance = self.remaining = moved * min(left / passed, max(1.0 / math.expm1(decay), 1e-3))
            if self.charge:
                # The charge of the kept period, a little off, is added up in every later one.
                self.remaining *= max(1.0, left * min(1.0, self.rate * self.period))
        self._looked = self._count, x.copy()
        settled = self.remaining <= self.allowed
        self._plan(1 if settled else self._wait(), left)
        return settled

    def _until(self, share: float) -> float:
        """Periods until things have decayed to a share, by the frozen rates; nan where nothing is known yet."""
        per_period = self.rate / _RATE_SHARE * self.period
        if not (0.0 < share < math.inf and 0.0 < per_period < math.inf):
            return math.nan
        return -math.log(share) / per_period

    @property
    def may_leap(self) -> bool:
        """Whether what is left after the last look is nearly periodic, and long enough."""
        return self.distance <= self.near and self._is_far(self.periods_left(self._last_look))

    def _is_far(self, left: float) -> bool:
        """Whether a leap saves twice what it costs, in steps."""
        if self.distance > self.allowed:
            left = min(self._until(self.allowed / self.remaining), left)
        # Else only the charge has to wait, which the errors of steps may keep from ever settling.
        saved = left * self._steps
        return saved > 2.0 * ((self._modes + 3) * (self._steps + _CALL) + _CALLS)

    @property
    def _last_look(self) -> float:
        assert self._looked is not None
        return self.start + self._looked[0] * self.period

    @property
    def probe(self) -> float:
        """How far to move a live voltage to see what the end of a period owes to its start, V."""
        return max(self.distance, _PROBE * self.near)

    def leapt(self, periods: int, x: FloatArray) -> None:
        """Go on from live voltages (n,), that many periods after the last look."""
        assert self._looked is not None
        self._count = self._looked[0] + periods
        self._looked = self._count, x.copy()
        self._plan(1, self.periods_left(self._last_look))

    def stumbled(self, excess: float) -> None:
        """A leap after the last look would have been off by so many times what is allowed: wait to be nearer."""
        assert self._looked is not None
        # What a linear map misses goes with the square of the distance.
        self.near = max(self.allowed, self.distance * min(0.5, 0.7 / math.sqrt(excess)))
        self._count = self._looked[0]
        self._plan(self._wait(), self.periods_left(self._last_look))

    def _wait(self) -> int:
        """Periods until it may have settled, or is near enough to leap, but no more than twice those passed."""
        settled = self._until(self.allowed / self.remaining)
        wait = self._until(self.near / self.distance) if self._is_far(math.inf) else settled
        return 1 if wait != wait else max(1, min(math.ceil(0.8 * wait), 2 * self._count))

    def _plan(self, wait: int, left: int) -> None:
        self._count += wait
        self.next = self.start + self._count * self.period if wait < left else math.inf

    @staticmethod
    def snapped(edges: FloatArray, t: float) -> float:
        """Time t (s), on the edge (ascending, s) of the source that it misses by rounding."""
        if t == math.inf:
            return t
        i = int(edges.searchsorted(t))
        for edge in edges[max(i - 1, 0) : i + 1].tolist():
            if abs(edge - t) <= same_time(edge):
                return float(edge)
        return t
