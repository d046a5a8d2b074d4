"""Export of a circuit as one self-contained ngspice deck, and comparison with the raw file of another simulator."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.describe import require_circuit
from fingerspice.circuit.laws import acting_law
from fingerspice.circuit.network import network_of
from fingerspice.circuit.statespace import beside_gap, find_branches
from fingerspice.netlist.reader import LIBRARIES, shipped_text
from fingerspice.physics.contact import Contact, JkrContact, LawContact
from fingerspice.plots import drawing
from fingerspice.results.measures import areas_of, currents_of
from fingerspice.results.rawfile import Raw, read_raw
from fingerspice.results.solution import Solution
from fingerspice.solve.problem import prepare
from fingerspice.solve.simulation import simulate
from fingerspice.solve.starting import start_voltage, starts_uncharged
from fingerspice.studies.steps import places, scene_of
from fingerspice.waveforms.periodic import PWL, Pulse
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import DC, Exp, Sine, Waveform, refuse, require

EDGE = 1e-9
"""Rise time (s) of an ideal jump in the export, since ngspice has none; a thousandth of TSTEP if that is shorter."""
NOW = 1e-30
"""Time (s) that is written for 0, because ngspice takes 0 for "not given"."""

# Found by tests with ngspice 39. At an edge ngspice's step control reduces the step until the run fails; a large trtol
# switches it off, so that TMAX (by default TSTEP) sets the accuracy. Inside a capacitor C='...' an auxiliary current of
# du/dt (in A) flows. At a constant voltage that is round-off divided by the step, about 1e-6 in the first steps and
# thus above the usual abstol of 1e-12. The last of several .options lines counts, so this one follows the library.
_OPTIONS = ".options reltol=1e-4 trtol=1e4 abstol=1e-4"

# Points per shortest time scale of a waveform: between them, a sine is off by 5e-6 of its amplitude. Most points of a
# source, and how many are few.
_DENSITY, _MOST, _FEW = 1000, 2_000_000, 1000
_MOST_STEPS = 200  # Runs of steps in one deck
# Error of the areas of another contact law than the paper's, relative; parameters of a GAP beside such a table.
_OF_TABLE, _OF_TABLES = 1e-6, ("d", "eps_r", "r", "a_fix", "tau")


def export_netlist(circuit: Circuit, *, charge_law: str | None = None) -> str:
    """A deck that ngspice 39 runs without other files.

    The deck contains the devices' subcircuits, numbers in place of parameters, and PWL for sources that ngspice lacks.
    The runs of `.step`, which ngspice lacks, stand side by side: names of the first one end in ``_1``.

    Parameters
    ----------
    circuit : Circuit
    charge_law : str, optional
        ``"local"`` or ``"mobile"``; the circuit's own by default.

    Raises
    ------
    InputError
        If a source has to be written as points and the circuit has no .tran line, if two names would become equal, or
        if there are too many steps.
    """
    require_circuit(circuit)
    circuit, stepped = _side_by_side(circuit) if circuit.steps else (circuit, [])
    law = charge_law or circuit.charge_law or "local"
    require(law in LIBRARIES, "charge_law", repr(law), " or ".join(map(repr, LIBRARIES)))
    nodes = {n: _name(n) for e in circuit.elements for n in e.node_names}
    for names in (nodes, {e.name: _element_name(e) for e in circuit.elements}):
        seen: dict[str, str] = {}
        for name in sorted(names):
            other = seen.setdefault(names[name].lower(), name)
            if other.lower() != name.lower():
                raise InputError(f"{other} and {name} would be one name in the export; allowed: rename one of them")
    network = network_of(circuit)
    contacts = dict(network.named_contacts)
    beyond = "a GAP whose height, or leak, follows its voltage is not written for ngspice"
    refuse(network.owned, f"{beyond}; allowed: another contact law, and r_exp=0")
    areas = _start_areas(circuit, law, contacts)
    ratio = max((one.work_ratio for one in contacts.values() if isinstance(one, JkrContact)), default=1.0)
    lines = [circuit.title or "fingerspice export"]
    lines.append(f"* Written by fingerspice; charge law {law}. Run: ngspice -b -r out.raw FILE")
    if circuit.overrides:
        changed = ", ".join(f"{k} = {v}" for k, v in circuit.overrides.items())
        lines.append(f"* Changed from the deck: {' '.join(changed.split())}"[:1000])
    lines += stepped
    if circuit.measures or circuit.fourier:
        lines.append("* The deck's .meas and .four lines are left out.")
    for element in circuit.elements:
        for one in filter(None, (element, beside_gap(element))):
            text = _element_line(one, circuit, ratio, areas)
            lines += textwrap.wrap(text, 100, subsequent_indent="+ ", break_long_words=False, break_on_hyphens=False)
    for e in circuit.by_device("S"):
        values = " ".join(f"{key}={value!r}" for key, value in e.values.items())
        lines.append(f".model model_{_element_name(e)} SW({values})")
    if (tran := circuit.tran) is not None:
        more = (tran.start, tran.max_step) if tran.max_step else (tran.start,) if tran.start else ()
        lines.append(f".tran {' '.join(map(repr, (tran.step, tran.stop, *more)))}{' uic' if tran.uic else ''}")
    if (ac := circuit.ac) is not None:
        lines.append(f".ac {ac.scale} {ac.points} {ac.start!r} {ac.stop!r}")
    lines += _start_lines(circuit, areas, contacts)
    lines += ["", shipped_text(law).rstrip(), ""]
    for name, contact in contacts.items():
        if isinstance(contact, LawContact):
            reach = contact.reach(prepare(circuit, charge_law=law, charge=False).scene.u_top)
            lines += _table(_element_name(circuit[name]), contact, reach)
    lines += [_OPTIONS, ".end", ""]
    return "\n".join(lines)


def _side_by_side(circuit: Circuit) -> tuple[Circuit, list[str]]:
    """The circuit of all steps, with a number at the end of every name, and lines that say what each number is."""
    scenes, elements = places(circuit.steps), list[Element]()
    refuse(len(scenes) > _MOST_STEPS, f"{len(scenes):,} steps; allowed in an export: {_MOST_STEPS}")
    initial, lines = dict[str, float](), list[str]()
    for number, place in enumerate(scenes, 1):
        scene = scene_of(circuit, place)
        refuse(scene.tran != circuit.tran, "the steps change .tran; allowed in an export: steps of the same run")
        named = {node: node if node == "0" else f"{node}_{number}" for e in scene.elements for node in e.nodes}
        initial |= {named[node]: value for node, value in scene.initial.items()}
        for e in scene.elements:
            nodes = tuple(named[node] for node in e.nodes)
            written = tuple(
                w if node == "0" else f"{w}_{number}" for w, node in zip(e.node_names, e.nodes, strict=True)
            )
            elements.append(replace(e, name=f"{e.name}_{number}", nodes=nodes, node_names=written))
        lines.append(f"* _{number}: {', '.join(f'{one.name} = {value:g}' for one, value in place.items())}")
    return replace(circuit, elements=tuple(elements), initial=initial, measures=(), fourier=(), steps=()), lines


def _table(name: str, contact: LawContact, reach: float) -> list[str]:
    """A GAP's subcircuit of its own, in which the areas stand as points up to a gap voltage (V)."""
    for count in 2 ** np.arange(6, 13) + 1:
        u = np.linspace(0.0, reach, count)
        area = contact.area(u)
        # A line between every other point, where the left-out ones are known.
        if np.abs(0.5 * (area[:-2:2] + area[2::2]) / area[1::2] - 1.0).max() <= 4.0 * _OF_TABLE:
            break
    points = ", ".join(f"{x!r}, {y!r}" for x, y in zip(u.tolist(), (1e6 * area).tolist(), strict=True))
    wrapped = textwrap.wrap(
        f"Ba follow 0 V=a_fix > 0 ? a_fix : pwl(abs(V(p,n)), {points})", 100, subsequent_indent="+ "
    )
    head = f"* GAP with the contact law {contact.law}: its areas up to {reach:.4g} V, on straight lines between points."
    begin = f".subckt GAP_{name} p n area params: d=1u eps_r=1 r=inf a_fix=0 tau=0 ic=0 a_ic=0"
    layer = "Xg p n area LAYER d={d} eps_r={eps_r} r={r} ic={ic} a_ic={a_ic}"
    return [head, begin, layer, *wrapped, "Ra follow area 1", "Ca area 0 {a_fix > 0 ? 0 : tau}", ".ends", ""]


