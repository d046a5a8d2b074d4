"""What the command line's options mean, and the checks before a run: nothing here writes a file."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from fingerspice.errors import FingerspiceWarning, InputError
from fingerspice.terminal import complain
from fingerspice.units import parse_number

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import AcSweep, Circuit

LARGEST_AREA = 0.01
"""m^2; an area above it was probably given in mm^2."""


def read_circuit(deck: Path, changes: list[str] | None, source: str | None) -> Circuit:
    """The deck's circuit with ``--set`` and ``--source``; what has no effect here is noted on stderr."""
    from fingerspice.circuit.netlist import read_netlist

    circuit = read_netlist(deck)
    circuit = _with_changes(circuit, changes or [])
    if source is not None:
        circuit = _with_source(circuit, source)
    for directive in circuit.unused:
        complain(f"note: {directive} has no effect here")
    return circuit


def _with_changes(circuit: Circuit, changes: list[str]) -> Circuit:
    """The circuit with every ``--set``, all at once: exponents may have to change together."""
    values: dict[str, str] = {}
    for change in changes:
        path, equals, text = (part.strip() for part in change.partition("="))
        if not equals or not path:
            raise InputError(f"--set {change!r} is not understood; allowed: PATH=VALUE, such as Xgap.d=3u")
        values[path] = text
    if not values:
        return circuit
    try:
        return circuit.replace(values)
    except InputError as error:
        # The deck's line is not at fault.
        raise InputError(f"--set {' '.join(map(repr, changes))}: {error.message}") from None


def _with_source(circuit: Circuit, text: str) -> Circuit:
    from fingerspice.circuit.netlist import source_from_text
    from fingerspice.circuit.topology import find_branches

    sources = [e for e in find_branches(circuit)[1] if e.device in "VI"]
    if len(sources) != 1:
        names = ", ".join(e.name for e in sources)
        raise InputError(f"--source needs a circuit with one source; this one has {names}")
    try:
        return circuit.replace({sources[0].name: source_from_text(text, circuit)})
    except InputError as error:
        raise InputError(f"--source {error.message}") from None


def note_skin_frequency(circuit: Circuit) -> None:
    """Warn where a SKIN's data are not taken at the source's fundamental."""
    from fingerspice.circuit.statespace import build_stack, is_stack
    from fingerspice.circuit.topology import find_branches

    if is_stack(circuit):
        fundamental = build_stack(circuit).waveform.fundamental
    else:
        waves = [e.waveform for e in find_branches(circuit)[1] if e.waveform is not None]
        fundamental = waves[0].fundamental if len(waves) == 1 else None
        if len(waves) > 1:
            # Which of several sources the skin's data should match is the user's to know.
            return
    for skin in circuit.by_device("SKIN"):
        f = skin.values["f"]
        if fundamental is None:
            text = f"{skin.name} takes its data at {f:g} Hz, and the source has no fundamental"
        elif abs(f / fundamental.frequency - 1.0) > 1e-9:
            text = (
                f"{skin.name} takes its data at f = {f:g} Hz, the source's fundamental is "
                f"{fundamental.frequency:g} Hz; --set {skin.name}.f={fundamental.frequency:g} would match"
            )
        else:
            continue
        warnings.warn(text, FingerspiceWarning, stacklevel=2)


def area_from_text(text: str) -> str | float:
    """A mode's name, or an area in m^2."""
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
    """Refuse an output that cannot be written, or is the deck, before spending time on the run; writes nothing."""
    try:
        _check_output(file, deck)
    except OSError as error:
        raise InputError(f"cannot write {file}: {error.strerror}; allowed: a folder that can be written") from None


def _check_output(file: Path, deck: Path | None) -> None:
    folder = file.parent
    while not folder.exists() and folder != folder.parent and not folder.is_symlink():
        folder = folder.parent
    # A name that is too long is found only by looking for a file, in a folder that is there.
    (folder / file.name).exists()
    if not folder.is_dir():
        raise InputError(f"cannot write {file}: {folder} is not a folder; allowed: a folder that can be written")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"cannot write {file}: no permission in {folder}; allowed: a folder that can be written")
    if file.is_dir():
        raise InputError(f"cannot write {file}: it is a folder; allowed: a file's name")
    if deck is not None and file.exists() and deck.exists() and file.samefile(deck):
        raise InputError(f"cannot write {file}: it is the deck itself; allowed: another name or folder")


def sweep(text: str | None, circuit: Circuit) -> AcSweep:
    """The sweep of ``--sweep``, or without it the deck's; else the band of the skin's data."""
    from fingerspice.circuit.circuit import AcSweep
    from fingerspice.circuit.directives import sweep_from_text

    if text is None:
        return circuit.ac or AcSweep("dec", 20, 10.0, 1e5)
    try:
        return sweep_from_text(text)
    except InputError as error:
        raise InputError(f"--sweep {error.message}") from None
