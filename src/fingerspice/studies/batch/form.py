"""The request of a batch, checked, with its answers (`Task`); what goes in lockstep, and the table of its values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev as powers
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, positive_number, real_numbers, whole_number
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.devices import Value
from fingerspice.circuit.statespace import Stack, build_stack, driving_sources, is_stack
from fingerspice.engine.lockstep.scenes import CELL_ROWS, LARGEST_X, N_OTHERS
from fingerspice.numerics import chebyshev
from fingerspice.physics.contact import universal_curve_array
from fingerspice.physics.materials import EPS0
from fingerspice.results.solution import MEANS
from fingerspice.solve.simulation import rtol_given
from fingerspice.waveforms.periodic import Pulse, Square
from fingerspice.waveforms.samples import Samples, as_samples
from fingerspice.waveforms.waveform import AM, DC, Sine, Sum, require

#: Signals whose figures a batch has, and the kinds of figures.
SIGNALS_OF_BATCH = ("f_el", "f_t", "friction", "u_gap", "area")
_KINDS = ("mean", "rms", "min", "max", "peak", "mean_periodic", "rms_periodic", "ripple", "amplitude", "phase_deg")
LEAST_RTOL = 1e-12
LOCKSTEP, ONE_BY_ONE, REFUSED, FAILED = 0, 1, 2, 3
STATUS_NAMES = ("lockstep", "one_by_one", "refused", "failed")
# A relative change of a parameter by which it is seen whether the source's tone depends on it.
_SEEN = 1e-3
#: For each figure that lockstep gives, the moments that it needs: the means of u^2 A (0), (u^2 A)^2 (1) and u^2 (2).
FIGURES: dict[str, tuple[int, ...]] = {
    "f_el_mean": (0,), "f_el_rms": (1,), "f_t_mean": (0,), "f_t_rms": (0, 1), "friction_mean": (0,),
    "friction_rms": (0, 1), "u_gap_rms": (2,),
}  # fmt: skip
# Parameters that must be equal in all scenes of a lockstep, because the form of the equations depends on them.
_FORM = ("m_exp", "n_exp", "a_fix", "tau")
# Most layers and most tones of a lockstep: code is compiled for each number of cells and of tones.
_MOST_LAYERS, _MOST_TONES = 4, 4
_LAYERS = ("LAYER", "SLAB", "SKIN", "SKIN_DISPERSIVE", "GAP")
# Largest ratio of a tone's frequency to that of the whole source.
_MOST_PERIODS = 2000
# Numbers of points tried for the universal curve's Chebyshev series, and the relative error allowed.
_CURVE_SIZES, _CURVE_ERROR = (16, 20, 24, 28), 1e-13
# Smallest rtol at which derivatives are taken in lockstep: below it their kinks would take too many steps.
_LEAST_RTOL_OF_SLOPES = 5e-7


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
            if name not in ("u_gap", *(f"{signal}_{kind}" for signal in SIGNALS_OF_BATCH for kind in _KINDS)):
                kinds, signals = ", ".join(f"_{kind}" for kind in _KINDS), ", ".join(SIGNALS_OF_BATCH)
                raise InputError(f"unknown output {name!r}; allowed: u_gap, or one of {signals} with one of {kinds}")
        require(bool(self.outputs), "outputs", "empty", "one or more names")
        self.traced = "u_gap" in self.outputs
        # Gap voltages stay on the processor.
        self.device = "cpu" if self.traced else device
        if periods is not None and t_stop is not None:
            raise InputError("t_stop and periods are both given; allowed: one of them")
        self.t_stop = None if t_stop is None else positive_number("t_stop", t_stop, "s")
        self.periods = None if periods is None else positive_number("periods", periods)
        if periodic and (periods is not None or t_stop is not None):
            raise InputError("periodic=True takes one period, and t_stop or periods is given; allowed: neither")
        if periodic:
            self.periods = 1.0
        elif periods is None and t_stop is None:
            if circuit.tran is None:
                raise InputError("no t_stop: the deck has no .tran line and none was given; give t_stop in s, or "
                                 "periods")  # fmt: skip
            self.t_stop = circuit.tran.stop
        # Parameters by which the means are differentiated, in the circuit's spelling, each with those that grow in
        # proportion to it: a source's frequency with that of a skin
        self.paths: dict[str, tuple[str, ...]] = {}
        self.clock: str | None = None  # The frequency of the only source, if it is one of `paths`

    def begin(self, values: dict[str, FloatArray]) -> None:
        """Take these arrays for the values; no scene is done."""
        self.values, self.error, self.status = values, np.full(self.n, np.nan), np.full(self.n, -1, np.int8)
        self.messages, self.ordinary = {}, ""

    def count(self, frequency: FloatArray) -> FloatArray:
        """Number of periods in runs with sources of these frequencies (Hz)."""
        return np.full(self.n, self.periods) if self.t_stop is None else np.asarray(frequency * self.t_stop)

    def frequencies(self, of_skin: bool = False) -> FloatArray:
        """The source's frequency in every scene, Hz: that of several together, or the one that a SKIN follows."""
        on = [e for e in driving_sources(self.circuit) if e.waveform is not None and e.waveform.period is not None]
        waves = [e.waveform for e in on if e.waveform is not None]
        if len(on) == 1:
            given = self.scenes.get(f"{on[0].name}.frequency")
            tone = waves[0].tone() if of_skin else None
            return given if given is not None else np.full(self.n, tone or 1.0 / (waves[0].period or math.nan))
        moved = any(f"{e.name}.frequency" in self.scenes for e in on)
        period = None if of_skin or moved or not on else Sum(tuple(waves)).period
        if period is None:
            raise InputError(f"{len(on)} sources have a period; allowed: one, where periods, u_gap or the skin's "
                             "frequency follow it, or several of fixed frequencies in a ratio of whole "
                             "numbers")  # fmt: skip
        return np.full(self.n, 1.0 / period)