def _name(name: str) -> str:
    # In ngspice a dot in a name separates a subcircuit from its element, but this deck is flat: replace it. In the
    # library's formulas a bracket or an operator ends a name. A node named temper makes ngspice exit.
    return "temper_" if name.lower() == "temper" else re.sub(r"\W", "_", name)


def _element_name(element: Element) -> str:
    name = _name(element.name)
    letter = element.device if len(element.device) == 1 else "X"
    # ngspice takes the device from the name's first letter, which in a subcircuit's flat name is the X of the call.
    return name if name[0].upper() == letter else f"{letter}{name}"


def _start_areas(circuit: Circuit, law: str, contacts: Mapping[str, Contact]) -> dict[str, float]:
    """Area (mm^2) of each area node at the start of a run with ``uic``; empty for a run that starts otherwise."""
    out: dict[str, float] = {}
    if circuit.tran is None or not starts_uncharged(circuit):
        return out
    for area in find_branches(circuit)[0]:
        value = area.given
        if value is None and area.gap is not None:
            value = float(contacts[area.gap.name].area(abs(start_voltage(area.gap, circuit.initial))))
        assert value is not None
        out[area.node] = 1e6 * value
    if any(gap.values["tau"] > 0.0 for gap in circuit.by_device("GAP")):
        # Areas that follow with a delay start where the problem says.
        problem = prepare(circuit, charge_law=law, charge=False)
        net = problem.scene.net
        for area, place, area0 in zip(problem.network.areas, net.slow, net.area0, strict=True):
            if place >= 0:
                out[area.node] = 1e6 * float(problem.initial.y[net.k.shape[0] + place] * area0)
    return out


