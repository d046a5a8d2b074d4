"""Choice of the scenes of a batch that are integrated in lockstep, and their tables for `engine.lockscenes`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial import chebyshev as powers

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.statespace import build_stack, is_stack
from fingerspice.engine.lockscenes import CELL_ROWS, LARGEST_X, N_OTHERS
from fingerspice.numerics import chebyshev
from fingerspice.physics.contact import universal_curve_array
from fingerspice.physics.ladder import SKIN_LADDER
from fingerspice.physics.materials import EPS0, skin_permittivity, skin_resistivity
from fingerspice.waveforms.combinations import AM
from fingerspice.waveforms.periodic import Pulse, Square
from fingerspice.waveforms.recorded import as_samples
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import DC, Sine, Waveform

Value = float | FloatArray
Curves = tuple[FloatArray, FloatArray, FloatArray]
Cell = tuple[Value, Value, Value]
# Parameters that must be equal in all scenes of a lockstep, because the form of the equations depends on them.
_FORM = ("m_exp", "n_exp", "a_fix", "tau")
# Most layers and most tones of a lockstep: code is compiled for each number of cells and of tones.
_MOST_LAYERS, _MOST_TONES = 4, 4
_SKIN_CELLS = SKIN_LADDER.cells()[0].size
_LAYERS = ("LAYER", "SLAB", "SKIN", "SKIN_DISPERSIVE", "GAP")
# Largest ratio of a tone's frequency to that of the whole source.
_MOST_PERIODS = 2000
# Numbers of points tried for the universal curve's Chebyshev series, and the relative error allowed.
_CURVE_SIZES, _CURVE_ERROR = (16, 20, 24, 28), 1e-13


@dataclass(frozen=True)
class LockstepForm:
    """Properties that all scenes in lockstep have in common."""

    layers: tuple[Element, ...]  # Layers in the order of the loop
    gap: int  # Index of the gap among them
    # The sources that are on; each with the sign of the gap along the loop times the sign of the source
    sources: tuple[tuple[Element, float], ...]
    multiples: tuple[int, ...]  # Frequency of every tone of the sources' sum, in that of the sum
    # That of the sum, Hz; None for one source of one tone, whose frequency may vary. For a recording half of its sample
    # rate, so that a sample's length is half a period.
    frequency: float | None
    jumping: bool  # Whether the source is a square
    recording: Samples | None = None  # The samples of the only source, if it is a recording

    @property
    def layer(self) -> Element:
        """The gap."""
        return self.layers[self.gap]

    @cached_property
    def layer_of_cells(self) -> tuple[Element, ...]:
        """The layer of every cell."""
        return tuple(e for e in self.layers for _ in range(_SKIN_CELLS if e.device == "SKIN_DISPERSIVE" else 1))

    @property
    def cells(self) -> int:
        """Number of cells of all layers."""
        return len(self.layer_of_cells)

    @property
    def gap_cell(self) -> int:
        """Index of the gap among the cells."""
        return self.layer_of_cells.index(self.layer)

    @property
    def leaks(self) -> tuple[int, ...]:
        """Indices of the cells whose leak has a total resistance."""
        return tuple(i for i, e in enumerate(self.layer_of_cells) if e.device in ("LAYER", "GAP"))


def lockstep_form(circuit: Circuit, varied: Mapping[str, object]) -> LockstepForm | str:
    """The common form of scenes in lockstep, or the reason why there is none; `varied` has the paths that vary."""
    if not is_stack(circuit):
        return "the circuit is no series stack of layers"
    stack = build_stack(circuit)
    gap = stack.gap_layer
    if stack.contact is None or gap is None or stack.area_given is not None:
        return "the stack has no contact whose area follows the gap"
    if not {e.device for e in stack.layers} <= set(_LAYERS) or not 2 <= len(stack.layers) <= _MOST_LAYERS:
        return f"the stack has other layers than {', '.join(_LAYERS)}, or not 2 to {_MOST_LAYERS} of them"
    if (circuit.charge_law or "local") != "local" or circuit.work != "gap":
        return "the charge law is mobile, or the total voltage is held"
    sources = tuple((e, float(turn * stack.sign[stack.gap])) for e, turn in stack.sources if e.waveform != DC(0.0))
    waves = [e.waveform for e, _ in sources]
    jumping = len(waves) == 1 and isinstance(waves[0], Square | Pulse)
    recording = as_samples(waves[0]) if len(waves) == 1 and waves[0] is not None else None
    tones = [] if recording else [hz for wave in waves for hz in _tones(wave)]
    if recording is not None and recording.start != 0.0:
        return "the recording does not start at 0 s"
    if recording is None and not (
        _plain_square(waves[0]) if jumping else tones and all(tones) and len(tones) <= _MOST_TONES
    ):
        return (
            f"the sources are not 1 to {_MOST_TONES} plain sines, not a square that starts with its period, and not a "
            "recording"
        )
    multiples: tuple[int, ...] = (1,)
    frequency: float | None = None
    if len(tones) > 1:
        period = stack.waveform.period
        if period is None or max(tones) * period > _MOST_PERIODS:
            return "the sources' tones have no common period, or one of very many of their own"
        multiples, frequency = tuple(round(hz * period) for hz in tones), 1.0 / period
    if recording is not None:
        frequency = 0.5 * recording.rate
    charged = jumping if recording is None else recording.between(0, 1)[0] != 0.0
    if not _starts_uncharged(circuit, charged, varied):
        return "the run does not start uncharged, or its figures start late"
    layers, on = {e.name.lower() for e in stack.layers}, {e.name.lower(): e.waveform for e, _ in sources}
    for path in varied:
        name, _, parameter = path.rpartition(".")
        if (parameter not in _varies(on[name], frequency)) if name in on else parameter in _FORM or name not in layers:
            return f"{path} varies"
    return LockstepForm(stack.layers, gap, sources, multiples, frequency, jumping, recording)


def _tones(wave: object) -> tuple[float, ...]:
    """Frequencies of a source without offset that consists of sines from t = 0 on; a zero for any other."""
    if isinstance(wave, AM):
        return (wave.carrier, wave.carrier - wave.modulation, wave.carrier + wave.modulation)
    if isinstance(wave, Sine) and wave.offset == 0.0 and wave.delay == 0.0 and wave.damping == 0.0:
        return (wave.frequency,)
    return (0.0,)


def _plain_square(wave: object) -> bool:
    """Whether a square has no offset and its period begins at t = 0."""
    if isinstance(wave, Pulse):
        return wave.half_wave and wave.rise == 0.0 and wave.delay == 0.0
    return isinstance(wave, Square) and wave.half_wave and wave.phase_deg == 0.0 and wave.delay == 0.0


def _varies(wave: object, frequency: float | None) -> tuple[str, ...]:
    """Parameters of a source that may vary from scene to scene."""
    if isinstance(wave, AM):
        return ("amplitude", "depth", "phase_deg")
    if not isinstance(wave, Sine | Square):
        return ()
    may_vary = {"amplitude": True, "frequency": frequency is None, "phase_deg": isinstance(wave, Sine)}
    return tuple(name for name, allowed in may_vary.items() if allowed)


def _starts_uncharged(circuit: Circuit, charged: bool, varied: Mapping[str, object]) -> bool:
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
    """Amplitude (V) and phase (rad) of the tones of a source, in the order of `_tones`; `given` has what varies."""

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
    """The table of some scenes as `engine.lockmarch.march` takes it, shape (n_row, n).

    Parameters
    ----------
    form : LockstepForm
    scenes : mapping of str to ndarray, shape (n,)
        Values by path in lower case, in the netlist's units; all other values are the circuit's.
    """

    def given(element: Element) -> dict[str, Value]:
        start = f"{element.name.lower()}."
        return {path.removeprefix(start): array for path, array in scenes.items() if path.startswith(start)}

    count = form.cells
    out = np.empty((CELL_ROWS * count + N_OTHERS + 2 * len(form.multiples), next(iter(scenes.values())).size))
    cell = 0
    for layer in form.layers:
        for c, g, g_area in _CELLS_OF[layer.device](dict(layer.values) | given(layer)):
            out[cell], out[count + cell], out[2 * count + cell] = c, g, g_area
            cell += 1
    first = form.sources[0][0]
    frequency = form.frequency or given(first).get("frequency", 1.0 / (_period(first.waveform)))
    rows = [*_contact_rows(dict(form.layer.values) | given(form.layer)), 2.0 * np.pi * np.asarray(frequency)]
    for element, sign in form.sources:
        tones = (
            _tones_of(element.waveform, given(element)) if form.recording is None else [(peak_of(form.recording), 0.0)]
        )
        for amplitude, phase in tones:
            rows += [sign * amplitude * np.cos(phase), sign * amplitude * np.sin(phase)]
    for i, row in enumerate(rows):
        out[CELL_ROWS * count + i] = row
    return out


def peak_of(recording: Samples) -> float:
    """Largest sample, V; 1 V if all are 0."""
    return float(np.abs(recording.values).max()) or 1.0


def _period(wave: Waveform | None) -> float:
    assert wave is not None
    assert wave.period is not None
    return wave.period


def _layer(v: Mapping[str, Value]) -> list[Cell]:
    return [(EPS0 * v["eps_r"] / v["d"], 1.0 / v["r"], 0.0)]


def _slab(v: Mapping[str, Value]) -> list[Cell]:
    return [(EPS0 * v["eps_r"] / v["d"], 0.0, 1.0 / (v["rho"] * v["d"]))]


def _skin(v: Mapping[str, Value]) -> list[Cell]:
    return _slab({"d": v["d"], "eps_r": skin_permittivity(v["f"]), "rho": skin_resistivity(v["f"])})


def _dispersive(v: Mapping[str, Value]) -> list[Cell]:
    ladder = zip(*SKIN_LADDER.cells(), strict=True)
    return [cell for eps_r, rho in ladder for cell in _slab({"d": v["d"], "eps_r": eps_r, "rho": rho})]


#: As `Element.spec.cells`, for arrays of values: capacitance per area, total leakage and leakage per area of each cell.
_CELLS_OF: dict[str, Callable[[Mapping[str, Value]], list[Cell]]] = {
    "LAYER": _layer, "GAP": _layer, "SLAB": _slab, "SKIN": _skin, "SKIN_DISPERSIVE": _dispersive,
}  # fmt: skip


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
