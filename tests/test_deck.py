"""Conversion of netlist text to flat, evaluated statements."""

import random
import re
import subprocess
import sys
from pathlib import Path
from types import FrameType

import pytest

from fingerspice.base.errors import InputError, Where
from fingerspice.netlist import reader
from fingerspice.netlist.deck import parse_deck
from fingerspice.netlist.expressions import Call, Number, Token
from fingerspice.netlist.reader import Deck, Statement, text_of
from ngspice_tools import call_ngspice
from scenes import DECKS, listed, refuses


def deck(*lines: str) -> Deck:
    return parse_deck("\n".join(["title", *lines]))


def of_file(path: Path) -> Deck:
    return parse_deck(*text_of(path))


def only(*lines: str) -> Statement:
    (statement,) = deck(*lines).statements
    return statement


def refusal(*lines: str) -> InputError:
    with pytest.raises(InputError) as caught:
        deck(*lines)
    return caught.value


def value(item: object) -> float:
    assert isinstance(item, Number)
    return item.value


def test_places_are_physical_lines_and_columns_also_on_continuations() -> None:
    gap = parse_deck((DECKS / "continued.cir").read_text("utf-8")).statements[2]
    assert gap.where == Where("<netlist>", 5, 1)
    assert gap.params["m_exp"].key == Where("<netlist>", 6, 3)
    assert gap.params["c2"].where == Where("<netlist>", 6, 36)
    error = refusal("R1 a 0 {2", "* between", "", "  + +thik}", ".param thick=1")
    assert error.where == Where("<netlist>", 5, 6)
    assert "did you mean 'thick'" in error.message


def test_comments_of_every_kind_are_dropped() -> None:
    read = deck("* R0 a 0 1", "R1 a 0 1 ; R", "R2 a 0 2 $ R", "   * R", 'V1 a 0 TABLE("a;b $ c.csv" 0 1);x', "", "$ x")
    assert [s.name for s in read.statements] == ["R1", "R2", "V1"]
    (call,) = read.statements[2].body
    assert isinstance(call, Call)
    assert call.args[0] == Token("a;b $ c.csv", Where("<netlist>", 6, 14))
    assert "needs a blank" in refusal("R1 a 0 1 $comment").message


def test_line_ends_of_every_system_count_alike() -> None:
    for end in ("\n", "\r\n", "\r"):
        assert parse_deck(end.join(["\ufefft", "R1 a 0 1", "R2 b 0 2"])).statements[1].where.line == 3


def test_brackets_and_commas_are_separators_and_calls_are_kept() -> None:
    for text in ("V1 a 0 SIN(0 200 {f})", "V1 (a 0) SIN ( 0, 200, 'f' )"):
        (call,) = only(text, ".param f=100").body
        assert isinstance(call, Call)
        assert (call.text, [value(a) for a in call.args]) == ("SIN", [0.0, 200.0, 100.0])
    bare = only("V1 a 0 SIN 0 200 100").body
    assert isinstance(bare[0], Token)
    assert [value(x) for x in bare[1:]] == [0.0, 200.0, 100.0]
    mixed = only("V1 a 0 DC 1 PULSE(0 1) AC 1 0").body
    assert [type(x) for x in mixed] == [Token, Number, Call, Token, Number, Number]


def test_calls_hold_their_own_parameters() -> None:
    (call,) = only("V1 a 0 PWL(0 0 1m 1 R=0 file=x.csv)").body
    assert isinstance(call, Call)
    assert value(call.params["r"]) == 0.0
    assert call.params["file"] == Token("x.csv", Where("<netlist>", 2, 30), key=Where("<netlist>", 2, 25))
    assert call.params["r"].key == Where("<netlist>", 2, 21)


def test_numbers_keep_what_was_written() -> None:
    statement = only("X1 a b c LAYER d = 'x * 2' r=INF eps_r={x}", ".param x=1u")
    assert statement.params["d"] == Number(2e-6, "'x * 2'", Where("<netlist>", 2, 20), key=Where("<netlist>", 2, 16))
    assert statement.params["r"] == Token("INF", Where("<netlist>", 2, 30), key=Where("<netlist>", 2, 28))


