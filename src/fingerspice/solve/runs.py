"""What integrators share: the loop over windows, the end of a run, stated errors; and what to say of how it went."""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray, read_only
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.units import format_si
from fingerspice.circuit.describe import circuit_warnings, course_warnings, option_notes, spectrum_warning
from fingerspice.circuit.devices import beyond_fingers
from fingerspice.circuit.statespace import driving
from fingerspice.engine.collocation.readout import ACCEPTED, NFEV, OUTPUT, REJECTED, TRIED, ZEROS
from fingerspice.engine.network import Sources, rates_at
from fingerspice.physics.contact import LawContact, inverse_area
from fingerspice.results.outcome import ErrorEstimate, Failure, SolveError, State, Status, last_tried
from fingerspice.results.record import Record
from fingerspice.results.solution import Solution
from fingerspice.results.steps import ClosedForm, Recorded
from fingerspice.solve.problem import Problem, Tables, after_the_end, joined, segment_index, shortest_event, values_at
from fingerspice.waveforms.periodic import PWL
from fingerspice.waveforms.sampling import Function, breakpoints_at
from fingerspice.waveforms.waveform import DOUBLE, Sum

Progress = Callable[[float], None]

# A distance to the fold below this means that the run has stepped over a fold: at the fold it is 0 to rounding.
PAST_FOLD = -0.01
BREAKDOWN_VOLTAGE = 300.0
LEAST_AREA = 0.2  # Smallest contact area without a warning, relative to the area at 0 V
# Smallest distance to the fold of the mobile law without a warning: a voltage a few percent larger reaches the fold.
NEAR_FOLD = 0.2
# Shortest event (s) in a user's function that may be missed without a warning, half a period of 10 kHz: drives of a
# screen have few that are shorter.
_EVENT = 0.5 / 10e3
# Smallest force (N) whose error is judged; the error of a smaller one may be a denormal number with too few digits.
LEAST_FORCE = 1e-290
ROUGH = "the source function itself is rough by {:.2g} V"


@dataclass
class Run:
    """Result of one run, with its statistics and stated errors."""

    # t, left, rows: As in `Record`, up to the time reached
    t: FloatArray
    left: BoolArray
    rows: FloatArray
    status: Status
    nfev: int  # Evaluations of the right-hand side
    stats: dict[str, int]
    state: State  # State at the time reached
    # (n_measured, 4): Peaks of voltage (V) and force (N), and the stated errors of both, for each cell in
    # `Scene.measured`
    gaps: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    charge_error: float | None = None  # Stated error of the charge, C
    node_error: float | None = None  # Stated error of the nodes' voltages, V
    t_failed: float | None = None  # Time at which the run failed, s
    # unseen, rough: See `Tables`
    unseen: tuple[float, float, int] | None = None
    rough: float = 0.0
    margin: float = 1.0  # Smallest distance to the fold in the run
    detail: str = ""  # Message of a method about its failure
    note: str = ""  # Why an implicit method took over; empty where none did
    # (n, 4): The last steps tried, as rows of `results.outcome.last_tried`
    tried: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    here: FloatArray | None = None  # (width,): The row at the time that a failed run reached
    continuous: Recorded | ClosedForm | None = None  # The run between its outputs, where that is known
    by_layer: bool = False  # Whether the rows refer to the network of `Scene.shown`

    @property
    def error(self) -> ErrorEstimate:
        """The largest stated errors."""
        _, _, u_gap, f_el = self.gaps.max(axis=0, initial=0.0).tolist()
        return ErrorEstimate(u_gap, f_el, self.charge_error, self.node_error)

    def record(self, problem: Problem) -> Record:
        """The outputs as a record, from which all signals follow."""
        scene = problem.scene.shown if self.by_layer else problem.scene
        return Record(scene.network, scene.net, self.t, self.left, self.rows, problem.charge)

    def only(self, kept: BoolArray) -> Run:
        """A copy that has only the outputs that are `kept`."""
        kept = kept[: self.t.size]
        return replace(self, t=self.t[kept], left=self.left[kept], rows=self.rows[kept])

    def end_where_it_stopped(self) -> None:
        """Append a left-hand output at the time that a failed run reached, unless it has one there already."""
        t, row = self.state.t, self.here
        if row is not None and np.all(np.isfinite(row)) and (self.t.size == 0 or t > self.t[-1]):
            self.t, self.left = np.append(self.t, t), np.append(self.left, True)
            self.rows = np.vstack([self.rows, row])

    def add_error(self, u_gap: FloatArray | float, f_el: FloatArray | None = None) -> None:
        """Add errors that the method does not estimate, V and N, as in `with_error`."""
        self.gaps = with_error(self.gaps, u_gap, f_el)
        if self.node_error is not None:
            self.node_error += float(np.max(u_gap, initial=0.0))


