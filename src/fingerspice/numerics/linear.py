"""Linear systems in modal form, w_k' = -rate_k w_k + gain_k U(t), answered in closed form.

The input is given on segments: between two edges, with tau the time since the first, it is

    U = sum over i of c tau^p exp(a tau) cos(phi + omega tau)  +  a Chebyshev series in 2 tau / length - 1.

Nothing is stepped: the response at a time depends on the segment's start and on that time alone, and its error is a few
roundings of the largest |w| for any rate and any length, on and off resonance.

For samples joined by straight lines there is another way (`first_order_hold`). In each stretch of samples the modes run
from zero, and what they had before decays in closed form beside that. So the state is rounded once in a stretch, with
the rounding carried on: a slow mode does not add up that of every sample.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, IntArray, read_only
from fingerspice.base.compiled import jit, jit_fused

# exp(-690) = 2e-300: beyond, an exponential is zero, before any product with it can become a (slow) denormal number.
_LAST_EXPONENT = 690.0
_SMALLEST = 1e-300
# A mean input below this part of the largest is the rounding of a mean of zero.
_ZERO_MEAN = 1e-12


@jit
def _exp(x: float) -> float:
    return math.exp(x) if x > -_LAST_EXPONENT else 0.0


@jit
def _difference(a: float, b: float) -> tuple[float, float]:
    """a - b rounded, and its rounding error."""
    d = a - b
    back = d - a
    return d, (a - (d - back)) - (b + back)


@jit
def _turn(omega: float, tau: float, rest: float) -> complex:
    """exp(i omega (tau + rest)), the product taken to twice the working precision: omega tau may be 1e9 rad."""
    angle = omega * tau
    # Dekker's exact product, from halves of 26 bits.
    split = 134217729.0 * omega
    omega_high = split - (split - omega)
    omega_low = omega - omega_high
    split = 134217729.0 * tau
    tau_high = split - (split - tau)
    tau_low = tau - tau_high
    lost = (omega_high * tau_high - angle) + omega_high * tau_low + omega_low * tau_high + omega_low * tau_low
    lost += omega * rest
    c = math.cos(angle)
    s = math.sin(angle)
    shrink = 1.0 - 0.5 * lost * lost
    return complex(c * shrink - s * lost, s * shrink + c * lost)


@jit
def _convolution(
    p: int, exponent: complex, size: float, inverse: complex, tau: float, decay: float, wave: complex
) -> complex:
    """Integral over s in [0, tau] of exp(-rate (tau - s)) s^p exp(sigma s): real where sigma is.

    `exponent` is rate + sigma, of the magnitude `size`, `decay` is exp(-rate tau) and `wave` exp(sigma tau).
    """
    reach = size * tau
    if reach <= p + 1:
        # Sum of (-z)^j / ((p + 1) ... (p + 1 + j)), z = exponent tau: its terms fall from the first on, so that near
        # a resonance nothing cancels.
        step = -exponent * tau
        term = wave * (tau / (p + 1))
        for _ in range(p):
            term *= tau
        total = term
        bound = 1.0
        j = p + 1
        while bound > 1e-17:
            j += 1
            part = 1.0 / j
            bound *= reach * part
            term *= step * part
            total += term
        return total
    # By parts, upward in p: stable as each step divides an error by exponent tau / p > 1.
    total = (wave - decay) * inverse
    power = 1.0
    for j in range(1, p + 1):
        power *= tau
        total = (power * wave - j * total) * inverse
    return total


@jit
def _clenshaw(c: FloatArray, row: int, count: int, s: float) -> float:
    """Chebyshev series c[row, :count] in 2 s - 1, the digits of a small s kept (Reinsch's form of the recurrence)."""
    b = 0.0
    d = 0.0
    for k in range(count - 1, 0, -1):
        d = (c[row, k] - d) + 4.0 * s * b
        b = d - b
    value: float = (c[row, 0] - d) + 2.0 * s * b
    return value


@jit
def _inverse(z: complex) -> complex:
    size = z.real * z.real + z.imag * z.imag
    return complex(z.real / size, -z.imag / size) if size > 0.0 else 0j


@jit
def _room(count: int) -> int:
    """Coefficients that `_particular` may need for a series of `count`."""
    return int(math.sqrt(count**2 + 80.0 * max(8.0, 0.25 * count**2))) + 16


@jit
def _particular(f: FloatArray, count: int, kappa: float, pivot: FloatArray, w: FloatArray) -> int:
    """Chebyshev series of one solution of dw/dx + kappa w = f on [-1, 1]; f has `count` coefficients.

    Writes the coefficients into w (`pivot` is work space of the same size) and returns their number. The series of
    dw/dx and w are tied by w'_{k-1} - w'_{k+1} = 2 k w_k (w'_0 counts twice), which makes the equation tridiagonal.
    """
    if kappa > max(8.0, 0.25 * count**2):
        # Fast decay: the polynomial solution, from its highest coefficient down.
        above = 0.0
        w[count - 1] = f[count - 1] / kappa
        for k in range(count - 1, 0, -1):
            twice = 2.0 if k == 1 else 1.0
            f_above = f[k + 1] if k + 1 < count else 0.0
            w[k - 1] = f[k - 1] / kappa + (above - (f_above + 2.0 * k * w[k]) / kappa) / twice
            above = w[k]
        return count
    # Slow decay: the solution without a constant, which takes up some of exp(-kappa x) and needs more coefficients.
    # Eliminated downward, from where the diagonal is largest, all pivots are near k + sqrt(k^2 + kappa^2).
    last = int(math.sqrt(count**2 + 80.0 * kappa)) + 14
    carried = 0.0
    for k in range(last, 0, -1):
        pivot[k] = 1.0 / (2.0 * k + (kappa * kappa * pivot[k + 1] if k < last else 0.0))
        if k - 1 < count:
            carried += f[k - 1] if k > 1 else 2.0 * f[0]
        if k + 1 < count:
            carried -= f[k + 1]
        w[k] = carried
        carried *= kappa * pivot[k]
    w[0] = 0.0
    for k in range(1, last + 1):
        w[k] = (w[k] - kappa * w[k - 1]) * pivot[k]
    return last + 1


@jit
def _prepare_series(
    rates: FloatArray, gains: FloatArray, series: FloatArray, s: int, length: float, count: IntArray, out: FloatArray
) -> None:
    """Write Chebyshev series of solutions for the input series[s] into out (n + 2, room), their lengths into count."""
    n = rates.size
    size = series.shape[1]
    while size > 1 and series[s, size - 1] == 0.0:
        size -= 1
    for k in range(n):
        for j in range(size):
            out[n, j] = 0.5 * length * gains[k] * series[s, j]
        count[k] = _particular(out[n], size, 0.5 * length * rates[k], out[n + 1], out[k])


@jit
def _respond(
    rates: FloatArray, gains: FloatArray, edges: FloatArray, terms: FloatArray, series: FloatArray, w: FloatArray,
    t_out: FloatArray, left: NDArray[np.bool_], rows: FloatArray,
) -> None:  # fmt: skip
    """`respond` compiled: outputs written into `rows`, w taken from start to end."""
    n = rates.size
    n_terms = terms.shape[1]
    decay = np.zeros(n)
    kept = np.zeros(n)
    # The rounding error of w at the end of a segment.
    carry = np.zeros(n)
    new = np.zeros(n)
    amplitude = np.zeros(n_terms, np.complex128)
    inverse = np.zeros((n_terms, n), np.complex128)
    size = np.zeros((n_terms, n))
    count = np.zeros(n, np.int64)
    at_start = np.zeros(n)
    poly = np.zeros((n + 2, _room(series.shape[1])))
    i = 0
    for s in range(edges.size - 1):
        stop = edges[s + 1]
        length, length_rest = _difference(stop, edges[s])
        if not length > 0.0:
            continue
        for j in range(n_terms):
            phi = terms[s, j, 4]
            amplitude[j] = terms[s, j, 0] * (complex(math.cos(phi), math.sin(phi)) if phi != 0.0 else 1.0)
            for k in range(n):
                exponent = complex(rates[k] + terms[s, j, 2], terms[s, j, 3])
                size[j, k] = math.sqrt(exponent.real**2 + exponent.imag**2)
                inverse[j, k] = _inverse(exponent)
        if series.shape[1] > 0:
            _prepare_series(rates, gains, series, s, length, count, poly)
            for k in range(n):
                at_start[k] = _clenshaw(poly, k, count[k], 0.0)
        inside = True
        while inside:
            inside = i < t_out.size and (t_out[i] < stop or (left[i] and t_out[i] == stop))
            tau, rest = _difference(t_out[i], edges[s]) if inside else (length, length_rest)
            for k in range(n):
                reach = rates[k] * tau
                if reach < 0.5:
                    # The change is summed apart: over many segments the rounding of decays near 1 would add up.
                    loss = -math.expm1(-reach)
                    decay[k] = 1.0 - loss
                    kept[k] = w[k]
                    new[k] = carry[k] - loss * w[k]
                else:
                    decay[k] = _exp(-reach)
                    kept[k] = 0.0
                    new[k] = decay[k] * w[k]
            for j in range(n_terms):
                if terms[s, j, 0] == 0.0:
                    continue
                p = int(terms[s, j, 1])
                a = terms[s, j, 2]
                omega = terms[s, j, 3]
                growth = _exp(a * tau) if a != 0.0 else 1.0
                if omega == 0.0:
                    for k in range(n):
                        real = inverse[j, k].real
                        forced = _convolution(p, rates[k] + a, size[j, k], real, tau, decay[k], growth)
                        new[k] += gains[k] * (amplitude[j].real * forced.real)
                else:
                    wave = growth * _turn(omega, tau, rest)
                    for k in range(n):
                        exponent = complex(rates[k] + a, omega)
                        turned = _convolution(p, exponent, size[j, k], inverse[j, k], tau, decay[k], wave)
                        new[k] += gains[k] * (amplitude[j] * turned).real
            if series.shape[1] > 0:
                x = tau / length
                for k in range(n):
                    new[k] += _clenshaw(poly, k, count[k], x) - decay[k] * at_start[k]
            for k in range(n):
                total, lost = _difference(kept[k], -new[k])
                if abs(total) < _SMALLEST:
                    total = lost = 0.0
                if inside:
                    rows[i, k] = total
                else:
                    w[k] = total
                    carry[k] = lost
            if inside:
                i += 1
    while i < t_out.size:
        for k in range(n):
            rows[i, k] = w[k]
        i += 1


def respond(
    rates: ArrayLike, gains: ArrayLike, edges: ArrayLike, terms: ArrayLike, series: ArrayLike, w0: ArrayLike,
    t_out: ArrayLike, left: ArrayLike | None = None,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """State (n_out, n) of n modes at the output times (s, ascending, within the edges), and (n,) at the end.

    `rates` (1/s, 0 or more) and `gains` (1/s for a w in the unit of U) are of the modes, whose state at edges[0] is
    `w0`. `edges` (m + 1,) are those of the segments, ascending, s; `terms` (m, k, 6) are c, p, a, omega, phi, beta of
    each term, of which p is a whole number and beta 0, and c = 0 is no term; `series` (m, l) are the Chebyshev
    coefficients of the input on each segment, if any. `left` tells whether an output on an edge belongs to the segment
    that ends there: the state is the same to the bit. No output depends on which other times are asked for.
    """
    rates, gains, edges, terms, series, w, t_out = (_plain(x) for x in (rates, gains, edges, terms, series, w0, t_out))
    rows, w = np.empty((t_out.size, rates.size)), w.copy()
    left = np.zeros(t_out.size, bool) if left is None else np.require(left, bool, ["C", "W"])
    _respond(rates, gains, edges, terms, series, w, t_out, left, rows)
    return rows, w


def periodic_state(
    rates: ArrayLike, gains: ArrayLike, edges: ArrayLike, terms: ArrayLike, series: ArrayLike
) -> FloatArray:
    """State (n,) at edges[0] to which one pass over the segments leads back; the arguments are those of `respond`.

    A mode without decay has one only where its mean input is zero, and then has many: it starts from 0. With an input
    whose mean is not zero it has none: NaN. The error of a slow mode is that of the mean input over rate x period.
    """
    rates, gains, edges, terms, series = (_plain(x) for x in (rates, gains, edges, terms, series))
    _, w = respond(rates, gains, edges, terms, series, np.zeros(rates.size), np.empty(0))
    length = np.diff(edges)
    c, p, a = terms[..., 0], terms[..., 1], terms[..., 2]
    largest = np.where(c != 0.0, np.abs(c) * length[:, None] ** p * np.exp(np.maximum(a * length[:, None], 0.0)), 0.0)
    bound = largest.sum(axis=1) + np.abs(series).sum(axis=1)
    # The lengths are as uncertain as the edges are rounded.
    zero = bound @ (_ZERO_MEAN * length + 1e-15 * (np.abs(edges[:-1]) + np.abs(edges[1:])))
    kept = -np.expm1(-rates * (edges[-1] - edges[0]))
    neutral = np.where(np.abs(w) <= zero * np.abs(gains), 0.0, np.nan)
    return np.where(kept > 0.0, w / np.where(kept > 0.0, kept, 1.0), neutral)


def _plain(x: ArrayLike) -> FloatArray:
    """The argument as an array of the one kind that the code is compiled for."""
    return np.require(x, float, ["C", "W"])


# Beyond, each moment follows from the one below; before, that would lose digits, and they follow from the highest.
_LATE = 4.0


@jit
def moments(z: float, out: FloatArray) -> None:
    """Integrals of exp(-z (1 - x)) x^j over [0, 1] for z >= 0 into `out` (count,), j from 0; to a few roundings."""
    count = out.size
    if z > _LATE:
        out[0] = -math.expm1(-z) / z
        for j in range(1, count):
            out[j] = (1.0 - j * out[j - 1]) / z
        return
    # exp(-z) sum of z^k / (k! (k + count)): all terms are positive, and once one is small the next are smaller.
    total, term, k = 0.0, 1.0, 0.0
    while term > 1e-17 * total:
        total += term / (k + count)
        k += 1.0
        term *= z / k
    out[count - 1] = math.exp(-z) * total
    for j in range(count - 1, 0, -1):
        out[j - 1] = (1.0 - z * out[j]) / j


_STRETCH = 500
# Below, a number counts as zero, before it becomes a (slow) denormal one.


@jit_fused
def _run(x: FloatArray, before: float, fall: FloatArray, by: FloatArray, out: FloatArray) -> None:
    """Two modes w <- fall w + by[:, 0] u_before + by[:, 1] u from zero: chains that the processor runs side by side."""
    e, f, v, w = fall[0], fall[1], 0.0, 0.0
    for i in range(x.size):
        v = e * v + (by[0, 0] * before + by[0, 1] * x[i])
        w = f * w + (by[1, 0] * before + by[1, 1] * x[i])
        out[0, i], out[1, i] = v, w
        before = x[i]


@jit_fused
def _hold(
    u: FloatArray, z: FloatArray, by: FloatArray, direct: FloatArray, weights: FloatArray, state: FloatArray,
    y: FloatArray,
) -> None:  # fmt: skip
    """Outputs y (n_y, m) of an even number of modes; `state` (n,) at the first of u (m,) is taken to the last.

    `z` is rate dt, and `by` (n, 2) has the weights of the samples at the start and the end of a step.
    """
    n, room, carry = z.size, np.empty((2, _STRETCH)), np.zeros(z.size)
    fall = np.empty((n, _STRETCH))
    for k in range(n):
        for i in range(_STRETCH):
            fall[k, i] = math.exp(-z[k] * (i + 1.0))
            if fall[k, i] < _SMALLEST:
                fall[k, i] = 0.0
    for j in range(direct.size):
        y[j, 0] = direct[j] * u[0]
        for k in range(n):
            y[j, 0] += weights[j, k] * state[k]
    for s in range(1, u.size, _STRETCH):
        x = u[s : s + _STRETCH]
        size = x.size
        for j in range(direct.size):
            out, g = y[j, s : s + size], direct[j]
            for i in range(size):
                out[i] = g * x[i]
        for k in range(0, n, 2):
            _run(x, u[s - 1], fall[k : k + 2, 0], by[k : k + 2], room)
            v, w, v_fall, w_fall = room[0, :size], room[1, :size], fall[k, :size], fall[k + 1, :size]
            for j in range(direct.size):
                out, g, h = y[j, s : s + size], weights[j, k], weights[j, k + 1]
                g_before, h_before = g * state[k], h * state[k + 1]
                for i in range(size):
                    out[i] += (g * v[i] + g_before * v_fall[i]) + (h * w[i] + h_before * w_fall[i])
            for j in range(2):
                # A slow mode is what it was and a change; a fast one keeps its digits as it decays.
                old, path = state[k + j], z[k + j] * size
                kept, left = (old, math.expm1(-path)) if path < 0.5 else (0.0, math.exp(-path))
                change = room[j, size - 1] + (left * old + carry[k + j])
                new = kept + change
                carry[k + j] = (kept - new) + change
                state[k + j] = 0.0 if abs(new) < _SMALLEST else new


def first_order_hold(
    u: FloatArray, dt: float, rates: FloatArray, gains: FloatArray, direct: FloatArray, weights: FloatArray,
    w0: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Outputs y = direct U + weights w (n_y, m) at samples joined by straight lines, and the state at the last one.

    `u` (m,) are one or more samples, `dt` (s) apart; `rates` (1/s, 0 or more) and `gains` (n,) are of the modes w,
    whose state at the first sample is `w0`; `direct` (n_y,) is the share of the input that appears at once.
    """
    n, y = rates.size, np.empty((direct.size, u.size))
    # A last mode without gain or weight completes an odd number.
    pairs = n + n % 2
    z, by, shares, state = np.zeros(pairs), np.zeros((pairs, 2)), np.zeros((direct.size, pairs)), np.zeros(pairs)
    z[:n], shares[:, :n], state[:n] = rates * dt, weights, w0
    for one, row in zip(z[:n].tolist(), by, strict=False):
        moments(one, row)
    # Of a straight line, by its values at both ends.
    by[:n] = np.column_stack([by[:n, 0] - by[:n, 1], by[:n, 1]]) * (gains * dt)[:, None]
    _hold(read_only(np.ascontiguousarray(u)), z, by, np.ascontiguousarray(direct), shares, state, y)
    return y, state[:n]
