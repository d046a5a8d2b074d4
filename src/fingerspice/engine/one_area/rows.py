"""Evaluations of a stack's step at all its rows at once: the source, the area, the nonlinear term; and their arrays."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, aligned
from fingerspice.base.compiled import jit, jit_fused, jit_rows, jit_within
from fingerspice.engine.collocation.readout import N_PLACES, Modal, new_modal
from fingerspice.engine.network import term_at
from fingerspice.engine.one_area.system import DEGREE, System
from fingerspice.numerics import chebyshev
from fingerspice.numerics.lobatto import POINTS, ROWS, multiply
from fingerspice.numerics.modes import copy_to
from fingerspice.physics.contact import inverse_area

# Rows of `Work.r`: source (V) and its slope (V/s), k_gap U, gap voltage and its guess (V), gap w, 1/A (1/m^2), its
# slope by the gap voltage, and two rows of scratch.
SOURCE, SLOPE, FREE, U, GUESS, X_GAP, Q, DQ, SCRATCH, MORE = range(10)
N_FLAT = 10


class Work(NamedTuple):
    """Arrays that a stack's steps work in; those with ROWS behind hold one value for each row of a step."""

    modal: Modal
    r: FloatArray  # (N_FLAT, ROWS): See above
    tapped: FloatArray  # (n + 1, ROWS): Leaks that do not scale with the area
    off: FloatArray  # (N_PLACES, n + 1): Interpolation errors of the modes and the source; see `exponential.node_error`
    # Scratch; the last one as `r`
    sums: FloatArray
    spare_r: FloatArray


def new_stack_work(n: int) -> Work:
    """Work arrays for n modes."""
    own = (N_FLAT, ROWS)
    r, *others = aligned((own, (n + 1, ROWS), (N_PLACES, n + 1), (3, 4), own))
    return Work(new_modal(n, n + 2, r[U : U + 1], r[GUESS : GUESS + 1]), r, *others)


_PI_HIGH = 3.141592653589793
_PI_LOW = 1.2246467991473532e-16
_PER_PI = 1.0 / _PI_HIGH
# Taylor coefficients of cos in x^2, to 1e-17 on |x| <= pi/2.
_COS = np.array([(-1.0) ** i / math.factorial(2 * i) for i in range(11)])
_LAST = _COS.size - 1


@jit_fused
def _add_cosines(amplitude: float, phase: FloatArray, out: FloatArray) -> None:
    """out += amplitude cos(phase), to 2e-16 of the amplitude and of the phase.

    The library's cosine is exact to half a rounding and does not vectorise; this one does.
    """
    for i in range(ROWS):
        turns = np.rint(phase[i] * _PER_PI)
        x = (phase[i] - turns * _PI_HIGH) - turns * _PI_LOW
        x *= x
        value = _COS[_LAST]
        for d in range(_LAST - 1, -1, -1):
            value = value * x + _COS[d]
        half = 0.5 * turns
        sign = 1.0 - 4.0 * (half - np.floor(half))
        out[i] += amplitude * sign * value


@jit
def source_rows(
    terms: FloatArray, series: FloatArray, length: float, t0: float, h: float, want_slope: bool, out: FloatArray,
    slope: FloatArray, scratch: FloatArray,
) -> None:  # fmt: skip
    """Fill source, and its slope if wanted, for a step of length h that starts t0 into a segment (see `source`)."""
    phase, rate = scratch[0], scratch[1]
    for i in range(ROWS):
        out[i] = 0.0
        slope[i] = 0.0
    for m in range(terms.shape[0]):
        c = terms[m, 0]
        if c == 0.0:
            continue
        omega = terms[m, 3]
        phi = terms[m, 4]
        beta = terms[m, 5]
        waves = omega != 0.0 or phi != 0.0 or beta != 0.0
        if waves and terms[m, 1] == 0.0 and terms[m, 2] == 0.0:
            for i in range(ROWS):
                tau = t0 + POINTS[i] * h
                phase[i] = phi + (omega + 0.5 * beta * tau) * tau
            _add_cosines(c, phase, out)
            if want_slope:
                for i in range(ROWS):
                    phase[i] += 0.5 * _PI_HIGH
                    rate[i] = 0.0
                _add_cosines(c, phase, rate)
                for i in range(ROWS):
                    slope[i] += rate[i] * (omega + beta * (t0 + POINTS[i] * h))
        elif waves or terms[m, 1] != 0.0 or terms[m, 2] != 0.0:
            for i in range(ROWS):
                value, rate_here = term_at(terms[m], t0 + POINTS[i] * h)
                out[i] += value
                slope[i] += rate_here
        else:
            for i in range(ROWS):
                out[i] += c
    if series.size > 0:
        for i in range(ROWS):
            tau = t0 + POINTS[i] * h
            value, rate_here = chebyshev.evaluate(series, 2.0 * tau / length - 1.0)
            out[i] += value
            slope[i] += rate_here * 2.0 / length


