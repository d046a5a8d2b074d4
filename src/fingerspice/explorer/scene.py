"""Scenes of the explorer, without any state: what a request gives, its text as deck or Python, examples, pictures."""

from __future__ import annotations

import dataclasses
import math
import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import fingerspice as fs
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Element, Tran
from fingerspice.circuit.describe import in_force, remembering
from fingerspice.circuit.statespace import driving_sources
from fingerspice.explorer.request import MENUS, WAVEFORMS, Asked, quiet, read_source, sliders, text_of, value_text
from fingerspice.plots.drawing import save
from fingerspice.results.record import SIGNALS
from fingerspice.waveforms.waveform import refuse

MOST_TRACES, HARMONICS = 8, 20  # Traces of each kind, and harmonics
LONGEST_RUN = 10.0  # Longest time of a run after its compilation, s
_SHOWN = ("u_source", "u_gap", "f_el", "area", "friction")
_WITHOUT_GAP = ("u_source", "u_layer", "v", "area")
_FIGURES = ("mean", "max", "min", "mean_periodic")


def scene(given: dict[str, Any], own: fs.Circuit | None = None) -> dict[str, Any]:
    """Run what the page asks for, for the circuit `own` if the page was opened for it, which stands for its own text.

    The keys of the request are those of `request.Asked`; only ``deck`` is needed. The answer has ``ok``, ``status``
    and ``message``; ``sliders``, ``sets``, ``waveform`` (text), ``warnings`` and ``unknown``; of a run ``t`` and
    ``traces`` (arrays in SI units), ``figures``, ``error``, ``plan``, ``harmonics``, ``stacks``, ``period``, ``t_stop``
    and ``failed_at``. A request that is refused, or a run that fails, says why in ``message``; neither raises an
    exception.
    """
    traces, rest = parts(given, own)
    return traces | rest


def parts(given: dict[str, Any], own: fs.Circuit | None = None) -> Iterator[dict[str, Any]]:
    """The answer of `scene` without ``figures``, ``harmonics`` and ``stacks``, to be drawn at once, and then these."""
    answer: dict[str, Any] = {"ok": False, "status": "BAD_INPUT", "message": "", "sliders": [], "traces": []}
    solution = None
    with _noticing(answer):
        try:
            asked = Asked(given, own)
            sets, _, without = in_scene(asked)
            answer |= {
                "title": asked.circuit.title, "sliders": sliders(asked.base, asked.circuit), "sets": sets,
                "unknown": [*asked.unknown, *without],
            }  # fmt: skip
            answer["waveform"] = text_of(asked.waveform)
            solution = _shown(asked)
            answer |= _traces(asked, solution)
        except InputError as error:
            answer["message"] = str(error)
        except fs.SolveError as error:
            answer |= {"status": error.failure.status.name, "message": error.message, "failed_at": error.failure.t}
        except MemoryError:
            answer["message"] = "not enough memory for this scene; allowed: fewer periods or elements"
    yield answer
    rest = {"warnings": answer["warnings"]}
    if solution is not None and answer["ok"]:
        with _noticing(rest):
            rest |= {
                "figures": [
                    {key: trace[key] for key in ("name", "label", "element", "unit")}
                    | {figure: solution._figure(trace["name"], figure) for figure in _FIGURES}
                    for trace in answer["traces"]
                ],
                "harmonics": _harmonics(solution, answer["period"]),
                "stacks": _stacks(solution),
            }
    yield rest


@contextmanager
def _noticing(answer: dict[str, Any]) -> Iterator[None]:
    """Add the warnings that are given inside to those of an answer, each once."""
    with warnings.catch_warnings(record=True, action="ignore") as noticed:
        warnings.simplefilter("always", FingerspiceWarning)
        yield
    answer["warnings"] = list(dict.fromkeys([*answer.get("warnings", ()), *(str(w.message) for w in noticed)]))


def deadline() -> Callable[[float], None]:
    """A `progress` function that ends a run which takes too long; compiling, before the first call, does not count."""
    begin = math.inf

    def check(done: float) -> None:
        nonlocal begin
        begin = min(begin, now := time.monotonic())
        problem = f"the run was stopped after {LONGEST_RUN:g} s at {100.0 * done:.3g} % of its length"
        refuse(now - begin > LONGEST_RUN, f"{problem}; allowed: fewer periods, or a larger error")

    return check


def _shown(asked: Asked) -> fs.Solution:
    """The run that is asked for, with outputs where it is shown."""

    def run(first: float, last: float) -> fs.Solution:
        times = np.linspace(first, last, asked.points(first, last)[0])
        return fs.simulate(
            asked.circuit, t_stop=stop, t_eval=times, charge_law=asked.charge_law, area=asked.area, rtol=asked.rtol,
            charge=False, throw=False, progress=deadline(),
        )  # fmt: skip

    first, stop, _ = asked.times
    solution = run(first, stop)
    if solution.failure is not None and solution.failure.t and solution.t.size < 2:
        # The run has failed before the part of it that is shown: then what there is of it is shown.
        solution = run(0.0, solution.failure.t)
    return solution


