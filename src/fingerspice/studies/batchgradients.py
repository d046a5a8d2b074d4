"""Derivatives of a batch's means: the request, scenes in lockstep, and all others by those of single runs.

In lockstep they are central differences of runs with the very same steps, which do not depend on a parameter: a
difference has the error of the method and hardly any noise. The tangents of the same steps would have this error, too:
it comes from the kink of 1/A where the gap voltage is 0, which has order 1 in a derivative.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.topology import driving_sources
from fingerspice.engine.lockscenes import CELL_ROWS, LOAD, STRESS
from fingerspice.numerics.small import STEP
from fingerspice.results.sensitivity import MEANS
from fingerspice.results.signals import SIGNALS
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import simulate
from fingerspice.studies.batchladder import (
    COVERED,
    ENOUGH,
    FIGURES,
    MOST_PIECES,
    MOST_STEPS,
    Level,
    Run,
    first_level,
    friction_of,
    in_lockstep,
    mesh_of,
)
from fingerspice.studies.batchscenes import LockstepForm, curves_of, lockstep_form, table_of
from fingerspice.studies.batchtask import (
    LOCKSTEP,
    ONE_BY_ONE,
    REFUSED,
    STATUS_NAMES,
    Answers,
    Single,
    Task,
    each_alone,
    error_of,
    jobs_of,
)
from fingerspice.studies.steady import SteadyState, steady_state

#: Error allowed to a derivative, for a change of the parameter by all of itself, in errors allowed to the output.
LIMIT = 10.0
#: Smallest rtol at which derivatives are taken in lockstep: below it their kinks would take too many steps.
LEAST_RTOL = 5e-7
# Degree by which the area's polynomial grows from level to level, and the highest one: its coefficients lose a digit in
# two to the rounding with every power. A run of degree d has this rounding error, relative, besides 2^d times 1e-16.
_MORE, _HIGHEST, _ROUNDING, _EPS = 4, 20, 1e-13, 1.1e-16
# The stated error has this many changes from half the steps to all steps, under tones and under squares. Under tones a
# kink's error is about as large as the change, or larger where that is small by chance.
_STATED, _STATED_JUMPING = 3.0, 2.0
# Kinks have order 1, with a factor that depends on where between two steps they fall, so that a change may be small by
# chance: doubling the steps may not reduce the stated error by more than this factor.
_MOST_GAIN = 8.0


@dataclass(frozen=True)
class Gradients:
    """The checked request."""

    paths: tuple[str, ...]  # The parameters, in the circuit's own spelling
    outputs: tuple[str, ...]  # Outputs that have derivatives
    # Each parameter with those that grow in proportion to it: the frequency of a source with that of a skin
    together: Mapping[str, tuple[str, ...]]
    # The parameter with which the length of a run changes: the frequency, where the length is given in periods
    longer: str | None
    clock: str | None  # The frequency of the only source, if it is one of the parameters

    def values(self, circuit: Circuit, scenes: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Values of the parameters in all scenes, shape (n,) each."""
        n = next(iter(scenes.values())).size
        return {
            path: scenes[path] if path in scenes else np.full(n, circuit.parameters[path].value) for path in self.paths
        }


@dataclass
class Slopes:
    """Derivatives of the outputs of some scenes."""

    # (n, n_parameter): Derivatives of every output, per unit of the parameter; NaN for a scene without a result
    values: dict[str, FloatArray]
    # (n,): Stated error for a change of a parameter by all of itself, relative to the output; the largest of all
    error: FloatArray
    status: NDArray[np.int8]  # (n,): As in `Answers`
    done: BoolArray  # (n,)
    messages: dict[int, str]

    @classmethod
    def empty(cls, wanted: Gradients, n: int) -> Slopes:
        """Slopes of n scenes, none of them done."""
        values = {name: np.full((n, len(wanted.paths)), np.nan) for name in wanted.outputs}
        return cls(values, np.full(n, np.nan), np.full(n, ONE_BY_ONE, np.int8), np.zeros(n, bool), {})


class _Changes(NamedTuple):
    """Outputs and their changes for a change of each parameter by all of itself, shape (n_output, n_parameter, n)."""

    size: FloatArray
    change: FloatArray

    @property
    def relative(self) -> FloatArray:
        return self.change / np.where(self.size > 0.0, self.size, 1.0)


def climb_gradients(
    task: Task, wanted: Gradients, form: LockstepForm, scenes: Mapping[str, FloatArray], halves: int
) -> Slopes:
    """Differentiate scenes in lockstep, doubling the steps; those whose error stays too large are left as not done.

    Parameters
    ----------
    task : Task
    wanted : Gradients
    form : LockstepForm
    scenes : mapping of str to ndarray, shape (n,)
        Values by path in lower case, the wanted parameters among them.
    halves : int
        Length of the runs in half periods.
    """
    mesh = mesh_of(task, form, table_of(form, scenes), most=MOST_PIECES)
    touching, pieces = mesh.touching, mesh.pieces
    found = Slopes.empty(wanted, touching.size)
    for path in wanted.paths:
        value = scenes[path.lower()]
        touching = touching & np.isfinite(value) & (value != 0.0)
    for count in np.unique(pieces[touching]).tolist():
        chosen = np.flatnonzero(touching & (pieces == count))
        for covered in COVERED:
            some = {path: array[chosen] for path, array in scenes.items()}
            which = chosen, mesh.least[chosen]
            chosen = _climb_one(task, wanted, form, some, (halves, count), covered, which, found)
    return found


