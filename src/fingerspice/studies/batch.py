"""Many scenes of one circuit: scenes of a suitable form in lockstep, all others one by one."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, positive_number, real_numbers, whole_number
from fingerspice.base.card import require_card
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.arguments import require_circuit
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.notices import scenes_warnings
from fingerspice.circuit.topology import driving_sources
from fingerspice.results.signals import SIGNALS
from fingerspice.solve.simulation import rtol_given
from fingerspice.studies.batchgradients import gradient_coordinates, gradient_data, gradient_request, gradients_of
from fingerspice.studies.batchladder import climb, in_lockstep
from fingerspice.studies.batchscenes import lockstep_form
from fingerspice.studies.batchtask import (
    LOCKSTEP,
    SIGNALS_OF_BATCH,
    STATUS_NAMES,
    Answers,
    Task,
    each_alone,
    jobs_of,
    run_single,
)
from fingerspice.waveforms.combinations import Sum
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from xarray import Dataset

_KINDS = ("mean", "rms", "min", "max", "peak", "mean_periodic", "rms_periodic", "ripple", "amplitude", "phase_deg")
LEAST_RTOL = 1e-12
# Largest number of failure messages that a Dataset keeps, and of gap voltages (8 GB) that a batch may return.
MESSAGES, MOST_VOLTAGES = 16, 1e9


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
    task = replace(_task(circuit, outputs, rtol, t_stop, periods, periodic, points), device=device)
    require(skin in ("own", "follow"), "skin", repr(skin), "'own' or 'follow'")
    if threads is not None:
        threads = whole_number("threads", threads, 1)
    scenes = checked_scenes(circuit, parameters)
    changed = dict(scenes)
    if skin == "follow":
        frequency = _frequencies(circuit, scenes, of_skin=True)
        for element in circuit.by_device("SKIN"):
            if f"{element.name}.f" in scenes:
                raise InputError(f"skin='follow' and {element.name}.f are both given; allowed: one of them")
            changed[f"{element.name}.f"] = frequency
    for text in scenes_warnings(circuit, task.t_stop, scenes, skin):
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    paths = gradient_paths(circuit, gradients)
    wanted = gradient_request(task, paths, scenes, skin) if paths else None
    with ThreadPoolExecutor(threads or _processors()) as pool:
        found, reason, where = _lockstep(task, changed, pool)
        found.fill()
        rest = np.flatnonzero(~found.done)
        _one_by_one(task, changed, rest, found, pool)
        attrs = {"skin": skin, "n_ordinary": rest.size, "ordinary": reason if rest.size else "", "device": where}
        if wanted is None:
            return _dataset(task, scenes, found, attrs)
        form = lockstep_form(circuit, {})
        by_period = task.periods is not None or not (isinstance(form, str) or form.recording is not None)
        frequency = _frequencies(circuit, changed) if by_period else np.ones(found.error.size)
        slopes, attrs["ordinary_gradients"] = gradients_of(task, wanted, changed, frequency, found, pool)
    attrs["n_ordinary_gradients"] = int(np.count_nonzero(slopes.status != LOCKSTEP))
    found.messages |= slopes.messages
    return (
        _dataset(task, scenes, found, attrs)
        .assign(gradient_data(slopes))
        .assign_coords(gradient_coordinates(task, wanted))
    )


def _processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _task(
    circuit: Circuit, outputs: Sequence[str], rtol: float, t_stop: float | None, periods: float | None, periodic: bool,
    points: int,
) -> Task:  # fmt: skip
    """The checked request."""
    rtol, points = rtol_given(rtol, LEAST_RTOL), whole_number("points", points, 2)
    require(points % 2 == 0, "points", points, "an even number, 2 or more")
    if isinstance(outputs, str):
        outputs = (outputs,)
    known = ["u_gap", *(f"{signal}_{kind}" for signal in SIGNALS_OF_BATCH for kind in _KINDS)]
    for name in outputs:
        if name not in known:
            kinds = ", ".join(f"_{kind}" for kind in _KINDS)
            signals = ", ".join(SIGNALS_OF_BATCH)
            raise InputError(f"unknown output {name!r}; allowed: u_gap, or one of {signals} with one of {kinds}")
    require(len(outputs) > 0, "outputs", "empty", "one or more names")
    if periods is not None and t_stop is not None:
        raise InputError("t_stop and periods are both given; allowed: one of them")
    t_stop = None if t_stop is None else positive_number("t_stop", t_stop, "s")
    periods = None if periods is None else positive_number("periods", periods)
    if periodic and (periods is not None or t_stop is not None):
        raise InputError("periodic=True takes one period, and t_stop or periods is given; allowed: neither")
    if periods is None and t_stop is None and not periodic:
        if circuit.tran is None:
            raise InputError("no t_stop: the deck has no .tran line and none was given; give t_stop in s, or periods")
        t_stop = circuit.tran.stop
    return Task(circuit, tuple(outputs), rtol, t_stop, 1.0 if periodic else periods, periodic, points)


def checked_scenes(circuit: Circuit, parameters: Mapping[str, ArrayLike]) -> dict[str, FloatArray]:
    """Values by path, all of one shape (n_scene,).

    Raises
    ------
    InputError
        If a path is unknown, lengths are unequal, or a value is NaN or out of range.
    """
    if not isinstance(parameters, Mapping) or not parameters:
        raise InputError(f"parameters is {parameters!r}; allowed: a mapping such as {{'Xgap.d': [3e-6, 4e-6]}}")
    given: dict[str, FloatArray] = {}
    for path, values in parameters.items():
        name = own_path(circuit, path)
        array = real_numbers(path, values, "an array of numbers")
        require(
            array.ndim <= 1 and array.size > 0, path, f"of shape {array.shape}", "one number, or one row of numbers"
        )
        if name in given:
            raise InputError(f"{name} is given twice; allowed: once")
        given[name] = array
    sizes = {path: array.size for path, array in given.items() if array.ndim == 1}
    if len(set(sizes.values())) > 1:
        raise InputError(f"the arrays have {', '.join(f'{n} ({p})' for p, n in sizes.items())} values; allowed: equal "
                         "lengths, or single numbers")  # fmt: skip
    n = max(sizes.values(), default=1)
    scenes = {path: np.ascontiguousarray(np.broadcast_to(array, (n,))) for path, array in given.items()}
    for path, array in scenes.items():
        _check_values(circuit, path, array)
    return scenes


def own_path(circuit: Circuit, path: Any) -> str:
    """A path in the circuit's own spelling."""
    if isinstance(path, str) and path.lower().startswith("source."):
        on = driving_sources(circuit)
        if not any(e.name.lower() == "source" for e in circuit.elements) and len(on) == 1:
            path = f"{on[0].name}.{path.partition('.')[2]}"
    known = {name.lower(): name for name in circuit.parameters}
    if not isinstance(path, str) or path.lower() not in known:
        # The circuit raises the error about an unknown path, which gives the nearest name.
        circuit.varied({path: 1.0})
        raise InputError(f"{path!r} is no parameter that takes numbers; allowed: a path such as 'Xgap.d'")
    return known[path.lower()]