def with_error(gaps: FloatArray, u_gap: FloatArray | float, f_el: FloatArray | None = None) -> FloatArray:
    """`Run.gaps` with more errors, V and N; by default f_el follows from u_gap, as F ~ u^2 A and A falls with u."""
    out = gaps.copy()
    out[:, 2] += u_gap
    # Without a voltage there is no force either.
    out[:, 3] += 2.0 * u_gap * out[:, 1] / np.maximum(out[:, 0], LEAST_FORCE) if f_el is None else f_el
    return out


def excess_of(gaps: FloatArray, rounding: float) -> float:
    """Largest ratio of a stated error to its peak, see `Run.gaps`; a gap within `rounding` (V) of 0 V is not judged."""
    worst = 0.0
    for u_peak, f_peak, u_error, f_error in gaps.tolist():
        if u_peak > rounding:
            worst = max(worst, u_error / u_peak, f_error / f_peak if f_peak > LEAST_FORCE else 0.0)
    return worst


def closed_form(problem: Problem, again: Callable[[Problem], Run], error: float = 0.0) -> ClosedForm:
    """The run between its outputs, by a method that computes it `again` with any outputs; see `ClosedForm`."""
    look, wave, course = partial(_look, problem, again), problem.network.waveform, problem.network.course
    if course is not None and (times := course.changes(problem.t_stop)[0]).size:
        # A source of 0 V has breakpoints where switches change.
        wave = Sum((wave, PWL(tuple(times.tolist()), (0.0,) * times.size)))
    return ClosedForm(look, wave, problem.t_start, error, problem.rounding)


def _look(problem: Problem, again: Callable[[Problem], Run], t: FloatArray, left: BoolArray) -> Record:
    return again(problem.at(t, left)).record(problem)


class Integration(ABC):
    """One integration of a problem in progress."""

    counters: IntArray  # With the indices of `engine.collocation.readout`
    rows: FloatArray  # (n_out, width): Outputs as in `Record`, those of exponential steps once they are `completed`
    detail = ""  # Message of a method about its failure

    def __init__(self, problem: Problem) -> None:
        self.problem, self.net = problem, problem.scene.net
        # What is written on the way: also the outputs at the end, if no source may jump there.
        left, last = problem.left, int(problem.t_out.searchsorted(problem.t_stop))
        if last < left.size and after_the_end(problem) is None:
            left = np.concatenate([left[:last], np.ones(left.size - last, bool)])
        self.t_out, self.left = read_only(problem.t_out), read_only(left)
        self.n, n_s = map(int, self.net.b.shape)
        # The state reached, as in `State`.
        self.y, self.sign = problem.initial.y.copy(), problem.initial.sign.copy()
        self.s_before = problem.initial.s_before.copy()
        self.n_slow = self.y.size - self.n - n_s
        self.tried = np.zeros((TRIED, 4))  # The last attempted steps, see `last_tried`

    @property
    @abstractmethod
    def t(self) -> float:
        """Time reached, s."""

    @abstractmethod
    def through(self, sources: Sources, t_end: float) -> Status:
        """Integrate to `t_end` (s), including the jumps of the sources before it."""

    def state(self) -> State:
        return State(self.t, self.y.copy(), self.s_before.copy(), self.sign.copy(), self.problem.scene.charge_law)

    def stuck(self) -> Status:
        """Status of a run in which no step is short enough; a coupled `mobile` scene is then taken to be at a fold."""
        return Status.FOLD if self.net.mobile and self.problem.scene.coupled else Status.STEP_UNDERFLOW

    def jump(self, after: FloatArray) -> bool:
        """Apply a jump of the sources to their values `after`; False where the jump goes past a fold."""
        raise NotImplementedError

    def completed(self) -> None:
        """Give the rows written so far the form of `Record`, which those of most methods have from the beginning."""
        return

    def finish(self, state: State, sources: Sources) -> None:
        """Write the right-hand outputs at the end of the run, with the state there, before a jump of the sources."""
        if (after := after_the_end(self.problem)) is not None:
            values, _ = values_at(after, self.problem.t_stop)
            if np.any(values != state.s_before):
                if not self.jump(values):
                    return
                state = self.state()
        self.rows[int(self.counters[OUTPUT]) :] = self.row(state, after or sources, "right")
        self.counters[OUTPUT] = self.t_out.size

    def row(self, state: State, sources: Sources, side: Literal["left", "right"]) -> FloatArray:
        """The row of a state, with left- or right-hand values of the sources; NaN past a fold."""
        if not self.problem.charge:
            return state.y.copy()
        index = segment_index(sources, state.t, side)
        rate = rates_at(self.net, sources, index, state.t, 0.0, state.y, state.sign.copy())
        return np.append(state.y, rate[-state.s_before.size :])


