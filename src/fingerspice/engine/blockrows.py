"""Loops over the rows of a block, with one entry for each step; `engine.relaxation` is composed of them.

Each is a function of its own, so that the compiler turns it into vector instructions.
"""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_inline, jit_rows, jit_within

# Zeros in front of a row that `recursion` works on, because it reads entries before the first.
PAD = 8


@jit_rows
def add(n: int, a: float, x: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] += a * x[i]


@jit_rows
def add_two(n: int, a: float, x: FloatArray, b: float, y: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] += a * x[i] + b * y[i]


@jit_rows
def add_three(
    n: int, a: float, x: FloatArray, b: float, y: FloatArray, c: float, z: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    for i in range(n):
        out[i] += a * x[i] + b * y[i] + c * z[i]


@jit_rows
def both_ends(n: int, a: float, b: float, x: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = a * x[i] + b * x[i + 1]


@jit_rows
def add_six(
    n: int, a: FloatArray, x: FloatArray, x_m: FloatArray, b: FloatArray, y: FloatArray, y_m: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    a0, a1, a2, b0, b1, b2 = a[0], a[1], a[2], b[0], b[1], b[2]
    for i in range(n):
        out[i] += a0 * x[i] + a1 * x_m[i] + a2 * x[i + 1] + b0 * y[i] + b1 * y_m[i] + b2 * y[i + 1]


@jit_rows
def of_step(
    n: int, share: FloatArray, s: FloatArray, c: float, w: FloatArray, d: float, v: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    a, b = share[0], share[1]
    for i in range(n):
        out[i] = a * s[i] + b * s[i + 1] + c * w[i] + d * v[i]


@jit_rows
def of_end(n: int, a: float, s: FloatArray, c: float, w: FloatArray, d: float, v: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = a * s[i] + c * w[i] + d * v[i]


@jit_within
def drives_into(n: int, c: FloatArray, g: FloatArray, middle: FloatArray, out: FloatArray) -> None:
    """Add the sum over the drives: c (T, 3) weights their values at the start, middle and end of each step."""
    t = 0
    while t + 1 < c.shape[0]:
        add_six(n, c[t], g[t], middle[t], c[t + 1], g[t + 1], middle[t + 1], out)
        t += 2
    if t < c.shape[0]:
        add_three(n, c[t, 0], g[t], c[t, 1], middle[t], c[t, 2], g[t, 1:], out)


@jit_within
def modes_into(n: int, first: int, c: FloatArray, w: FloatArray, out: FloatArray) -> None:
    """Add the sum of c_k w_k over the modes from `first` on."""
    k = first
    while k + 1 < c.size:
        add_two(n, c[k], w[k], c[k + 1], w[k + 1], out)
        k += 2
    if k < c.size:
        add(n, c[k], w[k], out)


@jit_rows
def scaled(n: int, a: float, x: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = a * x[i]


@jit_rows
def product_of(n: int, x: FloatArray, y: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = x[i] * y[i]


@jit_rows
def add_to_all(n: int, a: float, x: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = a + x[i]


@jit_rows
def settle(n: int, rest: float, error: FloatArray, w: FloatArray) -> None:
    """Correct w by its error, of which the share `rest` is left."""
    for i in range(n):
        w[i] += error[i]
        error[i] *= rest


@jit_rows
def sign_as(n: int, x: FloatArray, out: FloatArray) -> None:
    """Give each entry the sign of x."""
    for i in range(n):
        out[i] = out[i] if x[i] >= 0.0 else -out[i]


@jit_rows
def pulse_rows(
    n: int, h: float, kappa: float, q0: float, faded: float, z: FloatArray, slope: FloatArray, bend: FloatArray,
    middle: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Size of the part exp(-faded x) of N in each step, x from 0 to 1, where xi starts with this slope, into `out`.

    N is given at the ends and in the middle; the rest of it is a parabola.
    """
    over = faded - 3.0 + 4.0 * math.exp(-0.5 * faded) - math.exp(-faded)
    for i in range(n):
        e = -z[i] / (q0 * (q0 + z[i]))
        true = h * slope[i] * e / (1.0 + kappa * e)
        out[i] = (4.0 * middle[i] - 3.0 * bend[i] - bend[i + 1] - true) / over


@jit_rows
def _doubled(n: int, decay: float, by: int, x: FloatArray, out: FloatArray) -> None:
    """Decayed sums over twice as many increments: each sum plus that of the `by` increments before it."""
    for i in range(n):
        out[PAD + i] = x[PAD + i] + decay * x[PAD + i - by]


@jit_rows
def _by_eight(n: int, decay: float, x: FloatArray, w: FloatArray) -> None:
    """Each entry of w from the one eight places before it and a sum of eight increments."""
    for i in range(min(n, PAD)):
        w[i + 1] = x[i + PAD]
    for i in range(n - PAD):
        w[i + 1 + PAD] = x[i + 2 * PAD] + decay * w[i + 1]


@jit_within
def recursion(n: int, decay: float, inc: FloatArray, other: FloatArray, w: FloatArray) -> None:
    """Compute w[i + 1] = decay w[i] + inc[i], eight entries at a time.

    Decayed sums of 2, 4 and 8 successive increments come first, so that each entry then depends on the one eight places
    before it, no longer on its neighbour. `inc` and `other` have `PAD` zeros in front; both are overwritten.
    """
    inc[PAD] += decay * w[0]
    two = decay * decay
    four = two * two
    _doubled(n, decay, 1, inc, other)
    _doubled(n, two, 2, other, inc)
    _doubled(n, four, 4, inc, other)
    _by_eight(n, four * four, other, w)


@jit_rows
def area_rows(n: int, area: FloatArray, scale: float, shift: float, q0: float, u: FloatArray, z: FloatArray) -> None:
    """1/A - q0 (1/m^2) at the gap voltages u (V), into z; the polynomial `area` has the degree 4 k."""
    d = area.size - 1
    a, b, c, e, f = area[d], area[d - 1], area[d - 2], area[d - 3], area[d - 4]
    last = f - q0 if d == 4 else f
    for i in range(n):
        x = abs(u[i]) * scale + shift
        z[i] = (((a * x + b) * x + c) * x + e) * x + last
    for j in range(d - 4, 0, -4):
        b, c, e, f = area[j - 1], area[j - 2], area[j - 3], area[j - 4]
        last = f - q0 if j == 4 else f
        for i in range(n):
            x = abs(u[i]) * scale + shift
            z[i] = (((z[i] * x + b) * x + c) * x + e) * x + last


@jit_rows
def newton_rows(
    n: int, area: FloatArray, scale: float, shift: float, k_gap: float, area0: float, s: FloatArray, x_gap: FloatArray,
    u: FloatArray, z: FloatArray, slope: FloatArray,
) -> float:  # fmt: skip
    """One step of Newton's method for u = k_gap U + A0 x_gap q(|u|) in every entry.

    Returns the smallest slope of the residual by u, which is the distance to the fold.
    """
    d = area.size - 1
    top = area[d]
    for i in range(n):
        z[i], slope[i] = top, 0.0
    for j in range(d - 1, -1, -1):
        c = area[j]
        for i in range(n):
            x = abs(u[i]) * scale + shift
            slope[i] = slope[i] * x + z[i]
            z[i] = z[i] * x + c
    least = 1.0
    for i in range(n):
        b = area0 * x_gap[i]
        margin = 1.0 - b * slope[i] * scale * (1.0 if u[i] >= 0.0 else -1.0)
        least = min(least, margin)
        u[i] -= (u[i] - k_gap * s[i] - b * z[i]) / margin
    return least


@jit_rows
def change_of(n: int, u: FloatArray, before: FloatArray) -> float:
    """Upper bound of |u - before|, at most n^(1/8) times its maximum: twice that for 256 steps, 2.2 times for 512.

    It is the eighth root of the sum of eighth powers, as vector instructions add several at once. `before` becomes u.
    """
    total = 0.0
    for i in range(n):
        d = u[i] - before[i]
        before[i] = u[i]
        d *= d
        d *= d
        total += d * d
    return float(total**0.125)


@jit_rows
def crosses(n: int, u: FloatArray) -> bool:
    """Whether some step crosses 0 V."""
    found = False
    for i in range(n):
        found |= u[i] * u[i + 1] < 0.0
    return found


@jit_inline
def crossing(a: float, m: float, b: float) -> tuple[float, float]:
    """Fraction of a step at which u crosses 0 V, and the jump of the slope of |u| there (V per step; 0 if no crossing).

    u is given at 0, 1/2 and 1 as a, m and b, and taken as straight in between.
    """
    early = a * m < 0.0
    before, after = (a, m) if early else (m, b)
    size = abs(before) + abs(after) + 1e-300
    return (0.0 if early else 0.5) + 0.5 * abs(before) / size, 4.0 * size if a * b < 0.0 else 0.0


@jit_rows
def kink_rows(n: int, u: FloatArray, middle: FloatArray, at: FloatArray, jump: FloatArray) -> None:
    """`crossing` of every step: the fraction into `at`, the jump into `jump`."""
    for i in range(n):
        at[i], jump[i] = crossing(u[i], middle[i], u[i + 1])


@jit_inline
def after_kink(y: float, rest: float) -> tuple[float, float]:
    """Integrals of exp(-rate (1 - x)) times (x - at) and times (x - at)^2 over [at, 1].

    `rest` is 1 - at, and y = rate rest. The integrals are rest^2 (y - 1 + exp(-y)) / y^2 and, with an s of 2,
    rest^3 (y^2 - s y + s - s exp(-y)) / y^3. Rational approximations, right to 3e-4, are enough, as the correction
    itself is small.
    """
    ramp = rest * rest * (1.0 + y * (0.32058491 + 0.06524308 * y))
    ramp /= 2.0 + y * (1.31296923 + y * (0.38813995 + 0.06524308 * y))
    square = rest * rest * rest * (1.0 + y * (0.30348723 + 0.04368492 * y))
    square /= 3.0 + y * (1.66284145 + y * (0.39159498 + 0.04368492 * y))
    return ramp, square


@jit_rows
def add_kinks(
    n: int, z: float, weight: FloatArray, at: FloatArray, jump: FloatArray, x: FloatArray, out: FloatArray
) -> None:
    """Add a mode's exact response to what |u| x has besides a smooth part, less that to its parabola.

    |u| is bent at the fraction `at` of a step by `jump`; u and x (n + 1,) are straight beside it, so that |u| x has the
    additional part jump (t - at) (x_at + slope (t - at)) from there on. The parabola passes through 0, 1/2 and 1. The
    mode has rate z per step; `weight` (2,) are its quadrature weights at 1/2 and 1.
    """
    by_middle, by_end = weight[0], weight[1]
    for i in range(n):
        rest, early, slope = 1.0 - at[i], max(0.5 - at[i], 0.0), x[i + 1] - x[i]
        ramp, square = after_kink(z * rest, rest)
        ramp -= by_middle * early + by_end * rest
        square -= by_middle * early * early + by_end * rest * rest
        out[i] += jump[i] * ((x[i] + at[i] * slope) * ramp + slope * square)


@jit_rows
def kink_at(
    n: int, kink: float, place: float, at: FloatArray, jump: FloatArray, x: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    """Subtract from interpolation errors at fraction `place` of the steps the known part that the kink causes."""
    m, r = 4.0 * place * (1.0 - place), place * (2.0 * place - 1.0)
    for i in range(n):
        since, early, rest, slope = max(place - at[i], 0.0), max(0.5 - at[i], 0.0), 1.0 - at[i], x[i + 1] - x[i]
        ramp = since - m * early - r * rest
        square = since * since - m * early * early - r * rest * rest
        out[i] -= kink * jump[i] * ((x[i] + at[i] * slope) * ramp + slope * square)
