"""Stack, contact and source as one compiled right-hand side.

State y = [x (n,) in volt, z in coulomb]. With q = 1/A, the reference area A_0 and layer voltages u = k U + E v,

    local    v = x            x' = f          z' = A (lam + U'/S)    charge through the terminals
    mobile   v = x A_0 q      x' = f A / A_0  z' = A lam             charge is A U / S + z

where h_x = (rate_x + q rate0_x) u_x is the leak of layer x over its capacitance, f_x = k_x sum(h) - h_x and
lam = sum(h) / S. Leaks are taken from layer voltages, not from one matrix: what cancels in a layer that leaks fast
then cancels in every row alike. Only z' needs the slope of the source.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.physics.contact import inverse_area


class Model(NamedTuple):
    """A reduced stack with its area curve, as numbers.

    Attributes
    ----------
    mobile : bool
        Charge law.
    coupled : bool
        Whether the area follows the gap voltage; then steps end on its zeros.
    k : ndarray, shape (n + 1,)
        Share of a jump of U that each layer takes. The first n layers' voltages over k U are the state; the last
        layer's is minus their sum.
    rate, rate0 : ndarray, shape (n + 1,)
        Leak rate of each layer: the part that does not depend on the area (1/s), and that over 1/A (m^2/s).
    k_gap : float
        Share of a jump of U that the gap takes.
    gap : ndarray, shape (n,)
        x_gap = gap @ x.
    s : float
        Sum of 1/c_x over the layers, m^2/F.
    slow : ndarray, shape (n + 4,)
        The layer that leaks slowest: its row of the embedding, share k, capacitance c (F/m^2), and leak per area
        (S/m^2) as a constant and over 1/A. The current through it suffers least from cancellation.
    area0 : float
        Reference area of the mobile state, m^2.
    tau : float
        Shortest time constant of the frozen stack, s (inf without leakage).
    curve : ndarray
        See `fingerspice.physics.contact.inverse_area`.
    """

    mobile: bool
    coupled: bool
    k: FloatArray
    rate: FloatArray
    rate0: FloatArray
    k_gap: float
    gap: FloatArray
    s: float
    slow: FloatArray
    area0: float
    tau: float
    curve: FloatArray


# Gauss-Legendre rule for the charge of a jump under the local law: A is analytic on either side of 0 V. From the values
# at its points follow the last Legendre coefficients, _TAIL @ values: what the rule misses goes with their square.
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(24)
_TAIL = np.array([(k + 0.5) * _GAUSS_W * np.polynomial.legendre.Legendre.basis(k)(_GAUSS_X) for k in (20, 21, 22, 23)])
# Of a panel's charge, and the most panels that a jump is split into.
_RULE_ERROR, _MOST_PANELS = 1e-15, 200
# Legendre coefficients below this share of the values are their rounding.
_TAIL_ROUNDING = 1e-14


@jit
def dot(a: FloatArray, x: FloatArray) -> float:
    """a @ x[: a.size], for the few entries of a state."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * x[i]
    return total


@jit
def branch_area(model: Model, sign: float, u: float) -> tuple[float, float]:
    """1/A and its slope d(1/A)/du on the branch A(|u|) = A(sign u), continued a little past 0 V.

    Under `mobile`, farther on the wrong side it is the true area, so that a walk towards the branch starts on solid
    ground; under `local` nothing walks, and a step across 0 V must see no kink.
    """
    if model.mobile and sign * u < model.curve[0]:
        sign = -sign
    q, dq = inverse_area(sign * u, model.curve)
    return q, sign * dq


@jit
def gap_voltage(model: Model, k_u: float, x_gap: float, sign: float, guess: float) -> float:
    """Gap voltage (V): k U + x under `local`; under `mobile` the root of u = k U + x A_0 / A(|u|).

    The root meant is the one connected to `guess`, a gap voltage not long before; with k U for a guess, to the
    uncharged state. NaN where the branch holds no such root: past the fold.
    """
    if not model.mobile or x_gap == 0.0:
        return k_u + x_gap
    b = x_gap * model.area0
    u = guess
    q, dq = branch_area(model, sign, u)
    last = math.inf
    for _ in range(12):
        slope = 1.0 - b * dq
        # Past the fold Newton would go to another root: leave it to the walk.
        if not slope > 1e-3:
            break
        step = (k_u - u + b * q) / slope
        new = u + step
        q_new, dq_new = branch_area(model, sign, new)
        if not _rises(b, u, q, dq, q_new, dq_new, step, model.curve[0]):
            break
        u, q, dq = new, q_new, dq_new
        if _settled(step, last, slope, abs(u) + abs(k_u)):
            if sign * u >= model.curve[0]:
                return u
            break
        last = abs(step)
    u = walk(model, k_u, b, sign, guess, False)
    return u if sign * u >= model.curve[0] else math.nan


