"""Start and transient of random networks with initial conditions, by dense linear algebra in node voltages.

It never imports the package. The start minimises a list of quadratic forms one after the other, each over the states
that the minima of the earlier forms leave free.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, null_space

FloatArray = NDArray[np.float64]
Branch = tuple[int, int, float]


@dataclass(frozen=True)
class Capacitor:
    """Between two nodes, farad, and its ``IC=`` in V or None."""

    p: int
    n: int
    value: float
    initial: float | None = None


@dataclass(frozen=True)
class Started:
    """A network of R, C, V and I between nodes 0 (ground) to `nodes`, its sources constant, and how it starts.

    Branches are (node, node, value); `initial` is ``.ic``.
    """

    nodes: int
    resistors: Sequence[Branch]
    capacitors: Sequence[Capacitor]
    voltages: Sequence[Branch]
    currents: Sequence[Branch]
    initial: dict[int, float] = field(default_factory=dict)
    uic: bool = True

    def _across(self, pairs: Sequence[tuple[int, int]]) -> FloatArray:
        """Voltages between pairs of nodes from those of the nodes, shape (n_pair, nodes)."""
        every = np.vstack([np.zeros(self.nodes), np.eye(self.nodes)])
        return np.array([every[a] - every[b] for a, b in pairs]).reshape(len(pairs), self.nodes)

    @property
    def _tied(self) -> tuple[FloatArray, FloatArray]:
        """What voltage sources demand: across, and its value."""
        return self._across([(p, n) for p, n, _ in self.voltages]), np.array([v for *_, v in self.voltages])

    @property
    def _stored(self) -> tuple[FloatArray, FloatArray]:
        """Capacitances between nodes, and the charges on the nodes at the start with ``uic``."""
        across = self._across([(c.p, c.n) for c in self.capacitors])
        at = {0: 0.0, **{node: self.initial.get(node, 0.0) for node in range(1, self.nodes + 1)}}
        held = np.array([at[c.p] - at[c.n] if c.initial is None else c.initial for c in self.capacitors])
        farad = np.array([c.value for c in self.capacitors])
        return across.T @ (farad[:, None] * across), across.T @ (farad * held)

    @property
    def _resisted(self) -> tuple[FloatArray, FloatArray]:
        """Conductances between nodes, and the currents that sources bring into them."""
        across = self._across([(p, n) for p, n, _ in self.resistors])
        brought = self._across([(p, n) for p, n, _ in self.currents])
        siemens = np.array([1.0 / r for *_, r in self.resistors])
        # A current source takes from its first node.
        return across.T @ (siemens[:, None] * across), -brought.T @ np.array([i for *_, i in self.currents])

    def start(self) -> FloatArray:
        """Node voltages (nodes,) at 0+."""
        levels = [_squares(*self._tied)]
        if self.uic:
            levels += [self._stored, self._resisted]
            return _in_turn(levels)
        named = [(node, 0) for node in self.initial]
        rest = _in_turn([*levels, _squares(self._across(named), np.array(list(self.initial.values()))), self._resisted])
        # Let go, the capacitors hold what they have.
        farad, _ = self._stored
        return _in_turn([*levels, (farad, farad @ rest), self._resisted])

    def response(self, times: Sequence[float]) -> FloatArray:
        """Node voltages (n_t, nodes)."""
        tied, _ = self._tied
        farad, _ = self._stored
        siemens, brought = self._resisted
        start = self.start()
        free = null_space(tied) if len(tied) else np.eye(self.nodes)
        values, vectors = np.linalg.eigh(free.T @ farad @ free)
        stores = values > 1e-9 * values.max(initial=1e-30)
        live, idle = free @ vectors[:, stores], free @ vectors[:, ~stores]
        # The idle part follows: its nodes' currents add up to nothing.
        follow = -np.linalg.solve(idle.T @ siemens @ idle, idle.T @ siemens @ live)
        move = live + idle @ follow
        inverse = np.linalg.inv(live.T @ farad @ live)
        push = inverse @ (live.T @ (brought - siemens @ start))
        n = live.shape[1]
        whole = np.zeros((n + 1, n + 1))
        whole[:n, :n], whole[:n, n] = -inverse @ (live.T @ siemens @ move), push
        return np.array([start + move @ expm(whole * t)[:n, n] for t in times])


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


def random_network(seed: int) -> Started:
    """A network of 2 to 6 nodes with random ``IC=`` and ``.ic``, with ``uic`` or not; the sources constant."""
    rng = np.random.default_rng(seed)
    while True:
        found = _draw(rng)
        try:
            found.start()
        except ValueError:
            continue
        return found


def _draw(rng: np.random.Generator) -> Started:
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
            voltages.append((a, b, volts()))
            tree = [tree[b] if x == tree[a] else x for x in tree]
    currents = [(*pair(), 1e-4 * volts()) for _ in range(rng.integers(0, 2))]
    initial = {node: volts() for node in range(1, count + 1) if rng.random() < 0.5}
    # The last node has two to ground, the others as many as they need to have two ends: what hangs on capacitors only
    # holds its charge.
    for node in (*range(1, count + 1), count):
        ends = [n for branch in (*resistors, *voltages, *currents) for n in branch[:2]]
        ends += [n for c in capacitors for n in (c.p, c.n)]
        wanted = 2 - ends.count(node) if node < count else 1
        for _ in range(max(wanted, int(rng.random() < 0.6))):
            resistors.append((node, 0, float(f"{1e5 * 10.0 ** rng.uniform(0.0, 2.0):.4g}")))
    return Started(count, resistors, capacitors, voltages, currents, initial, uic)


def deck_of(network: Started, step: float, stop: float, extra: Sequence[str] = ()) -> str:
    """The network as text, nodes called n1, n2, ..."""

    def named(letter: str, i: int, p: int, n: int) -> str:
        return f"{letter}{i} n{p} n{n}"

    lines = [f"{named('R', i, p, n)} {r!r}" for i, (p, n, r) in enumerate(network.resistors)]
    for i, c in enumerate(network.capacitors):
        held = "" if c.initial is None else f" IC={c.initial!r}"
        lines.append(f"{named('C', i, c.p, c.n)} {c.value!r}{held}")
    lines += [f"{named('V', i, p, n)} {v!r}" for i, (p, n, v) in enumerate(network.voltages)]
    lines += [f"{named('I', i, p, n)} {a!r}" for i, (p, n, a) in enumerate(network.currents)]
    lines += [f".ic v(n{node})={v!r}" for node, v in network.initial.items()]
    lines += [*extra, f".tran {step!r} {stop!r}{' uic' if network.uic else ''}"]
    return "\n".join(("a random network", *lines, "")).replace(" n0 ", " 0 ")
