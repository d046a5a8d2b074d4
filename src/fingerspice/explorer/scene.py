"""One scene of the explorer, without any state: traces, figures, sentences, and its text as a deck or as Python."""

from __future__ import annotations

import dataclasses
import math
import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from fingerspice import __version__
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit, Tran
from fingerspice.circuit.describe import in_force
from fingerspice.explorer import changed, sliders
from fingerspice.explorer.examples import EXAMPLES
from fingerspice.explorer.request import Request, circuits_of, points_of, request_of, times_of, waveform_of
from fingerspice.results.outcome import SolveError
from fingerspice.results.signals import SIGNALS
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import simulate
from fingerspice.studies.comparison import large_signal
from fingerspice.studies.export import export_netlist
from fingerspice.waveforms.waveform import Sine

#: Traces of each kind, and harmonics.
MOST_TRACES, HARMONICS = 8, 20
#: Longest time of a run after its compilation, s.
LONGEST_RUN = 10.0
_SHOWN = ("u_source", "u_gap", "f_el", "area", "friction")
_WITHOUT_GAP = ("u_source", "u_layer", "v", "area")
_FIGURES = ("mean", "max", "min", "mean_periodic")


def scene(given: dict[str, Any], own: Circuit | None = None) -> dict[str, Any]:
    """Run what the page asks for, for the circuit `own` if the page was opened for it, which stands for its own text.

    The keys of the request are those of `request.Request`; only ``deck`` is needed. The answer has ``ok``, ``status``
    and ``message``; ``sliders``, ``sets``, ``waveform`` (text), ``warnings`` and ``unknown``; of a run ``t`` and
    ``traces`` (arrays in SI units), ``figures``, ``error``, ``plan``, ``harmonics``, ``stacks``, ``period``, ``t_stop``
    and ``failed_at``. A request that is refused, or a run that fails, says why in ``message``; neither raises an
    exception.
    """
    traces, rest = parts(given, own)
    return traces | rest


