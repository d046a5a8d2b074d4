"""Table 1's deck with one line changed, for tests that refer to its lines, and the value of one expression."""

from collections.abc import Mapping

from fingerspice.base.errors import Where
from fingerspice.netlist.expressions import evaluated

DECK = """\
Fingerpad
.include fingerspice.lib
Vdrive drive 0 SIN(0 200 100)
Xcoat drive top area LAYER d=1u eps_r=3.9 r=0.2meg
Xgap top skin area GAP d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000
Xskin skin 0 area SKIN d=350u f=100
.tran 10u 50m uic
.end
"""
"""Table 1; tests refer to its line numbers."""


def edited(*changes: tuple[str, str]) -> str:
    """`DECK` with texts replaced, each of which stands there once."""
    text = DECK
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def evaluate(text: str, names: Mapping[str, float], where: Where) -> float:
    """Value of an expression, whose names are matched without case; `where` is the place of its first character."""

    def place(position: int) -> Where:
        return Where(where.file, where.line, where.column + position)

    return evaluated(text, {name.lower(): value for name, value in names.items()}, place)
