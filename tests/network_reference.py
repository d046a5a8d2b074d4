"""Independent solutions of networks: linear ones by dense linear algebra in node voltages, fingers by an own ODE.

It never imports the package.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm, null_space

import analytic

FloatArray = NDArray[np.float64]
Branch = tuple[int, int, float]


@dataclass(frozen=True)
class Tone:
    """offset + amplitude sin(2 pi frequency t), from t = 0 on; 0 before."""

    offset: float
    amplitude: float = 0.0
    frequency: float = 1.0

    def __call__(self, t: float) -> float:
        return self.offset + self.amplitude * np.sin(2.0 * np.pi * self.frequency * t)

    def __str__(self) -> str:
        """As a netlist has it."""
        return f"SIN({self.offset!r} {self.amplitude!r} {self.frequency!r})" if self.amplitude else f"{self.offset!r}"


@dataclass(frozen=True)
class Capacitor:
    """Between two nodes, farad, and its ``IC=`` in V or None."""

    p: int
    n: int
    value: float
    initial: float | None = None


@dataclass(frozen=True)
class Nodal:
    """A network of R, C, V and I between nodes 0 (ground) to `nodes`, and how it starts.

    Resistors and sources are (node, node, value or tone); `initial` is ``.ic``. The start minimises a list of quadratic
    forms one after the other, each over the states that the minima of the earlier forms leave free.
    """

    nodes: int
    resistors: Sequence[Branch]
    capacitors: Sequence[Capacitor]
    voltages: list[tuple[int, int, Tone]]
    currents: list[tuple[int, int, Tone]]
    initial: dict[int, float] = field(default_factory=dict)
    uic: bool = True

    def _across(self, pairs: Sequence[tuple[int, int]]) -> FloatArray:
        """Voltages between pairs of nodes from those of the nodes, shape (n_pair, nodes)."""
        every = np.vstack([np.zeros(self.nodes), np.eye(self.nodes)])
        return np.array([every[a] - every[b] for a, b in pairs]).reshape(len(pairs), self.nodes)

    @property
    def _tied(self) -> FloatArray:
        """What voltage sources tie, shape (n_voltage, nodes)."""
        return self._across([(p, n) for p, n, _ in self.voltages])

    @property
    def _brought(self) -> FloatArray:
        """The nodes that current sources bring their currents into, shape (nodes, n_current)."""
        # A current source takes from its first node.
        return -self._across([(p, n) for p, n, _ in self.currents]).T

    @property
    def _stored(self) -> tuple[FloatArray, FloatArray]:
        """Capacitances between nodes, and the charges on the nodes at the start with ``uic``."""
        across = self._across([(c.p, c.n) for c in self.capacitors])
        at = {0: 0.0, **{node: self.initial.get(node, 0.0) for node in range(1, self.nodes + 1)}}
        held = np.array([at[c.p] - at[c.n] if c.initial is None else c.initial for c in self.capacitors])
        farad = np.array([c.value for c in self.capacitors])
        return across.T @ (farad[:, None] * across), across.T @ (farad * held)

    @property
    def _siemens(self) -> FloatArray:
        """Conductances between nodes."""
        across = self._across([(p, n) for p, n, _ in self.resistors])
        return across.T @ (np.array([1.0 / r for *_, r in self.resistors])[:, None] * across)

    def start(self) -> FloatArray:
        """Node voltages (nodes,) at 0+."""
        volts, amperes = (np.array([tone(0.0) for *_, tone in of]) for of in (self.voltages, self.currents))
        tied, resisted = _squares(self._tied, volts), (self._siemens, self._brought @ amperes)
        if self.uic:
            return _in_turn([tied, self._stored, resisted])
        named = _squares(self._across([(node, 0) for node in self.initial]), np.array(list(self.initial.values())))
        rest = _in_turn([tied, named, resisted])
        # Let go, the capacitors hold what they have.
        farad, _ = self._stored
        return _in_turn([tied, (farad, farad @ rest), resisted])

    def response(self, times: Sequence[float]) -> FloatArray:
        """Node voltages (n_t, nodes), by one dense exponential per time."""
        tied, (farad, _), siemens = self._tied, self._stored, self._siemens
        # An exosystem: for every source the states 1, sin, cos.
        tones = [tone for *_, tone in (*self.voltages, *self.currents)]
        size, count = 3 * len(tones), len(self.voltages)
        turn, value, begin = np.zeros((size, size)), np.zeros((len(tones), size)), np.tile([1.0, 0.0, 1.0], len(tones))
        for j, tone in enumerate(tones):
            omega = 2.0 * np.pi * tone.frequency
            turn[3 * j + 1, 3 * j + 2], turn[3 * j + 2, 3 * j + 1] = omega, -omega
            value[j, 3 * j : 3 * j + 2] = tone.offset, tone.amplitude
        # Voltages that obey the sources, and what is free beside them.
        held = np.linalg.pinv(tied) @ value[:count]
        free = null_space(tied) if len(tied) else np.eye(self.nodes)
        values, vectors = np.linalg.eigh(free.T @ farad @ free)
        stores = values > 1e-9 * values.max(initial=1e-30)
        live, idle = free @ vectors[:, stores], free @ vectors[:, ~stores]
        # The idle part charges no capacitor and follows at once: its nodes' currents add up to nothing.
        push = self._brought @ value[count:] - siemens @ held
        follow = np.linalg.inv(idle.T @ siemens @ idle) @ idle.T
        move, along = live - idle @ follow @ siemens @ live, held + idle @ follow @ push
        inverse = np.linalg.inv(live.T @ farad @ live) @ live.T
        n = live.shape[1]
        whole = np.zeros((n + size, n + size))
        whole[:n, :n], whole[n:, n:] = -inverse @ siemens @ move, turn
        whole[:n, n:] = inverse @ (push - siemens @ idle @ follow @ push - farad @ held @ turn)
        first = np.concatenate([inverse @ farad @ (self.start() - held @ begin), begin])
        return np.array([np.hstack([move, along]) @ (expm(whole * t) @ first) for t in times])


def _squares(across: FloatArray, value: FloatArray) -> tuple[FloatArray, FloatArray]:
    return across.T @ across, across.T @ value


def _in_turn(levels: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """The x that makes x^T H x / 2 - h^T x least for the first (H, h), and of those for the next, and so on.

    Raises
    ------
    ValueError
        Where they leave a choice.
    """
    x = np.zeros(levels[0][0].shape[0])
    free = np.eye(x.size)
    for h, linear in levels:
        if not free.shape[1]:
            break
        values, vectors = np.linalg.eigh(free.T @ h @ free)
        taken = values > 1e-10 * max(float(np.abs(h).max(initial=0.0)), 1e-30)
        along = free @ vectors[:, taken]
        x = x + along @ ((along.T @ (linear - h @ x)) / values[taken])
        free = free @ vectors[:, ~taken]
    if free.shape[1]:
        raise ValueError("a node has no voltage")
    return x


def random_network(seed: int, swinging: bool = False) -> Nodal:
    """A network of 2 to 6 nodes with random ``IC=`` and ``.ic``, with ``uic`` or not; the sources constant or tones."""
    rng = np.random.default_rng(seed)
    while True:
        found = _draw(rng)
        try:
            found.start()
        except ValueError:
            continue
        for sources in (found.voltages, found.currents) if swinging else ():
            for i, (p, n, tone) in enumerate(sources):
                amplitude, frequency = rng.uniform(-2.0, 2.0) * tone.offset, rng.choice([1e3, 7e4])
                sources[i] = (p, n, Tone(tone.offset, float(amplitude), float(frequency)))
        return found


def _draw(rng: np.random.Generator) -> Nodal:
    count = int(rng.integers(2, 7))

    def volts() -> float:
        return round(float(rng.uniform(-50.0, 50.0)), 3)

    def pair() -> tuple[int, int]:
        a, b = rng.choice(count + 1, 2, replace=False)
        return int(a), int(b)

    def farads() -> float:
        return float(f"{1e-10 * 10.0 ** rng.uniform(0.0, 2.0):.4g}")

    uic = bool(rng.random() < 0.6)
    capacitors = [
        Capacitor(*pair(), farads(), volts() if rng.random() < 0.5 else None) for _ in range(rng.integers(2, 9))
    ]
    resistors = [(*pair(), float(f"{1e3 * 10.0 ** rng.uniform(0.0, 2.0):.4g}")) for _ in range(rng.integers(0, 5))]
    tree = list(range(count + 1))
    voltages = []
    for a, b in (pair() for _ in range(rng.integers(1, 3))):
        if tree[a] != tree[b]:
            voltages.append((a, b, Tone(volts())))
            tree = [tree[b] if x == tree[a] else x for x in tree]
    currents = [(*pair(), Tone(1e-4 * volts())) for _ in range(rng.integers(0, 2))]
    initial = {node: volts() for node in range(1, count + 1) if rng.random() < 0.5}
    # The last node has two to ground, the others as many as they need to have two ends: what hangs on capacitors only
    # holds its charge.
    for node in (*range(1, count + 1), count):
        ends = [n for branch in (*resistors, *voltages, *currents) for n in branch[:2]]
        ends += [n for c in capacitors for n in (c.p, c.n)]
        wanted = 2 - ends.count(node) if node < count else 1
        for _ in range(max(wanted, int(rng.random() < 0.6))):
            resistors.append((node, 0, float(f"{1e5 * 10.0 ** rng.uniform(0.0, 2.0):.4g}")))
    return Nodal(count, resistors, capacitors, voltages, currents, initial, uic)


def deck_of(network: Nodal, step: float, stop: float, extra: Sequence[str] = ()) -> str:
    """The network as text, nodes called n1, n2, ..."""

    def named(letter: str, i: int, p: int, n: int) -> str:
        return f"{letter}{i} n{p} n{n}"

    lines = [f"{named('R', i, p, n)} {r!r}" for i, (p, n, r) in enumerate(network.resistors)]
    for i, c in enumerate(network.capacitors):
        held = "" if c.initial is None else f" IC={c.initial!r}"
        lines.append(f"{named('C', i, c.p, c.n)} {c.value!r}{held}")
    for letter, sources in (("V", network.voltages), ("I", network.currents)):
        lines += [f"{named(letter, i, p, n)} {tone}" for i, (p, n, tone) in enumerate(sources)]
    lines += [f".ic v(n{node})={v!r}" for node, v in network.initial.items()]
    lines += [*extra, f".tran {step!r} {stop!r}{' uic' if network.uic else ''}"]
    return "\n".join(("a random network", *lines, "")).replace(" n0 ", " 0 ")


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
