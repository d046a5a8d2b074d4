"""Files of results: NetCDF, CSV, and the variables of both."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base import files
from fingerspice.base.arrays import BoolArray
from fingerspice.results.signals import SIGNALS
from fingerspice.results.stored_circuit import stored_circuit
from fingerspice.results.summary import Figures
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    import pandas

    from fingerspice.results.solution import Solution

#: Name of the NetCDF group with what `load` needs besides the variables, and the number of its format.
GROUP, FORMAT = "fingerspice", 1

#: Dimensions, values and attributes of a variable, as xarray and NetCDF take them.
Variable = tuple[tuple[str, ...], NDArray[Any], dict[str, str]]


def write_csv(solution: Solution, path: Path) -> Path:
    """Write every signal as CSV with names and units in the header; a jump has both its rows."""
    signals = solution.signals
    header = ["t [s]", *(f"{name} [{unit}]" for name, (_, unit, _) in signals.items())]
    table = np.column_stack([solution.t, *(value for value, _, _ in signals.values())])
    return files.write_csv(path, header, (row.tolist() for row in table))


def _kept(solution: Solution, jumps: str) -> BoolArray:
    """Mask of the rows that are written, shape (n_t,): all rows, or all but the left-hand rows of jumps."""
    require(jumps in ("right", "both"), "jumps", repr(jumps), "'right' or 'both'")
    keep = np.ones(solution.t.size, bool)
    if jumps == "right" and solution.t.size:
        keep[:-1] = np.diff(solution.t) > 0.0
    return keep


def variables(
    solution: Solution, keep: BoolArray, wanted: Collection[str] = SIGNALS
) -> tuple[dict[str, Variable], dict[str, Variable]]:  # fmt: skip
    """Variables and coordinates of the data files, with the rows in `keep` and those signals that are wanted."""
    signals = solution.all_signals
    data: dict[str, Variable] = {}
    coords: dict[str, Variable] = {"time": (("time",), solution.t[keep], {"units": "s", "long_name": "time"})}
    for key, (unit, text) in SIGNALS.items():
        names = signals.names(key)
        several = key in ("u_layer", "v")
        if key not in wanted or (not names and not several):
            continue
        columns = [signals.one(name)[keep] for name in names]
        if several or len(names) > 1:
            dimension = {"u_layer": "layer", "v": "node"}.get(key, "source" if key.endswith("_source") else "gap")
            coords[dimension] = ((dimension,), np.array(signals.columns(key), dtype=object), {})
            values = np.column_stack(columns) if columns else np.zeros((int(keep.sum()), 0))
            data[key] = (("time", dimension), values, {"units": unit, "long_name": text})
        else:
            data[key] = (("time",), columns[0], {"units": unit, "long_name": text})
    return data, coords


def dataset(solution: Solution, jumps: str) -> tuple[dict[str, Variable], dict[str, Variable]]:
    """Variables and coordinates for xarray."""
    return variables(solution, _kept(solution, jumps))


def to_dataframe(solution: Solution, jumps: str) -> pandas.DataFrame:
    """The run as a table with a column for every signal and a row for every time."""
    import pandas

    keep = _kept(solution, jumps)
    index = pandas.Index(solution.t[keep], name="time")
    return pandas.DataFrame({name: x[keep] for name, (x, _, _) in solution.signals.items()}, index=index)


def write_netcdf(solution: Solution, path: Path, jumps: str) -> Path:
    """Write the variables as a NetCDF file, with a group of further data that `load` needs."""
    import h5netcdf

    keep = _kept(solution, jumps)

    def write(target: Path) -> None:
        # HDF5 would end the process on a full disk, so let it write into memory.
        content = io.BytesIO()
        with h5netcdf.File(content, "w") as file:
            _fill(file, *variables(solution, keep))
            for key, text in solution.provenance().items():
                file.attrs[key] = text
            group = file.create_group(GROUP)
            circuit, arrays = stored_circuit(solution.circuit, solution.t_stop, solution.rtol)
            between = solution._figures.between() if isinstance(solution._figures, Figures) else None
            more = {"circuit": circuit, "arrays": len(arrays), "between": between and between[0]}
            group.attrs["run"] = json.dumps({**_run(solution), **more}, default=float)
            tables = {f"circuit{k}": array for k, array in enumerate(arrays)}
            for name, table in (tables | ({} if between is None else {"between": between[1]})).items():
                dimensions = tuple(f"{name}_{axis}" for axis in range(table.ndim))
                group.dimensions.update(zip(dimensions, table.shape, strict=True))
                group.create_variable(name, dimensions, dtype=float, data=table)
            if not keep.all():
                # Only `load` uses the left-hand rows of jumps; they form one table, because each variable takes time.
                group.dimensions["jump"] = int(np.count_nonzero(~keep))
                group.dimensions["signal"] = 1 + len(solution.signals)
                rows = [np.flatnonzero(~keep), *(x[~keep] for x, _, _ in solution.signals.values())]
                group.create_variable("before", ("jump", "signal"), dtype=float, data=np.column_stack(rows))
        files.write_pieces(target, content.getbuffer())

    return files.write_aside(path, write)


def _fill(file: Any, data: dict[str, Variable], coords: dict[str, Variable]) -> None:
    import h5py

    for name, (_, values, _) in coords.items():
        file.dimensions[name] = values.size
    for name, (dimensions, values, attributes) in {**coords, **data}.items():
        kind = h5py.string_dtype() if values.dtype == object else values.dtype
        variable = file.create_variable(name, dimensions, dtype=kind, data=values)
        variable.attrs.update(attributes)


def _run(solution: Solution) -> dict[str, Any]:
    """Everything about a run except its signals, as plain data."""
    state = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(solution.state).items()}
    fundamental = solution.fundamental
    return {
        "format": FORMAT, "nfev": int(solution.nfev), "error": vars(solution.error), "rtol": solution.rtol,
        # Without the wall time, so that the same run gives the same file.
        "stats": {k: v for k, v in solution.stats.items() if isinstance(v, (int, float, str)) and k != "wall_s"},
        "charge_law": solution.charge_law, "area_mode": solution.area_mode, "method": solution.method,
        "plan": solution.plan.to_dict(), "status": solution.status.name,
        "failure": None if solution.failure is None else solution.failure.to_dict(),
        "fundamental": None if fundamental is None else vars(fundamental), "period": solution.period,
        "fold_margin_min": solution.fold_margin_min, "warnings": list(solution.warnings), "first": solution.first,
        "t_stop": solution.t_stop, "sources": list(solution.sources),
        "signals": list(solution.signals),
        "contacts": [[name, dataclasses.asdict(contact)] for name, contact in solution.record.fingers],
        "overrides": dict(solution.circuit.overrides), "state": state, "summary": solution.summary(),
    }  # fmt: skip
