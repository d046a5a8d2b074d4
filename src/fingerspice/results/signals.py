"""Signals of a run: what is fixed about each, and their values by name from a record or from a file."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.physics.contact import Contact
from fingerspice.waveforms.waveform import require


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
    # Other signals follow from the record itself: this one from another signal, with the contact of the gap
    base: str = ""
    make: Callable[[Contact, FloatArray], FloatArray] | None = None


#: Signals in the order of tables and files; those of layers and nodes are ``u_layer:NAME`` and ``v:NAME``.
SIGNALS = {
    "u_source": Signal("V", "source voltage", "source", "Voltage", 2.0, of="source"),
    "u_layer": Signal("V", "layer voltage", "layer", "Voltage", 2.0, of="layer"),
    "u_gap": Signal("V", "gap voltage", "gap", "Voltage", 2.0, of="gap"),
    "area": Signal("m^2", "ridge contact area", "area", "Ridge area", of="gap", ripple=True),
    "sigma_el": Signal(
        "Pa", "electroadhesive stress", "electroadhesive stress", "Stress", 2.0, True, "gap", False, "u_gap",
        Contact.stress,
    ),
    "f_el": Signal("N", "electroadhesive force", "electroadhesive force", "Force", 0.05, True, "gap", True),
    "f_t": Signal(
        "N", "friction force", "friction", "Friction", 0.05, True, "gap", True, "f_el",
        lambda contact, f: contact.mu * (contact.f_n + f),
    ),
    "friction": Signal(
        "1", "friction coefficient f_t / f_n", "coefficient", "Friction coefficient", 1.0, True, "gap", True, "f_t",
        lambda contact, f: f / contact.f_n,
    ),
    "q_source": Signal("C", "charge delivered by the source", "charge", "Charge", 2.0, of="source"),
    "i_source": Signal("A", "source current, regular part", "current", "Current", 2.0, of="source"),
    "fold_margin": Signal(
        "1", "distance to the fold of the mobile law", "distance to the fold", "Distance to the fold", from_zero=True
    ),
    "v": Signal("V", "node voltage", "node", "Voltage", 2.0, of="node"),
}  # fmt: skip


def signal_of(name: str) -> Signal:
    """What is fixed about a signal that is given as ``key`` or ``key:element``."""
    return SIGNALS[name.partition(":")[0]]


def sealed(x: FloatArray) -> FloatArray:
    """The same array, read-only."""
    x.flags.writeable = False
    return x


class Sealed:
    """A result whose arrays are read-only, also after copying or unpickling, which both make writable arrays."""

    def __post_init__(self) -> None:
        for value in vars(self).values():
            for array in value.values() if isinstance(value, dict) else (value,):
                if isinstance(array, np.ndarray):
                    sealed(array)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        Sealed.__post_init__(self)


def side_by_side(columns: Sequence[FloatArray] | FloatArray) -> FloatArray:
    """Signals (n_t,) of several elements as a table, that of one as it is."""
    # A view of a run's rows is copied, so that it does not seal them.
    return sealed(np.column_stack([*columns]) if len(columns) != 1 else np.array(columns[0]))


class Signals(Sealed):
    """Outputs of a run, with signals by name, each computed when it is first asked for; shapes as in `Solution`."""

    t: FloatArray  # (n_t,): s; at a jump two entries share a time
    sources: tuple[str, ...]  # Names of the sources, in the order of the columns of their signals
    fingers: tuple[tuple[str, Contact], ...]  # Each GAP's name and contact
    layers: tuple[str, ...]  # Names of the layers, in the order of `u_layer`
    node_voltages: dict[str, FloatArray]

    @property
    def gaps(self) -> tuple[str, ...]:
        """Names of the GAPs."""
        return tuple(name for name, _ in self.fingers)

    def value(self, key: str) -> FloatArray | None:
        """A signal, shape (n_t,), or (n_t, n) where n elements have it; None where the run has no such signal."""
        signal = SIGNALS[key]
        if signal.of == "gap" and key != "area" and not self.fingers:
            return None
        if signal.make is not None and key not in vars(self):
            base = self.value(signal.base)
            assert base is not None
            columns = [base] if len(self.fingers) == 1 else base.T
            made = [signal.make(contact, x) for (_, contact), x in zip(self.fingers, columns, strict=True)]
            vars(self)[key] = side_by_side(made)
        found: FloatArray | None = getattr(self, key, None)
        return found

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
        several = tuple(f"{key}:{name}" for name in self.columns(key))
        if key in ("u_layer", "v"):
            return several
        # Decide without computing the signal, where possible.
        missing = SIGNALS[key].of == "gap" and not several
        if key in ("q_source", "i_source") or (key == "area" and missing):
            missing = self.value(key) is None
        return () if missing else several if len(several) > 1 else (key,)

    def one(self, name: str) -> FloatArray:
        """The signal of one of the `names`, shape (n_t,)."""
        key, colon, element = name.partition(":")
        if key == "v":
            return self.node_voltages[element]
        value = self.value(key)
        assert value is not None
        return value[:, self.columns(key).index(element)] if colon else value


class StoredRecord(Signals):
    """Outputs of a run as they were read from a file: signals ``key`` or ``key:element`` as columns (n, n_t)."""

    def __init__(
        self, names: Sequence[str], sources: tuple[str, ...], fingers: tuple[tuple[str, Contact], ...], t: FloatArray,
        left: BoolArray | None, columns: FloatArray,
    ) -> None:  # fmt: skip
        own: dict[str, dict[str, FloatArray]] = {key: {} for key in SIGNALS}
        for name, column in zip(names, columns, strict=True):
            key, _, element = name.partition(":")
            own[key][element] = np.ascontiguousarray(column)
        self.t, self.sources, self.fingers = t, sources, fingers
        self.node_voltages, layers = own.pop("v"), own.pop("u_layer")
        self.layers, self.u_layer = tuple(layers), np.column_stack([np.zeros((t.size, 0)), *layers.values()])
        vars(self).update({k: side_by_side([*x.values()]) for k, x in own.items() if x and not SIGNALS[k].base})
        self.__post_init__()


def attribute(get: Callable[[Any], Any], doc: str) -> Any:
    """A property of a result, with its documentation."""
    return property(get, doc=doc)


def _given(key: str, doc: str) -> Any:
    """A property: a signal; None where the run has no such signal."""
    return attribute(lambda result: result.record.value(key), doc)


class Signalled:
    """A result with the signals of a record."""

    t: FloatArray
    record: Signals

    layers: tuple[str, ...] = attribute(lambda result: result.record.layers, "Names of the columns of `u_layer`.")
    gaps: tuple[str, ...] = attribute(lambda result: result.record.gaps, "Names of the GAPs.")
    sources: tuple[str, ...] = attribute(
        lambda result: result.record.sources,
        "Names of the sources of a network; of a series stack there is one, its loop.",
    )
    node_voltages: dict[str, FloatArray] = attribute(
        lambda result: result.record.node_voltages, "Node name to its voltage, V, shape (n_t,)."
    )
    u_source: FloatArray = _given(
        "u_source", "Voltage of each source, V; for a series stack the voltage around the loop, shape (n_t,)."
    )
    u_layer: FloatArray = _given("u_layer", "Voltage of each layer from its p to its n node, V, shape (n_t, n_layer).")
    fold_margin: FloatArray = _given(
        "fold_margin",
        "Distance to the fold of the `mobile` law: 1 without stored charge, 0 at the fold; 1 under `local`.",
    )
    area: FloatArray | None = _given("area", "Ridge contact area, m^2, shape (n_t,); None for a circuit without any.")
    q_source: FloatArray | None = _given(
        "q_source",
        "Charge delivered by the source since the start, C, shape (n_t,), with the impulses at jumps.\n\n"
        "None where the run was asked to leave it out.",
    )
    i_source: FloatArray | None = _given(
        "i_source",
        "Current of the source, A, shape (n_t,), without the impulses at jumps, which only `q_source` shows.",
    )
    u_gap: FloatArray | None = _given("u_gap", "Gap voltage, V, shape (n_t,); None for a circuit without GAP.")
    sigma_el: FloatArray | None = _given(
        "sigma_el", "Electroadhesive stress (Eq. 2), Pa, shape (n_t,); None for a circuit without GAP."
    )
    f_el: FloatArray | None = _given(
        "f_el",
        "Electroadhesive force, N, shape (n_t,); None for a circuit without GAP.\n\n"
        "Its mean is `f_el_mean`, and over the last period `f_el_mean_periodic`. ``f_el.mean()`` is another figure: it "
        "gives every output the same weight, including both ends of a period and both rows of a jump, which causes an "
        "error of some per cent at 50 to 200 outputs per period.",
    )
    f_t: FloatArray | None = _given("f_t", "Friction force (Eq. 1), N, shape (n_t,); None for a circuit without GAP.")
    friction: FloatArray | None = _given(
        "friction", "Friction coefficient f_t / f_n, shape (n_t,); None for a circuit without GAP."
    )

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
        out: dict[str, tuple[FloatArray, str, str]] = {}
        for key, signal in SIGNALS.items():
            for name, value in self.by_name(key).items():
                element = name.partition(":")[2]
                said = {"u_layer": f"voltage of {element}", "v": f"voltage of node {element}"}.get(key, signal.text)
                out[name] = value, signal.unit, said
        return out


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
    for key, signal in SIGNALS.items():
        columns = [x[keep] for x in solution.by_name(key).values()] if key in wanted else []
        several = key in ("u_layer", "v")
        about = {"units": signal.unit, "long_name": signal.text}
        if len(columns) > 1 or (several and key in wanted):
            coords[signal.of] = ((signal.of,), np.array(solution.record.columns(key), dtype=object), {})
            table = np.column_stack([np.zeros((int(keep.sum()), 0)), *columns])
            data[key] = (("time", signal.of), table, about)
        elif columns:
            data[key] = (("time",), columns[0], about)
    return data, coords
