"""Which scenes of a batch go in lockstep, what it gives, and the tables of their values for `scenes`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev as powers

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.devices import Value
from fingerspice.circuit.statespace import Stack, build_stack, is_stack
from fingerspice.engine.lockstep.scenes import CELL_ROWS, LARGEST_X, N_OTHERS
from fingerspice.numerics import chebyshev
from fingerspice.physics.contact import universal_curve_array
from fingerspice.physics.materials import EPS0
from fingerspice.waveforms.combinations import AM
from fingerspice.waveforms.periodic import Pulse, Square
from fingerspice.waveforms.samples import Samples, as_samples
from fingerspice.waveforms.waveform import DC, Sine

Curves = tuple[FloatArray, FloatArray, FloatArray]
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
    def places(self) -> tuple[int, IntArray]:
        """Index of the gap among the cells, and those of the cells whose leak has a total resistance."""
        assert self.stack.gap is not None
        of_cells = [self.stack.layers[self.stack.layer_of[i]].device for i in range(self.cells)]
        return self.stack.gap, np.array([i for i, device in enumerate(of_cells) if device in ("LAYER", "GAP")])


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
    out = np.empty((CELL_ROWS * form.cells + N_OTHERS + 2 * len(form.multiples), n))
    of_cells, cell = out[: CELL_ROWS * form.cells].reshape(CELL_ROWS, form.cells, n), 0
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
        recorded = None if form.recording is None else [(peak_of(form.recording), 0.0)]
        for amplitude, phase in recorded or _tones_of(element.waveform, values(element)):
            rows += [sign * amplitude * np.cos(phase), sign * amplitude * np.sin(phase)]
    for i, row in enumerate(rows):
        out[CELL_ROWS * form.cells + i] = row
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
def curves_of(m: float, n: float, degree: int) -> Curves | None:
    """Power series of the universal curve of two exponents, Chebyshev nodes and matrix of a degree, as for `march`.

    None if no series of the allowed sizes reaches the error allowed.
    """
    p = 0.5 * (1.0 + 1.0 / m - 1.0 / n)

    def curve(x: FloatArray) -> FloatArray:
        return universal_curve_array(x, 1.0 / m, p)

    series = chebyshev.fit(curve, 0.0, LARGEST_X, _CURVE_ERROR, _CURVE_SIZES)
    if series is None:
        return None
    at = chebyshev.nodes(degree + 1, -1.0, 1.0)
    to_series = chebyshev.coefficients(np.eye(degree + 1))
    to_powers = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        to_powers[: k + 1, k] = powers.cheb2poly(np.eye(degree + 1)[k, : k + 1])
    highest_first = np.ascontiguousarray((to_powers @ to_series)[::-1])
    return np.ascontiguousarray(powers.cheb2poly(series)[::-1]), at, highest_first
