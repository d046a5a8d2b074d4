"""Many scenes of one circuit: scenes of a suitable form in lockstep, all others one by one."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import require_circuit, scenes_warnings
from fingerspice.engine.lockstep.card import require_card
from fingerspice.results.outcome import SolveError
from fingerspice.results.record import SIGNALS
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import RTOL_RANGE, simulate
from fingerspice.studies.batch.form import (
    FAILED,
    ONE_BY_ONE,
    REFUSED,
    SIGNALS_OF_BATCH,
    STATUS_NAMES,
    Answers,
    Gradients,
    LockstepForm,
    Task,
    checked_scenes,
    frequencies,
    gradients_of,
    lockstep_form,
    task_of,
    why_alone,
)
from fingerspice.studies.batch.ladder import Figures, Ladder, Slopes
from fingerspice.studies.steady import SteadyState, steady_state
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from xarray import Dataset

# Largest number of failure messages that a Dataset keeps, and of gap voltages (8 GB) that a batch may return.
MESSAGES, _MOST_VOLTAGES = 16, 1e9
# Smallest and largest number of scenes in a job, of which there are 8 or more between these limits; the number if gap
# voltages are wanted, so that these stay in the processor's cache; the limits under a recording, whose scenes take
# long; and the number on a graphics card, which is slow to start.
_JOBS, _CHUNKS, _TRACED, _RECORDED, _ON_CARD = 8, (512, 4096), 256, (32, 128), 262_144
# Relative distance from a whole number within which a number of half periods counts as whole.
_WHOLE = 1e-9
# A run's rtol is relative to peaks, and a batch's to the output itself: the first attempt assumes that an output is at
# least this fraction of its peak.
_OVER_PEAK = 0.1


def batch(
    circuit: Circuit,
    parameters: Mapping[str, ArrayLike],
    *,
    outputs: Sequence[str] = ("f_el_mean",),
    rtol: float = 1e-4,
    t_stop: float | None = None,
    periods: float | None = None,
    periodic: bool = False,
    gradients: Sequence[str] = (),
    skin: str = "own",
    points: int = 200,
    threads: int | None = None,
    device: str = "cpu",
) -> Dataset:
    """Figures of many scenes, which are one circuit with different values of its parameters.

    Series stacks of two to four layers under the local law, driven by sines, an AM carrier, a square or a recording,
    are integrated in lockstep. Every other scene, and every scene that does not reach `rtol` in lockstep, is run by
    itself through `simulate` (`steady_state`).

    Parameters
    ----------
    circuit : Circuit
    parameters : mapping of str to array_like, shape (n_scene,) or ()
        Path to values in the netlist's unit, as in `Circuit.replace`; ``source.`` stands for the only source.
    outputs : sequence of str
        Figures ``SIGNAL_KIND`` as in `Solution.summary`, such as ``f_el_mean``, ``f_t_rms`` and ``u_gap_peak``; and
        ``u_gap``, the gap voltage at `points` times per period. Lockstep gives means, root mean squares and ``u_gap``.
    rtol : float
        Error of every output, relative to itself; error of ``u_gap``, relative to its peak.
    t_stop, periods : float, optional
        Length of every run in s, or in periods of its own source; the deck's TSTOP by default. Lockstep is possible if
        the length is a whole number of half periods, or of samples.
    periodic : bool
        Find the periodic state; the figures are then those of one period of it.
    gradients : sequence of str
        Parameters by which every mean among the outputs is differentiated, as in `simulate`'s `sensitivities`.
    skin : str
        ``"own"`` (a SKIN keeps its `f`) or ``"follow"`` (its `f` is the source's frequency).
    points : int
        Number of gap voltages per period, even.
    threads : int, optional
        Number of threads; all processors by default. The result does not depend on it.
    device : str
        ``"cuda"`` does lockstep on an NVIDIA graphics card, but for recordings and ``u_gap``.

    Returns
    -------
    xarray.Dataset
        With dimension ``scene``, the parameters as coordinates, the outputs, ``error`` (stated, relative) and
        ``status``: 0 in lockstep, 1 one by one, 2 refused, 3 failed; the outputs of the last two are NaN. The attribute
        `n_ordinary` counts the scenes not in lockstep, `ordinary` gives the reason, `failures` has the messages,
        `device` says where lockstep was done. With
        `gradients`, also ``d_f_el_mean`` and the like with dimensions ``scene`` and ``parameter``, per unit of the
        parameter; ``gradient_error`` (stated, of a change by all of a parameter, relative to the output) and
        ``gradient_status``; the attributes `n_ordinary_gradients` and `ordinary_gradients`.

    Raises
    ------
    InputError
        If a path or output is unknown, arrays have unequal lengths, a value is NaN or out of range, there are no
        derivatives by a parameter, or there is no graphics card.
    """
    require_circuit(circuit)
    require(device in ("cpu", "cuda"), "device", repr(device), "'cpu' or 'cuda'")
    if device == "cuda":
        require_card()
    task = task_of(circuit, outputs, rtol, t_stop, periods, periodic, points, device)
    require(skin in ("own", "follow"), "skin", repr(skin), "'own' or 'follow'")
    if threads is not None:
        threads = whole_number("threads", threads, 1)
    scenes = checked_scenes(circuit, parameters)
    changed = dict(scenes)
    if skin == "follow":
        frequency = frequencies(circuit, scenes, of_skin=True)
        for element in circuit.by_device("SKIN"):
            if f"{element.name}.f" in scenes:
                raise InputError(f"skin='follow' and {element.name}.f are both given; allowed: one of them")
            changed[f"{element.name}.f"] = frequency
    for text in scenes_warnings(circuit, task.t_stop, scenes, skin):
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    asked = gradients_of(task, gradients, scenes, skin)
    form = lockstep_form(circuit, changed)
    recorded = isinstance(form, LockstepForm) and form.recording is not None
    why = why_alone(form, task.outputs)
    with ThreadPoolExecutor(threads or _processors()) as pool:
        found = _unfilled(task, changed, recorded)
        _find(task, changed, why or form, found, pool)
        slopes = None if asked is None else _slopes(asked, changed, found, pool)
    about = {
        "skin": _skin(circuit, scenes, skin), "n_ordinary": found.n_ordinary, "ordinary": found.ordinary,
        "device": "cpu" if why or recorded else task.device,
    }  # fmt: skip
    return _dataset(task if asked is None else asked, scenes, found, slopes, about)


def _processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _unfilled(task: Task, scenes: Mapping[str, FloatArray], recorded: bool) -> Answers:
    """Answers for the outputs, of which none are found."""
    n, width = next(iter(scenes.values())).size, 0
    if task.traced or (recorded and task.t_stop is None):
        # Refused for what has no period, such as a recording.
        count = task.count(frequencies(task.circuit, scenes))
        width = math.ceil(float(count.max()) * task.points - 1e-9) if task.traced else 0
    require(n * width <= _MOST_VOLTAGES, "outputs", f"of {n * width:.3g} gap voltages", f"at most {_MOST_VOLTAGES:g}")
    # The memory of gap voltages, which is much, is taken by the threads that write them.
    values = {name: np.empty((n, width)) if name == "u_gap" else np.full(n, np.nan) for name in task.outputs}
    return Answers.empty(values, n)


def _slopes(task: Task, scenes: Mapping[str, FloatArray], figures: Answers, pool: ThreadPoolExecutor) -> Answers:
    """The derivatives that `task` asks for, in all scenes that have `figures`."""
    wanted, known, n = task.gradients, task.circuit.parameters, figures.error.size
    assert wanted is not None
    found = Answers.empty({name: np.full((n, len(wanted.paths)), np.nan) for name in task.outputs}, n)
    failed = figures.status >= REFUSED
    found.status[failed] = figures.status[failed]
    every = {**scenes, **{path: np.full(n, known[path].value) for path in wanted.paths if path not in scenes}}
    form = lockstep_form(task.circuit, every)
    why = why_alone(form, task.outputs, task.rtol)
    if not why and wanted.clock is not None and task.t_stop is not None:
        why = f"{wanted.clock} changes the number of periods in t_stop"
    _find(task, every, why or form, found, pool)
    return found


def _find(
    task: Task, scenes: Mapping[str, FloatArray], form: LockstepForm | str, found: Answers, pool: ThreadPoolExecutor
) -> None:
    """Find what `task` asks for in all scenes that are not done; `form` may be why none of them goes in lockstep."""
    ladder = Figures if task.gradients is None else Slopes
    if isinstance(form, LockstepForm):
        lower = {path.lower(): array for path, array in scenes.items()}
        recorded = form.recording is not None
        clock = np.full(found.error.size, form.frequency) if recorded else frequencies(task.circuit, scenes)

        def climb(job: tuple[int, IntArray]) -> None:
            halves, members = job
            some = {path: array[members] for path, array in lower.items()}
            ladder(task, form, some, members, found).climb(halves)

        # Jobs have no scene in common, so that threads write to different places.
        list(pool.map(climb, _jobs(task, task.count(clock), found.status < 0, recorded)))
    rest = np.flatnonzero(found.status < 0)
    if task.traced:
        found.values["u_gap"][rest] = np.nan
    if rest.size:
        found.ordinary = form if isinstance(form, str) else ladder.unmet
        _find_alone(ladder, task, scenes, rest, found, pool)


def _find_alone(
    ladder: type[Ladder], task: Task, scenes: Mapping[str, FloatArray], rest: IntArray, found: Answers,
    pool: ThreadPoolExecutor,
) -> None:  # fmt: skip
    """Find what `task` asks for in the scenes `rest`, each by itself."""
    by_period = (task.periods is not None and not task.periodic) or task.traced
    frequency = frequencies(task.circuit, scenes) if by_period else np.ones(found.error.size)
    allowed, finest = ladder.limit * task.rtol, RTOL_RANGE[0]

    def alone(i: int) -> tuple[int, dict[str, FloatArray]]:
        rtol = max(_OVER_PEAK * task.rtol, finest)
        try:
            circuit = task.circuit.varied({path: float(array[i]) for path, array in scenes.items()})
            values, error = _run_alone(task, circuit, float(frequency[i]), rtol)
            if error > allowed and rtol > finest:
                # The mean is smaller than assumed, relative to the peak: repeat with the rtol that the error asks for.
                closer = max(0.5 * rtol * allowed / error, finest)
                values, error = _run_alone(task, circuit, float(frequency[i]), closer)
        except (InputError, SolveError) as failure:
            found.status[i] = REFUSED if isinstance(failure, InputError) else FAILED
            found.messages[i] = f"{ladder.named}{failure}"
            return i, {}
        found.error[i], found.status[i] = error, ONE_BY_ONE
        return i, values

    # Warnings about unusual values are not repeated for every scene. Filters apply to all threads, so set them here.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ran = list(pool.map(alone, rest.tolist()))
    for i, values in ran:
        for name, value in values.items():
            if value.ndim == 1 and found.values[name].ndim == 1:
                # Several gaps have one column each.
                found.values[name] = np.full((found.error.size, value.size), np.nan)
            found.values[name][(i, slice(value.size)) if value.ndim == 1 else i] = value


def _run_alone(task: Task, circuit: Circuit, frequency: float, rtol: float) -> tuple[dict[str, FloatArray], float]:
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
        return {name: _slopes_of(task, wanted, circuit, ran, name, stop) for name in task.outputs}, Slopes.limit * error
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


def _slopes_of(
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


def _jobs(task: Task, count: FloatArray, chosen: BoolArray, recorded: bool) -> list[tuple[int, IntArray]]:
    """Jobs of the `chosen` scenes whose runs last for whole numbers of half periods: that number, and the scenes.

    `count` (n,) is the number of periods in every run. Under a recording (`recorded`) half a period is a sample.
    """
    halves = np.round(2.0 * count)
    good = chosen & (halves >= 1.0) & (np.abs(2.0 * count - halves) <= _WHOLE * halves)
    if any(name.endswith("_periodic") for name in task.outputs):
        good &= halves >= 2.0
    jobs = []
    for size in np.unique(halves[good]).astype(int).tolist():
        members = np.flatnonzero(good & (halves == size))
        chunk = int(np.clip(members.size // _JOBS, *(_RECORDED if recorded else _CHUNKS)))
        if not recorded:
            chunk = _TRACED if task.traced else _ON_CARD if task.device == "cuda" else chunk
        jobs += [(size, members[i : i + chunk]) for i in range(0, members.size, chunk)]
    return jobs


def _dataset(
    task: Task, scenes: Mapping[str, FloatArray], found: Answers, slopes: Answers | None, attrs: dict[str, Any]
) -> Dataset:
    """The answers with their coordinates and units."""
    from xarray import Dataset

    known = task.circuit.parameters
    meanings = {"flag_values": list(range(len(STATUS_NAMES))), "flag_meanings": " ".join(STATUS_NAMES)}
    data: dict[str, Any] = {}
    for name, values in found.values.items():
        signal = next(s for s in SIGNALS_OF_BATCH if name == s or name.startswith(f"{s}_"))
        unit = "deg" if name.endswith("phase_deg") else SIGNALS[signal][0]
        dims = ("scene",) if values.ndim == 1 else ("scene", "turn" if name == "u_gap" else "gap")
        data[name] = (dims, values, {"units": unit, "long_name": f"{SIGNALS[signal][1]}{name[len(signal) :]}"})
    data["error"] = ("scene", found.error, {"units": "1", "long_name": "stated error, relative"})
    data["status"] = ("scene", found.status, meanings)
    coords: dict[str, Any] = {path: ("scene", array, {"units": known[path].unit}) for path, array in scenes.items()}
    if "u_gap" in found.values:
        turns = np.arange(found.values["u_gap"].shape[1]) / task.points
        coords["turn"] = ("turn", turns, {"units": "1", "long_name": "time in periods of the source"})
    if slopes is not None and task.gradients is not None:
        for name, values in slopes.values.items():
            unit, text = SIGNALS[name.removesuffix("_mean")][:2]
            about = {"units": f"{unit} per parameter_unit", "long_name": f"derivative of {text}_mean by each parameter"}
            data[f"d_{name}"] = (("scene", "parameter"), values, about)
        told = "stated error of a derivative times its parameter, relative to the output"
        data["gradient_error"] = ("scene", slopes.error, {"units": "1", "long_name": told})
        data["gradient_status"] = ("scene", slopes.status, meanings)
        attrs |= {"ordinary_gradients": slopes.ordinary, "n_ordinary_gradients": slopes.n_ordinary}
        found.messages |= slopes.messages
        paths = list(task.gradients.paths)
        coords |= {"parameter": paths, "parameter_unit": ("parameter", [known[path].unit for path in paths])}
    length = {"t_stop": task.t_stop} if task.t_stop is not None else {"periods": task.periods}
    failures = [f"scene {i}: {found.messages[i]}" for i in sorted(found.messages)[:MESSAGES]]
    attrs |= {"rtol": task.rtol, "periodic": int(task.periodic), **length, "failures": failures}
    return Dataset(data, coords, attrs)


def _skin(circuit: Circuit, scenes: Mapping[str, FloatArray], skin: str) -> str:
    """Text about the frequency at which the skin's data are taken."""
    skins = circuit.by_device("SKIN")
    if skin == "follow" or not skins:
        return "the skin's data follow the source's frequency" if skins else "there is no SKIN"
    held = ", ".join(f"{e.name}.f" for e in skins)
    varied = any(path.lower().endswith(".frequency") for path in scenes)
    return f"the skin's data are those at its own {held}{', whatever the source frequency is' if varied else ''}"
