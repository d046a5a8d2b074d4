"""Values of parameters: their notation, those that are refused, and usual ranges, outside which there is a warning."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from fingerspice.base.arrays import real_number
from fingerspice.base.errors import InputError
from fingerspice.base.units import (
    format_si,
    parse_number,
    spice_text,
    suggest_mega,
    suspicious_mega,
    unit_read_as_scale,
)

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit, Element
    from fingerspice.circuit.devices import ParameterSpec

# Units that take a prefix, where a slip of the user is a power of 1000; in the other units the slip is m^2 for mm^2.
_PREFIXED = ("m", "N", "Pa", "ohm", "ohm m", "A", "V", "V/m", "F", "Hz", "s")
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
        """The warning about a value of `what`, such as ``Xgap d``, outside the range; None for a value inside."""
        size = abs(value)
        if size == 0.0 or not math.isfinite(size) or self.least <= size <= self.most:
            return None
        ends = f"{shown(self.least, unit if unit in _PREFIXED else '')} to {shown(self.most, unit)}"
        said = f"{what} is {shown(value, unit)}, outside {ends}, the usual range ({self.source})"
        said += f": it is in {self.slip}" if self.slip else ""
        # Usual values with the same digits and another prefix: at most three, the nearest first.
        powers = _THOUSANDS if unit in _PREFIXED else _MILLIONS.get(unit, ())
        found = [float(f"{value:.12g}") * 10.0**power for power in powers]
        meant = [spice_text(x) for x in found if self.least <= abs(x) <= self.most][:3]
        most = " or ".join([", ".join(meant[:-1]), meant[-1]] if len(meant) > 1 else meant)
        return f"{said}; was {most} meant?" if meant else said


def shown(value: float, unit: str) -> str:
    """A value with its unit; powers of a unit and angles take no prefix: 1 kmm^2 would not be 1000 mm^2."""
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

# Largest plausible results, each with its unit and the reason. Air, and most solids, break down far below an electric
# pressure of 10 MPa.
_LARGEST = (
    ("electroadhesive force", 100.0, "N", "as much as a finger bears"),
    ("electric pressure", 10e6, "Pa", "that of 1.5 GV/m, beyond the strength of any layer"),
    ("contact area", 1e-3, "m^2", "10 cm^2, more than a finger has"),
)


def beyond_fingers(where: str, force: float, pressure: float, area: float) -> Iterator[str]:
    """Warnings about largest values of a run (N, Pa and m^2) that no finger can have; `where` may be `` of Xgap``."""
    for value, (what, largest, unit, reason) in zip((force, pressure, area), _LARGEST, strict=True):
        if value > largest:
            yield (
                f"the {what}{where} reaches {shown(value, unit)}, over {shown(largest, unit)} ({reason}): some value "
                "is probably in another unit"
            )


# Units whose letter SPICE reads as a scale factor, with their names, and how SPICE reads them.
_UNIT_TRAPS = {"F": ("farad", "femto (1e-15)"), "N": ("newton", "nano (1e-9)")}


def unit_trap(spec: ParameterSpec, text: str) -> str | None:
    """Reason to refuse a number whose unit SPICE would read as a scale factor; None if SPICE would not."""
    word, prefix = _UNIT_TRAPS.get(spec.unit, ("", ""))
    if not word or not unit_read_as_scale(text, spec.unit, word):
        return None
    return f"is {text!r}: SPICE reads {spec.unit} as {prefix}; write the number alone, in {word}"


def mega_note(text: str, value: float, spec: ParameterSpec) -> str | None:
    """The warning about a number with a capital M, which SPICE reads as milli, if the parameter is a resistance."""
    if spec.unit not in ("ohm", "ohm m"):
        return None
    return f"{text!r} is milli ({value:g} {spec.unit}), as everywhere in SPICE; for megohm write {suggest_mega(text)}"


def value_of(path: str, given: Any, spec: ParameterSpec | None, unit: str) -> tuple[float, str | None]:
    """A parameter's new value, given as a number or as text, and a warning about how it is written, or None.

    `path` names it in messages, and `spec` is None for a parameter of a waveform.
    """
    if not isinstance(given, str):
        return real_number(path, given, f"a number {unit}".rstrip() + ", or text such as '3.5u'"), None
    text = given.strip()
    if text.lower() in ("inf", "none"):
        return math.inf, None
    try:
        value = parse_number(text)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    if spec is None:
        return value, None
    if trap := unit_trap(spec, text):
        raise InputError(f"{path} {trap}")
    note = mega_note(text, value, spec) if suspicious_mega(text) else None
    return value, f"{path}: {note}" if note else None


def unusual(element: Element) -> Iterator[tuple[str, str]]:
    """Warnings about an element's unusual values, each with the parameter's name (empty for the area at 0 V)."""
    wave, v = element.waveform, element.values
    found = [(p.name, p.unusual(element.name, v[p.name])) for p in element.spec.parameters]
    if wave is not None:
        found = [
            (name, SOURCES[unit].warning(f"{element.name} {name}", getattr(wave, name), unit))
            for name, unit in type(wave).units.items()
            if unit in SOURCES and hasattr(wave, name)
        ]
    if element.device == "GAP" and v["a_fix"] == 0.0 and not any(text for _, text in found):
        adhesive = v["alpha"] * v["fn"] ** v["m_exp"]
        area = adhesive**2 - v["c2"] * (v["mu"] * v["fn"]) ** 2
        if area > 0.0:
            found.append(("", REST_AREA.warning(f"{element.name} area at 0 V", area / adhesive, "mm^2")))
    yield from ((name, text) for name, text in found if text is not None)


def unusual_of_changed(before: Circuit, after: Circuit) -> tuple[dict[str, str], dict[str, str]]:
    """Warnings about unusual values in the elements that differ between two circuits, with the parameters' paths."""

    def texts(e: Element) -> dict[str, str]:
        return e.remember("unusual", lambda: {text: f"{e.name}.{name}".lower() for name, text in unusual(e)})

    found: tuple[dict[str, str], dict[str, str]] = {}, {}
    for a, b in zip(before.elements, after.elements, strict=True):
        if a is not b:
            found[0].update(texts(a))
            found[1].update(texts(b))
    return found


