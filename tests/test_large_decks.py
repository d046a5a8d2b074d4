"""Very large decks are read in time proportional to their length, or refused by the limit that they exceed.

Nothing is timed: at these sizes an algorithm of quadratic cost would not finish.
"""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

import fingerspice as fs
import fuzz
from deck_edits import evaluate
from fingerspice.base.errors import LONGEST_MESSAGE, FingerspiceWarning, InputError, Where
from fingerspice.circuit import statespace
from fingerspice.netlist import reader
from fingerspice.netlist.deck import LONGEST_TITLE, MAX_DEPTH, parse_deck
from fingerspice.netlist.expressions import Number
from fingerspice.netlist.lexer import nearest
from scenes import cases, refuses

MANY = cases(20_000, 8_000)


def lines(of: Callable[[int], str], count: int = MANY) -> str:
    return "".join(f"{of(i)}\n" for i in range(count))


def refusal(text: str) -> str:
    with pytest.raises(InputError) as caught:
        fs.parse_netlist(f"t\n{text}", "deck.cir")
    return caught.value.message


def test_a_million_comments_are_skipped() -> None:
    assert len(parse_deck("t\n" + "* a comment\n" * 1_000_000 + "R1 a 0 1\n").statements) == 1


def test_a_line_of_many_continuations_keeps_the_place_of_each() -> None:
    read = parse_deck("t\nV1 a 0 PWL(0 0\n" + lines(lambda i: f"+ {i + 1} 1") + "+)\n")
    (call,) = read.statements[0].body
    assert len(call.args) == 2 * MANY + 2
    assert call.args[-1].where == Where("<netlist>", MANY + 2, len(f"+ {MANY} ") + 1)


@pytest.mark.parametrize(
    "text",
    [
        lines(lambda i: f".param p{i}={i}"),
        ".param " + " ".join(f"p{i}={{{i}}}" for i in range(MANY)),
        lines(lambda i: f".param p{i}={{p{i + 1} - 1}}") + f".param p{MANY}={MANY}\n",
        lines(lambda i: f".param p{MANY - i}={{p{MANY - i - 1} + 1}}") + ".param p0=0\n",
        lines(lambda i: f".param p{i}={{1 ? {i} : nothing{i}}}"),
    ],
    ids=["lines", "one line", "chain", "chain the other way", "names never looked up"],
)
def test_many_parameters_are_evaluated_each_once(text: str) -> None:
    read = parse_deck(f"t\n{text}")
    assert len(read.params) in (MANY, MANY + 1)
    assert abs(read.params[f"p{MANY - 1}"] - MANY) <= 1


