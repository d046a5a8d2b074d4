"""Named sets of parameters on the page, and what had been changed in a circuit before the page was opened.

The explorer's example scenes: decks made of the paper's Table 1 and what differs from it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

from fingerspice.base.errors import InputError
from fingerspice.base.units import spice_text
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.describe import in_force, remembering
from fingerspice.circuit.statespace import driving_sources
from fingerspice.explorer.request import Asked, quiet, read_source, text_of, value_text
from fingerspice.sets.parameters import parameters
from fingerspice.waveforms.waveform import Waveform


@quiet()
def applied(given: dict[str, Any], own: Circuit | None = None) -> dict[str, Any]:
    """What the set changes in the scene that a request names in its key ``apply``, as in `Asked.sets`.

    The answer has ``ok`` and ``message``; ``overrides`` (path to value as text), ``source`` (text, or None where the
    set is no drive) and ``set``, the set's entry in `Asked.sets`. `InputError` says why a set does not fit.
    """
    asked = dict(given) if isinstance(given, dict) else {}
    entry = asked.pop("apply", None)
    if not isinstance(entry, str):
        raise InputError("apply: allowed: the name of a set, or ELEMENT=NAME")
    circuit = Asked(asked, own).circuit
    name, to, changes = _changes(circuit, entry)
    units = {path.lower(): parameter.unit for path, parameter in circuit.parameters.items()}
    overrides, source = {}, None
    for path, value in changes.items():
        if not isinstance(value, Waveform):
            overrides[path] = value_text(value, units[path.lower()])
        elif source is None:
            source = f"{path}={text_of(value)}" if len(driving_sources(circuit)) > 1 else text_of(value)
    return {"ok": True, "message": "", "overrides": overrides, "source": source, "set": f"{to}={name}" if to else name}


def in_scene(asked: Asked) -> tuple[list[dict[str, Any]], set[str], list[str]]:
    """What the page says of each set with a value in force, the paths that sets give, and sets that mean nothing."""
    circuit, given, lost = asked.circuit._with(sets={}), [], []
    for entry in asked.sets:
        try:
            name, to, changes = asked.base.remember(("set", entry), partial(_changes, asked.base, entry))
        except InputError as error:
            lost.append(f"set {entry!r}, which is left out: {error}")
            continue
        given.append((name, to))
        circuit = remembering(circuit, name, changes)
    force = in_force(circuit)
    said = [
        {"name": name, "to": to, "title": parameters(name).title, "caveat": parameters(name).not_claimed,
         "assumed": list(parameters(name).assumed), "changed": list(force[name][1])}
        for name, to in given
        if name in force and force[name][0]
    ]  # fmt: skip
    return said, {path.lower() for kept, _ in force.values() for path in kept}, lost


def before(circuit: Circuit) -> tuple[dict[str, Any], list[str]]:
    """What had been changed in a circuit before the page was opened, as the request's overrides, source and sets.

    With it go the names of replaced sources that it does not say: a request has one, and a recording or a function has
    no text.
    """
    known = {path.lower(): (path, parameter) for path, parameter in circuit.parameters.items()}
    given = {path.lower() for path in circuit.overrides}
    replaced = [e for e in circuit.elements if e.waveform is not None and e.name.lower() in given]
    texts = {e.name: text for e in replaced if (text := _source_text(circuit, e)) is not None}
    said = list(texts)[:1]
    overrides = {
        known[path][0]: value_text(known[path][1].value, known[path][1].unit)
        for path in sorted(given & set(known))
        if path.rpartition(".")[0] not in map(str.lower, said)
    }
    sets = ",".join(filter(None, (_entry(circuit, name) for name in circuit.sets)))
    found = {"overrides": overrides, "source": "".join(texts[name] for name in said), "sets": sets}
    return {key: value for key, value in found.items() if value}, [e.name for e in replaced if e.name not in said]


def _source_text(circuit: Circuit, element: Element) -> str | None:
    """The text of a source of now, as in `Asked.source`; None where the page has none for it."""
    assert element.waveform is not None
    for text in (text_of(element.waveform), circuit.overrides.get(element.name)):
        try:
            if text is not None and read_source(f"{element.name}={text}", circuit)[1] == element.waveform:
                return f"{element.name}={text}"
        except InputError:
            continue
    return None


def _entry(circuit: Circuit, name: str) -> str | None:
    """The set of that name as in `Asked.sets`: applied to all, or as narrowly as gives its values in the circuit."""
    values = circuit.sets[name]
    elements = dict.fromkeys(path.rpartition(".")[0] or path for path in values)
    inside = {e.rpartition(".")[0] for e in elements}
    for to in (None, *elements, *sorted(inside - {""}, key=len, reverse=True)):
        try:
            found = parameters(name).apply(circuit, to).sets[name]
        except InputError:
            continue
        if values == found or (to is not None and values.items() <= found.items()):
            return f"{to}={name}" if to else name
    return None


def _changes(circuit: Circuit, entry: str) -> tuple[str, str | None, dict[str, Any]]:
    """Name and element of a set as in `Asked.sets`, and what it gives to a circuit, by path."""
    to, _, name = (part.strip() for part in entry.rpartition("="))
    one = parameters(name)
    return one.name, to or None, dict(one.apply(circuit, to or None).sets[one.name])


_COAT = "Xcoat   drive top  area  LAYER d=1u eps_r=3.9 r=0.2meg"
_CONTACT = "alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000"
_GAP = f"Xgap    top   skin area  GAP   d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3\n+                              {_CONTACT}"
_DISPERSIVE = "Xskin   skin  0    area  SKIN_DISPERSIVE d=350u"


def _skin(frequency: str, node: str = "0") -> str:
    return f"Xskin   skin  {node:<4} area  SKIN  d=350u f={frequency}"


def _made(gap: str, **changes: str) -> str:
    """The line of the gap with other values."""
    for name, value in changes.items():
        head, _, rest = gap.partition(f" {name}=")
        gap = f"{head} {name}={value}{rest[len(rest.split()[0]) :]}"
    return gap


def _deck(title: str, *lines: str) -> str:
    return "\n".join([title, ".include fingerspice.lib", *lines, ".end", ""])


def _finger(title: str, source: str, skin: str, tran: str, *more: str, gap: str = _GAP) -> str:
    """Table 1's finger on one source."""
    return _deck(title, f"Vdrive  drive 0          {source}", *more, _COAT, gap, skin, f".tran {tran} uic")