def _traces(asked: Asked, solution: fs.Solution) -> dict[str, Any]:
    """The first part of an answer, as far as a run gives it: each column of a signal is one trace."""
    first, stop, period = asked.times
    too_few, error = asked.points(first, stop)[1], solution.error
    voltage, force = format_si(error.u_gap, "V", 2), format_si(error.f_el, "N", 2)
    said = f"{voltage} in the gap voltage, {force} in the force" if solution.gaps else f"{voltage} in the voltages"
    traces = [
        {"name": name, "signal": key, "element": name.partition(":")[2], "unit": SIGNALS[key][0],
         "label": SIGNALS[key][1], "values": values}
        for key in (_SHOWN if solution.gaps else _WITHOUT_GAP)
        for name, values in list(solution.by_name(key).items())[:MOST_TRACES]
    ]  # fmt: skip
    return {
        "ok": solution.success, "status": solution.status.name, "message": solution.message, "t": solution.t,
        "traces": traces, "warnings": [*solution.warnings, *filter(None, [too_few])], "period": period, "t_stop": stop,
        "frequency": None if solution.fundamental is None else solution.fundamental.frequency,
        "charge_law": solution.charge_law, "method": solution.method, "area": solution.area_mode,
        "error": {"u_gap": error.u_gap, "f_el": error.f_el, "text": f"stated error {said}".replace(" u", " µ")},
        "plan": {"tier": solution.plan.tier, "text": "; ".join(solution.plan.reasons)},
        "failed_at": solution.failure.t if solution.failure is not None else None,
    }  # fmt: skip


def _stacks(solution: fs.Solution) -> list[dict[str, Any]]:
    """The layers on each contact area with their thickness and voltage, for the drawing of the stack."""
    stacks: dict[str, dict[str, Any]] = {}
    for name, values in solution.by_name("u_layer").items():
        e = solution.circuit[name.partition(":")[2]]
        stack = stacks.setdefault(e.nodes[2], {"gap": None, "layers": []})
        if e.device == "GAP":
            stack["gap"] = e.name
        stack["layers"].append({"name": e.name, "device": e.device, "d": e.values["d"], "values": values})
    return [stack for stack in stacks.values() if stack["gap"] is not None][:MOST_TRACES]


def _harmonics(solution: fs.Solution, period: float | None) -> list[dict[str, Any]]:
    """Amplitudes of the friction force at multiples of the source's frequency, for each gap."""
    if period is None or not solution.gaps:
        return []
    out = []
    for name in solution.by_name("f_t"):
        try:
            found = solution.spectrum(name, method="lines", highest=HARMONICS / period)
        except InputError:
            return []
        out.append(
            {"name": name, "element": name.partition(":")[2], "unit": "N", "frequency": found.frequency,
             "amplitude": found.amplitude, "mean": found.mean}
        )  # fmt: skip
    return out


@quiet()
def applied(given: dict[str, Any], own: fs.Circuit | None = None) -> dict[str, Any]:
    """What the set changes in the scene that a request names in its key ``apply``, as in `Asked.sets`.

    The answer has ``ok`` and ``message``; ``overrides`` (path to value as text), ``source`` (text, or None where the
    set is no drive) and ``set``, the set's entry in `Asked.sets`. `InputError` says why a set does not fit.
    """
    entry = given.get("apply") if isinstance(given, dict) else None
    if not isinstance(entry, str):
        raise InputError("apply: allowed: the name of a set, or ELEMENT=NAME")
    circuit = Asked(given, own).circuit
    name, to, changes = _changes(circuit, entry)
    units = {path.lower(): parameter.unit for path, parameter in circuit.parameters.items()}
    overrides, source = {}, None
    for path, value in changes.items():
        if not isinstance(value, fs.Waveform):
            overrides[path] = value_text(value, units[path.lower()])
        elif source is None:
            source = f"{path}={text_of(value)}" if len(driving_sources(circuit)) > 1 else text_of(value)
    return {"ok": True, "message": "", "overrides": overrides, "source": source, "set": f"{to}={name}" if to else name}