def beginning(circuit: Circuit | None, asked: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """What the page needs first: its menus, and the scene to begin with."""
    examples = [
        {"name": e.name, "title": e.title, "note": e.note, "request": {"deck": e.deck, **e.asked}} for e in EXAMPLES
    ]
    own = None
    if circuit is not None:
        before = changed.before(circuit)
        asked = {"deck": circuit.text, **before, **(asked or {})}
        own = {"title": circuit.title, "request": asked, "unsaid": changed.unsaid(circuit)}
    return {
        "version": __version__,
        "own": own,
        "examples": examples,
        "waveforms": sliders.menu(),
        "sets": changed.menu(),
    }


def parts(given: dict[str, Any], own: Circuit | None = None) -> Iterator[dict[str, Any]]:
    """The answer of `scene` but for ``figures``, ``harmonics`` and ``stacks``, and then these.

    The traces can be drawn while the figures are computed, which takes longer than the run.
    """
    answer: dict[str, Any] = {"ok": False, "status": "BAD_INPUT", "message": "", "sliders": [], "traces": []}
    more: Callable[[], dict[str, Any]] = dict
    with _noticing(answer):
        try:
            request = request_of(given)
            base, circuit, lost = circuits_of(request, own)
            circuit, without = changed.marked(circuit, base, request)
            answer |= {
                "title": circuit.title, "sliders": sliders.sliders(base, circuit),
                "sets": changed.sentences(circuit, request), "unknown": [*request.unknown, *lost, *without],
            }  # fmt: skip
            answer["waveform"] = sliders.text_of(waveform_of(circuit))
            run, more = _run(circuit, request)
            answer |= run
        except InputError as error:
            answer["message"] = str(error)
        except SolveError as error:
            answer |= {"status": error.failure.status.name, "message": error.message, "failed_at": error.failure.t}
        except MemoryError:
            answer["message"] = "not enough memory for this scene; allowed: fewer periods or elements"
    yield answer
    rest = {"warnings": answer["warnings"]}
    with _noticing(rest):
        rest |= more()
    yield rest


@contextmanager
def _noticing(answer: dict[str, Any]) -> Iterator[None]:
    """Add the warnings that are given inside to those of an answer, each once."""
    with warnings.catch_warnings(record=True) as noticed:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", FingerspiceWarning)
        yield
    said = [*answer.get("warnings", ()), *(str(w.message) for w in noticed)]
    answer["warnings"] = list(dict.fromkeys(said))


def deadline(seconds: float = LONGEST_RUN) -> Callable[[float], None]:
    """A `progress` function that ends a run which takes longer; compiling, before the first call, does not count."""
    begin: list[float] = []

    def check(done: float) -> None:
        begin.append(time.monotonic())
        if begin[-1] - begin[0] > seconds:
            raise InputError(
                f"the run was stopped after {seconds:g} s at {100.0 * done:.3g} % of its length; allowed: fewer "
                "periods, or a larger error"
            )
        del begin[1:]

    return check


def _run(circuit: Circuit, request: Request) -> tuple[dict[str, Any], Callable[[], dict[str, Any]]]:
    """The part of an answer that a run gives, in the two parts of `parts`."""
    first, stop, period = times_of(circuit, request)
    solution = _simulated(circuit, request, stop, first, stop)
    if solution.failure is not None and solution.failure.t and solution.t.size < 2:
        # The run has failed before the part of it that is shown: then what there is of it is shown.
        solution = _simulated(circuit, request, stop, 0.0, solution.failure.t)
    _, too_few = points_of(circuit, first, stop)
    cautions = [*solution.warnings, *([too_few] if too_few else [])]
    keys = _SHOWN if solution.gaps else _WITHOUT_GAP
    traces = [one for key in keys for one in _traces(solution, key)]
    answer: dict[str, Any] = {
        "ok": solution.success, "status": solution.status.name, "message": solution.message, "t": solution.t,
        "traces": traces, "warnings": cautions, "period": period, "t_stop": stop,
        "frequency": None if solution.fundamental is None else solution.fundamental.frequency,
        "charge_law": solution.charge_law, "method": solution.method, "area": solution.area_mode,
        "error": {"u_gap": solution.error.u_gap, "f_el": solution.error.f_el, "text": _error_text(solution)},
        "plan": {"tier": solution.plan.tier, "text": "; ".join(solution.plan.reasons)},
        "failed_at": solution.failure.t if solution.failure is not None else None,
    }  # fmt: skip
    if not solution.success:
        return answer, dict
    return answer, lambda: {
        "figures": _figures(solution, traces), "harmonics": _harmonics(solution, period), "stacks": _stacks(solution)
    }  # fmt: skip


def _simulated(circuit: Circuit, request: Request, stop: float, first: float, last: float) -> Solution:
    """A run to `stop` as the page asks for it, with outputs between two times (all in s)."""
    times = np.linspace(first, last, points_of(circuit, first, last)[0])
    return simulate(
        circuit, t_stop=stop, t_eval=times, charge_law=request.charge_law, area=request.area, rtol=request.rtol,
        charge=False, throw=False, progress=deadline(),
    )  # fmt: skip


def _traces(solution: Solution, key: str) -> list[dict[str, Any]]:
    """The columns of a signal, each as one trace."""
    unit, label = SIGNALS[key][:2]
    return [
        {"name": name, "signal": key, "element": name.partition(":")[2], "unit": unit, "label": label, "values": values}
        for name, values in list(solution.by_name(key).items())[:MOST_TRACES]
    ]


def _stacks(solution: Solution) -> list[dict[str, Any]]:
    """The layers on each contact area with their thickness and voltage, for the drawing of the stack."""
    stacks: dict[str, dict[str, Any]] = {}
    voltages = solution.by_name("u_layer")
    for name in solution.layers:
        e = solution.circuit[name]
        stack = stacks.setdefault(e.nodes[2], {"gap": None, "layers": []})
        if e.device == "GAP":
            stack["gap"] = name
        values = voltages[f"u_layer:{name}"]
        stack["layers"].append({"name": name, "device": e.device, "d": e.values["d"], "values": values})
    return [stack for stack in stacks.values() if stack["gap"] is not None][:MOST_TRACES]


def _error_text(solution: Solution) -> str:
    error = solution.error
    voltage, force = format_si(error.u_gap, "V", 2), format_si(error.f_el, "N", 2)
    said = f"{voltage} in the gap voltage, {force} in the force" if solution.gaps else f"{voltage} in the voltages"
    return f"stated error {said}".replace(" u", " µ")


def _figures(solution: Solution, traces: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean, largest and smallest value of each trace's signal over the run, and the mean over the last period."""
    return [
        {key: trace[key] for key in ("name", "label", "element", "unit")}
        | {figure: solution._figures.value(trace["name"], figure) for figure in _FIGURES}
        for trace in traces
    ]


def _harmonics(solution: Solution, period: float | None) -> list[dict[str, Any]]:
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
    """The scene as one deck that fingerspice and ngspice run, with the length of the page's run and its outputs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        request = request_of(given)
        _, circuit, _ = circuits_of(request, own)
        first, stop, _ = times_of(circuit, request)
        step = (stop - first) / points_of(circuit, first, stop)[0]
        tran = Tran(step, stop, uic=circuit.tran is None or circuit.tran.uic)
        text = export_netlist(dataclasses.replace(circuit, tran=tran), charge_law=request.charge_law)
    if len(text) > _LONGEST_EXPORT:
        raise InputError(f"the deck would have {len(text):,} characters; allowed: at most {_LONGEST_EXPORT:,}")
    return text


def as_python(given: dict[str, Any], own: Circuit | None = None) -> str:
    """The scene as Python that gives the page's solution."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        request = request_of(given)
        base, circuit, _ = circuits_of(request, own)
        circuit, _ = changed.marked(circuit, base, request)
        first, stop, _ = times_of(circuit, request)
    by_sets = {path.lower() for kept, _ in in_force(circuit).values() for path in kept}
    name, waveform = sliders.read_source(request.source, base, request.recording) if request.source else ("", None)
    lines, changes = _beginning(request.deck, own, name)
    if request.skin == "dispersive":
        lines += _DISPERSIVE.splitlines()
    for one, to in changed.entries(circuit, request):
        lines.append(f"circuit = fs.parameters({one!r}).apply(circuit{'' if to is None else f', {to!r}'})")
    if waveform is not None and name.lower() not in by_sets:
        gain = sliders.gain_of(request.source)
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


def means(given: dict[str, Any], own: Circuit | None = None) -> dict[str, Any]:
    """Mean force of the periodic state under sines of the source's amplitude, at frequencies that the request names.

    Its key ``frequencies`` (Hz) has at most 16. The answer has ``ok`` and ``message``; ``frequency`` and ``force`` (Hz
    and N, arrays), and ``gap`` and ``amplitude``, in words.
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