@dataclass(frozen=True)
class Example:
    """One scene of the page's menu: a deck, and what the page asks for with it."""

    name: str  # Short name, which stands in the page's address
    # title, note: What the menu and the page say about it
    title: str
    note: str
    deck: str
    asked: dict[str, object] = field(default_factory=dict)  # Further keys of the request, as in `scene.scene`


_AMPLIFIER = _deck(
    "Finger behind an amplifier with a safety resistor, 5 kHz",
    "Vdrive  amp   0          SIN(0 200 5k)",
    "Rout    amp   drive      47k",
    "Ccable  drive 0          150p",
    *(_COAT, _GAP, _skin("5k"), ".tran 0.5u 1m uic"),
)
_UNGROUNDED = _finger(
    "User not grounded, 5 kHz", "SIN(0 200 5k)", _skin("5k", "body"), "0.5u 1m",
    "Rbody   body  far        1.5k", "Cbody   far   0          150p",
)  # fmt: skip
_TWO = _deck(
    "Two fingers on one screen, 5 kHz",
    "Vdrive  drive 0           SIN(0 200 5k)",
    ".subckt finger drive body area fn=0.5",
    *(_COAT, _made(_GAP, fn="{fn}"), _skin("5k", "body"), ".ends"),
    "Xfirm   drive body firm   finger fn=0.5",
    "Xlight  drive body light  finger fn=0.2",
    "Rbody   body  far         1.5k",
    "Cbody   far   0           150p",
    ".tran 0.5u 1m uic",
)
_TONES = _deck(
    "Two tones on a dispersive skin",
    "Vdrive  drive fast       SIN(0 120 100)",
    "Vfast   fast  0          SIN(0 80 5k)",
    *(_COAT, _GAP, _DISPERSIVE, ".tran 1u 30m uic"),
)


