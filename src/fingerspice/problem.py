"""A scene made ready to integrate: stack, source, charge law, area mode, start."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit
from fingerspice.circuit.statespace import Stack, build_stack
from fingerspice.circuit.waveforms import Waveform, require
from fingerspice.engine.model import Model, choose_branch, gap_voltage
from fingerspice.errors import InputError
from fingerspice.phasors import mean_area
from fingerspice.physics.contact import fixed_area_curve, inverse_area
from fingerspice.solution import Solution, State

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Problem:
    """What an integrator needs, as numbers.

    Attributes
    ----------
    circuit : Circuit
    stack : Stack
    waveform : Waveform
        Voltage around the loop.
    model : Model
    embedding : ndarray, shape (n_layer, n_layer - 1)
        v = embedding @ x.
    charge_law, area_mode : str
    t_start, t_stop, first, step : float
        s; outputs are spaced by `step` from `first` on.
    initial : State
    """

    circuit: Circuit
    stack: Stack
    waveform: Waveform
    model: Model
    embedding: FloatArray
    charge_law: str
    area_mode: str
    t_start: float
    t_stop: float
    first: float
    step: float
    initial: State

    @property
    def probe(self) -> int:
        """Layer whose voltage the error is measured on: the gap, or the one with the smallest capacitance."""
        return int(np.argmin(self.stack.c)) if self.stack.gap is None else self.stack.gap

    def layer_voltages(self, u_source: FloatArray, inverse: FloatArray, x: FloatArray) -> FloatArray:
        """Voltages along the loop (n_t, n_layer) from U, 1/A and the states (n_t, n_layer - 1)."""
        scale = self.model.area0 * inverse if self.model.mobile else np.ones_like(inverse)
        return np.asarray(np.outer(u_source, self.stack.k) + (x * scale[:, None]) @ self.embedding.T)

    def force(self, u_gap: FloatArray, inverse: FloatArray) -> FloatArray:
        """Electroadhesive force (N) from the gap voltage (V) and 1/A (1/m^2); zero without a gap."""
        if self.stack.contact is None:
            return np.zeros_like(u_gap)
        return np.asarray(self.stack.contact.stress(u_gap) / inverse)


def prepare(
    circuit: Circuit,
    *,
    t_stop: float | None,
    t_eval: FloatArray | None,
    charge_law: str | None,
    area: str | float,
    start: str | Solution,
) -> Problem:
    """Make a scene ready, or refuse it.

    Raises
    ------
    InputError
        For anything in the request that cannot be run.
    """
    law = charge_law or circuit.charge_law or "local"
    require(law in CHARGE_LAWS, "charge_law", repr(law), " or ".join(map(repr, CHARGE_LAWS)))
    stack = build_stack(circuit)
    waveform = stack.waveform
    fixed, area_mode = _fixed_area(circuit, stack, area)
    model, embedding = _model(stack, law, fixed, _largest_voltage(waveform, t_stop, circuit))
    t_start = start.state.t if isinstance(start, Solution) else 0.0
    stop, step = _times(circuit, t_start, t_stop, t_eval)
    first = t_start + (circuit.tran.start if circuit.tran else 0.0)
    initial = _initial_state(circuit, stack, waveform, model, law, start)
    return Problem(circuit, stack, waveform, model, embedding, law, area_mode, t_start, stop, first, step, initial)


def _largest_voltage(waveform: Waveform, t_stop: float | None, circuit: Circuit) -> float:
    stop = t_stop or (circuit.tran.stop if circuit.tran else 1.0)
    peak = waveform.peak(0.0, stop) if math.isfinite(stop) and stop > 0.0 else 0.0
    return peak if math.isfinite(peak) else 0.0


def _times(circuit: Circuit, t_start: float, t_stop: float | None, t_eval: FloatArray | None) -> tuple[float, float]:
    """End of the run and output spacing, s."""
    tran = circuit.tran
    if t_stop is None:
        if tran is not None:
            t_stop = t_start + tran.stop
        elif t_eval is not None and t_eval.size:
            t_stop = float(t_eval[-1])
        else:
            raise InputError("no t_stop: the deck has no .tran line and none was given; give t_stop in s")
    require(math.isfinite(t_stop) and t_stop > t_start, "t_stop", f"{t_stop:g} s", f"more than {t_start:g} s")
    if t_eval is not None:
        require(t_eval.ndim == 1 and t_eval.size > 0, "t_eval", f"of shape {t_eval.shape}", "one row of times")
        require(bool(np.all(np.diff(t_eval) >= 0.0)), "t_eval", "not in order", "ascending times")
        require(
            bool(t_eval[0] >= t_start and t_eval[-1] <= t_stop),
            "t_eval",
            f"{t_eval[0]:g} s to {t_eval[-1]:g} s",
            f"times from {t_start:g} s to t_stop = {t_stop:g} s",
        )
    step = tran.step if tran is not None else (t_stop - t_start) / 1000.0
    return t_stop, step


def _fixed_area(circuit: Circuit, stack: Stack, area: str | float) -> tuple[float | None, str]:
    """The area (m^2) that does not follow the voltage, or None, and the mode's name."""
    if not isinstance(area, str):
        require(math.isfinite(area) and area > 0.0, "area", f"{area:g} m^2", "a positive area in m^2")
        return float(area), f"{area:g} m^2"
    require(area in ("coupled", "mean", "frozen"), "area", repr(area), "'coupled', 'mean', 'frozen' or m^2")
    if stack.area_given is not None:
        return stack.area_given, f"{stack.area_given:g} m^2 (from the deck)"
    assert stack.contact is not None
    if area == "coupled":
        return None, area
    if area == "frozen":
        return float(stack.contact.area(0.0)), area
    fundamental = stack.waveform.fundamental
    if fundamental is None:
        raise InputError(
            "area='mean' is the area of the phasor at the source's fundamental, and this source has none; allowed: "
            "'coupled', 'frozen' or an area in m^2"
        )
    return mean_area(stack, fundamental.frequency, fundamental.amplitude), area