def in_scene(asked: Asked) -> tuple[list[dict[str, Any]], set[str], list[str]]:
    """What the page says of each set with a value in force, the paths that sets give, and sets that mean nothing."""
    circuit, given, lost = asked.circuit._with(sets={}), [], []
    for entry in filter(None, map(str.strip, asked.sets.split(","))):
        try:
            name, to, changes = asked.base.remember(("set", entry), partial(_changes, asked.base, entry))
        except InputError as error:
            lost.append(f"set {entry!r}, which is left out: {error}")
            continue
        given.append((name, to))
        circuit = remembering(circuit, name, changes)
    force = in_force(circuit)
    said = [
        {"name": name, "to": to, "title": fs.parameters(name).title, "caveat": fs.parameters(name).not_claimed,
         "assumed": list(fs.parameters(name).assumed), "changed": list(force[name][1])}
        for name, to in given
        if name in force and force[name][0]
    ]  # fmt: skip
    return said, {path.lower() for kept, _ in force.values() for path in kept}, lost


def before(circuit: fs.Circuit) -> tuple[dict[str, Any], list[str]]:
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


def _source_text(circuit: fs.Circuit, element: Element) -> str | None:
    """The text of a source of now, as in `Asked.source`; None where the page has none for it."""
    assert element.waveform is not None
    for text in (text_of(element.waveform), circuit.overrides.get(element.name)):
        try:
            if text is not None and read_source(f"{element.name}={text}", circuit)[1] == element.waveform:
                return f"{element.name}={text}"
        except InputError:
            continue
    return None


def _entry(circuit: fs.Circuit, name: str) -> str | None:
    """The set of that name as in `Asked.sets`: applied to all, or as narrowly as gives its values in the circuit."""
    values = circuit.sets[name]
    elements = dict.fromkeys(path.rpartition(".")[0] or path for path in values)
    inside = {e.rpartition(".")[0] for e in elements}
    for to in (None, *elements, *sorted(inside - {""}, key=len, reverse=True)):
        try:
            found = fs.parameters(name).apply(circuit, to).sets[name]
        except InputError:
            continue
        if values == found or (to is not None and values.items() <= found.items()):
            return f"{to}={name}" if to else name
    return None


def _changes(circuit: fs.Circuit, entry: str) -> tuple[str, str | None, dict[str, Any]]:
    """Name and element of a set as in `Asked.sets`, and what it gives to a circuit, by path."""
    to, _, name = (part.strip() for part in entry.rpartition("="))
    one = fs.parameters(name)
    return one.name, to or None, dict(one.apply(circuit, to or None).sets[one.name])


_LONGEST_EXPORT = 20_000_000  # Characters of an exported deck beyond which the page does not take it
_RTOL = 1e-5  # Largest error of the means against frequency: a picture shows no more
_AS_CODE = re.compile(r"\b([A-Z][A-Za-z]*)\(")
_DISPERSIVE = """\
def dispersive(e):
    return dataclasses.replace(e, device="SKIN_DISPERSIVE", values={"d": e.values["d"]}) if e.device == "SKIN" else e


circuit = dataclasses.replace(circuit, elements=tuple(map(dispersive, circuit.elements)))"""


@quiet()
def as_deck(given: dict[str, Any], own: fs.Circuit | None = None) -> str:
    """The scene as one deck that fingerspice and ngspice run, with the length of the page's run and its outputs."""
    asked = Asked(given, own)
    circuit, (first, stop, _) = asked.circuit, asked.times
    step = (stop - first) / asked.points(first, stop)[0]
    tran = Tran(step, stop, uic=circuit.tran is None or circuit.tran.uic)
    text = fs.export_netlist(dataclasses.replace(circuit, tran=tran), charge_law=asked.charge_law)
    if len(text) > _LONGEST_EXPORT:
        raise InputError(f"the deck would have {len(text):,} characters; allowed: at most {_LONGEST_EXPORT:,}")
    return text


