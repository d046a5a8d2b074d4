"""The request of a batch (`Task`), checked, and its answers (`Answers`)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, positive_number, real_numbers, whole_number
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.topology import driving_sources
from fingerspice.results.sensitivity import MEANS
from fingerspice.solve.simulation import rtol_given
from fingerspice.waveforms.combinations import Sum
from fingerspice.waveforms.waveform import require

#: Signals whose figures a batch has, and the kinds of figures.
SIGNALS_OF_BATCH = ("f_el", "f_t", "friction", "u_gap", "area")
_KINDS = ("mean", "rms", "min", "max", "peak", "mean_periodic", "rms_periodic", "ripple", "amplitude", "phase_deg")
LEAST_RTOL = 1e-12
LOCKSTEP, ONE_BY_ONE, REFUSED, FAILED = 0, 1, 2, 3
STATUS_NAMES = ("lockstep", "one_by_one", "refused", "failed")
# A relative change of a parameter by which it is seen whether the source's tone depends on it.
_SEEN = 1e-3


@dataclass(frozen=True)
class Gradients:
    """The parameters by which the means are to be differentiated."""

    paths: tuple[str, ...]  # In the circuit's own spelling
    # Each parameter with those that grow in proportion to it: the frequency of a source with that of a skin
    together: Mapping[str, tuple[str, ...]]
    clock: str | None  # The frequency of the only source, if it is one of the parameters


@dataclass(frozen=True)
class Task:
    """A checked request; its attributes are arguments of `batch`, with exactly one of `t_stop` and `periods` given.

    It asks for derivatives of its outputs, which are means, if it has `gradients`. Gap voltages stay on the processor.
    """

    circuit: Circuit
    outputs: tuple[str, ...]
    rtol: float
    t_stop: float | None
    periods: float | None
    periodic: bool
    points: int
    device: str
    gradients: Gradients | None = None

    @property
    def traced(self) -> bool:
        """Whether gap voltages are wanted."""
        return "u_gap" in self.outputs

    def stop(self, frequency: float) -> float:
        """End of a run with a source of this frequency (Hz), s."""
        return self.t_stop if self.t_stop is not None else (self.periods or 1.0) / frequency

    def count(self, frequency: FloatArray) -> FloatArray:
        """Number of periods in runs with sources of these frequencies (Hz)."""
        if self.t_stop is not None:
            return np.asarray(frequency * self.t_stop)
        return np.full(frequency.shape, self.periods)


@dataclass
class Answers:
    """Outputs of some scenes, or their derivatives; a scene without a result has NaN."""

    # (n,) each, (n, n_parameter) for derivatives, or (n, width) for gap voltages, which become NaN last
    values: dict[str, FloatArray]
    error: FloatArray  # (n,): Stated error, of outputs relative to themselves
    status: NDArray[np.int8]  # (n,): Index into `STATUS_NAMES`, and -1 before results have been entered
    messages: dict[int, str] = field(default_factory=dict)  # Of the scenes without a result
    ordinary: str = ""  # Why some scenes were not in lockstep

    @property
    def n_ordinary(self) -> int:
        """Number of scenes not in lockstep."""
        return int(np.count_nonzero(self.status != LOCKSTEP))

    @classmethod
    def empty(cls, values: dict[str, FloatArray], n: int) -> Answers:
        """Answers of n scenes, none of them done."""
        return cls(values, np.full(n, np.nan), np.full(n, -1, np.int8))


def task_of(
    circuit: Circuit, outputs: Sequence[str], rtol: float, t_stop: float | None, periods: float | None, periodic: bool,
    points: int, device: str,
) -> Task:  # fmt: skip
    """The checked request; arguments as of `batch`."""
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
    periods, device = 1.0 if periodic else periods, "cpu" if "u_gap" in outputs else device
    return Task(circuit, tuple(outputs), rtol, t_stop, periods, periodic, points, device)


def checked_scenes(circuit: Circuit, parameters: Mapping[str, ArrayLike]) -> dict[str, FloatArray]:
    """Values by path, all of one shape (n_scene,); refused where a path is unknown or a value NaN or out of range."""
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


def frequencies(circuit: Circuit, scenes: Mapping[str, FloatArray], of_skin: bool = False) -> FloatArray:
    """The source's frequency in every scene, Hz: that of several sources together, or the one that a SKIN follows.

    Refused if no source has a period, or several have none in common; a SKIN can follow one source only.
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


def gradients_of(task: Task, gradients: Sequence[str], scenes: Mapping[str, FloatArray], skin: str) -> Task | None:
    """The checked request of derivatives in scenes with these values by path; None for none."""
    circuit = task.circuit
    if isinstance(gradients, str):
        raise InputError(f"gradients is {gradients!r}; allowed: a sequence of paths such as ('Xgap.d',)")
    paths = tuple(own_path(circuit, path) for path in gradients)
    if not paths:
        return None
    outputs = tuple(name for name in task.outputs if name in MEANS)
    if not outputs:
        raise InputError(f"gradients are asked for, and outputs has no mean; allowed: one of {', '.join(MEANS)}")
    if (number := len(circuit.by_device("GAP"))) != 1:
        raise InputError(f"gradients are asked for, and the circuit has {number} GAPs; allowed: one")
    if len(set(paths)) < len(paths):
        raise InputError(f"gradients is {paths!r}; allowed: every parameter once")
    for path in paths:
        value = circuit.parameters[path].value
        if path not in scenes and not (math.isfinite(value) and value != 0.0):
            raise InputError(
                f"gradients names {path}, which is {value:g}; allowed: parameters whose value is finite and not 0, as "
                "steps are relative to it"
            )
    on = driving_sources(circuit)
    clock = f"{on[0].name}.frequency" if len(on) == 1 else None
    skins = tuple(f"{e.name}.f" for e in circuit.by_device("SKIN")) if skin == "follow" else ()
    for path in paths:
        if path in skins or (skins and path != clock and _turns(circuit, path)):
            raise InputError(f"skin='follow', and gradients names {path}, with which the skin's frequency changes; "
                             "allowed: the frequency of the only source, or skin='own'")  # fmt: skip
    together = {path: (path, *(skins if path == clock else ())) for path in paths}
    return replace(task, outputs=outputs, gradients=Gradients(paths, together, clock if clock in paths else None))


def _turns(circuit: Circuit, path: str) -> bool:
    """Whether a parameter changes the frequency of a source."""
    name = path.rpartition(".")[0]
    moved = circuit.varied({path: circuit.parameters[path].value * (1.0 + _SEEN)})
    own, other = circuit[name].waveform, moved[name].waveform
    return own is not None and other is not None and own.tone() != other.tone()
