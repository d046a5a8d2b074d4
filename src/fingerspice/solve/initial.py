"""The initial state of a run, from the deck's ``uic`` and ``.ic``, the operating point, or an earlier solution; and the
form that a state has in a stack's own equations.

The live voltages along the loop are k U + v. The stack's own state x is v under `local`, and v A / A_0 under `mobile`
(see `engine.one_area.model`). The charge delivered by the source is z under `local`, and z + A U / S - offset under
`mobile`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.network import Network, build_network
from fingerspice.circuit.statespace import Stack
from fingerspice.engine.one_area.model import Model, choose_branch, gap_voltage
from fingerspice.physics.contact import inverse_area
from fingerspice.results.outcome import State
from fingerspice.results.solution import Solution
from fingerspice.solve.scenes import Scene, kept_with
from fingerspice.solve.starting import (
    PAST_FOLD,
    ROUNDING,
    at_own_area,
    operating_point,
    settle,
    start_voltages,
    starts_uncharged,
)
from fingerspice.waveforms.waveform import require


class StackState(NamedTuple):
    """A state in the engine's form."""

    t: float  # s
    y: FloatArray  # (n + 1,): State x (V), and z (C) last
    u_before: float  # Voltage around the loop just before `t`, V
    u_gap: float  # Gap voltage along the loop, V
    offset: float  # Value of A U / S at the start of the run, subtracted so that the charge counts from there, C


def model_of(scene: Scene) -> Model:
    """The model of a scene that is known to be a stack."""
    assert scene.model is not None
    return scene.model


def to_stack(scene: Scene, state: State) -> StackState:
    """A state of a stack in the engine's form."""
    model = model_of(scene)
    if not state.y.any() and not state.s_before.any():
        return StackState(state.t, state.y.copy(), 0.0, 0.0, 0.0)
    before, along = float(state.s_before[0]), scene.turn * state.y[:-1]
    u_gap = float(np.einsum("k,k->", along[: model.gap.size], model.gap))
    # If the gap's voltage is no state, it is the source's voltage less the states, whose weights are -1.
    u_gap += 0.0 if model.gap.size and model.gap.max() > 0.0 else before
    inverse = inverse_area(abs(u_gap), model.curve)[0] if model.mobile else 0.0
    scale = model.area0 * inverse if model.mobile else 1.0
    offset = before / inverse / model.s if model.mobile else 0.0
    share = model.k[:-1] * before
    x = along - share
    # A remainder within the rounding of the capacitive share is no stored charge: an uncharged start gives exactly 0.
    x[np.abs(x) <= 4e-16 * np.abs(share)] = 0.0
    return StackState(state.t, np.append(x / scale, state.y[-1]), before, u_gap, offset)


def from_stack(scene: Scene, state: StackState) -> State:
    """The state used for all circuits from a state in the engine's form."""
    model = model_of(scene)
    stack, sign, scale, y = scene.stack, 0.0, 1.0, state.y.copy()
    assert stack is not None
    if model.mobile:
        inverse = inverse_area(abs(state.u_gap), model.curve)[0]
        scale = model.area0 * inverse
        y[-1] += state.u_before / inverse / model.s - state.offset
        if stack.gap is not None and state.u_gap != 0.0:
            sign = math.copysign(1.0, state.u_gap) * float(stack.sign[stack.gap])
    y[:-1] = scene.turn * (model.k[:-1] * state.u_before + scale * y[:-1])
    return State(state.t, y, np.array([state.u_before]), np.array([sign]), scene.charge_law)


def _unreachable(scene: Scene, state: StackState, largest: float) -> bool:
    """Whether the source, raised from 0 V, cannot reach a state's gap voltage; `largest`: largest cell voltage, V."""
    model, k_u = model_of(scene), model_of(scene).k_gap * state.u_before
    sign = choose_branch(model, state.u_before, state.y)
    found = float(gap_voltage(model, k_u, float(model.gap @ state.y[:-1]), sign, k_u))
    # Behind an insulating coating, a gap voltage of 0 V is a difference of other voltages: allow for their round-off.
    return not abs(found - state.u_gap) <= 1e-9 * abs(state.u_gap) + 1e-13 * largest


