"""The value of one expression of a netlist."""

from __future__ import annotations

from collections.abc import Mapping

from fingerspice.base.errors import Where
from fingerspice.netlist.expressions import compile_expression


def evaluate(text: str, names: Mapping[str, float], where: Where) -> float:
    """Value of an expression, whose names are matched without case; `where` is the place of its first character."""

    def place(position: int) -> Where:
        return Where(where.file, where.line, where.column + position)

    return compile_expression(text, place).evaluate({name.lower(): value for name, value in names.items()}, place)
