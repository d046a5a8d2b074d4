"""Measures of a run: means, extremes, crossings and delays, from the run between its outputs where that is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.polynomial import chebyshev

from fingerspice.base.arrays import FloatArray
from fingerspice.base.pages import Table
from fingerspice.base.units import format_si
from fingerspice.circuit.measures import LAST, PARTS, Crossing, Measure, Quantity, Vector
from fingerspice.circuit.network import network_of
from fingerspice.numerics.lobatto import NODES, POINTS, TO_SERIES
from fingerspice.results.record import Record, Signals, signal_of
from fingerspice.results.steps import WEIGHTS, Outputs, Stretch, Weighed, weigh_outputs

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit, Element
    from fingerspice.results.solution import Solution
    from fingerspice.results.spectrum import PhasorSolution

_MOST_PIECES, _MOST_HALVINGS = 60, 12  # Of a sweep, with as many polynomials, before pieces are halved
_FIGURES = {"min": "min", "max": "max", "mean": "avg", "rms": "rms"}  # Of saved vectors, with the form of a measure
_TOLERANCE = 1e-12  # Of the polynomials in which crossings are looked for, relative to the peak


class Failed(Exception):
    """A measure that has no value, and why."""


def values_of(solution: Solution, quantity: Quantity) -> Callable[[Signals], FloatArray]:
    """A quantity as a function of a record of the run, shape (n_t,)."""
    columns = [_vector(solution, vector) for vector in quantity.vectors]
    if quantity.function is None:
        return columns[0]
    made = np.vectorize(quantity.function, otypes=[float])

    def values(record: Signals) -> FloatArray:
        try:
            return np.asarray(made(*(column(record) for column in columns)))
        except (ArithmeticError, ValueError) as error:
            raise Failed(f"{quantity.text} has no value: {error}") from None

    return values


def _vector(solution: Solution, vector: Vector) -> Callable[[Signals], FloatArray]:
    circuit, (first, *more) = solution.circuit, vector.names
    if vector.kind == "v":

        def difference(record: Signals) -> FloatArray:
            at = {name.lower(): v for name, v in record.node_voltages.items()} | areas_of(record, circuit)
            for name in vector.names:
                if name != "0" and name not in at:
                    raise Failed(f"node {name} has no voltage of its own")
            zero = np.zeros(record.t.size)
            return at.get(first, zero) - (at.get(more[0], zero) if more else zero)

        return difference
    element = circuit[first]
    if vector.kind != "i":

        def signal(record: Signals) -> FloatArray:
            for name in record.names(vector.kind):
                if name.partition(":")[2].lower() in ("", first):
                    return record.one(name)
            raise Failed(f"{element.name} has no {vector.kind}; allowed: of a GAP with p_sat")

        return signal
    if element.device == "R":
        across = _vector(solution, Vector("v", element.nodes))
        return lambda record: across(record) / element.values["value"]
    if element.device == "L":
        return _of_inductor(circuit, element)
    if element.device not in "VI":
        raise Failed(f"I({element.name}) of a {element.device} is no signal; allowed: of a V, an I, an R or an L")

    def current(record: Signals) -> FloatArray:
        if first not in (found := currents_of(record, circuit)):
            raise Failed("the run has no currents; ask for them with charge=True")
        return found[first]

    return current


def saved_columns(solution: Solution) -> dict[str, tuple[FloatArray, str]]:
    """Values (n_t,) and units of what the deck's `.save` lines name, or of all signals."""
    if not solution.circuit.saved:
        return {name: (x, unit) for name, (x, unit, _) in solution.signals.items()}
    found = {}
    for one in solution.circuit.saved:
        try:
            values = values_of(solution, one)(solution.record)
        except Failed:
            values = np.full(solution.t.size, math.nan)
        found[one.text] = values, _unit(solution, one)
    return found