def as_marched(scene: Scene, rows: FloatArray, by_layer: bool = True) -> FloatArray:
    """Rows in the form of the compiled loop from rows of `write_row`: voltages along the loop, z and the current.

    The voltages are those of the recorded layers (`Scene.shown`), or without `by_layer` those of all cells.
    """
    model, stack = model_of(scene), scene.stack
    x = rows[:, 5:-1] * (model.area0 * rows[:, 2:3]) if model.mobile else rows[:, 5:-1]
    live = rows[:, :1] * model.k[:-1] + x
    if by_layer and stack is not None and stack.by_layer is not stack:
        live = np.einsum("lk,tk->tl", stack.grouping, live)
    out = np.empty((len(rows), live.shape[1] + 2))
    out[:, :-2], out[:, -2], out[:, -1] = live, rows[:, -1], rows[:, 3]
    return out


def from_written(scene: Scene, rows: FloatArray, offset: float, by_layer: bool) -> FloatArray:
    """Rows as in `Record` from rows of `engine.one_area.model.write_row`."""
    model, out = model_of(scene), as_marched(scene, rows, by_layer)
    out[:, :-2] *= (scene.shown if by_layer else scene).turn
    if model.mobile:
        out[:, -2] += rows[:, 0] / rows[:, 2] / model.s - offset
    return out


def row_width(scene: Scene) -> int:
    """Number of columns in a row of `engine.one_area.model.write_row`."""
    return 6 + model_of(scene).gap.size


def initial_state(circuit: Circuit, scene: Scene, start: str | Solution) -> State:
    """State just before the start."""
    network = scene.network
    size = sum(network.b.shape) + int(np.count_nonzero(scene.net.slow >= 0))
    if isinstance(start, Solution):
        names = tuple(e.name for e in network.layers)
        if start.layers != names or start.state.y.size != size or start.charge_law != scene.charge_law:
            raise InputError(
                f"the solution to start from has layers {', '.join(start.layers)} and the {start.charge_law} law, or "
                f"is another circuit's; allowed: one of this circuit, {', '.join(names)} and {scene.charge_law}"
            )
        return start.state
    require(start in ("deck", "uncharged", "dc"), "start", repr(start), "'deck', 'uncharged', 'dc' or a Solution")
    asked = start == "deck"

    def make() -> State:
        if start == "dc" or (asked and not starts_uncharged(circuit)):
            return _state(scene, *_at_rest(circuit, scene, circuit.initial if asked else {}))
        # An area is NaN if it follows its voltage without delay, or if it starts in equilibrium with it.
        u, area = np.zeros(len(network.cells)), np.full(len(network.areas), np.nan)
        if asked and (circuit.initial or any(cell.element.initial is not None for cell in network.cells)):
            u = start_voltages([c.element for c in network.cells], scene.net.c, circuit.initial)
            for i, one in enumerate(network.areas):
                if scene.net.slow[i] >= 0:
                    area[i] = 1e-6 * circuit.initial.get(one.node, math.nan)
        return _state(scene, u, area, None)

    return kept_with(scene.prepared, ("initial", start), 3, make)


