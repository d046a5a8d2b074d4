"""The differential equation of a stack with its contact and source, as compiled functions.

State y = [x (n,) in volt, z in coulomb]. With q = 1/A, the reference area A_0 and layer voltages u = k U + E v,

    local    v = x            x' = f          z' = A (lam + U'/S)    charge through the terminals
    mobile   v = x A_0 q      x' = f A / A_0  z' = A lam             charge is A U / S + z

where h_x = (rate_x + q rate0_x) u_x is the leak of layer x over its capacitance, f_x = k_x sum(h) - h_x and
lam = sum(h) / S. The leakage currents are computed from the layer voltages, not from one matrix times the state: then
all rows contain the same rounded currents, and the large ones of a fast-leaking layer cancel alike in every row. Only
z' needs the slope of the source.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.engine.network import on_branch, source
from fingerspice.physics.contact import inverse_area


class Model(NamedTuple):
    """A reduced stack with its area curve, as numbers."""

    mobile: bool  # Charge law
    coupled: bool  # Whether the area follows the gap voltage; then steps end on the zeros of this voltage
    # (n + 1,): Share of a jump of U that each layer takes. The state is x = layer voltage - k U (`local`) of the first
    # n layers; that of the last layer is minus their sum.
    k: FloatArray
    # rate, rate0 (n + 1,): Leak rate of each layer: the part that does not depend on the area (1/s), and the factor of
    # 1/A in the rest (m^2/s)
    rate: FloatArray
    rate0: FloatArray
    k_gap: float  # Share of a jump of U that the gap takes
    gap: FloatArray  # (n,): x_gap = gap @ x
    s: float  # Sum of 1/c_x over the layers, m^2/F
    # (n + 4,): The layer that leaks slowest, through which the current suffers least from cancellation: its row of E,
    # share k, capacitance c (F/m^2), and the two parts of its leak per area, constant (S/m^2) and factor of 1/A (S)
    slow: FloatArray
    area0: float  # Reference area of the mobile state, m^2
    tau: float  # Shortest time constant of the frozen stack, s (inf without leakage)
    curve: FloatArray  # See `fingerspice.physics.contact.inverse_area`


# Gauss-Legendre rule for the charge of a jump under the local law: A is analytic on either side of 0 V. The last
# Legendre coefficients are _TAIL @ values; the quadrature error is proportional to their square.
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(24)
_TAIL = np.array([(k + 0.5) * _GAUSS_W * np.polynomial.legendre.Legendre.basis(k)(_GAUSS_X) for k in (20, 21, 22, 23)])
# Quadrature error allowed in a panel, relative to its charge, and the most panels that a jump is split into.
_RULE_ERROR, _MOST_PANELS = 1e-15, 200
# Legendre coefficients below this fraction of the largest value are rounding.
_TAIL_ROUNDING = 1e-14


@jit
def dot(a: FloatArray, x: FloatArray) -> float:
    """a @ x[: a.size], for the few entries of a state."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * x[i]
    return total


@jit
def gap_voltage(model: Model, k_u: float, x_gap: float, sign: float, guess: float) -> float:
    """Gap voltage (V): k U + x under `local`; under `mobile` the root of u = k U + x A_0 / A(|u|).

    Of several roots it is the one connected with `guess`, a gap voltage shortly before. The guess k U, which is the gap
    voltage of the uncharged state, gives the root connected with that state. NaN past the fold, where the branch has no
    such root.
    """
    if not model.mobile or x_gap == 0.0:
        return k_u + x_gap
    u = walk(model, k_u, x_gap * model.area0, sign, guess, False)
    return u if sign * u >= model.curve[0] else math.nan


@jit
def _rises(
    b: float, u: float, q: float, dq: float, q_new: float, dq_new: float, step: float, lowest: float
) -> bool:  # fmt: skip
    """Whether k_u(u) = u - b / A rises all along a step from (u, q, dq) to (q_new, dq_new), so that no fold is crossed.

    The slope of k_u may fall by at most three quarters to the end of the step, and its mean over the step may differ
    from the average of both ends by at most half of the smaller one. 1/A may change by no more than 30 %, and the
    voltage by no more than half of itself or |lowest| (V), the distance to which A is continued past 0 V.
    """
    if abs(step) > max(0.5 * abs(u), abs(lowest)):
        return False
    slope, slope_new = 1.0 - b * dq, 1.0 - b * dq_new
    if not (slope_new > 0.25 * slope and abs(q_new - q) < 0.3 * min(q, q_new)):
        return False
    # For so small a change the mean slope would be rounding; but then no fold can lie in between.
    if abs(q_new - q) < 1e-6 * q and abs(b * (dq_new - dq)) < 0.5 * slope:
        return True
    return abs(b * ((q_new - q) / step - 0.5 * (dq + dq_new))) < 0.5 * min(slope, slope_new)


@jit
def _settled(step: float, last: float, slope: float, size: float) -> bool:
    """Whether Newton's step has fallen to rounding of `size`, or is close to it and no longer falls.

    Close to a fold the slope is small, and the step is rounding divided by this slope.
    """
    return abs(step) <= 4e-16 * size or (abs(step) * min(slope, 1.0) <= 1e-13 * size and abs(step) >= last)


