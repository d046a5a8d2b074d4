"""What a deck asks for beside one run: its `.step` lines, in lockstep or run by run, its `.dc` sweep, and `.op`."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import count, product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Step
from fingerspice.circuit.describe import require_circuit
from fingerspice.netlist.netlist import at_parameters
from fingerspice.results.outcome import SolveError
from fingerspice.results.record import signal_of
from fingerspice.solve.simulation import simulate
from fingerspice.studies.batch.batch import (
    FAILED,
    MESSAGES,
    ONE_BY_ONE,
    OUTPUTS,
    REFUSED,
    STATUS,
    STATUS_NAMES,
    batch,
    checked_scenes,
    processors,
)
from fingerspice.studies.steady import phasor, sweep_frequencies
from fingerspice.waveforms.waveform import DC, refuse, require

if TYPE_CHECKING:
    from xarray import Dataset

#: Figures of each step by default, and signals of a finger and of a circuit without one.
FIGURES, _SIGNALS, _PLAIN = ("u_gap_rms", "f_el_mean", "f_t_mean"), ("u_source", "u_gap", "f_el", "f_t"), ("v",)
_MOST_KEPT = 2e8  # Most numbers of all signals (1.6 GB)
_MOMENT = 1e-6  # Length (s) of the run that begins with the operating point
Row = tuple[tuple[str, ...], NDArray[Any], Mapping[str, Any]]  #: Dimensions of a variable, its values, its attributes.


def run_steps(
    circuit: Circuit,
    *,
    signals: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> Dataset:
    """Run a circuit at all values of its deck's `.step` lines.

    Parameters
    ----------
    circuit : Circuit
    signals : sequence of str, optional
        Signals over the outputs of the deck, as in `Solution.signals`; by default the source's and gap's voltage, the
        force and the friction. Where there are none, as with ``()``, and the deck has no `.meas`, the steps go as one
        `batch`.
    outputs : sequence of str, optional
        Figures, as in `batch`; ``u_gap_rms``, ``f_el_mean`` and ``f_t_mean`` by default.
    progress : callable, optional
        Called with the fraction of the steps that is done.
    **options
        As of `simulate`; of a batch `rtol` and `t_stop`.

    Returns
    -------
    xarray.Dataset
        With a dimension for each step, named as its line says, and ``time`` (s); the signals and the figures, of each
        of several GAPs as ``f_el_mean:Xlight``; the deck's measures by their names; and ``status`` as in `batch`. The
        attribute `failures` says why steps have no results, which are NaN there.

    Raises
    ------
    InputError
        For a deck without `.step`, a name that is unknown or given twice, and more numbers than memory holds.
    """
    require_circuit(circuit)
    refuse(not circuit.steps, "the deck has no .step line; allowed: one, such as .step Xgap.d 3u 4u 0.1u")
    fingers = bool(circuit.by_device("GAP"))
    outputs = (FIGURES if fingers else ()) if outputs is None else tuple(outputs)
    signals = (_SIGNALS if fingers else _PLAIN) if signals is None else tuple(signals)
    for name in outputs:
        require(name in OUTPUTS and name != "u_gap", "outputs", repr(name), f"figures such as {', '.join(FIGURES)}")
    named = *(one.name for one in circuit.measures), *(one.name for one in circuit.steps)
    _refuse_twice(*named, *signals, *outputs, "time", "status", "error")
    figures_alone = not signals and not circuit.measures and not options.keys() - {"rtol", "t_stop"}
    if figures_alone and (table := _table(circuit)) is not None:
        found = batch(circuit, table, outputs=outputs, **options)
        data: dict[str, Any] = {str(name): (x.dims[1:], x.values, x.attrs) for name, x in found.data_vars.items()}
        return _dataset(circuit, circuit.steps, data, {}, found.attrs)

    def kept(scene: Circuit) -> dict[str, Row]:
        run = simulate(scene, jumps="none", **options)
        names = [one for key in signals for one in run.record.names(key)]
        units = {name: {"units": signal_of(name).unit} for name in (*names, *(OUTPUTS[name][0] for name in outputs))}
        row: dict[str, Row] = {name: (("time",), run.record.one(name), units[name]) for name in names}
        row["time"] = ("time",), run.t, {"units": "s"}
        for name in outputs:
            value = np.asarray(run._figure(*OUTPUTS[name]), float)
            row[name] = ("gap",)[: value.ndim], value, units[OUTPUTS[name][0]]
        return row | {name: ((), np.array(value), {}) for name, value in run.measures.items()}

    tran = circuit.tran
    times = 1.0 if tran is None else (tran.stop - tran.start) / tran.step
    size = math.prod(len(one.values) for one in circuit.steps) * times * len(signals)
    require(size <= _MOST_KEPT, ".step", f"{size:.3g} numbers of signals", f"{_MOST_KEPT:g}; fewer outputs or signals")
    return _found(circuit, circuit.steps, kept, progress)


def phasor_steps(circuit: Circuit, **options: Any) -> Dataset:
    """The `.ac` sweep of a circuit at all values of its deck's `.step` lines.

    Parameters
    ----------
    circuit : Circuit
    **options
        As of `phasor`: `area`, `skin` and `finger`.

    Returns
    -------
    xarray.Dataset
        With a dimension for each step and ``frequency`` (Hz); the columns of the sweep's table, as ``u_gap`` (V) and
        ``phase_deg``, or without a GAP ``v:top`` (V) and ``phase_deg:top``; the deck's measures of `.ac` by their
        names; and ``status`` and `failures` as in `run_steps`.

    Raises
    ------
    InputError
        For a deck without `.ac` or `.step`, and for a name that is given twice.
    """
    require_circuit(circuit)
    lacks = "" if circuit.ac and circuit.steps else ".ac" if circuit.steps else ".step"
    refuse(lacks, f"the deck has no {lacks} line; allowed: both, such as .ac dec 10 10 10k and .step Xgap.d 3u 4u 0.1u")

    def swept(scene: Circuit) -> dict[str, Row]:
        assert scene.ac is not None
        found = phasor(scene, sweep_frequencies(scene.ac), **options)
        row: dict[str, Row] = {x.key: (("frequency",), x.values, {"units": x.unit}) for x in found._columns()}
        _refuse_twice(*row, *found.measures, *(one.name for one in scene.steps), "status")
        return row | {name: ((), np.array(value), {}) for name, value in found.measures.items()}

    return _found(circuit, circuit.steps, swept, None)


def operating_points(circuit: Circuit, *, charge_law: str | None = None) -> Dataset:
    """The operating point of a circuit with its areas, at all values of its deck's `.dc` and `.step` lines.

    Sources are at their values before 0 s, and all that could change has settled.

    Parameters
    ----------
    circuit : Circuit
    charge_law : str, optional
        ``"local"`` or ``"mobile"``; the circuit's own by default.

    Returns
    -------
    xarray.Dataset
        With a dimension for each value that is swept, every signal of `Solution.signals`, and ``status``.

    Raises
    ------
    InputError
        If the circuit has no operating point.
    """
    require_circuit(circuit)

    def point(scene: Circuit) -> dict[str, Row]:
        levels: dict[str, Any] = {
            e.name: DC(float(e.waveform.value(0.0, "left")))
            for e in scene.by_device("V", "I")
            if e.waveform is not None
        }
        held = scene.varied(levels)
        run = simulate(held, t_stop=_MOMENT, t_eval=[0.0], start="dc", charge_law=charge_law)
        return {name: ((), x[0], {"units": unit}) for name, (x, unit, _) in run.signals.items()}

    return _found(circuit, (*circuit.dc, *circuit.steps), point, None)


def table_of(found: Dataset) -> tuple[list[dict[str, Any]], dict[str, list[Any]]]:
    """The scenes of steps as plain data, and as columns with units in heads; without what has a further dimension."""
    steps = [str(name) for name in found["status"].dims]
    names = [str(name) for name, one in found.data_vars.items() if one.ndim == len(steps) and name != "status"]
    mesh = np.meshgrid(*(found[name].values for name in steps), indexing="ij")
    columns = {name: x.ravel().tolist() for name, x in zip(steps, mesh, strict=True)}
    columns |= {name: found[name].values.ravel().tolist() for name in names}
    status = [STATUS_NAMES[k] for k in found["status"].values.ravel()]
    rows = [
        {"values": {name: columns[name][k] for name in steps}, "status": one,
         "figures": {name: columns[name][k] for name in names}}
        for k, one in enumerate(status)
    ]  # fmt: skip
    heads = {name: f"{name} [{unit}]" if (unit := found[name].attrs.get("units")) else name for name in columns}
    return rows, {heads[name]: x for name, x in columns.items()} | {"status": status}


def _refuse_twice(*names: str) -> None:
    twice = [name for name, n in Counter(names).items() if n > 1]
    refuse(twice, f"{', '.join(twice)} is the name of a step or measure, and of what is kept; allowed: another name")


def scene_of(circuit: Circuit, values: Mapping[Step, float]) -> Circuit:
    """The circuit at values of steps, each a parameter of the deck, a source's level or a path."""
    params = {one.name: value for one, value in values.items() if one.of_param}
    circuit = at_parameters(circuit, params) if params else circuit
    sources = {e.name for e in circuit.by_device("V", "I")}
    rest = {one.name: value for one, value in values.items() if not one.of_param}
    return circuit.varied({path: DC(value) if path in sources else value for path, value in rest.items()})


