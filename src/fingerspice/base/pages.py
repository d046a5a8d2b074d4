"""Reports as text for a terminal and as HTML for a notebook, both from one list of lines and tables."""

from __future__ import annotations

import html
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from fingerspice.base.errors import printable

#: Largest number of characters of a row's name in a table, and number of lines of a result that Python's prompt shows.
LONGEST_LABEL, SCREEN = 60, 40
_CELL = "padding: 0.1em 0.7em; white-space: nowrap;"


@dataclass(frozen=True)
class Table:
    """Rows of text under a head; the first `left` columns are words, and the others are figures."""

    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    left: int = 1

    def text(self) -> str:
        """The table as text: words aligned to the left, figures to the right."""
        table = [(printable(r[0], LONGEST_LABEL), *r[1:]) for r in (self.head, *self.rows)]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        sides = ["<"] * self.left + [">"] * (len(widths) - self.left)
        cells = [[f"{c:{side}{w}}" for c, side, w in zip(r, sides, widths, strict=True)] for r in table]
        lines = ["  ".join(row).rstrip() for row in cells]
        lines.insert(1, "-" * max(map(len, lines)))
        return "\n".join(lines)

    def html(self) -> str:
        """The table as HTML."""
        lines = ["<table>"]
        for number, row in enumerate((self.head, *self.rows)):
            kind = "td" if number else "th"
            cells = [
                f'<{kind} style="text-align: {"left" if place < self.left else "right"}; {_CELL}">'
                f"{html.escape(printable(cell, LONGEST_LABEL))}</{kind}>"
                for place, cell in enumerate(row)
            ]
            lines.append(f"<tr>{''.join(cells)}</tr>")
        return "\n".join([*lines, "</table>"])


class Page(str):
    """A text of blocks from top to bottom, and the same as HTML in `html`; empty lines around a table must be given."""

    __slots__ = ("blocks", "html")
    blocks: tuple[str | Table, ...]
    html: str

    def __new__(cls, blocks: Sequence[str | Table]) -> Page:
        page = super().__new__(cls, "\n".join(b.text() if isinstance(b, Table) else b for b in blocks))
        page.blocks = tuple(blocks)
        parts = ["<div>"]
        for block in blocks:
            if isinstance(block, Table):
                parts.append(block.html())
                continue
            # Text of several lines may be set in columns, which <pre> keeps.
            text = "\n".join(html.escape(printable(line)) for line in block.split("\n"))
            parts.append(f"<pre>{text}</pre>" if "\n" in text else f"<div>{text or '&nbsp;'}</div>")
        page.html = "\n".join([*parts, "</div>"])
        return page


class Shown:
    """A result that `print`, Python's prompt and notebooks show as its page."""

    def _page(self) -> Page:
        raise NotImplementedError

    def __str__(self) -> str:
        return "\n".join(printable(line) for line in self._page().split("\n"))

    def __repr__(self) -> str:
        lines = str(self).split("\n")
        if len(lines) > SCREEN:
            lines[SCREEN - 1 :] = [f"... and {len(lines) - SCREEN + 1} lines more: print() shows them"]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return self._page().html


def in_notebook() -> bool:
    """Whether this program runs in a notebook's kernel."""
    interactive = sys.modules.get("IPython")  # IPython is not a dependency: a notebook has imported it.
    shell = interactive.get_ipython() if interactive is not None else None
    return shell is not None and hasattr(shell, "kernel")
