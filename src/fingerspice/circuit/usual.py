"""Usual ranges of values: a value outside its range is allowed, and causes a warning."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from fingerspice.base.units import format_si, spice_text

# Units that take a prefix, where a slip of the user is a power of 1000; in the other units the slip is m^2 for mm^2.
_PREFIXED = ("m", "N", "Pa", "ohm", "ohm m", "V", "V/m", "F", "Hz", "s")
_THOUSANDS = tuple(sign * 3 * k for k in (1, 2, 3, 4, 5) for sign in (-1, 1))
_MILLIONS = {"mm^2": (6, -6), "mm^2/N^m": (6, -6), "mm^4/N^2": (12, -12)}


@dataclass(frozen=True)
class Usual:
    """Usual range of a quantity, both ends included."""

    # least, most: Smallest and largest usual size of the quantity, in its unit. 0 and inf mean "none" and cause no
    # warning.
    least: float
    most: float
    source: str  # Origin of the range, as words to stand in brackets
    slip: str = ""  # The unit, and the other unit for which it is often taken, such as ``newton, not millinewton``

    def warning(self, what: str, value: float, unit: str) -> str | None:
        """The warning about a value outside the range; None for a value inside.

        Parameters
        ----------
        what : str
            Name of the quantity, such as ``Xgap d``.
        value : float
            Value in `unit`.
        unit : str
        """
        size = abs(value)
        if size == 0.0 or not math.isfinite(size) or self.least <= size <= self.most:
            return None
        ends = f"{_shown(self.least, unit if unit in _PREFIXED else '')} to {_shown(self.most, unit)}"
        said = f"{what} is {_shown(value, unit)}, outside {ends}, the usual range ({self.source})"
        if self.slip:
            said += f": it is in {self.slip}"
        meant = self._meant(value, unit)
        return f"{said}; was {meant} meant?" if meant else said

    def _meant(self, value: float, unit: str) -> str:
        """Usual values with the same digits and another prefix: at most three, the nearest first."""
        powers = _THOUSANDS if unit in _PREFIXED else _MILLIONS.get(unit, ())
        found = [float(f"{value:.12g}") * 10.0**power for power in powers]
        texts = [spice_text(x) for x in found if self.least <= abs(x) <= self.most][:3]
        return " or ".join([", ".join(texts[:-1]), texts[-1]] if len(texts) > 1 else texts)


def _shown(value: float, unit: str) -> str:
    return format_si(value, unit) if unit in _PREFIXED else f"{value:.4g} {unit}".rstrip()


#: Area of a finger's ridges on the screen, mm^2: Table 1 has 35, the tip of a hair 0.01, a palm some thousand.
REST_AREA = Usual(0.1, 2000.0, "a fingertip has 20 to 400, a palm some 1000", "mm^2, not m^2")

#: Usual ranges of sources, by the unit of the parameter. Screens for electrovibration take 10 to 400 V, electroadhesive
#: grippers some kV. The skin feels up to 1 kHz; carriers have up to some 100 kHz, where the skin's data end.
SOURCES = {
    "V": Usual(0.0, 10e3, "screens take up to 400 V, grippers some kV"),
    "Hz": Usual(10e-3, 10e6, "a finger feels up to 1 kHz, carriers have up to some 100 kHz"),
}

#: Usual ranges of the largest of several measured values, by the signal: a finger's, pressed on with up to some N.
MEASURED = {
    "f_el": Usual(1e-6, 10.0, "a finger is pulled with up to 1 N", "newton, not millinewton"),
    "f_t": Usual(1e-3, 50.0, "a finger rubs with 0.01 to 10 N", "newton, not millinewton"),
    "area": Usual(0.1e-6, 2e-3, "a fingertip has 20 to 400 mm^2", "m^2, not mm^2"),
}
#: Usual range of the largest amplitude (V) under which forces, friction and areas are measured.
MEASURING = Usual(1.0, 10e3, "forces are measured at 10 V to some kV", "volt, not kilovolt")

#: Largest plausible results, N, Pa and m^2. A finger bears 100 N. Air, and most solids, break down far below an
#: electric pressure of 10 MPa (1.5 GV/m). No finger has a contact of 10 cm^2.
LARGEST_FORCE = 100.0
LARGEST_PRESSURE = 10e6
LARGEST_AREA = 1e-3


def beyond_fingers(where: str, force: float, pressure: float, area: float) -> Iterator[str]:
    """Warnings about results that no finger can have.

    Parameters
    ----------
    where : str
        Empty, or a text such as `` of Xgap``.
    force, pressure, area : float
        Largest values of the run, N, Pa and m^2.
    """
    for what, value, largest, unit, source in (
        ("electroadhesive force", force, LARGEST_FORCE, "N", "as much as a finger bears"),
        ("electric pressure", pressure, LARGEST_PRESSURE, "Pa", "that of 1.5 GV/m, beyond the strength of any layer"),
        ("contact area", area, LARGEST_AREA, "m^2", "10 cm^2, more than a finger has"),
    ):
        if value > largest:
            yield (
                f"the {what}{where} reaches {_shown(value, unit)}, over {_shown(largest, unit)} ({source}): some value "
                "is probably in another unit"
            )