def _climb_one(
    task: Task, wanted: Gradients, form: LockstepForm, scenes: Mapping[str, FloatArray], mesh: tuple[int, int],
    covered: float, which: tuple[NDArray[np.int64], FloatArray], found: Slopes,
) -> NDArray[np.int64]:  # fmt: skip
    """Differentiate `scenes`, at `which` places of `found`; the rest is as in `batchladder`."""
    steps, degree = first_level(task.rtol, form, mesh[1])
    (place, needed), pairs = which, 2 * len(wanted.paths)
    # What ends the search for a periodic state moves a difference by 1 / STEP of itself.
    closer = replace(task, rtol=task.rtol * STEP)
    before: Run | None = None
    pending, least, outside = np.arange(place.size), np.zeros(place.size), [place[:0]]
    while pending.size and steps <= MOST_STEPS * max(form.multiples):
        curves = curves_of(form.layer.values["m_exp"], form.layer.values["n_exp"], degree)
        if curves is None:
            break
        some = {path: array[pending] for path, array in scenes.items()}
        moved = _moved(wanted, some)
        table = table_of(form, moved)
        level = Level(closer, form, mesh, steps, degree, covered, 1, False)
        run = level.run(table, np.arange(table.shape[1]), curves, before)
        rows = table[CELL_ROWS * form.cells :]
        own, coarse = (_changes(wanted, one[0], rows, friction_of(form, moved)) for one in (run.fine, run.coarse))
        share = _STATED_JUMPING if form.jumping else _STATED
        error = np.maximum(_error(own, coarse, run, degree, share), least)
        good = (error <= ENOUGH * LIMIT * task.rtol) & (needed[pending] <= steps)
        at = place[pending[good]]
        for k, path in enumerate(wanted.paths):
            for j, name in enumerate(wanted.outputs):
                found.values[name][at, k] = own.change[j, k, good] / some[path.lower()][good]
        found.error[at], found.status[at], found.done[at] = error[good], LOCKSTEP, True
        beyond = np.isinf(run.fine[-1]).reshape(pairs, -1).any(axis=0)
        outside.append(place[pending[beyond]])
        left = ~good & ~beyond
        runs = np.tile(left, pairs)
        before = Run(run.fine[:, runs], run.fine[:, runs], run.trace[runs], run.trace[runs])
        least = np.where(np.isfinite(error[left]), error[left], 0.0) / _MOST_GAIN
        pending, steps, degree = pending[left], 2 * steps, max(degree, min(degree + _MORE, _HIGHEST))
    return np.concatenate(outside)


def _moved(wanted: Gradients, scenes: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Every scene with each parameter smaller by a step, then with each larger, shape (2 n_parameter n,)."""
    out = {path: np.tile(array, (2, len(wanted.paths), 1)) for path, array in scenes.items()}
    for k, path in enumerate(wanted.paths):
        for other in wanted.together[path]:
            for side, sign in enumerate((-1.0, 1.0)):
                out[other.lower()][side, k] *= 1.0 + sign * STEP
    return {path: array.ravel() for path, array in out.items()}


def _changes(wanted: Gradients, mean: FloatArray, rows: FloatArray, mu: FloatArray) -> _Changes:
    """Changes of the outputs, from the means of u^2 A in the moved scenes; `rows` are the table's after its cells."""
    values = np.array([FIGURES[name][1](mean[None], rows[LOAD], rows[STRESS], mu) for name in wanted.outputs])
    low, high = np.moveaxis(values.reshape(len(wanted.outputs), 2, len(wanted.paths), -1), 1, 0)
    return _Changes(np.abs(0.5 * (low + high)), (high - low) / (2.0 * STEP))


def _error(own: _Changes, coarse: _Changes, run: Run, degree: int, share: float) -> FloatArray:
    """Stated error of every scene: of the steps (`share` of their change), the difference, polynomial and period."""
    largest = np.abs(own.relative).max(axis=(0, 1))
    change = np.abs(own.relative - coarse.relative).max(axis=(0, 1))
    # The third derivative of a power that has this slope, at most.
    cut = STEP**2 / 6.0 * largest * (largest + 1.0) * (largest + 2.0)
    pairs = run.fine.shape[1] // change.size
    closing, tail = run.fine[-2:].reshape(2, pairs, -1).max(axis=1)
    # The polynomial's error is one of Chebyshev's, whose slope is larger by its degree.
    tail = degree * (tail + run.coarse[-1].reshape(pairs, -1).max(axis=0))
    return np.asarray(share * change + cut + tail + (2.0 * closing + _ROUNDING + 2.0**degree * _EPS) / STEP)


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
        unit, text = SIGNALS[name.removesuffix("_mean")][:2]
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
