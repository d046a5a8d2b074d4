"""Names of parameters in nested subcircuit calls mean what they mean in ngspice 39, or are refused."""

from __future__ import annotations

import random
import re
from pathlib import Path

import pytest

import fingerspice as fs
from fingerspice.netlist.deck import parse_deck
from ngspice_tools import call_ngspice

INNER = ".subckt inner a b\nR1 a b {w}\n.ends\n"
MID = ".subckt mid a b\nX1 a b inner\n.ends\n"
OUTER = ".subckt outer a b w=5\nX1 a b inner\n.ends\nX1 a 0 outer"
OWN = ".subckt outer a b\n.param w=5\nX1 a b inner\n.ends\nX1 a 0 outer"
CASES = {
    "the caller's default": f".param w=7\n{INNER}{OUTER}",
    "the caller's given value": f".param w=7\n{INNER}{OUTER} w=3",
    "the caller's .param": f".param w=7\n{INNER}{OWN}",
    "the caller's caller's": f".param w=7\n{INNER}{MID}{OUTER.replace('b inner', 'b mid')}",
    "nobody's but the caller's": f"{INNER}{OWN}",
    "the deck's from another call": f".param w=7\n{INNER}{OUTER.replace('0 outer', '0 inner')}",
    "a bare name": f".param w=7\n{INNER.replace('{w}', 'w')}{OUTER}",
    "a default": f".param w=7\n.subckt inner a b z={{w+1}}\nR1 a b {{z}}\n.ends\n{OUTER}",
    "a .param inside": f".param w=7\n.subckt inner a b\n.param z={{w}}\nR1 a b {{z}}\n.ends\n{OUTER}",
    "the deck's own formula": f".param w=7 z={{2*w}}\n{INNER.replace('{w}', '{z}')}{OUTER}",
    "a name handed on": (
        f".param w=7\n.subckt inner a b w=4\nR1 a b {{w}}\n.ends\n{OUTER.replace('b inner', 'b inner w={2*w}')}"
    ),
    "a definition inside, called from beside it": (
        f".param w=7\n.subckt outer a b w=5\n{INNER}{MID.replace('a b', 'a b w=9', 1)}X1 a b mid\n.ends\nX1 a 0 outer"
    ),
    "what two callers hand down": (
        ".subckt inner a b\n.param y={w*2}\nR1 a b {y}\n.ends\n.subckt outer a b\n.param w={q}\nX1 a b inner\n.ends\n"
        ".subckt top a b q=3\nX1 a b outer\n.ends\nX1 a 0 top"
    ),
}


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


@pytest.mark.parametrize("name", CASES)
def test_an_undefined_name_is_the_callers_as_in_ngspice(name: str, tmp_path: Path) -> None:
    assert ours(CASES[name]) == pytest.approx(theirs(CASES[name], tmp_path), rel=1e-6)


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
        except fs.InputError as error:
            refusals.append(str(error))
            continue
        assert value == pytest.approx(theirs(body, tmp_path), rel=1e-6), body
        agreed += 1
    assert agreed >= 25
    assert all(re.search("allowed: another name|in a circle", refusal) for refusal in refusals), refusals


@pytest.mark.parametrize(
    ("call", "said"),
    [
        ("R0 a 0 1\n.subckt s a b w=4 v=1\nR1 a b {v}\n.ends\nX1 a 0 s w=9 v={w}", "w = 7 .* s's own w = 9"),
        ("R0 a 0 1\n.subckt s a b w=4 v=1\nR1 a b {v}\n.ends\nX1 a 0 s v={w}", "w = 7 .* s's own w = 4"),
        ("X1 a 0 area SLAB d=4u eps_r=3 rho={d*1e15}", "d = 2e-06 .* SLAB's own d = 4e-06"),
    ],
)
def test_a_value_whose_name_ngspice_takes_inside_is_refused(call: str, said: str) -> None:
    with pytest.raises(fs.InputError, match=f"{said}; allowed: another name for one of them"):
        parse_deck(f"captured\n.param w=7 d=2u\n{call}\n.end\n")


def test_a_value_that_is_the_same_inside_is_taken(tmp_path: Path) -> None:
    body = ".param w=7\n.subckt s a b w=4 v=1\nR1 a b {v*w}\n.ends\nX1 a 0 s w={w} v={w+1}"
    assert ours(body) == theirs(body, tmp_path) == 56.0
