"""Scenes of a batch in lockstep: what goes there, the table of its values, and its figures, or derivatives of means."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev as powers

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.devices import Value
from fingerspice.circuit.laws import ContactLaw, acting_law
from fingerspice.circuit.statespace import Stack, build_stack, in_si, loop_of
from fingerspice.engine.lockstep.card import march_on_card
from fingerspice.engine.lockstep.march import N_PORTION, march
from fingerspice.engine.lockstep.scenes import CELL_ROWS, LARGEST_X, LOAD, LOSS, OMEGA, REST, STRESS, new_block
from fingerspice.engine.lockstep.step import ALL_MOMENTS, START_TIMES, marks_of
from fingerspice.numerics import chebyshev
from fingerspice.numerics.modes import STEP
from fingerspice.physics.contact import universal_curve_array
from fingerspice.physics.laws import paper_constants
from fingerspice.physics.materials import EPS0
from fingerspice.waveforms.periodic import Pulse, Square
from fingerspice.waveforms.samples import Samples, as_samples
from fingerspice.waveforms.waveform import AM, OFF, Sine

if TYPE_CHECKING:
    from fingerspice.studies.batch.batch import Task

#: Status of a scene that has been run in lockstep.
LOCKSTEP = 0
#: For each figure that lockstep gives, the moments that it needs: the means of u^2 A (0), (u^2 A)^2 (1) and u^2 (2).
FIGURES: dict[str, tuple[int, ...]] = {
    "f_el_mean": (0,), "f_el_rms": (1,), "f_t_mean": (0,), "f_t_rms": (0, 1), "friction_mean": (0,),
    "friction_rms": (0, 1), "u_gap_rms": (2,),
}  # fmt: skip
# Parameters that must be equal in all scenes of a lockstep, because the form of the equations depends on them.
_FORM = ("m_exp", "n_exp", "a_fix", "tau", "p_sat", "slip", "v", "q", "n_cpe")
# Most layers and most tones of a lockstep: code is compiled for each number of cells and of tones.
_MOST_LAYERS, _MOST_TONES = 4, 4
# Largest ratio of a tone's frequency to that of the whole source.
_MOST_PERIODS = 2000
# Numbers of points tried for the universal curve's Chebyshev series, and the relative error allowed.
_CURVE_SIZES, _CURVE_ERROR = (16, 20, 24, 28), 1e-13
# Degree of the powers of another contact law, their relative error, and the gap voltages that they may reach, over the
# source's peak.
_OF_LAW, _LAW_ERROR, _REACHES = 24, 1e-10, (2.0, 1.5, 1.2, 1.1, 1.0, 0.9, 0.8, 0.7, 0.6, 0.4)
# Smallest rtol at which derivatives are taken in lockstep: below it their kinks would take too many steps.
_LEAST_RTOL_OF_SLOPES = 5e-7
# By the smallest rtol served: initial number of steps per period, with which nearly all scenes meet it, under one tone
# and (of the highest) under several, and of a piece of a square's half period; and initial degree of the area's
# polynomial, of which each takes the compiler 8 s.
_RUNGS = (
    (5e-4, 20, 16, 4, 8), (5e-5, 32, 24, 4, 8), (5e-6, 48, 48, 6, 16), (5e-7, 72, 72, 8, 16), (0.0, 112, 112, 16, 16),
)  # fmt: skip
# By how much that grows where the last coefficient is more than this share of rtol; and the largest number of steps.
_MORE_DEGREE, _SMALL_TAIL, _MOST_STEPS = 8, 0.1, 8192
# Under a recording: initial number of steps a sample, and the largest.
_PARTS = (2, 16)
# Largest gap voltage that the area's polynomial covers, as a ratio to its estimate: the second one for scenes that the
# first did not cover. As the linear part of the equations has the area of its middle, results are compared at one only.
_COVERED = 1.2, 1.8
# Allowed defect of the periodic state relative to rtol, and that of a run from rest that ends when it has settled.
_CLOSING, _SETTLED = 0.02, 0.05
# Voltage at the start of a run, over all tones, that counts as 0 V. Also from there a leaking gap's voltage jumps, as
# it leads the source: below this rtol the first step is as short as a square's.
_FROM_ZERO, _LEADING = 1e-12, 5e-5
# Number by which the first step of a square, with so many steps a piece, is shorter than the fastest cell's time
# constant; and the largest number of pieces.
_PIECE_START, _MOST_PIECES = 2, 20
#: A scene is accepted if its estimate is at most this fraction of the error allowed.
ENOUGH = 0.7
# The relative round-off added to every stated error.
_ROUNDING = 1e-11
# The error is estimated as this share of the change from half the steps to all steps. The order is 4, which would give
# a fifteenth, and 3 for what the kinks of 1/A leave, where the gap voltage is 0. Pieces of 2 and of 4 steps are still
# far from the order. Under a recording it is 3, which would give a seventh, and 2 at those zeros; but 1, which gives 1,
# for a dispersive skin, some of whose modes decay from each sample on within a part of a step.
_STATED, _STATED_JUMPING, _STATED_RECORDED, _STATED_DISPERSIVE = 0.25, 0.5, 0.5, 1.0
# It is more of gap voltages, which show the kinks at their zeros more than means do; after a start away from 0 V, as
# what decays then meets steps of several lengths, whose errors may cancel; and where steps of more than this many of
# the fastest time constants do not resolve a start from rest, most of all in runs of at most a period.
_STATED_MORE, _STATED_BEGINNING, _STIFF = 0.8, 2.0, 2.0
# Rounding error of a run in which the area's polynomial has degree d, relative: 2^d times this, by which the powers'
# coefficients are larger than those of Chebyshev's series. And, in a derivative, that of all else.
_EPS, _ROUNDING_OF_SLOPES = 4.4e-16, 1e-13
# The stated error of a derivative has this many changes from half the steps to all steps.
_STATED_SLOPES = 2.0


@dataclass(frozen=True)
class LockstepForm:
    """Properties that all scenes in lockstep have in common."""

    stack: Stack
    gap: Element
    # The sources that are on; each with the sign of the gap along the loop times the sign of the source
    sources: tuple[tuple[Element, float], ...]
    multiples: tuple[int, ...]  # Frequency of every tone of the sources' sum, in that of the sum
    # That of the sum, Hz; None for one source of one tone, whose frequency may vary. For a recording half of its sample
    # rate, so that a sample's length is half a period.
    frequency: float | None
    jumping: bool  # Whether the source is a square
    recording: Samples | None  # The samples of the only source, if it is a recording


def lockstep_form(circuit: Circuit, varied: Iterable[str]) -> LockstepForm | str:
    """The common form of scenes in lockstep, or the reason why there is none; `varied` has the paths that vary."""
    if loop_of(circuit) is None:
        return "the circuit is no series stack of layers"
    stack, tran = build_stack(circuit), circuit.tran
    if stack.contact is None or stack.gap is None or stack.gap_layer is None or stack.area_given is not None:
        return "the stack has no contact whose area follows the gap"
    if not 2 <= len(stack.layers) <= _MOST_LAYERS:
        return f"the stack has not 2 to {_MOST_LAYERS} layers"
    if (circuit.charge_law or "local") != "local" or circuit.work != "gap":
        return "the charge law is mobile, or the total voltage is held"
    sources = tuple((e, float(turn * stack.sign[stack.gap])) for e, turn in stack.sources if e.waveform != OFF)
    waves = [e.waveform for e, _ in sources]
    recording = as_samples(waves[0]) if len(waves) == 1 and waves[0] is not None else None
    jumping = recording is None and any(isinstance(wave, Square | Pulse) for wave in waves)
    tones = [hz for wave in waves for hz, *_ in _tones_of(wave, {})[0]]
    multiples: tuple[int, ...] = (1,)
    frequency, charged = None, jumping
    if recording is not None:
        if recording.start != 0.0:
            return "the recording does not start at 0 s"
        frequency, charged = 0.5 * recording.rate, recording.between(0, 1)[0] != 0.0
    elif not (tones and all(tones) and len(tones) <= (1 if jumping else _MOST_TONES)):
        said = f"the sources are not 1 to {_MOST_TONES} plain sines, not a square that starts with its period"
        return f"{said}, and not a recording"
    elif len(tones) > 1:
        period = stack.waveform.period
        if period is None or max(tones) * period > _MOST_PERIODS:
            return "the sources' tones have no common period, or one of very many of their own"
        multiples, frequency = tuple(round(hz * period) for hz in tones), 1.0 / period
    varied = [path.lower() for path in varied]
    given = circuit.initial or any(e.initial is not None for e in circuit.elements)
    if tran is not None and not tran.uic:
        # The operating point of sines that start at 0 V is the uncharged state.
        others = [e.waveform for e in circuit.by_device("V") if not isinstance(e.waveform, AM)]
        charged = charged or any(getattr(wave, "phase_deg", 0.0) for wave in others)
        given = given or charged or any(path.endswith(".phase_deg") for path in varied)
    if given or (tran is not None and tran.start > 0.0):
        return "the run does not start uncharged, or its figures start late"
    fixed = () if frequency is None else ("frequency",)
    may_vary = {e.name.lower(): set(_tones_of(e.waveform, {})[1]).difference(fixed) for e, _ in sources}
    layers = {e.name.lower() for e in stack.layers}
    for path in varied:
        name, _, parameter = path.rpartition(".")
        if parameter not in may_vary[name] if name in may_vary else parameter in _FORM or name not in layers:
            return f"{path} varies"
    return LockstepForm(stack, stack.layers[stack.gap_layer], sources, multiples, frequency, jumping, recording)


def why_alone(form: LockstepForm | str, outputs: Iterable[str], slopes_at: float | None = None) -> str:
    """Why outputs, or with `slopes_at` their derivatives at that rtol, need runs of their own; '' in lockstep."""
    if isinstance(form, str):
        return form
    if slopes_at is not None and form.recording is not None:
        return "the source is a recording"
    follows = math.isinf(form.gap.values["p_sat"]) and form.gap.values["slip"] == 0.0
    if not follows and any(name.startswith(("f_t_", "friction_")) for name in outputs):
        return "friction is not mu times its load (p_sat, slip)"
    # Of a recording no last period is kept.
    suffix = "_periodic" if form.recording is None else ""
    others = [name for name in outputs if name != "u_gap" and name.removesuffix(suffix) not in FIGURES]
    if others:
        return f"{', '.join(others)} needs a run of its own"
    if slopes_at is not None and slopes_at < _LEAST_RTOL_OF_SLOPES:
        return f"rtol is below {_LEAST_RTOL_OF_SLOPES:g}"
    return ""


def _tones_of(wave: object, given: Mapping[str, Value]) -> tuple[list[tuple[float, Value, Value]], tuple[str, ...]]:
    """Frequency (Hz; 0 of no tone), amplitude (V) and phase (rad) of a source's tones, and parameters that may vary."""
    height, depth, phase = (given.get(name, getattr(wave, name, 0.0)) for name in ("amplitude", "depth", "phase_deg"))
    turn: Value = np.radians(phase)
    match wave:
        case AM():
            # sin(x) sin(y) is half of cos(x - y) = sin(x - y + pi/2) and of -cos(x + y) = sin(x + y - pi/2).
            share, quarter = height / (1.0 + depth), 0.5 * np.pi
            side, low, high = 0.5 * depth * share, wave.carrier - wave.modulation, wave.carrier + wave.modulation
            tones = [(wave.carrier, share, 0.0), (low, side, quarter - turn), (high, side, turn - quarter)]
            return tones, ("amplitude", "depth", "phase_deg")
        case Sine(offset=0.0, delay=0.0, damping=0.0):
            return [(wave.frequency, height, turn)], ("amplitude", "frequency", "phase_deg")
        case Square(half_wave=True, phase_deg=0.0, delay=0.0):
            return [(wave.frequency, height, turn)], ("amplitude", "frequency")
        case Pulse(half_wave=True, rise=0.0, delay=0.0):
            return [(wave.tone() or 0.0, wave.v2, 0.0)], ()
    return [(0.0, 0.0, 0.0)], ()