def test_a_capital_m_is_remembered_through_parameters_and_subcircuits() -> None:
    call = (".subckt s a r=1", "R1 a 0 {r}", ".ends", "X1 a s r=r1")
    first, second = deck(".param r1={2*r0} r0=0.2MOhm", *call, "R2 a 0 {r1 + 1meg}").statements
    for statement in (first, second):
        (number,) = statement.body
        assert isinstance(number, Number)
        assert number.mega == Token("0.2MOhm", Where("<netlist>", 2, 21))
    assert only("R1 a 0 1M").body[0].mega.text == "1M"  # type: ignore[union-attr]
    assert only("R1 a 0 1meg").body[0].mega is None  # type: ignore[union-attr]


def test_parameters_may_come_in_any_order_and_with_blanks() -> None:
    read = deck("R1 a 0 {c}", ".param c = a + b * 2, B = {a^2}", ".PARAM A = 3 d=(a>2) ? 1 : 0")
    assert read.params == {"c": 21.0, "b": 9.0, "a": 3.0, "d": 1.0}
    assert value(read.statements[0].body[0]) == 21.0


def test_what_ngspice_takes_without_braces_is_taken() -> None:
    read = deck(".param w=2", "R1 a 0 w", "C1 a 0 1u ic=w", "X1 a b c LAYER d=w eps_r=2*w+1 r=w1")
    assert value(read.statements[0].body[0]) == 2.0
    assert value(read.statements[1].params["ic"]) == 2.0
    assert [value(read.statements[2].params[key]) for key in ("d", "eps_r")] == [2.0, 5.0]
    assert isinstance(read.statements[2].params["r"], Token)
    assert refusal(".param w=2", "R1 a 0 2*w").message == "arithmetic goes in braces: {2*w}"


def test_subcircuits_are_flattened_with_their_parameters_and_nodes() -> None:
    read = deck(
        ".param d=9u",
        "Xf drive gnd area finger params: d={d/3}",
        ".subckt finger p n area d=1u w={d*2}",
        "Xl P mid area LAYER d={d} r={q}",
        "Rm mid n {w}",
        "Xi mid inner",
        ".param q=w*2",
        ".subckt inner x",
        "R1 x deep {q}",
        "R2 deep 0 1",
        ".ic v(deep)=2 v(x)=1",
        ".ends inner",
        ".ends",
        ".ic v(xf.mid)=1",
    )
    assert [s.name for s in read.statements] == ["Xf.Xl", "Xf.Rm", "Xf.Xi.R1", "Xf.Xi.R2"]
    layer, middle, first, second = read.statements
    assert layer.nodes == ("drive", "xf.mid", "area")
    assert layer.node_names == ("drive", "Xf.mid", "area")
    assert middle.nodes == ("xf.mid", "0")
    assert first.nodes == ("xf.mid", "xf.xi.deep")
    assert second.nodes == ("xf.xi.deep", "0")
    assert value(layer.params["d"]) == pytest.approx(3e-6)
    assert value(middle.body[0]) == pytest.approx(6e-6)
    assert value(first.body[0]) == pytest.approx(12e-6)
    assert [[*one.params] for one in read.directives[".ic"]] == [["v(xf.xi.deep)", "v(xf.mid)"], ["v(xf.mid)"]]


def test_a_native_device_wins_over_a_definition_of_its_name() -> None:
    read = deck(".subckt GAP p n area", "B1 p n I='V(p)", ".model x", ".ends", "X1 a b c gap d=1u")
    assert read.statements[0].device == "GAP"
    assert "its .subckt is not read" in read.warnings[0]


def test_directives_without_effect_are_listed_once() -> None:
    read = deck(".print tran v(a", ".print 'x", ".control", "run 'it {", ".end", ".endc", ".title x", ".plot")
    assert list(read.unused) == [".control", ".title", ".plot"]


