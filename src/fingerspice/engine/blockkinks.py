"""Loops over the steps of a block in which the gap voltage crosses 0 V, where the area has a kink."""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit_inline, jit_rows


@jit_rows
def find_crossings(n: int, u: FloatArray, where: IntArray) -> int:
    """Find the steps that cross 0 V: their numbers into `where`, and how many there are."""
    m = 0
    for i in range(n):
        where[m] = i
        m += 1 if u[i] * u[i + 1] < 0.0 else 0
    return m


@jit_inline
def crossing(a: float, m: float, b: float) -> tuple[float, float, float]:
    """Fraction of a step at which u crosses 0 V, the jump of the slope of |u| there, and half of u''/u' there.

    u is given at 0, 1/2 and 1 as a, m and b, and taken as a parabola. The jump is in V per step, and 0 if u does not
    cross 0 V.
    """
    early = a * m < 0.0
    low = 0.0 if early else 0.5
    before, after = (a, m) if early else (m, b)
    straight = 2.0 * (after - before)
    linear, square = 4.0 * m - 3.0 * a - b, 2.0 * (a - 2.0 * m + b)
    # One step of Newton's method from where the straight line through the two values crosses 0 V.
    since = 0.5 * abs(before) / (abs(before) + abs(after) + 1e-300)
    slope = linear + 2.0 * square * (low + since)
    slope = slope if slope * straight > 0.25 * straight * straight else straight
    over = 1.0 / (slope if slope != 0.0 else 1.0)
    at = low + min(max(since - square * since * (since - 0.5) * over, 0.0), 0.5)
    return at, 2.0 * abs(slope) if a * b < 0.0 else 0.0, square * over


@jit_rows
def kink_rows(
    m: int, where: IntArray, u: FloatArray, middle: FloatArray, at: FloatArray, jump: FloatArray,
    bend: FloatArray,
) -> None:  # fmt: skip
    """`crossing` of m steps, whose numbers are `where`."""
    for j in range(m):
        i = where[j]
        at[j], jump[j], bend[j] = crossing(u[i], middle[i], u[i + 1])


@jit_rows
def add_where(m: int, where: IntArray, part: FloatArray, out: FloatArray) -> None:
    """Add `part` (m,) to the entries `where` of a row."""
    for j in range(m):
        out[where[j]] += part[j]


@jit_inline
def after_kink(y: float, rest: float) -> tuple[float, float]:
    """Integrals of exp(-rate (1 - x)) times (x - at) and times (x - at)^2 over [at, 1].

    `rest` is 1 - at, and y = rate rest. The integrals are rest^2 (y - 1 + exp(-y)) / y^2 and, with an s of 2,
    rest^3 (y^2 - s y + s - s exp(-y)) / y^3. Rational approximations, right to 3e-4, are enough, as the correction
    itself is small.
    """
    ramp, under = 1.0 + y * (0.32058491 + 0.06524308 * y), 2.0 + y * (1.31296923 + y * (0.38813995 + 0.06524308 * y))
    square, below = 1.0 + y * (0.30348723 + 0.04368492 * y), 3.0 + y * (1.66284145 + y * (0.39159498 + 0.04368492 * y))
    # One division instead of two.
    share = rest * rest / (under * below)
    return ramp * below * share, rest * square * under * share


@jit_rows
def respond_to_kinks(
    m: int, where: IntArray, z: float, until: float, weight: FloatArray, at: FloatArray, jump: FloatArray,
    bend: FloatArray, x: FloatArray, part: FloatArray,
) -> None:  # fmt: skip
    """A mode's exact response to what |u| x has besides a smooth part, less that to its parabola, in m steps `where`.

    From the fraction `at` of a step on, that part is jump (t (1 + bend t) x_at + t^2 slope), with t the fraction since
    then and x (n + 1,) a straight line. The parabola passes through 0, 1/2 and 1. The mode has rate z per step. The
    response is that at the fraction `until`; `weight` (2,) are the weights of 1/2 and 1 in the quadrature up to there.
    """
    by_middle, by_end = weight[0], weight[1]
    for j in range(m):
        i = where[j]
        rest, early, slope = 1.0 - at[j], max(0.5 - at[j], 0.0), x[i + 1] - x[i]
        since = max(until - at[j], 0.0)
        ramp, square = after_kink(z * since, since)
        ramp -= by_middle * early + by_end * rest
        square -= by_middle * early * early + by_end * rest * rest
        there = x[i] + at[j] * slope
        part[j] = jump[j] * (there * ramp + (slope + bend[j] * there) * square)


@jit_rows
def kink_at(
    m: int, where: IntArray, kink: float, place: float, at: FloatArray, jump: FloatArray, bend: FloatArray,
    x: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Subtract from interpolation errors at fraction `place` of steps the known part that kinks in m of them cause."""
    half, last = 4.0 * place * (1.0 - place), place * (2.0 * place - 1.0)
    for j in range(m):
        i = where[j]
        since, early, rest, slope = max(place - at[j], 0.0), max(0.5 - at[j], 0.0), 1.0 - at[j], x[i + 1] - x[i]
        ramp = since - half * early - last * rest
        square = since * since - half * early * early - last * rest * rest
        there = x[i] + at[j] * slope
        out[i] -= kink * jump[j] * (there * ramp + (slope + bend[j] * there) * square)
