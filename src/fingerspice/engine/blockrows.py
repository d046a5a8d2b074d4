"""Loops over the rows of a block, with one entry for each step; `engine.relaxation` is composed of them.

Each is a function of its own, so that the compiler turns it into vector instructions.
"""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_rows, jit_within

# Zeros in front of a row that `recursion` works on, because it reads entries before the first.
PAD = 16


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
def add_both_ends(n: int, a: float, x: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] += a * (x[i] + x[i + 1])


@jit_rows
def of_two(n: int, a: float, x: FloatArray, b: float, y: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = a * x[i] + b * y[i]


@jit_rows
def of_end(n: int, a: float, s: FloatArray, c: float, w: FloatArray, d: float, v: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = a * s[i] + c * w[i] + d * v[i]


@jit_within
def of_source_and_modes(n: int, a: float, s: FloatArray, c: FloatArray, w: FloatArray, out: FloatArray) -> None:
    """a s and the sum of c_k w_k over all modes."""
    if c.size > 1:
        of_end(n, a, s, c[0], w[0], c[1], w[1], out)
    else:
        of_two(n, a, s, c[0], w[0], out)
    modes_into(n, 2, c, w, out)


@jit_rows
def of_step(
    n: int, by_s: FloatArray, by_g: FloatArray, s: FloatArray, g: FloatArray, middle: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    """Source and first two drives, with their weights at the start, (the middle) and the end of each step."""
    for i in range(n):
        total = by_s[0] * s[i] + by_s[1] * s[i + 1]
        total += by_g[0, 0] * g[0, i] + by_g[0, 1] * middle[0, i] + by_g[0, 2] * g[0, i + 1]
        out[i] = total + by_g[1, 0] * g[1, i] + by_g[1, 1] * middle[1, i] + by_g[1, 2] * g[1, i + 1]


@jit_within
def forced_by(
    n: int, by_s: FloatArray, by_g: FloatArray, s: FloatArray, g: FloatArray, middle: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    """Source and all drives, with weights by_s (2,) and by_g (T, 3) as in `of_step`."""
    t = 0
    if by_g.shape[0] > 1:
        of_step(n, by_s, by_g, s, g, middle, out)
        t = 2
    else:
        both_ends(n, by_s[0], by_s[1], s, out)
    drives_into(n, t, by_g, g, middle, out)


@jit_within
def drives_into(n: int, first: int, c: FloatArray, g: FloatArray, middle: FloatArray, out: FloatArray) -> None:
    """Add the sum over the drives from `first` on, with weights c (T, 3) as in `of_step`."""
    for t in range(first, c.shape[0]):
        add_three(n, c[t, 0], g[t], c[t, 1], middle[t], c[t, 2], g[t, 1:], out)


@jit_rows
def three_at_ends(
    n: int, by_s: FloatArray, by_w: FloatArray, s: FloatArray, w: FloatArray, x: FloatArray, y: FloatArray,
    z: FloatArray,
) -> None:  # fmt: skip
    """Three projections of the source and the first two modes at the ends of the steps: by_s (3,), by_w (3, m)."""
    for i in range(n):
        x[i] = by_s[0] * s[i] + by_w[0, 0] * w[0, i] + by_w[0, 1] * w[1, i]
        y[i] = by_s[1] * s[i] + by_w[1, 0] * w[0, i] + by_w[1, 1] * w[1, i]
        z[i] = by_s[2] * s[i] + by_w[2, 0] * w[0, i] + by_w[2, 1] * w[1, i]


@jit_rows
def three_within(
    n: int, by_s: FloatArray, by_w: FloatArray, by_g: FloatArray, s: FloatArray, w: FloatArray, g: FloatArray,
    middle: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray,
) -> None:  # fmt: skip
    """Three projections of the source, the first two modes and drives within steps, with weights of the steps' ends.

    by_s (3, 2), by_w (3, m), by_g (3, T, 3) as in `of_step`.
    """
    for i in range(n):
        s0, s1, w0, w1 = s[i], s[i + 1], w[0, i], w[1, i]
        a0, a1, a2, b0, b1, b2 = g[0, i], middle[0, i], g[0, i + 1], g[1, i], middle[1, i], g[1, i + 1]
        total = by_s[0, 0] * s0 + by_s[0, 1] * s1 + by_w[0, 0] * w0 + by_w[0, 1] * w1
        total += by_g[0, 0, 0] * a0 + by_g[0, 0, 1] * a1 + by_g[0, 0, 2] * a2
        x[i] = total + by_g[0, 1, 0] * b0 + by_g[0, 1, 1] * b1 + by_g[0, 1, 2] * b2
        total = by_s[1, 0] * s0 + by_s[1, 1] * s1 + by_w[1, 0] * w0 + by_w[1, 1] * w1
        total += by_g[1, 0, 0] * a0 + by_g[1, 0, 1] * a1 + by_g[1, 0, 2] * a2
        y[i] = total + by_g[1, 1, 0] * b0 + by_g[1, 1, 1] * b1 + by_g[1, 1, 2] * b2
        total = by_s[2, 0] * s0 + by_s[2, 1] * s1 + by_w[2, 0] * w0 + by_w[2, 1] * w1
        total += by_g[2, 0, 0] * a0 + by_g[2, 0, 1] * a1 + by_g[2, 0, 2] * a2
        z[i] = total + by_g[2, 1, 0] * b0 + by_g[2, 1, 1] * b1 + by_g[2, 1, 2] * b2


@jit_rows
def add_to_three(
    n: int, k: int, by_w: FloatArray, w: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray
) -> None:  # fmt: skip
    """Add modes k and k + 1 to three projections, by_w (3, m)."""
    for i in range(n):
        w0, w1 = w[k, i], w[k + 1, i]
        x[i] += by_w[0, k] * w0 + by_w[0, k + 1] * w1
        y[i] += by_w[1, k] * w0 + by_w[1, k + 1] * w1
        z[i] += by_w[2, k] * w0 + by_w[2, k + 1] * w1


@jit_within
def modes_into_three(n: int, c: FloatArray, w: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray) -> None:
    """Add the modes from the third on to three projections, c (3, m)."""
    k = 2
    while k + 1 < c.shape[1]:
        add_to_three(n, k, c, w, x, y, z)
        k += 2
    if k < c.shape[1]:
        add(n, c[0, k], w[k], x)
        add(n, c[1, k], w[k], y)
        add(n, c[2, k], w[k], z)


@jit_within
def sum_of(n: int, c: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """The sum of c_k x_k over all rows of x."""
    if c.size > 1:
        of_two(n, c[0], x[0], c[1], x[1], out)
    else:
        scaled(n, c[0], x[0], out)
    modes_into(n, 2, c, x, out)


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
def products_of(n: int, x: FloatArray, y: FloatArray, out: FloatArray, z: FloatArray, other: FloatArray) -> None:
    """x y into `out`, and x z into `other`."""
    for i in range(n):
        out[i], other[i] = x[i] * y[i], x[i] * z[i]


@jit_rows
def add_to_all(n: int, a: float, x: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = a + x[i]


@jit_rows
def sign_as(n: int, x: FloatArray, out: FloatArray) -> None:
    """Give each entry the sign of x."""
    for i in range(n):
        out[i] = out[i] if x[i] >= 0.0 else -out[i]


@jit_rows
def _of_four(n: int, decay: float, x: FloatArray, out: FloatArray) -> None:
    """Decayed sums of four successive increments."""
    two = decay * decay
    three = two * decay
    for i in range(n):
        out[PAD + i] = x[PAD + i] + decay * x[PAD + i - 1] + two * x[PAD + i - 2] + three * x[PAD + i - 3]


@jit_rows
def _by_sixteen(n: int, four: float, x: FloatArray, w: FloatArray) -> None:
    """Each entry of w from the one sixteen places before it and four sums of four increments."""
    eight = four * four
    twelve, sixteen = eight * four, eight * eight
    for i in range(min(n, PAD)):
        w[i + 1] = x[PAD + i] + four * x[PAD + i - 4] + eight * x[PAD + i - 8] + twelve * x[PAD + i - 12]
    for i in range(n - PAD):
        total = x[2 * PAD + i] + four * x[2 * PAD + i - 4] + eight * x[2 * PAD + i - 8] + twelve * x[2 * PAD + i - 12]
        w[i + 1 + PAD] = total + sixteen * w[i + 1]


@jit_within
def recursion(n: int, decay: float, inc: FloatArray, other: FloatArray, w: FloatArray) -> None:
    """Compute w[i + 1] = decay w[i] + inc[i], sixteen entries at a time.

    Decayed sums of successive increments come first, so that each entry then depends on the one sixteen places before
    it, no longer on its neighbour. `inc` and `other` have `PAD` zeros in front; both are overwritten.
    """
    inc[PAD] += decay * w[0]
    _of_four(n, decay, inc, other)
    two = decay * decay
    _by_sixteen(n, two * two, other, w)


@jit_rows
def area_rows(n: int, area: FloatArray, scale: float, shift: float, q0: float, u: FloatArray, z: FloatArray) -> None:
    """1/A - q0 (1/m^2) at the gap voltages u (V), into z; the polynomial `area` has the degree 4 k."""
    d = area.size - 1
    a, b, c, e, f = area[d], area[d - 1], area[d - 2], area[d - 3], area[d - 4]
    last = f - q0 if d == 4 else f
    if d < 8:
        for i in range(n):
            x = abs(u[i]) * scale + shift
            z[i] = (((a * x + b) * x + c) * x + e) * x + last
        return
    a4, a5, a6, a7 = area[d - 5], area[d - 6], area[d - 7], area[d - 8] - (q0 if d == 8 else 0.0)
    if d < 12:
        for i in range(n):
            x = abs(u[i]) * scale + shift
            z[i] = (((((((a * x + b) * x + c) * x + e) * x + f) * x + a4) * x + a5) * x + a6) * x + a7
        return
    a8, a9, a10, a11 = area[d - 9], area[d - 10], area[d - 11], area[d - 12] - (q0 if d == 12 else 0.0)
    for i in range(n):
        x = abs(u[i]) * scale + shift
        total = (((((((a * x + b) * x + c) * x + e) * x + f) * x + a4) * x + a5) * x + a6) * x + a7
        z[i] = (((total * x + a8) * x + a9) * x + a10) * x + a11
    for j in range(d - 12, 0, -4):
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
def largest_of(n: int, x: FloatArray) -> float:
    """Largest |x|, as the largest of a quarter each: so four comparisons need not wait for one another."""
    a, b, c, d, m = 0.0, 0.0, 0.0, 0.0, n // 4
    for i in range(m):
        e, f, g, h = abs(x[i]), abs(x[m + i]), abs(x[2 * m + i]), abs(x[3 * m + i])
        a = e if e > a else a
        b = f if f > b else b
        c = g if g > c else c
        d = h if h > d else d
    for i in range(4 * m, n):
        a = max(a, abs(x[i]))
    return max(max(a, b), max(c, d))


@jit_rows
def largest_off(n: int, start: float, step: float, t: FloatArray) -> float:
    """Largest distance of t from `start` + i `step`."""
    largest = 0.0
    for i in range(n):
        off = abs(t[i] - (start + i * step))
        largest = off if off > largest else largest
    return largest


@jit_rows
def change_of(n: int, over: float, u: FloatArray, before: FloatArray) -> float:
    """Upper bound of |u - before| times `over`, at most n^(1/16) times its maximum: 1.4 times that for 256 steps.

    It is the sixteenth root of the sum of sixteenth powers, as vector instructions add several at once. `over` keeps
    the powers within the range of numbers. `before` becomes u.
    """
    total = 0.0
    for i in range(n):
        d = (u[i] - before[i]) * over
        before[i] = u[i]
        d *= d
        d *= d
        d *= d
        total += d * d
    return float(total**0.0625)
