"""Many scenes of one circuit: scenes of a suitable form in lockstep, all others one by one."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, IntArray, positive_number, real_numbers, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import own_path, require_circuit, scenes_warnings
from fingerspice.circuit.statespace import driving_sources
from fingerspice.engine.lockstep.card import require_card
from fingerspice.results.outcome import SolveError
from fingerspice.results.record import SIGNALS
from fingerspice.results.solution import DERIVED, MEANS
from fingerspice.solve.derivatives import check_signals
from fingerspice.solve.simulation import RTOL_RANGE, rtol_given, simulate
from fingerspice.studies.batch.lockstep import LOCKSTEP, Ladder, LockstepForm, Slopes, lockstep_form, why_alone
from fingerspice.studies.steady import steady_state
from fingerspice.waveforms.waveform import Sum, refuse, require

if TYPE_CHECKING:
    from xarray import Dataset

# Kinds of figures.
_KINDS = ("mean", "rms", "min", "max", "peak", "mean_periodic", "rms_periodic", "ripple", "amplitude", "phase_deg")
# The signal and the kind of every output.
OUTPUTS = {f"{signal}_{kind}": (signal, kind) for signal in DERIVED for kind in _KINDS}
OUTPUTS["u_gap"] = "u_gap", ""
LEAST_RTOL = 1e-12
ONE_BY_ONE, REFUSED, FAILED = 1, 2, 3
STATUS_NAMES = ("lockstep", "one_by_one", "refused", "failed")
STATUS = {"flag_values": [*range(len(STATUS_NAMES))], "flag_meanings": " ".join(STATUS_NAMES)}  # Attributes of `status`
# A relative change of a parameter by which it is seen whether the source's tone depends on it.
_SEEN = 1e-3
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


class Task:
    """A checked request of `batch`, of outputs or, with `paths`, of means' derivatives, and what is found."""

    n: int  # Number of scenes
    scenes: dict[str, FloatArray]  # Values by path, (n,) each
    # What is found, NaN in a scene without a result: (n,) each, (n, n_gap) of several GAPs, (n, n_parameter) of
    # derivatives, or, of gap voltages, (n, width) and (n, width, n_gap)
    values: dict[str, FloatArray]
    error: FloatArray  # (n,): Stated error, of outputs relative to themselves
    status: NDArray[np.int8]  # (n,): Index into `STATUS_NAMES`, and -1 before there are results
    messages: dict[int, str]  # Of the scenes without a result
    n_ordinary: int  # Scenes that were not in lockstep
    ordinary: str  # Why

    def __init__(
        self, circuit: Circuit, outputs: Sequence[str], rtol: float, t_stop: float | None, periods: float | None,
        periodic: bool, points: int, device: str,
    ) -> None:  # fmt: skip
        self.circuit, self.periodic = circuit, periodic
        self.rtol, self.points = rtol_given(rtol, LEAST_RTOL), whole_number("points", points, 2)
        require(self.points % 2 == 0, "points", self.points, "an even number, 2 or more")
        self.outputs = (outputs,) if isinstance(outputs, str) else tuple(outputs)
        for name in self.outputs:
            if name not in OUTPUTS:
                kinds, signals = ", ".join(f"_{kind}" for kind in _KINDS), ", ".join(DERIVED)
                raise InputError(f"unknown output {name!r}; allowed: u_gap, or one of {signals} with one of {kinds}")
        require(bool(self.outputs), "outputs", "empty", "one or more names")
        self.traced = "u_gap" in self.outputs
        # Gap voltages stay on the processor.
        self.device = "cpu" if self.traced else device
        given = [x for x in (t_stop, periods) if x is not None]
        refuse(len(given) == 2, "t_stop and periods are both given; allowed: one of them")
        self.t_stop = None if t_stop is None else positive_number("t_stop", t_stop, "s")
        self.periods = None if periods is None else positive_number("periods", periods)
        refuse(periodic and given, "periodic=True takes one period, and t_stop or periods is given; allowed: neither")
        if periodic:
            self.periods = 1.0
        elif not given and circuit.tran is not None:
            self.t_stop = circuit.tran.stop
        elif not given:
            raise InputError("no t_stop: the deck has no .tran line and none was given; give t_stop in s, or periods")
        # Parameters by which the means are differentiated, in the circuit's spelling, each with those that grow in
        # proportion to it: a source's frequency with that of a skin
        self.paths: dict[str, tuple[str, ...]] = {}
        self.clock: str | None = None  # The frequency of the only source, if it is one of `paths`

    def count(self, frequency: FloatArray) -> FloatArray:
        """Number of periods in runs with sources of these frequencies (Hz)."""
        return np.full(self.n, self.periods) if self.t_stop is None else np.asarray(frequency * self.t_stop)

    def frequencies(self, of_skin: bool = False) -> FloatArray:
        """The source's frequency in every scene, Hz: that of several together, or the one that a SKIN follows."""
        every = {e.name: e.waveform for e in driving_sources(self.circuit) if e.waveform is not None}
        on = {f"{name}.frequency": (wave, wave.period) for name, wave in every.items() if wave.period is not None}
        given = [self.scenes[path] for path in on if path in self.scenes]
        if len(on) == 1:
            ((wave, own),) = on.values()
            return given[0] if given else np.full(self.n, (wave.tone() if of_skin else None) or 1.0 / own)
        period = None if of_skin or given or not on else Sum(tuple(wave for wave, _ in on.values())).period
        if period is None:
            allowed = "one, where periods, u_gap or the skin's frequency follow it, or several of fixed frequencies"
            raise InputError(f"{len(on)} sources have a period; allowed: {allowed} in a ratio of whole numbers")
        return np.full(self.n, 1.0 / period)