def _start_lines(circuit: Circuit, areas: Mapping[str, float], contacts: Mapping[str, Contact]) -> Iterator[str]:
    """Start values (.ic) and guesses (.nodeset) of nodes; with ``uic`` the layers' own lines hold start voltages."""
    written = {node: _name(name) for e in circuit.elements for node, name in zip(e.nodes, e.node_names, strict=True)}
    gaps = {gap.nodes[2]: gap for gap in circuit.by_device("GAP")}
    for node, value in circuit.initial.items():
        if node != "0" and node not in gaps:
            yield f".ic v({written[node]})={value!r}"
    for node, gap in gaps.items():
        contact, held = contacts[gap.name], circuit.initial.get(node)
        guess = gap.values["a_fix"] or 1e6 * float(contact.area(0.0))
        if areas:
            # An area with a delay is a state and needs a start value; for an area without delay a guess is enough.
            held, guess = areas[node] if gap.values["tau"] > 0.0 else None, areas[node]
        yield f"{'.nodeset' if held is None else '.ic'} v({written[node]})={guess if held is None else held!r}"
        if areas and circuit.initial and not gap.values["a_fix"] and isinstance(contact, JkrContact):
            # Without guesses for the nodes inside a GAP, ngspice's first Newton iteration fails at u != 0.
            u, name = start_voltage(gap, circuit.initial), _element_name(gap)
            y = float(contact.area_adhesive(u)) / (at_rest := float(contact.area_adhesive(0.0)))
            pull, area = float(contact.stress(u)) * at_rest / contact.f_n, 1e6 * float(contact.area(u))
            guesses = ("x", math.log(y)), ("y", y), ("v", pull), ("follow", area)
            yield ".nodeset " + " ".join(f"v({name}.{inner})={one!r}" for inner, one in guesses)


