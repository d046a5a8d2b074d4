"""Model against experiment: every row within its bounds, and the pages are what their rows say."""

import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.append(str(Path(__file__).parents[1] / "docs"))
import evidence

ROWS = list(enumerate(evidence.ROWS, 1))


@pytest.mark.parametrize(("n", "row"), ROWS, ids=[f"{n}: {row.source}, {row.quantity}" for n, row in ROWS])
def test_every_number_of_a_row_is_within_its_bounds(n: int, row: Any) -> None:
    for number, (low, high) in zip(evidence.numbers(n), row.bounds, strict=True):
        assert low <= number <= high
    assert row.kind in evidence.VERDICTS


@pytest.mark.parametrize("n", [1, 2, 5, 6, 7, 9, 15, 18, 23])
def test_another_finger_is_outside_the_bounds(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # With more voltage, or across a thinner gap, row 23's gap would close, which is no number.
    other = {"Xgap.c2": 2000.0} | ({} if n == 23 else {"Xgap.r": 3e6, "Xgap.d": 2e-6})
    monkeypatch.setattr(evidence, "FINGER", evidence.FINGER.replace(other))
    row = evidence.ROWS[n - 1]
    assert any(not low <= number <= high for number, (low, high) in zip(row.make(), row.bounds, strict=True))


def test_the_pages_are_what_their_rows_say() -> None:
    assert len(evidence.ROWS) >= 24
    pages = [path.read_text(encoding="utf-8") for path in evidence.PAGES]
    for page in pages:
        assert page == evidence.filled(page), "run: python docs/evidence.py"
    assert all(f"<!-- evidence {name} -->\n" in "".join(pages) for name in evidence.TABLES)
