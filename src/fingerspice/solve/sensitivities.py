"""Sensitivities of a run by parameters: fourth-order differences of runs with a much smaller error than its own.

At an `rtol` of 1e-10 the gap voltages of networks are differentiated to 1e-9 of their peaks, for a change of a
parameter by all of itself, and all signals to 2e-9 (tests/test_sensitivity.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.network import network_of
from fingerspice.numerics.modes import AT, derivative
from fingerspice.results.outcome import SolveError, Status
from fingerspice.results.sensitivity import MEANS, SIGNALS, Sensitivity
from fingerspice.results.solution import Solution
from fingerspice.solve.problem import Problem
from fingerspice.solve.recordings.block import driving
from fingerspice.waveforms.combinations import Sum

# Error asked of the runs that are compared, over the run's own, and the least one.
_SHARE, _FINEST = 1e-3, 3e-13
# What may be left of that error where rounding is in the way, over the run's own.
_KNOWN = 1e-2
# Step relative to a parameter, at which what the runs' errors and the difference's truncation do are about the same;
# and shares of it for outputs at which the gap voltage changes its sign in a step.
_STEP, _CLOSER = 5e-4, (0.03, 1e-3)


# The same run of another circuit, with another `rtol`.
Runner = Callable[[Circuit, float], Solution]


class _Parameter:
    """A parameter by which a run is differentiated; refused if it is unknown, or not covered."""

    def __init__(self, problem: Problem, path: str) -> None:
        self.circuit, known = problem.circuit, {name.lower(): name for name in problem.circuit.parameters}
        if path.lower() not in known:
            # Refused with the nearest name.
            self.circuit.varied({path: 1.0})
        self.path = known[path.lower()]
        parameter = self.circuit.parameters[self.path]
        self.value, self.unit, self.step = parameter.value, parameter.unit, _STEP
        if not (math.isfinite(self.value) and self.value != 0.0):
            raise InputError(
                f"sensitivities names {self.path}, which is {self.value:g}; allowed: parameters whose value is finite "
                "and not 0, as steps are relative to it"
            )
        element, span = self.path.rpartition(".")[0], (problem.t_start, problem.t_stop)
        own = self.circuit[element].waveform
        if own is not None:
            # A phase is a frequency times all the time since the start.
            self.step /= max(1.0, 2.0 * math.pi * problem.t_stop / own.shortest_time())
            for wave in (circuit[element].waveform for circuit in self.circuits()):
                if wave is None or not np.array_equal(wave.breakpoints(*span), own.breakpoints(*span)):
                    raise InputError(
                        f"sensitivities names {self.path}, which moves the edges of its source; allowed: parameters "
                        "that leave them where they are, such as an amplitude, or the frequency of a sine"
                    )

    def circuits(self, share: float = 1.0) -> list[Circuit]:
        """Circuits around its value, with a `share` of the step."""
        return [self.circuit.varied({self.path: self.value * (1.0 + share * self.step * at)}) for at in AT]

    def by(self, values: Sequence[FloatArray | float], share: float = 1.0) -> FloatArray:
        """Derivative of what has these values for the circuits."""
        return derivative(values, share * self.step * self.value)

    @property
    def longer(self) -> float:
        """Relative change of the sources' common period, per unit of the parameter; NaN where there is none near it."""
        own, *periods = (period_of(circuit) or math.nan for circuit in (self.circuit, *self.circuits()))
        if not max(abs(period / own - 1.0) for period in periods) <= 0.01:
            return math.nan
        return float(self.by(periods)) / own if set(periods) != {own} else 0.0


def period_of(circuit: Circuit) -> float | None:
    """Common period of a circuit's sources, s."""
    waves = network_of(circuit).waveforms
    return (waves[0] if len(waves) == 1 else Sum(waves)).period


def check_request(problem: Problem, paths: Sequence[str], method: str, start: str) -> str:
    """Refuse a run that has no sensitivities; the method of the runs that are compared."""
    if isinstance(paths, str) or not all(isinstance(path, str) for path in paths):
        raise InputError(f"sensitivities is {paths!r}; allowed: a sequence of paths such as ('Xgap.d',)")
    what = ""
    if not problem.network.fingers:
        what = "the circuit has no GAP"
    elif start == "given":
        what = "the run goes on from another one"
    elif method not in ("auto", "exponential"):
        what = f"the method is {method!r}"
    if what:
        raise InputError(
            f"sensitivities are asked for, and {what}; allowed: a circuit with a GAP, one of the other starts, and the "
            "methods 'auto' and 'exponential'"
        )
    # A recording, or a PWL with many points, is otherwise followed point by point, to no error as small as needed here.
    return method if driving(problem) is None else "exponential"


def _gaps(run: Solution) -> FloatArray:
    """Gap voltages, V, shape (n_t, n_gap)."""
    assert run.u_gap is not None
    return run.u_gap.reshape(run.t.size, -1)


def _around(one: _Parameter, share: float, run: Runner, solution: Solution) -> list[Solution]:
    """The runs that are compared, at a `share` of the step; their errors are small enough, and outputs at one time."""
    rtol = max(_SHARE * solution.rtol, _FINEST)
    runs = [run(circuit, rtol) for circuit in one.circuits(share)]
    for other in runs:
        largest = float(np.abs(_gaps(other)).max())
        known = other.status is Status.ERROR_NOT_MET and other.error.u_gap <= _KNOWN * solution.rtol * largest
        if other.failure is not None and not known:
            raise SolveError(other.failure, solution)
        if not np.array_equal(other.t, solution.t):
            raise InputError(
                f"sensitivities names {one.path}, which moves the times at which the run has outputs; allowed: other "
                "parameters, or given t_eval"
            )
    return runs


def _differentiated(one: _Parameter, run: Runner, solution: Solution) -> dict[str, Any]:
    """Derivatives of signals and means by a parameter."""
    runs = _around(one, 1.0, run, solution)
    by = {name: one.by([getattr(other, name) for other in runs]) for name in (*SIGNALS, *MEANS)}
    for share in _CLOSER:
        # The area has a kink where the gap voltage is 0.
        signs = np.sign([_gaps(other) for other in runs])
        turned = np.any(signs != signs[0], axis=(0, 2))
        if not turned.any():
            break
        runs = _around(one, share, run, solution)
        for name in SIGNALS:
            by[name][turned] = one.by([getattr(other, name)[turned] for other in runs], share)
    return by


def sensitivities_of(
    problem: Problem, solution: Solution, paths: Sequence[str], run: Runner, over_period: bool = False
) -> dict[str, Sensitivity]:
    """Derivatives of a run's signals and means; `over_period`: of means over a period, which a parameter may change.

    A run with a parameter near its value that fails is a `SolveError`.
    """
    found = {}
    for one in [_Parameter(problem, path) for path in paths]:
        longer = one.longer if problem.begun is not None else 0.0
        if math.isnan(longer):
            raise InputError(
                f"sensitivities of a periodic state name {one.path}, near whose value the source has no such period; "
                "allowed: other parameters, or a run from another start"
            )
        by = _differentiated(one, run, solution)
        for name in MEANS if over_period else ():
            # The mean over a period that grows takes up what the signal is at its end.
            at_end = getattr(solution, name.removesuffix("_mean"))[-1]
            by[name] = by[name] + longer * (at_end - getattr(solution, name))
        found[one.path] = Sensitivity(one.path, one.unit, one.value, **by)
    return found
