"""Measured columns, from arrays or tables with names and units; and those that a circuit is fitted to."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.devices import MEASURED as USUAL
from fingerspice.circuit.devices import MEASURING
from fingerspice.circuit.statespace import driving_sources
from fingerspice.waveforms.files import MAX_TEXT_BYTES, checked_file, read_text_columns

#: Signals that can be fitted, over time or (with ``_mean``) as means, and their units.
MEASURED = {"f_el": "N", "f_t": "N", "friction": "", "area": "m^2", "u_gap": "V", "impedance": "ohm"}
#: The one measured quantity that is no mean, and the column that may stand beside it.
IMPEDANCE, PHASE = "impedance", "impedance_phase"
_MEANS = ("f_el", "f_t", "friction", "area")
_TIME = "t"
_UNITS = MEASURED | {f"{signal}_mean": unit for signal, unit in MEASURED.items()} | {_TIME: "s", PHASE: "deg"}
SIGMA = "sigma"
_PREFIXES = {"": 1.0, "k": 1e3, "M": 1e6, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
#: One set of columns, or the path of a table.
Given = Mapping[str, ArrayLike] | str | Path
#: What a name in a header means, with all names of the header beside it: the column's key, the key of the column whose
#: unit it has (of a standard deviation that of the values, else its own), and this unit, or None where none is known.
Meaning = Callable[[str, Sequence[str]], tuple[str, str, str | None]]


class Groups(NamedTuple):
    """The group of every measurement."""

    column: str  # Name of the column that tells it
    of: tuple[str, ...]  # Name of each measurement's group

    @property
    def labels(self) -> tuple[str, ...]:
        """Every group's name, in the order of the data."""
        return tuple(dict.fromkeys(self.of))


#: Columns (n,) in SI units or, of a circuit's parameters, those of the netlist; where they come from, as subject of a
#: message; and the groups.
Measured = tuple[dict[str, FloatArray], str, Groups | None]


def measured_of(
    given: Given, meaning: Meaning, example: str, by: str | None = None, place: str = "the data"
) -> Measured:
    """The columns that a caller gave, finite numbers; that named `by` tells the group of a measurement.

    `example` shows the header that a table needs, and `place` names columns that come from none.
    """
    if isinstance(given, (str, Path)):
        return _from_table(Path(given), meaning, example, by)
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise InputError(f"data is a {type(given).__name__}; allowed: a mapping of columns, or the path of a table")
    if by is not None and by not in given:
        raise InputError(f"the data have no column {by!r}, which groups names; they have {', '.join(given)}")
    found = {name: real_numbers(f"data column {name!r}", x, "numbers") for name, x in given.items() if name != by}
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
    # A number stands for a column of it.
    columns = {name: np.broadcast_to(x, size).copy() for name, x in found.items()}
    if by is None:
        return columns, place, None
    cells = np.asarray(given[by])
    if cells.ndim != 1 or cells.dtype.kind not in "iufU":
        raise InputError(f"data column {by!r} tells the group; allowed: a text or a number for every measurement")
    if cells.size != size:
        raise InputError(f"data column {by!r} has {cells.size} rows, others have {size}; allowed: as many")
    return columns, place, Groups(by, tuple(x if isinstance(x, str) else f"{x:g}" for x in cells.tolist()))


def _from_table(path: Path, meaning: Meaning, example: str, by: str | None) -> Measured:
    table = read_text_columns(checked_file(path, MAX_TEXT_BYTES), by)
    if not table.names:
        raise InputError(f"'{path}' has no header; allowed: names with units, such as {example}")
    found, units, of_share, groups = dict[str, FloatArray](), dict[str, str](), dict[str, str](), None
    for i, (name, unit) in enumerate(zip(table.names, table.units, strict=True)):
        if by is not None and name.lower() == by.lower():
            groups = Groups(by, tuple(table.words[int(number)] for number in table.numbers(i)))
            continue
        key, values, base = meaning(name, table.names)
        if key in found:
            raise InputError(f"'{path}' has two columns {name!r}; allowed: one")
        if key != values and unit == "%":
            of_share[key], base = values, ""
        factor = 1.0 if base is None else _unit_factor(unit, base, f"'{path}': the unit of column {name!r}")
        found[key], units[key] = table.numbers(i) * factor, unit
    for key, values in of_share.items():
        # Beside values in % (a friction coefficient), a standard deviation in % is of their unit, and no share of them.
        if units.get(values, "%") != "%":
            found[key] = found[key] * np.abs(found[values])
    return found, f"the data in '{path}'", groups


