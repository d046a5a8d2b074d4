"""Current of a recording of a stack under `mobile`."""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.engine.blockcourse import Course, inverse_area_at


@jit
def current_at(
    c: Course, r: int, w: FloatArray, g: FloatArray, source: float, slope: float, u: float
) -> float:  # fmt: skip
    """Current (A) from the modes w, the drives g, the source's value (V) and slope (V/s), and the gap voltage u (V)."""
    model, form, slow = c.model, c.form, c.model.slow
    n = slow.size - 4
    dv, v, x_gap, dx_gap = 0.0, 0.0, 0.0, 0.0
    for k in range(w.size):
        dw = -form.rates[r, k] * w[k] + form.gain[r, k] * source
        for t in range(g.size):
            dw += form.feed[r, k, t] * g[t]
        dv += c.shown.slow[r, k] * dw
        v += c.shown.slow[r, k] * w[k]
        x_gap += form.taps[r, 0, k] * w[k]
        dx_gap += form.taps[r, 0, k] * dw
    q, dq = inverse_area_at(form, u)
    scale = model.area0 * q
    lam = slow[n + 1] * dv * scale + (slow[n + 2] + q * slow[n + 3]) * (slow[n] * source + v * scale)
    # i = Q' with Q = A U / S + z, and u' from the area equation.
    du = (model.k_gap * slope + dx_gap * scale) / (1.0 - x_gap * model.area0 * dq)
    return float(lam / q + (slope / q - dq * du * source / (q * q)) / model.s)


@jit
def current_block(c: Course, r: int, n: int) -> None:
    """Right-hand limit of the current (A) at the starts of n steps, into `Charges.current`."""
    room, own = c.room, c.charges
    w, g = c.spare[0, : c.w.size], c.spare[1, : room.g.shape[0]]
    for i in range(n):
        for k in range(w.size):
            w[k] = room.w[k, i]
        for t in range(g.size):
            g[t] = room.g[t, i]
        own.current[i] = current_at(c, r, w, g, room.s[i], (room.s[i + 1] - room.s[i]) / own.h[i], room.u[i])
