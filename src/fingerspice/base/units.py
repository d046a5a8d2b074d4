"""Numbers: SPICE's notation read and written, and engineering notation written."""

from __future__ import annotations

import math
import re
from typing import TypeAlias

#: Types of numbers in a unit, and those units by the types' names.
Volt: TypeAlias = float
Hertz: TypeAlias = float
Second: TypeAlias = float
Degree: TypeAlias = float
PerSecond: TypeAlias = float
Ratio: TypeAlias = float
UNITS = {"Volt": "V", "Hertz": "Hz", "Second": "s", "Degree": "deg", "PerSecond": "1/s", "Ratio": ""}
#: Power of ten of each scale suffix; the suffix `mil` (25.4e-6) is not a power of ten.
SCALES = {"t": 12, "g": 9, "meg": 6, "k": 3, "m": -3, "u": -6, "µ": -6, "μ": -6, "n": -9, "p": -12, "f": -15}
MIL = 25.4e-6

#: Units that may follow a number without a scale. Units that begin with the letter of a scale (farad, newton, tesla
#: ...) are not among them, because SPICE takes that letter as the scale; nor is `a`, which elsewhere means atto.
PLAIN_UNITS = frozenset("""v vdc vac vpp volt volts h henry hz hertz o ohm ohms ω s sec second seconds c w watt watts
    deg degree degrees rad radian radians °c""".split())  # noqa: SIM905  # fmt: skip

# Words whose first letters SPICE reads as another scale than is meant, with that scale and the right one.
_MILLI = "m (milli)"
_MISREAD = {"milli": ("mil (25.4e-6)", "m"), "micro": (_MILLI, "u"), "met": (_MILLI, ""), "min": (_MILLI, "")}
_LETTERS = "a-zµμωΩ"
_NUMBER = re.compile(rf"([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+))(?:e([+-]?[0-9]+))?(°c|[{_LETTERS}]*)", re.IGNORECASE)
_LETTER_AS_POINT = re.compile(rf"([+-]?[0-9]+)([{_LETTERS}]+)([0-9]+)[{_LETTERS}]*", re.IGNORECASE)
_MEGA = re.compile(rf"[+-]?[0-9.]+(?:e[+-]?[0-9]+)?(M(?!eg|il)[{_LETTERS}]*)", re.IGNORECASE)
_DASHES = {0x2212: "-", 0x2013: "-", 0x2010: "-", 0x2011: "-"}
_MAX_LENGTH = 400
_PREFIXES = {-15: "f", -12: "p", -9: "n", -6: "u", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}


def parse_number(text: str) -> float:
    """Value of one SPICE number such as ``3.5u``, ``1meg``, ``200Hz`` or ``1e-6``, correctly rounded.

    Raises ValueError for another text, one that simulators read differently (``2k7``, ``1x``, ``1a``), and one outside
    the range of a double; the message says what to write instead.
    """
    if len(text) > _MAX_LENGTH:
        raise ValueError(f"a number of {len(text)} characters: at most {_MAX_LENGTH} are allowed")
    match = _NUMBER.fullmatch(text)
    if match is None:
        raise ValueError(_why_not_a_number(text))
    mantissa, exponent, letters = match[1], int(match[2] or 0), match[3].lower()
    if letters.startswith("mil") and not letters.startswith("milli"):
        value = float(f"{mantissa}e{exponent}") * MIL
    else:
        value = float(f"{mantissa}e{exponent + _power_of_ten(letters, text, match[3])}")
    if math.isinf(value):
        raise ValueError(f"'{text}' is larger than the largest number (1.8e308)")
    if value == 0.0 and mantissa.strip("+-0.") != "":
        raise ValueError(f"'{text}' is smaller than the smallest number (4.9e-324)")
    return value


def suspicious_mega(text: str) -> str:
    """What was probably meant by a number with a capital M, SPICE's milli that people read as mega.

    ``0.2MOhm`` gives ``0.2meg``; any other number, as ``1MEG``, gives an empty text.
    """
    match = _MEGA.fullmatch(text)
    return f"{text[: match.start(1)]}meg" if match is not None and match[1][0] == "M" else ""