def _gap_of(finger: str) -> str:
    """The line of Table 1's gap with the values in which a named set of parameters differs from the normal finger."""
    normal, values = parameters("normal").values, parameters(finger).values
    changed = [v for path, v in values.items() if v.element == "gap" and v.value != normal[path].value]
    return _made(_GAP, **{v.parameter: spice_text(v.value) if v.unit else f"{v.value:g}" for v in changed})


EXAMPLES: tuple[Example, ...] = (
    Example("sine", "Sine, 100 Hz (Fig. 4, left)", "Table 1: the layers leak, and the force follows the sine.",
            _finger("Table 1, sine of 100 Hz", "SIN(0 200 100)", _skin("100"), "10u 50m")),
    Example("sine-5k", "Sine, 5 kHz (Fig. 4, right)", "At 5 kHz the capacitances divide the voltage.",
            _finger("Table 1, sine of 5 kHz", "SIN(0 200 5k)", _skin("5k"), "0.2u 1m")),
    Example("square", "Square wave, 100 Hz (Fig. 5, left)", "After each edge the gap's voltage leaks away.",
            _finger("Table 1, square wave of 100 Hz", "SQUARE(200 100)", _skin("100"), "10u 50m")),
    Example("square-5k", "Square wave, 5 kHz (Fig. 5, right)", "The force is nearly constant.",
            _finger("Table 1, square wave of 5 kHz", "SQUARE(200 5k)", _skin("5k"), "0.2u 1m")),
    Example("ungrounded", "User not grounded", "The body's capacitance to ground takes voltage.", _UNGROUNDED),
    Example("two-fingers", "Two fingers of one hand", "A firm and a light finger share a body that floats.", _TWO),
    Example("amplifier", "Amplifier's limit", "A safety resistor and the cable take voltage at high frequencies.",
            _AMPLIFIER),
    Example("tones", "Two tones, dispersive skin", "The skin's data at all frequencies, for two tones at once.", _TONES,
            {"periods": 3}),
    Example("am", "AM texture", "A carrier of 5 kHz whose envelope of 50 Hz is what the finger feels.",
            _finger("AM texture", "SIN(0 200 5k)", _skin("5k"), "2u 40m"),
            {"source": "AM(200 5k 50)", "periods": 2}),
    Example("click", "Click", "A damped sine of 250 Hz, where fingers feel best.",
            _finger("Click", "SIN(0 200 250 0 250)", _DISPERSIVE, "10u 40m")),
    Example("chirp", "Chirp, 20 Hz to 1 kHz", "All frequencies that fingers feel, one after the other.",
            _finger("Chirp", "CHIRP(150 20 1k 0.1)", _DISPERSIVE, "20u 0.1")),
    Example("bursts", "Bursts of 5 kHz", "Ten cycles every 10 ms: the finger feels 100 Hz.",
            _finger("Bursts of 5 kHz", "SIN(0 200 5k)", _DISPERSIVE, "5u 50m"), {"source": "BURST(200 5k 10 10m)"}),
    Example("wet", "Moist finger", "Sweat in the gap conducts: the set moist, whose leak and friction are assumed.",
            _finger("Moist finger, 100 Hz", "SIN(0 200 100)", _skin("100"), "10u 50m", gap=_gap_of("moist"))),
    Example("dry", "Dry finger", "The gap hardly leaks: the set dry, whose leak and friction are assumed.",
            _finger("Dry finger, 100 Hz", "SIN(0 200 100)", _skin("100"), "10u 50m", gap=_gap_of("dry"))),
    Example("fold", "Fold of the mobile law", "A thin gap under the mobile charge law: no solution, and why.",
            _finger("A gap of 10 nm under the law mobile", "SIN(0 200 100)", _skin("100"), "10u 50m",
                    gap=_made(_GAP, d="10n")), {"charge_law": "mobile"}),
)  # fmt: skip
"""The scenes of the menu, the first of which is shown at the start."""