def _element_line(element: Element, circuit: Circuit, work_ratio: float, start_areas: Mapping[str, float]) -> str:
    head = f"{_element_name(element)} {' '.join(_name(n) for n in element.node_names)}"
    if element.waveform is not None:
        ac = "" if element.ac is None else f" AC {float(element.ac.magnitude)!r} {float(element.ac.phase_deg)!r}"
        return f"{head} {_source_text(element.waveform, element.name, circuit)}{ac}"
    if element.spec.cells is None:
        initial = f" IC={element.initial!r}" if element.initial is not None else ""
        if element.device == "S":
            return f"{head} {' '.join(_controls(element, circuit))} model_{_element_name(element)}"
        (value,) = element.values.values()
        return f"{head} {' '.join([*_controls(element, circuit), repr(value)])}{initial}"
    # Left out are what only a warning or the friction needs, and a CPE beside a gap, which is written for itself.
    left_out = ("p_sat", "slip", "v", "q", "n_cpe") if element.device == "GAP" else ("e_max",)
    tabled = element.device == "GAP" and acting_law(element) is not None
    written = [k for k in element.values if (k in _OF_TABLES if tabled else k not in left_out)]
    numbers = {k: "1e30" if math.isinf(v := element.values[k]) else repr(float(v)) for k in written}
    values = " ".join(f"{k}={number}" for k, number in numbers.items())
    extra = f" wk={work_ratio!r}" if element.device == "GAP" and work_ratio != 1.0 else ""
    held = start_voltage(element, circuit.initial) if start_areas else 0.0
    extra += f" ic={held!r}" if held else ""
    extra += f" a_ic={start_areas[element.nodes[2]]!r}" if held and element.spec.is_layer else ""
    device = f"GAP_{_element_name(element)}" if tabled else element.device
    return f"{head} {device} {values}{extra}"


def _controls(element: Element, circuit: Circuit) -> list[str]:
    """Names of the nodes or elements that control an element."""
    if "node" not in element.spec.control:
        return [_element_name(circuit[name]) for name in element.control]
    written = {node: name for e in circuit.elements for node, name in zip(e.nodes, e.node_names, strict=True)}
    return [_name(written.get(node, node)) for node in element.control]


def _source_text(w: Waveform, name: str, circuit: Circuit) -> str:
    """A waveform as ngspice has it, or as points."""
    if isinstance(w, DC):
        return f"DC {w.level!r}"
    if isinstance(w, Sine):
        return _call("SIN", (w.offset, w.amplitude, w.frequency, w.delay, w.damping, w.phase_deg))
    if isinstance(w, Exp):
        return _call("EXP", (w.v1, w.v2, w.td1 or NOW, w.tau1, w.td2 or NOW, w.tau2))
    tran = circuit.tran
    edge = EDGE if tran is None else min(EDGE, 1e-3 * tran.step)
    given = circuit.initial or any(e.initial is not None for e in circuit.elements)
    empty = tran is not None and starts_uncharged(circuit) and not given
    if isinstance(w, Pulse):
        stop = tran.stop if tran else 1.0
        span, rise, fall = stop + abs(w.delay), w.rise or edge, w.fall or edge
        # The rise time of a jump is subtracted from the width, so that the pulse still ends at its time.
        width = w.width - (0.0 if w.rise else edge) if math.isfinite(w.width) else 10.0 * span
        period = w.pulse_period if math.isfinite(w.pulse_period) else 20.0 * span + rise + width + fall
        jumps = empty and w.value(0.0) != 0.0 and w.breakpoint_rate() * stop < _FEW
        if not jumps and width > 0.0 and rise + width + fall <= period:
            return _call("PULSE", (w.v1, w.v2, w.delay, rise, fall, width, period))
    t, v = _points(w, name, circuit)
    if empty:
        # All voltages start at 0: let the source start at 0 V and jump, or ngspice often fails at its first step.
        t, v = np.append([0.0, 0.0], t[t > 0.0]), np.append([0.0, w.value(0.0)], v[t > 0.0])
    points: list[float] = []
    for time, value in zip(t.tolist(), v.tolist(), strict=True):
        if points and time <= points[-2]:
            if value == points[-1]:
                continue
            # A jump becomes an edge. Late in a long run it may be shorter than the spacing of doubles: take the next.
            time = max(points[-2] + edge, np.nextafter(points[-2], math.inf).item())
        points += [time, value]
    return _call("PWL", points)


