"""Least squares in the logarithms of a circuit's parameters: their bounds, and the way from a start."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.numerics.small import AT, derivative
from fingerspice.results.outcome import SolveError

#: What data that cannot be predicted are off by, over their scale.
REFUSED = 1e6
# Error of the least squares' last step, relative; and the largest number of evaluations, and of refused ones.
_CLOSE, _MOST, _MOST_REFUSALS = 1e-8, 40, 6
# Step of the differences in a parameter's logarithm, at which those of fourth order are exact to rounding.
_STEP = 1e-3
#: A parameter is looked for up to this factor from its start, and a profile is followed so far, where no bounds are.
FARTHEST = 1e3
# Singular values of the derivatives below this share of the largest are rounding.
_LEAST = 1e-9


class Unknown(NamedTuple):
    """What is fitted: a parameter in all measurements, or in those of one group."""

    path: str
    label: str | None = None  # Name of the group

    @property
    def name(self) -> str:
        """The path, with the group in brackets."""
        return self.path if self.label is None else f"{self.path}[{self.label}]"


def bounded(
    circuit: Circuit, unknowns: Sequence[Unknown], count: int, given: Mapping[str, tuple[float, float]]
) -> tuple[Circuit, FloatArray]:
    """The circuit to start from, and smallest and largest values, shape (n_parameter, 2): 0 and infinity by default.

    A start outside its bounds moves to the nearer one, with a warning. Fewer data (`count`) than unknowns are refused.
    """
    if count < len(unknowns):
        raise InputError(f"{count} data cannot tell {len(unknowns)} parameters; allowed: at least as many data")
    paths = [one.path for one in unknowns]
    for path in given:
        if path.lower() not in map(str.lower, paths):
            raise InputError(f"bounds names {path}, which is not fitted; allowed: {', '.join(paths)}")
    lower = {path.lower(): tuple(pair) for path, pair in given.items()}
    out = [lower.get(path.lower(), (0.0, math.inf)) for path in paths]
    for path, pair in zip(paths, out, strict=True):
        if len(pair) != 2 or not 0.0 <= pair[0] < pair[1]:
            raise InputError(f"bounds of {path} are {pair}; allowed: two values with 0 <= low < high")
        value = circuit.parameters[path].value
        moved = min(max(value, pair[0]), pair[1])
        if moved != value:
            said = f"{path} is {value:g}, outside its bounds {pair[0]:g} to {pair[1]:g}: it starts at {moved:g}"
            warnings.warn(said, FingerspiceWarning, stacklevel=3)
            circuit = circuit.varied({path: moved})
    return circuit, np.array(out, float)


@dataclass(frozen=True)
class Problem:
    """What is fitted; its classes compare what the circuit predicts with the data."""

    circuit: Circuit  # With the values to start from
    unknowns: tuple[Unknown, ...]
    bounds: FloatArray  # (n_parameter, 2): Smallest and largest values
    scale: FloatArray  # (n,): By which residuals are divided

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(one.name for one in self.unknowns)

    @property
    def initial(self) -> FloatArray:
        """Values to start from."""
        return np.array([self.circuit.parameters[one.path].value for one in self.unknowns])

    def misses(self, values: FloatArray) -> FloatArray:
        """Residuals over their scale, shape (n,)."""
        raise NotImplementedError

    def compared(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals over their scale (n,), and their derivatives by the logarithms of the values (n, n_parameter)."""
        ways = np.exp(_STEP * np.multiply.outer(AT, np.eye(values.size)))
        by = [derivative([self.misses(values * one) for one in way], _STEP) for way in ways.swapaxes(0, 1)]
        return self.misses(values), np.array(by).T

    def residuals(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `compared`; `REFUSED` for all where the circuit with these values cannot be run."""
        try:
            with warnings.catch_warnings():
                # Of values that no user has written.
                warnings.simplefilter("ignore", FingerspiceWarning)
                return self.compared(values)
        except (InputError, SolveError):
            return np.full(self.scale.size, REFUSED), np.zeros((self.scale.size, values.size))

    def profiled(self, wanted: bool | Sequence[str]) -> list[str]:
        """The unknowns whose profiles are wanted, in the circuit's own spelling."""
        if isinstance(wanted, bool):
            return list(self.names) if wanted else []
        known = {name.lower(): name for name in self.names}
        for name in wanted:
            if not isinstance(name, str) or name.lower() not in known:
                allowed = ", ".join(self.names)
                raise InputError(f"profiles names {name!r}, which is not fitted; allowed: True, or {allowed}")
        return [known[name.lower()] for name in wanted]


class Fitted(NamedTuple):
    """Where least squares have led."""

    values: FloatArray  # (n_parameter,)
    residual: FloatArray  # (n,): Over their scale
    by_log: FloatArray  # (n, n_parameter): Their derivatives by the logarithms of the values
    objective: float  # Sum of their squares
    evaluations: int
    closed: bool

    @property
    def found(self) -> bool:
        """Whether the data can be predicted with these values."""
        return self.objective < 0.5 * REFUSED**2

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the logarithms of the parameters, for residuals of variance 1.

        Combinations of parameters that no datum feels have a large variance, and not an infinite one, of which no
        correlation would be known.
        """
        _, singular, right = np.linalg.svd(self.by_log, full_matrices=False)
        spread = 1.0 / np.maximum(singular, _LEAST * max(float(singular.max()), 1e-300))
        return np.asarray((right.T * spread**2) @ right)


def followed(
    residuals: Callable[[FloatArray], tuple[FloatArray, FloatArray]], bounds: FloatArray, begin: FloatArray,
    close: float = _CLOSE,
) -> Fitted:  # fmt: skip
    """Where least squares lead from a start; `close` is the relative error of the last step."""
    from scipy.optimize import least_squares

    refused: list[tuple[FloatArray, FloatArray]] = []

    @lru_cache(maxsize=1)
    def known(x: bytes) -> tuple[FloatArray, FloatArray]:
        # At the edge of what can be run, all further steps are refused without a run, so that the search ends.
        tried = residuals(unit * np.exp(np.frombuffer(x))) if len(refused) < _MOST_REFUSALS else refused[-1]
        if np.all(tried[0] == REFUSED):
            refused.append(tried)
        return tried

    # The first step is at most as long as the place it starts from: by a factor of e, not by that of the unit.
    begin = np.clip(begin, *bounds.T)
    x0 = np.full(begin.size, begin.size**-0.5)
    unit = begin / np.exp(x0)
    with np.errstate(divide="ignore"):
        box = np.log(bounds / unit[:, None]).T
    found = least_squares(
        lambda x: known(x.tobytes())[0], np.clip(x0, *box), lambda x: known(x.tobytes())[1], bounds=box, xtol=close,
        ftol=close**1.5, gtol=1e-12, max_nfev=_MOST,
    )  # fmt: skip
    ended, values = len(refused) < _MOST_REFUSALS, unit * np.exp(found.x)
    residual, by = known(found.x.tobytes()) if ended else residuals(values)
    return Fitted(values, residual, by, float(residual @ residual), int(found.nfev), found.status > 0 and ended)
