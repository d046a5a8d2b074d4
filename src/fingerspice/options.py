"""What the command line's options mean, and the checks before a run: nothing here writes a file."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from fingerspice.errors import FingerspiceWarning, InputError
from fingerspice.units import parse_number

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import AcSweep, Circuit

LARGEST_AREA = 0.01
"""m^2; an area above it was probably given in mm^2."""


def read_circuit(deck: Path, changes: list[str] | None, source: str | None) -> Circuit:
    """The deck's circuit with ``--set`` and ``--source``; what has no effect here is warned about."""
    from fingerspice.circuit.netlist import read_netlist
    from fingerspice.notices import directive_warnings

    circuit = read_netlist(deck)
    circuit = _with_changes(circuit, changes or [])
    if source is not None:
        circuit = _with_source(circuit, source)
    # Said here for the commands that make no run of the circuit as it is.
    for text in directive_warnings(circuit):
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    return circuit


def _with_changes(circuit: Circuit, changes: list[str]) -> Circuit:
    """The circuit with every ``--set``, all at once: exponents may have to change together."""
    from fingerspice.circuit.netlist import value_from_text

    values: dict[str, float] = {}
    for change in changes:
        path, equals, text = (part.strip() for part in change.partition("="))
        if not equals or not path:
            raise InputError(f"--set {change!r} is not understood; allowed: PATH=VALUE, such as Xgap.d=3u")
        try:
            values[path], warning = value_from_text(circuit, path, text)
        except InputError as error:
            raise InputError(f"--set {change!r}: {error.message}") from None
        if warning:
            warnings.warn(f"--set {warning}", FingerspiceWarning, stacklevel=2)
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


def time_from_text(option: str, text: str | None) -> float | None:
    """A time in s, such as ``50m``."""
    try:
        return None if text is None else parse_number(text)
    except ValueError as error:
        raise InputError(f"{option} {text!r}: {error}") from None


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
    # A name that is too long is found only by looking for the file itself, in a folder that is there.
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