def saved_figures(solution: Solution) -> list[dict[str, Any]]:
    """Unit and figures over the run of each vector that the deck's `.save` lines name; NaN where it has none."""
    return [
        {"vector": one.text, "unit": _unit(solution, one)}
        | {key: x.value for key, x in measured(solution, [Measure(k, f, one) for k, f in _FIGURES.items()]).items()}
        for one in solution.circuit.saved
    ]


def _unit(solution: Solution, quantity: Quantity) -> str:
    kind, names = quantity.vectors[0] if quantity.function is None else ("", ())
    # An area node has mm^2, as it is in SPICE.
    if kind == "v" and set(names) <= areas_of(solution.record, solution.circuit).keys():
        return "mm^2"
    return {"": "1", "i": "A"}.get(kind) or signal_of(kind).unit


def _of_inductor(circuit: Circuit, element: Element) -> Callable[[Signals], FloatArray]:
    """The current of an inductor from its p node on, A."""
    network, names = network_of(circuit), [e.name for e in circuit.by_device("L")]
    (count, coils), end = network.coils.shape, network.k.shape[0]

    def current(record: Signals) -> FloatArray:
        if count < coils or not isinstance(record, Record):
            raise Failed(f"I({element.name}) is not known; allowed: of a V element of 0 V in series")
        return np.asarray(record.rows[:, end - count : end] @ np.linalg.inv(network.coils)[names.index(element.name)])

    return current


def areas_of(record: Signals, circuit: Circuit) -> dict[str, FloatArray]:
    """Area (mm^2) of each GAP by its area node, as SPICE has it; none where a file has left out the elements."""
    nodes = [circuit[gap].nodes[2] for gap in record.gaps] if circuit.elements else []
    return {node: 1e6 * x for node, x in zip(nodes, record.each("area"), strict=False)}


def currents_of(record: Signals, circuit: Circuit) -> dict[str, FloatArray]:
    """Current (A) of each source from its p node through it, as SPICE has it, by name; none likewise."""
    currents = record.each("i_source")
    if not circuit.elements or not len(currents):
        return {}
    network = network_of(circuit)
    if network.stack is not None:
        return {e.name.lower(): -sign * currents[0] for e, sign in network.drives}
    pairs = enumerate(zip(network.sources, currents, strict=True))
    return {e.name.lower(): x if k >= network.n_voltage else -x for k, (e, x) in pairs}


