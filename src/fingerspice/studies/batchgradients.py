"""Derivatives of a batch's means: the request, scenes in lockstep, and all others by those of single runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.topology import driving_sources
from fingerspice.results.sensitivity import MEANS
from fingerspice.results.signals import SIGNALS
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import simulate
from fingerspice.studies.batchdifferences import LEAST_RTOL, LIMIT, Gradients, Slopes, climb_gradients
from fingerspice.studies.batchladder import FIGURES, in_lockstep
from fingerspice.studies.batchscenes import lockstep_form
from fingerspice.studies.batchsingle import Single, each_alone, error_of
from fingerspice.studies.batchtask import ONE_BY_ONE, REFUSED, STATUS_NAMES, Answers, Task, jobs_of
from fingerspice.studies.steady import SteadyState, steady_state

# A relative change of a parameter by which it is seen whether the source's tone depends on it.
_SEEN = 1e-3


def gradient_request(
    task: Task, paths: Sequence[str], scenes: Mapping[str, FloatArray], skin: str
) -> Gradients:  # fmt: skip
    """The checked request of derivatives by parameters, `paths` in the circuit's own spelling.

    Raises
    ------
    InputError
        If the circuit, an output or a parameter has no derivatives.
    """
    circuit = task.circuit
    outputs = tuple(name for name in task.outputs if name in MEANS)
    if not outputs:
        raise InputError(f"gradients are asked for, and outputs has no mean; allowed: one of {', '.join(MEANS)}")
    if len(circuit.by_device("GAP")) != 1:
        number = len(circuit.by_device("GAP"))
        raise InputError(f"gradients are asked for, and the circuit has {number} GAPs; allowed: one")
    if len(set(paths)) < len(paths):
        raise InputError(f"gradients is {tuple(paths)!r}; allowed: every parameter once")
    for path in paths:
        value = circuit.parameters[path].value
        if path not in scenes and not (math.isfinite(value) and value != 0.0):
            raise InputError(
                f"gradients names {path}, which is {value:g}; allowed: parameters whose value is finite and not 0, as "
                "steps are relative to it"
            )
    on = driving_sources(circuit)
    clock = f"{on[0].name}.frequency" if len(on) == 1 else None
    clock = clock if clock in paths else None
    skins = tuple(f"{e.name}.f" for e in circuit.by_device("SKIN")) if skin == "follow" else ()
    for path in paths:
        if path in skins or (skins and path != clock and _turns(circuit, path)):
            raise InputError(f"skin='follow', and gradients names {path}, with which the skin's frequency changes; "
                             "allowed: the frequency of the only source, or skin='own'")  # fmt: skip
    together = {path: (path, *(skins if path == clock else ())) for path in paths}
    longer = clock if task.periods is not None and not task.periodic else None
    return Gradients(tuple(paths), outputs, together, longer, clock)


def in_lockstep_by(circuit: Circuit, paths: Iterable[str], outputs: Sequence[str], rtol: float) -> bool:
    """Whether derivatives of outputs by parameters, with the values of all `paths` varying, can be those of lockstep.

    If not, a batch takes the derivatives of single runs, besides a run for every scene's outputs.
    """
    form = lockstep_form(circuit, {path.lower(): None for path in paths})
    if isinstance(form, str) or form.recording is not None:
        return False
    return rtol >= LEAST_RTOL and all(name in FIGURES for name in outputs)


def _turns(circuit: Circuit, path: str) -> bool:
    """Whether a parameter changes the frequency of a source."""
    name = path.rpartition(".")[0]
    moved = circuit.varied({path: circuit.parameters[path].value * (1.0 + _SEEN)})
    own, other = circuit[name].waveform, moved[name].waveform
    return own is not None and other is not None and own.tone() != other.tone()


def gradients_of(
    task: Task, wanted: Gradients, scenes: Mapping[str, FloatArray], frequency: FloatArray, found: Answers,
    pool: ThreadPoolExecutor,
) -> tuple[Slopes, str]:  # fmt: skip
    """Derivatives in all scenes that have outputs, and why some were not in lockstep ('' where all were).

    Parameters
    ----------
    task : Task
    wanted : Gradients
    scenes : mapping of str to ndarray, shape (n,)
        Values by path.
    frequency : ndarray, shape (n,)
        Of the source, Hz, where the length of the runs depends on it.
    found : Answers
        The outputs.
    pool : ThreadPoolExecutor
    """
    every = {**scenes, **wanted.values(task.circuit, scenes)}
    slopes, reason = _lockstep(task, wanted, every, frequency, found, pool)
    failed = found.status >= REFUSED
    slopes.status[failed], slopes.done[failed] = found.status[failed], True
    rest = np.flatnonzero(~slopes.done)
    run = partial(_differentiated, task, wanted)
    for i, single in each_alone(task, every, frequency, rest, pool, run, LIMIT * task.rtol):
        for name, value in single.values.items():
            slopes.values[name][i] = value
        slopes.error[i], slopes.status[i] = single.error, single.status
        if single.message:
            slopes.messages[i] = f"gradients: {single.message}"
    return slopes, reason if rest.size else ""


def _lockstep(
    task: Task, wanted: Gradients, scenes: Mapping[str, FloatArray], frequency: FloatArray, found: Answers,
    pool: ThreadPoolExecutor,
) -> tuple[Slopes, str]:  # fmt: skip
    """The derivatives that lockstep gives, and the reason why other scenes have none from it."""
    slopes = Slopes.empty(wanted, found.error.size)
    lower = {path.lower(): array for path, array in scenes.items()}
    form = lockstep_form(task.circuit, lower)
    others = [name for name in wanted.outputs if not in_lockstep(name)]
    if isinstance(form, str):
        return slopes, form
    if form.recording is not None:
        return slopes, "the source is a recording"
    if others:
        return slopes, f"{', '.join(others)} needs a run of its own"
    if task.rtol < LEAST_RTOL:
        return slopes, f"rtol is below {LEAST_RTOL:g}"
    if wanted.clock is not None and task.t_stop is not None:
        return slopes, f"{wanted.clock} changes the number of periods in t_stop"
    jobs = jobs_of(task, task.count(frequency), found.status < REFUSED)

    def one(job: tuple[int, NDArray[np.int64]]) -> Slopes:
        return climb_gradients(task, wanted, form, {path: array[job[1]] for path, array in lower.items()}, job[0])

    for (_, members), answer in zip(jobs, pool.map(one, jobs), strict=True):
        at, good = members[answer.done], answer.done
        for name, values in answer.values.items():
            slopes.values[name][at] = values[good]
        slopes.error[at], slopes.status[at], slopes.done[at] = answer.error[good], answer.status[good], True
    return slopes, "what does not end after half periods, or does not meet its error in lockstep"


def _differentiated(task: Task, wanted: Gradients, circuit: Circuit, frequency: float, rtol: float) -> Single:
    paths = tuple(dict.fromkeys(other for path in wanted.paths for other in wanted.together[path]))
    ran: Solution | SteadyState
    stop = task.t_stop if task.t_stop is not None else (task.periods or 1.0) / frequency
    if task.periodic:
        ran = steady_state(circuit, rtol=rtol, points=4, charge=False, sensitivities=paths)
    else:
        ran = simulate(circuit, t_stop=stop, t_eval=[stop], rtol=rtol, charge=False, sensitivities=paths)
    values = {}
    for name in wanted.outputs:
        # For a change of each parameter by all of itself.
        each = {p: getattr(ran.sensitivities[p], name) * circuit.parameters[p].value for p in paths}
        by = [sum(each[other] for other in wanted.together[path]) for path in wanted.paths]
        if wanted.longer is not None and isinstance(ran, Solution):
            # The run ends after a number of periods: its end moves with the frequency, and the mean with its end.
            start = circuit.tran.start if circuit.tran is not None else 0.0
            gained = float(getattr(ran, name.removesuffix("_mean"))[-1]) - float(getattr(ran, name))
            by[wanted.paths.index(wanted.longer)] -= gained * stop / (stop - start)
        values[name] = np.array([x / circuit.parameters[p].value for x, p in zip(by, wanted.paths, strict=True)])
    # Their error, as that of a change by all of the parameter, is about ten times that of the run.
    return Single(values, LIMIT * error_of(ran), ONE_BY_ONE, "")


def gradient_data(slopes: Slopes) -> dict[str, Any]:
    """Variables of a Dataset."""
    data: dict[str, Any] = {}
    for name, values in slopes.values.items():
        unit, text = SIGNALS[name.removesuffix("_mean")]
        attrs = {"units": f"{unit} per parameter_unit", "long_name": f"derivative of {text}_mean by each parameter"}
        data[f"d_{name}"] = (("scene", "parameter"), values, attrs)
    told = "stated error of a derivative times its parameter, relative to the output"
    data["gradient_error"] = ("scene", slopes.error, {"units": "1", "long_name": told})
    meanings = {"flag_values": list(range(len(STATUS_NAMES))), "flag_meanings": " ".join(STATUS_NAMES)}
    data["gradient_status"] = ("scene", slopes.status, meanings)
    return data


def gradient_coordinates(task: Task, wanted: Gradients) -> dict[str, Any]:
    """The parameters with their units, as coordinates of a Dataset."""
    units = [task.circuit.parameters[path].unit for path in wanted.paths]
    return {"parameter": list(wanted.paths), "parameter_unit": ("parameter", units)}
