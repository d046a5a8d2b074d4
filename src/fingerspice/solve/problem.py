"""A scene made ready to integrate: stack, source, charge law, area mode, start."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit
from fingerspice.circuit.network import build_network
from fingerspice.circuit.response import mean_area
from fingerspice.circuit.spectrum import freezing_error
from fingerspice.circuit.statespace import Stack, build_stack
from fingerspice.engine.model import Model, choose_branch, gap_voltage
from fingerspice.numerics.modes import modes
from fingerspice.physics.contact import fixed_area_curve, inverse_area
from fingerspice.results.outcome import State
from fingerspice.results.record import Record
from fingerspice.results.solution import Solution
from fingerspice.solve.starting import PAST_FOLD, operating_point, start_voltages, starts_uncharged
from fingerspice.solve.times import run_times
from fingerspice.waveforms.sampling import is_sampled, on_breakpoint
from fingerspice.waveforms.waveform import Fundamental, Waveform, require

FloatArray = NDArray[np.float64]

# What a dispersive skin's data taken at one frequency may cost, over the error asked for.
FREEZING_SHARE = 0.3
# Breakpoints (64 kB) that a scene keeps.
KEPT_BREAKPOINTS = 8192
# V; below, the digits of all that a source causes are lost.
LEAST_PEAK = 1e-300


@dataclass(frozen=True)
class Freezing:
    """A dispersive skin's data taken at one frequency, and what that costs.

    Attributes
    ----------
    frequency : float
        Hz.
    error : float
        Of the gap voltage, relative to its peak.
    """

    frequency: float
    error: float


@dataclass(frozen=True, eq=False)
class Scene:
    """A circuit under one charge law and area mode, as numbers; kept with the circuit from run to run.

    Attributes
    ----------
    stack : Stack
    waveform : Waveform
        Voltage around the loop.
    model : Model
    charge_law, area_mode : str
    u_peak : float
        Largest |U|, V; 0 where it is not known.
    skin : Freezing or None
        At what frequency a dispersive skin's data are taken, where that is enough for the error asked for.
    prepared : dict
        What integrators made ready for this scene.
    """

    stack: Stack
    waveform: Waveform
    model: Model
    charge_law: str
    area_mode: str
    u_peak: float
    skin: Freezing | None = None
    prepared: dict[Any, Any] = field(default_factory=dict)

    @cached_property
    def fundamental(self) -> Fundamental | None:
        """The source's."""
        return self.waveform.fundamental

    @cached_property
    def is_sampled(self) -> bool:
        """Whether the source is a function that has to be looked at, not a waveform with a formula."""
        return is_sampled(self.waveform)

    @property
    def probe(self) -> int:
        """Cell whose voltage the error is measured on: the gap, or the one with the smallest capacitance."""
        return probe_cell(self.stack)

    @property
    def probe_layer(self) -> int:
        """The layer that this cell is part of."""
        return self.stack.layer_of(self.probe)

    def live_voltages(self, u_source: FloatArray, inverse: FloatArray, x: FloatArray) -> FloatArray:
        """Voltages (n_layer - 1, n_t) of the recorded layers from U, 1/A (n_t,) and the states (n_t, n_cell - 1)."""
        scale = self.model.area0 * inverse if self.model.mobile else np.ones_like(inverse)
        cells = (np.outer(u_source, self.model.k[:-1]) + x * scale[:, None]).T
        return np.ascontiguousarray(cells if len(self.stack.layers) > cells.shape[0] else self.stack.grouping @ cells)

    def force(self, u_gap: FloatArray, inverse: FloatArray) -> FloatArray:
        """Electroadhesive force (N) from the gap voltage (V) and 1/A (1/m^2); zero without a gap."""
        if self.stack.contact is None:
            return np.zeros_like(u_gap)
        return np.asarray(self.stack.contact.stress(u_gap) / inverse)


@dataclass(frozen=True)
class Problem:
    """What an integrator needs.

    Attributes
    ----------
    circuit : Circuit
    scene : Scene
    t_start, t_stop, first, step : float
        s; outputs are spaced by `step` from `first` on.
    initial : State
    charge : bool
        Whether charge and current are wanted.
    """

    circuit: Circuit
    scene: Scene
    t_start: float
    t_stop: float
    first: float
    step: float
    initial: State
    charge: bool = True

    @property
    def stack(self) -> Stack:
        return self.scene.stack

    @property
    def waveform(self) -> Waveform:
        return self.scene.waveform

    @property
    def waveforms(self) -> tuple[Waveform, ...]:
        """The loop's voltage, as the one source of a network."""
        return (self.scene.waveform,)

    @property
    def model(self) -> Model:
        return self.scene.model

    def breakpoints(self) -> FloatArray:
        """The source's breakpoints in the run, s; those of a short run stay with the scene."""
        span = self.t_start, self.t_stop
        # One entry with its key: another thread may put its own there at any time.
        kept, edges = self.scene.prepared.get("breakpoints", (None, np.empty(0)))
        if kept != span:
            edges = self.waveform.breakpoints(*span)
            if edges.size <= KEPT_BREAKPOINTS:
                self.scene.prepared["breakpoints"] = span, edges
        return np.asarray(edges)

    @property
    def max_step(self) -> float:
        """Longest step (s) that the deck's .tran line allows."""
        tran = self.circuit.tran
        return math.inf if tran is None or tran.max_step is None else tran.max_step