def checked_scenes(circuit: Circuit, parameters: Mapping[str, ArrayLike]) -> dict[str, FloatArray]:
    """Values by path, all of one shape (n_scene,); refused where a path is unknown or a value NaN or out of range."""
    given: dict[str, FloatArray] = {}
    good = isinstance(parameters, Mapping) and bool(parameters)
    require(good, "parameters", parameters, "a mapping such as {'Xgap.d': [3e-6, 4e-6]}")
    for path, values in parameters.items():
        name = own_path(circuit, path)
        array = real_numbers(path, values, "an array of numbers")
        one_row = array.ndim <= 1 and array.size > 0
        require(one_row, path, f"of shape {array.shape}", "one number, or one row of numbers")
        require(name not in given, name, "given twice", "once")
        given[name] = array
    sizes = {path: array.size for path, array in given.items() if array.ndim == 1}
    counts = ", ".join(f"{n} ({path})" for path, n in sizes.items())
    refuse(len(set(sizes.values())) > 1, f"the arrays have {counts} values; allowed: equal lengths, or single numbers")
    n = max(sizes.values(), default=1)
    scenes = {path: np.ascontiguousarray(np.broadcast_to(array, (n,))) for path, array in given.items()}
    for path, array in scenes.items():
        name, _, parameter = path.rpartition(".")
        element, allowed, bad = circuit[name], "numbers", np.isnan(array)
        if not bad.any() and parameter in element.values:
            spec = element.spec.parameter(parameter)
            bad = ~((array >= spec.least) & (array <= spec.most))
            bad &= ~((array == 0.0) & spec.may_be_zero) & ~((array == np.inf) & spec.may_be_infinite)
            allowed = spec.allowed()
        elif not bad.any():
            # The legal values of a waveform's parameter form an interval: testing its ends is enough.
            for i in (int(np.argmin(array)), int(np.argmax(array))):
                try:
                    circuit.varied({path: float(array[i])})
                except InputError as error:
                    raise InputError(f"scene {i}: {error}") from None
        i = int(np.argmax(bad))
        require(not bad[i], path, f"{array[i]:g} in scene {i}", allowed)
    return scenes