def test_a_title_that_reads_like_a_statement_is_warned_about() -> None:
    for title in ("R1 a 0 5", "V1 a 0 SIN(0 1 2)", "V1 a 0 triangle(1 2)", "Xg a b area GAP d=1u", ".tran 1u 1m"):
        assert "reads like a statement" in parse_deck(f"{title}\nR9 a 0 1\n").warnings[0]
    for title in ("Resistive coating in air", "Xray of the skin", "* a comment", "..."):
        assert parse_deck(f"{title}\nR9 a 0 1\n").warnings == []


def test_text_after_the_end_and_uncalled_subcircuits_are_warned_about() -> None:
    read = deck(".subckt s a", "Q1 a", ".ends", ".end", "* comment", "Q1")
    assert read.warnings == [
        "<netlist>:7:1: text after .end is not read",
        "<netlist>:2:1: subcircuit 's' is never called, and its body was not read",
    ]


@pytest.mark.parametrize(("text", "message"), listed("lines"))
def test_what_is_wrong_is_refused_with_its_place(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        parse_deck(f"title\n{text}\n")
    assert caught.value.where is not None
    assert caught.value.where.line >= 2


def test_work_grows_with_the_deck_and_not_faster() -> None:
    def calls(count: int, name: str) -> int:
        line = "R{i} n{i} n{j} {{{name}{i}}}\n.param {name}{i}={{{name}{j}+1}}\n"
        text = "".join(line.format(i=i, j=i + 1, name=name) for i in range(count))
        folder, made = str(Path(reader.__file__).parent), 0

        def count_one(frame: FrameType, event: str, _argument: object) -> None:
            nonlocal made
            made += event in ("call", "c_call") and frame.f_code.co_filename.startswith(folder)

        sys.setprofile(count_one)
        try:
            parse_deck(f"t\n{text}.param {name}{count}=1\n")
        finally:
            sys.setprofile(None)
        return made

    # Calls made by the reader are counted, not seconds: the same on every machine and beside any other process.
    # The names differ, as compiled expressions are kept by their text.
    assert calls(1500, "long") < 3.05 * calls(500, "short")


def theirs(body: str, folder: Path) -> float:
    """The resistance between a and 0 that ngspice finds, ohm."""
    text = f"a resistance\n{body}\nI1 0 a DC 1\n.op\n.control\nrun\nset numdgt=12\nprint v(a)\nquit 0\n.endc\n.end\n"
    (folder / "deck.cir").write_text(text)
    done = call_ngspice(folder, "deck.cir", timeout=20.0)
    found = re.search(r"v\(a\) = (\S+)", done.stdout)
    assert found, done.stdout + done.stderr
    return float(found[1])


def ours(body: str) -> float:
    """The same for a single resistor, as we read it."""
    (resistor,) = parse_deck(f"a resistance\n{body}\n.end\n").statements
    (value,) = resistor.body
    return float(value.value)  # type: ignore[union-attr]


@pytest.mark.parametrize(("name", "body"), listed("callers"), ids=[name for name, _ in listed("callers")])
def test_an_undefined_name_is_the_callers_as_in_ngspice(name: str, body: str, tmp_path: Path) -> None:
    assert ours(body) == pytest.approx(theirs(body, tmp_path), rel=1e-6)


def nest(rng: random.Random) -> str:
    """Five subcircuits, each calling the next; names of parameters from so few that they clash."""
    depth, names = 5, "wxyz"
    lines = [".param " + " ".join(f"{n}={rng.randint(2, 99)}" for n in names)]
    defaults = [rng.sample(names, rng.randint(0, 2)) for _ in range(depth)]
    for i in range(depth):
        own = " ".join(f"{n}={rng.randint(2, 99)}" for n in defaults[i])
        lines.append(f".subckt s{i} a b {own}")
        free = [n for n in names if n not in defaults[i]]
        if rng.random() < 0.5:
            lines.append(f".param {free[0]}={{{rng.choice([n for n in names if n != free[0]])}+1}}")
        if i == depth - 1:
            lines.append(f"R1 a b {{{'+'.join(rng.sample(names, 2))}}}")
        else:
            given = rng.sample(defaults[i + 1], rng.randint(0, len(defaults[i + 1])))
            lines.append(f"X1 a b s{i + 1} " + " ".join(f"{n}={{{rng.choice(names)}*2}}" for n in given))
        lines.append(".ends")
    return "\n".join([*lines, "X1 a 0 s0"])


def test_fifty_random_nests_are_what_ngspice_takes_or_refused(tmp_path: Path) -> None:
    rng = random.Random(11)
    agreed, refusals = 0, []
    for _ in range(50):
        body = nest(rng)
        try:
            value = ours(body)
        except InputError as error:
            refusals.append(str(error))
            continue
        assert value == pytest.approx(theirs(body, tmp_path), rel=1e-6), body
        agreed += 1
    assert agreed >= 25
    assert all(re.search("allowed: another name|in a circle", refusal) for refusal in refusals), refusals


@pytest.mark.parametrize(("call", "said"), listed("captured"))
def test_a_value_whose_name_ngspice_takes_inside_is_refused(call: str, said: str) -> None:
    refuses(f"{said}; allowed: another name for one of them", parse_deck, f"captured\n.param w=7 d=2u\n{call}\n.end\n")


def test_a_value_that_is_the_same_inside_is_taken(tmp_path: Path) -> None:
    body = ".param w=7\n.subckt s a b w=4 v=1\nR1 a b {v*w}\n.ends\nX1 a 0 s w={w} v={w+1}"
    assert ours(body) == theirs(body, tmp_path) == 56.0


@pytest.mark.parametrize(("body", "expected"), listed("functions_with_values"))
def test_functions_have_the_values_of_ngspice(tmp_path: Path, body: str, expected: float) -> None:
    assert ours(body) == expected
    # ngspice 39 takes parameters in the order of their lines.
    if "late" not in body:
        assert theirs(body, tmp_path) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("lines", "message", "place"), listed("functions"))