class _Course:
    """A quantity between two times (s), as Chebyshev series on consecutive pieces."""

    unit = "s"

    def __init__(self, solution: Solution, quantity: Quantity, since: float, until: float) -> None:
        self.values, self.since, self.until = values_of(solution, quantity), since, until
        # Currents of sources are known at the outputs only.
        of_sources = any(one.kind == "i" and solution.circuit[one.names[0]].device in "VI" for one in quantity.vectors)
        found = None if of_sources else solution._stretch(since, until)
        self.span: Stretch | Outputs = Outputs(solution.record)
        if found is not None:
            self.span = Stretch(found.run.each_once(), since, until, solution.rtol)
            panels = self.span.resolved(self.values, _TOLERANCE)
            t, x = self.span.run.at_points(self.values, panels)
            order = t[:, 0].argsort(kind="stable")
            self.begin, self.length = t[order, 0], panels[3, order]
            self.series = x[order, :NODES] @ TO_SERIES[:, :NODES]
        else:
            self.t, self.x = self._outputs(solution.record)
            keep = np.diff(self.t) > 0.0
            self.begin, self.length = self.t[:-1][keep], np.diff(self.t)[keep]
            low, high = self.x[:-1][keep], self.x[1:][keep]
            self.series = np.column_stack([0.5 * (low + high), 0.5 * (high - low)])
        if not self.begin.size:
            raise Failed("the run has no outputs in its window")

    def _outputs(self, record: Signals) -> tuple[FloatArray, FloatArray]:
        """Times and values of the outputs in the window, with interpolated ones at its ends."""
        t, x = record.t, self.values(record)
        inside = (t > self.since) & (t < self.until)
        ends = np.interp([self.since, self.until], t, x)
        return np.r_[self.since, t[inside], self.until], np.r_[ends[0], x[inside], ends[1]]

    def at(self, t: float, derivative: bool = False) -> float:
        """The value, or the derivative, at a time (s)."""
        if not self.since <= t <= self.until:
            raise Failed(f"{t:g} {self.unit} is outside the run or the window")
        k = int(np.clip(np.searchsorted(self.begin, t, side="right") - 1, 0, self.begin.size - 1))
        place, series = 2.0 * (t - self.begin[k]) / self.length[k] - 1.0, self.series[k]
        if derivative:
            return float(chebyshev.chebval(place, chebyshev.chebder(series)) * 2.0 / self.length[k])
        return float(chebyshev.chebval(place, series))

    def weighed(self, longest: float = math.inf) -> Weighed:
        """Values with weights for means, on pieces of at most `longest` (s)."""
        span = self.span
        return span.weigh(self.values, longest) if isinstance(span, Stretch) else weigh_outputs(self.t, self.x)

    def extreme(self, sign: float) -> tuple[float, float]:
        """Time (s) and value of the largest value, or with the sign -1 of the smallest."""
        if isinstance(self.span, Stretch):
            return self.span.extremes(self.values)[sign > 0.0]
        place = int((sign * self.x).argmax())
        return float(self.t[place]), float(self.x[place])

    def crossings(self, value: float) -> Iterator[tuple[float, float]]:
        """Times (s) at which it crosses a value, each with the sign of its slope there."""
        series = self.series.copy()
        series[:, 0] -= value
        before = 0.0
        turning = np.abs(series[:, 0]) <= np.abs(series[:, 1:]).sum(axis=1)
        signs = np.sign(series[:, 0])
        for k in range(self.begin.size):
            cuts = [-1.0]
            if turning[k]:
                roots = chebyshev.chebroots(chebyshev.chebtrim(series[k]))
                cuts += sorted(roots.real[(np.abs(roots.imag) < 1e-8) & (np.abs(roots.real) < 1.0)].tolist())
            for low, high in zip(cuts, [*cuts[1:], 1.0], strict=True):
                middle = 0.5 * (low + high)
                sign = float(np.sign(chebyshev.chebval(middle, series[k]))) if turning[k] else float(signs[k])
                if sign != 0.0:
                    if before not in (0.0, sign):
                        yield float(self.begin[k] + 0.5 * (low + 1.0) * self.length[k]), sign
                    before = sign