def gradients_of(task: Task, gradients: Sequence[str], skin: str) -> Task | None:
    """The checked request of derivatives in the scenes of a task; None for none."""
    circuit = task.circuit
    require(not isinstance(gradients, str), "gradients", repr(gradients), "a sequence of paths such as ('Xgap.d',)")
    paths = tuple(own_path(circuit, path) for path in gradients)
    if not paths:
        return None
    outputs = tuple(name for name in task.outputs if name in MEANS)
    refuse(not outputs, f"gradients are asked for, and outputs has no mean; allowed: one of {', '.join(MEANS)}")
    if (number := len(circuit.by_device("GAP"))) != 1:
        raise InputError(f"gradients are asked for, and the circuit has {number} GAPs; allowed: one")
    require(len(set(paths)) == len(paths), "gradients", repr(paths), "every parameter once")
    on, scenes = driving_sources(circuit), dict(task.scenes)
    clock = f"{on[0].name}.frequency" if len(on) == 1 else None
    skins = tuple(f"{e.name}.f" for e in circuit.by_device("SKIN")) if skin == "follow" else ()
    for path in paths:
        value, turned = circuit.parameters[path].value, path in skins
        if path not in scenes and not (math.isfinite(value) and value != 0.0):
            raise InputError(f"gradients names {path}, which is {value:g}; allowed: parameters whose value is finite "
                             "and not 0, as steps are relative to it")  # fmt: skip
        scenes.setdefault(path, np.full(task.n, value))
        if skins and not turned and path != clock:
            # Whether the parameter changes the frequency of a source.
            name, moved = path.rpartition(".")[0], circuit.varied({path: value * (1.0 + _SEEN)})
            own, other = circuit[name].waveform, moved[name].waveform
            turned = own is not None and other is not None and own.tone() != other.tone()
        said = f"skin='follow', and gradients names {path}, with which the skin's frequency changes"
        refuse(turned, f"{said}; allowed: the frequency of the only source, or skin='own'")
    asked = copy(task)
    asked.outputs, asked.traced, asked.scenes, asked.clock = outputs, False, scenes, clock if clock in paths else None
    asked.paths = {path: (path, *(skins if path == clock else ())) for path in paths}
    return asked


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
    task = Task(circuit, outputs, rtol, t_stop, periods, periodic, points, device)
    require(skin in ("own", "follow"), "skin", repr(skin), "'own' or 'follow'")
    threads = processors() if threads is None else whole_number("threads", threads, 1)
    scenes = checked_scenes(circuit, parameters)
    task.scenes, skins = dict(scenes), circuit.by_device("SKIN")
    n = task.n = next(iter(scenes.values())).size
    if skin == "follow":
        frequency = task.frequencies(of_skin=True)
        for element in skins:
            own_data = f"{element.name}.f"
            refuse(own_data in scenes, f"skin='follow' and {own_data} are both given; allowed: one of them")
            task.scenes[own_data] = frequency
    check_signals(circuit, task.outputs, scenes)
    for text in scenes_warnings(circuit, task.t_stop, scenes, skin):
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    slopes, form = gradients_of(task, gradients, skin), lockstep_form(circuit, task.scenes)
    why, recorded = why_alone(form, task.outputs), isinstance(form, LockstepForm) and form.recording is not None
    width, gaps = 0, len(circuit.by_device("GAP"))
    if task.traced or (recorded and task.t_stop is None):
        # Refused for what has no period, such as a recording.
        count = task.count(task.frequencies())
        width = math.ceil(float(count.max()) * task.points - 1e-9) if task.traced else 0
    # Figures of several GAPs have one column each.
    size, each = n * width * max(gaps, 1), (gaps,) if gaps > 1 else ()
    require(size <= _MOST_VOLTAGES, "outputs", f"of {size:.3g} gap voltages", f"at most {_MOST_VOLTAGES:g}")
    task.values = {name: np.full((n, *each), np.nan) for name in task.outputs if name != "u_gap"}
    if task.traced:
        # This memory, which is much, is taken by the threads that write it.
        task.values["u_gap"] = np.empty((n, width, *each))
    task.status = np.full(n, -1, np.int8)
    with ThreadPoolExecutor(threads) as pool:
        _find(task, why or form, pool)
        if slopes is not None:
            slopes.values = {name: np.full((n, len(slopes.paths)), np.nan) for name in slopes.outputs}
            slopes.status = np.where(task.status >= REFUSED, task.status, np.int8(-1))
            form = lockstep_form(circuit, slopes.scenes)
            unlike = why_alone(form, slopes.outputs, slopes.rtol)
            if not unlike and slopes.clock is not None and slopes.t_stop is not None:
                unlike = f"{slopes.clock} changes the number of periods in t_stop"
            _find(slopes, unlike or form, pool)
    said = "the skin's data follow the source's frequency" if skins else "there is no SKIN"
    if skins and skin == "own":
        varied = any(path.lower().endswith(".frequency") for path in scenes)
        held = ", ".join(f"{e.name}.f" for e in skins)
        said = f"the skin's data are those at its own {held}{', whatever the source frequency is' if varied else ''}"
    return _dataset(task, slopes, scenes, said, "cpu" if why or recorded else task.device)


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _find(task: Task, form: LockstepForm | str, pool: ThreadPoolExecutor) -> None:
    """Find what a task asks for in all scenes that are not done; `form` may be why none of them goes in lockstep."""
    ladder = Slopes if task.paths else Ladder
    task.error, task.messages, task.ordinary = np.full(task.n, np.nan), {}, ""
    if isinstance(form, LockstepForm):
        # Jobs have no scene in common, so that threads write to different places.
        list(pool.map(lambda job: ladder(task, form, *job).climb(), _jobs(task, form)))
    rest, task.n_ordinary = np.flatnonzero(task.status < 0), int(np.count_nonzero(task.status != LOCKSTEP))
    if task.traced:
        task.values["u_gap"][rest] = np.nan
    if not rest.size:
        return
    unmet = "what does not end after half periods or at a sample, or does not meet its error in lockstep"
    task.ordinary = form if isinstance(form, str) else unmet
    by_period = (task.periods is not None and not task.periodic) or task.traced
    frequency = task.frequencies() if by_period else np.ones(task.n)
    allowed, finest = ladder.limit * task.rtol, RTOL_RANGE[0]

    def alone(i: int) -> None:
        rtol = max(_OVER_PEAK * task.rtol, finest)
        try:
            circuit = task.circuit.varied({path: float(array[i]) for path, array in task.scenes.items()})
            values, error = _run_alone(task, circuit, float(frequency[i]), rtol)
            if error > allowed and rtol > finest:
                # The mean is smaller than assumed, relative to the peak: repeat with the rtol that the error asks for.
                closer = max(0.5 * rtol * allowed / error, finest)
                values, error = _run_alone(task, circuit, float(frequency[i]), closer)
        except (InputError, SolveError) as failure:
            task.status[i] = REFUSED if isinstance(failure, InputError) else FAILED
            task.messages[i] = f"{ladder.named}{failure}"
            return
        task.error[i], task.status[i] = error, ONE_BY_ONE
        for name, value in values.items():
            # Shorter runs have fewer gap voltages.
            task.values[name][(i, slice(len(value))) if name == "u_gap" else i] = value

    # Warnings about unusual values are not repeated for every scene. Filters apply to all threads, so set them here.
    with warnings.catch_warnings(action="ignore"):
        list(pool.map(alone, rest.tolist()))