def table_of(form: LockstepForm, scenes: Mapping[str, FloatArray]) -> FloatArray:
    """The table (n_row, n) that `engine.lockstep.march` takes of scenes, which are values by path in lower case."""

    def values(element: Element) -> dict[str, Any]:
        start = f"{element.name.lower()}."
        given = {path.removeprefix(start): array for path, array in scenes.items() if path.startswith(start)}
        return {**element.values, **given}

    first = form.sources[0][0]
    period = first.waveform.period if first.waveform is not None else None
    frequency = form.frequency or values(first).get("frequency", 1.0 / (period or math.nan))
    v, count, rows = in_si(form.gap, values(form.gap)), next(iter(scenes.values())).size, list[Any]()
    for element, sign in form.sources:
        recorded = None if form.recording is None else [(0.0, peak_of(form.recording), 0.0)]
        for _, amplitude, phase in recorded or _tones_of(element.waveform, values(element))[0]:
            rows += [sign * amplitude * np.cos(phase), sign * amplitude * np.sin(phase)]
    law = acting_law(form.gap)
    if law is None:
        xi, area = paper_constants(v)
        loss = v["c2"] * np.asarray(v["mu"]) ** 2
    else:
        peak = sum(np.hypot(along, across) for along, across in zip(rows[::2], rows[1::2], strict=True))
        xi, of_law = _series_of(law, v, np.broadcast_to(peak, count))
        # At 0 V the variable is -1.
        area, loss, rows = np.asarray(1.0 / np.polyval(of_law, -1.0), float), 0.0, [*rows, *of_law]
    stress = 0.5 * EPS0 * v["eps_r"] / v["d"] ** 2
    rows[:0] = [xi, area, stress, v["fn"], loss, 2.0 * np.pi * np.asarray(frequency)]
    others, cell = CELL_ROWS * form.stack.c.size, 0
    out = np.empty((others + len(rows), count))
    for i, row in enumerate(rows, others):
        out[i] = row
    of_cells = out[:others].reshape(CELL_ROWS, form.stack.c.size, count)
    for layer, own in zip(form.stack.layers, form.stack.cells, strict=True):
        assert layer.spec.cells is not None
        cells = layer.spec.cells(values(layer), None)
        of_cells[:, cell : cell + own] = np.moveaxis(cells.reshape(own, CELL_ROWS, -1), 0, 1)
        cell += own
    return out