def integrate(one: Integration, tables: Tables, progress: Progress | None = None) -> Run:
    """Run an integration to its end or to its failure; the caller adds the stated error."""
    problem, t_out = one.problem, one.t_out
    status, t_failed = Status.SUCCESS, None
    sources: Sources | None = None
    tables.done = -np.inf
    for window in tables:
        if all(table.edges.size > 1 for table in window):
            sources = joined(window)
            status = one.through(sources, min(float(table.edges[-1]) for table in window))
            if status is not Status.SUCCESS:
                t_failed = one.t
                break
        tables.done = one.t
        if progress is not None:
            progress(problem.done(one.t))
        if tables.not_finite is not None:
            status, t_failed = Status.SOURCE_NOT_FINITE, tables.not_finite
            break
    state = one.state()
    one.completed()
    if status is Status.SUCCESS and one.counters[OUTPUT] < t_out.size and sources is not None:
        one.finish(state, sources)
    here = None
    if t_failed is not None and sources is not None and state.t > problem.t_start:
        here = one.row(state, sources, "left")
    rows = one.rows[: int(one.counters[OUTPUT])]
    stats = {name: int(one.counters[i]) for name, i in (("steps", ACCEPTED), ("rejected", REJECTED), ("zeros", ZEROS))}
    return Run(
        t_out[: len(rows)], problem.left[: len(rows)], rows, status, int(one.counters[NFEV]), stats, state,
        t_failed=t_failed, tried=one.tried, unseen=tables.unseen, rough=tables.rough, detail=one.detail,
        here=here,
    )  # fmt: skip


def gap_signals(record: Record) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Voltage (V) and force (N) of every gap; without one, the voltage of the smallest capacitor and no force."""
    network = record.network
    yield from zip(record.each("u_gap"), record.each("f_el"), strict=True)
    if not record.fingers and network.cells:
        u = record.cell_voltage(int(np.argmin(network.capacitance(record.net.area0))))
        yield u, np.zeros(u.size)


def apart(one: FloatArray, other: FloatArray) -> float:
    """Largest difference of a signal between two runs of the same outputs, over their common times."""
    count = min(len(one), len(other))
    return float(np.abs(one[:count] - other[:count]).max(initial=0.0))


def nodes_apart(one: Record, other: Record) -> float:
    """As `apart`, of all nodes' voltages, V."""
    return max(map(apart, one.node_voltages.values(), other.node_voltages.values()), default=0.0)


