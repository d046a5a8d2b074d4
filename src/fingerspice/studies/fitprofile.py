"""Profile likelihood of a fitted parameter: how well the data can be fitted with other values of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.studies.fitestimates import Profile
from fingerspice.studies.fitresult import Fitted
from fingerspice.studies.fittask import FARTHEST, Problem, followed

# Growth of the distance from the value, in its logarithm; and the error of an interval's end over that distance.
_GROWTH, _CLOSE = 1.6, 0.01
# Error of the other parameters on the way.
_ROUGHLY = 1e-4
# Ratio of the interval's two parts, in the logarithm, from which on it is called skewed.
_SKEWED = 1.2


@dataclass(frozen=True)
class _Held:
    """A problem of which one value is held."""

    whole: Problem
    place: int
    value: float

    @property
    def bounds(self) -> FloatArray:
        return np.delete(self.whole.bounds, self.place, axis=0)

    def residuals(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        residual, by = self.whole.residuals(np.insert(values, self.place, self.value))
        return residual, np.delete(by, self.place, axis=1)


def limit_of(objective: float, freedom: int, *, given: bool) -> float:
    """The objective at the ends of a 95 % interval; `given` says whether sigma was, or is estimated.

    It exceeds the least objective by the 95 % quantile of chi squared with one degree of freedom, or, where sigma is
    estimated, of F (Bates and Watts, Nonlinear regression analysis, 1988, section 6.1).
    """
    from scipy.stats import chi2, f

    if given:
        return objective + float(chi2.ppf(0.95, 1))
    return objective * (1.0 + float(f.ppf(0.95, 1, freedom)) / freedom) if freedom > 0 else math.inf


def profile_of(task: Problem, paths: Sequence[str], best: Fitted, path: str, error: float, limit: float) -> Profile:
    """The profile of one of the parameters `paths`; its interval holds all values with objectives up to `limit`.

    `error` is the standard error of its logarithm at the best fit.
    """
    place = paths.index(path)
    here = math.log(best.values[place])
    box = task.bounds[place]
    known = {here: best.objective}
    low, high = (_end(task, best, place, sign, error, limit, box, known) for sign in (-1.0, 1.0))
    at = sorted(known)
    reach = [here - math.log(low) if low > 0.0 else math.inf, math.log(high) - here]
    open_below, open_above = (known_end is None for known_end in (_crossed(known, limit, here, s) for s in (-1, 1)))
    if open_below or open_above:
        shape = "open" if open_below and open_above else "open below" if open_below else "open above"
    else:
        shape = "skewed" if max(reach) > _SKEWED * min(reach) else "symmetric"
    return Profile(path, np.exp(at), np.array([known[x] for x in at]), limit, low, high, shape)


def _crossed(known: dict[float, float], limit: float, here: float, sign: int) -> float | None:
    """The nearest known place on one side of the best fit at which the objective is beyond the limit."""
    beyond = [x for x, value in known.items() if sign * (x - here) > 0.0 and value > limit]
    return min(beyond, key=lambda x: abs(x - here)) if beyond else None


def _end(
    task: Problem, best: Fitted, place: int, sign: float, error: float, limit: float, box: FloatArray,
    known: dict[float, float],
) -> float:  # fmt: skip
    """The end of the interval on one side, with all objectives on the way put into `known` (by the logarithm)."""
    from scipy.optimize import brentq

    here = math.log(best.values[place])
    with np.errstate(divide="ignore"):
        wall = float(np.log(box[0 if sign < 0.0 else 1]))
    farthest = min(math.log(FARTHEST), abs(wall - here))
    look = _held(task, best, place, known)
    near, far = 0.0, min(max(1.5 * error, 1e-6), 0.5, farthest)
    while look(here + sign * far) <= limit:
        if far >= farthest:
            return float(box[0 if sign < 0.0 else 1])
        near, far = far, min(_GROWTH * far, farthest)

    def beyond(x: float) -> float:
        # About linear in x, as the objective is about a parabola.
        return math.sqrt(max(look(here + sign * x) - best.objective, 0.0)) - math.sqrt(limit - best.objective)

    end = brentq(beyond, near, far, xtol=_CLOSE * far, rtol=1e-6)
    return math.exp(here + sign * end)


def _held(task: Problem, best: Fitted, place: int, known: dict[float, float]) -> Callable[[float], float]:
    """The least objective with the parameter held, as a function of its logarithm."""
    latest = {"begin": np.delete(best.values, place)}

    def look(x: float) -> float:
        if x not in known:
            held = _Held(task, place, math.exp(x))
            if best.values.size > 1:
                # From where the last value was fitted, which lies on the way.
                found = followed(held, latest["begin"], _ROUGHLY)
                known[x], latest["begin"] = found.objective, found.values
            else:
                residual, _ = held.residuals(np.empty(0))
                known[x] = float(residual @ residual)
        return known[x]

    return look