@jit_rows
def _series_rows(series: FloatArray, lo: float, scale: float, u: FloatArray, sign: float, out: FloatArray) -> None:
    """The Chebyshev series in (sign u - lo) scale - 1 at every row (Clenshaw)."""
    room = np.zeros((3, ROWS))
    twice, b1, b2 = room[0], room[1], room[2]
    for i in range(ROWS):
        twice[i] = 2.0 * min(max((sign * u[i] - lo) * scale - 1.0, -1.0), 1.0)
    for d in range(series.size - 1, 0, -1):
        for i in range(ROWS):
            b0 = twice[i] * b1[i] + (series[d] - b2[i])
            b2[i] = b1[i]
            b1[i] = b0
    for i in range(ROWS):
        out[i] = 0.5 * twice[i] * b1[i] + (series[0] - b2[i])


@jit_rows
def _powers_rows(powers: FloatArray, lo: float, scale: float, u: FloatArray, sign: float, out: FloatArray) -> None:
    """The polynomial in (sign u - lo) scale - 1 at every row."""
    for i in range(ROWS):
        x = (sign * u[i] - lo) * scale - 1.0
        # Outside the range any finite value will do: a step that needs it is rejected.
        x = min(max(x, -1.0), 1.0)
        # Two sums in powers of x^2, as in a single one every product would wait for the last.
        square, odd, even = x * x, powers[DEGREE], powers[DEGREE - 1]
        for d in range(DEGREE - 2, 0, -2):
            odd, even = odd * square + powers[d], even * square + powers[d - 1]
        out[i] = odd * x + even


@jit
def polynomial_rows(powers: FloatArray, lo: float, scale: float, u: FloatArray, sign: float, out: FloatArray) -> None:
    """The polynomial in (sign u - lo) scale - 1 at every row: of `DEGREE` in powers, longer as a Chebyshev series."""
    if powers.size == DEGREE + 1:
        _powers_rows(powers, lo, scale, u, sign, out)
    else:
        _series_rows(powers, lo, scale, u, sign, out)


@jit
def area_rows(
    powers: FloatArray, slopes: FloatArray, lo: float, scale: float, curve: FloatArray, u: FloatArray, sign: float,
    slopes_too: bool, q: FloatArray, dq: FloatArray,
) -> None:  # fmt: skip
    """1/A and, if wanted, its slope by the gap voltage u at every row (see `System`); from Eq. 4 where `scale` is 0."""
    if scale > 0.0:
        polynomial_rows(powers, lo, scale, u, sign, q)
        if slopes_too:
            polynomial_rows(slopes, lo, scale, u, sign, dq)
            for i in range(ROWS):
                dq[i] *= scale * sign
    else:
        for i in range(ROWS):
            q[i], slope = inverse_area(max(sign * u[i], lo), curve)
            dq[i] = slope * sign


@jit_rows
def _gap_voltage(k_gap: float, source: FloatArray, x: FloatArray, u: FloatArray) -> None:
    """u = k_gap U + x."""
    for i in range(ROWS):
        u[i] = k_gap * source[i] + x[i]


