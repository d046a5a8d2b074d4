"""The nearest known spelling of a word that is not known."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable

#: Comparing two words takes the product of their lengths: only so many known words of so many characters are compared.
MAX_KNOWN, MAX_COMPARED = 1000, 60


def closest(word: str, known: Iterable[str]) -> str | None:
    """The known word that is spelt most like `word`, whatever their case; None where none is similar."""
    if len(word) > MAX_COMPARED:
        return None
    lower = {name.lower(): name for name in itertools.islice(known, MAX_KNOWN) if len(name) <= MAX_COMPARED}
    close = difflib.get_close_matches(word.lower(), lower, n=1)
    return lower[close[0]] if close else None


def nearest(word: str, known: Iterable[str]) -> str:
    """The clause ``; did you mean 'x'?`` with the closest known word, or an empty text."""
    found = closest(word, known)
    return f"; did you mean '{found}'?" if found is not None else ""
