"""Directives of a deck: analyses, start values and options, in the forms of ngspice and of LTspice."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import WORK_READINGS, AcSweep, Element, Tran
from fingerspice.netlist.slips import is_unit, nearest
from fingerspice.netlist.words import Call, Directive, Number, Token
from fingerspice.waveforms.bounds import check_range

#: Number of outputs of a run whose .tran has no TSTEP.
LTSPICE_OUTPUTS = 10_000
_LTSPICE_START = {
    "startup": "sources are not ramped up here; allowed: a source that rises by itself, such as PWL(0 0 20u 5)",
    "steady": "no run stops by itself here; allowed: fs.steady_state(circuit), which finds the periodic state",
    "nodiscard": "outputs begin at TSTART here; allowed: TSTART left out",
    "step": "loads are not stepped here; allowed: a source with steps, PULSE or PWL",
}
_NGSPICE_OPTIONS = frozenset(
    """abstol acct bypass chgtol defad defas defl defw gmin gminsteps interp itl1 itl2 itl3 itl4 itl5 itl6 keepopinfo
    klu list maxevtiter maxopalter maxord method minbreak noacct noinit nomod nopage node noopalter numdgt opts
    pivrel pivtol ramptime reltol rshunt savecurrents seed seedinfo sparse srcsteps temp tnom trtol trytocompact
    vntol warn xmu""".split()  # noqa: SIM905
)
_LTSPICE_OPTIONS = frozenset(
    """baudrate cshunt delay fastaccess flagloads gfloat gshunt measdgt meascplxfmt minclockguide mindeltagmin nomarch
    noopiter plotabstol plotreltol plotvntol plotwinsize ptranmax ptrantau srcstepmethod sstol thev_induc
    topologycheck""".split()  # noqa: SIM905
)


def _numbers(directive: Directive, usage: str) -> tuple[list[Number], list[str]]:
    """The numbers and the other words of a directive's line."""
    for arg in directive.args:
        if isinstance(arg, Call):
            raise InputError(f"{directive.name}: {arg.text!r} is not understood; allowed: {usage}", arg.where)
    for key, value in directive.params.items():
        raise InputError(f"{directive.name} takes no {key!r}; allowed: {usage}", value.key)
    numbers = [arg for arg in directive.args if isinstance(arg, Number)]
    return numbers, [arg.text.lower() for arg in directive.args if isinstance(arg, Token)]


def read_tran(directive: Directive, notes: list[str]) -> Tran:
    """``.tran TSTEP TSTOP [TSTART [TMAX]] [uic]``, and LTspice's ``.tran TSTOP`` and ``.tran 0 TSTOP [TSTART [TMAX]]``.

    If no TSTEP is given, a warning with the TSTEP that is used is added to `notes`.
    """
    usage = ".tran TSTEP TSTOP [TSTART [TMAX]] [uic]"
    numbers, words = _numbers(directive, usage)
    for word in words:
        if word in _LTSPICE_START:
            raise InputError(f".tran {word}: {_LTSPICE_START[word]}", directive.where)
    if any(w != "uic" for w in words) or not 1 <= len(numbers) <= 4:
        apart = "; a unit joins its number, such as 20m" if any(is_unit(w) for w in words) else ""
        raise InputError(f"{directive.text.strip()!r} is not understood; allowed: {usage}{apart}", directive.where)
    step, stop, start, longest = [None, numbers[0], None, None] if len(numbers) == 1 else [*numbers, None, None][:4]
    assert stop is not None
    _require(stop.value > 0.0, "TSTOP", stop, "more than 0 s")
    for what, number in (("TSTOP", stop), ("TMAX", longest)):
        _require(number is None or 1e-30 <= number.value <= 1e30, what, number, "1e-30 to 1e30 s")
    if step is None or step.value == 0.0:
        step = longest
    if step is None:
        every = stop.value / LTSPICE_OUTPUTS
        step = Number(every, f"{every:g}", directive.where)
        notes.append(
            f"{directive.where}: {directive.text.strip()!r} has no TSTEP, which LTspice does not need: "
            f"{LTSPICE_OUTPUTS:,} outputs, one every {every:g} s"
        )
    _require(step.value > 0.0, "TSTEP", step, "more than 0 s")
    _require(1e-30 <= step.value <= 1e30, "TSTEP", step, "1e-30 to 1e30 s")
    _require(step.value <= stop.value, "TSTEP", step, f"at most TSTOP = {stop.text} (the output step comes first)")
    begin = start.value if start else 0.0
    _require(0.0 <= begin < stop.value, "TSTART", start, f"0 to TSTOP = {stop.text}")
    _require((stop.value - begin) / step.value <= 1e8, "TSTEP", step, "at most 1e8 output steps in a run")
    return Tran(step.value, stop.value, begin, longest.value if longest else None, "uic" in words)


def _require(condition: bool, what: str, given: Number | None, allowed: str) -> None:
    if not condition:
        assert given is not None
        raise InputError(f"{what} is {given.text}; allowed: {allowed}", given.where)