def test_many_ports_nodes_and_definitions_are_read() -> None:
    ports = " ".join(f"n{i}" for i in range(MANY))
    read = parse_deck(f"t\n.subckt s {ports}\nR1 n0 n{MANY - 1} 1\n.ends\nX1 {ports} s\n")
    assert read.statements[0].nodes == ("n0", f"n{MANY - 1}")
    read = parse_deck("t\n" + lines(lambda i: f".subckt s{i} a\nR1 a 0 {i + 1}\n.ends\nX{i} a s{i}", MANY // 5))
    assert len(read.statements) == MANY // 5


# Of a text its beginning, what is repeated, how often, and its end; the suite takes some at a tenth of the limit.
WORDS = "more than {:,} words and brackets"
TOO_MANY = {
    "words": ("V1 a 0 PWL(", "1 ", 1_000_000, ")", f"{WORDS}; allowed: no more, samples go in by Python"),
    "brackets": ("V1 a 0 ", "(", 1_000_000, "", WORDS),
    "braces": ("V1 a 0 ", "{", 1_000_000, "", WORDS),
    "quotes": ("V1 a 0 ", "'", 1_000_000, "", WORDS),
    "elements": ("", "R1 a 0 1\n", 260_000, "", WORDS),
    "continuations": ("R1 a 0 1\n", "+\n", 1_000_000, "", WORDS),
    "lines": ("", "\n", 2_000_000, "", "the netlist has 2,000,002 lines; allowed: 2,000,000, included files counted"),
    "lines of old": ("", "\r", 2_000_000, "", "the netlist has 2,000,002 lines"),
}


@pytest.mark.parametrize("name", TOO_MANY)
def test_more_words_and_lines_than_a_netlist_may_hold_are_refused_before_they_are_kept(name, monkeypatch):
    head, part, count, tail, said = TOO_MANY[name]
    smaller = cases(1, 1 if name == "words" or "lines" in name else 10)
    monkeypatch.setattr(reader, "MAX_WORDS", reader.MAX_WORDS // smaller)
    monkeypatch.setattr(fuzz, "ROOM", 512)
    text = head + part * (count // smaller) + tail
    with fuzz.little_room():
        assert said.format(reader.MAX_WORDS) in refusal(text)


def test_words_and_lines_of_included_files_count_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "part.lib").write_text("R1 a 0 1\n" * 10)
    (tmp_path / "deck.cir").write_text("t\nR2 a 0 1\n.include part.lib\n.end\n")
    monkeypatch.setattr(reader, "MAX_WORDS", 45)
    refuses(r"part.lib:10:1: the netlist has more than 45 words", fs.read_netlist, tmp_path / "deck.cir")
    monkeypatch.setattr(reader, "MAX_LINES", 12)
    refuses(r"deck.cir:3:10: the netlist has 16 lines; allowed: 12", fs.read_netlist, tmp_path / "deck.cir")


def test_a_title_is_shown_short_and_drives_no_terminal() -> None:
    title = "\x1b[31mred\x1b]0;owned\x07" + "x" * 100_000 + "\u202e"
    read = parse_deck(f"{title}\nR1 a 0 1\n")
    assert read.title.startswith("\\x1b[31mred\\x1b]0;owned\\x07xxx")
    assert read.title.endswith("xxx\\u202e")
    assert len(read.title) <= LONGEST_TITLE
    assert read.text.startswith(title)


def test_warnings_are_short_printable_and_no_flood() -> None:
    text = lines(lambda i: f".subckt s{i}\x1b[31m{'y' * 3000 if i == 0 else ''} a\n.ends", 1000)
    read = parse_deck(f"t\n{text}R1 a 0 1\n")
    assert len(read.warnings) == reader.MAX_WARNINGS + 1
    assert read.warnings[-1].endswith("more warnings than 100: the others are not shown")
    shown = [str(FingerspiceWarning(warning)) for warning in read.warnings]
    assert all(text.isprintable() and len(text) <= LONGEST_MESSAGE for text in shown)


def test_a_million_words_on_one_line_are_counted() -> None:
    assert refusal(f"V1 a 0 SIN {'1 ' * 200_000}").startswith("SIN takes at most 6 values, 200000 given")
    assert refusal(f"R1 a 0 {'x' * 1_000_000}").startswith("R1 value is 'xxx")


def test_brackets_of_any_depth_are_read_or_refused() -> None:
    (value,) = parse_deck(f"t\nR1 a 0 {'(' * 100_000}5{')' * 100_000}\n").statements[0].body
    assert isinstance(value, Number)
    assert "at most 2000 are allowed" in refusal(f"R1 a 0 {{{'(' * 100_000}5{')' * 100_000}}}")
    assert "at most 2000 are allowed" in refusal(f"R1 a 0 {'{' * 100_000}5{'}' * 100_000}")
    assert refusal(f"R1 a 0 {'(' * 100_000}") == "'(' is never closed"
    assert refusal(f".param x={'{' * 100_000}") == "{ is never closed"


def test_brackets_behind_numbers_are_refused_in_linear_time() -> None:
    # Each of them was once followed as far as a name may reach, two minutes in all.
    with pytest.raises(fs.InputError, match="'\\(' is never closed"):
        fs.parse_netlist(f"a deck\nV1 a 0 SIN(0 1 100)\nC1 a 0 1n\n.tran 1u 1m uic{'(1' * 100_000}\n")


def test_subcircuits_nested_in_each_other_are_read() -> None:
    read = parse_deck("t\n" + lines(lambda i: f".subckt s{i} a") + ".ends\n" * MANY + "R1 a 0 1\n")
    assert len(read.statements) == 1


def laughs(body: str, levels: int = 30) -> str:
    calls = lines(lambda i: f".subckt s{i} a\nX1 a s{i + 1}\nX2 a s{i + 1}\n.ends", levels)
    return f"{calls}.subckt s{levels} a\n{body}\n.ends\nX1 a s0\n"


def test_subcircuits_that_double_at_every_level_are_refused() -> None:
    assert refusal(laughs("R1 a 0 1")) == "the subcircuits expand to more than 100,000 lines"
    assert refusal(laughs(f"R1 a {' ' * 300_000} 0 1")) == "the subcircuits expand to more than 4 MiB of text"
    assert refusal(laughs(f".param {' '.join(f'p{i}=1' for i in range(1000))}")).endswith("100,000 lines")


def test_calls_of_calls_are_refused_by_depth() -> None:
    chain = lines(lambda i: f".subckt s{i} a\nX1 a s{i + 1}\n.ends")
    assert refusal(f"{chain}X1 a s0\n") == f"subcircuits call each other more than {MAX_DEPTH} deep"


def test_names_that_grow_with_every_call_are_refused() -> None:
    assert refusal(f"R{'x' * 1000} a 0 1") == "an element's name of 1001 characters: at most 400 are allowed"
    calls = lines(lambda i: f".subckt s{i} a\nX{'y' * 90} a s{i + 1}\n.ends", 10)
    assert "an element's name of 462 characters" in refusal(f"{calls}X1 a s0\n")


@pytest.mark.parametrize(
    "text",
    [
        lines(lambda i: f"R{i} n{i} n{i + 1} 1\nC{i} n{i + 1} 0 1u", MANY // 2),
        lines(lambda i: f"X{i} n{i} n{i + 1} area LAYER d=1u eps_r=1", MANY // 4),
        lines(lambda i: f"X{i} d 0 a{i} LAYER d=1u eps_r=1\nV{i} a{i} 0 1", MANY // 4),
    ],
    ids=["ladder", "stack", "areas"],
)
def test_circuits_too_large_for_dense_matrices_are_refused(text: str) -> None:
    said = refusal(f"Vd n0 0 1\n{text}")
    assert re.fullmatch(r"deck.cir: the circuit has [\d,]+ elements; allowed: at most 2,000", said)


def test_slabs_of_a_dispersive_skin_count_as_elements(monkeypatch: pytest.MonkeyPatch) -> None:
    deck = "Va area 0 35\nV1 d 0 1\nX1 d m area SKIN_DISPERSIVE d=1u\nX2 m 0 area LAYER d=1u eps_r=1\n"
    monkeypatch.setattr(statespace, "MAX_ELEMENTS", 9)
    assert len(fs.parse_netlist(f"t\n{deck}").elements) == 4
    monkeypatch.setattr(statespace, "MAX_ELEMENTS", 8)
    assert "9 elements, a SKIN_DISPERSIVE counted as its 6 slabs; allowed: at most 8" in refusal(deck)


def test_the_largest_circuits_find_conflicts_and_start_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statespace, "MAX_ELEMENTS", 10**9)
    star = lines(lambda i: f"V{i} n0 n{i + 1} 1", 5_000)
    assert refusal(f"{star}Vx n5000 n1 1\nR1 n5000 0 1\nR2 n1 0 1\n").startswith("node 'n2' is floating")
    ring = lines(lambda i: f"V{i} n0 n{i + 1} 1\nR{i} n{i + 1} 0 1", 5_000)
    assert refusal(f"{ring}Vx n5000 n1 1\n") == "Vx closes a loop of voltage sources with V0, V4999"
    start = lines(lambda i: f"R{i} n{i} 0 1\n.ic v(n{i})=1", 5_000)
    assert refusal(f"{start}.ic v(n1)=2\n") == ".ic gives node 'n1' twice"
    areas = lines(lambda i: f"X{i} d 0 a{i} LAYER d=1u eps_r=1\nV{i} a{i} 0 1", 4_000)
    assert refusal(f"{areas}V1x d 0 1\nV2x d 0 1\n") == "V1x and V2x are voltage sources in parallel"


def test_many_lines_with_start_values_are_read_in_linear_time() -> None:
    # Each line looked at all before it for a while.
    assert refusal(lines(lambda i: f".ic v(n{i})=1", 2 * MANY)).startswith(".ic names node 'n0', which")
    # A name that goes on through brackets ends where names do.
    assert "never closed" in refusal(f"X1 {'a(' * 10_000} gnd LAYER\n")


def test_the_nearest_spelling_is_looked_for_in_bounded_time() -> None:
    assert nearest("thik", ["thick", *map(str, range(10**6))]) == "; did you mean 'thick'?"
    assert nearest("x" * 10**6, ["x" * 10**6]) == nearest("a" * 50, ["a" * 10**6] * 1000) == ""
    refuses("'q' is not defined", parse_deck, "t\n" + lines(lambda i: f".param p{i}=1") + "R1 a 0 {q}\n")


def test_included_files_are_bounded_in_number_depth_and_size(tmp_path: Path) -> None:
    deck = tmp_path / "deck.cir"
    (tmp_path / "part.lib").write_text("* nothing\n")
    for i in range(40):
        (tmp_path / f"deep{i}.lib").write_text(f".include deep{i + 1}.lib\n")
        (tmp_path / f"wide{i}.lib").write_text(f".include wide{i + 1}.lib\n" * 2)
    (tmp_path / "wide40.lib").write_text("\n")
    limit = "too many included files: at most 1000, nested 32 deep"
    for text in (".include part.lib\n" * 1001, ".include deep0.lib\n", ".include wide12.lib\n"):
        deck.write_text(f"t\n{text}")
        refuses(limit, fs.read_netlist, deck)
    (tmp_path / "large.lib").write_text(("*" * 1000 + "\n") * 10_000)
    deck.write_text("t\n" + ".include large.lib\n" * 8)
    refuses("the included files are larger than 64 MiB in all", fs.read_netlist, deck)


def test_messages_are_short_and_printable_whatever_was_given() -> None:
    with pytest.raises(InputError) as caught:
        evaluate("\x1b[31m" + "x" * 10, {}, Where("deck.cir", 1))
    assert caught.value.message.startswith("'\\x1b' does not belong")
    said = refusal(f"R1 a 0 {'x' * 10**6}\u202e\n")
    assert len(said) < LONGEST_MESSAGE
    assert said.isprintable()
    assert said.endswith("allowed: a number ohm")
