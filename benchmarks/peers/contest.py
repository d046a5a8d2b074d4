"""What a contestant is, and what it is given."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from network_problems import NetworkProblem
from problems import Piece, Problem

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """A run to be made: a problem, how long, and where it is split.

    Attributes
    ----------
    problem : Problem
    periods : int
    zeros, signs : tuple of float
        Times of the gap voltage's zeros (s) and its sign on each piece, for contestants that restart there.
    """

    problem: Problem
    periods: int
    zeros: tuple[float, ...] = ()
    signs: tuple[float, ...] = ()

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """Smooth stretches in order."""
        return self.problem.pieces(self.periods, self.zeros, self.signs)

    @cached_property
    def t_eval(self) -> FloatArray:
        """Output times, s."""
        return self.problem.t_eval(self.periods)

    @cached_property
    def u_source(self) -> FloatArray:
        """Source at the outputs, V."""
        return self.problem.waveform.value(self.t_eval)

    @property
    def t_stop(self) -> float:
        """End, s."""
        return self.problem.t_stop(self.periods)


@dataclass(frozen=True)
class Outcome:
    """What a run gave.

    Attributes
    ----------
    u_gap, f_el : ndarray
        V and N, at the outputs.
    nfev : int or None
        Evaluations of the right-hand side; None where the library does not count them.
    seconds : float or None
        Wall time, where the contestant measures it itself.
    """

    u_gap: FloatArray
    f_el: FloatArray
    nfev: int | None
    seconds: float | None = None


class NotSolvedError(RuntimeError):
    """The library says that it failed, or did."""


@dataclass(frozen=True)
class Contestant:
    """A method of a library.

    Attributes
    ----------
    name, library : str
    settings : tuple of float
        From loose to tight.
    what : str
        What a setting is: ``"rtol"``, or steps per period.
    setup : callable
        Takes a plan; returns the function of a setting that is timed.
    kinks : bool
        Whether the plan is split at the zeros of the gap voltage.
    whole : bool
        Whether it can be told the zeros only where the source has no jumps.
    mobile, networks, stacks : bool
        Whether it takes part under the `mobile` law, on networks, and on stacks.
    slow : bool
        Whether it is given a fifth of the periods where that costs the same per period.
    compile_limit : float
        What its first run may take longer than others because it compiles, s.
    """

    name: str
    library: str
    settings: tuple[float, ...]
    setup: Callable[[Plan], Callable[[float], Outcome]]
    what: str = "rtol"
    kinks: bool = False
    whole: bool = False
    mobile: bool = False
    networks: bool = False
    stacks: bool = True
    slow: bool = False
    compile_limit: float = 0.0

    def takes_part(self, problem: Problem) -> bool:
        """Whether it is timed on a problem, and there in another way than without the zeros."""
        if self.kinks and self.whole and len(problem.pieces(1)) > 1:
            return False
        kind = self.networks if isinstance(problem, NetworkProblem) else self.stacks
        return kind and (self.mobile or problem.law == "local")

    @property
    def adaptive(self) -> bool:
        """Whether a setting is a tolerance."""
        return self.what == "rtol"


def tolerances(loose: float, tight: float, per_decade: float = 1.0) -> tuple[float, ...]:
    """Tolerances 10^-loose to 10^-tight, evenly spread."""
    count = round((tight - loose) * per_decade)
    return tuple(float(10.0 ** -(loose + i / per_decade)) for i in range(count + 1))


def installed(package: str) -> str | None:
    """Version of an installed package, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