def run_failure(problem: Problem, run: Run, record: Record) -> Failure:
    """The failure of a run. At a fold, the gap with the smallest area relative to its area at 0 V is named."""
    status, cause, names = run.status, run.status.cause, _concerned(problem, run.status, run.t_failed)
    element, u_gap, area, margin = ", ".join(names), None, None, None
    if status is Status.SOURCE_UNSEEN and run.unseen is not None:
        _, off, place = run.unseen
        element, device = ", ".join(_written(problem, place)), problem.network.sources[place].device
        cause += f" (by {off:.3g} {'A' if device == 'I' else 'V'})"
    elif status is Status.FOLD and record.t.size and record.fingers:
        if run.t_failed is not None and breakpoints_at(problem.network.waveform, run.t_failed).size:
            cause += " (the source jumps past the fold at this time)"
        areas = record.each("area")
        shrunk = [x[-1] / problem.scene.net.area0[j] for x, j in zip(areas, problem.network.fingers, strict=True)]
        i = int(np.argmin(shrunk))
        signals = record.each("u_gap")[i], areas[i], record.fold_margin
        element, (u_gap, area, margin) = names[i], (float(x[-1]) for x in signals)
    if detail := run.detail or (ROUGH.format(run.rough) if run.rough > 0.0 else ""):
        cause += f" ({detail})"
    if status is Status.ERROR_NOT_MET and len(run.gaps):
        peaks = run.gaps[:, 0]
        worst = int(np.argmax(run.gaps[:, 2] / np.where(peaks > 0.0, peaks, np.inf)))
        element = names[worst] if names else element
        cause += f" (estimate {run.gaps[worst, 2]:.3g} V of {peaks[worst]:.3g} V peak"
        largest = max(problem.scene.u_peak, float(peaks.max()))
        little = f"; the gap takes almost nothing of the {largest:.3g} V of the source, and rounding of these limits it"
        cause += f"{little if peaks[worst] < 1e-4 * largest else ''})"
    return Failure(status, cause, status.action, run.t_failed, element, u_gap, area, margin, last_tried(run.tried))


def no_period(problem: Problem, status: Status, t: float | None = None, cause: str = "") -> SolveError:
    """The end of a search for the periodic state, which found none."""
    cause = cause or f"no periodic state was reached: {status.cause}"
    return SolveError(Failure(status, cause, status.action, t, ", ".join(_concerned(problem, status, t))))


def _concerned(problem: Problem, status: Status, t: float | None) -> list[str]:
    """Names of the elements whose voltages have a stated error, or of the sources that are not finite at time t, s."""
    if status is Status.SOURCE_NOT_FINITE and t is not None:
        broken = [i for i, wave in enumerate(problem.network.waveforms) if not np.isfinite(wave.value(t))]
        return [name for i in broken for name in _written(problem, i)]
    return [problem.network.cells[i].element.name for i in problem.scene.measured]


def _written(problem: Problem, place: int) -> list[str]:
    """Names of the deck's sources that are combined in source number `place` of the network."""
    drives = problem.network.drives
    return [e.name for e, _ in (drives if problem.network.inner else drives[place : place + 1])]


def refuse_beyond_law(problem: Problem, area: int, u: float, when: str = "") -> None:
    """Refuse a largest gap voltage `u` (V) beyond the areas that are known of its contact law."""
    contact, net = problem.network.contacts[area], problem.scene.net
    if isinstance(contact, LawContact) and net.gap[area] >= 0 and u > net.curves[area, 1]:
        raise InputError(f"{when}{contact.ends(float(net.curves[area, 1]))}")


def run_warnings(problem: Problem, run: Run, record: Record) -> Iterator[str]:
    """Warnings for every limit of the model that the run exceeds."""
    success, several, net = run.status is Status.SUCCESS, len(record.fingers) > 1, problem.scene.net
    circuit = problem.circuit
    yield from (*circuit.warnings, *option_notes(circuit), *circuit_warnings(circuit, problem.t_stop))
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
        refuse_beyond_law(problem, i, u_peak)
        unloaded = least = largest = float(net.area0[i])
        if net.slow[i] >= 0:
            area = record.each("area")[finger]
            least, largest = float(area.min(initial=math.inf)), float(area.max(initial=0.0))
        elif net.gap[i] >= 0:
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


def warn(solution: Solution, level: int) -> None:
    """Issue a run's warnings but for its circuit's own, issued when that was read, and notes of options."""
    quiet = (*solution.circuit.warnings, *option_notes(solution.circuit))
    for text in [text for text in solution.warnings if text not in quiet]:
        warnings.warn(text, FingerspiceWarning, stacklevel=level + 1)


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
