"""What a call asks for: its problem, the lightest model that meets its error, and warnings about a run's limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import circuit_warnings, course_warnings, spectrum_warning
from fingerspice.circuit.devices import beyond_fingers
from fingerspice.circuit.statespace import driving
from fingerspice.physics.contact import LawContact, inverse_area, inverse_area_range
from fingerspice.results.outcome import Plan, Status
from fingerspice.results.record import Record
from fingerspice.solve.periodic import close_period
from fingerspice.solve.problem import Problem, prepare, shortest_event, to_ends
from fingerspice.solve.runs import Run
from fingerspice.solve.stepping import FEWEST_PERIODS
from fingerspice.waveforms.sampling import Function
from fingerspice.waveforms.waveform import DOUBLE, refuse, require

TIERS = ("algebraic", "linear", "coupled")
# A scene is called stiff if its fastest rate times the source's shortest time exceeds this: stability alone would then
# limit the steps of an explicit method.
STIFF = 300.0
REPEATS = "periodic: once a period no longer changes the state, later ones repeat it"
BREAKDOWN_VOLTAGE = 300.0
LEAST_AREA = 0.2  # Smallest contact area without a warning, relative to the area at 0 V
# Smallest distance to the fold of the mobile law without a warning: a voltage a few percent larger reaches the fold.
NEAR_FOLD = 0.2
# Shortest event (s) in a user's function that may be missed without a warning, half a period of 10 kHz: drives of a
# screen have few that are shorter.
_EVENT = 0.5 / 10e3


def asked(circuit: Circuit, *, rtol: float, t_eval: FloatArray | None = None, **how: Any) -> Problem:
    """The problem that a call of `simulate` asks for, with arguments as `check_arguments` leaves them."""
    problem = prepare(circuit, t_eval=t_eval, rtol=rtol, **how)
    if problem.start == "periodic":
        problem, _ = close_period(problem, 0.5 * rtol)
        if t_eval is not None:
            to_ends(t_eval, problem.t_start, problem.t_stop)
            allowed = f"from {problem.t_start:g} s on, where the source has settled and its periodic state exists"
            require(t_eval[0] >= problem.t_start, "the first of t_eval", f"{t_eval[0]:g} s", allowed)
    return problem


def make_plan(problem: Problem, rtol: float, tier: str = "auto", method: str = "auto") -> Plan:
    """The model for a problem with this error and tier asked for; a method that is named steps the coupled one."""
    refuse(tier not in ("auto", *TIERS), f"unknown tier {tier!r}; allowed: auto, {', '.join(TIERS)}")
    asked = "coupled" if tier == "auto" and method != "auto" else tier
    key = ("plan", rtol, asked, problem.start, problem.charge, problem.stored, problem.t_start, problem.t_stop)
    return problem.scene.remember(key, lambda: _plan(problem, rtol, asked))


def _plan(problem: Problem, rtol: float, tier: str) -> Plan:
    scene, model, span = problem.scene, problem.scene.model, problem.t_stop - problem.t_start
    area, changed = float(scene.net.area0[0]) if scene.fixed else math.nan, math.nan if scene.coupled else 0.0
    if model is not None and model.coupled:
        changed, area = _change(model.curve, scene.u_peak)
    elif scene.coupled and len(problem.network.sources) == problem.network.n_voltage:
        changed = max(_change(curve, scene.u_peak)[0] for curve in scene.net.curves[scene.net.gap >= 0])
    best, reason = _best(problem, rtol, changed)
    chosen = best if tier == "auto" else tier
    if chosen != best:
        _refuse(problem, chosen, best)
        reason = f"asked for; the lightest that is right would be {best}: {reason}"
    rates, shortest = scene.rates, min(problem.network.waveform.shortest_time(), span)
    fastest = float(rates.max(initial=0.0))
    reasons, stiff, needed = [reason], fastest * shortest > STIFF, 0.0
    if stiff:
        reasons.append(f"stiff: the fastest rate {fastest:.3g} 1/s against {1.0 / shortest:.3g} 1/s of the source")
    if chosen == "coupled" and scene.coupled and problem.network.waveform.period:
        reasons += [REPEATS] if span / problem.network.waveform.period >= FEWEST_PERIODS else []
    if chosen == "linear" and model is not None and scene.coupled and np.any(model.rate0 > 0.0):
        needed = changed
    if scene.skin is not None:
        f, error = scene.skin
        reasons.append(f"skin at {f:g} Hz: its dispersion moves the gap voltage by {error:.1g}")
        needed += error
    elif scene.network.stack is not None and problem.circuit.by_device("SKIN_DISPERSIVE"):
        reasons.append(f"skin dispersive: no one frequency serves to rtol = {rtol:g}")
    if problem.network.waveform.is_sampled:
        event = format_si(shortest_event(problem), "s")
        reasons.append(f"a source is a function: an event in it shorter than {event} may be missed without breaks=")
    found = tuple(sorted(map(float, rates)))
    return Plan(chosen, tuple(reasons), problem.start, found, stiff, changed, needed, area)


def _refuse(problem: Problem, tier: str, best: str) -> None:
    """Refuse a tier that cannot describe the circuit."""
    stack, mobile = problem.network.stack, problem.scene.charge_law == "mobile"
    if stack is None and tier != "coupled":
        others = "auto" if best == "coupled" else f"auto, {best}"
        raise InputError(f"the {tier} tier is not for this network; allowed: {others} or coupled")
    if stack is not None and tier == "algebraic":
        leaking = stack.layers_of(stack.g_total + stack.g_area > 0.0)
        what = f"a stack without leaks; here {', '.join(leaking)} leak"
        raise InputError(f"the algebraic tier needs {what if leaking else 'a start without stored charge'}")
    if tier == "linear" and problem.scene.coupled and (mobile or problem.charge):
        what = "the mobile law" if mobile else "the charge (charge=False leaves it out)"
        raise InputError(f"the linear tier takes the area as fixed, and {what} needs the one that follows the voltage")


def _best(problem: Problem, rtol: float, changed: float) -> tuple[str, str]:
    """The lightest tier that is valid, and the reason.

    With capacitors outside the layers, a small change of an area may have a large effect on the voltages over many
    periods. No useful bound of that effect is known beforehand: a network is coupled however little its areas change.
    """
    scene, model, several = problem.scene, problem.scene.model, len(problem.network.fingers) > 1
    stores = scene.coupled and model is not None and model.mobile and problem.stored > 0.0
    if model is not None and not (model.rate.any() or model.rate0.any() or stores):
        return "algebraic", "no layer leaks, so the voltages follow the source at once"
    if not scene.coupled:
        which = f"the area{' is' if model is not None else 's are'} {scene.area_mode}"
        return "linear", f"{which if scene.fixed else 'no element has an area'}, so the circuit is linear"
    if model is None:
        follows = f"a network whose area{'s follow' if several else ' follows'} the gap voltage"
        if math.isnan(changed):
            return "coupled", f"{follows}; by how much is not known beforehand: a current source sets no bound"
        return "coupled", f"{follows}, {'each ' if several else ''}by up to {_percent(changed)} of its middle"
    free = not model.rate0.any()
    if model.mobile or not (free or changed <= 0.2 * rtol):
        return "coupled", f"the area follows the voltage and moves the leaks by up to {_percent(changed)}"
    if problem.charge:
        return "coupled", "only the charge needs the area at every instant; charge=False leaves it out"
    if free:
        return "linear", "every leak scales with the area, so under the local law no voltage feels it"
    return "linear", f"the area changes the leaks by {changed:.2g} at most, against rtol = {rtol:g}"


def _percent(share: float) -> str:
    """A share in percent to two digits, without an exponent where it has three."""
    return f"{float(f'{100.0 * share:.2g}'):g} %"


def _change(curve: FloatArray, u_peak: float) -> tuple[float, float]:
    """Largest relative change of 1/A under sources with peak `u_peak` (V) from its middle value, and its area (m^2)."""
    # The gap may hold the whole source voltage, and up to twice that if stored charge adds to a reversed source.
    least, largest = inverse_area_range(2.0 * u_peak, 65, curve)
    middle = 0.5 * (least + largest)
    return max(middle / least, largest / middle) - 1.0, 1.0 / middle


def run_warnings(problem: Problem, run: Run, record: Record) -> Iterator[str]:
    """Warnings for every limit of the model that the run exceeds."""
    success, several, net = run.status is Status.SUCCESS, len(record.fingers) > 1, problem.scene.net
    yield from (*problem.circuit.warnings, *circuit_warnings(problem.circuit, problem.t_stop))
    key = ("source", problem.t_start, problem.t_stop, problem.by_deck)
    yield from problem.circuit.remember(key, lambda: tuple(_source_warnings(problem)))
    waves = problem.network.waveforms
    off = problem.scene.u_peak == 0.0 and success and waves and not run.gaps[:, 0].any()
    if off and not any(wave.peak(problem.t_start, problem.t_stop) for wave in waves[problem.network.n_voltage :]):
        if small := ", ".join(e.name for e in driving(problem.circuit) if e.ac is not None):
            alone = f"{small} has AC alone, which drives sweeps (fingerspice ac)"
            yield f"the sources are 0 all the time: {alone}; a sine in time is SIN(VO VA FREQ)"
        elif not problem.initial.y.any() and not any(problem.t_stop <= wave.course[0] < math.inf for wave in waves):
            yield "the sources are 0 all the time, and nothing is charged: every voltage is 0"
    if run.note and success:
        yield run.note
    for finger, (name, contact) in enumerate(record.fingers):
        u_peak, f_peak, u_error, _ = run.gaps[finger].tolist()
        where, i = f" of {name}" if several else "", problem.network.fingers[finger]
        unloaded = least = largest = float(net.area0[i])
        if net.slow[i] >= 0:
            area = record.each("area")[finger]
            least, largest = float(area.min(initial=math.inf)), float(area.max(initial=0.0))
        elif net.gap[i] >= 0:
            if isinstance(contact, LawContact) and u_peak > net.curves[i, 1]:
                raise InputError(contact.ends(u_peak))
            least = float(1.0 / inverse_area(u_peak, net.curves[i])[0])
            largest = max(unloaded, least)
        if u_peak > BREAKDOWN_VOLTAGE:
            limit = f"air breaks down above about {BREAKDOWN_VOLTAGE:g} V (Paschen minimum 327 V)"
            yield f"the gap voltage{where} reaches {u_peak:.4g} V; {limit}, which the model does not contain"
        if least < LEAST_AREA * unloaded:
            little = f"below {100.0 * LEAST_AREA:g} % of the {1e6 * unloaded:.3g} mm^2 at 0 V"
            said = f"the contact area{where} falls to {1e6 * least:.3g} mm^2, {little}"
            yield f"{said}: the contact model was not made for so little"
        yield from beyond_fingers(where, f_peak, float(contact.stress(u_peak)), largest)
        if success and 0.0 < u_peak <= u_error and not several:
            known = f"of its {u_peak:.2g} V nothing is known but that they are as good as 0"
            yield f"the gap takes no more than rounding of the source's voltage: {known}"
    for e in problem.circuit.by_device("V", "I"):
        if e.waveform is not None and e.waveform.precision > DOUBLE:
            rounded = f"numbers rounded to {e.waveform.precision:.2g} of their size, not doubles"
            rough = f"it is rough by {run.rough:.2g} V, which the stated errors contain"
            yield f"the source function of {e.name} gives {rounded}: {rough}"
    if run.margin < NEAR_FOLD and success:
        distance = f"the distance to it falls to {run.margin:.2g} (1 far, 0 at the fold)"
        yield f"the fold of the mobile charge law is near: {distance}"
    for i, layer in enumerate(problem.network.layers):
        strength = layer.values.get("e_max", math.inf)
        if math.isfinite(strength) and record.t.size:
            field = float(np.abs(record.u_layer[:, i]).max()) / layer.values["d"]
            if field > strength:
                met = f"the field in {layer.name} reaches {field:.3g} V/m at the outputs"
                yield f"{met}; its dielectric strength is {strength:.3g} V/m"


def _source_warnings(problem: Problem) -> Iterator[str]:
    """Warnings about sources that miss the run, and about sources beyond the band of the skin's data."""
    yield from course_warnings(problem.circuit, problem.t_start, problem.t_stop, problem.by_deck)
    event = shortest_event(problem)
    plain = any(isinstance(wave, Function) and not wave.breaks for wave in problem.network.waveforms)
    if plain and event > _EVENT:
        seen = f"which was looked at every {format_si(event, 's')}: an event shorter than that may have been missed"
        mend = "give Function(f, breaks=(...)) its edges, or the circuit a .tran of a shorter TSTEP"
        yield f"the source is a function, {seen}; {mend}"
    yield from spectrum_warning(problem.circuit, problem.network.waveform, problem.t_stop)
