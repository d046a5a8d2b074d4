"""When switches close and open, which the voltage sources that control them determine beforehand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, Remembering
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.statespace import spanning_tree
from fingerspice.waveforms.waveform import DC, OFF, Product, Sum, Waveform, refuse

# Parts of a source's shortest time between which its voltage counts as monotonic; halvings of one that find a crossing;
# and most times that are looked at.
_PARTS, _HALVINGS, _MOST = 32.0, 60, 20_000_000


@dataclass(frozen=True)
class Course(Remembering):
    """Times at which the switches of a circuit close or open."""

    circuit: Circuit

    @property
    def switches(self) -> tuple[Element, ...]:
        """The switches, in the order of the deck."""
        return self.circuit.by_device("S")

    def controls(self) -> list[Waveform]:
        """The voltage that controls each switch; refused if voltage sources alone do not determine it."""
        sources = self.circuit.by_device("V")
        _, potential = spanning_tree(e.nodes for e in sources)
        out: list[Waveform] = []
        for e in self.switches:
            for node in e.control:
                allowed = "the nodes of a V element, whose voltage is known beforehand"
                refuse(node not in potential, f"{e.name} is controlled by {node!r}; allowed: {allowed}", e)
            row = (potential[e.control[0]] - potential[e.control[1]]).tolist()
            parts = [(w.waveform, x) for w, x in zip(sources, row, strict=True) if x and w.waveform is not None]
            waves = tuple(wave if sign == 1.0 else Product((DC(sign), wave)) for wave, sign in parts)
            out.append(Sum(waves) if len(waves) > 1 else waves[0] if waves else OFF)
        return out

    def changes(self, stop: float) -> tuple[FloatArray, BoolArray]:
        """Times from 0 to `stop` (s), shape (m,), and which switches are on before, between and after (m + 1, n)."""

        def make() -> tuple[FloatArray, BoolArray]:
            found = [_crossings(wave, e, stop) for e, wave in zip(self.switches, self.controls(), strict=True)]
            times = np.unique(np.concatenate([t for _, t in found]))
            on = [before ^ (np.append(0, t.searchsorted(times, "right")) % 2 == 1) for before, t in found]
            return times, np.array(on).T

        return self.remember(("changes", stop), make, 4)


def _crossings(wave: Waveform, switch: Element, stop: float) -> tuple[bool, FloatArray]:
    """Whether a switch is on before time 0, and when it changes up to `stop` (s)."""
    v = switch.values
    high, low = v["vt"] + v["vh"], v["vt"] - v["vh"]
    count = _PARTS * stop / wave.shortest_time(0.0, stop) + 1.0
    refuse(count > _MOST, f"{switch.name} is controlled by {count / _PARTS:.3g} periods; allowed: fewer", switch)
    grid = np.unique(np.concatenate([wave.breakpoints(0.0, stop), np.linspace(0.0, stop, 1 + int(np.ceil(count)))]))
    # Each time twice, with the limits from the left and from the right.
    t, u = np.repeat(grid, 2), np.column_stack([wave.value(grid, "left"), wave.value(grid)]).ravel()
    decided = np.where(u > high, 1, np.where(u < low, 0, -1))
    last = np.maximum.accumulate(np.where(decided >= 0, np.arange(u.size), -1))
    on = np.where(last >= 0, decided[last], 0) == 1
    k = np.flatnonzero(on[1:] != on[:-1])
    return bool(on[0]), _between(wave.value, t[k], t[k + 1], np.where(on[k + 1], high, low), on[k + 1])


def _between(
    value: Callable[[FloatArray], FloatArray], begin: FloatArray, end: FloatArray, level: FloatArray, rising: BoolArray
) -> FloatArray:
    """Times (m,) at which a voltage passes its levels (m,) between two times each, s."""
    for _ in range(_HALVINGS):
        middle = 0.5 * (begin + end)
        if not np.any((begin < middle) & (middle < end)):
            break
        u = value(middle)
        beyond = np.where(rising, u > level, u < level)
        begin, end = np.where(beyond, begin, middle), np.where(beyond, middle, end)
    return end
