"""Groups of measurements, such as fingers: parameters that are the same in all of them, and parameters of each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit


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
