"""Inputs for the fuzzer: mutated decks, arithmetic, sources and tables, each from its own random generator."""

import random
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from scenes import listed

CIRCUITS = Path(__file__).parents[1] / "circuits"

# Tables by subject, not one entry a line.
# fmt: off
# ruff: noqa: SIM905
NUMBERS = (
    *"0 1 -1 2.5 1e-6 3.5u 0.2meg 0.2M 1MOhm 1F 1N 2k7 1x 1a 1mil µ 1µ -0 -0.0".split(),
    *"1e308 -1e308 1e-308 4.9e-324 1e309 1e-400 1e999999999 1e150 1e-150 1e30 1e-30 1e3.5".split(),
    *"nan inf -inf none infinity 0x10 1_000 1e 1e+ --1 + . 1..2 1,5 ٣ １ 1K 1ſ ²".split(),
    "9" * 330, "0." + "0" * 330 + "1", "9" * 500, "1" * 20 + "u",
)
NAMES = (
    *("a", "drive", "top", "skin", "area", "0", "gnd", "GND", "n1", "x.y", "d", "eps_r", "r", "fn", "w", "pi",
      "e", "sqrt"),
    *("p0", "p1", "aª", "ﬁ", "dµ", "İ", "x²", "ß", "\u0301", "v_a", "if", "lambda", "__import__", "__class__", "self"),
    *("None", "True", "x" * 300, "A\u0300", "\u202e", "\x1b[31m", "\x0b", "\x85", "\u2028", "\ufeff", "\x00", "\ud800"),
)
MARKS = (*"(){}[]'\"=,;$+-*/^<>?:!&|.@#%~`\\_ \t\r\n", "**", "&&", "||", "==", "!=", "<=", "\r\n", "\n+",
      "\n*", " ;", " $ ")
TITLES = (
    *("\x1b[31mred\x1b[0m", "\x1b]0;owned\x07", "\x9b2J", "\r", "\x08" * 9, "\x1b[2J\x1b[H", "\u202egnp.exe"),
    *("$\\frac{$", "$x$", "漢字", "😀", "\U000e0041", "\ud800", "e\u0301\u0301", "a" * 5000, "\t", "\x00", "<b>", "%s"),
)
FUNCTIONS = (
    "sqrt exp ln log log10 sin tan acos atanh cosh floor int nint sgn abs min max pow pwr atan2 hypot ternary_fcn sqr "
    "eval open exec SIN sqrtt v i"
).split()
SOURCES = "SIN PULSE EXP PWL SQUARE AM SFFM WAVEFILE TABLE CHIRP BURST WAV DC AC SINE sin Pwl FOO".split()
FILES = (
    *("fingerspice.lib", "fingerspice_mobile.lib", "part.lib", "loop.lib", "ping.lib", "sub/inner.lib", "sub",
      "link.lib"),
    *("mutated.lib", "../outside.lib", "../../etc/passwd", "/etc/passwd", "sub/../../outside.lib",
      "C:\\x.lib", "~/x", "."),
    *("missing.lib", "'part.lib'", '"part.lib"', "'part.lib", "part.lib x", "sub\\inner.lib", "/dev/zero",
      "/dev/stdin"),
    *("pipe.lib", "x" * 300, "a/" * 200, "file:///etc/passwd", "http://a.example/b", "part.lib/../part.lib",
      "deck.cir"),
)
LINES = tuple(listed("fuzz_lines"))
DECKS = tuple(
    path.read_text(encoding="utf-8") for path in (*sorted(CIRCUITS.glob("*.cir")), *sorted(CIRCUITS.glob("*.lib")))
)
OWN = (
    "Network\nV1 in 0 PULSE(0 5 1m 1u 1u 2m 5m)\n.param r0=1k c0={r0*1p}\n.subckt cell p n r={r0}\n"
    "R1 p m {r}\nC1 m n {c0} ic=1\n.ends\nX1 in out cell r=2*r0\nX2 out 0 cell\nI1 out 0 SIN(0 1u 1k)\n"
    ".ic v(out)=1\n.tran 1u 10m\n.ac dec 10 1 1meg\n",
    "Layers\nVa area 0 35\nVd d 0 PWL(0 0 1m 10 r=0)\nX1 d m area SLAB d=1u eps_r=3 rho=1e9\n"
    "R1 m 0 1meg\n.include part.lib\n",
)
# fmt: on
_TOKEN = re.compile(r"\s+|[\w.]+|[^\w\s]")