def _call(name: str, numbers: Iterable[float]) -> str:
    return f"{name}({' '.join(repr(float(x)) for x in numbers)})"


def _points(w: Waveform, name: str, circuit: Circuit) -> tuple[np.ndarray, np.ndarray]:
    """Points (s, V) of a waveform over the run: its own, or left and right values at breakpoints and dense points.

    Own points go from 0 s to the first one after the end of the run, or to the last one if the end is not known.
    """
    tran = circuit.tran
    if isinstance(w, PWL | Samples) and w.period is None:
        t, v = w.knots
        if tran is not None:
            count = int(np.searchsorted(t, tran.stop, side="right")) + 1
            t, v = t[:count], v[:count]
        if t[0] < 0.0:
            at_0 = [w.value(0.0, "left").item(), w.value(0.0).item()]
            t, v = np.append([0.0, 0.0], t[t > 0.0]), np.append(at_0, v[t > 0.0])
        _refuse_many(t.size, name)
        return t, v
    if tran is None:
        raise InputError(f"{name}: exporting this source as PWL needs a .tran line to know how far")
    stop, spacing = tran.stop, w.shortest_time() / _DENSITY
    if not math.isfinite(spacing) and w.terms(np.array([0.0]), np.array([stop])) is None:
        spacing = tran.step / 4.0
    count = math.ceil(stop / spacing) if math.isfinite(spacing) else 1
    # Test with the rate, an upper bound, before the breakpoints are listed: there may be too many to list.
    most = count + 2.0 * w.breakpoint_rate() * stop
    breaks = w.breakpoints(0.0, stop) if most <= 10 * _MOST else np.empty(0)
    _refuse_many(count + 2 * breaks.size if most <= 10 * _MOST else most, name)
    if tran.uic:
        # The left value at t = 0 only matters for an operating point, which a run with uic does not have.
        breaks = breaks[breaks > 0.0]
    smooth = np.linspace(0.0, stop, count + 1)
    # At one time the left value comes first, and the right one last.
    t = np.concatenate([breaks, smooth, breaks])
    order = np.argsort(t, kind="stable")
    return t[order], np.concatenate([w.value(breaks, "left"), w.value(smooth), w.value(breaks)])[order]


def _refuse_many(points: float, name: str) -> None:
    allowed = f"at most {_MOST}; shorten the run (--stop, or .tran)"
    refuse(points > _MOST, f"{name}: the source would take {points:.0f} PWL points; allowed: {allowed}")


# Comparison with another simulator's run

_MOST_DRAWN = 4  # Vectors in a picture, those with the largest differences


