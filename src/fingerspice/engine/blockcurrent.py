"""Current at the starts of the steps of a recording, or at the samples within them."""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.blockcourse import Course, inverse_area_at
from fingerspice.engine.blockforms import Room
from fingerspice.engine.blockrows import modes_into, scaled


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
    if not form.mobile:
        leak = (slow[n + 2] + q * slow[n + 3]) * (slow[n] * source + v)
        return float((slow[n + 1] * dv + leak + slope / model.s) / q)
    scale = model.area0 * q
    lam = slow[n + 1] * dv * scale + (slow[n + 2] + q * slow[n + 3]) * (slow[n] * source + v * scale)
    # i = Q' with Q = A U / S + z, and u' from the area equation.
    du = (model.k_gap * slope + dx_gap * scale) / (1.0 - x_gap * model.area0 * dq)
    return float(lam / q + (slope / q - dq * du * source / (q * q)) / model.s)


@jit_rows
def _current_rows(
    n: int, slow: FloatArray, over_s: float, slopes: FloatArray, dv: FloatArray, v: FloatArray, q: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Right-hand limit of the current (A) in n places, under `local`."""
    c, g_area, g_total = slow[slow.size - 3], slow[slow.size - 2], slow[slow.size - 1]
    for i in range(n):
        out[i] = (c * dv[i] + g_area * v[i] + slopes[i] * over_s) / q[i] + g_total * v[i]


@jit
def current_block(c: Course, r: int, room: Room, n: int, slopes: FloatArray, q: FloatArray) -> None:
    """Right-hand limit of the current (A) at one place of n steps, whose rows are in `room`, into `Charges.current`.

    `slopes` (n,) are the source's (V/s), and q (n,) is 1/A.
    """
    form, shown, own = c.form, c.shown, c.charges
    m, drives = form.rates.shape[1], room.g.shape[0]
    if form.mobile:
        w, g = c.spare[0, :m], c.spare[1, :drives]
        for i in range(n):
            for k in range(m):
                w[k] = room.w[k, i]
            for t in range(drives):
                g[t] = room.g[t, i]
            own.current[i] = current_at(c, r, w, g, room.s[i], slopes[i], room.u[i])
        return
    share, by_g, by_s, dv = c.spare[0, :m], c.spare[1, :drives], 0.0, c.room.before
    for t in range(drives):
        by_g[t] = 0.0
    for k in range(m):
        share[k] = -form.rates[r, k] * shown.slow[r, k]
        by_s += form.gain[r, k] * shown.slow[r, k]
        for t in range(drives):
            by_g[t] += shown.slow[r, k] * form.feed[r, k, t]
    scaled(n, by_s, room.s, dv)
    modes_into(n, 0, share, room.w, dv)
    modes_into(n, 0, by_g, room.g, dv)
    _current_rows(n, c.model.slow, 1.0 / c.model.s, slopes, dv, room.end[form.tap_s.size - 1], q, own.current)
