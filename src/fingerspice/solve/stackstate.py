"""The state of a series stack as its own equations have it, from that of any circuit, and back.

There x = v along the loop under `local` and v = x A_0 / A under `mobile`, for live voltages k U + v (see
`engine.model`). The charge that the source has delivered is z under `local`, and z + A U / S - offset under `mobile`.
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
    """A state in the engine's form.

    Attributes
    ----------
    t : float
        s.
    y : ndarray, shape (n + 1,)
        x (V) and z (C).
    u_before : float
        Voltage around the loop just before `t`, V.
    u_gap : float
        Gap voltage along the loop, V.
    offset : float
        Subtracted from the charge so that it starts with what has been delivered, C.
    """

    t: float
    y: FloatArray
    u_before: float
    u_gap: float
    offset: float


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
    # Of what follows the source at once, no charge is stored: what is left is rounding.
    x[np.abs(x) <= 4e-16 * np.abs(share)] = 0.0
    return StackState(state.t, np.append(x / scale, state.y[-1]), before, u_gap, offset)


def along_gap(model: Model, along: FloatArray, u_source: FloatArray) -> FloatArray:
    """Gap voltages (n_t,) from rows of live voltages along the loop (n_t, n) and the source's, V."""
    x = np.einsum("tk,k->t", along[:, : model.gap.size], model.gap)
    # Without states, or where the gap is not one of them, it takes what the others leave.
    return np.asarray(x if model.gap.size and model.gap.max() > 0.0 else u_source + x)


def from_stack(scene: Scene, state: StackState) -> State:
    """A state in the engine's form as that of any circuit."""
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
    """Whether no rise of the source from 0 V leads to a state's gap voltage; `largest` is that of all layers, V."""
    model = model_of(scene)
    if scene.network.gaps[0] is None:
        return False
    k_u = model.k_gap * state.u_before
    sign = choose_branch(model, state.u_before, state.y)
    found = float(gap_voltage(model, k_u, float(model.gap @ state.y[:-1]), sign, k_u))
    # Behind an insulating coating the gap's 0 V are the difference of others.
    return not abs(found - state.u_gap) <= 1e-9 * abs(state.u_gap) + 1e-13 * largest


def as_marched(scene: Scene, rows: FloatArray, by_layer: bool = True) -> FloatArray:
    """Rows as the loop writes them from those of `write_row`: voltages along the loop, z and the current.

    The voltages are those of the recorded layers (`Scene.shown`), or of all cells.
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
    """Rows as in `Record` from those of `engine.model.write_row`."""
    model, out = model_of(scene), as_marched(scene, rows, by_layer)
    out[:, :-2] *= (scene.shown if by_layer else scene).turn
    if model.mobile:
        out[:, -2] += rows[:, 0] / rows[:, 2] / model.s - offset
    return out


def row_width(scene: Scene) -> int:
    """Columns of a row of `engine.model.write_row`."""
    return 6 + model_of(scene).gap.size