def _number(rng: random.Random, odd: float = 0.3) -> str:
    kind = rng.random()
    if kind > 0.1 + odd:
        return f"{rng.choice(['', '', '-'])}{rng.randint(1, 999)}{rng.choice(['', '', 'u', 'n', 'k', 'm', 'meg', 'p'])}"
    if kind > odd:
        return f"{10.0 ** rng.uniform(-320, 308):.3g}"
    return rng.choice(NUMBERS)


def arithmetic(rng: random.Random, depth: int = 4) -> str:
    """Arithmetic, mostly right."""
    kind = rng.random()
    if depth == 0 or kind < 0.25:
        return _number(rng) if rng.random() < 0.7 else rng.choice(NAMES)
    inner = arithmetic(rng, depth - 1)
    if kind < 0.6:
        operator = rng.choice(["+", "-", "*", "/", "^", "**", "<", ">=", "==", "&&", "||", " ", ","])
        return f"{inner}{operator}{arithmetic(rng, depth - 1)}"
    if kind < 0.75:
        others = [arithmetic(rng, depth - 2) for _ in range(rng.choice([0, 0, 1, 2]))] if depth > 1 else []
        return f"{rng.choice(FUNCTIONS)}({','.join([inner, *others])})"
    if kind < 0.9:
        return f"({inner})"
    if kind < 0.95:
        return f"{inner}?{arithmetic(rng, depth - 1)}:{arithmetic(rng, depth - 1)}"
    return f"{rng.choice('+-')}{inner}"


def source(rng: random.Random) -> str:
    """A source's text, mostly right."""
    odd = rng.choice([0.0, 0.0, 0.3])
    values = [_number(rng, odd) for _ in range(rng.choice([0, 1, 2, 2, 3, 3, 4, 4, 5, 6, 7, 8, 40]))]
    if odd == 0.0:
        values = [x.lstrip("-") for x in values]
    if rng.random() < 0.3:
        values.append(f"{{{arithmetic(rng, 2)}}}")
    if rng.random() < 0.1:
        values.append(f"{rng.choice(['r', 'td', 'file', 'x'])}={_number(rng)}")
    if rng.random() < 0.1:
        values.append(rng.choice(FILES))
    inner = rng.choice([" ", ", "]).join(values)
    call = rng.choice(
        ["{}({})", "{}({})", "{}({})", "{} ({})", "{} {}", "{}({}", "DC 1 {}({})", "{}({}) AC 1 0", "{}({}) {}"]
    )
    name = rng.choice((*SOURCES, *SOURCES[:5] * 4))
    return call.format(name, inner, name)


def expression(rng: random.Random) -> str:
    """Arithmetic, right, damaged, or nested and repeated out of all measure."""
    kind = rng.random()
    text = arithmetic(rng, rng.randint(1, 6))
    if kind < 0.05:
        opening, closing = rng.choice(
            [("(", ")"), ("-", ""), ("1?", ":1"), ("abs(", ")"), ("1+", ""), ("(1?2:", ")"), ("max(1,", ")")]
        )
        count = rng.choice([5, 24, 25, 26, 100, 1000, 20_000])
        return f"{opening * count}{text}{closing * count}"
    return _damaged(text, rng) if kind < 0.6 else text


def source_text(rng: random.Random) -> str:
    """A source, an analysis or a number for the command line's options, as written or damaged."""
    text = rng.choice([source, source, source, lambda r: f"dec {_number(r)} {_number(r)} {_number(r)}", _number])(rng)
    return _damaged(text, rng) if rng.random() < 0.25 else text


def table(rng: random.Random) -> bytes:
    """A CSV file of frequency, resistivity and permittivity, as written or damaged."""
    rows = ["f,rho,eps"] if rng.random() < 0.5 else []
    separator = rng.choice([",", ",", ",", ",", ",", ",", ";", " , "])
    for i in range(rng.choice([0, 1, 2, 3, 3, 5, 5, 5, 20])):
        right = [f"{10 * 2.0**i:g}", f"{rng.uniform(1, 1e4):g}", f"{rng.uniform(1, 1e5):g}"]
        rows.append(separator.join(_number(rng) if rng.random() < 0.02 else x for x in right))
    text = "\n".join(rows)
    if rng.random() < 0.25:
        text = _damaged(text, rng)
    if rng.random() < 0.01:
        text += '\n"' + "1" * 140_000
    return _encoded(text, rng)