def concerns(warning: str, changes: Mapping[str, Any]) -> bool:
    """Whether a warning of the reader is about the notation of a value that `changes` now replaces."""
    said = warning.lower()
    for path in map(str.lower, changes):
        name, _, parameter = path.rpartition(".")
        # A warning that names only the source may be about its frequency.
        subjects = [path, f"{name} {parameter}", *([name] if parameter == "frequency" else [])]
        if any(f": {subject}: " in said for subject in subjects):
            return True
    return False


def check(circuit: Circuit) -> None:
    """Refuse values out of range and contacts that cannot exist."""
    for element in circuit.elements:
        element.remember("checked", partial(_check_element, element))
    if circuit.tran is not None and not circuit.tran.stop > 0.0:
        raise InputError(f"t_stop is {circuit.tran.stop:g} s; allowed: more than 0")


def _check_element(element: Element) -> None:
    v = element.values
    for spec in element.spec.parameters:
        if not spec.accepts(v[spec.name]):
            given = f"{v[spec.name]:g} {spec.unit}".rstrip()
            raise InputError(f"{element.name} {spec.name} is {given}; allowed: {spec.allowed()}", element.where)
    if element.device != "GAP":
        return
    m, n, fault = v["m_exp"], v["n_exp"], ""
    loss = math.sqrt(v["c2"]) * v["mu"] * v["fn"]
    if not 0.0 < m < n:
        fault = f"exponents are m_exp={m:g}, n_exp={n:g}; allowed: 0 < m_exp < n_exp"
    elif not 1.0 / m + 1.0 / n > 1.0:
        fault = (
            f"exponents m_exp={m:g}, n_exp={n:g} give 1/m + 1/n = {1 / m + 1 / n:.4g}; allowed: more than 1 (else Eq. "
            "4 has no single root)"
        )
    elif v["a_fix"] == 0.0 and not (area := v["alpha"] * v["fn"] ** m) > loss:
        hint = "".join(f"; note {text}" for _, text in unusual(element))
        fault = (
            f"has no contact: friction takes the whole ridge area at 0 V (A0 = alpha fn^m_exp = {area:.4g} mm^2, "
            f"sqrt(c2) mu fn = {loss:.4g} mm^2); allowed: A0^2 > c2 mu^2 fn^2, so less load fn, less friction mu or "
            f"less c2{hint}"
        )
    if fault:
        raise InputError(f"{element.name} {fault}", element.where)