def test_functions_and_shared_nodes_that_mean_nothing_are_refused(
    lines: tuple[str, ...], message: str, place: tuple[int, int]
) -> None:
    error = refusal(*lines)
    assert message in error.message
    assert error.where == Where("<netlist>", *place)


def test_functions_of_functions_cannot_take_for_ever() -> None:
    lines = [f".func f{i}(x) {{f{i - 1}(x) + f{i - 1}(x)}}" for i in range(1, 30)]
    assert "makes 1,023, 10 deep; allowed: 1,000, 25 deep" in refusal(".func f0(x) {x}", *lines).message
    lines = [f".func f{i}(x) {{f{i - 1}(x)}}" for i in range(1, 30)]
    assert "makes 26, 26 deep; allowed: 1,000, 25 deep" in refusal(".func f0(x) {x}", *lines).message


def test_a_shared_node_is_the_same_in_every_subcircuit(tmp_path: Path) -> None:
    lines = (
        ".global Vcc",
        ".subckt inner o",
        "R2 vcc o 2",
        ".ends",
        ".subckt cell o",
        "X2 o inner",
        ".ends",
        "X1 a cell",
    )
    assert only(*lines).nodes == ("vcc", "a")
    # A port of that name is the caller's node.
    assert only(".global vcc", ".subckt cell vcc", "R2 vcc 0 2", ".ends", "X1 a cell").nodes == ("a", "0")
    body = "\n".join((".global a", ".subckt cell o", "R2 a o 2", ".ends", "X1 0 cell"))
    assert theirs(body, tmp_path) == 2.0


def test_a_section_of_a_library_is_read_alone(tmp_path: Path) -> None:
    path = tmp_path / "main.cir"
    (tmp_path / "p.lib").write_text(
        ".lib fast\n.param r=5\n.endl\n.LIB Slow\n.param r=7\n.endl slow\n.lib open\nR9 a 0 1\n"
    )
    path.write_text("t\n.lib p.lib fast\nR1 a 0 {r}\n")
    refuses(r"section 'open' of the library has no \.endl", of_file, path)
    (tmp_path / "p.lib").write_text("* two\n.lib fast\n.param r=5\n.endl\n.LIB Slow\n.param r=7\n.endl slow\n")
    for section, expected in (("fast", 5.0), ("SLOW", 7.0)):
        path.write_text(f"t\n.lib 'p.lib' {section}\nR1 a 0 {{r}}\n")
        assert value(of_file(path).statements[0].body[0]) == expected
        assert theirs(f".lib 'p.lib' {section}\nR1 a 0 {{r}}", tmp_path) == expected
    for line, said in (
        (".lib p.lib slo", "the library has no section 'slo'; did you mean 'slow'?"),
        (".lib p.lib xyz", "the library has no section 'xyz'; its sections are fast, slow"),
        (".lib p.lib", "'fast' begins a section of a library; allowed: .lib FILE SECTION, which reads one"),
    ):
        path.write_text(f"t\n{line}\nR1 a 0 1\n")
        refuses(re.escape(said), of_file, path)