def _at_rest(circuit: Circuit, scene: Scene, initial: Mapping[str, float]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cell voltages (V), areas (m^2) and sources at the operating point, with the nodes in `initial` held."""
    network, net, stack = scene.network, scene.net, scene.stack
    s = np.array([float(w.value(0.0, "left")) for w in scene.waveforms])
    if stack is not None and scene.model is not None and not initial:
        order = list(stack.state_order)
        return (stack.sign * dc_voltages(stack, float(s[0]), scene.model))[order], scene.area0, s
    contacts = [c if gap >= 0 else None for c, gap in zip(network.contacts, net.gap, strict=True)]
    # The reduced network of a series loop has no nodes, so the operating point needs the unreduced network.
    whole = network if stack is None else build_network(replace(circuit, work="gap"))
    u, area, held = operating_point(circuit, whole, scene.area0, contacts, initial)
    u = u if stack is None else _cells_of(network, whole, u)
    if net.mobile:
        for i in np.flatnonzero(held & (net.slow < 0)):
            # A held area is released at the start: it becomes that of its gap voltage, and the charge is conserved.
            gap = net.gap[i]
            own = at_own_area(float(u[gap]), area[i], net.curves[i])
            rest = 1.0 / inverse_area(abs(own), net.curves[i])[0]
            u[net.place == i] *= area[i] / rest
            u[gap] = own
    return u, area, s


def _cells_of(network: Network, whole: Network, u: FloatArray) -> FloatArray:
    """Voltages (V) of a loop's cells from the cell voltages of the same circuit built as a network."""
    of: dict[str, list[float]] = {}
    for cell, one in zip(whole.cells, u.tolist(), strict=True):
        of.setdefault(cell.element.name, []).append(one)
    for layer in network.layers:
        if sum(cell.element is layer for cell in network.cells) == 1:
            # A dispersive skin evaluated at one frequency is one cell of the loop, but several of the network.
            of[layer.name] = [sum(of[layer.name])]
    return np.array([of[cell.element.name].pop(0) for cell in network.cells])


def _state(scene: Scene, u: FloatArray, area: FloatArray, s: FloatArray | None) -> State:
    """State just before the start from cell voltages u (n_cell,) V; without `s`, the sources are fitted to them."""
    network, net = scene.network, scene.net
    if s is None and not u.any() and not np.any(net.slow >= 0):
        y, still = np.zeros(sum(network.b.shape)), np.zeros(len(network.sources))
        return State(0.0, y, still, np.zeros(len(network.areas)), scene.charge_law)
    slow = (area / net.area0)[net.slow >= 0]
    x: FloatArray = u[list(network.live)]
    charge: FloatArray = np.zeros(len(network.sources))
    rest, q = u - network.p @ x, network.q
    if s is not None:
        before = s
    else:
        # The values that agree with the cell voltages in the least-squares sense.
        fits = q.size and np.any(rest)
        before = np.asarray(np.linalg.lstsq(q, rest, rcond=None)[0], float) if fits else np.zeros(q.shape[1])
    after = np.array([float(w.value(0.0)) for w in scene.waveforms])
    # The run itself reports a source that is not finite.
    after[~np.isfinite(after)] = 0.0
    if float(np.abs(rest - q @ before).max(initial=0.0)) > ROUNDING * float(np.abs(u).max(initial=0.0)):
        before = after if s is None else s
        x, slow, charge = settle(net, u, slow, before)
    elif np.any(np.isnan(slow)):
        # Areas with a time constant start in equilibrium with the voltages after the sources' first jump.
        _, slow, _ = settle(net, u, slow, after)
    sign = np.zeros(len(network.areas))
    state = State(0.0, np.concatenate([x, slow, charge]), before, sign, scene.charge_law)
    has_gap = scene.model is not None and network.gaps[0] is not None
    if has_gap and np.any(u) and _unreachable(scene, to_stack(scene, state), float(np.abs(u).max())):
        raise InputError(f"the start has {u[scene.measured[0]]:.4g} V across the gap, {PAST_FOLD}")
    return state


def dc_voltages(stack: Stack, u_source: float, model: Model) -> FloatArray:
    """Cell voltages (V) along the loop (n_cell,) at the DC operating point, with the area coupled.

    Where two or more layers do not leak, the node between them has no DC voltage: such a start is refused.
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
    low, high = 0.0, abs(u_source)
    for _ in range(200):
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        more = abs(split(1.0 / inverse_area(middle, model.curve)[0])[stack.gap]) > middle
        low, high = (middle, high) if more else (low, middle)
    return split(1.0 / inverse_area(high, model.curve)[0])