def _unit_factor(unit: str, base: str, what: str) -> float:
    """A header's unit over the unit `base`; the prefix of an area is squared with it."""
    power = 2 if base == "m^2" else 1
    known = {prefix + base: factor**power for prefix, factor in _PREFIXES.items()} if base else {"%": 0.01}
    known |= {"": 1.0} | (dict.fromkeys(("mm2", "mm²"), 1e-6) if power == 2 else {})
    if unit in known:
        return known[unit]
    scaled = ", with k, m, u or n before it where need be" if base else ""
    raise InputError(f"{what} is {unit!r}; allowed: {base or 'none'}{scaled}")


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

    @property
    def scale(self) -> FloatArray:
        """Scale of the residuals, after those of an impedance's magnitudes those of its phases, where given.

        That is sigma, or the largest value; of an impedance each value's own size.
        """
        sizes = np.abs(self.values)
        own = sizes if self.signal == IMPEDANCE else np.full(sizes.size, float(sizes.max()) or 1.0)
        scale = own if self.sigma is None else self.sigma
        # An error of the complex impedance, equal in all directions, is as large across as along.
        return scale if self.phase is None else np.concatenate([scale, np.degrees(scale / sizes)])

    def unusual(self) -> Iterator[str]:
        """Warnings about measured values and amplitudes that are probably in another unit."""
        if self.signal in USUAL:
            largest = float(np.abs(self.values).max())
            yield USUAL[self.signal].warning(f"the data's largest {self.name}", largest, MEASURED[self.signal]) or ""
        for path, x in self.conditions.items():
            if self.signal in _MEANS and path.endswith(".amplitude"):
                yield MEASURING.warning(f"the data's largest {path}", float(x[np.abs(x).argmax()]), "V") or ""

    @property
    def varying(self) -> dict[str, FloatArray]:
        """The conditions that are not the same in all measurements."""
        return {path: x for path, x in self.conditions.items() if np.ptp(x) > 0.0}

    def remedy(self, circuit: Circuit) -> str:
        """A measurement that would add what is missing: at another voltage, frequency or load."""
        if self.t is not None:
            return "Measure under another voltage or load as well, or fix one of them."
        varying, known = ({path.rpartition(".")[2] for path in paths} for paths in (self.varying, circuit.parameters))
        for key, text in (("amplitude", "voltage"), ("frequency", "frequency"), ("fn", "load")):
            if key in known - varying:
                return f"Measure at a second {text} as well, or fix one of them."
        return "Fix one of them to a value known from elsewhere."


