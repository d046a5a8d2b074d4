"""The network scenes by Radau collocation, from the paper's equations in `tests/analytic.py`.

Nothing of the package is used: areas come from Eqs. 1 to 4 at every point, and the circuits' values are repeated here,
so that errors in reading a deck show as well. State x (V): the voltage across all fingers, the body's voltage, and the
voltages of each finger's coating and gap. See `network_rates.py` for the equations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve
from scipy.optimize import brentq

from network_rates import code

FloatArray = NDArray[np.float64]
Source = Callable[[FloatArray], FloatArray]
STAGES, TOL, MOST = 10, 1e-14, 40
#: Resistance (ohm), cable and body (F), and the fingers' normal loads (N) of each deck.
DECKS = {
    "amplifier": (47e3, 150e-12, math.inf, (0.5,)),
    "ungrounded_user": (1.5e3, 0.0, 150e-12, (0.5,)),
    "two_fingers": (1.5e3, 0.0, 150e-12, (0.5, 0.2)),
}


class Network:
    """The time derivatives of a deck's state, for many states at once."""

    def __init__(self, analytic: ModuleType, deck: str, skin_frequency: float, mobile: bool) -> None:
        self.resistance, self.cable, self.body, loads = DECKS[deck]
        self.analytic, self.mobile = analytic, mobile
        self.fingers = [replace(analytic.TABLE1, force_normal=load) for load in loads]
        layers = analytic.table1_layers(skin_frequency)
        self.c = np.array([layer.c for layer in layers])
        self.g_total = np.array([1.0 / layer.r_total for layer in layers])
        self.g_area = np.array([1.0 / layer.r_area for layer in layers])
        self.size = 2 + 2 * len(loads)
        self.gaps = [3 + 2 * j for j in range(len(loads))]

    def rates(self, source: FloatArray, x: FloatArray, signs: Sequence[float]) -> FloatArray:
        """x' (m, n) in V/s for sources (m,) and states (m, n); `signs` selects the branch of each gap's area."""
        fingers = []
        meets, pull = np.full(len(x), self.cable), np.zeros(len(x))
        for j, sign in enumerate(signs):
            u = np.column_stack([x[:, 2 + 2 * j], x[:, 3 + 2 * j], x[:, 0] - x[:, 2 + 2 * j] - x[:, 3 + 2 * j]])
            _, area, slope, _ = self.analytic.contact(sign * u[:, 1], self.fingers[j])
            # The layer voltages change by u' = a i - b, with the finger's current i.
            a = 1.0 / (self.c * area[:, None])
            b = (self.g_total + self.g_area * area[:, None]) * u * a
            if self.mobile:
                grows = sign * slope / area
                a[:, 1] /= 1.0 + u[:, 1] * grows
                b[:, 1] /= 1.0 + u[:, 1] * grows
                for k in (0, 2):
                    a[:, k] -= u[:, k] * grows * a[:, 1]
                    b[:, k] -= u[:, k] * grows * b[:, 1]
            fingers.append((a, b))
            meets, pull = meets + 1.0 / a.sum(1), pull + b.sum(1) / a.sum(1)
        current = (source - x[:, 0] - x[:, 1]) / self.resistance
        speed = (current - pull) / meets
        columns = [speed, current / self.body]
        for a, b in fingers:
            through = (speed + b.sum(1)) / a.sum(1)
            columns += [a[:, k] * through - b[:, k] for k in (0, 1)]
        return np.column_stack(columns)

    def forces(self, u_gap: FloatArray) -> FloatArray:
        """Electroadhesive forces (N) at gap voltages (V), shape (m, n_finger)."""
        return np.column_stack(
            [self.analytic.contact(np.abs(u), p)[3] for u, p in zip(u_gap.T, self.fingers, strict=True)]
        )