@jit
def walk(model: Model, k_u: float, b: float, sign: float, u: float, stops: bool) -> float:
    """Follow the branch from gap voltage u to the root of u = k_u + b / A; with `stops`, to 0 V if that comes first.

    Newton's steps are halved until k_u(u) = u - b / A rises along each (`_rises`). NaN where a fold comes first.
    """
    q, dq = on_branch(model.mobile, model.curve, sign, u)
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
            q_new, dq_new = on_branch(model.mobile, model.curve, sign, new)
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
    q, _ = on_branch(model.mobile, model.curve, 1.0, 0.0)
    # The side of 0 V to which the gap voltage goes from 0 V where the source's share is k_u.
    after = 1.0 if k_u + b * q >= 0.0 else -1.0
    before = after if u == 0.0 else math.copysign(1.0, u)
    if before != after:
        u = walk(model, k_u, b, before, u, True)
        if u != 0.0:
            return u
    return walk(model, k_u, b, after, u, True)


@jit
def turns_at_zero(model: Model, x_gap: float, sign: float) -> bool:
    """Whether the mobile law has a fold at 0 V on the side `sign`: A has a kink there, at which a root may vanish."""
    _, dq = on_branch(model.mobile, model.curve, sign, 0.0)
    return model.mobile and not 1.0 - x_gap * model.area0 * dq > 0.0


@jit
def choose_branch(model: Model, u_source: float, y: FloatArray) -> float:
    """Sign of the gap voltage; 1 at 0 V, and where the area does not depend on the gap voltage."""
    if not model.coupled:
        return 1.0
    k_u = model.k_gap * u_source
    x_gap = dot(model.gap, y)
    zero = k_u + x_gap
    if model.mobile and zero * k_u < 0.0:
        # With the area at 0 V the charge would outweigh U; with a larger area a root may still be on U's own side.
        sign = 1.0 if k_u > 0.0 else -1.0
        if sign * gap_voltage(model, k_u, x_gap, sign, k_u) > 0.0:
            return sign
    return 1.0 if zero >= 0.0 else -1.0


@jit
def voltage_by_time(
    model: Model, u_source: float, du_source: float, y: FloatArray, sign: float, u: float, dy: FloatArray
) -> tuple[float, float]:
    """Distance to the fold, and its product with the gap voltage's rate (V/s), which both stay finite at the fold.

    The distance is that of the `mobile` area equation: 1 without stored charge, 0 at the fold. `dy` (n + 1,) takes y',
    from the source's voltage and slope and the gap voltage u (V); `sign` chooses the branch A(|u|) = A(sign u),
    continued analytically through 0 V.
    """
    n = model.gap.size
    q, dq = on_branch(model.mobile, model.curve, sign, u)
    scale = model.area0 * q if model.mobile else 1.0
    rest = 0.0
    total = 0.0
    for i in range(n):
        rest -= y[i]
        leak = (model.rate[i] + q * model.rate0[i]) * (model.k[i] * u_source + y[i] * scale)
        dy[i] = -leak
        total += leak
    total += (model.rate[n] + q * model.rate0[n]) * (model.k[n] * u_source + rest * scale)
    for i in range(n):
        dy[i] = (dy[i] + model.k[i] * total) / scale
    lam = total / model.s
    dy[n] = lam / q if model.mobile else (lam + du_source / model.s) / q
    margin = 1.0 - dot(model.gap, y) * model.area0 * dq if model.mobile else 1.0
    return margin, model.k_gap * du_source + dot(model.gap, dy) * model.area0 * q


@jit
def jump_charge(model: Model, x_gap: float, u_from: float, u_to: float) -> tuple[float, float]:
    """Charge through the terminals in a jump of the source under `local` and its error, C: integral of A dD = A dU / S.

    The range is split at 0 V, where the area has a kink, and then halved into panels until the quadrature error of each
    is at rounding: a jump of many times the voltage scale of the area needs several panels.
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
            # The last panel must end exactly at `last`, whatever the rounding of the sums.
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
    """Integral of A dU between two source voltages at which the gap voltage has one sign, and its error, m^2 V."""
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
    # If the coefficients fall geometrically from the range of the values to `left`, those of twice the degree, which
    # are the first that the rule misses, have the size left^2 / (high - low).
    missed = 2.0 * left * min(1.0, left / (high - low)) if left > _TAIL_ROUNDING * high else 0.0
    return half * total, abs(half) * missed


@jit
def jump_charges(model: Model, x_gap: float, u_from: float, u_to: FloatArray, out: FloatArray) -> float:
    """`jump_charge` from one source voltage to each of several, into `out`; the largest error, C."""
    worst = 0.0
    for i in range(u_to.size):
        out[i], error = jump_charge(model, x_gap, u_from, u_to[i])
        worst = max(worst, error)
    return worst


@jit
def source_at(
    edges: FloatArray, terms: FloatArray, series: FloatArray, t: FloatArray, left: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Source voltage (V) and slope (V/s) at times t (ascending, inside the edges), shape (n,) each."""
    u = np.empty(t.size)
    slope = np.empty(t.size)
    index = 0
    for i in range(t.size):
        while index < edges.size - 2 and (t[i] > edges[index + 1] or (t[i] == edges[index + 1] and not left[i])):
            index += 1
        length, tau = edges[index + 1] - edges[index], t[i] - edges[index]
        u[i], slope[i] = source(terms[index], series[index], length, tau)
    return u, slope
