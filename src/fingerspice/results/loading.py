"""Reading a run back from its NetCDF file."""

from __future__ import annotations

import dataclasses
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.physics.contact import Contact
from fingerspice.results.datafiles import FORMAT, GROUP
from fingerspice.results.outcome import Attempt, ErrorEstimate, Failure, Plan, State, Status
from fingerspice.results.signals import StoredRecord, StoredRun
from fingerspice.results.solution import Solution
from fingerspice.results.stored_circuit import made_again
from fingerspice.waveforms.waveform import Fundamental

if TYPE_CHECKING:
    pass


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
        raise InputError(f"{path} is not a file; allowed: a NetCDF file that to_netcdf or the command wrote")
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
        what = f"{type(error).__name__}: {error}"
        raise InputError(
            f"{path} cannot be read as a run ({what}); allowed: a NetCDF file that to_netcdf or the command wrote"
        ) from None


def _solution(file: Any) -> Solution:
    run = json.loads(_text(file.groups[GROUP].attrs["run"]))
    if run["format"] != FORMAT:
        raise InputError(f"the file has format {run['format']!r}; allowed: {FORMAT}, so another version wrote it")
    record = _record(file, run)
    failure = run["failure"]
    if failure is not None:
        tried = tuple(Attempt(**a) for a in failure["tried"])
        known = {f.name for f in dataclasses.fields(Failure)} - {"status", "tried"}
        own = {k: v for k, v in failure.items() if k in known}
        failure = Failure(Status[failure["status"]], tried=tried, **own)
    plan = run["plan"]
    return Solution(
        t=record.t,
        record=record,
        status=Status[run["status"]],
        failure=failure,
        nfev=int(run["nfev"]),
        stats=dict(run["stats"]),
        error=ErrorEstimate(**run["error"]),
        rtol=float(run["rtol"]),
        charge_law=str(run["charge_law"]),
        area_mode=str(run["area_mode"]),
        method=str(run["method"]),
        plan=Plan(**{**plan, "reasons": tuple(plan["reasons"]), "rates": tuple(plan["rates"])}),
        circuit=_circuit(file, run),
        state=_state(run["state"], str(run["charge_law"])),
        fundamental=None if run["fundamental"] is None else Fundamental(**run["fundamental"]),
        period=run["period"],
        fold_margin_min=float(run["fold_margin_min"]),
        warnings=tuple(map(str, run["warnings"])),
        first=float(run["first"]),
        t_stop=float(run["t_stop"]),
        continuous=_between(file, run, record),
        stored=dict(run["summary"]),
    )


def _record(file: Any, run: dict[str, Any]) -> StoredRecord:
    """The outputs, with the left-hand rows of jumps put back in their places."""
    names = {key: tuple(_text(x) for x in file.variables[key][...]) for key in ("layer", "node")}
    group = file.groups[GROUP]
    signals = [str(name) for name in run["signals"]]
    before = np.zeros((0, 1 + len(signals)))
    if "before" in group.variables:
        before = np.asarray(group.variables["before"][...], float)
    rows = before[:, 0].astype(int)
    t_before = np.asarray(file.variables["time"][...], float)[rows - np.arange(rows.size)]

    def whole(name: str) -> FloatArray | None:
        if name not in file.variables:
            return None
        kept = np.asarray(file.variables[name][...], float)
        own = [1 + i for i, signal in enumerate(signals) if signal == name or signal.startswith(f"{name}:")]
        added = t_before if name == "time" else before[:, own].reshape(rows.size, *kept.shape[1:])
        # np.insert takes places in the array without the inserted rows.
        return np.insert(kept, rows - np.arange(rows.size), added, axis=0)

    t = whole("time")
    if t is None or np.any(np.diff(t) < 0.0):
        raise ValueError("its times do not ascend")
    return _of_columns(t, whole, names, run)


def _of_columns(
    t: FloatArray, whole: Callable[[str], FloatArray | None], names: dict[str, tuple[str, ...]], run: dict[str, Any]
) -> StoredRecord:
    """A record at times (s) of the signals that `whole` gives by name."""
    u_layer, nodes, u_source, margin = (whole(name) for name in ("u_layer", "v", "u_source", "fold_margin"))
    if u_layer is None or nodes is None or u_source is None or margin is None:
        raise ValueError("a voltage is missing")
    none = np.zeros((t.size, 0))
    u_gap, force = whole("u_gap"), whole("f_el")
    return StoredRecord(
        t, names["layer"], tuple(map(str, run["sources"])),
        tuple((str(name), Contact(**values)) for name, values in run["contacts"]),
        u_source, u_layer, none if u_gap is None else u_gap, whole("area"), none if force is None else force,
        whole("q_source"), whole("i_source"), margin,
        {name: nodes[:, i].copy() for i, name in enumerate(names["node"])},
    )  # fmt: skip


def _between(file: Any, run: dict[str, Any], record: StoredRecord) -> StoredRun | None:
    """The last period between the outputs; None where the file has none."""
    group = file.groups[GROUP]
    if "between" not in group.variables:
        return None
    table, signals = np.asarray(group.variables["between"][...], float), [str(name) for name in run["between"]]
    kept = {"layer": record.layers, "node": tuple(record.node_voltages)}

    def whole(name: str) -> FloatArray | None:
        own = [1 + i for i, signal in enumerate(signals) if signal == name or signal.startswith(f"{name}:")]
        if name in ("u_layer", "v"):
            return table[:, own]
        return None if not own else table[:, own[0]].copy() if len(own) == 1 else table[:, own]

    return StoredRun(float(run["t_stop"]) - float(run["period"]), _of_columns(table[:, 0].copy(), whole, kept, run))


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _state(kept: dict[str, Any], law: str) -> State:
    y, before, sign = (np.array(kept.get(k, d), float) for k, d in (("y", []), ("s_before", []), ("sign", [0.0])))
    return State(float(kept["t"]), y, before, sign, law)


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