def _series_of(law: ContactLaw, v: dict[str, Any], peak: FloatArray) -> tuple[FloatArray, FloatArray]:
    """X at 1 V of scenes, and the powers of 1/A (n_power, n), the highest first; without any, X is beyond all series.

    They reach to the largest of some multiples of the source's peak (V) up to which there are areas.
    """
    at, _, to_powers = _to_powers(_OF_LAW)
    # The polynomials are checked between their nodes.
    every = np.concatenate([at, 0.5 * (at[1:] + at[:-1])])
    xi, found = np.full(peak.size, 1e30), np.zeros((at.size, peak.size))
    found[-1] = 1.0
    for multiple in _REACHES:
        missing = np.flatnonzero((xi == 1e30) & (peak > 0.0))
        # Parameters that are equal in all scenes stay numbers.
        given = {k: np.tile(x[missing], every.size) if np.ndim(x) else x for k, x in v.items()}
        top = multiple * peak[missing]
        u = 0.5 * np.outer(every + 1.0, top)
        try:
            inverse = (1.0 / law.contact(given).given(u.ravel())).reshape(u.shape)
        except Exception:  # A function of a single scene's parameters: all scenes run one by one.
            break
        series = chebyshev.coefficients(inverse[: at.size])
        # High powers of what is rounding would be large.
        own = to_powers @ np.where(np.abs(series) < 1e-15 * np.abs(series).max(axis=0), 0.0, series)
        between = np.polyval(own, every[at.size :, None]) / inverse[at.size :]
        # NaN, where an area is missing, is not small.
        good = np.abs(between - 1.0).max(axis=0) <= _LAW_ERROR
        xi[missing[good]] = LARGEST_X / top[good]
        found[:, missing[good]] = own[:, good]
    return xi, found


