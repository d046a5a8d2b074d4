"""Choice of the scenes of a batch that are integrated in lockstep, and their tables for `engine.lockscenes`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev as powers

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.statespace import build_stack, is_stack
from fingerspice.engine.lockscenes import CELL_ROWS, LARGEST_X, N_OTHERS
from fingerspice.numerics import chebyshev
from fingerspice.physics.contact import universal_curve_array
from fingerspice.physics.materials import EPS0, skin_permittivity, skin_resistivity
from fingerspice.waveforms.periodic import Pulse, Square
from fingerspice.waveforms.waveform import DC, Sine

Value = float | FloatArray
Curves = tuple[FloatArray, FloatArray, FloatArray]
# Parameters that must be equal in all scenes of a lockstep, because the form of the equations depends on them.
_FORM = ("m_exp", "n_exp", "a_fix", "tau")
_OF_SOURCE = ("amplitude", "frequency", "phase_deg")
# Numbers of cells for which a lockstep exists; each number is compiled separately.
_CELLS = (2, 3, 4)
# Numbers of points tried for the universal curve's Chebyshev series, and the relative error allowed.
_CURVE_SIZES, _CURVE_ERROR = (16, 20, 24, 28), 1e-13


@dataclass(frozen=True)
class LockstepForm:
    """Properties that all scenes in lockstep have in common.

    Attributes
    ----------
    layers : tuple of Element
        Layers in the order of the loop.
    gap : int
        Index of the gap among them.
    sign : float
        Sign of the gap along the loop times the sign of the source.
    source : Element
    jumping : bool
        Whether the source is a square.
    """

    layers: tuple[Element, ...]
    gap: int
    sign: float
    source: Element
    jumping: bool


def lockstep_form(circuit: Circuit, varied: Mapping[str, object]) -> LockstepForm | str:
    """The common form of scenes in lockstep, or the reason why there is none; `varied` has the paths that vary."""
    if not is_stack(circuit):
        return "the circuit is no series stack of layers"
    stack = build_stack(circuit)
    devices = {e.device for e in stack.layers}
    if stack.contact is None or stack.gap is None or stack.area_given is not None:
        return "the stack has no contact whose area follows the gap"
    if not devices <= {"LAYER", "SLAB", "SKIN", "GAP"} or len(stack.layers) not in _CELLS:
        return f"the stack has other layers than LAYER, SLAB, SKIN and GAP, or not {_CELLS[0]} to {_CELLS[-1]} of them"
    if (circuit.charge_law or "local") != "local" or circuit.work != "gap":
        return "the charge law is mobile, or the total voltage is held"
    on = [(e, sign) for e, sign in stack.sources if e.waveform != DC(0.0)]
    if len(on) != 1 or not _plain(on[0][0].waveform):
        return "the source is not one plain sine, or one plain square that starts with its period"
    source, turn = on[0]
    jumping = not isinstance(source.waveform, Sine)
    if not _starts_uncharged(circuit, jumping, varied):
        return "the run does not start uncharged, or its figures start late"
    for path in varied:
        name, _, parameter = path.rpartition(".")
        fixed = None
        if name == source.name.lower():
            fixed = () if isinstance(source.waveform, Pulse) else _OF_SOURCE[: 2 if jumping else 3]
        if (parameter not in fixed) if fixed is not None else parameter in _FORM:
            return f"{path} varies"
        if fixed is None and name not in {e.name.lower() for e in stack.layers}:
            return f"{path} varies"
    return LockstepForm(stack.layers, stack.gap, float(turn * stack.sign[stack.gap]), source, jumping)


def _plain(wave: object) -> bool:
    """Whether a source has no offset and is a sine from t = 0 on, or a square whose period begins at t = 0."""
    if isinstance(wave, Sine):
        return wave.offset == 0.0 and wave.delay == 0.0 and wave.damping == 0.0
    if isinstance(wave, Pulse):
        return wave.half_wave and wave.rise == 0.0 and wave.delay == 0.0
    return isinstance(wave, Square) and wave.half_wave and wave.phase_deg == 0.0 and wave.delay == 0.0


def _of_wave(wave: object) -> dict[str, Value]:
    """Amplitude (V), frequency (Hz) and phase of a plain source."""
    if isinstance(wave, Pulse):
        return {"amplitude": wave.v2, "frequency": 1.0 / wave.pulse_period, "phase_deg": 0.0}
    assert isinstance(wave, Sine | Square)
    return {name: getattr(wave, name) for name in _OF_SOURCE}


def _starts_uncharged(circuit: Circuit, jumping: bool, varied: Mapping[str, object]) -> bool:
    tran = circuit.tran
    if circuit.initial or any(e.initial is not None for e in circuit.elements) or (tran and tran.start > 0.0):
        return False
    if tran is None or tran.uic:
        return True
    # The operating point of a sine that starts at 0 V is the uncharged state.
    phases = [getattr(e.waveform, "phase_deg", 0.0) for e in circuit.by_device("V")]
    return not jumping and not any(phases) and not any(path.endswith(".phase_deg") for path in varied)


def table_of(form: LockstepForm, scenes: Mapping[str, FloatArray]) -> FloatArray:
    """The table of some scenes as `engine.lockscenes.march` takes it, shape (n_row, n).

    Parameters
    ----------
    form : LockstepForm
    scenes : mapping of str to ndarray, shape (n,)
        Values by path in lower case, in the netlist's units; all other values are the circuit's.
    """

    def values(element: Element) -> dict[str, Value]:
        own: dict[str, Value] = dict(element.values)
        wave = element.waveform
        if wave is not None:
            own |= _of_wave(wave)
        return {key: scenes.get(f"{element.name.lower()}.{key}", own[key]) for key in own}

    n, count = next(iter(scenes.values())).size, len(form.layers)
    out = np.empty((CELL_ROWS * count + N_OTHERS, n))
    for i, layer in enumerate(form.layers):
        out[i], out[count + i], out[2 * count + i] = _CELL_OF[layer.device](values(layer))
    source = values(form.source)
    contact = _contact_rows(values(form.layers[form.gap]))
    wave = (
        form.sign * np.asarray(source["amplitude"]),
        2.0 * np.pi * np.asarray(source["frequency"]),
        np.radians(source["phase_deg"]),
    )
    for i, row in enumerate((*contact, *wave)):
        out[CELL_ROWS * count + i] = row
    return out


def _layer(v: Mapping[str, Value]) -> tuple[Value, Value, Value]:
    return EPS0 * v["eps_r"] / v["d"], 1.0 / v["r"], 0.0


def _slab(v: Mapping[str, Value]) -> tuple[Value, Value, Value]:
    return EPS0 * v["eps_r"] / v["d"], 0.0, 1.0 / (v["rho"] * v["d"])


def _skin(v: Mapping[str, Value]) -> tuple[Value, Value, Value]:
    return _slab({"d": v["d"], "eps_r": skin_permittivity(v["f"]), "rho": skin_resistivity(v["f"])})


#: As `Element.spec.cells`, for arrays of values: capacitance per area, total leakage and leakage per area.
_CELL_OF: dict[str, Callable[[Mapping[str, Value]], tuple[Value, Value, Value]]] = {
    "LAYER": _layer, "GAP": _layer, "SLAB": _slab, "SKIN": _skin,
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