class Collocation:
    """A run of a network; steps end on zeros of the gap voltages, where the areas have kinks."""

    def __init__(self, network: Network, scale: float, t_eval: FloatArray) -> None:
        self.network, self.scale, self.t_eval = network, scale, t_eval
        self.nodes = network.analytic._nodes("radau", STAGES)
        self.out = np.empty((t_eval.size, network.size))
        self.zeros: list[float] = []
        # Start times of the branches, each with the `code` of the gap voltages' signs.
        self.branches: list[tuple[float, float]] = []
        self.steps = 0

    def attempt(self, t: float, h: float, x: FloatArray, source: Source, signs: list[float]) -> FloatArray | None:
        """States at the start and the stages of a step, (stages + 1, n); None if the iteration does not converge."""
        network, nodes, n = self.network, self.nodes, x.size
        m = STAGES
        u = source(t + h * nodes.tau)
        # Simplified Newton iteration: the Jacobian at the start of the step is used at all stages and iterations.
        d = 1e-5 * self.scale
        around = np.vstack([x + d * np.eye(n), x - d * np.eye(n)])
        f = network.rates(np.full(2 * n, u[0]), around, signs)
        slope = (f[:n] - f[n:]).T / (2.0 * d)
        system = lu_factor(np.eye(m * n) - h * np.kron(nodes.integrate, slope))
        z, last = np.zeros((m, n)), math.inf
        for _ in range(MOST):
            missing = h * nodes.integrate @ network.rates(u, x + z, signs) - z
            step = lu_solve(system, missing.ravel()).reshape(m, n)
            z = z + step
            size = float(np.abs(step).max()) / self.scale
            if not size < 1e3:
                return None
            if size < 1e-15 or (size < 1e-13 and size >= 0.5 * last):
                return np.vstack([x, x + z])
            last = size
        return None

    def zero(self, w: FloatArray, signs: list[float]) -> tuple[float, int] | None:
        """Fraction of a step at which a gap voltage first changes its sign, and its number; None if none does."""
        found = []
        grid = np.linspace(-1.0, 1.0, 4 * STAGES + 1)
        rows = self.nodes.interpolation(grid)
        for j, place in enumerate(self.network.gaps):
            values = signs[j] * (rows @ w[:, place])
            # A voltage that starts at a zero may have the wrong sign by round-off.
            below = np.flatnonzero(values[1:] < -1e-13 * self.scale)
            if below.size:
                low, high = grid[below[0]], grid[below[0] + 1]

                def value(s: float, place: int = place, sign: float = signs[j]) -> float:
                    return float(sign * (self.nodes.interpolation(np.array([s])) @ w[:, place])[0])

                if value(low) > 0.0:
                    found.append((0.5 * (1.0 + brentq(value, low, high, xtol=1e-16, rtol=1e-15)), j))
        return min(found) if found else None

    def shortened(
        self, t: float, h: float, x: FloatArray, source: Source, signs: list[float], cut: tuple[float, int]
    ) -> tuple[float, FloatArray]:
        """Length and states of a step that ends on a zero of a gap voltage, which `cut` locates in a longer step."""
        fraction, j = cut
        place = self.network.gaps[j]
        before = self.nodes.interpolation(np.array([1.0 - 2e-3]))
        # The polynomial of a shorter step has a slightly different zero: two corrections reach round-off.
        for _ in range(3):
            h *= fraction
            w = self.attempt(t, h, x, source, signs)
            assert w is not None
            end = w[-1, place]
            fraction = 1.0 - end * 1e-3 / (end - float((before @ w[:, place])[0]))
        return h, w

    def signs(self, t: float, length: float, x: FloatArray, source: Source) -> list[float]:
        """Signs of the gap voltages at the start of a smooth stretch; at 0 V the sign just after the start."""
        signs = [math.copysign(1.0, x[place]) for place in self.network.gaps]
        if min(abs(x[place]) for place in self.network.gaps) <= 1e-12 * self.scale:
            w = self.attempt(t, 1e-6 * length, x, source, signs)
            assert w is not None
            signs = [math.copysign(1.0, w[-1, place]) for place in self.network.gaps]
        return signs

    def segment(self, t0: float, t1: float, x: FloatArray, source: Source) -> FloatArray:
        """Integrate over a smooth stretch of the source, and return the state at its end."""
        t, h = t0, 1e-3 * (t1 - t0)
        signs = self.signs(t0, t1 - t0, x, source)
        self.branches.append((t0, code(signs)))
        while t < t1:
            last = t + 1.0001 * h >= t1
            h = t1 - t if last else h
            w = self.attempt(t, h, x, source, signs)
            if w is None:
                h *= 0.4
                continue
            error = float(np.abs(self.nodes.tail @ (w - w[0])).max()) / (TOL * self.scale)
            if error > 1.0:
                h *= max(0.2, 0.8 * error ** (-1.0 / STAGES))
                continue
            following = h * min(3.0, 0.85 * max(error, 1e-9) ** (-1.0 / STAGES))
            cut = self.zero(w, signs)
            if cut is not None:
                h, w = self.shortened(t, h, x, source, signs, cut)
                last = False
                signs[cut[1]] = -signs[cut[1]]
                self.zeros.append(t + h)
                self.branches.append((t + h, code(signs)))
            inside = slice(*np.searchsorted(self.t_eval, [t, t + h]))
            self.out[inside] = self.nodes.interpolation(2.0 * (self.t_eval[inside] - t) / h - 1.0) @ w
            self.steps += 1
            t, x, h = t1 if last else t + h, w[-1], following
        return x
