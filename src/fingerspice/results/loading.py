"""Reading a run back from its NetCDF file."""

from __future__ import annotations

import ast
import dataclasses
import json
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.netlist.netlist import parse_netlist
from fingerspice.physics.contact import Contact
from fingerspice.results.datafiles import FORMAT, GROUP
from fingerspice.results.outcome import Attempt, ErrorEstimate, Failure, State, Status
from fingerspice.results.plan import Plan
from fingerspice.results.solution import Solution
from fingerspice.results.stored_record import StoredRecord
from fingerspice.waveforms import combinations, periodic, ramps, repeated, transients
from fingerspice.waveforms import waveform as waveforms
from fingerspice.waveforms.waveform import Fundamental, Waveform

# Waveform classes that `_literal` accepts in the stored text of a changed source.
_WAVEFORMS = {
    kind.__name__: kind
    for kind in (
        waveforms.DC, waveforms.Sine, transients.Chirp, transients.Exp, ramps.PWL, periodic.Pulse, periodic.Square,
        periodic.Triangle, periodic.Sawtooth, combinations.Sum, combinations.Product, combinations.AM,
        repeated.Burst, repeated.Repeat,
    )
}  # fmt: skip
# Deepest nesting of expressions in that text, so that a malicious file cannot exhaust the stack.
_DEEPEST = 20
_NOT_KEPT = "a source that was a function or samples is not kept in a file"


def load(path: str | Path) -> Solution:
    """Read a run back from a file of `Solution.to_netcdf` or of ``fingerspice run``.

    Signals with both rows of each jump, figures, error, status and warnings are those of the run. The circuit is built
    again from the deck's text and the changes; where that is not possible (a source that was a function or samples, a
    deck that includes or plays files), it has no elements, and a warning is issued. No run can start from a loaded one.

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
        circuit=_circuit(file, run["overrides"])._with(sets=_sets(file)),
        state=_state(run["state"], str(run["charge_law"])),
        fundamental=None if run["fundamental"] is None else Fundamental(**run["fundamental"]),
        period=run["period"],
        fold_margin_min=float(run["fold_margin_min"]),
        warnings=tuple(map(str, run["warnings"])),
        first=float(run["first"]),
        t_stop=float(run["t_stop"]),
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


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _state(kept: dict[str, Any], law: str) -> State:
    """The state reached; files of earlier versions store the source of a series stack as one number, `u_before`."""
    y, before, sign = (np.array(kept.get(k, d), float) for k, d in (("y", []), ("s_before", []), ("sign", [0.0])))
    if "u_before" in kept:
        before = np.array([kept["u_before"]], float)
    return State(float(kept["t"]), y, before, sign, law)


def _circuit(file: Any, overrides: dict[str, str]) -> Circuit:
    title, text = _text(file.attrs["title"]), _text(file.attrs["deck"])
    try:
        circuit = parse_netlist(text)
        return circuit.replace({path: _value(value) for path, value in overrides.items()}) if overrides else circuit
    except (InputError, ValueError, TypeError) as error:
        warnings.warn(
            f"the circuit of this run cannot be made again from its file ({error}); its elements are left out",
            FingerspiceWarning,
            stacklevel=4,
        )
        return Circuit(title, (), text=text, overrides=dict(overrides))


def _sets(file: Any) -> dict[str, dict[str, float | Waveform]]:
    """The named sets of parameters that were applied; files of earlier versions name none."""
    found = json.loads(_text(file.attrs["sets"])) if "sets" in file.attrs else {}
    return {str(name): {path: _value(text) for path, text in values.items()} for name, values in found.items()}


def _value(text: str) -> float | Waveform:
    """The value that `Circuit.replace` was given, from its text.

    Raises
    ------
    ValueError
        For anything but a number or a waveform made of numbers.
    """
    try:
        return float(text)
    except ValueError:
        pass
    try:
        found = _literal(ast.parse(text, mode="eval").body)
    except SyntaxError:
        found = None
    if not isinstance(found, Waveform):
        raise ValueError(_NOT_KEPT)
    return found


def _literal(node: ast.expr, depth: int = 0) -> Any:
    """The value of a number, a tuple or a waveform made of these; anything else is refused."""
    if depth < _DEEPEST:
        if isinstance(node, ast.Constant) and (node.value is None or isinstance(node.value, (int, float))):
            return node.value
        if isinstance(node, ast.Name) and node.id in ("inf", "nan"):
            return math.inf if node.id == "inf" else math.nan
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            return -_literal(node.operand, depth + 1)
        if isinstance(node, ast.Tuple):
            return tuple(_literal(x, depth + 1) for x in node.elts)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _WAVEFORMS:
            given = {str(k.arg): _literal(k.value, depth + 1) for k in node.keywords}
            kind: Any = _WAVEFORMS[node.func.id]
            return kind(*(_literal(x, depth + 1) for x in node.args), **given)
    raise ValueError(_NOT_KEPT)
