"""Results as tables and variables."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import BoolArray
from fingerspice.results.signals import SIGNALS
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from fingerspice.results.solution import Solution


#: Dimensions, values and attributes of a variable, as xarray and NetCDF take them.
Variable = tuple[tuple[str, ...], NDArray[Any], dict[str, str]]


def kept_rows(solution: Solution, jumps: str) -> BoolArray:
    """Mask of the rows that are written, shape (n_t,): all rows, or all but the left-hand rows of jumps."""
    require(jumps in ("right", "both"), "jumps", repr(jumps), "'right' or 'both'")
    keep = np.ones(solution.t.size, bool)
    if jumps == "right" and solution.t.size:
        keep[:-1] = np.diff(solution.t) > 0.0
    return keep


def variables(
    solution: Solution, keep: BoolArray, wanted: Collection[str] = SIGNALS
) -> tuple[dict[str, Variable], dict[str, Variable]]:
    """Variables and coordinates of the data files, with the rows in `keep` and those signals that are wanted."""
    data: dict[str, Variable] = {}
    coords: dict[str, Variable] = {"time": (("time",), solution.t[keep], {"units": "s", "long_name": "time"})}
    for key, signal in SIGNALS.items():
        columns = [x[keep] for x in solution.by_name(key).values()] if key in wanted else []
        several = key in ("u_layer", "v")
        about = {"units": signal.unit, "long_name": signal.text}
        if len(columns) > 1 or (several and key in wanted):
            coords[signal.of] = ((signal.of,), np.array(solution.all_signals.columns(key), dtype=object), {})
            table = np.column_stack([np.zeros((int(keep.sum()), 0)), *columns])
            data[key] = (("time", signal.of), table, about)
        elif columns:
            data[key] = (("time",), columns[0], about)
    return data, coords