def peak_of(recording: Samples) -> float:
    """Largest sample, V; 1 V if all are 0."""
    return float(np.abs(recording.values).max()) or 1.0


@lru_cache(maxsize=32)
def curves_of(m: float, n: float, degree: int) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Power series of the universal curve, if there is one, Chebyshev nodes and matrix of a degree, as for `march`."""
    p = 0.5 * (1.0 + 1.0 / m - 1.0 / n)
    series = chebyshev.fit(lambda x: universal_curve_array(x, 1.0 / m, p), 0.0, LARGEST_X, _CURVE_ERROR, _CURVE_SIZES)
    if series is None:
        return None
    return np.ascontiguousarray(powers.cheb2poly(series)[::-1]), *_to_powers(degree)[:2]


@lru_cache(maxsize=32)
def _to_powers(degree: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Chebyshev nodes, and the matrices from values there, and from a series, to powers, the highest first."""
    to_powers = np.zeros((degree + 1, degree + 1))
    for k, one in enumerate(np.eye(degree + 1)):
        to_powers[: k + 1, k] = powers.cheb2poly(one[: k + 1])
    highest_first = (to_powers @ chebyshev.coefficients(np.eye(degree + 1)))[::-1]
    return chebyshev.nodes(degree + 1, -1.0, 1.0), np.ascontiguousarray(highest_first), to_powers[::-1]


