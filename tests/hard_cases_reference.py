"""References of the hard cases that `analytic.py` lacks: written from the equations, without importing the package.

`stack_fold` finds the fold of the `mobile` law without a division by D, which vanishes there. With A = g(|u_a|) and
q_x = A c_x u_x the stack obeys D u_a' = N, where, with S = sum of all 1/c_x,

    D = S c_a d(A u_a)/du_a - U dA/du_a        N = A U' + sum u_x g_x / c_x - S u_a g_a        g_x = 1/R_x + A/r_x

and the fold is D = 0. In the variable s with dt = D ds the same equations are smooth through it: dt/ds = D,
du_a/ds = N.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

import analytic as ref


@dataclass(frozen=True)
class StackFold:
    """Time (s), gap voltage (V) and area (m^2) where the `mobile` law ends."""

    t: float
    u_gap: float
    area: float


def stack_fold(
    params: ref.Parameters, amplitude: float, f: float, *, resisted: bool = False, method: str = "DOP853"
) -> StackFold:
    """Where a sine from rest meets the fold of Table 1's stack.

    `resisted` gives the end behind any series resistance instead, however small: the largest A u_a. From there the gap
    takes more voltage with less charge, and what drives it through a resistor cannot hold it.

    DOP853 at 1e-13 and Radau at 1e-11 agree to 4e-12 of the time, also where u_a only follows a slow drift: N vanishes
    there together with D, and t creeps up to the fold as s grows.
    """
    layers, om = ref.table1_layers(f, params), 2.0 * math.pi * f
    c = np.array([x.c for x in layers])
    elastance = float(np.sum(1.0 / c))

    def terms(y: np.ndarray) -> tuple[float, float, float, float, np.ndarray]:
        t, u, q_coat, q_skin = y
        a, slope = (float(x) for x in ref.contact(abs(u), params)[1:3])
        slope = slope if u >= 0.0 else -slope
        leak = np.array([q_coat / (a * c[0]), u, q_skin / (a * c[2])])
        leak *= np.array([1.0 / x.r_total + a / x.r_area for x in layers])
        growth = a + u * slope
        d = elastance * c[1] * growth - slope * amplitude * math.sin(om * t)
        n = a * amplitude * om * math.cos(om * t) + float(np.sum(leak / c)) - elastance * leak[1]
        return d, n, growth, a, leak

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        d, n, growth, _, leak = terms(y)
        current = leak[1] * d + c[1] * growth * n
        return np.array([d, n, current - leak[0] * d, current - leak[2] * d]) / start

    def end(_: float, y: np.ndarray) -> float:
        d, _, growth, *_ = terms(y)
        return growth if resisted else d

    end.terminal = True  # type: ignore[attr-defined]
    start = terms(np.zeros(4))[0]
    rtol = 1e-13 if method == "DOP853" else 1e-11
    run = solve_ivp(rates, (0.0, 1.0), np.zeros(4), method, events=end, rtol=rtol, atol=[1e-17, 1e-12, 1e-20, 1e-20])
    assert run.status == 1, "no fold"
    t, u = run.y[:2, -1]
    return StackFold(float(t), float(u), terms(run.y[:, -1])[3])