@jit
def _rises(
    b: float, u: float, q: float, dq: float, q_new: float, dq_new: float, step: float, lowest: float
) -> bool:  # fmt: skip
    """Whether k_u(u) = u - b / A rises all along a step from (u, q, dq) to (q_new, dq_new), so that no fold is crossed.

    No step takes off more than three quarters of the slope, at its end or in between, as far as the slopes at both ends
    miss the mean one; nor does the area change by a third, nor the voltage by more than a half or by its own scale, as
    far as which (`lowest`, V) the area may be continued past 0 V.
    """
    if abs(step) > max(0.5 * abs(u), abs(lowest)):
        return False
    slope, slope_new = 1.0 - b * dq, 1.0 - b * dq_new
    if not (slope_new > 0.25 * slope and abs(q_new - q) < 0.3 * min(q, q_new)):
        return False
    # A change as small as rounding tells no mean slope; but nothing can lie in between.
    if abs(q_new - q) < 1e-6 * q and abs(b * (dq_new - dq)) < 0.5 * slope:
        return True
    return abs(b * ((q_new - q) / step - 0.5 * (dq + dq_new))) < 0.5 * min(slope, slope_new)


@jit
def _settled(step: float, last: float, slope: float, size: float) -> bool:
    """Whether Newton's step is down to rounding of `size`, or no longer falls close to that.

    A small slope, close to a fold, magnifies what rounding leaves.
    """
    return abs(step) <= 4e-16 * size or (abs(step) * min(slope, 1.0) <= 1e-13 * size and abs(step) >= last)


@jit
def walk(model: Model, k_u: float, b: float, sign: float, u: float, stops: bool) -> float:
    """From gap voltage u to the root of u = k_u + b / A on the same branch, or to 0 V if that comes first and `stops`.

    k_u(u) = u - b / A must rise all the way. NaN where a fold comes first.
    """
    q, dq = branch_area(model, sign, u)
    slope = 1.0 - b * dq
    last = math.inf
    for _ in range(200):
        if not slope > 0.0:
            return math.nan
        whole = (k_u - u + b * q) / slope
        if _settled(whole, last, slope, abs(u) + abs(k_u)):
            return u
        last = abs(whole)
        step = whole
        new = u
        q_new, dq_new = q, dq
        for _ in range(50):
            new = u + step
            if stops and sign * new < 0.0:
                new = 0.0
            q_new, dq_new = branch_area(model, sign, new)
            if _rises(b, u, q, dq, q_new, dq_new, new - u, model.curve[0]):
                break
            step *= 0.5
        if abs(step) <= 1e-10 * abs(u) and abs(step) < abs(whole):
            return math.nan
        if stops and new == 0.0 and u == 0.0:
            return 0.0
        u, q, dq, slope = new, q_new, dq_new, 1.0 - b * dq_new
    return math.nan


@jit
def ramp(model: Model, k_u: float, x_gap: float, u: float) -> float:
    """Gap voltage after a jump of the source to k_u from gap voltage u: the limit of a ramp too fast for any leak.

    NaN where the ramp meets a fold.
    """
    if not model.mobile or not model.coupled or x_gap == 0.0:
        return k_u + x_gap
    b = x_gap * model.area0
    q, _ = branch_area(model, 1.0, 0.0)
    # The side of 0 V that k_u leads to from there.
    after = 1.0 if k_u + b * q >= 0.0 else -1.0
    before = after if u == 0.0 else math.copysign(1.0, u)
    if before != after:
        u = walk(model, k_u, b, before, u, True)
        if u != 0.0:
            return u
    return walk(model, k_u, b, after, u, True)


@jit
def turns_at_zero(model: Model, x_gap: float, sign: float) -> bool:
    """Whether the mobile law folds at 0 V towards a sign: the area has its kink there, and the root may end in it."""
    _, dq = branch_area(model, sign, 0.0)
    return model.mobile and not 1.0 - x_gap * model.area0 * dq > 0.0


@jit
def choose_branch(model: Model, u_source: float, y: FloatArray) -> float:
    """Sign of the gap voltage; 1 at zero or where the area does not follow it."""
    if not model.coupled:
        return 1.0
    k_u = model.k_gap * u_source
    x_gap = dot(model.gap, y)
    zero = k_u + x_gap
    if model.mobile and zero * k_u < 0.0:
        # Charge opposes U and would win at the area of 0 V; a larger area may still hold a root on U's own side.
        sign = 1.0 if k_u > 0.0 else -1.0
        if sign * gap_voltage(model, k_u, x_gap, sign, k_u) > 0.0:
            return sign
    return 1.0 if zero >= 0.0 else -1.0


@jit
def fold_margin(model: Model, x_gap: float, u: float, sign: float) -> float:
    """Distance to the fold of the `mobile` area equation: 1 without stored charge, 0 at the fold."""
    if not model.mobile:
        return 1.0
    _, dq = branch_area(model, sign, u)
    return 1.0 - x_gap * model.area0 * dq