#: Characters from which on a text is edited no further.
LONGEST = 200_000


def netlist(rng: random.Random) -> str:
    """A shipped deck with some of its lines, tokens, numbers and brackets changed."""
    text = rng.choice((*DECKS, *OWN, *OWN))
    if rng.random() < 0.2:
        return _extreme(text, rng)
    for _ in range(rng.choice([0, 1, 1, 1, 2, 2, 3, 5, 12])):
        if len(text) > LONGEST:
            break
        lines = text.split("\n")
        text = "\n".join(rng.choice(_LINE_EDITS)(lines, rng)) if rng.random() < 0.5 else _damaged(text, rng)
    return text


def deck_file(rng: random.Random) -> bytes:
    """A netlist as a file may hold it: in any encoding, with any bytes."""
    return _encoded(netlist(rng), rng)


def _encoded(text: str, rng: random.Random) -> bytes:
    kind = rng.random()
    if kind < 0.05:
        return text.encode("utf-16", "surrogatepass")
    data = text.encode("utf-8", "surrogatepass")
    if kind < 0.1:
        return b"\xef\xbb\xbf" + data
    if kind < 0.2 and data:
        at = rng.randrange(len(data))
        return data[:at] + bytes(rng.randrange(256) for _ in range(rng.randint(1, 4))) + data[at:]
    return data.replace(b"\n", rng.choice([b"\r\n", b"\r"])) if kind < 0.25 else data


def _damaged(text: str, rng: random.Random) -> str:
    """Text with one piece replaced, dropped, doubled, moved or put in."""
    tokens = _TOKEN.findall(text) or [""]
    at = rng.randrange(len(tokens))
    kind = rng.randrange(9)
    if kind == 0:
        del tokens[at]
    elif kind == 1:
        other = rng.randrange(len(tokens))
        tokens[at], tokens[other] = tokens[other], tokens[at]
    elif kind == 2:
        tokens[at] = rng.choice(MARKS)
    elif kind == 3:
        tokens.insert(at, rng.choice((*MARKS, *NUMBERS, *NAMES)))
    elif kind == 4:
        tokens[at] *= rng.choice([2, 3, 50, 3000])
    elif kind == 5:
        stop = at + rng.randint(1, 30)
        tokens[at:stop] = []
    elif kind == 6:
        tokens[at] = chr(rng.choice([rng.randrange(0x80), rng.randrange(0x3000), rng.randrange(0x110000)]))
    else:
        numbers = [i for i, token in enumerate(tokens) if token[:1].isdigit()]
        tokens[rng.choice(numbers or [at])] = _number(rng) if kind == 7 else rng.choice(NAMES)
    return "".join(tokens)


def _extreme(text: str, rng: random.Random) -> str:
    """Text with one of its numbers far from what was meant."""
    found = [match.span() for match in re.finditer(r"(?<=[= (])[\d.]+[a-z]*", text)]
    if not found:
        return text
    start, stop = rng.choice(found)
    return f"{text[:start]}{10.0 ** rng.uniform(-40, 40) if rng.random() < 0.5 else rng.choice(NUMBERS)}{text[stop:]}"


def _line(rng: random.Random) -> str:
    fill: dict[str, Callable[[], str]] = {
        "n": lambda: _number(rng),
        "w": lambda: rng.choice(NAMES),
        "f": lambda: rng.choice(FILES),
        "s": lambda: source(rng),
        "x": lambda: arithmetic(rng, 3),
    }
    template = rng.choice(LINES).replace("{{", "\0").replace("}}", "\1")
    return re.sub(r"\{(\w)\}", lambda m: fill[m[1]](), template).replace("\0", "{").replace("\1", "}")


def _insert(lines: list[str], rng: random.Random) -> list[str]:
    at = rng.randint(0, len(lines))
    return [*lines[:at], _line(rng), *lines[at:]]


def _repeat(lines: list[str], rng: random.Random) -> list[str]:
    """One line left out, or given several times."""
    at = rng.randrange(len(lines))
    return [*lines[:at], *[lines[at]] * rng.choice([0, 0, 0, 2, 2, 3, 40]), *lines[at + 1 :]]


