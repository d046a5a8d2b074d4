"""The request of a batch (`Task`), checked, and its answers (`Answers`).

Which scenes of a batch go in lockstep, what it gives, and the tables of their values for `scenes`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, IntArray, positive_number, real_numbers, whole_number
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.devices import Value
from fingerspice.circuit.statespace import Stack, build_stack, contact_with, is_stack
from fingerspice.circuit.topology import driving_sources
from fingerspice.engine.lockstep.scenes import CELL_ROWS
from fingerspice.physics.contact import N_PACKED
from fingerspice.results.sensitivity import MEANS
from fingerspice.solve.simulation import rtol_given
from fingerspice.waveforms.combinations import AM, Sum
from fingerspice.waveforms.periodic import Pulse, Square
from fingerspice.waveforms.samples import Samples, as_samples
from fingerspice.waveforms.waveform import DC, Sine, require

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


# Parameters that must be equal in all scenes of a lockstep, because the form of the equations depends on them.
_FORM = ("m_exp", "n_exp", "a_fix", "tau")
# Most layers and most tones of a lockstep: code is compiled for each number of cells and of tones.
_MOST_LAYERS, _MOST_TONES = 4, 4
_LAYERS = ("LAYER", "SLAB", "SKIN", "SKIN_DISPERSIVE", "GAP")
# Largest ratio of a tone's frequency to that of the whole source.
_MOST_PERIODS = 2000
# Smallest rtol at which derivatives are taken in lockstep: below it their kinks would take too many steps.
_LEAST_RTOL_OF_SLOPES = 5e-7
_Figure = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
#: For each figure, the indices of the moments that it needs, and the function that gives it from the moments (4, n),
#: the load, the stress at 1 V and the friction coefficient.
FIGURES: dict[str, tuple[tuple[int, ...], _Figure]] = {
    "f_el_mean": ((0,), lambda m, load, stress, mu: stress * m[0]),
    "f_el_rms": ((1,), lambda m, load, stress, mu: stress * np.sqrt(m[1])),
    "f_t_mean": ((0,), lambda m, load, stress, mu: mu * (load + stress * m[0])),
    "f_t_rms": ((0, 1), lambda m, load, stress, mu: mu * _loaded(m, load, stress)),
    "friction_mean": ((0,), lambda m, load, stress, mu: mu * (load + stress * m[0]) / load),
    "friction_rms": ((0, 1), lambda m, load, stress, mu: mu * _loaded(m, load, stress) / load),
    "u_gap_rms": ((2,), lambda m, load, stress, mu: np.sqrt(m[2])),
}


def _loaded(m: FloatArray, load: FloatArray, stress: FloatArray) -> FloatArray:
    """Root mean square of the sum of load and electroadhesive force, N."""
    return np.asarray(np.sqrt(load * load + 2.0 * load * stress * m[0] + stress * stress * m[1]))


@dataclass(frozen=True)
class LockstepForm:
    """Properties that all scenes in lockstep have in common."""

    stack: Stack  # With a gap
    # The sources that are on; each with the sign of the gap along the loop times the sign of the source
    sources: tuple[tuple[Element, float], ...]
    multiples: tuple[int, ...]  # Frequency of every tone of the sources' sum, in that of the sum
    # That of the sum, Hz; None for one source of one tone, whose frequency may vary. For a recording half of its sample
    # rate, so that a sample's length is half a period.
    frequency: float | None
    jumping: bool  # Whether the source is a square
    recording: Samples | None  # The samples of the only source, if it is a recording

    @cached_property
    def gap(self) -> Element:
        """The gap."""
        assert self.stack.gap_layer is not None
        return self.stack.layers[self.stack.gap_layer]

    @property
    def cells(self) -> int:
        """Number of cells of all layers."""
        return self.stack.c.size

    @cached_property
    def places(self) -> tuple[int, int, IntArray]:
        """Number of cells, index of the gap among them, and those of the cells whose leak has a total resistance."""
        assert self.stack.gap is not None
        of_cells = [self.stack.layers[i].device for i in self.stack.layer_of]
        leaks = np.array([i for i, device in enumerate(of_cells) if device in ("LAYER", "GAP")])
        return self.cells, self.stack.gap, leaks


def lockstep_form(circuit: Circuit, varied: Iterable[str]) -> LockstepForm | str:
    """The common form of scenes in lockstep, or the reason why there is none; `varied` has the paths that vary."""
    if not is_stack(circuit):
        return "the circuit is no series stack of layers"
    stack = build_stack(circuit)
    if stack.contact is None or stack.gap is None or stack.area_given is not None:
        return "the stack has no contact whose area follows the gap"
    if not {e.device for e in stack.layers} <= set(_LAYERS) or not 2 <= len(stack.layers) <= _MOST_LAYERS:
        return f"the stack has other layers than {', '.join(_LAYERS)}, or not 2 to {_MOST_LAYERS} of them"
    if (circuit.charge_law or "local") != "local" or circuit.work != "gap":
        return "the charge law is mobile, or the total voltage is held"
    found = _form_of_sources(stack)
    if isinstance(found, str):
        return found
    recording = found.recording
    charged = found.jumping if recording is None else recording.between(0, 1)[0] != 0.0
    varied = [path.lower() for path in varied]
    if not _starts_uncharged(circuit, charged, varied):
        return "the run does not start uncharged, or its figures start late"
    fixed = () if found.frequency is None else ("frequency",)
    may_vary = {e.name.lower(): set(_source_of(e.waveform)[1]).difference(fixed) for e, _ in found.sources}
    layers = {e.name.lower() for e in stack.layers}
    for path in varied:
        name, _, parameter = path.rpartition(".")
        if parameter not in may_vary[name] if name in may_vary else parameter in _FORM or name not in layers:
            return f"{path} varies"
    return found


def _form_of_sources(stack: Stack) -> LockstepForm | str:
    """The form that the sources of a stack allow, whatever varies; or the reason why there is none."""
    assert stack.gap is not None
    sources = tuple((e, float(turn * stack.sign[stack.gap])) for e, turn in stack.sources if e.waveform != DC(0.0))
    waves = [e.waveform for e, _ in sources]
    recording = as_samples(waves[0]) if len(waves) == 1 and waves[0] is not None else None
    if recording is not None:
        if recording.start != 0.0:
            return "the recording does not start at 0 s"
        return LockstepForm(stack, sources, (1,), 0.5 * recording.rate, False, recording)
    jumping = any(isinstance(wave, Square | Pulse) for wave in waves)
    tones = [hz for wave in waves for hz in _source_of(wave)[0]]
    if not (tones and all(tones) and len(tones) <= (1 if jumping else _MOST_TONES)):
        return (
            f"the sources are not 1 to {_MOST_TONES} plain sines, not a square that starts with its period, and not a "
            "recording"
        )
    if len(tones) == 1:
        return LockstepForm(stack, sources, (1,), None, jumping, None)
    period = stack.waveform.period
    if period is None or max(tones) * period > _MOST_PERIODS:
        return "the sources' tones have no common period, or one of very many of their own"
    return LockstepForm(stack, sources, tuple(round(hz * period) for hz in tones), 1.0 / period, False, None)


def why_alone(form: LockstepForm | str, outputs: Iterable[str], slopes_at: float | None = None) -> str:
    """Why outputs, or with `slopes_at` their derivatives at that rtol, need runs of their own; '' in lockstep."""
    if isinstance(form, str):
        return form
    if slopes_at is not None and form.recording is not None:
        return "the source is a recording"
    # Of a recording no last period is kept.
    suffix = "_periodic" if form.recording is None else ""
    others = [name for name in outputs if name != "u_gap" and name.removesuffix(suffix) not in FIGURES]
    if others:
        return f"{', '.join(others)} needs a run of its own"
    if slopes_at is not None and slopes_at < _LEAST_RTOL_OF_SLOPES:
        return f"rtol is below {_LEAST_RTOL_OF_SLOPES:g}"
    return ""


def in_lockstep_by(circuit: Circuit, paths: Iterable[str], outputs: Iterable[str], rtol: float) -> bool:
    """Whether derivatives of outputs by parameters, with the values of all `paths` varying, can be those of lockstep.

    If not, a batch takes the derivatives of single runs, besides a run for every scene's outputs.
    """
    return not why_alone(lockstep_form(circuit, paths), outputs, rtol)


def _source_of(wave: object) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Frequencies of a source's tones from t = 0 on, and its parameters that may vary; 0 Hz of one without such tones.

    A square that starts with its period counts as one tone.
    """
    match wave:
        case AM():
            sides = wave.carrier - wave.modulation, wave.carrier + wave.modulation
            return (wave.carrier, *sides), ("amplitude", "depth", "phase_deg")
        case Sine(offset=0.0, delay=0.0, damping=0.0):
            return (wave.frequency,), ("amplitude", "frequency", "phase_deg")
        case Square(half_wave=True, phase_deg=0.0, delay=0.0):
            return (wave.frequency,), ("amplitude", "frequency")
        case Pulse(half_wave=True, rise=0.0, delay=0.0):
            return (wave.tone() or 0.0,), ()
    return (0.0,), ()


