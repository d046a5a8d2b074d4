"""What a deck measures: vectors, quantities made of them, crossings, and the measures of its `.meas` lines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

#: A device's own signals: names in SPICE's words, and the key of each among the signals of a run.
OF_DEVICES: Mapping[str, str] = {
    "u_gap": "u_gap", "f_el": "f_el", "f_t": "f_t", "friction": "friction", "area": "area", "sigma_el": "sigma_el",
    "a_real": "a_real", "u": "u_layer",
}  # fmt: skip
#: Parts of a node's phasor in SPICE's words; the phase is in radians.
PARTS = ("v", "vr", "vi", "vm", "vp", "vdb")
EDGES = ("rise", "fall", "cross")
LAST = -1  #: The number of a crossing that is the last one.


class Vector(NamedTuple):
    """A vector of a run: `kind` is ``v`` with one or two nodes, ``i`` with an element, or a signal with an element."""

    kind: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class Quantity:
    """An expression of vectors: alone, or with a function of their values in order."""

    text: str
    vectors: tuple[Vector, ...]
    function: Callable[..., float] | None = field(default=None, compare=False)

    def less(self, other: Quantity) -> Quantity:
        """The difference of two quantities."""
        both = partial(_difference, self.function, other.function, len(self.vectors))
        return Quantity(f"{self.text} - {other.text}", (*self.vectors, *other.vectors), both)


def _difference(f: Callable[..., float] | None, g: Callable[..., float] | None, n: int, *x: float) -> float:
    """Difference of a function of the first n values, or the value itself, and one of the others."""
    return (x[0] if f is None else f(*x[:n])) - (x[n] if g is None else g(*x[n:]))


class Crossing(NamedTuple):
    """When a quantity has a value: the `number`-th of its rises, falls or crossings from `since` (s) on; or a time."""

    of: Quantity | None
    value: float
    edge: str = "cross"
    number: int = 1
    since: float = 0.0


@dataclass(frozen=True)
class Measure:
    """One `.meas` line; what is not measurable has its reason in `refused`."""

    name: str
    kind: str  # A form in lower case, such as ``avg``
    of: Quantity | None = None
    start: Crossing | None = None  # When it is measured, or where a delay begins
    stop: Crossing | None = None  # Where a delay ends
    since: float | None = None  # s
    until: float | None = None
    needs: tuple[str, ...] = ()  # Other measures, in lower case, of which `formula` is a function
    formula: Callable[[Mapping[str, float]], float] | None = field(default=None, compare=False)  # Of other measures
    refused: str = ""
    analysis: str = "tran"  # Or ``ac``: times are frequencies (Hz) then
