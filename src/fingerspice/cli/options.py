"""Interpretation of the command line's options, and checks before a run; no function here writes a file."""

from __future__ import annotations

import dataclasses
import os
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from fingerspice.base.errors import FingerspiceWarning, InputError, printable
from fingerspice.base.units import parse_number
from fingerspice.cli.terminal import complain

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit
    from fingerspice.waveforms.waveform import Waveform

#: Largest area that causes no warning, m^2; a larger one was probably given in mm^2.
LARGEST_AREA = 0.01
#: Largest number of characters of a source's numbers that are stored with the results.
LONGEST_SOURCE = 1000


def read_circuit(deck: Path, changes: list[str] | None, sources: list[str] | None, **sets: list[str] | None) -> Circuit:
    """The deck's circuit with the named sets of ``--set`` and of options by kind, ``--set`` values, and ``--source``.

    What comes later in this order has the last word. Gives the reader's warnings, without those about replaced values,
    and warnings about directives without effect.
    """
    from fingerspice.circuit.describe import directive_warnings
    from fingerspice.netlist.netlist import read_netlist

    with warnings.catch_warnings(record=True) as noticed:
        warnings.simplefilter("always", FingerspiceWarning)
        circuit = read_netlist(deck)
    given = circuit.warnings
    # A path has a dot, and the name of a set none.
    named = [change for change in changes or () if change and not set("=.") & set(change)]
    try:
        for option, text in [
            (option, text) for option, texts in {"set": named, **sets}.items() for text in texts or ()
        ]:
            circuit = _with_set(circuit, option, text)
        circuit = _with_values(circuit, changes or [], named)
        circuit = _with_sources(circuit, sources or [])
        given = circuit.warnings
    finally:
        # If a change is refused, show all warnings of the deck, since any of them may explain the refusal.
        for warning in noticed:
            if str(warning.message) in map(printable, given):
                warnings.warn(str(warning.message), FingerspiceWarning, stacklevel=2)
    # `simulate` gives these warnings itself, but commands that do not call it with this circuit would not.
    for text in directive_warnings(circuit):
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    others = [name.removeprefix(".options ") for name in circuit.unused if name.startswith(".options ")]
    if others:
        complain(f"note: .options {', '.join(others)}: of no effect here, where --rtol alone sets the error")
    return circuit


def _with_set(circuit: Circuit, option: str, text: str) -> Circuit:
    from fingerspice.sets.parameters import parameters

    element, equals, name = (part.strip() for part in text.rpartition("="))
    try:
        return parameters(name, None if option == "set" else option).apply(circuit, element if equals else None)
    except InputError as error:
        other = "; or PATH=VALUE, such as Xgap.d=3u" if option == "set" and "unknown set" in error.message else ""
        raise InputError(f"--{option} {text!r}: {error.message}{other}") from None


def _with_values(circuit: Circuit, changes: list[str], named: list[str]) -> Circuit:
    """The circuit with all ``--set`` values applied together, as two exponents may only be legal together."""
    values: dict[str, str] = {}
    for change in (change for change in changes if change not in named):
        path, equals, text = (part.strip() for part in change.partition("="))
        if not equals or not path:
            raise InputError(f"--set {change!r} is not understood; allowed: PATH=VALUE, such as Xgap.d=3u")
        values[path] = text
    try:
        return circuit.replace(values) if values else circuit
    except InputError as error:
        # Leave out the place in the deck, because the error is in the option.
        raise InputError(f"--set {' '.join(map(repr, changes))}: {error.message}") from None