def prepare(
    circuit: Circuit,
    *,
    t_stop: float | None,
    t_eval: FloatArray | None,
    charge_law: str | None,
    area: str | float,
    start: str | Solution,
    charge: bool = True,
    rtol: float = 0.0,
) -> Problem:
    """Make a scene ready, or refuse it; `rtol` decides whether a dispersive skin's data may be taken at one frequency.

    Raises
    ------
    InputError
        For anything in the request that cannot be run.
    """
    t_start = start.state.t if isinstance(start, Solution) else 0.0
    scene = scene_of(circuit, charge_law, area, t_stop, rtol)
    stop, step = run_times(circuit, t_start, t_stop, t_eval)
    # One entry with its key: another thread may put its own there at any time.
    asked, ends = scene.prepared.get("end", (math.nan, math.nan))
    if asked != stop:
        asked, ends = scene.prepared["end"] = stop, on_breakpoint(scene.waveform, stop)
    stop = ends
    first = t_start + (circuit.tran.start if circuit.tran else 0.0)
    initial = _initial_state(circuit, scene, start)
    return Problem(circuit, scene, t_start, stop, first, step, initial, charge)


def scene_of(
    circuit: Circuit, charge_law: str | None, area: str | float, t_stop: float | None, rtol: float = 0.0
) -> Scene:
    """The circuit's scene under a charge law and area mode, made on first use.

    Raises
    ------
    InputError
        As `prepare`.
    """
    law = charge_law or circuit.charge_law or "local"
    require(law in CHARGE_LAWS, "charge_law", repr(law), " or ".join(map(repr, CHARGE_LAWS)))
    stop = t_stop or (circuit.tran.stop if circuit.tran else 1.0)

    skin = _freezing(circuit, stop)
    if skin is not None and skin.error > FREEZING_SHARE * rtol:
        skin = None

    def make() -> Scene:
        stack = build_stack(circuit, None if skin is None else skin.frequency)
        waveform = stack.waveform
        u_peak = _largest_voltage(waveform, stop)
        fixed, area_mode = _fixed_area(stack, area)
        return Scene(stack, waveform, _model(stack, law, fixed, u_peak), law, area_mode, u_peak, skin)

    scene: Scene = circuit.remember(("scene", law, area, stop, skin), make)
    return scene


def _freezing(circuit: Circuit, stop: float) -> Freezing | None:
    """The best single frequency of a dispersive skin, and its error; None where there is no such skin or frequency."""
    if not circuit.by_device("SKIN_DISPERSIVE"):
        return None

    def make() -> Freezing | None:
        stack = build_stack(circuit)
        fundamental = stack.waveform.fundamental
        if fundamental is None or stack.contact is None or not (math.isfinite(stop) and stop > 0.0):
            return None
        f = fundamental.frequency
        areas = stack.contact.area(np.linspace(0.0, _largest_voltage(stack.waveform, stop), 65))
        area = stack.area_given or float(np.median(areas))
        change = 0.0 if stack.area_given else float(np.ptp(areas)) / area
        return Freezing(f, freezing_error(circuit, f, area, change, stop))

    found: Freezing | None = circuit.remember(("freezing", stop), make)
    return found


def _largest_voltage(waveform: Waveform, stop: float) -> float:
    if not (math.isfinite(stop) and stop > 0.0):
        return 0.0
    if waveform.period is not None:
        stop = waveform.settled + waveform.period
    peak = waveform.peak(0.0, stop)
    require(not 0.0 < peak < LEAST_PEAK, "the source's peak", f"{peak:g} V", f"0, or {LEAST_PEAK:g} V or more")
    return peak if math.isfinite(peak) else 0.0


def _fixed_area(stack: Stack, area: str | float) -> tuple[float | None, str]:
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


def probe_cell(stack: Stack) -> int:
    """The gap, or without one the cell with the smallest capacitance."""
    return int(np.argmin(stack.c)) if stack.gap is None else stack.gap


