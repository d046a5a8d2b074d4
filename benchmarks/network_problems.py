"""The network scenes of the benchmarks: shipped decks with an amplifier, a floating user, or two fingers.

All have the form for which the right-hand side of `network_rates.py` is written: the source drives, through one
resistance, the fingers and in parallel the capacitance of a cable, if there is one; if the user floats, the current
returns through the body's capacitance. Behind the resistance no voltage jumps with the source.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import fingerspice as fs
from fingerspice.circuit.statespace import contact_of, layer_constants
from problems import AMPLITUDE, DECK, Problem, area_series, by_name, held, square_text, tone


@dataclass(frozen=True)
class Finger:
    """A finger's layers (coating, gap, skin) and contact as numbers.

    Attributes
    ----------
    c : tuple of float
        Capacitances per area, F/m^2.
    g_total, g_area : tuple of float
        Leakage conductances, independent of the area (S) and per area (S/m^2).
    series : tuple of float
        Series of 1/A_R; see `problems.area_series`.
    stress : float
        sigma_el / u_gap^2, Pa/V^2.
    """

    c: tuple[float, float, float]
    g_total: tuple[float, float, float]
    g_area: tuple[float, float, float]
    series: tuple[float, ...]
    stress: float


@dataclass(frozen=True)
class Around:
    """The circuit around the fingers, and the fingers.

    Attributes
    ----------
    resistance : float
        Resistance in series with the source, ohm.
    cable : float
        Capacitance parallel to the fingers, F.
    body : float
        Capacitance through which the current returns, F; inf for a grounded user.
    fingers : tuple of Finger
    reach : float
        Upper bound of the gap voltages, V.
    """

    resistance: float
    cable: float
    body: float
    fingers: tuple[Finger, ...]
    reach: float


#: For each deck, the names of the elements that are the resistance, the cable and the body.
ELEMENTS = {
    "amplifier": ("Rout", "Ccable", None),
    "ungrounded_user": ("Rbody", None, "Cbody"),
    "two_fingers": ("Rbody", None, "Cbody"),
}


@dataclass(frozen=True)
class NetworkProblem(Problem):
    """A problem on one of the decks in `ELEMENTS`."""

    deck: str = "amplifier"

    def circuit(self) -> fs.Circuit:
        text = (DECK.parent / f"{self.deck}.cir").read_text(encoding="utf-8")
        if self.law == "mobile":
            text = text.replace(".include fingerspice.lib", ".include fingerspice_mobile.lib")
        circuit = fs.parse_netlist(text)
        skins = {f"{e.name}.f": self.skin_frequency for e in circuit.by_device("SKIN")}
        return circuit.replace({"Vdrive": self.waveform, **skins})

    @cached_property
    def around(self) -> Around:
        """Constants of the right-hand side."""
        circuit = self.circuit()
        values = {e.name: e.values["value"] for e in circuit.by_device("R", "C")}
        resistance, cable, body = ELEMENTS[self.deck]
        layers = zip(*(circuit.by_device(device) for device in ("LAYER", "GAP", "SKIN")), strict=True)
        return Around(
            resistance=values[resistance],
            cable=0.0 if cable is None else values[cable],
            body=math.inf if body is None else values[body],
            fingers=tuple(self._finger(*elements) for elements in layers),
            reach=self.reach,
        )

    def _finger(self, *elements: fs.Element) -> Finger:
        c, g_total, g_area = zip(*(layer_constants(e)[0].tolist() for e in elements), strict=True)
        contact = contact_of(elements[1])
        return Finger(c, g_total, g_area, area_series(contact, self.reach), float(contact.stress(1.0)))

    @property
    def stresses(self) -> tuple[float, ...]:
        return tuple(finger.stress for finger in self.around.fingers)


Exported = tuple[tuple[str, str, str], ...]


def _scene(
    deck: str, title: str, exported: Exported, square: bool, frequency: float, law: str = "local"
) -> NetworkProblem:
    kind = "square" if square else "sine"
    label = f"{frequency:g} Hz" if frequency < 1e3 else f"{frequency / 1e3:g} kHz"
    return NetworkProblem(
        name=f"{deck}_{kind}_{label.replace(' ', '')}" + ("" if law == "local" else f"_{law}"),
        title=f"{title}, {kind} {label}",
        waveform=fs.Square(AMPLITUDE, frequency) if square else fs.Sine(AMPLITUDE, frequency),
        drive=held if square else tone(AMPLITUDE, frequency),
        ngspice=square_text(frequency) if square else f"SIN(0 {AMPLITUDE!r} {frequency!r})",
        skin_frequency=frequency,
        period=1.0 / frequency,
        periods=100,
        law=law,
        # After a jump the gap voltage exceeds the source voltage by the stored charge.
        reach=1.3 * AMPLITUDE if square else AMPLITUDE,
        exported=exported,
        deck=deck,
    )


AMPLIFIER, FLOATING, TWO = (
    ("amplifier", "amplifier", Problem.exported),
    ("ungrounded_user", "floating user", Problem.exported),
    ("two_fingers", "two fingers", tuple((f"x{x}_top", f"x{x}_skin", x) for x in ("firm", "light"))),
)
#: The amplifier also runs a square of 100 Hz, where the layers leak and its resistance matters at the jumps; a floating
#: body only passes high frequencies.
NETWORKS = (
    _scene(*AMPLIFIER, False, 5000.0),
    _scene(*AMPLIFIER, True, 100.0),
    *(_scene(*deck, square, 5000.0) for deck in (FLOATING, TWO) for square in (False, True)),
    _scene(*AMPLIFIER, False, 5000.0, "mobile"),
    _scene(*AMPLIFIER, True, 100.0, "mobile"),
)


@lru_cache(maxsize=1)
def every() -> dict[str, Problem]:
    """All problems by name: stacks, then networks."""
    return by_name() | {problem.name: problem for problem in NETWORKS}