def _with_sources(circuit: Circuit, texts: list[str]) -> Circuit:
    """The circuit with every ``--source``; the source's name may be left out if the circuit has only one."""
    from fingerspice.circuit.describe import overridden
    from fingerspice.circuit.statespace import driving_sources
    from fingerspice.netlist.netlist import source_from_text
    from fingerspice.waveforms.periodic import MOST_SHOWN, PWL
    from fingerspice.waveforms.samples import Samples

    if not texts:
        return circuit
    names = {e.name.lower(): e.name for e in driving_sources(circuit)}
    sources: dict[str, Waveform] = {}
    # The results describe a recording or a long table by the option's text, instead of by its numbers.
    named_by: dict[str, str] = {}
    for text in texts:
        named, equals, spec = (part.strip() for part in text.partition("="))
        # In PWL(...) r=10m the text before the = is not a source's name.
        if not (equals and named.replace(".", "").isidentifier()):
            named, spec = "", text
        known = ", ".join(names.values()) or "no source"
        if not named and len(names) != 1:
            raise InputError(f"--source {text!r}: the circuit has {known}; allowed: NAME=SPEC with one of these names")
        name = names.get(named.lower(), "") if named else next(iter(names.values()))
        if not name or name in sources:
            problem = "is given twice" if name else f"is not a source of the circuit; allowed: {known}"
            raise InputError(f"--source {text!r}: {named or name} {problem}")
        try:
            sources[name] = source_from_text(spec, circuit)
        except InputError as error:
            raise InputError(f"--source {error.message}") from None
        wave = sources[name]
        long = isinstance(wave, PWL) and len(wave.times) > MOST_SHOWN
        if long or isinstance(wave, Samples) or len(repr(wave)) > LONGEST_SOURCE:
            named_by[name] = spec
    changed = overridden(circuit, sources)
    return dataclasses.replace(changed, overrides={**changed.overrides, **named_by})


def with_times(circuit: Circuit, stop: str | None, start: str = "deck") -> tuple[Circuit, str]:
    """The circuit with ``--stop`` and ``--start`` in place of TSTOP and TSTART, and the mode of the run's start.

    Without a .tran line the run starts uncharged and has 1,001 outputs.
    """
    from fingerspice.circuit.circuit import Tran

    tran, t_stop = circuit.tran, time_from_text("--stop", stop)
    t_start = time_from_text("--start", start) if start[:1] in "+-.0123456789" and start else None
    if t_start is not None:
        start = "deck"
    if t_stop is None and (t_start is None or tran is None):
        return circuit, start
    first = t_start if t_start is not None else tran.start if tran is not None else 0.0
    last = t_stop if t_stop is not None or tran is None else tran.stop
    assert last is not None
    if last <= 0.0:
        raise InputError(f"--stop {last:g} s; allowed: more than 0 s")
    if t_start is not None and not 0.0 <= first < last:
        raise InputError(f"--start {first:g} s; allowed: from 0 s to less than the end, {last:g} s")
    step = tran.step if tran is not None else (last - first) / 1000.0
    if last < first + step * (1.0 - 1e-12):
        raise InputError(
            f"--stop {last:g} s is before the second output; allowed: TSTART + TSTEP = {first + step:g} s or more"
        )
    old = Tran(step, last, uic=True) if tran is None else tran
    return dataclasses.replace(circuit, tran=dataclasses.replace(old, stop=last, start=first)), start


def time_from_text(option: str, text: str | None) -> float | None:
    """A time in s, such as ``50m``."""
    try:
        return None if text is None else parse_number(text)
    except ValueError as error:
        raise InputError(f"{option} {text!r}: {error}") from None


def area_from_text(text: str) -> str | float:
    """The name of a mode, or an area in m^2."""
    try:
        area = parse_number(text)
    except ValueError:
        return text
    if area > LARGEST_AREA:
        warnings.warn(
            f"--area {text} is in m^2, {area * 1e6:g} mm^2; a fingerpad has tens of mm^2, which is 35e-6 or 35u here",
            FingerspiceWarning,
            stacklevel=2,
        )
    return area


def check_output(file: Path, deck: Path | None = None) -> None:
    """Before a run, refuse an output file that cannot be written or is the deck itself; writes nothing."""
    folder, names, allowed = file.parent, [file.name], "allowed: a folder that can be written"
    try:
        while not folder.exists() and folder != folder.parent and not folder.is_symlink():
            names.append(folder.name)
            folder = folder.parent
        # This raises OSError if a name is too long; the check needs a folder that exists.
        for one in names:
            (folder / one).exists()
        if not folder.is_dir():
            raise InputError(f"cannot write {file}: {folder} is not a folder; {allowed}")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise InputError(f"cannot write {file}: no permission in {folder}; {allowed}")
        # Some folders, such as those of /proc, take nothing new whatever their permissions say.
        with tempfile.TemporaryFile(dir=folder):
            pass
        if file.is_dir():
            raise InputError(f"cannot write {file}: it is a folder; allowed: a file's name")
        if deck is not None and file.exists() and deck.exists() and file.samefile(deck):
            raise InputError(f"cannot write {file}: it is the deck itself; allowed: another name or folder")
    except OSError as error:
        raise InputError(f"cannot write {file}: {error.strerror}; {allowed}") from None
