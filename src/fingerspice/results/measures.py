"""Measures of a run: means, extremes, crossings and delays, from the run between its outputs where that is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.polynomial import chebyshev

from fingerspice.base.arrays import FloatArray
from fingerspice.base.pages import Table
from fingerspice.base.units import format_si
from fingerspice.circuit.measures import LAST, Crossing, Measure, Quantity, Vector
from fingerspice.circuit.network import network_of
from fingerspice.numerics.lobatto import NODES, TO_SERIES
from fingerspice.results.record import Record, Signals
from fingerspice.results.steps import Outputs, Stretch, Weighed, weigh_outputs

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit, Element
    from fingerspice.results.solution import Solution

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

    def __init__(self, solution: Solution, quantity: Quantity, since: float, until: float) -> None:
        if not since < until:
            raise Failed(f"its window from {since:g} to {until:g} s is empty")
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
            raise Failed(f"{t:g} s is outside the run or the window")
        k = int(np.clip(np.searchsorted(self.begin, t, side="right") - 1, 0, self.begin.size - 1))
        place, series = 2.0 * (t - self.begin[k]) / self.length[k] - 1.0, self.series[k]
        if derivative:
            return float(chebyshev.chebval(place, chebyshev.chebder(series)) * 2.0 / self.length[k])
        return float(chebyshev.chebval(place, series))

    def weighed(self, longest: float = math.inf) -> Weighed:
        """Values with weights for means, on pieces of at most `longest` (s)."""
        return (
            self.span.weigh(self.values, longest) if isinstance(self.span, Stretch) else weigh_outputs(self.t, self.x)
        )

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


def _time(solution: Solution, crossing: Crossing, since: float, until: float) -> float:
    """When a quantity has its value."""
    if crossing.of is None:
        return crossing.value
    course = _Course(solution, crossing.of, max(since, crossing.since), until)
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


def _reached(solution: Solution) -> float:
    """Time (s) up to which the run is known: its end, or where it stopped."""
    return solution.t_stop if solution.failure is None else min(float(solution.t[-1]), solution.t_stop)


def _made(solution: Solution, one: Measure, known: Mapping[str, float]) -> Measured:
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
    first, last = solution.first, _reached(solution)
    since, until = one.since if one.since is not None else first, one.until if one.until is not None else last
    if since < first or until > last * (1.0 + 1e-12):
        raise Failed(f"its window from {since:g} to {until:g} s is not within the run from {first:g} to {last:g} s")
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
    course = _Course(solution, one.of, since, until)
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


def measured(solution: Solution) -> dict[str, Measured]:
    """The measures of the deck, by name."""
    found: dict[str, Measured] = {}
    for one in solution.circuit.measures:
        try:
            if solution.t.size < 2:
                raise Failed("the run has no outputs")
            found[one.name] = _made(solution, one, {name.lower(): x.value for name, x in found.items()})
        except Failed as failed:
            found[one.name] = Measured(math.nan, failed=str(failed))
    return found


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
    course = _Course(solution, quantity, max(since, solution.first), last)
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
        rows = [(name, one.failed or f"{one.value:.6g}", "" if math.isnan(one.at) else format_si(one.at, "s"))
                for name, one in self.measured.items()]  # fmt: skip
        yield from ("", Table(("measure", "value", "at"), rows)) if rows else ()
        for name, harmonics in self.fourier.items():
            shown = harmonics if isinstance(harmonics, str) else f"total harmonic distortion {harmonics.thd:.6g} %"
            yield from ("", f"{name}: {shown}")
            yield from () if isinstance(harmonics, str) else (harmonics.table(),)
