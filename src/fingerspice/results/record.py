"""Signals of a run: what is fixed about each, and values by name, from a file or computed when first asked for."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Union

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import BoolArray, FloatArray, read_only
from fingerspice.base.errors import InputError
from fingerspice.circuit.network import Network
from fingerspice.engine.network import Net
from fingerspice.physics.contact import Contact, areas, forces, inverse_area_array
from fingerspice.physics.laws import friction, real_area
from fingerspice.waveforms.waveform import Waveform, require


class Signal(NamedTuple):
    """What is fixed about a signal, wherever it is printed, drawn or written."""

    unit: str
    text: str  # Its long name
    short: str  # Its name in a legend
    axis: str  # Label of its panel in a picture, which signals of the same quantity share
    least: float = 1.0  # A panel's unit has a prefix by which the peak is at least this number
    from_zero: bool = False  # Whether the scale of a panel starts at 0
    of: str = ""  # "source", "layer", "gap" or "node" where each of these has a column
    ripple: bool = False  # Whether its summary has a ripple instead of an rms


#: Signals in the order of tables and files; those of layers and nodes are ``u_layer:NAME`` and ``v:NAME``.
SIGNALS = {
    "u_source": Signal("V", "source voltage", "source", "Voltage", 2.0, of="source"),
    "u_layer": Signal("V", "layer voltage", "layer", "Voltage", 2.0, of="layer"),
    "u_gap": Signal("V", "gap voltage", "gap", "Voltage", 2.0, of="gap"),
    "area": Signal("m^2", "ridge contact area", "area", "Ridge area", of="gap", ripple=True),
    "sigma_el": Signal("Pa", "electroadhesive stress", "electroadhesive stress", "Stress", 2.0, True, "gap"),
    "f_el": Signal("N", "electroadhesive force", "electroadhesive force", "Force", 0.05, True, "gap", True),
    "f_t": Signal("N", "friction force", "friction", "Friction", 0.05, True, "gap", True),
    "friction": Signal(
        "1", "friction coefficient f_t / f_n", "coefficient", "Friction coefficient", 1.0, True, "gap", True
    ),
    "a_real": Signal("m^2", "real contact area", "real area", "Real area", of="gap", ripple=True),
    "q_source": Signal("C", "charge delivered by the source", "charge", "Charge", 2.0, of="source"),
    "i_source": Signal("A", "source current, regular part", "current", "Current", 2.0, of="source"),
    "fold_margin": Signal(
        "1", "distance to the fold of the mobile law", "distance to the fold", "Distance to the fold", from_zero=True
    ),
    "v": Signal("V", "node voltage", "node", "Voltage", 2.0, of="node"),
}


def signal_of(name: str) -> Signal:
    """What is fixed about a signal that is given as ``key`` or ``key:element``."""
    return SIGNALS[name.partition(":")[0]]


class Sealed:
    """A result whose arrays are read-only, also after copying or unpickling, which both make writable arrays."""

    def __post_init__(self) -> None:
        _seal(vars(self))

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        _seal(state)


def _seal(values: dict[Any, Any]) -> None:
    for value in values.values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        elif isinstance(value, dict):
            _seal(value)


def side_by_side(columns: Sequence[FloatArray] | FloatArray) -> FloatArray | None:
    """Signals (n_t,) of several elements as a table, that of one as it is; None of no element."""
    if len(columns) < 2:
        return read_only(np.ascontiguousarray(columns[0])) if len(columns) else None
    return read_only(np.column_stack([*columns]))


#: Friction (N) of each GAP as a function of times (s); None of one without a slip.
Frictions = tuple[Callable[[FloatArray], FloatArray] | None, ...]


#: The name of a signal, or a function of a record, shape (n_t,).
Named = Union[str, "Callable[[Signals], FloatArray]"]


class Signals(Sealed):
    """Outputs of a run, with signals by name, each computed when it is first asked for; shapes as in `Solution`."""

    t: FloatArray  # (n_t,): s; at a jump two entries share a time
    sources: tuple[str, ...]  # Names of the sources, in the order of the columns of their signals
    fingers: tuple[tuple[str, Contact], ...]  # Each GAP's name and contact
    layers: tuple[str, ...]  # Names of the layers, in the order of `u_layer`
    node_voltages: dict[str, FloatArray]
    slides: Frictions = ()

    gaps = cached_property(lambda self: tuple(name for name, _ in self.fingers))  # Names of the GAPs

    _saturates = cached_property(lambda self: any(not math.isinf(contact.p_sat) for _, contact in self.fingers))

    def _of_gaps(self, make: Callable[..., FloatArray], *keys: str) -> FloatArray | None:
        """A signal of the GAPs by their contacts and signals."""
        columns = zip((contact for _, contact in self.fingers), *map(self.each, keys), strict=True)
        return side_by_side([make(*column) for column in columns])

    sigma_el = cached_property(lambda self: self._of_gaps(Contact.stress, "u_gap"))
    friction = cached_property(lambda self: self._of_gaps(lambda contact, f: f / contact.f_n, "f_t"))

    @cached_property
    def f_t(self) -> FloatArray | None:
        """Friction force of each GAP, N; with a slip that of `fingerspice.results.slide`."""
        formed = self._of_gaps(friction, "f_el", *(("area",) if self._saturates else ()))
        if formed is None or not any(self.slides):
            return formed
        columns = (formed,) if formed.ndim == 1 else formed.T
        return side_by_side([x if f is None else f(self.t) for x, f in zip(columns, self.slides, strict=True)])

    @cached_property
    def a_real(self) -> FloatArray | None:
        """Real contact area of each GAP, m^2; None where no GAP has a `p_sat`."""
        return self._of_gaps(real_area, "f_el", "area") if self._saturates else None

    def each(self, key: str) -> Sequence[FloatArray]:
        """A signal of each of its elements, shape (n_t,); none where the run has no such signal."""
        if key == "v":
            return tuple(self.node_voltages.values())
        value = getattr(self, key, None)
        return () if value is None else (value,) if value.ndim == 1 else tuple(value.T)

    def columns(self, key: str) -> tuple[str, ...]:
        """Names of the layers, gaps, sources or nodes to which the columns of a signal belong."""
        of = SIGNALS[key].of
        return () if not of else tuple(self.node_voltages if of == "node" else getattr(self, f"{of}s"))

    def names(self, key: str) -> tuple[str, ...]:
        """``key`` itself, or ``key:element`` for each of several elements; empty where the run has no such signal."""
        base, colon, _ = key.partition(":")
        if base not in SIGNALS or (colon and key not in self.names(base)):
            raise InputError(f"unknown signal {key!r}; allowed: {', '.join(SIGNALS)}")
        if colon:
            return (key,)
        if key == "a_real" and not self._saturates:
            return ()
        several = tuple(f"{key}:{name}" for name in self.columns(key))
        # Decide without computing the signal, where possible.
        if key in ("q_source", "i_source") or (SIGNALS[key].of == "gap" and not several):
            return () if getattr(self, key, None) is None else several if len(several) > 1 else (key,)
        return several if len(several) > 1 or key in ("u_layer", "v") else (key,)

    def one(self, name: Named) -> FloatArray:
        """The signal of one of the `names`, or what a function makes of the record, shape (n_t,)."""
        if callable(name):
            return name(self)
        key, colon, element = name.partition(":")
        return self.each(key)[self.columns(key).index(element) if colon else 0]


class StoredRecord(Signals):
    """Outputs of a run as they were read from a file: signals ``key`` or ``key:element`` as rows (n_t, n)."""

    def __init__(
        self, names: Sequence[str], sources: tuple[str, ...], fingers: tuple[tuple[str, Contact], ...], t: FloatArray,
        left: BoolArray | None, rows: FloatArray,
    ) -> None:  # fmt: skip
        own: dict[str, dict[str, FloatArray]] = {key: {} for key in SIGNALS}
        for name, column in zip(names, rows.T, strict=True):
            key, _, element = name.partition(":")
            own[key][element] = np.ascontiguousarray(column)
        self.t, self.sources, self.fingers = t, sources, fingers
        self.node_voltages, layers = own.pop("v"), own.pop("u_layer")
        self.layers, self.u_layer = tuple(layers), np.column_stack([np.zeros((t.size, 0)), *layers.values()])
        vars(self).update({key: side_by_side([*x.values()]) for key, x in own.items() if x})
        self.__post_init__()


attribute: Callable[..., Any] = property  # A property of a result, with its documentation.


def _given(key: str, doc: str) -> Any:
    """A property: what the record has of this name, None where the run has no such signal."""
    return attribute(lambda result: getattr(result.record, key, None), doc=doc)


class Signalled:
    """A result with the signals of a record."""

    t: FloatArray
    record: Signals

    layers: tuple[str, ...] = _given("layers", "Names of the columns of `u_layer`.")
    gaps: tuple[str, ...] = _given("gaps", "Names of the GAPs.")
    sources: tuple[str, ...] = _given("sources", "Names of the sources; of a series stack there is one, its loop.")
    node_voltages: dict[str, FloatArray] = _given("node_voltages", "Node name to its voltage, V, shape (n_t,).")
    u_source: FloatArray = _given("u_source", "Voltage of each source, V, shape (n_t,); of a series stack the loop's.")
    u_layer: FloatArray = _given("u_layer", "Voltage of each layer from its p to its n node, V, shape (n_t, n_layer).")
    fold_margin: FloatArray = _given("fold_margin", "Distance to the fold: 0 at it, and 1 without stored charge.")
    area: FloatArray | None = _given("area", "Ridge contact area, m^2, shape (n_t,); None for a circuit without any.")
    q_source: FloatArray | None = _given(
        "q_source",
        "Charge delivered by the source since the start, C, shape (n_t,), with the impulses at jumps.\n\n"
        "None where the run was asked to leave it out.",
    )
    i_source: FloatArray | None = _given("i_source", "Source current, A, shape (n_t,), without the impulses at jumps.")
    u_gap: FloatArray | None = _given("u_gap", "Gap voltage, V, shape (n_t,); None for a circuit without GAP.")
    sigma_el: FloatArray | None = _given("sigma_el", "Electroadhesive stress (Eq. 2), Pa; otherwise as `u_gap`.")
    f_el: FloatArray | None = _given(
        "f_el",
        "Electroadhesive force, N, shape (n_t,); None for a circuit without GAP.\n\n"
        "Its mean is `f_el_mean`, and over the last period `f_el_mean_periodic`. ``f_el.mean()`` is another figure: it "
        "gives every output the same weight, including both ends of a period and both rows of a jump, which causes an "
        "error of some per cent at 50 to 200 outputs per period.",
    )
    f_t: FloatArray | None = _given("f_t", "Friction force (Eq. 1), N, shape (n_t,); None for a circuit without GAP.")
    friction: FloatArray | None = _given("friction", "Friction coefficient f_t / f_n; otherwise as `u_gap`.")
    a_real: FloatArray | None = _given("a_real", "Real contact area, m^2, shape (n_t,); None without a ``p_sat``.")

    def by_name(self, key: str) -> dict[str, FloatArray]:
        """A signal by its name, or the columns of several elements by ``name:element``.

        Raises
        ------
        InputError
            For a name that no signal has.
        """
        return {name: self.record.one(name) for name in self.record.names(key)}

    @property
    def signals(self) -> dict[str, tuple[FloatArray, str, str]]:
        """Every signal by name, with its values (n_t,), unit and long name."""
        named = {"u_layer": "voltage of {}", "v": "voltage of node {}"}
        return {
            name: (value, signal.unit, named.get(key, signal.text).format(name.partition(":")[2]))
            for key, signal in SIGNALS.items()
            for name, value in self.by_name(key).items()
        }


#: Dimensions, values and attributes of a variable, as xarray and NetCDF take them.
Variable = tuple[tuple[str, ...], NDArray[Any], dict[str, str]]


def kept_rows(solution: Signalled, jumps: str) -> BoolArray:
    """Mask of the rows that are written, shape (n_t,): all rows, or all but the left-hand rows of jumps."""
    require(jumps in ("right", "both"), "jumps", repr(jumps), "'right' or 'both'")
    return np.append(np.diff(solution.t) > 0.0, True)[: solution.t.size] | (jumps == "both")


def variables(
    solution: Signalled, keep: BoolArray, wanted: Collection[str] = SIGNALS
) -> tuple[dict[str, Variable], dict[str, Variable]]:
    """Variables and coordinates of the data files, with the rows in `keep` and those signals that are wanted."""
    data: dict[str, Variable] = {}
    coords: dict[str, Variable] = {"time": (("time",), solution.t[keep], {"units": "s", "long_name": "time"})}
    for key, signal in ((key, signal) for key, signal in SIGNALS.items() if key in wanted):
        columns = [x[keep] for x in solution.by_name(key).values()]
        about = {"units": signal.unit, "long_name": signal.text}
        if len(columns) > 1 or key in ("u_layer", "v"):
            coords[signal.of] = ((signal.of,), np.array(solution.record.columns(key), dtype=object), {})
            data[key] = (("time", signal.of), np.column_stack([np.zeros((int(keep.sum()), 0)), *columns]), about)
        elif columns:
            data[key] = (("time",), columns[0], about)
    return data, coords


def sided(waveform: Waveform, t: FloatArray, left: BoolArray) -> FloatArray:
    """Values of a waveform at times t (s), shape (n_t,); left-hand limits where `left` is true."""
    out = np.array(waveform.value(t), float)
    if left.any():
        out[left] = waveform.value(t[left], "left")
    if (lost := ~np.isfinite(out)).any():
        # A run ends where the source stops being finite, at a time known to 1e-12: use the finite value just before.
        out[lost] = waveform.value(t[lost] * (1.0 - 4e-12))
    return read_only(out)


@dataclass(frozen=True, eq=False)
class Record(Signals):
    """Outputs of a run as they were computed, and the signals that follow from them."""

    network: Network
    net: Net
    t: FloatArray  # (n_t,): s; at a jump two entries share a time
    left: BoolArray  # (n_t,): Whether an output is the left-hand value at a jump
    # (n_t, size): The state as in `engine.network`; with `has_charge` the sources' currents follow in the last columns,
    # and without it the columns of the charges may be missing
    rows: FloatArray
    has_charge: bool = False
    slides: Frictions = ()

    fingers = cached_property(lambda self: self.network.named_contacts)
    layers = cached_property(lambda self: tuple(e.name for e in self.network.layers))
    sources = cached_property(lambda self: tuple(e.name for e in self.network.sources))

    @cached_property
    def _x(self) -> FloatArray:
        # Methods store rows in different memory orders, on which the rounding of a sum over a row depends.
        return np.ascontiguousarray(self.rows[:, : self.network.k.shape[0]])

    @cached_property
    def _s(self) -> FloatArray:
        """Values of the sources, and of those within a loop, V or A, shape (n_t, n_s + n_inner)."""
        waveforms = (e.waveform for e in (*self.network.sources, *self.network.inner))
        columns = [sided(w, self.t, self.left) for w in waveforms if w is not None]
        # Currents that nodes' voltages follow stand beside the sources.
        return np.column_stack([*columns, *(self.rows[:, -len(columns) :].T if self.network.senses else ())])

    def _voltage(self, by_x: FloatArray, by_s: FloatArray) -> FloatArray:
        """A voltage (V), shape (n_t,), as a weighted sum of the live voltages and the sources."""
        some = [(weight, self._s[:, i]) for i, weight in reversed([*enumerate(by_s.tolist())]) if weight != 0.0]
        some += [(weight, self.rows[:, i]) for i, weight in reversed([*enumerate(by_x.tolist())]) if weight != 0.0]
        if len(some) >= 8:
            # Without BLAS, whose threads may round differently.
            return np.asarray((self._x * by_x).sum(1) + (self._s[:, : by_s.size] * by_s).sum(1))
        if len(some) == 1 and some[0][0] == 1.0:
            return np.ascontiguousarray(some[0][1])
        terms = [weight * column for weight, column in some] or [np.zeros(self.t.size)]
        return np.asarray(sum(terms[1:], terms[0]))

    def cell_voltage(self, cell: int) -> FloatArray:
        """Voltage of a cell from p to n, V, shape (n_t,)."""
        return self._voltage(self.network.p[cell], self.network.q[cell])

    def _area_of(self, i: int) -> FloatArray:
        if self.net.slow[i] >= 0:
            return np.asarray(self.rows[:, self._x.shape[1] + int(self.net.slow[i])] * self.net.area0[i])
        if self.net.gap[i] < 0:
            return np.full(self.t.size, self.net.area0[i])
        return areas(self.cell_voltage(int(self.net.gap[i])), self.net.curves[i])

    @cached_property
    def u_source(self) -> FloatArray | None:
        """Voltage of each source, V: from p to n of a V, and from n to p of an I, the direction in which it drives."""
        out, zero = list(self._s.T[: len(self.network.sources)]), np.zeros(self.t.size)
        for j, element in enumerate(self.network.sources[self.network.n_voltage :], self.network.n_voltage):
            at = {name.lower(): u for name, u in self.node_voltages.items()}
            p, n = (at.get(node, zero) for node in element.nodes[:2])
            out[j] = n - p
        return side_by_side(out)

    @cached_property
    def u_layer(self) -> FloatArray:
        cells = map(self.cell_voltage, range(len(self.network.cells)))
        table = np.column_stack([np.zeros((self.t.size, 0)), *cells])
        return read_only(np.einsum("tc,lc->tl", table, self.network.grouping))

    @cached_property
    def u_gap(self) -> FloatArray | None:
        return side_by_side([self.cell_voltage(cell) for cell in self.network.finger_cells])

    @cached_property
    def area(self) -> FloatArray | None:
        """Contact area of each GAP, m^2; without a GAP the circuit's first area; None where there is none."""
        return side_by_side([self._area_of(i) for i in self.network.fingers or range(min(1, len(self.network.areas)))])

    @cached_property
    def f_el(self) -> FloatArray | None:
        """Electroadhesive force (Eq. 2 times A_R), N."""
        out = []
        for i, (_, contact), u in zip(self.network.fingers, self.fingers, self.each("u_gap"), strict=True):
            if self.net.gap[i] >= 0 and self.net.slow[i] < 0 and not self.network.owned:
                out.append(forces(u, self.net.curves[i], float(contact.stress(1.0))))
            else:
                every = np.array([self._area_of(j) for j in range(self.net.gap.size)])
                out.append(contact.per_volt * u**2 * self.network.pulled(i, every))
        return side_by_side(out)

    @cached_property
    def q_source(self) -> FloatArray | None:
        """Charge (C) that each source has delivered at its p node, or at its n node if it is an I."""
        n_s = len(self.network.sources)
        end = self.rows.shape[1] - n_s
        return side_by_side(self.rows[:, end - n_s : end].T) if self.has_charge else None

    @cached_property
    def i_source(self) -> FloatArray | None:
        """Current (A) that each source delivers at that node, without the impulses at jumps."""
        return side_by_side(self.rows[:, -len(self.network.sources) :].T) if self.has_charge else None

    @cached_property
    def fold_margin(self) -> FloatArray:
        """Distance to the fold of the `mobile` law, 1 where no area feels a voltage, shape (n_t,).

        Ratio of the determinant of the differential capacitances to that of the capacitances at fixed areas.
        """
        net, n = self.net, self._x.shape[1]
        out = np.ones(self.t.size)
        if not net.mobile or not np.any((net.gap >= 0) & (net.slow < 0)):
            return read_only(out)
        area = np.column_stack([self._area_of(i) for i in range(net.gap.size)])
        held, met = np.zeros((2, self.t.size, n, n))
        for cell in range(net.c.size):
            i, row, cut = int(net.place[cell]), net.p[cell], net.cut[cell]
            own = net.c[cell] * (np.ones(self.t.size) if i < 0 else area[:, i])
            held += own[:, None, None] * np.outer(cut, row)
            if i >= 0 and net.gap[i] >= 0 and net.slow[i] < 0:
                u = self.cell_voltage(int(net.gap[i]))
                inverse, slope = inverse_area_array(np.abs(u), net.curves[i])
                cross = net.c[cell] * self.cell_voltage(cell) * -np.sign(u) * slope / inverse**2
                met += cross[:, None, None] * np.outer(cut, net.p[net.gap[i]])
        return read_only(np.linalg.det(held + met) / np.linalg.det(held))

    @cached_property
    def node_voltages(self) -> dict[str, FloatArray]:  # type: ignore[override]
        n, course, out = self._x.shape[1], self.network.course, dict[str, FloatArray]()
        for name, row in zip(self.network.node_names, self.network.nodes, strict=True):
            out[name] = read_only(self._voltage(row[:n], row[n:]))
        if course is None or not self.t.size:
            return out
        times, on = course.changes(float(self.t.max()))
        state = np.where(self.left, times.searchsorted(self.t), times.searchsorted(self.t, "right"))
        kinds, which = np.unique(on, axis=0, return_inverse=True)
        every = np.hstack([self._x, self._s])
        networks = [self.network.switched(tuple(kind.tolist())) for kind in kinds]
        values = np.zeros((self.t.size, len(out)))
        for kind, network in enumerate(networks):
            here = which.ravel()[state] == kind
            values[here] = np.einsum("tc,nc->tn", every[here], network.nodes)
        return {name: read_only(column) for name, column in zip(out, values.T.copy(), strict=True)}
