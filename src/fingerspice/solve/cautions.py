"""Warnings about a run that succeeded but left the range in which its models, or its materials, are valid."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Element
from fingerspice.circuit.notices import circuit_warnings, course_warnings, driving
from fingerspice.circuit.spectrum import spectrum_warning
from fingerspice.circuit.usual import beyond_fingers
from fingerspice.physics.contact import inverse_area
from fingerspice.results.outcome import Status
from fingerspice.results.record import Record
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Run
from fingerspice.solve.sources import shortest_event
from fingerspice.waveforms.sampling import Function
from fingerspice.waveforms.waveform import DOUBLE

BREAKDOWN_VOLTAGE = 300.0
# Smallest contact area without a warning, relative to the area at 0 V.
LEAST_AREA = 0.2
# Smallest distance to the fold of the mobile law without a warning: a voltage a few percent larger reaches the fold.
NEAR_FOLD = 0.2
# Shortest event (s) in a user's function that may be missed without a warning, half a period of 10 kHz: drives of a
# screen have few that are shorter.
_EVENT = 0.5 / 10e3


def run_warnings(problem: Problem, run: Run, record: Record) -> Iterator[str]:
    """Warnings for every limit of the model that the run exceeds."""
    yield from (*problem.circuit.warnings, *circuit_warnings(problem.circuit, problem.t_stop))
    key = ("source", problem.t_start, problem.t_stop, problem.by_deck)
    yield from problem.circuit.remember(key, lambda: tuple(_source_warnings(problem)))
    yield from _off_warning(problem, run)
    if run.note and run.status is Status.SUCCESS:
        yield run.note
    net, several = problem.scene.net, len(record.fingers) > 1
    for finger, (name, contact) in enumerate(record.fingers):
        i, (u_peak, f_peak, u_error, _) = problem.network.fingers[finger], run.gaps[finger].tolist()
        where, unloaded = f" of {name}" if several else "", float(net.area0[i])
        least, largest = math.inf, unloaded
        if net.slow[i] >= 0:
            area = record.finger_area(finger)
            least, largest = float(area.min(initial=math.inf)), float(area.max(initial=0.0))
        elif net.gap[i] >= 0:
            least = float(1.0 / inverse_area(u_peak, net.curves[i])[0])
            largest = max(unloaded, least)
        yield from _gap_warnings(where, u_peak, unloaded, least)
        yield from beyond_fingers(where, f_peak, float(contact.stress(u_peak)), largest)
        if run.status is Status.SUCCESS and 0.0 < u_peak <= u_error and not several:
            yield (
                f"the gap takes no more than rounding of the source's voltage: of its {u_peak:.2g} V nothing is "
                "known but that they are as good as 0"
            )
    for e in problem.circuit.by_device("V", "I"):
        if e.waveform is not None and e.waveform.precision > DOUBLE:
            yield (
                f"the source function of {e.name} gives numbers rounded to {e.waveform.precision:.2g} of their size, "
                f"not doubles: it is rough by {run.rough:.2g} V, which the stated errors contain"
            )
    yield from _fold_warning(run)
    yield from _strength_warnings(problem.network.layers, record)


def _source_warnings(problem: Problem) -> Iterator[str]:
    """Warnings about sources that miss the run, and about sources beyond the band of the skin's data."""
    yield from course_warnings(problem.circuit, problem.t_start, problem.t_stop, problem.by_deck)
    event = shortest_event(problem)
    plain = any(isinstance(wave, Function) and not wave.breaks for wave in problem.waveforms)
    if plain and event > _EVENT:
        yield (
            f"the source is a function, which was looked at every {format_si(event, 's')}: an event shorter than that "
            "may have been missed; give Function(f, breaks=(...)) its edges, or the circuit a .tran of a shorter TSTEP"
        )
    outside = spectrum_warning(problem.circuit, problem.waveform, problem.t_stop)
    if outside is not None:
        yield outside


def _off_warning(problem: Problem, run: Run) -> Iterator[str]:
    """A warning about sources that are 0 in the whole run, unless a charge of the start drives it."""
    currents = problem.waveforms[problem.network.n_voltage :]
    peaks = (problem.scene.u_peak, *(wave.peak(problem.t_start, problem.t_stop) for wave in currents))
    if run.status is Status.SUCCESS and problem.waveforms and not (any(peaks) or run.gaps[:, 0].any()):
        small = ", ".join(e.name for e in driving(problem.circuit) if e.ac is not None)
        if small:
            yield (
                f"the sources are 0 all the time: {small} has AC alone, which drives sweeps (fingerspice ac); a sine "
                "in time is SIN(VO VA FREQ)"
            )
        elif not problem.initial.y.any() and not any(
            problem.t_stop <= wave.course[0] < math.inf for wave in problem.waveforms
        ):
            yield "the sources are 0 all the time, and nothing is charged: every voltage is 0"


def _gap_warnings(where: str, peak: float, unloaded: float, least: float) -> Iterator[str]:
    """Warnings about a gap, given its largest voltage (V), its area at 0 V and its smallest area (m^2)."""
    if peak > BREAKDOWN_VOLTAGE:
        yield (
            f"the gap voltage{where} reaches {peak:.4g} V; air breaks down above about {BREAKDOWN_VOLTAGE:g} V "
            "(Paschen minimum 327 V), which the model does not contain"
        )
    if least < LEAST_AREA * unloaded:
        yield (
            f"the contact area{where} falls to {1e6 * least:.3g} mm^2, below {100.0 * LEAST_AREA:g} % of the "
            f"{1e6 * unloaded:.3g} mm^2 at 0 V: the contact model was not made for so little"
        )


def _fold_warning(run: Run) -> Iterator[str]:
    if run.margin < NEAR_FOLD and run.status is Status.SUCCESS:
        yield (
            f"the fold of the mobile charge law is near: the distance to it falls to {run.margin:.2g} (1 far, 0 at the "
            "fold)"
        )


def _strength_warnings(layers: tuple[Element, ...], record: Record) -> Iterator[str]:
    for i, layer in enumerate(layers):
        strength = layer.values.get("e_max", math.inf)
        if math.isfinite(strength) and record.t.size:
            field = float(np.abs(record.u_layer[:, i]).max()) / layer.values["d"]
            if field > strength:
                yield (
                    f"the field in {layer.name} reaches {field:.3g} V/m at the outputs; its dielectric strength is "
                    f"{strength:.3g} V/m"
                )
