"""Raw files of SPICE: written for viewers, and read from ngspice and LTspice."""

from __future__ import annotations

import codecs
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import whole_number
from fingerspice.base.errors import InputError
from fingerspice.base.files import write_aside
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.results.measures import areas_of, currents_of, saved_columns
from fingerspice.results.record import signal_of
from fingerspice.waveforms.files import file_fault
from fingerspice.waveforms.waveform import refuse

if TYPE_CHECKING:
    from xarray import Dataset

    from fingerspice.results.solution import Solution

MOST_BYTES = 2**31  #: Of a raw file that is read.
_KINDS = {"V": "voltage", "A": "current"}  # By unit; all else has no kind that SPICE knows
_NOT_WRITTEN = ("u_source", "u_layer", "q_source", "i_source", "fold_margin")  # What nodes and sources' currents say
_KEYS = "title date plotname flags command offset".split()  # noqa: SIM905


@dataclass(frozen=True, repr=False)
class Raw(Shown):
    """One plot of a raw file.

    Attributes
    ----------
    title, plotname : str
    vectors : dict of str to ndarray, shape (n,)
        By name in lower case, the scale first: ``time`` (s), ``v(node)``, ``i(element)``.
    kinds : dict of str to str
        What each is, as the file says: ``time``, ``voltage``, ``current``.
    """

    title: str
    plotname: str
    vectors: Mapping[str, NDArray[Any]]
    kinds: Mapping[str, str]

    @property
    def scale(self) -> NDArray[Any]:
        """The first vector: time, or frequency."""
        return next(iter(self.vectors.values()))

    @property
    def steps(self) -> list[slice]:
        """The runs of a stepped file: where the scale begins anew."""
        starts = [0, *(np.flatnonzero(np.diff(self.scale.real) < 0.0) + 1).tolist(), self.scale.size]
        return [slice(a, b) for a, b in itertools.pairwise(starts)]

    def _page(self) -> Page:
        rows = [(name, self.kinds[name], f"{np.abs(x).max(initial=0.0):.5g}") for name, x in self.vectors.items()]
        head = f"{self.title}: {self.plotname}, {self.scale.size:,} points, {len(self.steps)} runs"
        return Page([head, "", Table(("vector", "kind", "largest"), rows)])


def write_raw(solution: Solution, path: Path) -> Path:
    """See `Solution.to_raw`."""
    columns = {"time": (solution.t, "time")}
    if solution.circuit.saved:
        for name, (values, unit) in saved_columns(solution).items():
            columns["".join(name.lower().split())] = values, _KINDS.get(unit, "notype")
        return _written(solution.circuit.title, columns, path)
    for name, (values, unit, _) in solution.signals.items():
        if name.partition(":")[0] not in _NOT_WRITTEN:
            columns[_vector(name, solution.gaps)] = values, _KINDS.get(unit, "notype")
    columns |= {f"v({node})": (x, "voltage") for node, x in areas_of(solution.record, solution.circuit).items()}
    columns |= {f"i({name})": (x, "current") for name, x in currents_of(solution.record, solution.circuit).items()}
    return _written(solution.circuit.title, columns, path)


def write_raw_steps(found: Dataset, gaps: Sequence[str], path: Path) -> Path:
    """Write the signals of `run_steps` of a circuit with these GAPs: run after run, with each step as a vector."""
    steps = [str(name) for name in found.dims if name != "time"]
    count = found.sizes["time"]
    mesh = np.meshgrid(*(found[name].values for name in steps), indexing="ij")
    columns = {"time": (np.tile(found["time"].values, mesh[0].size), "time")}
    columns |= {name.lower(): (np.repeat(x.ravel(), count), "notype") for name, x in zip(steps, mesh, strict=True)}
    for name, one in found.data_vars.items():
        if "time" in one.dims:
            columns[_vector(str(name), gaps)] = one.values.ravel(), _KINDS.get(one.attrs.get("units", ""), "notype")
    return _written(found.attrs["title"], columns, path)


def _vector(name: str, gaps: Sequence[str]) -> str:
    """A signal's name in SPICE's words."""
    key, _, element = name.partition(":")
    owner = element or (gaps[0] if signal_of(name).of == "gap" else "")
    return f"v({element.lower()})" if key == "v" else f"@{owner.lower()}[{key}]" if owner else key


def _written(title: str, columns: Mapping[str, tuple[NDArray[Any], str]], path: Path) -> Path:
    count = next(iter(columns.values()))[0].size
    head = [
        f"Title: {title}", "Date: -", "Plotname: Transient Analysis", "Flags: real",
        f"No. Variables: {len(columns)}", f"No. Points: {count}", "Variables:",
        *(f"\t{k}\t{name}\t{kind}" for k, (name, (_, kind)) in enumerate(columns.items())), "Binary:", "",
    ]  # fmt: skip
    table = np.column_stack([values for values, _ in columns.values()]).astype("<f8")
    return write_aside(path, lambda target: target.write_bytes("\n".join(head).encode() + table.tobytes()))


