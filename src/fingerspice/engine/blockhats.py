"""Triangles of the drives in steps of several samples, where the slope of the source jumps at samples within the step.

A drive g(U, w) contains the triangles of the source (`blockforms.Coarse`) times its derivative by U, which no parabola
shows. The modes' response to such triangles, less that to the parabola through them, is known in closed form, and is
added. The derivative is taken from the ends and the middle of the step.
"""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_rows, jit_within
from fingerspice.engine.blockforms import FIRST_QUARTER, LAST_QUARTER, MIDDLE, Form, Room
from fingerspice.engine.blockrows import add_bumps, area_rows


@jit_rows
def _derivatives(
    n: int, k_gap: float, k: float, slope: FloatArray, u: FloatArray, z: FloatArray, x: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    """Derivative by U of z x, where u and x contain the shares `k_gap` and k of U, and `slope` is dz/d|u|."""
    for i in range(n):
        by_u = slope[i] if u[i] >= 0.0 else -slope[i]
        out[i] = k_gap * by_u * x[i] + k * z[i]


@jit_rows
def _hat_rows(n: int, ends: FloatArray, bumps: FloatArray, hats: FloatArray) -> None:
    """Triangles `hats` (3, n), from derivatives at the ends of the steps and, in the row of the middle, there."""
    for i in range(n):
        here = hats[MIDDLE, i]
        hats[FIRST_QUARTER, i] = 0.5 * (ends[i] + here) * bumps[FIRST_QUARTER, i]
        hats[MIDDLE, i] = here * bumps[MIDDLE, i]
        hats[LAST_QUARTER, i] = 0.5 * (here + ends[i + 1]) * bumps[LAST_QUARTER, i]


@jit_within
def look_at_middle(form: Form, room: Room, n: int) -> None:
    """Derivatives of the drives in the middle of the steps, from a look there: into a row of `Room.hats` each."""
    slope = room.slope
    area_rows(n, form.coarse.slope, form.scale, form.shift, 0.0, room.u_within[MIDDLE], slope)
    for t in range(room.g.shape[0]):
        _derivatives(
            n, form.k_gap, form.tap_s[1 + t], slope, room.u_within[MIDDLE], room.z, room.within[MIDDLE, 1 + t],
            room.hats[t, MIDDLE],
        )  # fmt: skip


@jit_within
def find_hats(form: Form, room: Room, n: int) -> None:
    """The triangles of the drives, after `look_at_middle`, from a look at the ends of the steps."""
    # The row of the fast part of N serves as scratch: steps of several samples have no such part.
    slope, ends = room.slope, room.pulse
    area_rows(n + 1, form.coarse.slope, form.scale, form.shift, 0.0, room.u, slope)
    for t in range(room.g.shape[0]):
        _derivatives(n + 1, form.k_gap, form.tap_s[1 + t], slope, room.u, room.z, room.end[1 + t], ends)
        _hat_rows(n, ends, room.bumps, room.hats[t])


@jit_within
def add_hats(room: Room, by_hats: FloatArray, n: int, out: FloatArray) -> None:
    """Add the response to the triangles of all drives, with weights (T, 3)."""
    for t in range(room.g.shape[0]):
        add_bumps(n, by_hats[t], room.hats[t], out)


@jit_rows
def hats_at(n: int, place: int, weight: float, hats: FloatArray, out: FloatArray) -> None:
    """Subtract from interpolation errors at a place what triangles cause there; their middle has this weight."""
    for i in range(n):
        out[i] -= hats[place, i] - weight * hats[MIDDLE, i]