@jit_rows
def _leaked(tap_k: FloatArray, q0: float, source: FloatArray, q: FloatArray, tapped: FloatArray) -> None:
    """(q - q0) (tapped + tap_k U), in place."""
    for t in range(tap_k.size):
        share = tap_k[t]
        for i in range(ROWS):
            tapped[t, i] = (q[i] - q0) * (tapped[t, i] + share * source[i])


@jit_rows
def _push(push: FloatArray, q0: float, area0: float, source: FloatArray, q: FloatArray, pull: FloatArray) -> None:
    """pull += (1/q - 1/q0) push U / A0."""
    for k in range(pull.shape[0]):
        factor = push[k] / area0
        for i in range(ROWS):
            pull[k, i] += (1.0 / q[i] - 1.0 / q0) * factor * source[i]


@jit_within
def evaluate_one(c: Any, s: Any, w: FloatArray, pull: FloatArray, probing: bool) -> bool:
    """Write the nonlinear term at the modes w into `pull`, and the gap voltage and 1/A into the rows of `Work.r`.

    With `probing`, the modes are not those of the step at hand, and other rows are taken, so that those of the step
    stay as they are. False where, under `mobile`, the area equation was not solved on the branch connected to the guess
    of the gap voltage.
    """
    system, level, sign, tapped = c.system, s.step[0].level, s.sign[0], c.work.tapped
    model, r = system.model, c.work.spare_r if probing else c.work.r
    mobile, q0 = model.mobile, system.q0[level]
    if probing:
        copy_to(r[SOURCE], c.work.r[SOURCE])
        copy_to(r[GUESS], c.work.r[U])
    multiply(system.gap[level : level + 1], w, None, r[X_GAP : X_GAP + 1])
    _gap_voltage(model.k_gap, r[SOURCE], r[X_GAP], r[U])
    if mobile:
        if not _solve_mobile(system, sign, r):
            return False
    else:
        _area(system, sign, False, r)
    multiply(system.tap[level], w, None, tapped)
    _leaked(system.tap_k, q0, r[SOURCE], r[Q], tapped)
    multiply(system.feed[level], tapped, None, pull)
    if mobile:
        _push(system.push[level], q0, model.area0, r[SOURCE], r[Q], pull)
    return True


@jit
def _area(system: System, sign: float, slopes_too: bool, r: FloatArray) -> None:
    area_rows(
        system.powers, system.slopes, system.lo, system.scale, system.model.curve, r[U], sign, slopes_too, r[Q], r[DQ]
    )  # fmt: skip


@jit
def _solve_mobile(system: System, sign: float, r: FloatArray) -> bool:
    """u = k U + b q(u) at all rows at once, by Newton; r[U] holds k U + x on entry."""
    area0 = system.model.area0
    for i in range(ROWS):
        r[FREE, i] = r[U, i] - r[X_GAP, i]
        r[U, i] = r[GUESS, i]
    for _ in range(30):
        _area(system, sign, True, r)
        worst, size, lowest = 0.0, 0.0, 1.0
        for i in range(ROWS):
            size = max(size, abs(r[FREE, i]) + abs(r[U, i]))
            b = r[X_GAP, i] * area0
            margin = 1.0 - b * r[DQ, i]
            step = (r[U, i] - r[FREE, i] - b * r[Q, i]) / margin
            r[U, i] -= step
            worst = max(worst, abs(step))
            lowest = min(lowest, margin)
        # Beyond the fold the slope has changed its sign: such a root is not connected to the uncharged state.
        if not lowest > 0.0 or not worst < math.inf:
            return False
        # What is left after a step falls with its square. Close to the fold, rounding is divided by the distance to it.
        if worst * lowest <= 2e-13 * size:
            return True
    return False


@jit
def largest_size(values: FloatArray) -> float:
    """The largest of the sizes of values; NaN counts for nothing."""
    largest = 0.0
    for i in range(values.size):
        largest = max(largest, abs(values[i]))
    return largest
