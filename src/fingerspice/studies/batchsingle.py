"""One scene of a batch, run by itself through `simulate` or `steady_state`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.results.outcome import ErrorEstimate, SolveError
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import RTOL_RANGE, simulate
from fingerspice.studies.batchtask import FAILED, ONE_BY_ONE, REFUSED, Task
from fingerspice.studies.steady import SteadyState, steady_state

# A run's rtol is relative to peaks, and a batch's to the output itself: the first attempt assumes that an output is at
# least this fraction of its peak.
OVER_PEAK = 0.1


class Single(NamedTuple):
    """The outputs of one scene, its stated error, its status, and the message if it has no outputs."""

    values: Mapping[str, FloatArray]
    error: float
    status: int
    message: str


def run_single(task: Task, changes: Mapping[str, float], frequency: float) -> Single:
    """Run one scene, whose periods are those of `frequency` (Hz); a refusal or failure is returned, not raised."""
    try:
        circuit, rtol = task.circuit.varied(changes), max(OVER_PEAK * task.rtol, RTOL_RANGE[0])
        found = _run(task, circuit, frequency, rtol)
        if found.error > task.rtol and rtol > RTOL_RANGE[0]:
            # The mean is smaller than assumed, relative to the peak: repeat with the rtol that the error asks for.
            found = _run(task, circuit, frequency, max(0.5 * rtol * task.rtol / found.error, RTOL_RANGE[0]))
        return found
    except InputError as error:
        return Single({}, math.nan, REFUSED, str(error))
    except SolveError as error:
        return Single({}, math.nan, FAILED, str(error))


def _run(task: Task, circuit: Circuit, frequency: float, rtol: float) -> Single:
    ran: Solution | SteadyState
    if task.periodic:
        ran = steady_state(circuit, rtol=rtol, points=task.points, charge=False)
        trace = ran.solution if task.traced else None
    else:
        stop = task.t_stop if task.t_stop is not None else (task.periods or 1.0) / frequency
        t = None
        if task.traced:
            t = np.arange(math.ceil(stop * frequency * task.points - 1e-9)) / (frequency * task.points)
        ran = trace = simulate(circuit, t_stop=stop, t_eval=t, rtol=rtol, charge=False)
    values = {}
    for name in task.outputs:
        if name == "u_gap":
            assert trace is not None
            u = np.asarray(trace.u_gap)
            values[name] = u[:-1] if task.periodic else u
            continue
        signal = next(s for s in SIGNALS_OF_BATCH if name.startswith(f"{s}_"))
        value = ran._figures.value(signal, name[len(signal) + 1 :])
        values[name] = np.asarray(math.nan if value is None else value, float)
    return Single(values, error_of(ran), ONE_BY_ONE, "")


#: Signals whose figures a batch has.
SIGNALS_OF_BATCH = ("f_el", "f_t", "friction", "u_gap", "area")


def error_of(ran: Solution | SteadyState) -> float:
    """Stated error of the gap voltage relative to its peak, or of the force relative to its mean, if that is larger."""
    error: ErrorEstimate = ran.error
    pairs = (error.u_gap, ran.u_gap_peak), (error.f_el, ran.f_el_mean)
    sizes = [float(np.min(size)) if size is not None else 0.0 for _, size in pairs]
    return max((off / size for (off, _), size in zip(pairs, sizes, strict=True) if size > 0.0), default=0.0)