def checked_scenes(circuit: Circuit, parameters: Mapping[str, ArrayLike]) -> dict[str, FloatArray]:
    """Values by path, all of one shape (n_scene,); refused where a path is unknown or a value NaN or out of range."""
    given: dict[str, FloatArray] = {}
    good = isinstance(parameters, Mapping) and bool(parameters)
    require(good, "parameters", repr(parameters), "a mapping such as {'Xgap.d': [3e-6, 4e-6]}")
    for path, values in parameters.items():
        name = own_path(circuit, path)
        array = real_numbers(path, values, "an array of numbers")
        one_row = array.ndim <= 1 and array.size > 0
        require(one_row, path, f"of shape {array.shape}", "one number, or one row of numbers")
        require(name not in given, name, "given twice", "once")
        given[name] = array
    sizes = {path: array.size for path, array in given.items() if array.ndim == 1}
    if len(set(sizes.values())) > 1:
        raise InputError(f"the arrays have {', '.join(f'{n} ({p})' for p, n in sizes.items())} values; allowed: equal "
                         "lengths, or single numbers")  # fmt: skip
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


def gradients_of(task: Task, gradients: Sequence[str], skin: str) -> Task | None:
    """The checked request of derivatives in the scenes of a task; None for none."""
    circuit = task.circuit
    require(not isinstance(gradients, str), "gradients", repr(gradients), "a sequence of paths such as ('Xgap.d',)")
    paths = tuple(own_path(circuit, path) for path in gradients)
    if not paths:
        return None
    outputs = tuple(name for name in task.outputs if name in MEANS)
    if not outputs:
        raise InputError(f"gradients are asked for, and outputs has no mean; allowed: one of {', '.join(MEANS)}")
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
        if turned:
            raise InputError(f"skin='follow', and gradients names {path}, with which the skin's frequency changes; "
                             "allowed: the frequency of the only source, or skin='own'")  # fmt: skip
    asked = copy(task)
    asked.outputs, asked.traced, asked.scenes, asked.clock = outputs, False, scenes, clock if clock in paths else None
    asked.paths = {path: (path, *(skins if path == clock else ())) for path in paths}
    return asked


@dataclass(frozen=True)
class LockstepForm:
    """Properties that all scenes in lockstep have in common."""

    stack: Stack
    gap: Element
    # The sources that are on; each with the sign of the gap along the loop times the sign of the source
    sources: tuple[tuple[Element, float], ...]
    multiples: tuple[int, ...]  # Frequency of every tone of the sources' sum, in that of the sum
    # That of the sum, Hz; None for one source of one tone, whose frequency may vary. For a recording half of its sample
    # rate, so that a sample's length is half a period.
    frequency: float | None
    jumping: bool  # Whether the source is a square
    recording: Samples | None  # The samples of the only source, if it is a recording

    @property
    def cells(self) -> int:
        """Number of cells of all layers."""
        return self.stack.c.size