def _model(stack: Stack, law: str, fixed: float | None, u_peak: float) -> tuple[Model, FloatArray]:
    embedding = stack.matrices()[-1]
    order = _state_order(embedding)
    if fixed is not None:
        area0 = fixed
        curve = fixed_area_curve(fixed)
    else:
        assert stack.contact is not None
        area0 = float(stack.contact.area(0.0))
        # Discharging layers add to the gap's share of a jump: the curve covers a little more than U itself.
        curve = stack.contact.curve(max(1.3 * u_peak, 1e-30))
    probe = int(np.argmin(stack.c)) if stack.gap is None else stack.gap
    rate = stack.fastest_rate(area0)
    model = Model(
        mobile=law == "mobile",
        coupled=fixed is None,
        k=np.ascontiguousarray(stack.k[order]),
        rate=np.ascontiguousarray((stack.g_area / stack.c)[order]),
        rate0=np.ascontiguousarray((stack.g_total / stack.c)[order]),
        k_gap=float(stack.k[probe]),
        gap=np.ascontiguousarray(embedding[probe]),
        s=stack.s,
        slow=_slowest_layer(stack, embedding, area0),
        area0=area0,
        tau=1.0 / rate if rate > 0.0 else math.inf,
        curve=curve,
    )
    return model, embedding


def _state_order(embedding: FloatArray) -> list[int]:
    """Layers in the order of the states, the layer left out last."""
    live = [int(np.argmax(column == 1.0)) for column in embedding.T]
    return [*live, next(i for i in range(embedding.shape[0]) if i not in live)]


def _slowest_layer(stack: Stack, embedding: FloatArray, area: float) -> FloatArray:
    """See `Model.slow`."""
    i = int(np.argmin((stack.g_total / area + stack.g_area) / stack.c))
    return np.append(embedding[i], [stack.k[i], stack.c[i], stack.g_area[i], stack.g_total[i]])


