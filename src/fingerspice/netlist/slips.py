"""Common slips in netlists, and directives of other simulators, each with a sentence about what to write instead."""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Iterable, Iterator

from fingerspice.base.errors import InputError

#: Directives that only other simulators know, each with the alternative here.
ELSEWHERE = {
    ".step": "give one value a run by --set PATH=VALUE, or loop over circuit.replace({path: value}) in Python",
    ".four": "mean, peaks and amplitude are in the summary of a run, and any harmonic in the data that it writes",
    ".temp": "nothing depends on temperature; give the values at the one that is meant",
    ".model": "there are no models; write the device's parameters on its own line",
    ".global": "give the node to each .subckt as one of its nodes",
    ".func": "write the expression where it is used, {a*b}, or into .param",
    ".op": "a .tran without uic starts from the operating point, fs.simulate(circuit, start='dc') too",
    ".dc": "run once per value by --set, such as --set Vdrive.level=5",
    ".noise": "there is no noise analysis",
    ".wave": "run writes every signal as NetCDF, or as CSV with --csv",
    ".csparam": "write .param",
    ".endl": "put the section of the library into a file and .include it",
    ".width": "leave it out",
    **dict.fromkeys((".tf", ".pz", ".net"), "gains against frequency are given by fingerspice ac"),
    **dict.fromkeys((".sens", ".data", ".alter"), "run once per value by --set"),
    **dict.fromkeys((".if", ".elseif", ".else", ".endif"), "write the case that is meant"),
    **dict.fromkeys(
        (".savebias", ".loadbias"), "a run goes on from another in Python, fs.simulate(circuit, start=solution)"
    ),
}

_LISTS = re.compile(r"\{[^{}]*\}|'[^']*'|\"[^\"]*\"")
_CALL = re.compile(r"\(([^()]*)\)")
_COMMA = re.compile(r"(?<![\w.,])([+-]?[0-9]+),([0-9]+[a-zµμ]*)(?![\w.,])", re.IGNORECASE)
_ASSIGNED = re.compile(rf"=\s*{_COMMA.pattern}", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?\.?[0-9][\w.+-]*")
_GREEK_MU = re.compile(r"(?<![\w.])([0-9.]+(?:e[+-]?[0-9]+)?)μ", re.IGNORECASE)
_UNIT = re.compile(r"(?:[tgkmunpfµμ]|meg|mil)?(?:m|v|a|s|n|f|hz|ohm|ω)?", re.IGNORECASE)


def decimal_comma(text: str) -> str | None:
    """A warning about a comma that is probably meant as a decimal point; None if there is none.

    Commas separate numbers, as in ``SIN(0,200,100)``. A comma is doubtful if blanks separate the other numbers, as in
    ``SIN(0 200 0,1)``, and in ``d=3,5u``.
    """
    bare = _LISTS.sub("x", text)
    for found in (_ASSIGNED.search(bare), *_among_blanks(bare)):
        if found:
            whole, part = found[1], found[2]
            return (
                f"{whole},{part} is two numbers, {whole} and {part}, for a comma separates; if it is a decimal comma "
                f"write {whole}.{part}"
            )
    return None


def greek_mu(text: str) -> str | None:
    """A warning about a number with the Greek letter for micro, which ngspice does not read; None if there is none."""
    found = _GREEK_MU.search(text)
    return f"{found[0]} is {found[1]}u here and {found[1]} in ngspice 39: write {found[1]}u" if found else None


def _among_blanks(bare: str) -> Iterator[re.Match[str] | None]:
    outside = _CALL.sub(" ", bare)
    # An element's name and nodes are left out: they may be numbers, and commas may separate them.
    words = outside.split()[1 if outside.lstrip().startswith(".") else 3 :]
    for chunks in ([c for c in words if "=" not in c], *(m[1].split() for m in _CALL.finditer(bare))):
        matches = [_COMMA.fullmatch(chunk) for chunk in chunks]
        others = [c for c, m in zip(chunks, matches, strict=True) if m is None]
        if all(_NUMBER.fullmatch(c) or c.isalpha() for c in others) and (others or len(chunks) == len(words) == 1):
            yield from matches


def is_unit(word: str) -> bool:
    """Whether a word may be a scale, a unit, or both."""
    return _UNIT.fullmatch(word) is not None and word != ""


def stray_word(word: str, before: str) -> str:
    """A hint if a word after ``key=value`` is a unit, separated from its number by a blank; else an empty text."""
    number = before.rpartition("=")[2].strip()
    return f"; a unit joins its number, {number}{word}" if _NUMBER.fullmatch(number) and is_unit(word) else ""


def with_comma(error: InputError, warnings: Iterable[str]) -> InputError:
    """The error, with the warning about a decimal comma in the same line, if there is one."""
    place = f"{error.where.file}:{error.where.line}:" if error.where else "none"
    found = [text.partition(": ")[2] for text in warnings if text.startswith(place) and "decimal comma" in text]
    return InputError("; note ".join([error.message, *found]), error.where) if found else error


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