def read_ac(directive: Directive) -> AcSweep:
    """``.ac DEC|OCT|LIN N FSTART FSTOP``."""
    usage = ".ac DEC|OCT|LIN N FSTART FSTOP"
    numbers, words = _numbers(directive, usage)
    if len(words) != 1 or words[0] not in ("dec", "oct", "lin") or len(numbers) != 3:
        raise InputError(f"{directive.text.strip()!r} is not understood; allowed: {usage}", directive.where)
    n, low, high = numbers
    _require(n.value >= 1 and n.value == int(n.value) and n.value <= 1e6, "N", n, "a whole number, 1 to 1e6")
    _require(low.value > 0.0, "FSTART", low, "more than 0 Hz")
    _require(high.value >= low.value, "FSTOP", high, f"at least FSTART = {low.text}")
    for what, number in (("FSTART", low), ("FSTOP", high)):
        _require(1e-30 <= number.value <= 1e30, what, number, "1e-30 to 1e30 Hz")
    scale: Literal["dec", "oct", "lin"] = words[0]  # type: ignore[assignment]
    spans = 1.0 if scale == "lin" else math.log(high.value / low.value, 10.0 if scale == "dec" else 2.0)
    _require(n.value * spans <= 1e6, "N", n, f"at most 1e6 frequencies in a sweep, here {n.value * spans:.3g}")
    return AcSweep(scale, int(n.value), low.value, high.value)


def read_initial(directives: list[Directive], elements: tuple[Element, ...]) -> dict[str, float]:
    """``.ic v(node)=value``: start values by canonical node, in V, or in mm^2 of an area node."""
    usage = "allowed: .ic v(node)=value"
    nodes = {node: None for e in elements for node in e.nodes}  # an ordered set
    area_nodes = {e.nodes[2] for e in elements if e.spec.is_layer}
    out: dict[str, float] = {}
    for directive in directives:
        if directive.args:
            raise InputError(f"{directive.text.strip()!r} is not understood; {usage}", directive.where)
        for key, value in directive.params.items():
            place = value.key
            if not (key.startswith("v(") and key.endswith(")")):
                raise InputError(f".ic {key!r} is not understood; {usage}", place)
            if not isinstance(value, Number):
                raise InputError(f".ic {key} is {value.text!r}; allowed: a number V", place)
            node = key[2:-1]
            if node not in nodes:
                raise InputError(f".ic names node {node!r}, which is not in the circuit{nearest(node, nodes)}", place)
            if node in out:
                raise InputError(f".ic gives node {node!r} twice", place)
            if node == "0" and value.value != 0.0:
                raise InputError(f".ic {key} is {value.text} V; allowed: 0, it is ground", place)
            if node in area_nodes and not 1e-30 <= value.value <= 1e30:
                raise InputError(f".ic {key} is {value.text} mm^2; allowed: more than 0, from 1e-30 to 1e30", place)
            out[node] = value.value if node in area_nodes else start_volts(f".ic {key}", value)
    return out


def start_volts(what: str, number: Number) -> float:
    """A start voltage (V), which must be within the range allowed for sources."""
    try:
        check_range(what, number.value, "V")
    except InputError as error:
        raise InputError(error.message, number.where) from None
    return number.value


def unused_starts(initial: Mapping[str, float], elements: tuple[Element, ...], uic: bool) -> tuple[str, ...]:
    """Start values without effect: with ``uic`` where no layer or capacitor without ``IC=`` is, else every ``IC=``."""
    layers = [e for e in elements if e.spec.is_layer]
    gaps = [e for e in layers if e.device == "GAP" and e.values["a_fix"] == 0.0]
    started = [*layers, *(e for e in elements if e.device == "C" and e.initial is None)]
    used = {node for e in started for node in e.nodes[:2]} if uic else set(initial)
    used -= {e.nodes[2] for e in layers}
    used |= {e.nodes[2] for e in gaps if not uic or e.values["tau"] > 0.0}
    without = [f".ic v({node})" for node in initial if node not in used]
    return (*without, *(f"IC= of {e.name}" for e in elements if e.initial is not None and not uic))


def read_options(directives: list[Directive]) -> tuple[str, tuple[str, ...]]:
    """The reading of Eq. 7 that ``work`` selects, and the names of ngspice's and LTspice's options, without effect."""
    work, unused = None, []
    for directive in directives:
        names = [(key, value.text.lower(), value.key) for key, value in directive.params.items()]
        for arg in directive.args:
            if not isinstance(arg, Token):
                raise InputError(f".options {arg.text!r} is not understood; allowed: .options name=value", arg.where)
            names.append((arg.text.lower(), "", arg.where))
        for key, text, place in names:
            if key == "work":
                if text not in WORK_READINGS:
                    raise InputError(f".options work is {text!r}; allowed: {' or '.join(WORK_READINGS)}", place)
                if work not in (None, text):
                    raise InputError(f".options work is given twice, first {work}, then {text}", place)
                work = text
            elif key in _NGSPICE_OPTIONS or key in _LTSPICE_OPTIONS:
                unused.append(f".options {key}")
            else:
                hint = nearest(key, [*_NGSPICE_OPTIONS, "work"])
                known = f"work={'|'.join(WORK_READINGS)}, and those of ngspice and LTspice, which have no effect here"
                raise InputError(f"unknown option {key!r}{hint}; allowed: {known}", place)
    return work or "gap", tuple(dict.fromkeys(unused))
