"""Measured data for a fit, from arrays or a table: means under conditions, or a signal over time; and their groups."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.topology import driving_sources
from fingerspice.circuit.usual import MEASURED as USUAL
from fingerspice.circuit.usual import MEASURING
from fingerspice.waveforms.columns import Columns, read_labelled_columns, read_text_columns
from fingerspice.waveforms.files import MAX_TEXT_BYTES, checked_file


@dataclass(frozen=True)
class Groups:
    """The group of every measurement."""

    column: str  # Name of the column that tells it
    labels: tuple[str, ...]  # Every group's name, in the order of the data
    of: NDArray[np.int64]  # (n,): Number of each measurement's group


@dataclass(frozen=True)
class Unknown:
    """What is fitted: a parameter in all measurements, or in those of one group."""

    path: str
    label: str | None = None  # Name of the group

    @property
    def name(self) -> str:
        """The path, with the group in brackets."""
        return self.path if self.label is None else f"{self.path}[{self.label}]"


def labels_of(column: str, given: ArrayLike) -> Groups:
    """The groups in a column of texts or numbers.

    Raises
    ------
    InputError
        If it is no column of texts or numbers.
    """
    cells = np.asarray(given)
    if cells.ndim != 1 or cells.dtype.kind not in "iufU":
        raise InputError(f"data column {column!r} tells the group; allowed: a text or a number for every measurement")
    words = [str(x) if cells.dtype.kind == "U" else f"{x:g}" for x in cells.tolist()]
    labels = tuple(dict.fromkeys(words))
    return Groups(column, labels, np.array([labels.index(word) for word in words]))


def group_column(circuit: Circuit, groups: Mapping[str, Sequence[str]] | None) -> str | None:
    """The column that tells the group, of a request such as ``{"finger": ["Xgap.d"]}``."""
    if groups is None:
        return None
    wanted = "a mapping of a column of the data to the parameters of each group, such as {'finger': ['Xgap.d']}"
    if not isinstance(groups, Mapping) or len(groups) != 1:
        raise InputError(f"groups is {groups!r}; allowed: {wanted}")
    ((column, paths),) = groups.items()
    if not isinstance(column, str) or isinstance(paths, str) or not paths:
        raise InputError(f"groups is {groups!r}; allowed: {wanted}")
    if column.lower() in {path.lower() for path in circuit.parameters}:
        raise InputError(f"groups names the column {column!r}, which is a parameter; allowed: {wanted}")
    return column


def unknowns_of(paths: Sequence[str], separate: Sequence[str], groups: Groups | None) -> tuple[Unknown, ...]:
    """The unknowns of the parameters `paths`, of which each group has the `separate` ones to itself."""
    known = {path.lower(): path for path in paths}
    for path in separate:
        if path.lower() not in known:
            raise InputError(f"groups names {path!r}, which is not fitted; allowed: {', '.join(paths)}")
    own = {path.lower() for path in separate}
    out: list[Unknown] = []
    for path in paths:
        split = groups is not None and path.lower() in own
        out += [Unknown(path, label) for label in groups.labels] if split and groups is not None else [Unknown(path)]
    return tuple(out)


def members_of(unknowns: Sequence[Unknown], groups: Groups | None, count: int) -> NDArray[np.bool_]:
    """Whether each unknown belongs to each measurement, shape (n_unknown, count)."""
    out = np.ones((len(unknowns), count), bool)
    for k, one in enumerate(unknowns):
        if one.label is not None and groups is not None:
            out[k] = groups.of == groups.labels.index(one.label)
    return out


def fitted_circuits(
    circuit: Circuit, unknowns: Sequence[Unknown], values: Sequence[float], groups: Groups | None
) -> tuple[Circuit, dict[str, Circuit]]:
    """The circuit with the fitted values, which has the geometric means of those of the groups; and that of each."""
    shared = {one.path: value for one, value in zip(unknowns, values, strict=True) if one.label is None}
    logs: dict[str, list[float]] = {}
    for one, value in zip(unknowns, values, strict=True):
        if one.label is not None:
            logs.setdefault(one.path, []).append(math.log(value))
    mean = {path: math.exp(sum(own) / len(own)) for path, own in logs.items()}
    each = {
        label: circuit.varied(
            shared | {one.path: value for one, value in zip(unknowns, values, strict=True) if one.label == label}
        )
        for label in (groups.labels if groups is not None else ())
    }
    return circuit.varied(shared | mean), each


#: Signals that can be fitted, over time or (with ``_mean``) as means, and their units.
MEASURED = {"f_el": "N", "f_t": "N", "friction": "", "area": "m^2", "u_gap": "V", "impedance": "ohm"}
MEANS = ("f_el", "f_t", "friction", "area")
_PREFIXES = {"": 1.0, "k": 1e3, "M": 1e6, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
TIME, SIGMA, SOURCE = "t", "sigma", "source"
#: The one measured quantity that is no mean, and the column that may stand beside it.
IMPEDANCE, PHASE = "impedance", "impedance_phase"


@dataclass(frozen=True)
class Data:
    """Measured values with their conditions."""

    signal: str  # A key of `MEASURED`
    values: FloatArray  # (n,): Measured values in SI units: means, or, with `t`, values over time
    sigma: FloatArray | None  # (n,): Standard deviation of every value; None where it is not known
    # (n,): Path to the values that a parameter had in the measurements, in the unit of the netlist
    conditions: dict[str, FloatArray]
    t: FloatArray | None = None  # (n,): Times, s
    phase: FloatArray | None = None  # (n,): Phase of an impedance, deg
    groups: Groups | None = None  # Which measurements belong together, such as those of one finger

    @property
    def name(self) -> str:
        """Name of the measured column."""
        return self.signal if self.t is not None or self.signal == IMPEDANCE else f"{self.signal}_mean"

    def unusual(self) -> Iterator[str]:
        """Warnings about measured values and amplitudes that are probably in another unit."""
        if self.signal in USUAL:
            largest = float(np.abs(self.values).max())
            yield USUAL[self.signal].warning(f"the data's largest {self.name}", largest, MEASURED[self.signal]) or ""
        for path, x in self.conditions.items():
            if self.signal in MEANS and path.endswith(".amplitude"):
                yield MEASURING.warning(f"the data's largest {path}", float(x[np.abs(x).argmax()]), "V") or ""

    @property
    def varying(self) -> dict[str, FloatArray]:
        """The conditions that are not the same in all measurements."""
        return {path: x for path, x in self.conditions.items() if np.ptp(x) > 0.0}


def data_of(circuit: Circuit, given: Mapping[str, ArrayLike] | str | Path, by: str | None = None) -> Data:
    """The data that a caller gave: a mapping of columns, or a table with a header.

    The columns are one of ``f_el_mean``, ``f_t_mean``, ``friction_mean`` and ``area_mean`` with conditions (paths such
    as ``Vdrive.amplitude``, ``source.frequency``, ``Xgap.fn``); or ``impedance`` with conditions, complex or with
    ``impedance_phase`` (deg) beside it; or ``t`` with ``f_el``, ``f_t``, ``friction``, ``area`` or ``u_gap``; and
    ``sigma``, the standard deviation, where it is known. The column `by` has names or numbers that tell which group a
    measurement belongs to.

    Raises
    ------
    InputError
        If a column or unit is unknown, columns have different lengths, or a value is no finite number or has a sign
        that it cannot have.
    """
    columns, groups, place = _columns(circuit, given, by)
    names = {
        **{f"{name}_mean": name for name in MEANS},
        **({name: name for name in MEASURED if name != IMPEDANCE} if TIME in columns else {IMPEDANCE: IMPEDANCE}),
    }
    measured = [name for name in columns if name in names]
    if len(measured) != 1:
        allowed = ", ".join(names)
        what = f"several measured columns ({', '.join(measured)})" if measured else "no measured column"
        raise InputError(f"{place} have {what}, and the columns {', '.join(columns)}; allowed: one of {allowed}")
    values = columns.pop(measured[0])
    sigma, t, phase = columns.pop(SIGMA, None), columns.pop(TIME, None), columns.pop(PHASE, None)
    if phase is not None and measured[0] != IMPEDANCE:
        raise InputError(f"{place} have the column {PHASE} beside {measured[0]}; allowed: beside {IMPEDANCE}")
    _refuse_signs(measured[0], values, place, first=1 if isinstance(given, (str, Path)) else 0)
    if sigma is not None and not np.all(sigma > 0.0):
        raise InputError(f"{place}: the smallest sigma is {sigma.min():g}; allowed: more than 0")
    if t is not None and (measured[0].endswith("_mean") or np.any(np.diff(t) <= 0.0)):
        raise InputError(f"{place} have the column t; allowed: rising times, with a signal that is no mean")
    conditions: dict[str, FloatArray] = {}
    for name, x in columns.items():
        path = _path(circuit, name)
        if path in conditions:
            raise InputError(f"{place} have two columns of {path}; allowed: one")
        conditions[path] = x
    if t is not None and any(np.ptp(x) > 0.0 for x in conditions.values()):
        raise InputError(f"{place} have times and changing conditions; allowed: one run over time, or means")
    if t is not None and groups is not None:
        raise InputError(f"{place} have times and groups; allowed: groups of means or of impedances")
    return Data(names[measured[0]], values, sigma, conditions, t, phase, groups)


def _refuse_signs(name: str, values: FloatArray, place: str, first: int) -> None:
    """Refuse magnitudes of an impedance that are not above 0, and signals that are negative on average.

    A signal over time may be below 0 now and then, by noise. Rows count from `first`.
    """
    if name == IMPEDANCE or name.endswith("_mean"):
        bad = np.flatnonzero(values <= 0.0 if name == IMPEDANCE else values < 0.0)
        told = [(f"in row {i + first}", values[i]) for i in bad[:1]]
    else:
        told = [("on average", values.mean())] if name in MEANS and values.mean() < 0.0 else []
    allowed = "magnitudes above 0" if name == IMPEDANCE else "0 or more"
    if name.startswith("f_el"):
        allowed += ", as the electroadhesive force counts as positive where it pulls towards the screen"
    for where, value in told:
        size = f"{value:g} {MEASURED[name.removesuffix('_mean')]}".rstrip()
        raise InputError(f"{place}: {name} is {size} {where}; allowed: {allowed}")


def _columns(
    circuit: Circuit, given: Mapping[str, ArrayLike] | str | Path, by: str | None
) -> tuple[dict[str, FloatArray], Groups | None, str]:
    if isinstance(given, (str, Path)):
        return *_from_table(circuit, Path(given), by), f"the data in '{given}'"
    if isinstance(given, Mapping) and np.iscomplexobj(given.get(IMPEDANCE, 0.0)):
        if PHASE in given:
            raise InputError(f"{IMPEDANCE} is complex, and {PHASE} is given; allowed: one of them")
        z = np.asanyarray(given[IMPEDANCE])
        given = {**given, IMPEDANCE: np.abs(z), PHASE: np.angle(z, deg=True)}
    if by is None or not isinstance(given, Mapping):
        return number_columns(given), None, "the data"
    if by not in given:
        raise InputError(f"the data have no column {by!r}, which groups names; they have {', '.join(given)}")
    groups = labels_of(by, given[by])
    found = number_columns({name: x for name, x in given.items() if name != by})
    size = next(iter(found.values())).size if found else 0
    if groups.of.size != size:
        raise InputError(f"data column {by!r} has {groups.of.size} rows, others have {size}; allowed: as many")
    return found, groups, "the data"


def number_columns(given: Mapping[str, ArrayLike]) -> dict[str, FloatArray]:
    """The columns of a mapping as arrays of one length.

    Raises
    ------
    InputError
        If it is no mapping, columns have different lengths, or a value is no finite number.
    """
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise InputError(f"data is a {type(given).__name__}; allowed: a mapping of columns, or the path of a table")
    found = {name: real_numbers(f"data column {name!r}", x, "numbers") for name, x in given.items()}
    size = max((x.size for x in found.values()), default=0)
    for name, x in found.items():
        if x.shape not in ((), (size,)):
            raise InputError(
                f"data column {name!r} has the shape {x.shape}, others have {size} rows; allowed: as many, or one "
                "number for all"
            )
        bad = np.flatnonzero(~np.isfinite(x))
        if bad.size:
            raise InputError(f"data column {name!r} is {x.flat[bad[0]]} in row {bad[0]}; allowed: finite numbers")
    return {name: np.broadcast_to(x, size).copy() for name, x in found.items()}


def _from_table(circuit: Circuit, path: Path, by: str | None) -> tuple[dict[str, FloatArray], Groups | None]:
    file = checked_file(path, MAX_TEXT_BYTES)
    words: tuple[str, ...] = ()
    if by is None:
        try:
            table = read_text_columns(file)
        except InputError as refused:
            if "no rows of numbers" not in refused.message:
                raise
            raise InputError(
                f"{refused.message}; allowed: numbers, and names in the column that groups names"
            ) from None
    else:
        table, words = read_labelled_columns(file, by)
    if not table.names:
        raise InputError(
            f"'{path}' has no header; allowed: names with units, such as Vdrive.amplitude (V), f_el_mean (N)"
        )
    found: dict[str, FloatArray] = {}
    groups: Groups | None = None
    measured = next((name for name in table.names if name.removesuffix("_mean") in MEASURED), "")
    for i, (name, unit) in enumerate(zip(table.names, table.units, strict=True)):
        if by is not None and name.lower() == by.lower():
            groups = Groups(by, words, table.numbers(i).astype(int))
            continue
        signal = name.removesuffix("_mean")
        key = {"time": TIME}.get(name.lower(), name.lower())
        key = key if key in (TIME, SIGMA) else name
        if key == TIME:
            base = "s"
        elif key == SIGMA:
            base = "" if unit == "%" else MEASURED.get(measured.removesuffix("_mean"), "")
        elif key == PHASE:
            base = "deg"
        elif signal in MEASURED:
            base = MEASURED[signal]
        else:
            base = circuit.parameters[_path(circuit, name)].unit
        if key in found:
            raise InputError(f"'{path}' has two columns {name!r}; allowed: one")
        found[key] = table.numbers(i) * unit_factor(unit, base, f"'{path}': the unit of column {name!r}")
    if SIGMA in found and shares(table, measured, SIGMA):
        found[SIGMA] = found[SIGMA] * np.abs(found[measured])
    return found, groups


def shares(table: Columns, values: str, sigma: str) -> bool:
    """Whether the column `sigma` of a table has shares of `values`: it is in %, and they are not."""
    units = {name.lower(): unit for name, unit in zip(table.names, table.units, strict=True)}
    return units[sigma.lower()] == "%" and units.get(values.lower(), "%") != "%"


def unit_factor(unit: str, base: str, what: str) -> float:
    """Of a header's unit over the netlist's."""
    if unit in ("", base):
        return 1.0
    if base == "" and unit == "%":
        return 0.01
    if base == "m^2" and unit in ("mm^2", "mm2", "mm²"):
        return 1e-6
    prefix = unit.removesuffix(base) if base and unit.endswith(base) else None
    if prefix in _PREFIXES and len(base) > 0:
        return _PREFIXES[prefix]
    scaled = ", with k, m, u or n before it where need be" if base else ""
    raise InputError(f"{what} is {unit!r}; allowed: {base or 'none'}{scaled}")


def _path(circuit: Circuit, name: str) -> str:
    """A condition's path; ``source.`` stands for the only source, and ``frequency`` for its frequency."""
    if name.lower() == "frequency":
        name = f"{SOURCE}.frequency"
    element, _, parameter = name.partition(".")
    if element.lower() == SOURCE:
        driving = driving_sources(circuit)
        if len(driving) != 1:
            raise InputError(f"{name} is the only source's, and the circuit has {len(driving)}; allowed: its name")
        name = f"{driving[0].name}.{parameter}"
    known = {path.lower(): path for path in circuit.parameters}
    if name.lower() not in known:
        near = difflib.get_close_matches(name.lower(), known, 1, 0.0)
        hint = f", such as {known[near[0]]}" if near else ""
        allowed = ", ".join((*(f"{signal}_mean" for signal in MEANS), IMPEDANCE, PHASE, SIGMA, TIME))
        raise InputError(
            f"the data have a column {name!r}, which is no parameter of the circuit; allowed: {allowed} with a signal, "
            f"and conditions{hint}"
        )
    return known[name.lower()]