def places(steps: Sequence[Step]) -> list[dict[Step, float]]:
    """The values of each scene, the last step changing fastest."""
    return [dict(zip(steps, values, strict=True)) for values in product(*(one.values for one in steps))]


def _table(circuit: Circuit) -> dict[str, FloatArray] | None:
    """Values (n_scene,) by path of all scenes; None where other things change, or one is out of range."""
    known, rows, scenes = circuit.parameters, list[dict[str, float]](), places(circuit.steps)
    try:
        for place in scenes:
            if all(one.name in known for one in place):
                rows.append({one.name: value for one, value in place.items()})
                continue
            scene = scene_of(circuit, place)
            rows.append({path: p.value for path, p in scene.parameters.items() if p != known.get(path)})
            if scene.tran != circuit.tran or circuit.varied(rows[-1]).elements != scene.elements:
                return None
        paths = dict.fromkeys(path for row in rows for path in row)
        table = {path: np.array([row.get(path, known[path].value) for row in rows]) for path in paths}
        return checked_scenes(circuit, table) if table else None
    except InputError:
        return None


def _found(
    circuit: Circuit, steps: Sequence[Step], make: Callable[[Circuit], dict[str, Row]],
    progress: Callable[[float], None] | None,
) -> Dataset:  # fmt: skip
    """What `make` finds in every scene, on all processors, as a Dataset."""
    scenes, failures, done = places(steps), dict[int, str](), count(1)
    rows: list[dict[str, Row]] = [{} for _ in scenes]
    status = np.full(len(scenes), ONE_BY_ONE, np.int8)

    def told(k: int) -> str:
        return "".join(f"{step.name} = {value:g}, " for step, value in scenes[k].items())[:-2] + ": " * bool(steps)

    def one(k: int) -> None:
        try:
            rows[k] = make(scene_of(circuit, scenes[k]))
        except (InputError, SolveError) as error:
            status[k] = REFUSED if isinstance(error, InputError) else FAILED
            failures[k] = f"{told(k)}{error.message}"
        if progress is not None:
            progress(next(done) / len(rows))

    # Filters of warnings apply to all threads.
    with warnings.catch_warnings(action="ignore"), ThreadPoolExecutor(processors()) as pool:
        list(pool.map(one, range(len(scenes))))
    none = f"{'no step has a result; the first: ' * bool(steps)}{failures.get(0)}"
    refuse(len(failures) == len(rows), none)
    axis = next((name for row in rows for name, one in row.items() if one[0] == (name,)), "")
    t = max((row[axis][1] for row in rows if axis in row), key=np.size, default=np.empty(0))
    for k, row in enumerate(rows):
        own = row[axis][1] if axis in row else t[:0]
        if not np.allclose(own, t[: own.size], rtol=1e-9, atol=0.0):
            rows[k], status[k] = {}, REFUSED
            failures[k] = f"{told(k)}its outputs differ in {axis}; allowed: a TSTEP, TSTART and .ac that stay"
    data: dict[str, Row] = {"status": ((), status, STATUS)}
    for name, (dims, first, attrs) in next(filter(None, rows)).items():
        # A run that ends earlier than others has no values after its end.
        values = np.full((len(rows), *(t.shape if dims == (axis,) else first.shape)), np.nan)
        for k, row in enumerate(rows):
            if row:
                value = row[name][1]
                values[(k, slice(value.size)) if dims == (axis,) else k] = value
        data[name] = dims, values, attrs
    coords = {axis: (axis, t, data.pop(axis)[2])} if axis else {}
    about = {"failures": [failures[k] for k in sorted(failures)[:MESSAGES]]}
    return _dataset(circuit, steps, data, coords, about)


def _dataset(
    circuit: Circuit,
    steps: Sequence[Step],
    data: Mapping[str, Row],
    coords: Mapping[str, Any],
    about: Mapping[str, Any],
) -> Dataset:
    """A Dataset whose first dimensions are the steps; a variable has its further ones, its values and attributes."""
    from xarray import Dataset

    sizes, units = [len(one.values) for one in steps], {path: p.unit for path, p in circuit.parameters.items()}
    units |= {e.name: "V" if e.device == "V" else "A" for e in circuit.by_device("V", "I")}
    axes = {one.name: (one.name, np.array(one.values), {"units": units.get(one.name, "")}) for one in steps}
    found: dict[str, Any] = {}
    for name, (more, values, attrs) in data.items():
        gaps = [f":{one.name}" for one in circuit.by_device("GAP")] if more == ("gap",) else [""]
        for gap, column in zip(gaps, values.T if more == ("gap",) else [values], strict=True):
            shape = (*sizes, *column.shape[1:])
            found[f"{name}{gap}"] = (*axes, *(() if gap else more)), column.reshape(shape), attrs
    return Dataset(found, {**axes, **coords}, {**about, "title": circuit.title})
