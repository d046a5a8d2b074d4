"""The data of a contestant, of the run that it is given, and of its outcome."""

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
    """A run to be made: a problem, its number of periods, and the times at which it is split.

    Attributes
    ----------
    problem : Problem
    periods : int
    zeros, signs : tuple of float
        Times of the gap voltage's zeros (s) and its sign on each piece, for contestants that restart at the zeros.
    """

    problem: Problem
    periods: int
    zeros: tuple[float, ...] = ()
    signs: tuple[float, ...] = ()

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """Smooth stretches of the run, in order."""
        return self.problem.pieces(self.periods, self.zeros, self.signs)

    @cached_property
    def t_eval(self) -> FloatArray:
        """Output times, s."""
        return self.problem.t_eval(self.periods)

    @cached_property
    def u_source(self) -> FloatArray:
        """Source voltage at the outputs, V."""
        return self.problem.waveform.value(self.t_eval)

    @property
    def t_stop(self) -> float:
        """End of the run, s."""
        return self.problem.t_stop(self.periods)


@dataclass(frozen=True)
class Outcome:
    """The results of a run.

    Attributes
    ----------
    u_gap, f_el : ndarray
        Gap voltage (V) and force (N) at the outputs.
    nfev : int or None
        Number of evaluations of the right-hand side; None if the library does not count them.
    seconds : float or None
        Wall time, if the contestant measures it itself.
    """

    u_gap: FloatArray
    f_el: FloatArray
    nfev: int | None
    seconds: float | None = None


class NotSolvedError(RuntimeError):
    """The library reported a failure, or failed without a report."""


@dataclass(frozen=True)
class Contestant:
    """A method of a library.

    Attributes
    ----------
    name, library : str
    settings : tuple of float
        Settings from loose to tight.
    what : str
        Meaning of a setting: ``"rtol"``, or ``"steps per period"``.
    setup : callable
        Function from a plan to the timed function of a setting.
    kinks : bool
        Whether the plan is split at the zeros of the gap voltage.
    whole : bool
        Whether the zeros can only be given for a source without jumps.
    mobile, networks, stacks : bool
        Whether it takes part under the `mobile` law, on networks, and on stacks.
    slow : bool
        Whether it only runs a fifth of the periods, if a shorter run costs the same per period.
    compile_limit : float
        Additional time limit of the first run, which compiles, s.
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
        """Whether it is timed on a problem; a contestant that cannot use the zeros there is left out."""
        if self.kinks and self.whole and len(problem.pieces(1)) > 1:
            return False
        kind = self.networks if isinstance(problem, NetworkProblem) else self.stacks
        return kind and (self.mobile or problem.law == "local")

    @property
    def adaptive(self) -> bool:
        """Whether its settings are tolerances."""
        return self.what == "rtol"


def tolerances(loose: float, tight: float, per_decade: float = 1.0) -> tuple[float, ...]:
    """Tolerances from 10^-loose to 10^-tight, evenly spaced in the exponent."""
    count = round((tight - loose) * per_decade)
    return tuple(float(10.0 ** -(loose + i / per_decade)) for i in range(count + 1))


def installed(package: str) -> str | None:
    """Version of an installed package, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