def _model(stack: Stack, law: str, fixed: float | None, u_peak: float) -> Model:
    if fixed is not None:
        area0 = fixed
        curve = fixed_area_curve(fixed)
    else:
        assert stack.contact is not None
        area0 = float(stack.contact.area(0.0))
        # Discharging layers add to the gap's share of a jump: the curve covers a little more than U itself.
        curve = stack.contact.curve(max(1.3 * u_peak, 1e-30))
    order = list(stack.state_order)
    probe = probe_cell(stack)
    k = stack.k[order]
    leaks = stack.leak_rates(area0)
    slow = int(np.argmin(leaks))
    rates, _, _, _ = modes(np.ascontiguousarray(leaks[order]), np.ascontiguousarray(k))
    fastest = float(rates.max(initial=0.0))
    return Model(
        mobile=law == "mobile",
        coupled=fixed is None,
        k=np.ascontiguousarray(k),
        rate=np.ascontiguousarray((stack.g_area / stack.c)[order]),
        rate0=np.ascontiguousarray((stack.g_total / stack.c)[order]),
        k_gap=float(stack.k[probe]),
        gap=_row(order, probe),
        s=stack.s,
        slow=np.append(_row(order, slow), [stack.k[slow], stack.c[slow], stack.g_area[slow], stack.g_total[slow]]),
        area0=area0,
        tau=1.0 / fastest if fastest > 0.0 else math.inf,
        curve=curve,
    )


def _row(order: list[int], layer: int) -> FloatArray:
    """How a cell's voltage over k U follows from the states, shape (n_cell - 1,)."""
    place = order.index(layer)
    n = len(order) - 1
    return np.full(n, -1.0) if place == n else np.eye(n)[place]


def _initial_state(circuit: Circuit, scene: Scene, start: str | Solution) -> State:
    """State just before the start."""
    stack, model, law = scene.stack, scene.model, scene.charge_law
    n = stack.c.size
    if isinstance(start, Solution):
        before = start.record
        alike = isinstance(before, Record) and (before.layers, before.stack.cells) == (
            tuple(e.name for e in stack.layers), stack.cells
        )  # fmt: skip
        if not alike or start.charge_law != law:
            raise InputError(
                f"the solution to start from has layers {', '.join(start.layers)} and the {start.charge_law} law; "
                f"allowed: those of this run, {', '.join(e.name for e in stack.layers)} and {law}"
            )
        assert isinstance(start.state, State)
        return start.state
    require(start in ("deck", "uncharged", "dc"), "start", repr(start), "'deck', 'uncharged', 'dc' or a Solution")
    initial = circuit.initial if start == "deck" else {}
    if start == "deck":
        start = "dc" if not starts_uncharged(circuit) else ("given" if initial else "uncharged")
    if start == "uncharged":
        return State(0.0, np.zeros(n), 0.0, 0.0, law)
    inverse, let_go = 0.0, False
    if start == "given":
        of = [e for e, count in zip(stack.layers, stack.cells, strict=True) for _ in range(count)]
        u = stack.sign * start_voltages(of, stack.c, initial)
        u_before = float(u.sum())
    else:
        u_before = float(scene.waveform.value(0.0, "left"))
        u = dc_voltages(stack, u_before, model) if not initial else np.zeros(n)
        if initial:
            u, inverse, let_go = _held_voltages(circuit, scene)
    v = u - stack.k * u_before
    if not let_go:
        inverse = 1.0 / model.area0
        if stack.gap is not None:
            inverse, _ = inverse_area(abs(float(u[stack.gap])), model.curve)
    x = v[list(stack.state_order[:-1])] / (model.area0 * inverse if model.mobile else 1.0)
    state = state_from(model, 0.0, x, u_before, law)
    if stack.gap is not None:
        found = _gap_voltage(model, x, u_before)
        # Behind an insulating coating the gap's 0 V are the difference of others.
        slack = 1e-9 * abs(u[stack.gap]) + 1e-13 * float(np.abs(u).max())
        # An area that .ic held springs back, and the voltage with it.
        if not (math.isfinite(found) if let_go else abs(found - u[stack.gap]) <= slack):
            raise InputError(f"the start has {u[stack.gap]:.4g} V across the gap, {PAST_FOLD}")
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


def _held_voltages(circuit: Circuit, scene: Scene) -> tuple[FloatArray, float, bool]:
    """Cell voltages (n_cell,) and 1/A (1/m^2) at rest with ``.ic`` held, and whether that holds the area."""
    stack, model = scene.stack, scene.model
    network = build_network(replace(circuit, work="gap"))
    contact = stack.contact if model.coupled else None
    point = operating_point(circuit, network, np.array([model.area0]), [contact], circuit.initial)
    u = []
    for layer, count in zip(stack.layers, stack.cells, strict=True):
        own = point.u[[i for i, cell in enumerate(network.cells) if cell.element is layer]]
        # A dispersive skin whose data are taken at one frequency is one cell.
        u += list(own) if own.size == count else [own.sum()]
    return stack.sign * np.array(u), float(1.0 / point.area[0]), bool(point.held[0])


def dc_voltages(stack: Stack, u_source: float, model: Model) -> FloatArray:
    """Cell voltages along the loop (n_cell,) at the DC operating point, the area coupled.

    Raises
    ------
    InputError
        Where two or more layers do not leak: the node between them has no DC voltage.
    """
    insulating = stack.layers_of(stack.g_total + stack.g_area == 0.0)
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