def test_local_files_are_included_and_named_in_places(tmp_path: Path) -> None:
    path = tmp_path / "main.cir"
    path.write_text("t\n.inc 'my parts.lib'\nR1 a 0 {r}\n")
    (tmp_path / "my parts.lib").write_text(".param r=5\n.lib FingerSpice_mobile.LIB\n")
    read = of_file(path)
    assert value(read.statements[0].body[0]) == 5.0
    assert read.files == [tmp_path.resolve() / "my parts.lib"]
    assert read.libraries == ["FingerSpice_mobile.LIB"]
    assert read.path == path
    (tmp_path / "my parts.lib").write_text("\n\nR1 a 0 2k7\n")
    with pytest.raises(InputError, match=r"write 2\.7k") as caught:
        of_file(path)
    assert caught.value.where == Where(str(tmp_path / "my parts.lib"), 3, 8)


@pytest.mark.parametrize(("name", "message"), [*listed("other_files"), ("x" * 5000, "cannot be read|not a usable")])
def test_other_files_are_refused_by_name(tmp_path: Path, name: str, message: str) -> None:
    folder = tmp_path / "deck"
    (folder / "sub").mkdir(parents=True)
    for file in ("../secret.lib", "part.lib", "sub/inner.lib"):
        (folder / file).write_text("R1 a 0 1\n")
    (folder / "link.lib").symlink_to(tmp_path / "secret.lib")
    (folder / "loop.lib").write_text(".include loop.lib\n")
    (folder / "end.lib").write_text(".end\n")
    (folder / "main.cir").write_text(f"t\n.include {name}\n")
    with pytest.raises(InputError, match=message) as caught:
        of_file(folder / "main.cir")
    assert caught.value.where is not None


def test_no_name_from_outside_the_folder_is_proposed_for_a_missing_file(tmp_path: Path) -> None:
    (tmp_path / "secret.lib").write_text("R1 a 0 1\n")
    with pytest.raises(InputError) as caught:
        parse_deck("t\n.include secret.lob\n", tmp_path / "gone" / "main.cir")
    assert "secret.lob' does not exist" in str(caught.value)
    assert "secret.lib" not in str(caught.value)


@pytest.mark.parametrize(("data", "message"), [
    (b"", "is empty"), (b" \n\n", "is empty"), (b"t\nR1 a 0 1\0", "NUL"),
    ("t\nR1 a 0 1\n".encode("utf-16-le"), "not a text file"),
    (b"t\nC1 a 0 1\x81\n", "neither UTF-8 nor Latin-1 text .byte 0x81 in line 2"),
])  # fmt: skip
def test_files_that_are_no_netlists_are_refused(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "main.cir"
    path.write_bytes(data)
    refuses(message, of_file, path)


def test_missing_files_folders_and_huge_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "finger.cir").write_text("t\n")
    refuses(r"does not exist; did you mean '.*/finger\.cir'\?$", of_file, tmp_path / "fingr.cir")
    refuses("is a folder", of_file, tmp_path)
    with (tmp_path / "huge.cir").open("wb") as huge:
        huge.truncate(2**27)
    refuses("has 128 MiB; allowed: at most 64 MiB", of_file, tmp_path / "huge.cir")


def test_reading_a_deck_imports_nothing_heavy() -> None:
    code = "import sys; import fingerspice.netlist.deck; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert not {"numba", "scipy", "torch", "matplotlib", "xarray"} & set(loaded.split())
