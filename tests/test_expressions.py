"""Numbers, arithmetic and engineering notation of netlists."""

import contextlib
import itertools
import math
import random
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fingerspice as fs
from deck_edits import evaluate
from fingerspice.base.errors import InputError, Where
from fingerspice.base.units import format_si, parse_number, suspicious_mega, unit_read_as_scale
from ngspice_tools import call_ngspice
from scenes import cases, listed

HERE = Where("deck.cir", 3, 10)
NAMES = {"thick": 2.0, "Rho": 3.0, "if": 5.0}


LONG = [("1" + 900 * "+1", 901.0)]


@pytest.mark.parametrize(("text", "value"), [*listed("arithmetic"), *listed("arithmetic_with_names"), *LONG])
def test_arithmetic_means_what_ngspice_means_with_names_conditions_and_nesting(text: str, value: float) -> None:
    assert evaluate(text, NAMES, HERE) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(("text", "column", "message"), [
    *listed("expressions"),
    ("-" * 4 + "1", 13, "signs in a row"),
    ("(" * 500, 35, "nested deeper"),
    ("1?" * 26 + "1" + ":1" * 26, 61, "more than 25 '.' in one expression"),
    ("1?2:1?2:1?2:1?2:(" * 25 + "1" + ")" * 25, 117, "more than 25 '.' in one expression"),
])  # fmt: skip
def test_what_is_not_arithmetic_is_refused_at_its_column(text: str, column: int, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        evaluate(text, NAMES, HERE)
    assert caught.value.where == Where("deck.cir", 3, column)


@pytest.mark.parametrize("name", ["dµ", "aª", "ﬁ", "x²", "aİ"])
def test_names_that_unicode_would_normalise_are_themselves(name: str) -> None:
    if name[0].isascii():
        assert evaluate(f"2*{name}", {name: 4.0}, HERE) == 8.0
    with pytest.raises(InputError, match=r"is not defined|does not belong"):
        evaluate(f"2*{name}", {"dμ": 1.0, "aa": 1.0, "fi": 1.0, "x2": 1.0}, HERE)


ENDLESS = ("(" * 100_000, "-" * 100_000, "1+" * 100_000, "x" * 100_000, "{" * 9)
PYTHON = ("__import__('os')", "x.y", "[1]", "lambda: 1", "1 if 1 else 2", "f'1'", "1;2", "1j", "a:=1", "not 1")


@pytest.mark.parametrize("text", [*ENDLESS, *PYTHON])
def test_expressions_of_any_size_and_python_are_refused(text: str) -> None:
    with pytest.raises(InputError):
        evaluate(text, NAMES, HERE)


@given(
    st.recursive(
        st.floats(0.1, 9.0).map(repr),
        lambda x: st.tuples(x, st.sampled_from("+-*/"), x).map(lambda t: f"({t[0]}{t[1]}{t[2]})"),
        max_leaves=8,
    )
)
def test_plain_arithmetic_agrees_with_python(text: str) -> None:
    try:
        expected = eval(text)  # of digits and operators only
    except ZeroDivisionError:
        return
    assert evaluate(text, {}, HERE) == expected


# ngspice 39 as the reference -------------------------------------------------------------------------------------

_PARAMETERS = {"x": 2.0, "y": -0.5, "meg": 3.0, "k": 7.0, "e": 1.25}
_CALLS = ["sqrt(abs({}))", "abs({})", "max({}, {})", "min({}, {})", "int({})", "nint({})", "sgn({})", "pow({}, 2)",
          "sqr({})", "floor({})", "ceil({})", "exp(min({}, 3))", "ln(abs({}) + 1)", "sin({})", "atan({})",
          "ternary_fcn({}, {}, {})"]  # fmt: skip


def expression(rng: random.Random, depth: int) -> str:
    """Random arithmetic of numbers, names, signs, operators, functions and conditions, in brackets or not."""
    kind = rng.random() if depth else 0.0
    if kind < 0.3:
        number = rng.choice(["2", "3", ".5", "1.5", "4k", "2meg", "3m", "5u", "1e3", "2e-3", "7kOhm", "2MEG", "1n"])
        return rng.choice([number, number, *_PARAMETERS, "X"])
    inner = [expression(rng, depth - 1) for _ in range(3)]
    if kind < 0.45:
        return f"({inner[0]})"
    if kind < 0.55:
        return f"-{inner[0]}"
    if kind < 0.65:
        return rng.choice(_CALLS).format(*inner)
    if kind < 0.7:
        return f"{inner[0]} > {inner[1]} ? {inner[2]} : {inner[0]}"
    blank = rng.choice(["", " "])
    operator = rng.choice("+-*/^+-*/<>") if kind < 0.95 else rng.choice(["&&", "||", "==", "!=", ">=", "<=", "**"])
    return f"{inner[0]}{blank}{operator}{blank}{inner[1]}"


def deck_of_sources(forms: list[str], *others: str) -> str:
    """A deck with the parameters, these sources and a load of 1 ohm at the node `n<i>` of each."""
    given = [f".param {name}={value!r}" for name, value in _PARAMETERS.items()]
    return "\n".join(["grid", *others, *given, *forms, *(f"R{i} n{i} 0 1" for i in range(len(forms)))])


def differing(folder: Path, forms: list[str], *others: str) -> list[tuple[str, float, float]]:
    """The sources that have another voltage in ngspice, with ours and theirs (V); those refused here are left out."""

    read = []
    for form in forms:
        with contextlib.suppress(InputError):
            fs.parse_netlist(deck_of_sources([form.format(i=0)], *others))
            read.append(form)
    assert len(read) > 40
    deck = deck_of_sources([form.format(i=i) for i, form in enumerate(read)], *others)
    ours = [e.waveform.level for e in fs.parse_netlist(deck).by_device("V")]
    printed = [f"print v(n{i})" for i in range(len(read))]
    block = [".control", "op", "set numdgt=15", *printed, "quit 0", ".endc", ".end\n"]
    (folder / "deck.cir").write_text("\n".join([deck, *block]))
    said = call_ngspice(folder, "deck.cir").stdout
    theirs = dict(re.findall(r"^v\(n(\d+)\) = (\S+)", said, re.MULTILINE))
    assert len(theirs) == len(read), said[-2000:]
    pairs = [(form, here, float(theirs[str(i)])) for i, (form, here) in enumerate(zip(read, ours, strict=True))]
    return [pair for pair in pairs if not math.isclose(*pair[1:], rel_tol=1e-9) and abs(pair[1]) > 1e-250]


@pytest.mark.parametrize("seed", range(3))
def test_random_arithmetic_has_ngspices_value_or_is_refused(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    assert differing(tmp_path, [f"V{{i}} n{{i}} 0 '{expression(rng, 3)}'" for _ in range(200)]) == []


_SCALES = ("", "t", "g", "meg", "k", "mil", "m", "u", "µ", "n", "p", "f", "a", "x", "q", "MEG", "MIL", "Meg", "M", "K")
_CELL = (".subckt cell a b w=1", "V1 a b {w}", ".ends")


@pytest.mark.parametrize("form", ["V{{i}} n{{i}} 0 {}", "V{{i}} n{{i}} 0 {{{{{}}}}}", "X{{i}} n{{i}} 0 cell w={}"])
def test_numbers_in_a_grid_of_spellings_have_ngspices_value_or_are_refused(form: str, tmp_path: Path) -> None:
    parts = itertools.product(("5", "2e-3", "-.5"), _SCALES, ("", "V", "Ohm", "Hz", "s"))
    forms = [form.format("".join(part)) for part in parts]
    assert differing(tmp_path, forms, *(_CELL if "cell" in form else ())) == []


@pytest.mark.parametrize("name", ["max", "sqrt", "limit", "Gauss"])
def test_a_parameter_named_like_a_function_is_refused_as_ngspice_does_not_read_it(name: str) -> None:
    with pytest.raises(InputError, match=f"parameter '{name}' has the name of a function of ngspice"):
        fs.parse_netlist(f"name\n.param {name}=3\nV1 a 0 {{{name}+1}}\nR1 a 0 1\n.tran 1 1")


def test_a_greek_mu_is_micro_with_a_warning_as_ngspice_ignores_it() -> None:
    with pytest.warns(fs.FingerspiceWarning, match=r"2:1: 5μ is 5u here and 5 in ngspice 39: write 5u"):
        circuit = fs.parse_netlist("mu\nC1 a 0 5μF\nV1 a 0 1\n.tran 1 1")
    assert circuit["C1"].values["value"] == 5e-6


def test_numbers_have_the_value_that_spice_gives_them_and_a_suffix_costs_no_rounding() -> None:
    assert [[text, parse_number(text)] for text, _ in listed("numbers")] == listed("numbers")
    assert parse_number("3.5u") == 3.5e-6
    assert [i for i in range(1000) if parse_number(f"{i}.1u") != float(f"{i}.1e-6")] == []


def test_what_is_no_number_or_read_differently_elsewhere_is_refused() -> None:
    for text, hint in [*listed("no_numbers"), (500 * "9", "characters")]:
        with pytest.raises(ValueError, match=hint):
            parse_number(text)


def test_a_capital_m_is_suspected_of_meaning_mega_and_a_unit_that_spice_takes_for_a_scale_is_recognised() -> None:
    assert [t for t in ("1M", "0.2MOhm", "1MΩ", "-3e2M") if not suspicious_mega(t)] == []
    assert [t for t in ("1m", "0.2meg", "1MEG", "1MIL", "0.2mohm", "M", "x") if suspicious_mega(t)] == []
    assert suspicious_mega("0.2MOhm") == "0.2meg"
    for text, unit, word, taken in (
        ("1F", "F", "farad", True), ("1farads", "F", "farad", True), ("0.5N", "N", "newton", True),
        ("1f", "F", "farad", False), ("1uF", "F", "farad", False),
    ):  # fmt: skip
        assert unit_read_as_scale(text, unit, word) is taken


def test_engineering_notation_which_without_a_unit_ends_in_the_prefix() -> None:
    assert [format_si(value, "m") for value, _ in listed("written")] == [text for _, text in listed("written")]
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