def unit_read_as_scale(text: str, unit: str, word: str = "") -> bool:
    """Whether a number is followed by just a unit that SPICE takes for a scale: ``1F`` (not ``1f``), ``1farads``."""
    match = _NUMBER.fullmatch(text)
    return match is not None and (match[3] == unit or (word != "" and match[3].lower() in (word, f"{word}s")))


def format_si(value: float, unit: str, digits: int = 4) -> str:
    """A value in engineering notation, without trailing zeros: ``format_si(3.5e-6, "m")`` gives ``3.5 um``."""
    if not math.isfinite(value) or value == 0.0:
        return f"{value + 0.0:g} {unit}".rstrip()
    # Rounded first, as 999.96 to four digits is 1 k and not 1000.
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    power = 3 * (int(exponent) // 3)
    if power not in _PREFIXES:
        return f"{value:.{digits}g} {unit}".rstrip()
    scaled = float(mantissa) * 10.0 ** (int(exponent) - power)
    return f"{scaled:.{max(digits, 3)}g} {_PREFIXES[power]}{unit}".rstrip()


def exponent_and_scale(text: str) -> bool:
    """Whether a number has both, as ``1e-4u`` has, which is 1e-10 and seldom meant."""
    match = _NUMBER.fullmatch(text)
    return match is not None and match[2] is not None and match[3].lower() not in {"", *PLAIN_UNITS}


def spice_text(value: float) -> str:
    """A number in SPICE's notation: 3.5e-6 gives ``3.5u``, and 2e6 gives ``2meg``."""
    return format_si(value, "", 12).replace(" ", "").replace("M", "meg").replace("G", "g").replace("T", "t")


def _power_of_ten(letters: str, text: str, as_written: str) -> int:
    """Power of ten for which the letters after a number, given in lower case, stand."""
    digits = text[: len(text) - len(letters)]
    for word, (read_as, scale) in _MISREAD.items():
        if letters.startswith(word):
            raise ValueError(f"'{text}' would be read as {digits}{read_as}: write {digits}{scale}")
    if (scale := "meg" if letters.startswith("meg") else letters[:1]) in SCALES:
        return SCALES[scale]
    if letters in {"", *PLAIN_UNITS}:
        return 0
    if letters[0] in "ax":
        meanings = {"a": f"atto ({digits}e-18) or ampere: write {digits}", "x": f"mega: write {digits}meg"}
        raise ValueError(f"'{text}' differs between simulators: '{as_written}' may be {meanings[letters[0]]}")
    neither = "neither a scale (t g meg k m mil u n p f) nor a known unit"
    raise ValueError(f"'{as_written}' in '{text}' is {neither}: write {digits}")


def _why_not_a_number(text: str) -> str:
    """Why a text is not a number, with what to write where that can be guessed."""
    match = _LETTER_AS_POINT.fullmatch(text)
    if match is not None:
        whole, letters, fraction = match.groups()
        if letters.lower().startswith(tuple(SCALES)) or letters.lower() in ("r", "v"):
            scale = "" if letters.lower() in ("r", "v") else letters
            return f"'{text}' differs between simulators: write {whole}.{fraction}{scale}"
    guesses = {
        text.rstrip("%°"): "", "".join(text.split()): ", its unit stands apart",
        text.translate(_DASHES): ", its minus is a typographic one", text.replace(",", "."): ", its comma separates",
    }  # fmt: skip
    for guess, why in guesses.items():
        if guess != text.strip() and _NUMBER.fullmatch(guess):
            plain = f"{parse_number(guess) / 100.0:g}" if text.endswith("%") else guess
            return f"'{text}' is not a number{why}: write {plain}"
    return f"'{text}' is not a number (examples: 10, 2.5, 1e-6, 3.5u, 0.2meg)"


def amount_text(value: float, unit: str) -> str:
    """A value with its unit: an area takes no prefix, which would be squared with its unit, and a coefficient none."""
    plain = {"m^2": f"{1e6 * value:.4g} mm^2", "1": f"{value:.4g}"}
    return plain.get(unit) or format_si(value, unit)