def lockstep_form(circuit: Circuit, varied: Iterable[str]) -> LockstepForm | str:
    """The common form of scenes in lockstep, or the reason why there is none; `varied` has the paths that vary."""
    if not is_stack(circuit):
        return "the circuit is no series stack of layers"
    stack, tran = build_stack(circuit), circuit.tran
    if stack.contact is None or stack.gap is None or stack.gap_layer is None or stack.area_given is not None:
        return "the stack has no contact whose area follows the gap"
    if not {e.device for e in stack.layers} <= set(_LAYERS) or not 2 <= len(stack.layers) <= _MOST_LAYERS:
        return f"the stack has other layers than {', '.join(_LAYERS)}, or not 2 to {_MOST_LAYERS} of them"
    if (circuit.charge_law or "local") != "local" or circuit.work != "gap":
        return "the charge law is mobile, or the total voltage is held"
    sources = tuple((e, float(turn * stack.sign[stack.gap])) for e, turn in stack.sources if e.waveform != DC(0.0))
    waves = [e.waveform for e, _ in sources]
    recording = as_samples(waves[0]) if len(waves) == 1 and waves[0] is not None else None
    jumping = recording is None and any(isinstance(wave, Square | Pulse) for wave in waves)
    tones = [hz for wave in waves for hz, *_ in _tones_of(wave, {})[0]]
    multiples: tuple[int, ...] = (1,)
    frequency, charged = None, jumping
    if recording is not None:
        if recording.start != 0.0:
            return "the recording does not start at 0 s"
        frequency, charged = 0.5 * recording.rate, recording.between(0, 1)[0] != 0.0
    elif not (tones and all(tones) and len(tones) <= (1 if jumping else _MOST_TONES)):
        said = f"the sources are not 1 to {_MOST_TONES} plain sines, not a square that starts with its period"
        return f"{said}, and not a recording"
    elif len(tones) > 1:
        period = stack.waveform.period
        if period is None or max(tones) * period > _MOST_PERIODS:
            return "the sources' tones have no common period, or one of very many of their own"
        multiples, frequency = tuple(round(hz * period) for hz in tones), 1.0 / period
    varied = [path.lower() for path in varied]
    given = circuit.initial or any(e.initial is not None for e in circuit.elements)
    if tran is not None and not tran.uic:
        # The operating point of sines that start at 0 V is the uncharged state.
        others = [e.waveform for e in circuit.by_device("V") if not isinstance(e.waveform, AM)]
        charged = charged or any(getattr(wave, "phase_deg", 0.0) for wave in others)
        given = given or charged or any(path.endswith(".phase_deg") for path in varied)
    if given or (tran is not None and tran.start > 0.0):
        return "the run does not start uncharged, or its figures start late"
    fixed = () if frequency is None else ("frequency",)
    may_vary = {e.name.lower(): set(_tones_of(e.waveform, {})[1]).difference(fixed) for e, _ in sources}
    layers = {e.name.lower() for e in stack.layers}
    for path in varied:
        name, _, parameter = path.rpartition(".")
        if parameter not in may_vary[name] if name in may_vary else parameter in _FORM or name not in layers:
            return f"{path} varies"
    return LockstepForm(stack, stack.layers[stack.gap_layer], sources, multiples, frequency, jumping, recording)


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


def _tones_of(wave: object, given: Mapping[str, Value]) -> tuple[list[tuple[float, Value, Value]], tuple[str, ...]]:
    """Frequency (Hz; 0 of no tone), amplitude (V) and phase (rad) of a source's tones, and parameters that may vary."""
    height, depth, phase = (given.get(name, getattr(wave, name, 0.0)) for name in ("amplitude", "depth", "phase_deg"))
    turn: Value = np.radians(phase)
    match wave:
        case AM():
            # sin(x) sin(y) is half of cos(x - y) = sin(x - y + pi/2) and of -cos(x + y) = sin(x + y - pi/2).
            share, quarter = height / (1.0 + depth), 0.5 * np.pi
            side, low, high = 0.5 * depth * share, wave.carrier - wave.modulation, wave.carrier + wave.modulation
            tones = [(wave.carrier, share, 0.0), (low, side, quarter - turn), (high, side, turn - quarter)]
            return tones, ("amplitude", "depth", "phase_deg")
        case Sine(offset=0.0, delay=0.0, damping=0.0):
            return [(wave.frequency, height, turn)], ("amplitude", "frequency", "phase_deg")
        case Square(half_wave=True, phase_deg=0.0, delay=0.0):
            return [(wave.frequency, height, turn)], ("amplitude", "frequency")
        case Pulse(half_wave=True, rise=0.0, delay=0.0):
            return [(wave.tone() or 0.0, wave.v2, 0.0)], ()
    return [(0.0, 0.0, 0.0)], ()