def _starts_uncharged(circuit: Circuit, charged: bool, varied: Iterable[str]) -> bool:
    """Whether the uncharged state starts all runs; `charged`: whether the source is not 0 V there."""
    tran = circuit.tran
    if circuit.initial or any(e.initial is not None for e in circuit.elements) or (tran and tran.start > 0.0):
        return False
    if tran is None or tran.uic:
        return True
    # The operating point of sines that start at 0 V is the uncharged state.
    phases = [getattr(e.waveform, "phase_deg", 0.0) for e in circuit.by_device("V") if not isinstance(e.waveform, AM)]
    return not charged and not any(phases) and not any(path.endswith(".phase_deg") for path in varied)


def _tones_of(wave: object, given: Mapping[str, Value]) -> list[tuple[Value, Value]]:
    """Amplitude (V) and phase (rad) of the tones of a source, in the order of `_source_of`; `given` has what varies."""

    def value(name: str) -> Value:
        return given.get(name, getattr(wave, name, 0.0))

    if isinstance(wave, Pulse):
        return [(wave.v2, 0.0)]
    if isinstance(wave, AM):
        # sin(x) sin(y) is half of cos(x - y) = sin(x - y + pi/2) and of -cos(x + y) = sin(x + y - pi/2).
        depth, turn = value("depth"), np.radians(value("phase_deg"))
        share = value("amplitude") / (1.0 + depth)
        side = 0.5 * depth * share
        return [(share, 0.0), (side, 0.5 * np.pi - turn), (side, turn - 0.5 * np.pi)]
    return [(value("amplitude"), np.radians(value("phase_deg")))]