def gradient_paths(circuit: Circuit, gradients: Sequence[str]) -> tuple[str, ...]:
    """The parameters of a gradient in the circuit's own spelling."""
    if isinstance(gradients, str):
        raise InputError(f"gradients is {gradients!r}; allowed: a sequence of paths such as ('Xgap.d',)")
    return tuple(own_path(circuit, path) for path in gradients)


def _check_values(circuit: Circuit, path: str, array: FloatArray) -> None:
    """Refuse NaN and values that the parameter does not accept; the message names the scene."""
    name, _, parameter = path.rpartition(".")
    element = circuit[name]
    bad = np.isnan(array)
    if not bad.any() and parameter in element.values:
        spec = element.spec.parameter(parameter)
        bad = ~((array >= spec.least) & (array <= spec.most))
        bad &= ~((array == 0.0) & spec.may_be_zero) & ~((array == np.inf) & spec.may_be_infinite)
        allowed = spec.allowed()
    elif not bad.any():
        # The legal values of a waveform's parameter form an interval: testing the smallest and the largest is enough.
        for i in (int(np.argmin(array)), int(np.argmax(array))):
            try:
                circuit.varied({path: float(array[i])})
            except InputError as error:
                raise InputError(f"scene {i}: {error}") from None
    else:
        allowed = "numbers"
    if bad.any():
        i = int(np.argmax(bad))
        raise InputError(f"{path} is {array[i]:g} in scene {i}; allowed: {allowed}")


def _frequencies(circuit: Circuit, scenes: Mapping[str, FloatArray], of_skin: bool = False) -> FloatArray:
    """The source's frequency in every scene, Hz: that of several sources together, or the one that a SKIN follows.

    Raises
    ------
    InputError
        If no source has a period, or several have none in common; a SKIN can follow one source only.
    """
    n = next(iter(scenes.values())).size
    on = [e for e in driving_sources(circuit) if e.waveform is not None and e.waveform.period is not None]
    waves = [e.waveform for e in on if e.waveform is not None]
    if len(on) == 1:
        given = scenes.get(f"{on[0].name}.frequency")
        tone = waves[0].tone() if of_skin else None
        return given if given is not None else np.full(n, tone or 1.0 / (waves[0].period or math.nan))
    moved = any(f"{e.name}.frequency" in scenes for e in on)
    period = None if of_skin or moved or not on else Sum(tuple(waves)).period
    if period is None:
        raise InputError(f"{len(on)} sources have a period; allowed: one, where periods, u_gap or the skin's frequency "
                         "follow it, or several of fixed frequencies in a ratio of whole numbers")  # fmt: skip
    return np.full(n, 1.0 / period)


