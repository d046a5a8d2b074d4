"""SPICE numbers and engineering notation."""

import contextlib
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerspice.base.units import format_si, parse_number, suggest_mega, suspicious_mega, unit_read_as_scale
from scenes import cases

VALUES = {
    "10": 10.0, ".5": 0.5, "5.": 5.0, "-3": -3.0, "+3": 3.0, "1e-6": 1e-6, "1E3": 1e3, "1e3k": 1e6, "1t": 1e12,
    "1g": 1e9, "0.2meg": 2e5, "1MEG": 1e6, "1MegOhm": 1e6, "200k": 2e5, "1m": 1e-3, "1M": 1e-3, "1mil": 25.4e-6,
    "350u": 350e-6, "1µ": 1e-6, "1μF": 1e-6, "10uF": 1e-5, "1n": 1e-9, "1p": 1e-12, "1f": 1e-15, "1F": 1e-15,
    "5V": 5.0, "200Hz": 200.0, "1Ohm": 1.0, "1kΩ": 1e3, "90deg": 90.0, "0e-999": 0.0,
}  # fmt: skip
REFUSED = {
    "2k7": "write 2.7k", "4R7": "write 4.7", "1x": "write 1meg", "1a": "write 1", "1A": "write 1", "1milli": "write 1m",
    "5micro": "write 5u", "5meter": "write 5", "1q": "neither a scale", "1e": "neither a scale", "1e999": "larger than",
    "1e308k": "larger than", "1e-999": "smaller than", "9" * 500: "characters",
    **dict.fromkeys(("", ".", "-", "inf", "nan", "1_0", " 1", "1 ", "1.2.3", "0x10", "١", "1,2"), "is not a number"),
}  # fmt: skip
WRITTEN = {
    3.5e-6: "3.5 um", 2e5: "200 km", 0.0: "0 m", 999.96: "1 km", 999.94: "999.9 m", -1500.0: "-1.5 km",
    1e-20: "1e-20 m", 1e17: "1e+17 m", math.inf: "inf m", -math.inf: "-inf m", math.nan: "nan m",
}  # fmt: skip


def test_numbers_have_the_value_that_spice_gives_them_and_a_suffix_costs_no_rounding() -> None:
    assert {text: parse_number(text) for text in VALUES} == VALUES
    assert parse_number("3.5u") == 3.5e-6
    assert [i for i in range(1000) if parse_number(f"{i}.1u") != float(f"{i}.1e-6")] == []


def test_what_is_no_number_or_read_differently_elsewhere_is_refused() -> None:
    for text, hint in REFUSED.items():
        with pytest.raises(ValueError, match=hint):
            parse_number(text)


def test_a_capital_m_is_suspected_of_meaning_mega_and_a_unit_that_spice_takes_for_a_scale_is_recognised() -> None:
    assert [t for t in ("1M", "0.2MOhm", "1MΩ", "-3e2M") if not suspicious_mega(t)] == []
    assert [t for t in ("1m", "0.2meg", "1MEG", "1MIL", "0.2mohm", "M", "x") if suspicious_mega(t)] == []
    assert suggest_mega("0.2MOhm") == "0.2meg"
    for text, unit, word, taken in (
        ("1F", "F", "farad", True), ("1farads", "F", "farad", True), ("0.5N", "N", "newton", True),
        ("1f", "F", "farad", False), ("1uF", "F", "farad", False),
    ):  # fmt: skip
        assert unit_read_as_scale(text, unit, word) is taken


def test_engineering_notation_which_without_a_unit_ends_in_the_prefix() -> None:
    assert {value: format_si(value, "m") for value in WRITTEN} == WRITTEN
    assert [format_si(-0.0, "m"), format_si(2e5, ""), format_si(1.0, "")] == ["0 m", "200 k", "1"]
    assert format_si(123.4, "V", digits=2) == "120 V"


@settings(max_examples=cases(100, 40))
@given(st.floats(min_value=1e-14, max_value=1e14))
def test_engineering_notation_reads_back_to_its_digits(value: float) -> None:
    text = format_si(value, "").replace(" ", "").replace("M", "meg")
    assert parse_number(text) == pytest.approx(value, rel=1e-3)


@settings(max_examples=cases(100, 40))
@given(st.text(max_size=12))
def test_any_text_is_a_finite_number_or_a_value_error(text: str) -> None:
    with contextlib.suppress(ValueError):
        assert math.isfinite(parse_number(text))
