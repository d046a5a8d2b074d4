"""Reading of a netlist, from a file or a text, into a `Circuit`."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path

from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import AcSweep, Circuit, Element, Tran
from fingerspice.circuit.devices import REST_AREA, unusual
from fingerspice.circuit.loop import checked
from fingerspice.netlist.deck import parse_deck, read_deck
from fingerspice.netlist.elements import read_ac, read_elements, read_initial, read_options, read_tran, source_of
from fingerspice.netlist.expressions import decimal_comma, with_comma
from fingerspice.netlist.lexer import SourceFiles
from fingerspice.netlist.reader import MAX_WARNINGS, Deck
from fingerspice.netlist.sources import Context
from fingerspice.waveforms.waveform import DC, Waveform


def read_netlist(path: str | Path) -> Circuit:
    """Read a circuit from a netlist file.

    Parameters
    ----------
    path : str or Path
        A file, or ``-`` for standard input.

    Raises
    ------
    InputError
        If the file cannot be read or has an error; the message gives its place and the allowed alternatives.
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"read_netlist is given {path!r}; allowed: the path of a netlist, such as 'deck.cir'")
    return _circuit(read_deck(path))


def parse_netlist(text: str, path: str | Path | None = None) -> Circuit:
    """Read a circuit from the text of a netlist.

    Parameters
    ----------
    text : str
    path : str or Path, optional
        Path of the file with this text; the text may include files from its folder.

    Raises
    ------
    InputError
        If the text has an error; the message gives its place and the allowed alternatives.
    """
    if not isinstance(text, str):
        raise InputError(f"parse_netlist is given {text!r}; allowed: a netlist's text, whose first line is the title")
    if "\n" not in text.strip() and text.strip().lower().endswith((".cir", ".net", ".sp")):
        raise InputError(f"parse_netlist is given {text.strip()!r}, a file's name; allowed: read_netlist for a file")
    return _circuit(parse_deck(text, None if path is None else Path(path)))


def _circuit(deck: Deck) -> Circuit:
    """The circuit of a deck; an error without a place gets the deck's name, and a note if the title is a statement."""
    try:
        circuit = _read(deck, list(deck.warnings))
    except InputError as error:
        told = with_comma(error, deck.warnings)
        text = told.message if told.where else f"{deck.file}: {told.message}"
        title = [note for note in deck.warnings if "the first line is the title" in note]
        raise InputError("; note ".join([text, *title]), told.where) from None
    for note in circuit.warnings:
        warnings.warn(note, FingerspiceWarning, stacklevel=3)
    return circuit


def _read(deck: Deck, notes: list[str]) -> Circuit:
    tran = next((read_tran(directive, notes) for directive in deck.named(".tran")), None)
    context = Context(tran, SourceFiles(None if deck.path is None else deck.path.parent))
    elements = tuple(e for statement in deck.statements for e in read_elements(statement, context, notes))
    work, unused = read_options(deck.named(".options"))
    initial, unused_starts = read_initial(deck.named(".ic"), elements, tran is None or tran.uic)
    notes.extend(_unusual(deck, elements, tran, initial))
    more = len(notes) - MAX_WARNINGS
    if more > 1:
        notes[MAX_WARNINGS:] = [f"{more} more warnings are not shown"]
    laws = {"mobile" if "mobile" in name.lower() else "local" for name in deck.libraries}
    ac = next(map(read_ac, deck.named(".ac")), None)
    if len(laws) > 1:
        raise InputError("both fingerspice.lib (local law) and fingerspice_mobile.lib (mobile law) are included")
    circuit = Circuit(
        title=deck.title,
        elements=elements,
        tran=tran,
        ac=ac,
        initial=initial,
        charge_law=next(iter(laws), None),
        work=work,
        warnings=tuple(notes),
        unused=(*deck.unused, *unused, *unused_starts),
        text=deck.text,
        path=deck.path,
    )
    return checked(circuit)


def _unusual(
    deck: Deck, elements: tuple[Element, ...], tran: Tran | None, initial: Mapping[str, float]
) -> Iterator[str]:
    """Warnings about unusual areas given by sources or start values, and outputs too far apart for a source."""
    nodes = {e.nodes[2] for e in elements if e.spec.is_layer}
    for node in (node for node in initial if node in nodes):
        if text := REST_AREA.warning(f".ic v({node})", initial[node], "mm^2"):
            yield text
    for e in (e for e in elements if e.device == "V" and e.nodes[0] in nodes):
        if isinstance(e.waveform, DC) and (text := REST_AREA.warning(f"{e.name}, an area,", e.waveform.level, "mm^2")):
            yield f"{e.where}: {text}"
    for e in elements if tran is not None else ():
        period = e.waveform.period if e.waveform is not None else None
        # A source whose frequency is unusual has a warning already.
        if tran is not None and period is not None and tran.step > period * (1.0 + 1e-9) and not any(unusual(e)):
            step, longest = format_si(tran.step, "s"), format_si(period, "s")
            yield (
                f"{deck.named('.tran')[0].where}: {e.name}: TSTEP is {step}, longer than this source's period of "
                f"{longest}: the outputs do not show its course, and the figures of a run still do"
            )


def source_from_text(text: str, circuit: Circuit, *, files: bool = True) -> Waveform:
    """A waveform from netlist text such as ``SQUARE(200 100)`` or ``WAVEFILE(a.wav 150)``.

    SPICE's defaults come from the circuit's .tran, and file names are relative to the working directory. Without
    `files`, for a text from elsewhere, no file is read.
    """
    tran = circuit.tran
    line = f".tran {tran.step!r} {tran.stop!r}\n" if tran else ""
    context = Context(tran, SourceFiles(anywhere=files), in_deck=False)
    try:
        deck = parse_deck(f"source\nVsource a 0 {text}\n{line}")
        if len(deck.statements) != 1:
            raise InputError("not one source; allowed: such as SQUARE(200 100)")
        source = source_of(deck.statements[0]._replace(name="source"), context)
        if source.ac is not None:
            raise InputError("AC belongs into the deck; allowed: the source function alone, whose fundamental drives")
    except InputError as error:
        comma = decimal_comma(f"V1 a 0 {text}")
        raise InputError(f"{text!r}: {error.message}" + (f"; note {comma}" if comma else "")) from None
    for note in (*deck.warnings, *source.notes):
        # A note begins with a place in the one-source deck made here, which the user does not know: cut it off.
        warnings.warn(f"{text!r}: {note.partition(': ')[2]}", FingerspiceWarning, stacklevel=2)
    return source.waveform


def sweep_from_text(text: str) -> AcSweep:
    """A sweep from text such as ``dec 10 10 100k``."""
    try:
        sweeps = parse_deck(f"sweep\n.ac {text}\n").named(".ac")
        if not sweeps:
            raise InputError("not a sweep")
        return read_ac(sweeps[0])
    except InputError as error:
        raise InputError(f"{text!r}: {error.message}") from None