@jit
def rates_at(
    model: Model, u_source: float, du_source: float, y: FloatArray, sign: float, u: float, out: FloatArray
) -> None:
    """Write y' into `out` (n + 1,), from the source's voltage and slope and the gap voltage u (V).

    `sign` chooses the branch A(|u|) = A(sign u), continued analytically through 0 V.
    """
    n = model.gap.size
    q, _ = branch_area(model, sign, u)
    scale = model.area0 * q if model.mobile else 1.0
    rest = 0.0
    total = 0.0
    for i in range(n):
        rest -= y[i]
        leak = (model.rate[i] + q * model.rate0[i]) * (model.k[i] * u_source + y[i] * scale)
        out[i] = -leak
        total += leak
    total += (model.rate[n] + q * model.rate0[n]) * (model.k[n] * u_source + rest * scale)
    for i in range(n):
        out[i] = (out[i] + model.k[i] * total) / scale
    lam = total / model.s
    out[n] = lam / q if model.mobile else (lam + du_source / model.s) / q


@jit
def voltage_by_time(
    model: Model, u_source: float, du_source: float, y: FloatArray, sign: float, u: float, dy: FloatArray
) -> tuple[float, float]:
    """Distance to the fold, and the gap voltage's rate times it, V/s: both stay finite where the fold is met.

    `dy` takes y'.
    """
    rates_at(model, u_source, du_source, y, sign, u, dy)
    q, _ = branch_area(model, sign, u)
    margin = fold_margin(model, dot(model.gap, y), u, sign)
    return margin, model.k_gap * du_source + dot(model.gap, dy) * model.area0 * q


@jit
def write_row(
    model: Model, u_source: float, du_source: float, y: FloatArray, sign: float, guess: float, row: FloatArray
) -> None:
    """Fill one output row: U, gap voltage, 1/A, current, fold margin, then y."""
    u = gap_voltage(model, model.k_gap * u_source, dot(model.gap, y), sign, guess)
    write_row_at(model, u_source, du_source, y, sign, u, row)


@jit
def write_row_at(
    model: Model, u_source: float, du_source: float, y: FloatArray, sign: float, u: float, row: FloatArray
) -> None:
    """As `write_row`, where the gap voltage u (V) is known."""
    n = model.gap.size
    dy = np.empty(n + 1)
    margin, speed = voltage_by_time(model, u_source, du_source, y, sign, u, dy)
    q, dq = branch_area(model, sign, u)
    current = dy[n]
    if model.mobile:
        # i = Q' with Q = A U / S + z, and u' from the area equation.
        current += (du_source / q - dq * speed / margin * u_source / (q * q)) / model.s
    row[0] = u_source
    row[1] = u
    row[2] = q
    row[3] = current
    row[4] = margin
    # A slice on the left would be compiled with a message for every shape.
    for j in range(y.size):
        row[5 + j] = y[j]


@jit
def jump_charge(model: Model, x_gap: float, u_from: float, u_to: float) -> tuple[float, float]:
    """Charge through the terminals in a jump of the source under `local` and its error, C: integral of A dD = A dU / S.

    Split at 0 V, where the area has a kink, and then in halves until the rule is right on each: a jump of many times
    the voltage on which the area changes takes several.
    """
    crossing = -x_gap / model.k_gap if model.k_gap != 0.0 else u_from
    inside = min(u_from, u_to) < crossing < max(u_from, u_to)
    total, error, panels = 0.0, 0.0, 0
    for piece in range(2 if inside else 1):
        first = crossing if piece == 1 else u_from
        last = crossing if inside and piece == 0 else u_to
        start, length = first, last - first
        while start != last:
            end = start + length
            # The last panel ends exactly at the end.
            if abs(last - end) <= 1e-12 * abs(last - first):
                end = last
            charge, missed = _panel_charge(model, x_gap, start, end)
            panels += 1
            if missed > _RULE_ERROR * abs(charge) and panels < _MOST_PANELS and abs(length) > 1e-9 * abs(last - first):
                length *= 0.5
                continue
            total += charge
            error += missed
            start = end
            length = 2.0 * length if abs(2.0 * length) <= abs(last - start) else last - start
    return total / model.s, (error + 4e-16 * abs(total)) / model.s


@jit
def _panel_charge(model: Model, x_gap: float, u_from: float, u_to: float) -> tuple[float, float]:
    """Integral of A dU between source voltages on one side of the gap's 0 V, and what the rule misses of it, m^2 V."""
    half, middle = 0.5 * (u_to - u_from), 0.5 * (u_to + u_from)
    total = 0.0
    centre = 1.0 / inverse_area(abs(model.k_gap * middle + x_gap), model.curve)[0]
    low, high = centre, centre
    tail = np.zeros(_TAIL.shape[0])
    for g in range(_GAUSS_X.size):
        u = abs(model.k_gap * (middle + half * _GAUSS_X[g]) + x_gap)
        area = 1.0 / inverse_area(u, model.curve)[0]
        total += _GAUSS_W[g] * area
        low, high = min(low, area), max(high, area)
        for k in range(tail.size):
            tail[k] += _TAIL[k, g] * (area - centre)
    left = 0.0
    for k in range(tail.size):
        left = max(left, abs(tail[k]))
    # Coefficients that fall as a geometric series from the range of the values to these end there squared.
    missed = 2.0 * left * min(1.0, left / (high - low)) if left > _TAIL_ROUNDING * high else 0.0
    return half * total, abs(half) * missed
