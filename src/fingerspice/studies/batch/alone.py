"""One scene of a batch from a run of its own: its outputs, or their derivatives, and their stated error."""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.circuit import Circuit
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import simulate
from fingerspice.studies.batch.slopes import Slopes
from fingerspice.studies.batch.task import SIGNALS_OF_BATCH, Gradients, Task
from fingerspice.studies.steady import SteadyState, steady_state


def run_alone(task: Task, circuit: Circuit, frequency: float, rtol: float) -> tuple[dict[str, FloatArray], float]:
    """What is wanted of a scene from one run, and its stated error; `frequency` (Hz) is that of its periods."""
    wanted, stop, t = task.gradients, task.stop(frequency), None
    paths = () if wanted is None else tuple(dict.fromkeys(p for path in wanted.paths for p in wanted.together[path]))
    ran: Solution | SteadyState
    if task.periodic:
        points = task.points if wanted is None else 4
        ran = steady_state(circuit, rtol=rtol, points=points, charge=False, sensitivities=paths)
        trace = ran.solution if task.traced else None
    else:
        if wanted is not None:
            t = np.array([stop])
        elif task.traced:
            t = np.arange(math.ceil(stop * frequency * task.points - 1e-9)) / (frequency * task.points)
        ran = trace = simulate(circuit, t_stop=stop, t_eval=t, rtol=rtol, charge=False, sensitivities=paths)
    # Largest of the errors of the gap voltage relative to its peak, and of the force relative to its mean.
    pairs = (ran.error.u_gap, ran.u_gap_peak), (ran.error.f_el, ran.f_el_mean)
    sizes = [(off, 0.0 if size is None else float(np.min(size))) for off, size in pairs]
    error = max((off / size for off, size in sizes if size > 0.0), default=0.0)
    if wanted is not None:
        # The error of a change by all of the parameter is about ten times that of the run.
        return {name: _slopes(task, wanted, circuit, ran, name, stop) for name in task.outputs}, Slopes.limit * error
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
    return values, error


def _slopes(
    task: Task, wanted: Gradients, circuit: Circuit, ran: Solution | SteadyState, name: str, stop: float
) -> FloatArray:
    """Derivatives of a mean by the parameters `wanted`."""
    known = circuit.parameters
    # For a change of each parameter by all of itself.
    each = {path: getattr(one, name) * known[path].value for path, one in ran.sensitivities.items()}
    by = [sum(each[other] for other in wanted.together[path]) for path in wanted.paths]
    if wanted.clock is not None and task.periods is not None and isinstance(ran, Solution):
        # The run ends after a number of periods: its end moves with the frequency, and the mean with its end.
        start = circuit.tran.start if circuit.tran is not None else 0.0
        gained = float(getattr(ran, name.removesuffix("_mean"))[-1]) - float(getattr(ran, name))
        by[wanted.paths.index(wanted.clock)] -= gained * stop / (stop - start)
    return np.array([x / known[path].value for x, path in zip(by, wanted.paths, strict=True)])
