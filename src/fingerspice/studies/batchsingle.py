"""One scene of a batch, run by itself through `simulate` or `steady_state`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
    """The outputs of one scene or their derivatives, the stated error, status, and the message if there are none."""

    values: Mapping[str, FloatArray]
    error: float
    status: int
    message: str


def each_alone(
    task: Task, scenes: Mapping[str, FloatArray], frequency: FloatArray, which: NDArray[np.int64],
    pool: ThreadPoolExecutor, run: Callable[[Circuit, float, float], Single], allowed: float,
) -> Iterator[tuple[int, Single]]:  # fmt: skip
    """What `run` finds of the scenes `which`, with an rtol that leads to an error that is `allowed`.

    It takes the circuit, the frequency of its periods (Hz) and an rtol. A refusal or failure is an answer, not raised.
    """

    def one(i: int) -> Single:
        try:
            circuit = task.circuit.varied({path: float(array[i]) for path, array in scenes.items()})
            rtol = max(OVER_PEAK * task.rtol, RTOL_RANGE[0])
            found = run(circuit, float(frequency[i]), rtol)
            if found.error > allowed and rtol > RTOL_RANGE[0]:
                # The mean is smaller than assumed, relative to the peak: repeat with the rtol that the error asks for.
                closer = max(0.5 * rtol * allowed / found.error, RTOL_RANGE[0])
                found = run(circuit, float(frequency[i]), closer)
            return found
        except InputError as error:
            return Single({}, math.nan, REFUSED, str(error))
        except SolveError as error:
            return Single({}, math.nan, FAILED, str(error))

    # Warnings about unusual values are not repeated for every scene. Filters apply to all threads, so set them here.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = list(pool.map(one, which.tolist()))
    yield from zip(which.tolist(), found, strict=True)


def run_single(task: Task, circuit: Circuit, frequency: float, rtol: float) -> Single:
    """The outputs of one scene."""
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
