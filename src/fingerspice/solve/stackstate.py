"""Conversion between the state used for all circuits and the state in a series stack's own equations.

The live voltages along the loop are k U + v. The stack's own state x is v under `local`, and v A / A_0 under `mobile`
(see `engine.model`). The charge delivered by the source is z under `local`, and z + A U / S - offset under `mobile`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.engine.model import Model, choose_branch, gap_voltage
from fingerspice.physics.contact import inverse_area
from fingerspice.results.outcome import State
from fingerspice.solve.scenes import Scene


@dataclass(frozen=True)
class StackState:
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
    u_gap = float(along_gap(model, along[None], state.s_before)[0])
    inverse = inverse_area(abs(u_gap), model.curve)[0] if model.mobile else 0.0
    scale = model.area0 * inverse if model.mobile else 1.0
    offset = before / inverse / model.s if model.mobile else 0.0
    share = model.k[:-1] * before
    x = along - share
    # A remainder within the rounding of the capacitive share is no stored charge: an uncharged start gives exactly 0.
    x[np.abs(x) <= 4e-16 * np.abs(share)] = 0.0
    return StackState(state.t, np.append(x / scale, state.y[-1]), before, u_gap, offset)


def along_gap(model: Model, along: FloatArray, u_source: FloatArray) -> FloatArray:
    """Gap voltages (n_t,) from rows of live voltages along the loop (n_t, n) and the source's, V."""
    x = np.einsum("tk,k->t", along[:, : model.gap.size], model.gap)
    # If the gap's voltage is no state, it is the source's voltage less the states, whose weights are -1.
    return np.asarray(x if model.gap.size and model.gap.max() > 0.0 else u_source + x)


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


def unreachable(scene: Scene, state: StackState, largest: float) -> bool:
    """Whether the source, raised from 0 V, cannot reach a state's gap voltage; `largest`: largest cell voltage, V."""
    model = model_of(scene)
    if scene.network.gaps[0] is None:
        return False
    k_u = model.k_gap * state.u_before
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
    """Rows as in `Record` from rows of `engine.model.write_row`."""
    model, out = model_of(scene), as_marched(scene, rows, by_layer)
    out[:, :-2] *= (scene.shown if by_layer else scene).turn
    if model.mobile:
        out[:, -2] += rows[:, 0] / rows[:, 2] / model.s - offset
    return out


def row_width(scene: Scene) -> int:
    """Number of columns in a row of `engine.model.write_row`."""
    return 6 + model_of(scene).gap.size
