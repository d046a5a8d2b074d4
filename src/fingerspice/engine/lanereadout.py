"""What is read from the states of lanes at samples (`engine.lanes`), row by row."""

from __future__ import annotations

from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.lanerows import polynomial_rows, rise_of
from fingerspice.numerics.small import copy_to


@jit_rows
def _of_source_and_modes(
    n: int, a: float, s: FloatArray, columns: FloatArray, lane: int, kept: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    first, c = kept[0, lane], columns[0]
    for i in range(n):
        out[i] = a * s[i] + c * first[i]
    for k in range(1, columns.size):
        own, c = kept[k, lane], columns[k]
        for i in range(n):
            out[i] += c * own[i]


@jit_rows
def _variable(n: int, scale: float, shift: float, xi: FloatArray, x: FloatArray) -> None:
    for i in range(n):
        x[i] = abs(xi[i]) * scale + shift


@jit
def polynomial_of(powers: FloatArray, scale: float, shift: float, xi: FloatArray, out: FloatArray) -> None:
    """A polynomial of `engine.lanerows.Lanes` at xi (n,)."""
    x = np.empty(xi.size)
    _variable(xi.size, scale, shift, xi, x)
    polynomial_rows(xi.size, powers, x, out)


@jit
def show(
    k: float, columns: FloatArray, x: FloatArray, first: IntArray, count: int, n: int, kept: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """k x + columns z at the samples 0 to n - 1, of which each lane has `count` from `first` on, into `out` (n,).

    The last lane reads one more, where the number of samples asks for it.
    """
    for i in range(first.size):
        size = n - first[i] if i + 1 == first.size else min(count, n - first[i])
        if size > 0:
            _of_source_and_modes(size, k, x[first[i] :], columns, i, kept, out[first[i] :])


@jit_rows
def _signed(n: int, xi: FloatArray, bend: FloatArray) -> None:
    """Give N the sign of xi."""
    for i in range(n):
        bend[i] = bend[i] if xi[i] >= 0.0 else -bend[i]


@jit_rows
def _of_area(n: int, q0: float, q: FloatArray, s: FloatArray, out: FloatArray) -> None:
    """A - 1/q0 times the source."""
    for i in range(n):
        out[i] = -q[i] / (q0 * (q0 + q[i])) * s[i]


@jit_rows
def _add(n: int, q: FloatArray, w: FloatArray, a: float, out: FloatArray, b: float, other: FloatArray) -> None:
    """Add a product to two rows."""
    for i in range(n):
        out[i] += a * q[i] * w[i]
        other[i] += b * q[i] * w[i]


@jit_rows
def _by_area(
    n: int, q0: float, kappa: float, k: float, k_xi: float, share: float, slope: FloatArray, q: FloatArray,
    rate: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Add what follows from the source's slope, and from N by xi (`rise_of`), of which `rate` is the part by modes."""
    for i in range(n):
        out[i] += k * slope[i] + share * rise_of(q0, kappa, q[i]) * (rate[i] + k_xi * slope[i])


@jit_rows
def _under_mobile(
    n: int, q0: float, k: float, k_xi: float, share: float, s: FloatArray, slope: FloatArray, u: FloatArray,
    q: FloatArray, steep: FloatArray, rate: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """The same with A s for N, by the gap voltage u, whose rate is that by xi over the distance to the fold."""
    for i in range(n):
        inverse, rise = q0 + q[i], steep[i] if u[i] >= 0.0 else -steep[i]
        du = (k_xi * slope[i] + rate[i] * inverse / q0) / (1.0 - (u[i] - k_xi * s[i]) / inverse * rise)
        out[i] += k * slope[i] + share * (slope[i] - s[i] * rise * du / inverse) / inverse


@jit
def flow(
    c: Any, k: float, columns: FloatArray, share: float, x: FloatArray, slope: FloatArray, first: IntArray, count: int,
    n: int, kept: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Rate of k x + columns z + share N at the samples, as `show`; `slope` (n,) is the source's, V/s.

    Under `mobile` A x stands in the place of N, and gap voltages follow the modes in `kept`.
    """
    m, leaks, drives, mobile = c.rates.size, c.tap_s.size, c.feed.shape[1], kept.shape[0] > c.rates.size
    rise, q, xi, w, steep = np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    bend, one = np.zeros(count), np.ones(count)
    # Shares of source, modes and drives in the rates of the quantity and of xi.
    by_s, by_z, by_g = np.zeros(2), np.zeros((2, m)), np.zeros((2, drives))
    for j in range(m):
        for row, own in enumerate((columns[j], c.shape[j])):
            by_s[row] += own * c.gain[j]
            by_z[row, j] = -own * c.rates[j]
            for t in range(drives):
                by_g[row, t] += own * c.feed[j, t]
    for i in range(first.size):
        size, at = min(count, n - first[i]), first[i]
        if size <= 0:
            break
        s, rate = x[at:], out[at:]
        if mobile:
            copy_to(xi[:size], kept[m, i, :size])
            polynomial_of(c.slope, c.scale, c.shift, xi[:size], steep)
        else:
            _of_source_and_modes(size, c.k, s, c.shape, i, kept, xi)
        polynomial_of(c.area, c.scale, c.shift, xi[:size], q)
        _of_source_and_modes(size, by_s[0], s, by_z[0], i, kept, rate)
        _of_source_and_modes(size, by_s[1], s, by_z[1], i, kept, rise)
        if mobile:
            _of_area(size, c.q0, q, s, bend)
        elif drives > leaks:
            polynomial_of(c.bend, c.scale, c.shift, xi[:size], bend)
            _signed(size, xi, bend)
        if drives > leaks:
            _add(size, one, bend, by_g[0, leaks], rate, by_g[1, leaks], rise)
        for t in range(leaks):
            _of_source_and_modes(size, c.tap_s[t], s, c.taps[t], i, kept, w)
            for j in range(size):
                w[j] += c.bent[t] * bend[j]
            _add(size, q, w, by_g[0, t], rate, by_g[1, t], rise)
        if mobile:
            _under_mobile(size, c.q0, k, c.k, share, s, slope[at:], xi, q, steep, rise, rate)
        else:
            _by_area(size, c.q0, c.kappa, k, c.k, share, slope[at:], q, rise, rate)