def _lockstep(task: Task, scenes: Mapping[str, FloatArray], pool: ThreadPoolExecutor) -> tuple[Answers, str, str]:
    """The results of lockstep, the reason why the other scenes have none, and the device that was used."""
    n = next(iter(scenes.values())).size
    lower = {path.lower(): array for path, array in scenes.items()}
    traced = task.traced
    form = lockstep_form(task.circuit, lower)
    recorded = not isinstance(form, str) and form.recording is not None
    others = [name for name in task.outputs if not in_lockstep(name) or (recorded and name.endswith("_periodic"))]
    count = np.ones(n)
    if not isinstance(form, str) and recorded and not traced and task.t_stop is not None:
        # Half a period is the length of a sample.
        count = task.count(np.full(n, form.frequency or math.nan))
    elif traced or not isinstance(form, str):
        count = task.count(_frequencies(task.circuit, scenes))
    width = math.ceil(float(count.max()) * task.points - 1e-9) if traced else 0
    require(n * width <= MOST_VOLTAGES, "outputs", f"of {n * width:.3g} gap voltages", f"at most {MOST_VOLTAGES:g}")
    found = Answers.empty(task, n, width)
    if isinstance(form, str) or others:
        return found, form if isinstance(form, str) else f"{', '.join(others)} needs a run of its own", "cpu"
    jobs = jobs_of(task, count, np.ones(n, bool), recorded)

    def one(job: tuple[int, NDArray[np.int64]]) -> None:
        halves, members = job
        climb(task, form, {path: array[members] for path, array in lower.items()}, halves, members, found)

    # Jobs have no scene in common, so that threads write to different places.
    list(pool.map(one, jobs))
    reason = "what does not end after half periods or at a sample, or does not meet its error in lockstep"
    return found, reason, task.device if task.on_card(recorded) else "cpu"


def _one_by_one(
    task: Task, scenes: Mapping[str, FloatArray], rest: NDArray[np.int64], found: Answers, pool: ThreadPoolExecutor
) -> None:  # fmt: skip
    """Run the scenes `rest`, each by itself."""
    if not rest.size:
        return
    by_period = (task.periods is not None and not task.periodic) or task.traced
    frequency = _frequencies(task.circuit, scenes) if by_period else np.ones(next(iter(scenes.values())).size)
    for i, single in each_alone(task, scenes, frequency, rest, pool, partial(run_single, task), task.rtol):
        found.put_single(i, single.values, single.error, single.status)
        if single.message:
            found.messages[i] = single.message


def _dataset(task: Task, scenes: Mapping[str, FloatArray], found: Answers, attrs: dict[str, Any]) -> Dataset:
    """The answers with their coordinates and units."""
    from xarray import Dataset

    units = {path: p.unit for path, p in task.circuit.parameters.items()}
    data: dict[str, Any] = {}
    for name, values in found.values.items():
        signal = next(s for s in SIGNALS_OF_BATCH if name == s or name.startswith(f"{s}_"))
        unit = "deg" if name.endswith("phase_deg") else SIGNALS[signal][0]
        dims = ("scene",) if values.ndim == 1 else ("scene", "turn" if name == "u_gap" else "gap")
        data[name] = (dims, values, {"units": unit, "long_name": f"{SIGNALS[signal][1]}{name[len(signal) :]}"})
    data["error"] = ("scene", found.error, {"units": "1", "long_name": "stated error, relative"})
    meanings = {"flag_values": list(range(len(STATUS_NAMES))), "flag_meanings": " ".join(STATUS_NAMES)}
    data["status"] = ("scene", found.status, meanings)
    coords: dict[str, Any] = {path: ("scene", array, {"units": units[path]}) for path, array in scenes.items()}
    if "u_gap" in found.values:
        turns = np.arange(found.values["u_gap"].shape[1]) / task.points
        coords["turn"] = ("turn", turns, {"units": "1", "long_name": "time in periods of the source"})
    length = {"t_stop": task.t_stop} if task.t_stop is not None else {"periods": task.periods}
    told = [f"scene {i}: {found.messages[i]}" for i in sorted(found.messages)[:MESSAGES]]
    attrs |= {
        "rtol": task.rtol,
        "periodic": int(task.periodic),
        **length,
        "failures": told,
        "skin": _skin(task, scenes, attrs),
    }
    return Dataset(data, coords, attrs)


def _skin(task: Task, scenes: Mapping[str, FloatArray], attrs: Mapping[str, Any]) -> str:
    """Text about the frequency at which the skin's data are taken."""
    skins = task.circuit.by_device("SKIN")
    if attrs["skin"] == "follow" or not skins:
        return "the skin's data follow the source's frequency" if skins else "there is no SKIN"
    held = ", ".join(f"{e.name}.f" for e in skins)
    varied = any(path.lower().endswith(".frequency") for path in scenes)
    return f"the skin's data are those at its own {held}{', whatever the source frequency is' if varied else ''}"