def _swap(lines: list[str], rng: random.Random) -> list[str]:
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[i], lines[j] = lines[j], lines[i]
    return lines


def _continue(lines: list[str], rng: random.Random) -> list[str]:
    at = rng.randrange(len(lines))
    words = lines[at].split(" ")
    cut = rng.randint(0, len(words))
    return [*lines[:at], " ".join(words[:cut]), "+ " + " ".join(words[cut:]), *lines[at + 1 :]]


def _chain(lines: list[str], rng: random.Random) -> list[str]:
    """Parameters that refer to each other, sometimes in a circle."""
    count = rng.choice([3, 30, 300])
    last = rng.choice(["1", "{q0}", "{zz}", "{1?2:zz}"])
    row = [f".param q{i}={{q{i + 1}+1}}" for i in range(count)]
    return [lines[0], *row, f".param q{count}={last}", "Rq drive 0 {q0}", *lines[1:]]


def _nest(lines: list[str], rng: random.Random) -> list[str]:
    """Subcircuits that call each other, sometimes themselves, one or two of the next each."""
    depth, calls = rng.choice([2, 5, 31, 33, 40]), rng.choice([1, 1, 2])
    body = []
    for i in range(depth if calls == 1 else min(depth, 6)):
        target = f"z{i + 1}" if rng.random() < 0.98 else f"z{rng.randint(0, i)}"
        body += [f".subckt z{i} a b", *(f"X{k} a b {target}" for k in range(calls)), ".ends"]
    return [lines[0], *body, f".subckt z{i + 1} a b", "R1 a b 1k", ".ends", "Xz drive 0 z0", *lines[1:]]


def _wrap(lines: list[str], rng: random.Random) -> list[str]:
    """Some of the lines as a subcircuit's body."""
    i, j = sorted((rng.randint(1, len(lines)), rng.randint(1, len(lines))))
    ends = rng.choice([[".ends"], [".ends wrapped"], []])
    return [*lines[:i], ".subckt wrapped drive top", *lines[i:j], *ends, "Xwrapped drive top wrapped", *lines[j:]]


def _splice(lines: list[str], rng: random.Random) -> list[str]:
    """The deck's beginning with the end of another."""
    other = rng.choice((*DECKS, *OWN)).split("\n")
    return lines[: rng.randint(1, len(lines))] + other[rng.randrange(len(other)) :]


def _title(lines: list[str], rng: random.Random) -> list[str]:
    """The deck under a title that would drive a terminal, flood it, or be drawn as a formula."""
    pieces = [rng.choice((*TITLES, *NAMES, *MARKS)) for _ in range(rng.randint(1, 5))]
    return ["".join(pieces).replace("\n", "") * rng.choice([1, 1, 1, 20]), *lines[1:]]


def _start(lines: list[str], rng: random.Random) -> list[str]:
    """Voltages to start from, at nodes that mostly exist, and on capacitors."""
    nodes = ("drive", "top", "skin", "area", "out", "in", "0", "gnd", "d", "m", rng.choice(NAMES))
    pairs = [f"v({rng.choice(nodes)})={rng.choice(['', '-'])}{_number(rng)}" for _ in range(rng.choice([1, 1, 2, 4]))]
    between = f"{rng.choice(nodes)} {rng.choice(nodes)}"
    extra = [f".ic {' '.join(pairs)}", f"Cstart {between} 1n ic={_number(rng)}", f"Rstart {between} {_number(rng)}"]
    return [*lines[:1], *rng.sample(extra, rng.randint(1, 3)), *lines[1:]]


def _vast(lines: list[str], rng: random.Random) -> list[str]:
    """One line, or one word of it, out of all measure; seldom, for it takes a second."""
    if rng.random() > 0.01:
        return _insert(lines, rng)
    at = rng.randrange(len(lines))
    piece = rng.choice((*MARKS, *NAMES, " 1", " 1u 2", "(1", "+\n", "R1 a 0 1\n", f"{lines[at]}\n", ".param a=1\n"))
    return [*lines[:at], lines[at] + piece * (int(10.0 ** rng.uniform(3.0, 6.2)) // len(piece)), *lines[at + 1 :]]


_LINE_EDITS: Sequence[Callable[[list[str], random.Random], list[str]]] = (
    *(_insert, _insert, _insert, _repeat, _repeat, _swap, _continue, _chain, _nest, _wrap, _splice),
    *(_title, _start, _start, _vast),
)
