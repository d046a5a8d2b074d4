"""A solution as files: CSV and NetCDF, and the variables that NetCDF and xarray share."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.waveforms import require
from fingerspice.files import write_aside, write_pieces

if TYPE_CHECKING:
    from fingerspice.solution import Solution

# Dimensions, values, attributes: what both xarray and NetCDF take.
Variable = tuple[tuple[str, ...], NDArray[Any], dict[str, str]]


def write_csv(solution: Solution, path: Path) -> Path:
    """Write every signal as CSV, names and units in the header; both rows of a jump are kept."""
    signals = solution.signals
    header = ["t [s]", *(f"{name} [{unit}]" for name, (_, unit, _) in signals.items())]
    table = np.column_stack([solution.t, *(value for value, _, _ in signals.values())])

    def write(target: Path) -> None:
        with target.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(header)
            writer.writerows([repr(float(x)) for x in row] for row in table)

    return write_aside(path, write)


def variables(solution: Solution, jumps: str) -> tuple[dict[str, Variable], dict[str, Variable]]:
    """Variables and coordinates of the data files."""
    require(jumps in ("right", "both"), "jumps", repr(jumps), "'right' or 'both'")
    t = solution.t
    keep = np.ones(t.size, bool)
    if jumps == "right" and t.size:
        keep[:-1] = np.diff(t) > 0.0
    data: dict[str, Variable] = {
        name: (("time",), value[keep], {"units": unit, "long_name": text})
        for name, (value, unit, text) in solution.signals.items()
        if not name.startswith(("u_layer:", "v:"))
    }
    data["u_layer"] = (("time", "layer"), solution.u_layer[keep], {"units": "V", "long_name": "layer voltage"})
    nodes = np.column_stack(list(solution.node_voltages.values()))[keep]
    data["v"] = (("time", "node"), nodes, {"units": "V", "long_name": "node voltage"})
    coords: dict[str, Variable] = {
        "time": (("time",), t[keep], {"units": "s", "long_name": "time"}),
        "layer": (("layer",), np.array(solution.layers, dtype=object), {}),
        "node": (("node",), np.array(list(solution.node_voltages), dtype=object), {}),
    }
    return data, coords


def write_netcdf(solution: Solution, path: Path, jumps: str) -> Path:
    """Write the variables as a NetCDF file."""
    import h5netcdf
    import h5py

    data, coords = variables(solution, jumps)

    def write(target: Path) -> None:
        # HDF5 ends the process where the disk is full, so it gets to see memory only.
        content = io.BytesIO()
        with h5netcdf.File(content, "w") as file:
            for name, (_, values, _) in coords.items():
                file.dimensions[name] = values.size
            for name, (dimensions, values, attributes) in {**coords, **data}.items():
                kind = h5py.string_dtype() if values.dtype == object else values.dtype
                variable = file.create_variable(name, dimensions, dtype=kind, data=values)
                variable.attrs.update(attributes)
            for key, text in solution.provenance().items():
                file.attrs[key] = text
        write_pieces(target, content.getbuffer())

    return write_aside(path, write)