def data_of(circuit: Circuit, given: Given, by: str | None = None) -> Data:
    """The checked data that a caller of `fit` gave; the column `by` tells which group a measurement belongs to."""
    if isinstance(given, Mapping) and np.iscomplexobj(given.get(IMPEDANCE, 0.0)):
        if PHASE in given:
            raise InputError(f"{IMPEDANCE} is complex, and {PHASE} is given; allowed: one of them")
        z = np.asanyarray(given[IMPEDANCE])
        given = {**given, IMPEDANCE: np.abs(z), PHASE: np.angle(z, deg=True)}

    def meaning(name: str, names: Sequence[str]) -> tuple[str, str, str]:
        key = {"time": _TIME, _TIME: _TIME, SIGMA: SIGMA}.get(name.lower(), name)
        if key == SIGMA:
            measured = next((one for one in names if one.removesuffix("_mean") in MEASURED), "")
            return SIGMA, measured, _UNITS.get(measured, "")
        return key, key, _UNITS[key] if key in _UNITS else circuit.parameters[_path(circuit, name)].unit

    try:
        columns, place, groups = measured_of(given, meaning, "Vdrive.amplitude (V), f_el_mean (N)", by)
    except InputError as refused:
        if by is not None or "no rows of numbers" not in refused.message:
            raise
        raise InputError(f"{refused.message}; allowed: numbers, and names in the column that groups names") from None
    names = {f"{name}_mean": name for name in _MEANS}
    names |= {name: name for name in MEASURED if name != IMPEDANCE} if _TIME in columns else {IMPEDANCE: IMPEDANCE}
    measured = [name for name in columns if name in names]
    if len(measured) != 1:
        what = f"several measured columns ({', '.join(measured)})" if measured else "no measured column"
        raise InputError(
            f"{place} have {what}, and the columns {', '.join(columns)}; allowed: one of {', '.join(names)}"
        )
    (name,) = measured
    values = columns.pop(name)
    sigma, t, phase = (columns.pop(key, None) for key in (SIGMA, _TIME, PHASE))
    if phase is not None and name != IMPEDANCE:
        raise InputError(f"{place} have the column {PHASE} beside {name}; allowed: beside {IMPEDANCE}")
    _refuse_signs(name, values, place, first=0 if isinstance(given, Mapping) else 1)
    if sigma is not None and not np.all(sigma > 0.0):
        raise InputError(f"{place}: the smallest sigma is {sigma.min():g}; allowed: more than 0")
    if t is not None and (name.endswith("_mean") or np.any(np.diff(t) <= 0.0)):
        raise InputError(f"{place} have the column t; allowed: rising times, with a signal that is no mean")
    conditions: dict[str, FloatArray] = {}
    for column, x in columns.items():
        path = _path(circuit, column)
        if path in conditions:
            raise InputError(f"{place} have two columns of {path}; allowed: one")
        conditions[path] = x
    data = Data(names[name], values, sigma, conditions, t, phase, groups)
    if t is not None and data.varying:
        raise InputError(f"{place} have times and changing conditions; allowed: one run over time, or means")
    if t is not None and groups is not None:
        raise InputError(f"{place} have times and groups; allowed: groups of means or of impedances")
    return data


def _refuse_signs(name: str, values: FloatArray, place: str, first: int) -> None:
    """Refuse magnitudes of an impedance that are not above 0, and signals that are negative on average.

    A signal over time may be below 0 now and then, by noise. Rows count from `first`.
    """
    low, allowed = values < 0.0, "0 or more"
    if name == IMPEDANCE:
        low, allowed = values <= 0.0, "magnitudes above 0"
    elif name.startswith("f_el"):
        allowed += ", as the electroadhesive force counts as positive where it pulls towards the screen"
    if name == IMPEDANCE or name.endswith("_mean"):
        told = [(values[i], f"in row {i + first}") for i in np.flatnonzero(low)[:1]]
    else:
        told = [(values.mean(), "on average")] if name in _MEANS and values.mean() < 0.0 else []
    for value, where in told:
        raise InputError(f"{place}: {name} is {f'{value:g} {_UNITS[name]}'.rstrip()} {where}; allowed: {allowed}")


def _path(circuit: Circuit, name: str) -> str:
    """A condition's path; ``source.`` stands for the only source, and ``frequency`` for its frequency."""
    name = "source.frequency" if name.lower() == "frequency" else name
    element, _, parameter = name.partition(".")
    if element.lower() == "source":
        driving = driving_sources(circuit)
        if len(driving) != 1:
            raise InputError(f"{name} is the only source's, and the circuit has {len(driving)}; allowed: its name")
        name = f"{driving[0].name}.{parameter}"
    known = {path.lower(): path for path in circuit.parameters}
    if name.lower() not in known:
        near = difflib.get_close_matches(name.lower(), known, 1, 0.0)
        hint = f", such as {known[near[0]]}" if near else ""
        allowed = ", ".join((*(f"{signal}_mean" for signal in _MEANS), IMPEDANCE, PHASE, SIGMA, _TIME))
        raise InputError(
            f"the data have a column {name!r}, which is no parameter of the circuit; allowed: {allowed} with a signal, "
            f"and conditions{hint}"
        )
    return known[name.lower()]