class _Swept(_Course):
    """A quantity between two frequencies (Hz), from phasors at the nodes of polynomials between those of a sweep."""

    unit = "Hz"

    def __init__(self, sweep: Sweep, quantity: Quantity, since: float, until: float) -> None:
        inside = sweep.frequency[(sweep.frequency > since) & (sweep.frequency < until)]
        edges = np.r_[since, inside[:: 1 + inside.size // _MOST_PIECES], until]
        begin, length, found = edges[:-1], np.diff(edges), list[tuple[FloatArray, ...]]()
        for rest in range(_MOST_HALVINGS, -1, -1):
            nodes = begin[:, None] + length[:, None] * POINTS[:NODES]
            solved = sweep.solve(nodes.ravel())
            columns = [_part(solved, vector) for vector in quantity.vectors]
            made = (
                columns[0] if quantity.function is None else np.vectorize(quantity.function, otypes=[float])(*columns)
            )
            x = made.reshape(nodes.shape)
            series = x @ TO_SERIES[:, :NODES]
            # Near a resonance, pieces are halved until the last terms of their polynomials vanish.
            wild = (np.abs(series[:, -2:]).max(axis=1) > _TOLERANCE * np.abs(series).max()) & (rest > 0)
            found.append((begin[~wild], length[~wild], nodes[~wild], x[~wild], series[~wild]))
            half = 0.5 * length[wild]
            begin, length = np.r_[begin[wild], begin[wild] + half], np.r_[half, half]
            if not begin.size:
                break
        self.since, self.until = since, until
        order = np.concatenate([one[0] for one in found]).argsort()
        self.begin, self.length, nodes, x, self.series = (
            np.concatenate(one)[order] for one in zip(*found, strict=True)
        )
        self.t, self.x = nodes.ravel(), x.ravel()

    def extreme(self, sign: float) -> tuple[float, float]:
        best = int((sign * self.x).argmax()) // NODES
        places = [self.since, self.until]
        for k in range(max(best - 1, 0), min(best + 2, self.begin.size)):
            roots = chebyshev.chebroots(chebyshev.chebder(self.series[k]))
            within = roots.real[(np.abs(roots.imag) < 1e-8) & (np.abs(roots.real) < 1.0)]
            places += [self.begin[k], *(self.begin[k] + 0.5 * (within + 1.0) * self.length[k])]
        return max(((float(f), self.at(f)) for f in places), key=lambda one: sign * one[1])

    def weighed(self, longest: float = math.inf) -> Weighed:
        share = self.length[:, None] / self.length.sum()
        return Weighed(self.t, (share * WEIGHTS).ravel(), self.x)


def _part(found: PhasorSolution, vector: Vector) -> FloatArray:
    """A part of the voltage between nodes, or a figure of a sweep."""
    if vector.kind in PARTS:
        at = dict(zip(map(str.lower, found.nodes), np.asarray(found.v_nodes).T, strict=True))
        missing = [name for name in vector.names if name not in ("0", *at)]
        if missing:
            raise Failed(f"node {missing[0]} has no voltage of its own")
        first, other = (at.get(name, np.zeros(found.frequency.size)) for name in (*vector.names, "0")[:2])
        v = first - other
        with np.errstate(divide="ignore"):
            decibels = 20.0 * np.log10(np.abs(v))
        return np.asarray({"vi": v.imag, "vm": np.abs(v), "vp": np.angle(v), "vdb": decibels}.get(vector.kind, v.real))
    if vector.kind == "u_gap":
        return np.abs(found.u_gap)
    if vector.kind not in ("area", "f_el"):
        of = f"{vector.kind} of {', '.join(vector.names)}"
        raise Failed(f"{of} is no part of a sweep; allowed: V, VM, VDB, VP, VR, VI")
    return found.area if vector.kind == "area" else found.f_el_mean


class Sweep:
    """What a measure of `.ac` needs of a sweep at frequencies (Hz): those, and the same sweep at others."""

    def __init__(self, circuit: Circuit, frequency: FloatArray, solve: Callable[[FloatArray], PhasorSolution]) -> None:
        self.circuit, self.frequency = circuit, np.unique(frequency)
        self.first, self.t_stop = float(self.frequency[0]), float(self.frequency[-1])
        self._solve = solve
        self._found: dict[bytes, PhasorSolution] = {}

    def solve(self, f: FloatArray) -> PhasorSolution:
        """The sweep at other frequencies, which several measures may ask for."""
        if (found := self._found.get(f.tobytes())) is None:
            found = self._found[f.tobytes()] = self._solve(f)
        return found


def _course(run: Solution | Sweep, quantity: Quantity, since: float, until: float) -> _Course:
    kind = _Swept if isinstance(run, Sweep) else _Course
    if not since < until:
        raise Failed(f"its window from {since:g} to {until:g} {kind.unit} is empty")
    return kind(run, quantity, since, until)  # type: ignore[arg-type]


def _time(solution: Solution | Sweep, crossing: Crossing, since: float, until: float) -> float:
    """When a quantity has its value."""
    if crossing.of is None:
        return crossing.value
    course = _course(solution, crossing.of, max(since, crossing.since), until)
    wanted = {"rise": (1.0,), "fall": (-1.0,), "cross": (1.0, -1.0)}[crossing.edge]
    times = [t for t, sign in course.crossings(crossing.value) if sign in wanted]
    if len(times) < max(crossing.number, 1):
        low, high = course.extreme(-1.0)[1], course.extreme(1.0)[1]
        asked = crossing.edge.upper(), "LAST" if crossing.number == LAST else crossing.number
        said = f"{crossing.of.text} has {len(times)} of {crossing.value:g} where {asked[0]}={asked[1]} is asked for"
        raise Failed(f"{said}; it runs from {low:g} to {high:g}")
    return times[LAST if crossing.number == LAST else crossing.number - 1]


class Measured(NamedTuple):
    """A measure's value, NaN where it has none; the time (s) that belongs to it; and why it has none."""

    value: float
    at: float = math.nan
    failed: str = ""


def _reached(solution: Solution | Sweep) -> float:
    """Time (s) up to which the run is known: its end, or where it stopped; of a sweep the last frequency."""
    failed = not isinstance(solution, Sweep) and solution.failure is not None
    return min(float(solution.t[-1]), solution.t_stop) if failed else solution.t_stop  # type: ignore[union-attr]


def _made(solution: Solution | Sweep, one: Measure, known: Mapping[str, float]) -> Measured:
    if one.refused:
        raise Failed(one.refused)
    if one.formula is not None:
        for name in one.needs:
            if math.isnan(known[name]):
                raise Failed(f"{name} has no value")
        try:
            return Measured(float(one.formula(known)))
        except Exception as error:
            raise Failed(f"its expression has no value: {error or type(error).__name__}") from None
    first, last, unit = solution.first, _reached(solution), "Hz" if isinstance(solution, Sweep) else "s"
    since, until = one.since if one.since is not None else first, one.until if one.until is not None else last
    if since < first or until > last * (1.0 + 1e-12):
        raise Failed(f"its window from {since:g} to {until:g} is not within the run from {first:g} to {last:g} {unit}")
    until = min(until, last)
    if one.kind == "trig":
        assert one.start is not None
        assert one.stop is not None
        begun, ended = (_time(solution, crossing, since, until) for crossing in (one.start, one.stop))
        return Measured(ended - begun, ended)
    if one.kind == "when":
        assert one.start is not None
        return Measured(t := _time(solution, one.start, since, until), t)
    assert one.of is not None
    course = _course(solution, one.of, since, until)
    if one.start is not None:
        t = _time(solution, one.start, since, until)
        return Measured(course.at(t, one.kind == "deriv"), t)
    if one.kind in ("avg", "rms", "integ"):
        weighed, length = course.weighed(), until - since
        return Measured(math.sqrt(weighed.mean(2)) if one.kind == "rms"
                        else weighed.mean() * (length if one.kind == "integ" else 1.0))  # fmt: skip
    (t_low, low), (t_high, high) = course.extreme(-1.0), course.extreme(1.0)
    return {
        "min": Measured(low, t_low), "max": Measured(high, t_high), "pp": Measured(high - low),
        "min_at": Measured(t_low, t_low), "max_at": Measured(t_high, t_high),
    }[one.kind]  # fmt: skip


def measured(solution: Solution | Sweep, asked: Sequence[Measure] | None = None) -> dict[str, Measured]:
    """The deck's measures of a run or of a sweep, or those asked for, by name."""
    found: dict[str, Measured] = {}
    analysis, size = ("ac", solution.frequency.size) if isinstance(solution, Sweep) else ("tran", solution.t.size)
    asked = solution.circuit.measures if asked is None else asked
    for one in [one for one in asked if one.analysis == analysis]:
        try:
            if size < 2:
                raise Failed("the run has no outputs")
            found[one.name] = _made(solution, one, {name.lower(): x.value for name, x in found.items()})
        except Failed as failed:
            found[one.name] = Measured(math.nan, failed=str(failed))
    return found


def measures_table(found: Mapping[str, Measured], unit: str) -> tuple[str | Table, ...]:
    """Blocks of a page with measures, and the times (s) or frequencies (Hz) that belong to them."""
    rows = [(name, one.failed or f"{one.value:.6g}", "" if math.isnan(one.at) else format_si(one.at, unit))
            for name, one in found.items()]  # fmt: skip
    return ("", Table(("measure", "value", "at"), rows)) if rows else ()


HARMONICS = 10  #: Of a `.four` line, the mean counted.


@dataclass(frozen=True)
class Fourier:
    """Harmonics of a vector over the last period of a frequency, from integrals of the run.

    Attributes
    ----------
    vector : str
    frequency : float
        Hz.
    magnitude, phase_deg : ndarray, shape (10,)
        Of the harmonics from the mean on, in the vector's unit, and degrees relative to a sine.
    thd : float
        Root of the sum of the squares of all harmonics but the first over the first, %.
    """

    vector: str
    frequency: float
    magnitude: FloatArray
    phase_deg: FloatArray
    thd: float

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return vars(self) | {name: getattr(self, name).tolist() for name in ("magnitude", "phase_deg")}

    @classmethod
    def made(cls, plain: Mapping[str, Any]) -> Fourier:
        """From plain data."""
        own: dict[str, Any] = {name: np.array(x) if isinstance(x, list) else x for name, x in plain.items()}
        return cls(**own)

    def table(self) -> Table:
        """The harmonics as SPICE prints them."""
        first = self.magnitude[1] or math.nan
        rows = [
            (str(k), format_si(k * self.frequency, "Hz"), f"{x:.6g}", f"{phase:.4g}", f"{x / first:.6g}")
            for k, (x, phase) in enumerate(zip(self.magnitude.tolist(), self.phase_deg.tolist(), strict=True))
        ]
        return Table(("", "frequency", "magnitude", "phase [deg]", "over the first"), rows)


def _fourier(solution: Solution, quantity: Quantity, frequency: float) -> Fourier:
    last = _reached(solution)
    since = last - 1.0 / frequency
    if since < solution.first - 1e-9 / frequency:
        raise Failed(f"the run holds no whole period of {frequency:g} Hz")
    course = _course(solution, quantity, max(since, solution.first), last)
    weighed = course.weighed(0.5 / (frequency * HARMONICS))
    found = [complex(weighed.mean()), *(weighed.phasor(k * frequency) for k in range(1, HARMONICS))]
    magnitude, phase = np.abs(found), np.degrees(np.angle(found))
    thd = 100.0 * math.sqrt(float((magnitude[2:] ** 2).sum())) / magnitude[1] if magnitude[1] > 0.0 else math.nan
    return Fourier(quantity.text, frequency, magnitude, phase, thd)


class Measuring:
    """A result with the measures of its deck."""

    @cached_property
    def measured(self) -> dict[str, Measured]:
        """The measures of the deck's `.meas` lines by name: their ``value``, ``at`` (s), and why one ``failed``."""
        return measured(cast("Solution", self))

    @property
    def measures(self) -> dict[str, float]:
        """Their values alone, NaN where there is none."""
        return {name: one.value for name, one in self.measured.items()}

    @cached_property
    def fourier(self) -> dict[str, Fourier | str]:
        """The harmonics of the deck's `.four` lines by vector; in words, why there are none."""
        found: dict[str, Fourier | str] = {}
        solution = cast("Solution", self)
        for frequency, quantity in solution.circuit.fourier:
            try:
                found[quantity.text] = _fourier(solution, quantity, frequency)
            except Failed as failed:
                found[quantity.text] = str(failed)
        return found

    def _measures_shown(self) -> Iterator[str | Table]:
        """The blocks of measures and harmonics on a page."""
        yield from measures_table(self.measured, "s")
        for name, harmonics in self.fourier.items():
            shown = harmonics if isinstance(harmonics, str) else f"total harmonic distortion {harmonics.thd:.6g} %"
            yield from ("", f"{name}: {shown}")
            yield from () if isinstance(harmonics, str) else (harmonics.table(),)
