"""Linear systems in modal form, w_k' = -rate_k w_k + gain_k U(t), driven by samples joined by straight lines.

Each sample of the recursion w <- exp(-rate dt) w + input depends on the one before. Eight stretches of each block are
therefore advanced side by side, all from zero; the decaying exponential that each inherits from the one before is added
afterwards.
Blocks are counted from the first sample, so that an input that comes in whole blocks gives the bits of a single call.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit

Lanes: TypeAlias = tuple[float, float, float, float, float, float, float, float]

# Not a power of two: eight stretches that far apart would meet in the same sets of the cache.
_STRETCH = 125
_LANES = 8
BLOCK = _LANES * _STRETCH
"""Samples: an input streamed in multiples of this gives the same bits as in one call."""
# Number of samples converted at a time, so that an input that is no plain array needs little memory.
_PIECE = 250 * BLOCK
_SMALLEST = 1e-300


@jit
def hold_weights(z: float) -> tuple[float, float]:
    """Weights of the samples at the start and the end of a step, of the integral of exp(-z (1 - x)) U(x) over [0, 1].

    They are (1 - (1 + z) exp(-z)) / z^2 and (z - 1 + exp(-z)) / z^2, for z >= 0, to full precision.
    """
    if z >= 1.0:
        fall = math.exp(-z)
        return (1.0 - (1.0 + z) * fall) / z / z, (1.0 - (1.0 - fall) / z) / z
    start = 0.0
    end = 0.0
    for k in range(20, -1, -1):
        # Sums of (-z)^k / (k! (k + 2)) and of 2 (-z)^k / (k + 2)!, as nested products.
        start = 1.0 / (k + 2) - z / (k + 1) * start
        end = 1.0 - z / (k + 3) * end
    return start, 0.5 * end


@jit
def _load(x: FloatArray, i: int) -> Lanes:
    n = _STRETCH
    return (x[i], x[n + i], x[2 * n + i], x[3 * n + i], x[4 * n + i], x[5 * n + i], x[6 * n + i], x[7 * n + i])


@jit
def _step(v: Lanes, e: float, x: Lanes) -> Lanes:
    return (
        e * v[0] + x[0],
        e * v[1] + x[1],
        e * v[2] + x[2],
        e * v[3] + x[3],
        e * v[4] + x[4],
        e * v[5] + x[5],
        e * v[6] + x[6],
        e * v[7] + x[7],
    )


@jit
def _store(y: FloatArray, i: int, v: Lanes) -> None:
    n = _STRETCH
    y[i] = v[0]
    y[n + i] = v[1]
    y[2 * n + i] = v[2]
    y[3 * n + i] = v[3]
    y[4 * n + i] = v[4]
    y[5 * n + i] = v[5]
    y[6 * n + i] = v[6]
    y[7 * n + i] = v[7]


@jit
def _sweep(
    x: FloatArray, i0: int, i1: int, e: float, f: float, v: Lanes, w: Lanes, a: FloatArray, b: FloatArray
) -> tuple[Lanes, Lanes]:
    """Advance two modes over the samples i0 to i1 of every stretch, writing their states into a and b."""
    for i in range(i0, i1):
        sample = _load(x, i)
        _store(a, i, v)
        _store(b, i, w)
        v = _step(v, e, sample)
        w = _step(w, f, sample)
    return v, w


@jit
def _flushed(x: float) -> float:
    """Zero in place of a number that would soon become a (slow) denormal one; NaN stays."""
    return 0.0 if abs(x) < _SMALLEST else x


@jit
def _decay(z: float) -> tuple[float, float]:
    """exp(-z) as 1 or 0 and the rest: x exp(-z) = whole x + rest x keeps the digits of a decay fast or slow."""
    return (1.0, math.expm1(-z)) if z < 0.5 else (0.0, math.exp(-z))


@jit
def _hold(
    u: FloatArray,
    count: int,
    z: FloatArray,
    gains: FloatArray,
    direct: FloatArray,
    weights: FloatArray,
    state: FloatArray,
    is_first: bool,
    y: FloatArray,
    place: int,
) -> None:
    """Outputs y (n_y, m), from column `place` on, of whole blocks u of which `count` samples are real.

    The number of modes is even. `z` is rate dt and `gains` gain dt. `state` (n + 1,) holds w, then the sample, at the
    last time before u, and is taken to the last of u; with `is_first`, w is that at the first sample of u.
    """
    n = z.size
    # w <- exp(-z) w + start u_before + end u. With v = w - end u each sample enters once, v <- exp(-z) v + once u, and
    # y = through u + sum of weight v. In a sweep v is in units of `once`.
    start = np.empty(n)
    end = np.empty(n)
    once = np.empty(n)
    fall = np.empty((n, _STRETCH))
    # The decay over c stretches.
    whole = np.empty((n, _LANES))
    rest = np.empty((n, _LANES))
    through = direct.copy()
    for k in range(n):
        start[k], end[k] = hold_weights(z[k])
        start[k] *= gains[k]
        end[k] *= gains[k]
        once[k] = start[k] + math.exp(-z[k]) * end[k]
        for j in range(through.size):
            through[j] += weights[j, k] * end[k]
        for i in range(_STRETCH):
            fall[k, i] = _flushed(math.exp(-z[k] * i))
        for c in range(_LANES):
            whole[k, c], rest[k, c] = _decay(z[k] * (_STRETCH * c))
    a = np.empty(BLOCK)
    b = np.empty(BLOCK)
    inherited = np.empty((2, _LANES))
    last = np.empty(2)
    for s in range(0, u.size, BLOCK):
        x = u[s : s + BLOCK]
        # The state goes over to the next block at the last real sample of this one.
        stop = min(BLOCK, count - s) - 1
        lane = stop // _STRETCH
        depth = stop % _STRETCH
        for j in range(through.size):
            # The compiler makes vector instructions only of loops over whole arrays, without other indices.
            out = y[j][place + s : place + s + BLOCK]
            g = through[j]
            for i in range(BLOCK):
                out[i] = g * x[i]
        for pair in range(0, n, 2):
            e = fall[pair, 1]
            f = fall[pair + 1, 1]
            v = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            v, w = _sweep(x, 0, depth, e, f, v, v, a, b)
            last[0] = v[lane]
            last[1] = w[lane]
            v, w = _sweep(x, depth, _STRETCH, e, f, v, w, a, b)
            for j in range(2):
                k = pair + j
                kept, left = _decay(z[k])
                to_first = left * state[k] + start[k] * state[n]
                if is_first and s == 0:
                    kept, to_first = 1.0, -end[k] * x[0]
                first = kept * state[k] + to_first
                own = 0.0
                to_lane = 0.0
                for c in range(_LANES):
                    change = rest[k, c] * first + own
                    inherited[j, c] = _flushed(whole[k, c] * first + change)
                    own = whole[k, 1] * own + (rest[k, 1] * own + once[k] * (v[c] if j == 0 else w[c]))
                    if c == lane:
                        to_lane = change
                begin = inherited[j, lane]
                kept, left = _decay(z[k] * depth)
                to_last = left * begin + (once[k] * last[j] + end[k] * x[stop])
                if z[k] * BLOCK < 0.5:
                    # Rounded once in a block: a slow mode adds up thousands of them.
                    state[k] += to_first + to_lane + to_last
                else:
                    state[k] = kept * begin + to_last
            for c in range(_LANES):
                g = once[pair]
                h = once[pair + 1]
                v_begin = inherited[0, c]
                w_begin = inherited[1, c]
                v_part = a[c * _STRETCH : (c + 1) * _STRETCH]
                w_part = b[c * _STRETCH : (c + 1) * _STRETCH]
                for i in range(_STRETCH):
                    v_part[i] = g * v_part[i] + v_begin * fall[pair, i]
                    w_part[i] = h * w_part[i] + w_begin * fall[pair + 1, i]
            for j in range(through.size):
                out = y[j][place + s : place + s + BLOCK]
                g = weights[j, pair]
                h = weights[j, pair + 1]
                for i in range(BLOCK):
                    out[i] += g * a[i] + h * b[i]
        state[n] = x[stop]


def first_order_hold(
    u: ArrayLike,
    dt: float,
    rates: ArrayLike,
    gains: ArrayLike,
    direct: ArrayLike,
    weights: ArrayLike,
    w0: ArrayLike,
    u_before: float | None = None,
    out: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Output of a linear system for a sampled input, exact for the straight lines that join the samples.

    Solves w_k' = -rate_k w_k + gain_k U(t) and gives y = direct U + sum of weight_k w_k at the samples, or several such
    y. Nothing in y depends on later samples; a sample that is not finite leaves nothing finite from there on.

    Parameters
    ----------
    u : array_like, shape (m,)
        Samples, real. Any strides; what is not double precision is converted piece by piece.
    dt : float
        Time between samples, s.
    rates, gains : array_like, shape (n,)
        Decay rates (>= 0, 1/s) and input gains (1/s for a w in the unit of U) of the modes.
    direct : float or array_like, shape (n_y,)
        Share of the input that appears in the output at once.
    weights : array_like, shape (n,) or (n_y, n)
        Output weights of the modes.
    w0 : array_like, shape (n,)
        State at the first sample or, with `u_before`, one step before it.
    u_before : float, optional
        Sample one step before the first: with it and the state returned for the input so far, an input may be given
        in parts. Parts that are multiples of `BLOCK` give the same bits as the whole.
    out : ndarray, shape (m,) or (n_y, m), optional
        Where to write y: double precision, contiguous.

    Returns
    -------
    y : ndarray, shape (m,) or (n_y, m)
    w_end : ndarray, shape (n,)
        State at the last sample.
    """
    u = np.asarray(u)
    if u.ndim != 1 or not np.can_cast(u.dtype, np.float64, "same_kind"):
        raise ValueError(f"samples of shape {u.shape} and type {u.dtype}; allowed: a row of real numbers")
    given, through = [np.asarray(x, float) for x in (rates, gains, w0, weights)], np.asarray(direct, float)
    n, shape = given[0].size, through.shape + u.shape
    if any(x.shape != (n,) for x in given[:3]) or given[3].shape != (*through.shape, n) or through.ndim > 1:
        raise ValueError(
            f"rates, gains, state and weights of shape {[x.shape for x in given]}; allowed: (n,), and {through.shape} "
            "of direct before the n of weights"
        )
    # Modes are advanced in pairs: a last one without gain or weight completes an odd number.
    modes, by = np.zeros((3, n + n % 2)), np.zeros((through.size, n + n % 2))
    modes[:, :n], by[:, :n] = given[:3], given[3]
    if not (0.0 < dt < math.inf and np.all((modes[0] >= 0.0) & (modes[0] < math.inf))):
        raise ValueError(f"time step {dt!r} s, rates {given[0]} 1/s; allowed: finite, > 0 and >= 0")
    if out is None:
        out = np.empty(shape)
    elif out.shape != shape or out.dtype != np.float64 or not out.flags.carray or np.may_share_memory(out, u):
        raise ValueError(f"output of shape {out.shape}, type {out.dtype}; allowed: contiguous float64 {shape}, not u")
    state = np.append(modes[2], 0.0 if u_before is None else u_before)
    rows = out.reshape(through.size, u.size)
    _by_pieces(u, modes[:2] * dt, through.reshape(-1), by, state, u_before is None, rows)
    return out, state[:n].copy()


def _by_pieces(
    u: FloatArray,
    modes: FloatArray,
    through: FloatArray,
    by: FloatArray,
    state: FloatArray,
    is_first: bool,
    rows: FloatArray,
) -> None:
    """As `_hold` for any number of samples of any type and strides; `modes` (2, n) is rate dt and gain dt."""
    for s in range(0, u.size, _PIECE):
        piece = u[s : s + _PIECE]
        whole = piece.size - piece.size % BLOCK
        tail = np.zeros(BLOCK)
        tail[: piece.size - whole] = piece[whole:]
        end = np.empty((through.size, BLOCK))
        for x, count, y, place in ((piece[:whole], whole, rows, s), (tail, piece.size - whole, end, 0)):
            if count > 0:
                x = np.require(x, float, ["C", "A"]).view()
                # Constant arrays and others alike: one compiled form.
                x.flags.writeable = False
                _hold(x, count, modes[0], modes[1], through, by, state, is_first, y, place)
                is_first = False
        rows[:, s + whole : s + piece.size] = end[:, : piece.size - whole]
