"""Search for the known word nearest to an unknown one, for the hints of messages."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable

#: Largest number and length of the known words that are compared: a comparison takes the product of the two lengths.
MAX_KNOWN, MAX_COMPARED = 1000, 60


def closest(word: str, known: Iterable[str]) -> str | None:
    """The known word whose spelling is nearest to `word`, regardless of case; None if none is similar."""
    if len(word) > MAX_COMPARED:
        return None
    lower = {name.lower(): name for name in itertools.islice(known, MAX_KNOWN) if len(name) <= MAX_COMPARED}
    close = difflib.get_close_matches(word.lower(), lower, n=1)
    return lower[close[0]] if close else None


def nearest(word: str, known: Iterable[str]) -> str:
    """The clause ``; did you mean 'x'?`` with the closest known word, or an empty text."""
    found = closest(word, known)
    return f"; did you mean '{found}'?" if found is not None else ""