def read_raw(path: str | Path, plot: int = 0) -> Raw:
    """Read a raw file of ngspice or LTspice, binary or ASCII.

    Parameters
    ----------
    path : str or Path
    plot : int
        Which of the plots in the file, from 0.

    Raises
    ------
    InputError
        If the file cannot be read, is cut short or is no raw file, or has no such plot.
    """
    path, plot = Path(path), whole_number("plot", plot, 0)
    fault = file_fault(path, MOST_BYTES)
    refuse(fault, f"'{path}' {fault}")
    data, found = path.read_bytes(), list[Raw]()
    # LTspice writes its header, and ASCII files as a whole, in UTF-16, and others put its mark before it.
    data = data.removeprefix(codecs.BOM_UTF16_LE)
    wide = data[1:2] == b"\0"
    at = 0
    while len(found) <= plot and data[at:].strip(b"\0\r\n \t"):
        one, at = _plot(path, data, at, "utf-16-le" if wide else "utf-8")
        found.append(one)
    refuse(not found, f"'{path}' is empty; allowed: a whole raw file")
    refuse(len(found) <= plot, f"'{path}' has {len(found)} plots; allowed: plot up to {len(found) - 1}")
    return found[plot]


def _plot(path: Path, data: bytes, at: int, encoding: str) -> tuple[Raw, int]:
    """The plot that begins at a position, and where it ends."""
    newline = "\n".encode(encoding)
    head: dict[str, str] = {}
    variables: list[tuple[str, str]] = []

    def line() -> str:
        nonlocal at
        end = data.find(newline, at)
        # In UTF-16 a newline begins at an even distance.
        while end >= 0 and len(newline) == 2 and (end - at) % 2:
            end = data.find(newline, end + 1)
        if end < 0:
            raise InputError(f"'{path}' ends within the header of a plot; allowed: a whole raw file")
        text, at = data[at:end].decode(encoding, "replace").rstrip("\r"), end + len(newline)
        return text

    while (text := line()).strip().lower() not in ("binary:", "values:"):
        key, colon, value = text.partition(":")
        known = key.strip().lower()
        if known == "variables":
            for _ in range(_whole(path, head, "no. variables")):
                parts = (value or line()).split()
                value = ""
                refuse(len(parts) < 3, f"'{path}': a variable is {' '.join(parts)!r}; allowed: number, name and kind")
                variables.append((parts[1].lower(), parts[2].lower()))
        elif colon and (known in _KEYS or known.startswith("no. ") or not head):
            head[known] = value.strip()
        elif not head:
            raise InputError(f"'{path}' is no raw file: it begins with {text[:40]!r}; allowed: Title: first")
    refuse(not variables, f"'{path}' has a plot without variables")
    flags = head.get("flags", "real").lower().split()
    refuse("fastaccess" in flags, f"'{path}' has fast access; allowed: LTspice's files as a run writes them")
    n, points, is_complex = len(variables), _whole(path, head, "no. points"), "complex" in flags
    kind = np.dtype("<c16" if is_complex else "<f8")
    if text.strip().lower() == "binary:":
        # LTspice's real vectors are of single precision, but the scale is not.
        single = encoding != "utf-8" and not is_complex and "double" not in flags
        row = np.dtype([("scale", kind), ("rest", "<f4" if single else kind, (n - 1,))])
        end = at + row.itemsize * points
        said = f"'{path}' is cut short: {points:,} points of {n} variables are {row.itemsize * points:,} bytes"
        refuse(end > len(data), f"{said}, and {len(data) - at:,} are there")
        rows = np.frombuffer(data, row, points, at)
        table = np.column_stack([rows["scale"], rows["rest"].astype(kind)])
        at = end
    else:
        words = re.split(r"[\s]+", data[at:].decode(encoding, "replace").partition("Title:")[0].strip())
        refuse(len(words) < points * (n + 1), f"'{path}' is cut short: {len(words):,} of {points * (n + 1):,} values")
        numbers = [word for k, word in enumerate(words[: points * (n + 1)]) if k % (n + 1)]
        try:
            table = np.array([complex(*map(float, word.split(","))) if is_complex else float(word) for word in numbers])
        except ValueError as error:
            raise InputError(f"'{path}': {error}; allowed: numbers") from None
        table = table.reshape(points, n)
        following = data.find("Title:".encode(encoding), at)
        at = following if following >= 0 else len(data)
    if variables[0][1] == "time":
        # LTspice marks points that it has left out beside others by a minus.
        table[:, 0] = np.abs(table[:, 0])
    vectors = {name: np.ascontiguousarray(table[:, k]) for k, (name, _) in enumerate(variables)}
    return Raw(head.get("title", ""), head.get("plotname", ""), vectors, dict(variables)), at


def _whole(path: Path, head: Mapping[str, str], key: str) -> int:
    """A count in the header."""
    text = head.get(key, "").split()
    if not text or not text[0].isdigit():
        raise InputError(f"'{path}' has {key!r} {head.get(key)!r}; allowed: a whole number")
    return int(text[0])
