"""Independent solutions of networks: nodal equations by dense matrix exponentials, fingers by a hand-written ODE.

It never imports the package.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import analytic

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Tone:
    """offset + amplitude sin(2 pi frequency t), from t = 0 on; 0 before."""

    offset: float
    amplitude: float
    frequency: float

    def __call__(self, t: float) -> float:
        return self.offset + self.amplitude * np.sin(2.0 * np.pi * self.frequency * t)


@dataclass(frozen=True)
class Nodal:
    """A network of R and C with grounded voltage sources and current sources into nodes. Node 0 is ground.

    Elements are (node, node, value); `voltages` and `currents` map a node to its source.
    """

    nodes: int
    resistors: Sequence[tuple[int, int, float]]
    capacitors: Sequence[tuple[int, int, float]]
    voltages: dict[int, Tone]
    currents: dict[int, Tone]

    def _matrix(self, branches: Sequence[tuple[int, int, float]]) -> FloatArray:
        m = np.zeros((self.nodes, self.nodes))
        for a, b, value in branches:
            for i, j in ((a, b), (b, a)):
                if i:
                    m[i - 1, i - 1] += value
                    if j:
                        m[i - 1, j - 1] -= value
        return m

    def response(self, times: Sequence[float]) -> FloatArray:
        """Node voltages (n_t, nodes) at t > 0 from the uncharged state, by one dense exponential per time."""
        c = self._matrix(self.capacitors)
        g = self._matrix([(a, b, 1.0 / r) for a, b, r in self.resistors])
        known = [n - 1 for n in sorted(self.voltages)]
        unknown = [i for i in range(self.nodes) if i not in known]
        # An exosystem: for every source the states 1, sin, cos.
        sources = [(n - 1, self.voltages[n]) for n in sorted(self.voltages)] + [
            (n - 1, self.currents[n]) for n in sorted(self.currents)
        ]
        size = 3 * len(sources)
        turn = np.zeros((size, size))
        value = np.zeros((len(sources), size))
        start = np.zeros(size)
        for j, (_, tone) in enumerate(sources):
            omega = 2.0 * np.pi * tone.frequency
            turn[3 * j + 1, 3 * j + 2], turn[3 * j + 2, 3 * j + 1] = omega, -omega
            value[j, 3 * j], value[j, 3 * j + 1] = tone.offset, tone.amplitude
            start[3 * j], start[3 * j + 2] = 1.0, 1.0
        held = value[: len(known)]
        push = np.zeros((self.nodes, size))
        for j, (node, _) in enumerate(sources[len(known) :]):
            push[node] += value[len(known) + j]

        def part(m: FloatArray, rows: list[int], columns: list[int]) -> FloatArray:
            return m[np.ix_(rows, columns)]

        # Of the unknown voltages some combinations charge no capacitor: those follow at once.
        every_c, every_g = part(c, unknown, unknown), part(g, unknown, unknown)
        values, vectors = np.linalg.eigh(every_c)
        stored = values > 1e-9 * values.max(initial=0.0)
        live, free = vectors[:, stored], vectors[:, ~stored]
        force = push[unknown] - part(g, unknown, known) @ held
        inverse = np.linalg.inv(free.T @ every_g @ free)
        from_live = live - free @ inverse @ (free.T @ every_g @ live)
        from_sources = free @ inverse @ (free.T @ force)
        inverse_c = np.linalg.inv(live.T @ every_c @ live)
        into = live.T @ (force - every_g @ from_sources - part(c, unknown, known) @ held @ turn)
        n = live.shape[1]
        whole = np.zeros((n + size, n + size))
        whole[:n, :n], whole[:n, n:] = -inverse_c @ (live.T @ every_g @ from_live), inverse_c @ into
        whole[n:, n:] = turn
        # The step of the voltage sources at t = 0 splits over the capacitors at once.
        first = -inverse_c @ (live.T @ (part(c, unknown, known) @ (held @ start)))
        out = np.zeros((len(times), self.nodes))
        for i, t in enumerate(times):
            z = expm(whole * t) @ np.concatenate([first, start])
            out[i, unknown] = from_live @ z[:n] + from_sources @ z[n:]
            out[i, known] = held @ z[n:]
        return out


@dataclass(frozen=True)
class Floating:
    """Table 1's layers in series with a resistor and a capacitor to ground: amplifier, finger, body.

    `tau` (s) is the contact's; 0 where the area follows at once.
    """

    frequency: float
    resistance: float
    body: float
    mobile: bool
    tau: float = 0.0

    def response(
        self, u: Callable[[float], float], times: Sequence[float], rtol: float = 1e-12, start: FloatArray | None = None
    ) -> dict[str, FloatArray]:
        """Gap voltage (V), area (m^2), delivered charge (C) and state at times from 0 on, from a state or uncharged.

        The state is the voltages (V) of coat, gap, skin and body, the area (m^2) where it is slow, at a column each.
        """
        layers = analytic.table1_layers(self.frequency)
        a0 = float(analytic.area(0.0))
        c = np.array([layer.c for layer in layers])
        g_total = np.array([1.0 / layer.r_total for layer in layers])
        g_area = np.array([1.0 / layer.r_area for layer in layers])
        gap = 1

        def unpack(y: FloatArray) -> tuple[FloatArray, float]:
            if not self.mobile:
                area = y[5] if self.tau > 0.0 else float(analytic.area(abs(y[gap])))
                return y[:3], area
            if self.tau > 0.0:
                return y[:3] / (c * y[5]), y[5]
            q = y[gap]
            if q == 0.0:
                return y[:3] / (c * a0), a0

            # The area grows by 1 % at first, then falls; these stay where it is not less than half.
            v = held = float(q / (c[gap] * a0))
            if not abs(held) <= 200.0:
                return np.full(3, np.nan), math.nan
            for _ in range(50):
                _, at, slope, _ = analytic.contact(abs(v))
                step = (at * v - a0 * held) / (at + abs(v) * slope)
                v -= float(step)
                # What is left is of the square of the last step.
                if abs(step) <= 1e-9 * abs(v):
                    break
            else:
                raise AssertionError("Newton's method did not converge")
            area = float(analytic.area(abs(v)))
            return y[:3] / (c * area), area

        def rates(t: float, y: FloatArray) -> FloatArray:
            v, area = unpack(y)
            i = (u(t) - v.sum() - y[3]) / self.resistance
            net = i - (g_total + g_area * area) * v
            out = np.zeros(y.size)
            out[:3] = net if self.mobile else net / (c * area)
            out[3] = i / self.body
            out[4] = i
            if self.tau > 0.0:
                out[5] = (float(analytic.area(abs(v[gap]))) - area) / self.tau
            return out

        y0 = np.zeros(6 if self.tau > 0.0 else 5)
        if self.tau > 0.0:
            y0[5] = a0
        if start is not None:
            y0[:4] = start[:4]
            area = start[4] if self.tau > 0.0 else float(analytic.area(abs(start[gap])))
            if self.mobile:
                y0[:3] *= c * area
            y0[5:] = start[4:]
        scale = np.full(y0.size, 1e-12)
        if self.mobile:
            scale[:3] *= 1e-10
        scale[4] *= 1e-10
        if self.tau > 0.0:
            scale[5] *= 1e-5
        # A stage that is refused may have been far out.
        with np.errstate(all="ignore"):
            found = self._pieces(rates, y0, np.asarray(times), gap, {"rtol": rtol, "atol": scale})
        states = [unpack(y) for y in found.T]
        return {
            "u_gap": np.array([v[gap] for v, _ in states]),
            "area": np.array([a for _, a in states]),
            "charge": found[4],
            "state": np.array([[*v, y[3], *y[5:]] for (v, _), y in zip(states, found.T, strict=True)]).T,
        }

    def _pieces(
        self, rates: Callable[[float, FloatArray], FloatArray], y: FloatArray, times: FloatArray, gap: int, how: Any
    ) -> FloatArray:
        """States at the times; from an uncharged start with a slow area no step passes over the kinks at 0 V."""
        found, begin, stops = [], 0.0, self.tau > 0.0 and y[gap] == 0.0
        while True:
            side = float(np.sign(rates(begin, y)[gap]))

            def at_zero(t: float, y: FloatArray, begin: float = begin, side: float = side) -> float:
                return float(y[gap]) if t > begin + 1e-9 else side

            at_zero.terminal = True  # type: ignore[attr-defined]
            left = times[times > begin] if found else times
            run = solve_ivp(rates, (begin, times[-1]), y, "DOP853", left, events=at_zero if stops else None, **how)
            assert run.success, run.message
            found.append(run.y.reshape(y.size, -1))
            if run.status == 0:
                return np.concatenate(found, axis=1)
            begin, y = float(run.t_events[0][0]), run.y_events[0][0]
