"""The NetCDF file of a run: written and read back."""

from __future__ import annotations

import dataclasses
import io
import json
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fingerspice.base import files
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.numerics.lobatto import NODES
from fingerspice.physics.contact import Contact
from fingerspice.results.datafiles import Variable, kept_rows, variables
from fingerspice.results.outcome import Attempt, ErrorEstimate, Failure, Plan, State, Status
from fingerspice.results.signals import stored_record
from fingerspice.results.solution import Solution
from fingerspice.results.steps import Block, Recorded
from fingerspice.results.stored_circuit import made_again, stored_circuit
from fingerspice.waveforms.waveform import Fundamental

#: Name of the NetCDF group with what `load` needs besides the variables, and the number of its format.
GROUP, FORMAT = "fingerspice", 1
_ALLOWED = "allowed: a NetCDF file that to_netcdf or the command wrote"


def _failure(plain: dict[str, Any] | None) -> Failure | None:
    if plain is None:
        return None
    tried = tuple(Attempt(**a) for a in plain["tried"])
    own = {f.name: plain[f.name] for f in dataclasses.fields(Failure) if f.name in plain}
    return Failure(**{**own, "status": Status[plain["status"]], "tried": tried})


def _state(plain: dict[str, Any]) -> State:
    y, before, sign = (np.array(plain.get(k, d), float) for k, d in (("y", []), ("s_before", []), ("sign", [0.0])))
    return State(float(plain["t"]), y, before, sign, str(plain["charge_law"]))


#: Attributes of a solution that its file holds as plain data, how each is made plain, and how it is made again.
_PLAIN: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "nfev": (int, int),
    "error": (vars, lambda plain: ErrorEstimate(**plain)),
    "rtol": (float, float),
    # Without the wall time, so that the same run gives the same file.
    "stats": (lambda x: {k: v for k, v in x.items() if isinstance(v, (int, float, str)) and k != "wall_s"}, dict),
    "charge_law": (str, str),
    "area_mode": (str, str),
    "method": (str, str),
    "plan": (
        Plan.to_dict,
        lambda plain: Plan(**{**plain, "reasons": tuple(plain["reasons"]), "rates": tuple(plain["rates"])}),
    ),
    "status": (lambda status: status.name, lambda name: Status[name]),
    "failure": (lambda failure: failure and failure.to_dict(), _failure),
    "fundamental": (lambda x: x and vars(x), lambda plain: plain and Fundamental(**plain)),
    "period": (lambda x: x, lambda x: x),
    "fold_margin_min": (float, float),
    "warnings": (list, lambda plain: tuple(map(str, plain))),
    "first": (float, float),
    "t_stop": (float, float),
    "state": (lambda x: {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(x).items()}, _state),
}


def write_netcdf(solution: Solution, path: Path, jumps: str) -> Path:
    """Write the variables as a NetCDF file, with a group of further data that `load` needs."""
    import h5netcdf

    keep = kept_rows(solution, jumps)

    def write(target: Path) -> None:
        # HDF5 would end the process on a full disk, so let it write into memory.
        content = io.BytesIO()
        with h5netcdf.File(content, "w") as file:
            _fill(file, *variables(solution, keep))
            for key, text in solution.provenance().items():
                file.attrs[key] = text
            group = file.create_group(GROUP)
            circuit, arrays = stored_circuit(solution.circuit, solution.t_stop, solution.rtol)
            between = solution._figures.between()
            run = {"format": FORMAT, **{name: plain(getattr(solution, name)) for name, (plain, _) in _PLAIN.items()}}
            run |= {
                "sources": list(solution.sources), "signals": list(solution.signals),
                "contacts": [[name, dataclasses.asdict(contact)] for name, contact in solution.record.fingers],
                "overrides": dict(solution.circuit.overrides), "summary": solution.summary(), "circuit": circuit,
                "arrays": len(arrays), "between": between and between[0],
            }  # fmt: skip
            group.attrs["run"] = json.dumps(run, default=float)
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