def _initial_state(
    circuit: Circuit, stack: Stack, waveform: Waveform, model: Model, law: str, start: str | Solution
) -> State:
    """State just before the start."""
    n = stack.c.size
    if isinstance(start, Solution):
        if start.layers != tuple(e.name for e in stack.layers) or start.charge_law != law:
            raise InputError(
                f"the solution to start from has layers {', '.join(start.layers)} and the {start.charge_law} law; "
                f"allowed: those of this run, {', '.join(e.name for e in stack.layers)} and {law}"
            )
        return start.state
    require(start in ("deck", "uncharged", "dc"), "start", repr(start), "'deck', 'uncharged', 'dc' or a Solution")
    if start == "deck":
        uic = circuit.tran is None or circuit.tran.uic
        start = "uncharged" if uic and not circuit.initial else ("given" if circuit.initial else "dc")
    if start == "uncharged":
        return State(0.0, np.zeros(n), 0.0, 0.0, law)
    if start == "given":
        u, u_before = _given_voltages(circuit, stack)
    else:
        u_before = float(waveform.value(0.0, "left"))
        u = dc_voltages(stack, u_before, model)
    v = u - stack.k * u_before
    inverse = 1.0 / model.area0
    if stack.gap is not None:
        inverse, _ = inverse_area(abs(float(u[stack.gap])), model.curve)
    live = _state_order(stack.matrices()[-1])[:-1]
    x = v[live] / (model.area0 * inverse if model.mobile else 1.0)
    state = state_from(model, 0.0, x, u_before, law)
    if stack.gap is not None:
        found = _gap_voltage(model, x, u_before)
        if not abs(found - u[stack.gap]) <= 1e-9 * abs(u[stack.gap]):
            raise InputError(
                f"the start has {u[stack.gap]:.4g} V across the gap, past the fold of the mobile law; allowed: less "
                "voltage, more load, or the local law"
            )
    return state


def _gap_voltage(model: Model, x: FloatArray, u_before: float) -> float:
    k_u = model.k_gap * u_before
    sign = choose_branch(model, u_before, x)
    return float(gap_voltage(model, k_u, float(model.gap @ x), sign, k_u))


def state_from(model: Model, t: float, x: FloatArray, u_before: float, law: str) -> State:
    """State with live voltages `x` (V) just before time t, the source at `u_before` (V), no charge delivered yet."""
    offset = 0.0
    if model.mobile:
        inverse, _ = inverse_area(abs(_gap_voltage(model, x, u_before)), model.curve)
        offset = u_before / inverse / model.s
    return State(t, np.append(x, 0.0), u_before, offset, law)


def _given_voltages(circuit: Circuit, stack: Stack) -> tuple[FloatArray, float]:
    """Layer voltages along the loop from ``.ic`` node voltages (unnamed nodes: 0), and their sum."""
    names = {node for hop in stack.hops for node in hop.element.nodes[:2]}
    unknown = [node for node in circuit.initial if node not in names]
    if unknown:
        raise InputError(f".ic names node {unknown[0]!r}, which is not in the circuit")
    u = np.array([circuit.initial.get(e.nodes[0], 0.0) - circuit.initial.get(e.nodes[1], 0.0) for e in stack.layers])
    u = u * stack.sign
    return u, float(u.sum())


def dc_voltages(stack: Stack, u_source: float, model: Model) -> FloatArray:
    """Layer voltages along the loop (n_layer,) at the DC operating point, the area coupled.

    Raises
    ------
    InputError
        Where two or more layers do not leak: the node between them has no DC voltage.
    """
    insulating = [e.name for e, g in zip(stack.layers, stack.g_total + stack.g_area, strict=True) if g == 0.0]
    if len(insulating) > 1:
        raise InputError(
            f"no DC operating point: {' and '.join(insulating)} do not leak, so the nodes between them are reached "
            "by capacitors only; allowed: a leakage (r=...), or uic in .tran to start uncharged"
        )

    def split(area: float) -> FloatArray:
        g = stack.g_total + stack.g_area * area
        if insulating:
            return np.asarray(np.where(g == 0.0, u_source, 0.0))
        r = 1.0 / g
        return np.asarray(u_source * r / r.sum())

    if stack.gap is None or not model.coupled:
        return split(model.area0)
    lo, hi = 0.0, abs(u_source)
    for _ in range(200):
        middle = 0.5 * (lo + hi)
        inverse, _ = inverse_area(middle, model.curve)
        if abs(split(1.0 / inverse)[stack.gap]) > middle:
            lo = middle
        else:
            hi = middle
        if not lo < 0.5 * (lo + hi) < hi:
            break
    inverse, _ = inverse_area(hi, model.curve)
    return split(1.0 / inverse)