@quiet()
def as_python(given: dict[str, Any], own: fs.Circuit | None = None) -> str:
    """The scene as Python that gives the page's solution."""
    asked = Asked(given, own)
    sets, by_sets, _ = in_scene(asked)
    first, stop, _ = asked.times
    name, waveform = asked.replaced or ("", None)
    lines = ["import dataclasses", "", "import numpy as np", "", "import fingerspice as fs", ""]
    # The values changed before the page was opened are those of the user's own circuit.
    known = {path.lower(): one.value for path, one in asked.base.parameters.items()}
    if asked.base.path is not None:
        lines.append(f"circuit = fs.read_netlist({str(asked.base.path)!r})")
    else:
        deck = [f"    {line!r}" for line in asked.deck.splitlines(keepends=True)]
        lines += ["circuit = fs.parse_netlist(", *deck, ")"]
    lines += [
        f"# Changed before, in Python: {path} = {' '.join(text.split())}"
        for path, text in asked.base.overrides.items()
        if path.lower() not in (*known, name.lower())
    ]
    if asked.skin == "dispersive":
        lines += _DISPERSIVE.splitlines()
    for one in sets:
        to = f", {one['to']!r}" if one["to"] else ""
        lines.append(f"circuit = fs.parameters({one['name']!r}).apply(circuit{to})")
    if waveform is not None and name.lower() not in by_sets:
        code = _AS_CODE.sub(r"fs.\1(", repr(waveform))
        if asked.recording is not None and asked.gain is not None:
            code = asked.recording.python(asked.gain)
        lines.append(f"circuit = circuit.replace({{{name!r}: {code}}})")
    before = {path: known[path.lower()] for path in asked.base.overrides if path.lower() in known}
    changes = {**before, **asked.overrides}
    changes = {path: x for path, x in changes.items() if path.lower() not in by_sets}
    if asked.skin == "follow":
        changes |= {f"{e.name}.f": e.values["f"] for e in asked.circuit.by_device("SKIN")}
    if changes:
        numbers = {path: 'float("inf")' if x == math.inf else repr(x) for path, x in changes.items()}
        inside = ", ".join(f"{path!r}: {number}" for path, number in numbers.items())
        lines.append(f"circuit = circuit.replace({{{inside}}})")
    lines += [
        "solution = fs.simulate(",
        f"    circuit, t_stop={stop!r}, t_eval=np.linspace({first!r}, {stop!r}, {asked.points(first, stop)[0]}),",
        f"    charge_law={asked.charge_law!r}, area={asked.area!r}, rtol={asked.rtol!r},",
        *(")", "print(solution)", ""),
    ]
    return "\n".join(lines)


@quiet()
def means(given: dict[str, Any], own: fs.Circuit | None = None) -> dict[str, Any]:
    """Mean force of the periodic state under sines of the source's amplitude, at frequencies that the request names.

    Its key ``frequencies`` (Hz) has at most 16. The answer has ``ok`` and ``message``; ``frequency`` and ``force`` (Hz
    and N, arrays), and ``gap`` and ``amplitude``, in words. `InputError` and `SolveError` say why there is none.
    """
    frequencies = given.get("frequencies") if isinstance(given, dict) else None
    good = isinstance(frequencies, list) and 0 < len(frequencies) <= 16
    if not good or not all(isinstance(x, (int, float)) and 1e-2 <= x <= 1e6 for x in frequencies or ()):
        raise InputError("frequencies: allowed: a list of at most 16 numbers from 0.01 to 1e6 Hz")
    asked = Asked(given, own)
    gaps, wave = asked.circuit.by_device("GAP"), asked.waveform
    refuse(not gaps, "the circuit has no GAP, and so no force")
    if wave.fundamental is None:
        raise InputError("the source has no one amplitude that sines could have; allowed: a periodic source")
    (found,) = fs.large_signal(
        asked.circuit, np.asarray(frequencies, float), charge_law=asked.charge_law, finger=gaps[0].name,
        rtol=max(asked.rtol, _RTOL), progress=deadline(),
    )  # fmt: skip
    amplitude = format_si(float(np.max(found.amplitude)), "V")
    if not (isinstance(wave, fs.Sine) and wave.offset == 0.0):
        amplitude += ", the source's fundamental,"
    return {
        "ok": True, "message": "", "frequency": found.frequency, "force": found.f_el_mean, "gap": gaps[0].name,
        "amplitude": amplitude,
    }  # fmt: skip


EXAMPLES = MENUS["scene"]  # The first of them is shown at the start


def beginning(circuit: fs.Circuit | None, asked: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """What the page needs first: its menus, and the scene to begin with."""
    own = None
    if circuit is not None:
        changed, unsaid = before(circuit)
        own = {"title": circuit.title, "request": {"deck": circuit.text, **changed, **(asked or {})}, "unsaid": unsaid}
    sets = [{"name": one.name, "kind": one.kind, "title": one.title} for one in fs.parameters().values()]
    waveforms = [*WAVEFORMS.values()]
    return {"version": fs.__version__, "own": own, "examples": EXAMPLES, "waveforms": waveforms, "sets": sets}


def shown_runs(folder: Path) -> dict[str, Callable[[], fs.Solution]]:
    """What makes the runs of the gallery's pictures, by name: the decks of a folder, and the example scenes."""

    def deck(path: Path) -> fs.Solution:
        return fs.simulate(fs.read_netlist(path))

    def example(request: dict[str, Any]) -> fs.Solution:
        return _shown(Asked(request))

    decks = {path.stem: partial(deck, path) for path in sorted(folder.glob("*.cir"))}
    return {**decks, **{f"scene-{one['name']}": partial(example, one["request"]) for one in EXAMPLES}}


def draw(run: Callable[[], fs.Solution], picture: Path) -> None:
    """Draw source, gap voltage and friction of what `run` gives."""
    with warnings.catch_warnings(action="ignore", category=FingerspiceWarning):
        save(run().plot(("u_source", "u_gap", "f_t")), picture, dpi=110.0)