def table_of(form: LockstepForm, scenes: Mapping[str, FloatArray]) -> FloatArray:
    """The table (n_row, n) that `engine.lockstep.march` takes of scenes, which are values by path in lower case."""

    def values(element: Element) -> dict[str, Any]:
        start = f"{element.name.lower()}."
        given = {path.removeprefix(start): array for path, array in scenes.items() if path.startswith(start)}
        return {**element.values, **given}

    n, others = next(iter(scenes.values())).size, CELL_ROWS * form.cells
    out = np.empty((others + N_OTHERS + 2 * len(form.multiples), n))
    of_cells, cell = out[:others].reshape(CELL_ROWS, form.cells, n), 0
    for layer, count in zip(form.stack.layers, form.stack.cells, strict=True):
        assert layer.spec.cells is not None
        cells = layer.spec.cells(values(layer), None)
        of_cells[:, cell : cell + count] = np.moveaxis(cells.reshape(count, CELL_ROWS, -1), 0, 1)
        cell += count
    first = form.sources[0][0]
    period = first.waveform.period if first.waveform is not None else None
    frequency = form.frequency or values(first).get("frequency", 1.0 / (period or math.nan))
    rows = [*_contact_rows(values(form.gap)), 2.0 * np.pi * np.asarray(frequency)]
    for element, sign in form.sources:
        recorded = None if form.recording is None else [(0.0, peak_of(form.recording), 0.0)]
        for _, amplitude, phase in recorded or _tones_of(element.waveform, values(element))[0]:
            rows += [sign * amplitude * np.cos(phase), sign * amplitude * np.sin(phase)]
    for i, row in enumerate(rows):
        out[others + i] = row
    return out


def peak_of(recording: Samples) -> float:
    """Largest sample, V; 1 V if all are 0."""
    return float(np.abs(recording.values).max()) or 1.0


def _contact_rows(v: Mapping[str, Value]) -> tuple[Value, ...]:
    """As `Contact.packed`, for arrays of values: X at 1 V, A0, stress at 1 V, load, c2 mu^2."""
    m, n, f_n, d = v["m_exp"], v["n_exp"], np.asarray(v["fn"]), v["d"]
    p = 0.5 * (1.0 + 1.0 / m - 1.0 / n)
    alpha, beta = np.asarray(v["alpha"]) * 1e-6, np.asarray(v["beta"]) * 1e-6 * 1e3**n
    area = alpha * f_n**m
    per_volt = EPS0 * v["eps_r"] / d
    xi = np.sqrt(per_volt * (n * n / (n - m)) * beta ** (1.0 / n) * alpha ** (-1.0 / m)) * area**p / f_n
    return xi, area, 0.5 * per_volt / d, f_n, v["c2"] * 1e-12 * np.asarray(v["mu"]) ** 2


@lru_cache(maxsize=32)
def curves_of(m: float, n: float, degree: int) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Power series of the universal curve, if there is one, Chebyshev nodes and matrix of a degree, as for `march`."""
    p = 0.5 * (1.0 + 1.0 / m - 1.0 / n)
    series = chebyshev.fit(lambda x: universal_curve_array(x, 1.0 / m, p), 0.0, LARGEST_X, _CURVE_ERROR, _CURVE_SIZES)
    if series is None:
        return None
    to_powers = np.zeros((degree + 1, degree + 1))
    for k, one in enumerate(np.eye(degree + 1)):
        to_powers[: k + 1, k] = powers.cheb2poly(one[: k + 1])
    highest_first = (to_powers @ chebyshev.coefficients(np.eye(degree + 1)))[::-1]
    at = chebyshev.nodes(degree + 1, -1.0, 1.0)
    return np.ascontiguousarray(powers.cheb2poly(series)[::-1]), at, np.ascontiguousarray(highest_first)