class Run(NamedTuple):
    """Results of `march` with all steps and with half of them, and the gap voltages of both; a column each."""

    steps: int  # Of a period (sample)
    degree: int  # Of the area's polynomial
    fine: FloatArray
    trace: FloatArray
    coarse: FloatArray
    trace_coarse: FloatArray


class Ladder:
    """Scenes in lockstep: the steps are doubled until the outputs of a scene have an error that is small enough.

    A scene is integrated `copies` times; the table has the first copies of all scenes, then all second ones, and so on.
    """

    copies = 1
    limit = 1.0  # Error allowed to what is wanted, over rtol
    stated = ENOUGH  # Estimate over the error that is stated
    closer = 1.0  # Factor on the tolerance that ends the search for a periodic state
    # As an estimate may be small by chance, doubling the steps may not reduce it by more than this factor.
    most_gain = 24.0
    highest_degree = 24  # Of the area's polynomial
    gives_up = True  # Whether scenes are given up for which more steps are no help
    named = ""  # What comes before the message of a scene that cannot be run

    def __init__(self, task: Task, form: LockstepForm, halves: int, members: IntArray) -> None:
        self.task, self.form = task, form
        self.halves = halves  # Length of the runs in half periods
        self.members = members  # (n,): Places of the scenes in the task
        # Values by path in lower case, (copies n,)
        self.scenes = {path.lower(): array[members] for path, array in task.scenes.items()}
        self.table = table_of(form, self.scenes)  # (n_row, copies n)
        self.names = [name for name in task.outputs if name != "u_gap"]
        # Rows of the moments that the figures need
        self.needed = sorted({i for name in self.names for i in FIGURES[name.removesuffix("_periodic")]} or {0})
        self.n_moment = ALL_MOMENTS if self.needed[-1] else 1
        # What the scenes need of their steps, each of shape (n,); first, whether there is contact
        table, periodic, cells, others = self.table, task.periodic, form.stack.c.size, CELL_ROWS * form.stack.c.size
        self.possible = table[others + REST] ** 2 > table[others + LOSS] * table[others + LOAD] ** 2
        # Leakage rate of every cell with its area at rest; the largest is an upper bound of the rates of the modes.
        leaks = table[cells : 2 * cells] / table[others + REST] + table[2 * cells : 3 * cells]
        rates = leaks / (table[:cells] * table[others + OMEGA])
        # Smallest leakage rate, in periods over 2 pi; and half a period in time constants of the fastest cell
        self.slowest, self.decays = rates.min(axis=0), np.max(rates, axis=0) * np.pi
        # Pieces of a half period, each twice as long as the one before; 0 for tones
        self.pieces = np.full(table.shape[1], int(form.recording is not None))
        first: FloatArray | float = 0.0
        if form.jumping:
            # Gap voltages at equal distances need a single piece.
            most = 1 if task.traced else _MOST_PIECES
            self.pieces = np.ceil(np.log2(1.0 + _PIECE_START * self.decays)).clip(1, most).astype(int)
            first = self.pieces / (2.0**self.pieces - 1.0)
        elif form.recording is not None and not periodic:
            first = 0.5 * (form.recording.between(0, 1)[0] != 0.0)
        elif not periodic:
            tones = table[-2 * len(form.multiples) :]
            size = np.hypot(tones[::2], tones[1::2]).sum(axis=0)
            from_zero = abs(tones[1::2].sum(axis=0)) <= _FROM_ZERO * size
            first = np.where(from_zero, START_TIMES[2] if task.rtol < _LEADING else 0.0, 1.0)
        # Least number of steps a period (sample); else 0. The first step after a jump of a square, and every step of a
        # run whose source is not 0 V at its start, lasts for a time constant of the fastest cell or less.
        self.least = 2.0 * first * self.decays

    def climb(self) -> None:
        """Find what is wanted; scenes whose error stays too large stay not done."""
        # Scenes that settle after about as many periods share a block, which ends when all of its scenes have settled.
        order = np.argsort(self.slowest) if self.halves > 4 else np.arange(self.members.size)
        rtol, highest, points = self.task.rtol, max(self.form.multiples), self.task.points
        _, one, several, of_piece, degree = next(rung for rung in _RUNGS if rtol >= rung[0])
        for pieces in np.unique(self.pieces[self.possible]).tolist():
            steps = 2 * pieces * of_piece if pieces > 1 else one if highest == 1 else several * highest
            if self.form.recording is not None:
                steps = _PARTS[0]
            if self.task.traced:
                # Half of the steps, too, are an even number.
                each = points * (1 if points % 4 == 0 else 2)
                steps = each * -(-steps // each)
            pending = order[(self.possible & (self.pieces == pieces))[order]]
            for covered in _COVERED:
                pending = self._climb(pending, covered, steps, degree)

    def _climb(self, pending: IntArray, covered: float, steps: int, degree: int) -> IntArray:
        """Find what is wanted of scenes, and return those whose gap voltage the area's polynomial does not serve."""
        form, task, rtol = self.form, self.task, self.task.rtol
        most = _MOST_STEPS * max(form.multiples) if form.recording is None else _PARTS[1]
        # No degree whose rounding is too large.
        highest = self.highest_degree if 0.3 * rtol > 2.0**self.highest_degree * _EPS else 16
        before: Run | None = None  # With half the steps
        last, outside = np.full(pending.size, np.inf), [pending[:0]]
        while pending.size and steps <= most:
            run = self._run(pending, covered, steps, degree, before)
            if run is None:
                break
            error, resolved = self.error(run, pending), self.least[pending] <= steps
            error = np.where(np.isfinite(last), np.maximum(error, last / self.most_gain), error)
            # What decays after a start away from 0 V may have the same error with half the steps, once.
            once = (before is None) & (self.least > self.decays)[pending]
            good = (error <= ENOUGH * self.limit * rtol) & resolved & ~once
            self.enter(run, pending, good)
            at = self.members[pending[good]]
            task.error[at], task.status[at] = error[good] / self.stated, LOCKSTEP
            tail = run.fine[-1].reshape(self.copies, -1)
            beyond, left = np.isinf(tail).any(axis=0), ~good
            if self.gives_up:
                # A scene whose estimate grows from twice the steps: the explicit steps may be unstable around that
                # area. And where the area's polynomial of the highest degree is what limits the error.
                beyond |= ~good & resolved & (error > last)
                left &= (tail <= ENOUGH * rtol).all(axis=0) | (degree < highest or before is None)
            left &= ~beyond
            outside.append(pending[beyond])
            kept = np.tile(left, self.copies)
            before, last = run._replace(fine=run.fine[:, kept], trace=run.trace[kept]), error[left]
            pending, steps = pending[left], 2 * steps
            more = _MORE_DEGREE if tail[:, left].max(initial=0.0) > _SMALL_TAIL * rtol else 0
            degree = max(degree, min(degree + more, highest))
        return np.concatenate(outside)

    def _columns(self, some: IntArray) -> IntArray:
        """Places of all copies of some scenes in the table."""
        return np.add.outer(np.arange(self.copies) * self.members.size, some).ravel()

    def _run(self, pending: IntArray, covered: float, steps: int, degree: int, before: Run | None) -> Run | None:
        """Integrate scenes, for half the steps, too, where `before` has no results; None: no curve."""
        task, form, halves, columns = self.task, self.form, self.halves, self._columns(pending)
        own, matrices = form.gap.values, _to_powers(degree)[:2]
        curves = (np.zeros(0), *matrices) if acting_law(form.gap) else curves_of(own["m_exp"], own["n_exp"], degree)
        if curves is None:
            return None
        sizes, recorded = (steps // 2 if before is None else 0, steps), form.recording is not None
        waves = _waves(sizes[0], form, halves), _waves(sizes[1], form, halves)
        coarse, fine = (np.empty((columns.size, halves * n // 2 if task.traced else 0)) for n in sizes)
        # The cells whose leak has a total resistance, and in any case the gap
        n, gap = form.stack.c.size, form.stack.gap
        assert gap is not None
        leaks: IntArray = np.flatnonzero(self.table[n : 2 * n].any(axis=1) | (np.arange(n) == gap))
        lengths = n - 1, waves[1].shape[1], leaks.size, degree + 1, self.n_moment
        marks, scenes = marks_of(*lengths), (self.table, columns, (gap, leaks), curves)
        pieces, source = int(self.pieces[pending[0]]), (np.array(form.multiples, float), waves, recorded)
        tol = (_CLOSING if task.periodic else _SETTLED) * (task.rtol * self.closer)
        how = halves, steps if recorded else steps // 2, pieces, task.periodic, tol, covered
        if task.device == "cuda" and not recorded:
            out = march_on_card(scenes, source, how, _MOST_PIECES if form.jumping else 0, lengths)
        else:
            out = np.empty((2, (1 + (N_PORTION if recorded else 1)) * self.n_moment + 3, columns.size))
            block = new_block(self.table.shape[0], pieces, marks, N_PORTION if recorded else 1)
            march(scenes, source, how, block, out, (coarse, fine), marks)
        halved = (out[0], coarse) if before is None else (before.fine, before.trace)
        return Run(steps, degree, out[1], fine, *halved)

    def figure(self, name: str, m: FloatArray, columns: IntArray) -> FloatArray:
        """An output of some columns of the table, from their moments."""
        signal, kind = name.removesuffix("_periodic").rsplit("_", 1)
        if signal == "u_gap":
            return np.asarray(np.sqrt(m[2]))
        others, gap = self.table[CELL_ROWS * self.form.stack.c.size :], self.form.gap
        load, stress = others[LOAD, columns], others[STRESS, columns]
        if signal == "f_el":
            return np.asarray(stress * (m[0] if kind == "mean" else np.sqrt(m[1])))
        mu = self.scenes.get(f"{gap.name.lower()}.mu")
        # Friction coefficient times the sum of load and electroadhesive force, N
        normal = load + stress * m[0]
        if kind == "rms":
            normal = np.sqrt(load * load + 2.0 * load * stress * m[0] + stress * stress * m[1])
        force = (gap.values["mu"] if mu is None else mu[columns]) * normal
        return np.asarray(force if signal == "f_t" else force / load)

    def enter(self, run: Run, pending: IntArray, good: BoolArray) -> None:
        """Put what is wanted of the scenes that are `good` among `pending` into the task."""
        at = pending[good]
        for name in self.names:
            # Of the moments, those of the last period are the second ones.
            first = self.n_moment if name.endswith("_periodic") or self.task.periodic else 0
            moments = run.fine[first : first + self.n_moment, good]
            self.task.values[name][self.members[at]] = self.figure(name, moments, at)
        if self.task.traced:
            u, some = self.task.values["u_gap"], run.trace[good, :: run.steps // self.task.points]
            u[self.members[at]] = np.pad(some, ((0, 0), (0, u.shape[1] - some.shape[1])), constant_values=np.nan)

    def error(self, run: Run, pending: IntArray) -> FloatArray:
        """Estimated error of the scenes `pending`: the largest of all outputs, relative to themselves."""
        peak, closing, tail = run.fine[-3:]
        # Of the moments that are needed, in the whole run and in its parts, of shape (n_part + 1, n_needed, n)
        fine, coarse = (x[:-3].reshape(-1, self.n_moment, peak.size)[:, self.needed] for x in (run.fine, run.coarse))
        size, change = np.abs(fine), np.abs(fine - coarse)
        if self.form.recording is not None:
            # Each zero of the gap voltage adds an error as if by chance, so that the sum of all may be small by chance
            # with half the steps, and not with all of them. The root of the sum of their squares is not.
            change[0] = np.maximum(change[0], np.linalg.norm(change[1:], axis=0))
        if self.form.recording is not None or self.halves == 1:
            size, change = size[:1], change[:1]
        off = (change / np.where(size > 0.0, size, 1.0)).max(axis=(0, 1))
        if self.task.traced:
            missed = np.abs(run.trace[:, : 2 * run.trace_coarse.shape[1] : 2] - run.trace_coarse).max(axis=1)
            off = np.maximum(off, missed / np.where(peak > 0.0, peak, 1.0))
        # The area's polynomial of the run with half the steps may be another one.
        change, decays = off + run.coarse[-1], self.decays[pending]
        # A start away from 0 V asks for more steps than there are decays in a half period, any other for fewer.
        begins = 2.0 * decays > _STIFF * run.steps
        more = np.where(self.task.traced | begins | (self.least[pending] > decays), _STATED_MORE, _STATED)
        share: FloatArray | float = np.where(begins & (self.halves <= 2), _STATED_BEGINNING, more)
        if self.form.recording is not None:
            share = _STATED_RECORDED if self.form.stack.c.size == len(self.form.stack.layers) else _STATED_DISPERSIVE
        elif self.form.jumping:
            share = _STATED_JUMPING
        return np.asarray(share * change + tail + 2.0 * closing + _ROUNDING + 2.0**run.degree * _EPS)


class Slopes(Ladder):
    """Derivatives by the parameters asked for: central differences of runs with the very same steps.

    Copies of a scene have one of the parameters smaller, then larger, by a step. The steps do not depend on a
    parameter: a difference has the error of the method and hardly any noise. The tangents of the same steps would have
    this error, too: it comes from the kink of 1/A where the gap voltage is 0, whose order is less by 1 in a derivative.
    """

    limit = 10.0  # For a change of the parameter by all of itself
    stated = 1.0
    # What ends the search for a periodic state moves a difference by 1 / STEP of itself.
    closer = STEP
    # What kinks leave depends on where between two steps they fall.
    most_gain = 8.0
    highest_degree = 16
    gives_up = False
    named = "gradients: "

    def __init__(self, task: Task, form: LockstepForm, halves: int, members: IntArray) -> None:
        super().__init__(task, form, halves, members)
        self.given = np.array([self.scenes[path.lower()] for path in task.paths])  # (n_parameter, n)
        self.possible &= (np.isfinite(self.given) & (self.given != 0.0)).all(axis=0)
        self.copies = 2 * len(task.paths)
        moved = {path: np.tile(array, (2, len(task.paths), 1)) for path, array in self.scenes.items()}
        for k, together in enumerate(task.paths.values()):
            for path in together:
                moved[path.lower()][:, k] *= [[1.0 - STEP], [1.0 + STEP]]
        self.scenes = {path: array.ravel() for path, array in moved.items()}
        self.table = table_of(form, self.scenes)

    def enter(self, run: Run, pending: IntArray, good: BoolArray) -> None:
        """Per unit of the parameter."""
        at = pending[good]
        change, _ = self._changes(run.fine[0], pending)
        for j, name in enumerate(self.task.outputs):
            self.task.values[name][self.members[at]] = (change[j][:, good] / self.given[:, at]).T

    def error(self, run: Run, pending: IntArray) -> FloatArray:
        """For a change of a parameter by all of itself, relative to the output; the largest of all."""
        (_, own), (_, coarse) = (self._changes(each[0], pending) for each in (run.fine, run.coarse))
        largest = np.abs(own).max(axis=(0, 1))
        change = np.abs(own - coarse).max(axis=(0, 1))
        # The third derivative of a power that has this slope, at most.
        cut = STEP**2 / 6.0 * largest * (largest + 1.0) * (largest + 2.0)
        closing, tail = run.fine[-2:].reshape(2, self.copies, -1).max(axis=1)
        # The polynomial's error is one of Chebyshev's, whose slope is larger by its degree.
        tail = run.degree * (tail + run.coarse[-1].reshape(self.copies, -1).max(axis=0))
        noise = 2.0 * closing + _ROUNDING_OF_SLOPES + 2.0**run.degree * _EPS
        return np.asarray(_STATED_SLOPES * change + cut + tail + noise / STEP)

    def _changes(self, mean: FloatArray, pending: IntArray) -> tuple[FloatArray, FloatArray]:
        """Changes of outputs by all of each parameter (n_output, n_parameter, n), and relative to the outputs."""
        columns, outputs = self._columns(pending), self.task.outputs
        values = np.array([self.figure(name, mean[None], columns) for name in outputs])
        low, high = np.moveaxis(values.reshape(len(outputs), 2, len(self.task.paths), -1), 1, 0)
        size, change = np.abs(0.5 * (low + high)), (high - low) / (2.0 * STEP)
        return change, change / np.where(size > 0.0, size, 1.0)


def _waves(n: int, form: LockstepForm, halves: int) -> FloatArray:
    """Sine and cosine of every tone at the times that `step.run` needs; a square's value in both halves; or samples."""
    if form.recording is not None:
        return (form.recording.between(0, halves + 1) / peak_of(form.recording))[: n * (halves + 1), None]
    if n == 0 or form.jumping:
        return np.array([[1.0], [-1.0]])[: 2 * n]
    # The phase in turns is reduced before it is multiplied by 2 pi, so that high tones keep their accuracy.
    times = np.concatenate([0.5 * np.arange(2 * n), START_TIMES])
    turns = np.outer(times, form.multiples) % n * (2.0 * np.pi / n)
    return np.stack([np.sin(turns), np.cos(turns)], axis=2).reshape(times.size, -1)