def load(path: str | Path) -> Solution:
    """Read a run back from a file of `Solution.to_netcdf` or of ``fingerspice run``.

    Signals with both rows of each jump, figures, error, status and warnings are those of the run, and so are the lines
    of its spectra. The circuit is made again from the elements in the file, with the samples of recordings, and with a
    function as the Chebyshev series by which the run represented it. Where these are more than 8 million numbers, it
    has no elements, and a warning is issued. No run can start from a loaded one.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Solution

    Raises
    ------
    InputError
        For a missing file, or one that this package did not write.
    """
    import h5netcdf

    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} is not a file; {_ALLOWED}")
    try:
        with h5netcdf.File(path, "r") as file:
            if GROUP not in file.groups:
                raise InputError(
                    f"{path} is no run of fingerspice; allowed: a file that to_netcdf or the command wrote"
                )
            return _solution(file)
    except InputError:
        raise
    except (OSError, KeyError, ValueError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as a run ({type(error).__name__}: {error}); {_ALLOWED}") from None


def _solution(file: Any) -> Solution:
    group = file.groups[GROUP]
    run = json.loads(_text(group.attrs["run"]))
    if run["format"] != FORMAT:
        raise InputError(f"the file has format {run['format']!r}; allowed: {FORMAT}, so another version wrote it")
    signals = [str(name) for name in run["signals"]]
    # A table of all signals in their order, with the left-hand rows of jumps put back in their places.
    keys = ["time", *dict.fromkeys(name.partition(":")[0] for name in signals)]
    table = np.column_stack([np.asarray(file.variables[key][...], float) for key in keys])
    if "before" in group.variables:
        before = np.asarray(group.variables["before"][...], float)
        # np.insert takes places in the array without the inserted rows.
        places = before[:, 0].astype(int) - np.arange(len(before))
        before[:, 0] = table[places, 0]
        table = np.insert(table, places, before, axis=0)
    t = table[:, 0].copy()
    if np.any(np.diff(t) < 0.0):
        raise ValueError("its times do not ascend")
    fingers = tuple((str(name), Contact(**values)) for name, values in run["contacts"])
    of_names = partial(stored_record, sources=tuple(map(str, run["sources"])), fingers=fingers)
    continuous = None
    if "between" in group.variables:
        # The last period, of which each panel is a step.
        period = np.asarray(group.variables["between"][...], float)
        begin, end = period[::NODES, 0], period[NODES - 1 :: NODES, 0]
        values = period[:, 1:].reshape(begin.size, NODES, -1).transpose(0, 2, 1)
        steps = Block(np.column_stack([begin, end - begin, end, np.ones(begin.size)]), values)
        make = partial(of_names, tuple(map(str, run["between"])))
        continuous = Recorded((steps,), float(run["t_stop"]) - float(run["period"]), make)
    return Solution(
        t=t,
        record=of_names(signals, t, None, table[:, 1:].T),
        circuit=_circuit(file, run),
        continuous=continuous,
        stored=dict(run["summary"]),
        **{name: make(run[name]) for name, (_, make) in _PLAIN.items()},
    )


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _circuit(file: Any, run: dict[str, Any]) -> Circuit:
    kept = run.get("circuit", "an earlier version wrote it")
    group = file.groups[GROUP]
    try:
        if isinstance(kept, str):
            raise ValueError(kept)
        names = [f"circuit{k}" for k in range(int(run["arrays"]))]
        made = made_again(kept, [np.asarray(group.variables[name][...], float) for name in names])
        return made._with(text=_text(file.attrs["deck"]))
    except (InputError, ValueError, TypeError, KeyError, IndexError, AttributeError, ArithmeticError) as error:
        warnings.warn(
            f"the circuit of this run cannot be made again from its file ({error}); its elements are left out",
            FingerspiceWarning,
            stacklevel=4,
        )
        sets = json.loads(_text(file.attrs["sets"])) if "sets" in file.attrs else {}
        return Circuit(
            _text(file.attrs["title"]), (), text=_text(file.attrs["deck"]), overrides=dict(run["overrides"]), sets=sets
        )
