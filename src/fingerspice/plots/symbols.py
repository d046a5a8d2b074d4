"""Symbols of a schematic as strokes: points in inches around the symbol's centre, the first node above."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fingerspice.circuit.circuit import Element

Stroke = Sequence[tuple[float, float]]
#: Half the height of a part, and half the distance of a resistor from the capacitor beside it.
HALF, APART = 0.24, 0.17
_RADIUS = 0.17


def symbol(element: Element) -> tuple[list[Stroke], float, float]:
    """Strokes of an element's symbol, half its height, and half its width."""
    if element.device == "R":
        return [*_resistor(0.0, 0.0)], HALF, 0.08
    if element.device == "C":
        return [*_capacitor(0.0, 0.0)], HALF, 0.12
    if element.device in "VI":
        return [*_source(element.device)], HALF, _RADIUS
    if element.device == "SKIN_DISPERSIVE":
        # Two cells stand for the many of the ladder, with dots in between.
        away = HALF + 0.1
        dots: list[Stroke] = [[(0.0, y), (0.0, y + 0.02)] for y in (-0.06, -0.01, 0.04)]
        return [*_cell(away, leaks=True), *dots, *_cell(-away, leaks=True)], 2.0 * HALF + 0.1, APART + 0.12
    leak = element.values.get("r", element.values.get("rho", 0.0))
    return [*_cell(0.0, leaks=bool(np.isfinite(leak)))], HALF, APART + 0.12


def ground(x: float, y: float) -> list[Stroke]:
    """Strokes of a ground whose wire begins at (x, y)."""
    lines: list[Stroke] = [[(x, y), (x, y - 0.14)]]
    return lines + [[(x - w, y - d), (x + w, y - d)] for w, d in ((0.13, 0.14), (0.08, 0.19), (0.03, 0.24))]


def _cell(y: float, *, leaks: bool) -> list[Stroke]:
    """A capacitor, and a resistor beside it where the layer leaks."""
    if not leaks:
        return _capacitor(0.0, y)
    bars: list[Stroke] = [[(-APART, y + s * HALF), (APART, y + s * HALF)] for s in (1.0, -1.0)]
    return [*_resistor(-APART, y), *_capacitor(APART, y), *bars]


def _resistor(x: float, y: float) -> list[Stroke]:
    top, step, wide = y + 0.15, 0.05, 0.06
    zigzag = [(x + wide * (-1.0) ** k, top - step * (k + 0.5)) for k in range(6)]
    return [[(x, y + HALF), (x, top), *zigzag, (x, y - 0.15), (x, y - HALF)]]


def _capacitor(x: float, y: float) -> list[Stroke]:
    plates: list[Stroke] = [[(x - 0.11, y + s * 0.035), (x + 0.11, y + s * 0.035)] for s in (1.0, -1.0)]
    return [*plates, *([(x, y + s * 0.035), (x, y + s * HALF)] for s in (1.0, -1.0))]


def _source(device: str) -> list[Stroke]:
    """A circle, with plus and minus for a voltage, and for a current its arrow from the first node to the second."""
    angle = np.linspace(0.0, 2.0 * np.pi, 61)
    circle = [(float(_RADIUS * np.cos(a)), float(_RADIUS * np.sin(a))) for a in angle]
    leads: list[Stroke] = [[(0.0, s * _RADIUS), (0.0, s * HALF)] for s in (1.0, -1.0)]
    if device == "I":
        return [circle, *leads, [(0.0, 0.11), (0.0, -0.11)], [(-0.045, -0.05), (0.0, -0.11), (0.045, -0.05)]]
    plus: list[Stroke] = [[(-0.045, 0.085), (0.045, 0.085)], [(0.0, 0.04), (0.0, 0.13)]]
    return [circle, *leads, *plus, [(-0.045, -0.085), (0.045, -0.085)]]