@dataclass(frozen=True, repr=False)
class RawComparison(Shown):
    """A run beside one of another simulator.

    Attributes
    ----------
    solution : Solution
        With outputs at the other run's times.
    raw : Raw
    vectors : dict of str to tuple of ndarray, shape (n_t,)
        What both have, by the other's name: ours, and the other's. Areas are in mm^2, as the other's are.
    """

    solution: Solution
    raw: Raw
    vectors: dict[str, tuple[FloatArray, FloatArray]]

    @property
    def differences(self) -> dict[str, float]:
        """Largest difference of each vector over its largest value, the largest first."""
        found = {
            name: float(np.abs(ours - theirs).max()) / (float(np.abs(ours).max()) or 1.0)
            for name, (ours, theirs) in self.vectors.items()
        }
        return dict(sorted(found.items(), key=lambda one: -one[1]))

    def _page(self) -> Page:
        t, rows = self.solution.t, list[tuple[str, ...]]()
        for name, share in self.differences.items():
            ours, theirs = self.vectors[name]
            place = int(np.abs(ours - theirs).argmax())
            rows.append((name, f"{np.abs(ours).max():.5g}", f"{share:.2g}", format_si(float(t[place]), "s")))
        head = f"{len(rows)} vectors at {t.size:,} times of '{self.raw.title}', {self.raw.plotname}"
        return Page([head, "", Table(("vector", "largest", "difference over it", "at"), rows)])

    def to_dict(self) -> dict[str, Any]:
        """The largest differences as plain data."""
        return {"vectors": self.differences, "times": int(self.solution.t.size)}

    def plot(self) -> drawing.Picture:
        """Both runs, of the vectors that differ most."""
        names = list(self.differences)[:_MOST_DRAWN]
        areas = {gap.nodes[2] for gap in self.solution.circuit.by_device("GAP")}
        figure, axes = drawing.new_figure(len(names), height=1.0 + 1.3 * len(names), sharex=True)
        factor, unit = drawing.engineering(float(self.solution.t.max()), "s", 2.0)
        for ax, name in zip(axes, names, strict=True):
            styles = ({"linewidth": 3.2, "alpha": 0.45, "label": "here"}, {"linewidth": 1.2, "label": "other"})
            for values, style, color in zip(self.vectors[name], styles, drawing.CYCLE[:2], strict=True):
                ax.plot(factor * self.solution.t, values, color=color, **style)  # type: ignore[arg-type]
            shown = "mm²" if name[2:-1] in areas else "A" if name[0] == "i" else "V"
            drawing.dress(ax, f"{name} [{shown}]", f"Time [{unit}]" if ax is axes[-1] else "")
        drawing.legend_above(axes[0])
        drawing.caption(figure, f"{self.solution.circuit.title} · {self.raw.title}")
        return figure


def compare_raw(
    circuit: Circuit, raw: Raw | str | Path, *, rtol: float = 1e-8, charge_law: str | None = None
) -> RawComparison:
    """Run a circuit at the times of another simulator's run, and compare node voltages, areas and sources' currents.

    Parameters
    ----------
    circuit : Circuit
    raw : Raw, str or Path
        As `read_raw` gives it, or its file; of several runs in it the first.
    rtol, charge_law
        As in `simulate`.

    Raises
    ------
    InputError
        If the file cannot be read, is no run in time, or has no vector of this circuit.
    """
    require_circuit(circuit)
    raw = raw if isinstance(raw, Raw) else read_raw(raw)
    refuse(next(iter(raw.kinds.values())) != "time", f"'{raw.title}' is {raw.plotname}, no run in time; allowed: one")
    first = raw.steps[0]
    # Of two values at a jump the right-hand one is the later.
    t, place = np.unique(raw.scale[first].real[::-1], return_index=True)
    place = first.stop - first.start - 1 - place
    refuse(t.size < 2, f"'{raw.title}' has {t.size} times; allowed: two or more")
    solution = simulate(circuit, t_stop=float(t[-1]), t_eval=t, rtol=rtol, charge_law=charge_law, jumps="none")
    record = solution.record
    ours = {f"v({name.lower()})": x for name, x in record.node_voltages.items()}
    ours |= {f"i({name})": x for name, x in currents_of(record, circuit).items()}
    ours |= {f"v({node})": x for node, x in areas_of(record, circuit).items()}
    both = {name: (ours[name], x[first].real[place]) for name, x in raw.vectors.items() if name in ours}
    said = f"'{raw.title}' has the vectors {', '.join([*raw.vectors][:12])}"
    refuse(not both, f"{said}; allowed: some of {', '.join([*ours][:12])}")
    return RawComparison(solution, raw, both)