def table_of(form: LockstepForm, scenes: Mapping[str, FloatArray]) -> FloatArray:
    """The table of some scenes as `engine.lockstep.march.march` takes it, shape (n_row, n).

    `scenes` has values by path in lower case, in the netlist's units; all others are the circuit's.
    """

    def values(element: Element) -> dict[str, Any]:
        start = f"{element.name.lower()}."
        given = {path.removeprefix(start): array for path, array in scenes.items() if path.startswith(start)}
        return {**element.values, **given}

    n = next(iter(scenes.values())).size
    others = CELL_ROWS * form.cells
    out = np.empty((others + N_PACKED + 1 + 2 * len(form.multiples), n))
    of_cells, cell = out[:others].reshape(CELL_ROWS, form.cells, n), 0
    for layer, count in zip(form.stack.layers, form.stack.cells, strict=True):
        assert layer.spec.cells is not None
        cells = layer.spec.cells(values(layer), None)
        of_cells[:, cell : cell + count] = np.moveaxis(cells.reshape(count, CELL_ROWS, -1), 0, 1)
        cell += count
    first = form.sources[0][0]
    period = first.waveform.period if first.waveform is not None else None
    frequency = form.frequency or values(first).get("frequency", 1.0 / (period or math.nan))
    rows = [*contact_with(values(form.gap)).packed, 2.0 * np.pi * np.asarray(frequency)]
    for element, sign in form.sources:
        recorded = None if form.recording is None else [(peak_of(form.recording), 0.0)]
        for amplitude, phase in recorded or _tones_of(element.waveform, values(element)):
            rows += [sign * amplitude * np.cos(phase), sign * amplitude * np.sin(phase)]
    for i, row in enumerate(rows):
        out[others + i] = row
    return out


def peak_of(recording: Samples) -> float:
    """Largest sample, V; 1 V if all are 0."""
    return float(np.abs(recording.values).max()) or 1.0
