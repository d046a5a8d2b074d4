"""What the page hands on: a scene as a deck for ngspice, as Python, and its mean force against frequency."""

from __future__ import annotations

import dataclasses
import math
import re
import warnings
from typing import Any

import numpy as np

from fingerspice.base.errors import InputError
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit, Tran
from fingerspice.circuit.provenance import in_force
from fingerspice.explorer.changed import entries, marked
from fingerspice.explorer.request import Request, circuits_of, points_of, request_of, times_of, waveform_of
from fingerspice.explorer.scene import deadline
from fingerspice.explorer.waveforms import gain_of, read_source
from fingerspice.results.outcome import SolveError
from fingerspice.studies.export import export_netlist
from fingerspice.studies.largesignal import large_signal
from fingerspice.waveforms.waveform import Sine

#: Characters of an exported deck beyond which the page does not take it.
_LONGEST_EXPORT = 20_000_000
#: Largest error of the means against frequency: a picture shows no more.
_RTOL = 1e-5
_INFINITE = 'float("inf")'
_AS_CODE = re.compile(r"\b([A-Z][A-Za-z]*)\(")
_DISPERSIVE = """\
def dispersive(e):
    return dataclasses.replace(e, device="SKIN_DISPERSIVE", values={"d": e.values["d"]}) if e.device == "SKIN" else e


circuit = dataclasses.replace(circuit, elements=tuple(map(dispersive, circuit.elements)))"""


def as_deck(given: dict[str, Any], own: Circuit | None = None) -> str:
    """The scene as one deck that fingerspice and ngspice run.

    Raises
    ------
    InputError
        If the request is wrong, or the deck would be too long.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        request = request_of(given)
        _, circuit, _ = circuits_of(request, own)
        text = export_netlist(_timed(circuit, request), charge_law=request.charge_law)
    if len(text) > _LONGEST_EXPORT:
        raise InputError(f"the deck would have {len(text):,} characters; allowed: at most {_LONGEST_EXPORT:,}")
    return text


def as_python(given: dict[str, Any], own: Circuit | None = None) -> str:
    """The scene as Python that gives the page's solution.

    Raises
    ------
    InputError
        If the request is wrong.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        request = request_of(given)
        base, circuit, _ = circuits_of(request, own)
        circuit, _ = marked(circuit, base, request)
        first, stop, _ = times_of(circuit, request)
    by_sets = {path.lower() for kept, _ in in_force(circuit).values() for path in kept}
    name, waveform = read_source(request.source, base, request.recording) if request.source else ("", None)
    lines, changes = _beginning(request.deck, own, name)
    if request.skin == "dispersive":
        lines += _DISPERSIVE.splitlines()
    for one, to in entries(circuit, request):
        lines.append(f"circuit = fs.parameters({one!r}).apply(circuit{'' if to is None else f', {to!r}'})")
    if waveform is not None and name.lower() not in by_sets:
        gain = gain_of(request.source)
        recorded = request.recording.python(gain) if request.recording is not None and gain is not None else None
        code = recorded or _AS_CODE.sub(r"fs.\1(", repr(waveform))
        lines.append(f"circuit = circuit.replace({{{name!r}: {code}}})")
    known = {path.lower() for path in circuit.parameters}
    changes |= {path: x for path, x in request.overrides.items() if path.lower() in known}
    changes = {path: x for path, x in changes.items() if path.lower() not in by_sets}
    if request.skin == "follow":
        changes |= {f"{e.name}.f": e.values["f"] for e in circuit.by_device("SKIN")}
    if changes:
        inside = ", ".join(f"{path!r}: {_INFINITE if x == math.inf else repr(x)}" for path, x in changes.items())
        lines.append(f"circuit = circuit.replace({{{inside}}})")
    lines += [
        "solution = fs.simulate(",
        f"    circuit, t_stop={stop!r}, t_eval=np.linspace({first!r}, {stop!r}, {points_of(circuit, first, stop)[0]}),",
        f"    charge_law={request.charge_law!r}, area={request.area!r}, rtol={request.rtol!r},",
        ")",
        "print(solution)",
        "",
    ]
    return "\n".join(lines)


def _beginning(deck: str, own: Circuit | None, replaced: str) -> tuple[list[str], dict[str, float]]:
    """The lines that make the circuit of a deck, and the values changed before the page was opened.

    The source of the name `replaced` has got another waveform on the page.
    """
    lines = ["import dataclasses", "", "import numpy as np", "", "import fingerspice as fs", ""]
    mine = own if own is not None and deck == own.text else None
    if mine is not None and mine.path is not None:
        lines.append(f"circuit = fs.read_netlist({str(mine.path)!r})")
    else:
        lines += ["circuit = fs.parse_netlist(", *(f"    {line!r}" for line in deck.splitlines(keepends=True)), ")"]
    changes: dict[str, float] = {}
    if mine is None:
        return lines, changes
    known = {path.lower(): parameter.value for path, parameter in mine.parameters.items()}
    for path, text in mine.overrides.items():
        if path.lower() in known:
            changes[path] = known[path.lower()]
        elif path.lower() != replaced.lower():
            lines.append(f"# Changed before, in Python: {path} = {' '.join(text.split())}")
    return lines, changes


def _timed(circuit: Circuit, request: Request) -> Circuit:
    """The circuit with the length of the page's run, and as many outputs."""
    first, stop, _ = times_of(circuit, request)
    uic = circuit.tran is None or circuit.tran.uic
    return dataclasses.replace(circuit, tran=Tran((stop - first) / points_of(circuit, first, stop)[0], stop, uic=uic))


def means(given: dict[str, Any], own: Circuit | None = None) -> dict[str, Any]:
    """Mean force of the periodic state at some frequencies, under sines of the source's amplitude.

    Parameters
    ----------
    given : dict
        A request; its key ``frequencies`` (Hz, at most 16) says where.
    own : Circuit, optional
        As in `scene`.

    Returns
    -------
    dict
        ``ok`` and ``message``; ``frequency`` and ``force`` (Hz and N, arrays), and ``gap`` and ``amplitude``, in words.
    """
    frequencies = given.get("frequencies") if isinstance(given, dict) else None
    try:
        good = isinstance(frequencies, list) and 0 < len(frequencies) <= 16
        if not good or not all(isinstance(x, (int, float)) and 1e-2 <= x <= 1e6 for x in frequencies or ()):
            raise InputError("frequencies: allowed: a list of at most 16 numbers from 0.01 to 1e6 Hz")
        asked = {key: value for key, value in given.items() if key != "frequencies"}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            request = request_of(asked)
            _, circuit, _ = circuits_of(request, own)
            gaps = circuit.by_device("GAP")
            if not gaps:
                raise InputError("the circuit has no GAP, and so no force")
            wave = waveform_of(circuit)
            if wave.fundamental is None:
                raise InputError("the source has no one amplitude that sines could have; allowed: a periodic source")
            (found,) = large_signal(
                circuit, np.asarray(frequencies, float), charge_law=request.charge_law, finger=gaps[0].name,
                rtol=max(request.rtol, _RTOL), progress=deadline(),
            )  # fmt: skip
    except (InputError, SolveError) as error:
        return {"ok": False, "message": str(error)}
    amplitude = format_si(float(np.max(found.amplitude)), "V")
    if not (isinstance(wave, Sine) and wave.offset == 0.0):
        amplitude += ", the source's fundamental,"
    return {
        "ok": True, "message": "", "frequency": found.frequency, "force": found.f_el_mean, "gap": gaps[0].name,
        "amplitude": amplitude,
    }  # fmt: skip
