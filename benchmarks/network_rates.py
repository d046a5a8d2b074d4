"""The right-hand side of the network scenes that peers integrate, written by hand for numba and for any array library.

Someone who knows the circuit would write it in this form. No matrix is needed: the layers of a finger are in series
and the fingers in parallel, so that the current divides in closed form. `fingerspice.engine.network.rates`, which
serves any circuit, fills and eliminates a matrix at every evaluation and takes several times longer, which would be
unfair to the peers. The package itself is given the netlist and uses none of this.

State x (V): the voltage across all fingers; the body's voltage, if the body floats; the voltages of each finger's
coating and gap. The skin's voltage is the finger's less these two. With the current i through a finger, each of its
voltages u changes by u' = a i - b:

    local:   c A u' = i - G u               G = g_total + g_area A
    mobile:  c A u' + c u A' = i - G u      A' = dA/du_gap u_gap'
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from network_problems import Around, Finger
from problems import BELOW, Drive

Part = Callable[[Any], Any]
Least = Callable[[Any, Any], Any]


def code(signs: Sequence[float]) -> float:
    """The signs of one or two gap voltages as one number: the first sign plus three times the second."""
    return sum(3.0**i * sign for i, sign in enumerate(signs))


def _answer(finger: Finger, reach: float, mobile: bool, least: Least, compile_part: Part) -> Any:
    """Function from (coating, gap, all layers in V, sign) to a and b of the coating, the gap, and all layers together.

    A sign of 0 uses |u_gap|; +-1 uses the branch of that sign and its continuation through zero. Beyond both ends of
    the series the area is constant, so that a trial step far outside does not overflow.
    """
    series, scale = finger.series[::-1], 2.0 / reach
    (c0, c1, c2), (t0, t1, t2), (g0, g1, g2) = finger.c, finger.g_total, finger.g_area

    @compile_part
    def answer(coat, gap, across, sign):  # type: ignore[no-untyped-def]
        s = least(scale * (abs(gap) if sign == 0.0 else sign * gap) - 1.0, 1.0)
        s = -least(-s, BELOW)
        inverse = series[0] + 0.0 * s
        slope = 0.0 * s
        for c in series[1:]:
            if mobile:
                slope = slope * s + inverse
            inverse = inverse * s + c
        skin = across - coat - gap
        a0, a1, a2 = inverse / c0, inverse / c1, inverse / c2
        b0 = (t0 * inverse + g0) * coat / c0
        b1 = (t1 * inverse + g1) * gap / c1
        b2 = (t2 * inverse + g2) * skin / c2
        if mobile:
            side = sign if sign != 0.0 else (1.0 if gap >= 0.0 else -1.0)
            # shrink = -A'/A, the relative decrease of the area per volt across the gap.
            shrink = side * scale * slope / inverse if -BELOW < s < 1.0 else 0.0
            a1 /= 1.0 - gap * shrink
            b1 /= 1.0 - gap * shrink
            a0, b0 = a0 + coat * shrink * a1, b0 + coat * shrink * b1
            a2, b2 = a2 + skin * shrink * a1, b2 + skin * shrink * b1
        return a0, b0, a1, b1, a0 + a1 + a2, b0 + b1 + b2

    return answer


def network_rates(
    around: Around, mobile: bool, drive: Drive, sin: Callable[[Any], Any], least: Least, compile_part: Part
) -> Any:
    """Function rates(t, x, sign, level) -> x' as a tuple, for the library's functions `sin` and `least`.

    Several signs are one number (see `code`). Elements that the circuit lacks are omitted at compile time.
    """
    assert len(around.fingers) == 1 or math.isfinite(around.body)
    source = compile_part(drive(sin))
    first, second = (
        _answer(finger, around.reach, mobile, least, compile_part) for finger in (around.fingers[0], around.fingers[-1])
    )
    conductance, cable, body = 1.0 / around.resistance, around.cable, around.body
    floats, two = math.isfinite(body), len(around.fingers) == 2
    place = 2 if floats else 1

    @compile_part
    def rates(t, x, sign, level):  # type: ignore[no-untyped-def]
        across = x[0]
        far = x[1] if floats else 0.0
        left = sign
        if two:
            right = float(round(sign / 3.0))
            left = sign - 3.0 * right
        a0, b0, a1, b1, a, b = first(x[place], x[place + 1], across, left)
        current = conductance * (source(t, level) - across - far)
        # The current charges the cable and the fingers, which are in parallel.
        capacitance, pull = cable + 1.0 / a, b / a
        if two:
            d0, e0, d1, e1, d, e = second(x[place + 2], x[place + 3], across, right)
            capacitance, pull = capacitance + 1.0 / d, pull + e / d
        speed = (current - pull) / capacitance
        through = (speed + b) / a
        coat, gap = a0 * through - b0, a1 * through - b1
        if two:
            through = (speed + e) / d
            return speed, current / body, coat, gap, d0 * through - e0, d1 * through - e1
        if floats:
            return speed, current / body, coat, gap
        return speed, coat, gap

    return rates
