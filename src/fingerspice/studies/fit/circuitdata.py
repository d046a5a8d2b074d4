"""Measured data for the fit of a circuit: means or impedances under conditions, or a signal over time."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.topology import driving_sources
from fingerspice.circuit.usual import MEASURED as USUAL
from fingerspice.circuit.usual import MEASURING
from fingerspice.studies.fit.measured import SIGMA, Given, Groups, Measured, measured_of

#: Signals that can be fitted, over time or (with ``_mean``) as means, and their units.
MEASURED = {"f_el": "N", "f_t": "N", "friction": "", "area": "m^2", "u_gap": "V", "impedance": "ohm"}
#: The one measured quantity that is no mean, and the column that may stand beside it.
IMPEDANCE, PHASE = "impedance", "impedance_phase"
_MEANS = ("f_el", "f_t", "friction", "area")
_TIME, _SOURCE = "t", "source"
_UNITS = MEASURED | {f"{signal}_mean": unit for signal, unit in MEASURED.items()} | {_TIME: "s", PHASE: "deg"}


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
    def count(self) -> int:
        """Number of residuals: of an impedance with its phase two for each value."""
        return self.values.size * (1 if self.phase is None else 2)

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


def data_of(circuit: Circuit, given: Given, by: str | None = None) -> Data:
    """The checked data that a caller of `fit` gave; the column `by` tells which group a measurement belongs to."""
    found = _read(circuit, given, by)
    columns, place = found.columns, found.place
    names = {f"{name}_mean": name for name in _MEANS}
    names |= {name: name for name in MEASURED if name != IMPEDANCE} if _TIME in columns else {IMPEDANCE: IMPEDANCE}
    measured = [name for name in columns if name in names]
    if len(measured) != 1:
        allowed = ", ".join(names)
        what = f"several measured columns ({', '.join(measured)})" if measured else "no measured column"
        raise InputError(f"{place} have {what}, and the columns {', '.join(columns)}; allowed: one of {allowed}")
    values = columns.pop(measured[0])
    sigma, t, phase = (columns.pop(name, None) for name in (SIGMA, _TIME, PHASE))
    if phase is not None and measured[0] != IMPEDANCE:
        raise InputError(f"{place} have the column {PHASE} beside {measured[0]}; allowed: beside {IMPEDANCE}")
    _refuse_signs(measured[0], values, place, first=0 if isinstance(given, Mapping) else 1)
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
    if t is not None and found.groups is not None:
        raise InputError(f"{place} have times and groups; allowed: groups of means or of impedances")
    return Data(names[measured[0]], values, sigma, conditions, t, phase, found.groups)


def _read(circuit: Circuit, given: Given, by: str | None) -> Measured:
    """The columns as they are named, of which a complex impedance becomes two."""
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
        return measured_of(given, meaning, "Vdrive.amplitude (V), f_el_mean (N)", by)
    except InputError as refused:
        if by is not None or "no rows of numbers" not in refused.message:
            raise
        raise InputError(f"{refused.message}; allowed: numbers, and names in the column that groups names") from None


def _refuse_signs(name: str, values: FloatArray, place: str, first: int) -> None:
    """Refuse magnitudes of an impedance that are not above 0, and signals that are negative on average.

    A signal over time may be below 0 now and then, by noise. Rows count from `first`.
    """
    if name == IMPEDANCE or name.endswith("_mean"):
        bad = np.flatnonzero(values <= 0.0 if name == IMPEDANCE else values < 0.0)
        told = [(f"in row {i + first}", values[i]) for i in bad[:1]]
    else:
        told = [("on average", values.mean())] if name in _MEANS and values.mean() < 0.0 else []
    allowed = "magnitudes above 0" if name == IMPEDANCE else "0 or more"
    if name.startswith("f_el"):
        allowed += ", as the electroadhesive force counts as positive where it pulls towards the screen"
    for where, value in told:
        size = f"{value:g} {_UNITS[name]}".rstrip()
        raise InputError(f"{place}: {name} is {size} {where}; allowed: {allowed}")


def _path(circuit: Circuit, name: str) -> str:
    """A condition's path; ``source.`` stands for the only source, and ``frequency`` for its frequency."""
    if name.lower() == "frequency":
        name = f"{_SOURCE}.frequency"
    element, _, parameter = name.partition(".")
    if element.lower() == _SOURCE:
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
