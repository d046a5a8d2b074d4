"""The tables of docs/sets.md, made of the sets' files; ``python tests/sets_page.py`` writes them into the page."""

from pathlib import Path

import fingerspice as fs
from fingerspice.sets import quantity, references, tables

PAGE = Path(__file__).parents[1] / "docs" / "sets.md"


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def sets_table() -> str:
    """Every set: its name, kind, title, and what it does not claim."""
    head = _row("set", "kind", "what it is", "what it does not claim"), "|---|---|---|---|"
    sets = fs.parameters().values()
    return "\n".join([*head, *(_row(f"`{one.name}`", one.kind, one.title, one.not_claimed) for one in sets)])


def values_table() -> str:
    """The values that each set has of its own, after the sets that it includes."""
    rows = [_row("set", "value", "", "range", "source", "source of the range"), "|---|---|---|---|---|---|"]
    for name, one in fs.parameters().items():
        first = f"`{name}`"
        included = tables()[name].get("includes", ())
        if included:
            rows.append(_row(first, f"all of {' and '.join(f'`{x}`' for x in included)}, but", *[""] * 4))
            first = ""
        own = {f"{v['element']}.{v['parameter']}" for v in tables()[name]["values"]}
        for path, v in one.values.items():
            if path not in own:
                continue
            ends = dict.fromkeys((quantity(v.low, v.unit), quantity(v.high, v.unit)))
            rows.append(_row(first, f"`{path}`", quantity(v.value, v.unit), " to ".join(ends), v.source, v.range))
            first = ""
    return "\n".join(rows)


def references_list() -> str:
    """The works that the sets name."""
    used = {r.key for one in fs.parameters().values() for r in one.references}
    return "\n".join(f"- **{key}**: {one.text()}" for key, one in references().items() if key in used)


TABLES = {"sets": sets_table, "values": values_table, "references": references_list}


def filled(page: str) -> str:
    """The page with its tables made anew between their marks."""
    for name, make in TABLES.items():
        begin, end = f"<!-- {name}:begin -->\n", f"\n<!-- {name}:end -->"
        before, _, rest = page.partition(begin)
        assert end in rest, f"the page lacks the marks of the table {name}"
        page = f"{before}{begin}{make()}{end}{rest.partition(end)[2]}"
    return page


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
