"""The explorer's example scenes, with which its page begins, and pictures of them and of decks."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fingerspice import __version__
from fingerspice.base.errors import FingerspiceWarning
from fingerspice.base.units import spice_text
from fingerspice.circuit.circuit import Circuit
from fingerspice.explorer.request import WAVEFORMS, Asked
from fingerspice.explorer.scene import before
from fingerspice.netlist.netlist import read_netlist
from fingerspice.plots.drawing import save
from fingerspice.results.solution import Solution
from fingerspice.sets.parameters import parameters
from fingerspice.solve.simulation import simulate


class Example(NamedTuple):
    """One scene of the page's menu: a deck, and what the page asks for with it."""

    name: str  # Short name, which stands in the page's address
    # title, note: What the menu and the page say about it
    title: str
    note: str
    deck: str
    asked: Mapping[str, object] = {}  # Further keys of the request, as in `scene.scene`


_COAT = "Xcoat   drive top  area  LAYER d=1u eps_r=3.9 r=0.2meg"
_DISPERSIVE = "Xskin   skin  0    area  SKIN_DISPERSIVE d=350u"


def _skin(frequency: str, node: str = "0") -> str:
    return f"Xskin   skin  {node:<4} area  SKIN  d=350u f={frequency}"


def _gap(*, d: str = "3.5u", r: str = "1meg", fn: str = "0.5", mu: str = "0.3") -> str:
    return (
        f"Xgap    top   skin area  GAP   d={d} eps_r=1 r={r} fn={fn} mu={mu}\n"
        "+                              alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000"
    )


def _gap_of(finger: str) -> str:
    """The gap of Table 1 with the values in which a named set of parameters differs from the normal finger."""
    normal, values = parameters("normal").values, parameters(finger).values
    changed = [v for path, v in values.items() if v.element == "gap" and v.value != normal[path].value]
    return _gap(**{v.parameter: spice_text(v.value) if v.unit else f"{v.value:g}" for v in changed})


def _deck(title: str, *lines: str) -> str:
    return "\n".join([title, ".include fingerspice.lib", *lines, ".end", ""])


def _finger(title: str, source: str, skin: str, tran: str, *more: str, gap: str = "") -> str:
    """Table 1's finger on one source."""
    return _deck(title, f"Vdrive  drive 0          {source}", *more, _COAT, gap or _gap(), skin, f".tran {tran} uic")


_AMPLIFIER = _deck(
    "Finger behind an amplifier with a safety resistor, 5 kHz",
    "Vdrive  amp   0          SIN(0 200 5k)",
    "Rout    amp   drive      47k",
    "Ccable  drive 0          150p",
    *(_COAT, _gap(), _skin("5k"), ".tran 0.5u 1m uic"),
)
_UNGROUNDED = _finger(
    "User not grounded, 5 kHz", "SIN(0 200 5k)", _skin("5k", "body"), "0.5u 1m",
    "Rbody   body  far        1.5k", "Cbody   far   0          150p",
)  # fmt: skip
_TWO = _deck(
    "Two fingers on one screen, 5 kHz",
    "Vdrive  drive 0           SIN(0 200 5k)",
    ".subckt finger drive body area fn=0.5",
    *(_COAT, _gap(fn="{fn}"), _skin("5k", "body"), ".ends"),
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
    *(_COAT, _gap(), _DISPERSIVE, ".tran 1u 30m uic"),
)
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
                    gap=_gap(d="10n")), {"charge_law": "mobile"}),
)  # fmt: skip
"""The scenes of the menu, the first of which is shown at the start."""


def beginning(circuit: Circuit | None, asked: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """What the page needs first: its menus, and the scene to begin with."""
    examples = [
        {"name": e.name, "title": e.title, "note": e.note, "request": {"deck": e.deck, **e.asked}} for e in EXAMPLES
    ]
    own = None
    if circuit is not None:
        changed, unsaid = before(circuit)
        own = {"title": circuit.title, "request": {"deck": circuit.text, **changed, **(asked or {})}, "unsaid": unsaid}
    waveforms = [
        {"kind": kind, "title": title, "arguments": [a._asdict() for a in arguments]}
        for kind, (title, arguments) in WAVEFORMS.items()
    ]
    sets = [{"name": one.name, "kind": one.kind, "title": one.title} for one in parameters().values()]
    return {"version": __version__, "own": own, "examples": examples, "waveforms": waveforms, "sets": sets}


class Entry(NamedTuple):
    """One picture of the gallery."""

    name: str  # Of its file, without the suffix
    # title, about: What it shows, in a line, and the comment of the deck or the note of the scene
    title: str
    about: str
    origin: Path  # File that it is drawn from
    run: Callable[[], Solution]  # Runs it


def decks(folder: Path) -> Iterator[Entry]:
    """The decks of a folder; their comments explain them."""
    for path in sorted(folder.glob("*.cir")):
        lines = path.read_text(encoding="utf-8").splitlines()
        end = lines.index(".include fingerspice.lib") if ".include fingerspice.lib" in lines else len(lines)
        comments = [line[1:].strip() for line in lines[1:end] if line[:1] == "*"]
        about = re.split(r"Layers(?:,| and) contact|SI units|V\(area\)|In ngspice|Charge law:", " ".join(comments))[0]
        title = re.sub(r"Fingerpad on a (3M-coated )?touchscreen,? (with )?", "", lines[0]) or path.stem
        title = title[0].upper() + title[1:]
        yield Entry(path.stem, title, about.strip(), path, partial(lambda path: simulate(read_netlist(path)), path))


def scenes() -> Iterator[Entry]:
    """The example scenes of the explorer."""
    for one in EXAMPLES:
        yield Entry(f"scene-{one.name}", one.title, one.note, Path(__file__), partial(_run_scene, one))


def _run_scene(example: Example) -> Solution:
    asked = Asked({"deck": example.deck, **example.asked})
    first, stop, _ = asked.times
    times = np.linspace(first, stop, 4001)
    return simulate(asked.circuit, t_stop=stop, t_eval=times, charge_law=asked.charge_law, throw=False)


def draw(entry: Entry, picture: Path) -> None:
    """Run an entry, and draw source, gap voltage and friction."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FingerspiceWarning)
        save(entry.run().plot(("u_source", "u_gap", "f_t")), picture, dpi=110.0)
