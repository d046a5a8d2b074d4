"""Measured columns, from arrays or tables with names and units; those of materials also with likely slips.

Measured data for the fit of a circuit, and what a circuit predicts of them, with derivatives by its parameters.
"""

from __future__ import annotations

import csv
import difflib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import BoolArray, FloatArray, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.devices import MEASURED as USUAL
from fingerspice.circuit.devices import MEASURING
from fingerspice.circuit.statespace import build_stack, is_stack
from fingerspice.circuit.topology import driving_sources
from fingerspice.netlist.lexer import read_text
from fingerspice.physics.materials import EPS0
from fingerspice.solve.simulation import simulate
from fingerspice.studies.batch.batch import batch
from fingerspice.studies.batch.form import REFUSED, in_lockstep_by
from fingerspice.studies.fit.result import Problem
from fingerspice.studies.steady import phasor, steady_state
from fingerspice.waveforms.files import MAX_TEXT_BYTES, checked_file, read_text_columns

if TYPE_CHECKING:
    from xarray import Dataset


SIGMA = "sigma"
_PREFIXES = {"": 1.0, "k": 1e3, "M": 1e6, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
#: Columns of measured materials, and what they may be in words.
COLUMNS = ("frequency", "resistivity", "permittivity")
ALLOWED = "frequency (Hz), resistivity (ohm m), relative permittivity"
_ALL_PREFIXES = _PREFIXES | {"G": 1e9, "p": 1e-12}
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_PREFIX = f"(?P<prefix>[{''.join(_ALL_PREFIXES)}]?)"
_METRE = "(?P<metre>cm|mm|m)"
_FREQUENCY = "f|freq|frequency|frequenz|hz"
_PERMITTIVITY = (
    "eps|eps_r|epsr|eps'|eps_r'|epsilon|epsilon_r|ε|ε_r|εr|ε'|eps_r_sc|permittivity|relative permittivity|"
    "relative_permittivity|dielectric constant|dk"
)

#: One set of columns, or the path of a table.
Given = Mapping[str, ArrayLike] | str | Path
#: What a name in a header means, with all names of the header beside it: the column's key, the key of the column whose
#: unit it has (of a standard deviation that of the values, else its own), and this unit, or None where none is known.
Meaning = Callable[[str, Sequence[str]], tuple[str, str, str | None]]
#: Columns (n,) in SI units or, of a circuit's parameters, those of the netlist; where they come from, as subject of a
#: message; and the groups.
Measured = tuple[dict[str, FloatArray], str, "Groups | None"]


class Groups(NamedTuple):
    """The group of every measurement."""

    column: str  # Name of the column that tells it
    of: tuple[str, ...]  # Name of each measurement's group

    @property
    def labels(self) -> tuple[str, ...]:
        """Every group's name, in the order of the data."""
        return tuple(dict.fromkeys(self.of))


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
    found: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    of_share: dict[str, str] = {}
    groups: Groups | None = None
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


class _Kind(NamedTuple):
    """What a column may hold by its name and unit; of several kinds with a name the first is that without a unit."""

    column: str  # The one of `COLUMNS` that it tells
    names: str  # Pattern of its names
    units: str  # Pattern of its units
    metres: int  # Power of the metre in its unit
    meant: Callable[[FloatArray], FloatArray]  # From its values in SI units to those of the column


_KINDS = (
    _Kind("frequency", _FREQUENCY, f"{_PREFIX}[Hh]z|1/s", 0, lambda x: x),
    _Kind("frequency", _FREQUENCY, "rad/s", 0, lambda x: x / (2.0 * np.pi)),
    _Kind("frequency", "w|omega|ω|angular frequency|angular_frequency", "rad/s|1/s", 0, lambda x: x / (2.0 * np.pi)),
    _Kind("resistivity", "rho|ρ|rho_sc|resistivity|resistance",
          f"{_PREFIX}(?:[Oo]hms?|[\u03a9\u2126])[ *·.-]?{_METRE}", 1, lambda x: x),
    _Kind("resistivity", "sigma|σ|kappa|conductivity|conductance", f"{_PREFIX}S/{_METRE}", -1, lambda x: 1.0 / x),
    _Kind("permittivity", _PERMITTIVITY, "1|-", 0, lambda x: x),
    _Kind("permittivity", _PERMITTIVITY, f"{_PREFIX}F/{_METRE}", -1, lambda x: x * (1.0 / EPS0)),
)  # fmt: skip


def read_table(path: Path) -> FloatArray:
    """Rows of frequency (Hz), resistivity (ohm m) and relative permittivity from a text file of three columns.

    Columns are separated by commas, tabs or semicolons; with semicolons decimal commas are allowed. A line of names
    may give quantities, order and units of the columns; conductivities and angular frequencies are converted.
    """
    try:
        lines = read_text(path, str(path)).splitlines(keepends=True)
        mark = next((mark for mark in ";\t" if any(mark in line for line in lines)), ",")
        rows = [row for row in csv.reader(lines, delimiter=mark) if row and not row[0].lstrip().startswith("#")]
    except csv.Error as error:
        raise InputError(f"{path} cannot be read as CSV: {error}") from error
    head: list[str] = []
    numbers = []
    for place, row in enumerate(rows):
        try:
            numbers.append([float(x.replace(",", ".") if mark == ";" else x) for x in row])
        except ValueError:
            if place > 0:
                raise InputError(f"{path}, row {place + 1}: {','.join(row)!r}; allowed: three numbers") from None
            head = row
    if any(len(row) != 3 for row in numbers):
        raise InputError(f"{path} has rows that are not three numbers; allowed: {ALLOWED}")
    table = np.array(numbers, float).reshape(-1, 3)
    if len(head) != 3:
        return table
    # Columns with unknown names fill the places that the others leave.
    named: dict[str, FloatArray] = {}
    others = []
    for name, x in zip(head, table.T, strict=True):
        kind, scale = _kind(name, str(path))
        if kind is None:
            others.append(x)
            continue
        if kind.column in named:
            names = ", ".join(head)
            raise InputError(f"{path}: two columns are a {kind.column} by their names, {names}; allowed: {ALLOWED}")
        with np.errstate(divide="ignore"):
            named[kind.column] = kind.meant(scale * x)
    return np.column_stack([named[name] if name in named else others.pop(0) for name in COLUMNS])


def _kind(name: str, file: str) -> tuple[_Kind | None, float]:
    """What a column holds by its name, and the factor of its unit; None for an unknown name."""
    bare = name.strip().strip("\"'")
    match = re.fullmatch(r"(?P<what>[^\[(/]*?)\s*(?:[\[(](?P<bracket>[^\])]*)[\])]|/\s*(?P<slash>.+))?", bare)
    if match is None:
        return None, 1.0
    what, unit = match["what"].strip(), (match["bracket"] or match["slash"] or "").strip()
    known = [kind for kind in _KINDS if re.fullmatch(kind.names, what, re.IGNORECASE)]
    if not known and "_" in what and not unit:
        # A name such as f_kHz ends with its unit.
        what, _, unit = what.rpartition("_")
        known = [kind for kind in _KINDS if re.fullmatch(kind.names, what, re.IGNORECASE)]
    if not known or not unit:
        return next(iter(known), None), 1.0
    for kind in known:
        found = re.fullmatch(kind.units, unit)
        if found:
            groups = found.groupdict()
            return kind, _ALL_PREFIXES[groups.get("prefix") or ""] * _METRES[groups.get("metre") or "m"] ** kind.metres
    raise InputError(
        f"{file}: the unit of column {name.strip()!r} is not known; allowed: Hz, rad/s, ohm m, S/m, and 1 or F/m"
    )


#: Possible slips of the user, each with the function from the table as given to the table as meant.
_SLIPS: tuple[tuple[str, Callable[[FloatArray], FloatArray]], ...] = (
    ("the frequency is in rad/s", lambda t: t * (0.5 / np.pi, 1.0, 1.0)),
    ("the second column is a conductivity in S/m", lambda t: t ** (1.0, -1.0, 1.0)),
    ("the frequency is in kHz", lambda t: t * (1e3, 1.0, 1.0)),
    ("the resistivity is in ohm cm", lambda t: t * (1.0, 1e-2, 1.0)),
    ("the resistivity is in kohm m", lambda t: t * (1.0, 1e3, 1.0)),
    ("resistivity and permittivity have changed places", lambda t: t[:, [0, 2, 1]]),
    ("frequency and resistivity have changed places", lambda t: t[:, [1, 0, 2]]),
    ("frequency and permittivity have changed places", lambda t: t[:, [2, 1, 0]]),
    ("the columns are resistivity, permittivity, frequency", lambda t: t[:, [2, 0, 1]]),
    ("the columns are permittivity, frequency, resistivity", lambda t: t[:, [1, 2, 0]]),
    ("the second column is a conductivity in mS/m", lambda t: t ** (1.0, -1.0, 1.0) * (1.0, 1e3, 1.0)),
    ("the second column is a conductivity in uS/cm", lambda t: t ** (1.0, -1.0, 1.0) * (1.0, 1e4, 1.0)),
    ("the second column is a conductivity in S/cm", lambda t: t ** (1.0, -1.0, 1.0) * (1.0, 1e-2, 1.0)),
    ("the frequency is in MHz", lambda t: t * (1e6, 1.0, 1.0)),
    ("the permittivity is in F/m", lambda t: t * (1.0, 1.0, 1.0 / EPS0)),
)


def likely_slips(table: FloatArray, misfit: Callable[[FloatArray], float], least: float) -> list[str]:
    """Slips that may explain data that fit no material: at most two that reduce the misfit to less than a third.

    `misfit` is that of a table (n, 3) to the nearest causal and passive material, `least` that of the data as given.
    """
    found = []
    for text, meant in _SLIPS:
        other = meant(table)
        other = other[np.argsort(other[:, 0])]
        if np.all(np.diff(other[:, 0]) > 0.0):
            found.append((misfit(other), text))
    best = min((value for value, _ in found), default=np.inf)
    # Name two slips at most, as those with the same factor, such as kHz and kohm m, cannot be distinguished.
    return [text for value, text in found if value <= min(1.1 * best, least / 3.0)][:2]


#: Signals that can be fitted, over time or (with ``_mean``) as means, and their units.
MEASURED = {"f_el": "N", "f_t": "N", "friction": "", "area": "m^2", "u_gap": "V", "impedance": "ohm"}
#: The one measured quantity that is no mean, and the column that may stand beside it.
IMPEDANCE, PHASE = "impedance", "impedance_phase"
_MEANS = ("f_el", "f_t", "friction", "area")
_TIME = "t"
_UNITS = MEASURED | {f"{signal}_mean": unit for signal, unit in MEASURED.items()} | {_TIME: "s", PHASE: "deg"}
# Error of the runs whose derivatives a batch gives: ten times this, relative, which is far below any data's.
_SLOPES = 1e-6


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
    def target(self) -> FloatArray:
        """What is to be predicted: the values, and after them the phases (deg) of an impedance where given."""
        return self.values if self.phase is None else np.concatenate([self.values, self.phase])

    @property
    def scale(self) -> FloatArray:
        """Scale of the residuals: sigma, or the largest value; of an impedance each value's own size."""
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
    if name.lower() == "frequency":
        name = "source.frequency"
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


@dataclass(frozen=True)
class Task(Problem):
    """The fit of a circuit's parameters; how it is run is said by `fit`."""

    data: Data
    average: str
    skin: str
    rtol: float
    charge_law: str | None
    watch: Callable[[], None] = lambda: None  # Called before every evaluation

    @cached_property
    def members(self) -> BoolArray:
        """Whether each unknown belongs to each measurement, shape (n_parameter, n)."""
        groups, count = self.data.groups, self.data.values.size
        own = groups.of if groups is not None else [None] * count
        return np.array([[one.label in (None, label) for label in own] for one in self.unknowns])

    @cached_property
    def places(self) -> dict[str, list[int]]:
        """Places of every fitted parameter's unknowns, by its path: one, or one for each group."""
        paths = [one.path for one in self.unknowns]
        return {path: [k for k, other in enumerate(paths) if other == path] for path in paths}

    def compared(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        self.watch()
        if self.data.signal == IMPEDANCE:
            return super().compared(values)
        found, by = self._in_batches(values) if self._in_lockstep else self._in_single_runs(values)
        return (found - self.data.values) / self.scale, by * values / self.scale[:, None]

    def misses(self, values: FloatArray) -> FloatArray:
        """Of impedances, at the area that the deck's amplitude causes."""
        data, how = self.data, "swept" if self.skin == "follow" else "own"
        runs = [phasor(self._scene(values, row), skin=how).impedance for row in range(data.values.size)]
        z = np.array([one[0] for one in runs if one is not None])
        off = np.abs(z) - data.values
        if data.phase is not None:
            off = np.append(off, np.remainder(np.angle(z, deg=True) - data.phase + 180.0, 360.0) - 180.0)
        return np.asarray(off / self.scale)

    def _in_single_runs(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predicted means or a signal (n,), and their derivatives by the parameters (n, n_parameter)."""
        data, over_time = self.data, self.data.t is not None
        if not over_time and self.average == "run" and self.circuit.tran is None:
            raise InputError("the deck has no .tran, and average is 'run'; allowed: a deck with .tran, or 'periodic'")
        found, by = np.empty(data.values.size), np.zeros((data.values.size, values.size))
        # A signal over time has all its values from one run.
        for row in range(1 if over_time else data.values.size):
            circuit, felt = self._scene(values, row), np.flatnonzero(self.members[:, row])
            paths = tuple(self.unknowns[k].path for k in felt)
            how = {"sensitivities": paths, "rtol": self.rtol, "charge_law": self.charge_law, "charge": False}
            if over_time or self.average == "run":
                one = simulate(circuit, t_eval=data.t if over_time else [0.0], **how)  # type: ignore[arg-type]
            else:
                one = steady_state(circuit, points=4, **how)  # type: ignore[arg-type,assignment]
            at = slice(None) if over_time else row
            found[at] = getattr(one, data.name)
            for k, path in zip(felt, paths, strict=True):
                by[at, k] = getattr(one.sensitivities[path], data.name)
        return found, by

    def _scene(self, values: FloatArray, row: int) -> Circuit:
        """The circuit of one measurement."""
        changes = {path: float(x[row]) for path, x in self.data.conditions.items()}
        changes |= {self.unknowns[k].path: float(values[k]) for k in np.flatnonzero(self.members[:, row])}
        changed = self.circuit.varied(changes)
        if self.skin == "follow":
            fundamental = build_stack(changed).waveform.fundamental if is_stack(changed) else None
            skins = {f"{e.name}.f": fundamental.frequency for e in changed.by_device("SKIN") if fundamental is not None}
            changed = changed.varied(skins)
        return changed

    @cached_property
    def _in_lockstep(self) -> bool:
        """Whether a batch predicts all measurements, and has their derivatives, in lockstep."""
        paths = {*self.data.conditions, *self.places}
        skins = {f"{e.name}.f" for e in self.circuit.by_device("SKIN")}
        if self.data.t is not None or self.charge_law is not None or (self.skin == "follow" and paths & skins):
            return False
        alone = self.skin == "own" or len(driving_sources(self.circuit)) == 1
        return alone and in_lockstep_by(self.circuit, paths, (self.data.name,), max(self.rtol, _SLOPES))

    def _in_batches(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `_in_single_runs`, all measurements at once, and derivatives with an error that suits least squares."""
        name, by, runs = self.data.name, np.zeros((self.data.values.size, values.size)), []
        slopes = max(self.rtol, _SLOPES), tuple(self.places)
        for status, (rtol, gradients) in (("gradient_status", slopes), ("status", (self.rtol, ()))):
            runs.append(self.scenes(values[None], rtol, gradients))
            if np.any(runs[-1][status].to_numpy() >= REFUSED):
                raise InputError(runs[-1].attrs["failures"][0])
        for i, own in enumerate(self.places.values()):
            by[:, own] = self.members[own].T * runs[0][f"d_{name}"].to_numpy()[:, i, None]
        return runs[1][name].to_numpy(), by

    def scenes(self, values: FloatArray, rtol: float, gradients: tuple[str, ...] = ()) -> Dataset:
        """A batch of all measurements, with every row of `values` (n_row, n_parameter) one after the other."""
        table = {path: np.tile(x, len(values)) for path, x in self.data.conditions.items()}
        table |= {path: (values[:, own] @ self.members[own]).ravel() for path, own in self.places.items()}
        return batch(
            self.circuit, table, outputs=(self.data.name,), rtol=rtol, periodic=self.average == "periodic",
            skin=self.skin, gradients=gradients,
        )  # fmt: skip
