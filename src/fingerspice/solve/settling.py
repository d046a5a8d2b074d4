"""Test whether a run under a periodic source has reached its periodic state: then one period gives all later ones."""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray
from fingerspice.solve.problem import Problem
from fingerspice.waveforms.sampling import same_time

# Runs of fewer periods are integrated throughout, because nothing would be saved.
FEWEST_PERIODS = 6.0
# Remaining change allowed over all later periods, as a fraction of the error allowed in a step.
_SHARE = 1.0 / 3.0
# Distance to the periodic state below which the period map is first tried as a linear one, in units of
# sqrt(allowed error * peak): the map's defect is of second order. A rejected extrapolation reduces the distance.
_NEAR = 10.0
# Smallest perturbation for the map's derivative, relative to that distance; with a smaller one, round-off dominates
# the difference of two periods.
_PROBE = 0.1
# Overhead of an extrapolation in units of steps: once, and for each of its periods (one per live voltage, and three).
_CALLS, _CALL = 50, 10
# The coupling may make the slowest mode slower than with the area frozen; this fraction of its rate is a safe bound.
_RATE_SHARE = 0.5


class Settling:
    """Compares the states after whole periods until later periods no longer change them.

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
        Time of the next comparison, s; inf if no later comparison would save steps.
    distance, remaining : float
        Bound of the change of the gap voltage in all periods after the last comparison, V; the same enlarged by a
        factor for the effect of that change on the charge.
    near : float
        Distance to the periodic state below which the map of a period may be taken as linear, V.
    """

    def __init__(self, problem: Problem, rates: FloatArray, tol: float) -> None:
        self.period = problem.waveform.period or math.inf
        self.start = max(problem.t_start, problem.waveform.settled)
        self.stop = problem.t_stop
        self.charge = problem.charge
        self.allowed = _SHARE * tol
        live = rates[rates > 0.0]
        # A mode with rate 0 keeps its charge for ever, so that it does not limit the time to the periodic state.
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
        """Compare the live voltages x (V, shape (n,)) at time `next` with the last ones; True if they have settled.

        `magnified` is the largest ratio of a change of the gap voltage to a change of a live voltage. The gap voltage's
        `peak` (V) and the number of `steps` so far are needed to decide on an extrapolation.
        """
        self._steps = steps / max(self._count, 1)
        if peak > 0.0:
            self.near = max(self.allowed, min(self.near, _NEAR * math.sqrt(self.allowed * peak)))
        self.distance = self.remaining = math.inf
        left = self.periods_left(self.next)
        if self._looked is not None:
            before, y = self._looked
            passed = self._count - before
            # In plain Python: for so few numbers the overhead of numpy's calls would dominate this method.
            moved = magnified * max(map(abs, (x - y).tolist()), default=0.0)
            decay = min(self.rate * self.period * passed, 700.0)
            # Later changes form a geometric series, or with negligible decay each period changes as much as the last.
            self.distance = self.remaining = moved * min(left / passed, max(1.0 / math.expm1(decay), 1e-3))
            if self.charge:
                # The charge error of the repeated period accumulates in every later period.
                self.remaining *= max(1.0, left * min(1.0, self.rate * self.period))
        self._looked = self._count, x.copy()
        settled = self.remaining <= self.allowed
        self._plan(1 if settled else self._wait(), left)
        return settled

    def _until(self, share: float) -> float:
        """Periods in which the slowest mode of the frozen circuit decays to `share`; NaN where that is undefined."""
        per_period = self.rate / _RATE_SHARE * self.period
        if not (0.0 < share < math.inf and 0.0 < per_period < math.inf):
            return math.nan
        return -math.log(share) / per_period

    @property
    def may_leap(self) -> bool:
        """Whether the state is near enough to the periodic one for extrapolation, and enough periods remain."""
        return self.distance <= self.near and self._is_far(self.periods_left(self._last_look))

    def _is_far(self, left: float) -> bool:
        """Whether an extrapolation saves more than twice its own cost, both counted in steps."""
        if self.distance > self.allowed:
            left = min(self._until(self.allowed / self.remaining), left)
        # Otherwise only the charge has not settled. It may never do so, because truncation errors of the steps keep
        # the states of successive periods different: all remaining periods would be integrated.
        saved = left * self._steps
        return saved > 2.0 * ((self._modes + 3) * (self._steps + _CALL) + _CALLS)

    @property
    def _last_look(self) -> float:
        assert self._looked is not None
        return self.start + self._looked[0] * self.period

    @property
    def probe(self) -> float:
        """Perturbation of a live voltage for the finite differences of the period map, V."""
        return max(self.distance, _PROBE * self.near)

    def leapt(self, periods: int, x: FloatArray) -> None:
        """Record an accepted extrapolation over `periods` periods from the last comparison to live voltages x (n,)."""
        assert self._looked is not None
        self._count = self._looked[0] + periods
        self._looked = self._count, x.copy()
        self._plan(1, self.periods_left(self._last_look))

    def stumbled(self, excess: float) -> None:
        """Record a rejected extrapolation, whose error was `excess` times the allowed one: wait until nearer."""
        assert self._looked is not None
        # The error of a linear map goes with the square of the distance, hence the root.
        self.near = max(self.allowed, self.distance * min(0.5, 0.7 / math.sqrt(excess)))
        self._count = self._looked[0]
        self._plan(self._wait(), self.periods_left(self._last_look))

    def _wait(self) -> int:
        """Periods until the run may have settled or may be extrapolated, at most twice the periods passed so far."""
        settled = self._until(self.allowed / self.remaining)
        wait = self._until(self.near / self.distance) if self._is_far(math.inf) else settled
        return 1 if wait != wait else max(1, min(math.ceil(0.8 * wait), 2 * self._count))

    def _plan(self, wait: int, left: int) -> None:
        self._count += wait
        self.next = self.start + self._count * self.period if wait < left else math.inf

    @staticmethod
    def snapped(edges: FloatArray, t: float) -> float:
        """Time t (s), or the edge of the source (s, ascending) from which it differs by rounding only."""
        if t == math.inf:
            return t
        i = int(edges.searchsorted(t))
        for edge in edges[max(i - 1, 0) : i + 1].tolist():
            if abs(edge - t) <= same_time(edge):
                return float(edge)
        return t