def _jobs(task: Task, form: LockstepForm) -> list[tuple[int, IntArray]]:
    """Jobs of the scenes not done that last for whole numbers of half periods (samples): the number, and the scenes."""
    recorded = form.recording is not None
    count = task.count(np.full(task.n, form.frequency) if recorded else task.frequencies())
    halves = np.round(2.0 * count)
    least = 2.0 if any(name.endswith("_periodic") for name in task.outputs) else 1.0
    good = (task.status < 0) & (halves >= least) & (np.abs(2.0 * count - halves) <= _WHOLE * halves)
    jobs = []
    for size in np.unique(halves[good]).astype(int).tolist():
        members = np.flatnonzero(good & (halves == size))
        chunk = int(np.clip(members.size // _JOBS, *(_RECORDED if recorded else _CHUNKS)))
        if not recorded:
            chunk = _TRACED if task.traced else _ON_CARD if task.device == "cuda" else chunk
        jobs += [(size, members[i : i + chunk]) for i in range(0, members.size, chunk)]
    return jobs


def _run_alone(task: Task, circuit: Circuit, frequency: float, rtol: float) -> tuple[dict[str, FloatArray], float]:
    """What is wanted of a scene from one run, and its stated error; `frequency` (Hz) is that of its periods."""
    stop, t = (task.periods or 1.0) / frequency if task.t_stop is None else task.t_stop, None
    paths = tuple(dict.fromkeys(path for together in task.paths.values() for path in together))
    if task.periodic:
        state = steady_state(circuit, rtol=rtol, points=4 if paths else task.points, charge=False, sensitivities=paths)
        run, off = state.solution, state.error
    else:
        if paths:
            t = np.array([stop])
        elif task.traced:
            t = np.arange(math.ceil(stop * frequency * task.points - 1e-9)) / (frequency * task.points)
        run = simulate(circuit, t_stop=stop, t_eval=t, rtol=rtol, charge=False, sensitivities=paths)
        off = run.error
    # Largest of the errors of the gap voltage relative to its peak, and of the force relative to its mean.
    sizes = [0.0 if size is None else float(np.min(size)) for size in (run.u_gap_peak, run.f_el_mean)]
    error = max((x / size for x, size in zip((off.u_gap, off.f_el), sizes, strict=True) if size > 0.0), default=0.0)
    if not paths:
        # What there is not is None, and so NaN.
        values = {name: np.asarray(run._figure(*OUTPUTS[name]), float) for name in task.outputs if name != "u_gap"}
        if task.traced:
            values["u_gap"] = np.atleast_1d(np.asarray(run.u_gap, float))[: -1 if task.periodic else None]
        return values, error
    known, values, start = circuit.parameters, {}, circuit.tran.start if circuit.tran is not None else 0.0
    for name in task.outputs:
        # For a change of each parameter by all of itself.
        each = {path: getattr(one, name) * known[path].value for path, one in run.sensitivities.items()}
        by = {path: sum(each[other] for other in together) for path, together in task.paths.items()}
        if task.clock is not None and task.periods is not None and not task.periodic:
            # The run ends after a number of periods: its end moves with the frequency, and the mean with its end.
            gained = float(getattr(run, name.removesuffix("_mean"))[-1]) - float(getattr(run, name))
            by[task.clock] -= gained * stop / (stop - start)
        values[name] = np.array([x / known[path].value for path, x in by.items()])
    # The error of a change by all of the parameter is about ten times that of the run.
    return values, Slopes.limit * error


def _dataset(task: Task, slopes: Task | None, scenes: Mapping[str, FloatArray], skin: str, device: str) -> Dataset:
    """The answers with the values given, `scenes`, as coordinates, and units."""
    from xarray import Dataset

    known = task.circuit.parameters
    data: dict[str, Any] = {}
    for name in task.outputs:
        signal, kind = OUTPUTS[name]
        dims, values = ("scene", "gap") if kind else ("scene", "turn", "gap"), task.values[name]
        unit = "deg" if kind == "phase_deg" else SIGNALS[signal][0]
        text = name.replace(signal, SIGNALS[signal][1], 1)
        data[name] = (dims[: values.ndim], values, {"units": unit, "long_name": text})
    data["error"] = ("scene", task.error, {"units": "1", "long_name": "stated error, relative"})
    data["status"] = ("scene", task.status, STATUS)
    coords: dict[str, Any] = {path: ("scene", array, {"units": known[path].unit}) for path, array in scenes.items()}
    if task.traced:
        turns = np.arange(task.values["u_gap"].shape[1]) / task.points
        coords["turn"] = ("turn", turns, {"units": "1", "long_name": "time in periods of the source"})
    about = {"skin": skin, "n_ordinary": task.n_ordinary, "ordinary": task.ordinary, "device": device}
    messages = task.messages
    if slopes is not None:
        for name, values in slopes.values.items():
            unit, text = SIGNALS[name.removesuffix("_mean")][:2]
            of = {"units": f"{unit} per parameter_unit", "long_name": f"derivative of {text}_mean by each parameter"}
            data[f"d_{name}"] = (("scene", "parameter"), values, of)
        told = "stated error of a derivative times its parameter, relative to the output"
        data["gradient_error"] = ("scene", slopes.error, {"units": "1", "long_name": told})
        data["gradient_status"] = ("scene", slopes.status, STATUS)
        about |= {"ordinary_gradients": slopes.ordinary, "n_ordinary_gradients": slopes.n_ordinary}
        paths, messages = list(slopes.paths), messages | slopes.messages
        coords |= {"parameter": paths, "parameter_unit": ("parameter", [known[path].unit for path in paths])}
    length = {"periods": task.periods} if task.t_stop is None else {"t_stop": task.t_stop}
    failures = [f"scene {i}: {messages[i]}" for i in sorted(messages)[:MESSAGES]]
    about |= {"rtol": task.rtol, "periodic": int(task.periodic), **length, "failures": failures}
    return Dataset(data, coords, about)
