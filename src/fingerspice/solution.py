"""The result of a run: read-only arrays with their status, error and provenance."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.files import write_aside
from fingerspice.network_record import NetworkRecord
from fingerspice.numerics.cubics import fundamental, mean
from fingerspice.outcome import ErrorEstimate, Failure, NetworkState, State, Status
from fingerspice.record import Record, Sealed, sealed

if TYPE_CHECKING:
    from collections.abc import Callable

    import xarray
    from matplotlib.figure import Figure

    from fingerspice.circuit.circuit import Circuit
    from fingerspice.circuit.waveforms import Fundamental
    from fingerspice.physics.contact import Contact
    from fingerspice.planning import Plan

FloatArray = NDArray[np.float64]
# Dimensions, values, attributes: what both xarray and NetCDF take.
_Variable = tuple[tuple[str, ...], NDArray[Any], dict[str, str]]


@dataclass(frozen=True)
class Solution(Sealed):
    """Time response of a circuit.

    Signals are read-only arrays in SI units, computed when first asked for; at a jump of the source two rows share a
    time. Where a circuit has several GAPs, what belongs to them (`u_gap`, `area`, `sigma_el`, `f_el`, `f_t`,
    `friction`) has the shape (n_t, n_gap), in the order of `gaps`; likewise `u_source`, `q_source` and `i_source` with
    several sources of a network, in the order of `sources`.

    Attributes
    ----------
    t : ndarray, shape (n_t,)
        s.
    record : Record or NetworkRecord
        What the run wrote down.
    status : Status
    failure : Failure or None
        Why, when and where the run failed, and what to do.
    nfev : int
        Evaluations of the right-hand side.
    stats : dict
        Steps, rejections, zeros met, method, wall time.
    error : ErrorEstimate
    rtol : float
        Error asked for, relative to the peaks.
    charge_law, area_mode, method : str
    plan : Plan
        Which model was run, and why.
    circuit : Circuit
    state : State
    """

    t: FloatArray
    record: Record | NetworkRecord
    status: Status
    failure: Failure | None
    nfev: int
    stats: dict[str, Any]
    error: ErrorEstimate
    rtol: float
    charge_law: str
    area_mode: str
    method: str
    plan: Plan
    circuit: Circuit
    state: State | NetworkState
    fundamental: Fundamental | None = None
    period: float | None = None
    fold_margin_min: float = 1.0
    warnings: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        sealed(self.t)

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the columns of `u_layer`."""
        return self.record.layers

    @property
    def gaps(self) -> tuple[str, ...]:
        """Names of the GAPs."""
        return tuple(name for name, _ in self.record.fingers)

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the sources of a network; a series stack has one loop."""
        return self.record.sources

    @property
    def u_source(self) -> FloatArray:
        """Voltage around the loop, V, shape (n_t,)."""
        return self.record.u_source

    @property
    def u_layer(self) -> FloatArray:
        """Voltage of each layer from its p to its n node, V, shape (n_t, n_layer)."""
        return self.record.u_layer

    @property
    def node_voltages(self) -> dict[str, FloatArray]:
        """Node name to its voltage, V, shape (n_t,)."""
        return self.record.node_voltages

    @property
    def area(self) -> FloatArray | None:
        """Ridge contact area, m^2, shape (n_t,); None for a circuit without any."""
        return self.record.area

    @property
    def q_source(self) -> FloatArray | None:
        """Charge delivered by the source since the start, C, shape (n_t,); a jump adds its integral of A dD.

        None where the run was asked to leave it out.
        """
        return self.record.charge

    @property
    def i_source(self) -> FloatArray | None:
        """Regular part of the source's current, A, shape (n_t,); a jump is an impulse, seen in `q_source` only."""
        return self.record.current

    @property
    def fold_margin(self) -> FloatArray:
        """Distance to the fold of the `mobile` law: 1 without stored charge, 0 at the fold; 1 under `local`."""
        return self.record.fold_margin

    @property
    def u_gap(self) -> FloatArray | None:
        """Gap voltage, V, shape (n_t,); None for a circuit without GAP."""
        return self.record.u_gap if self.gaps else None

    @cached_property
    def sigma_el(self) -> FloatArray | None:
        """Electroadhesive stress (Eq. 2), Pa, shape (n_t,); None for a circuit without GAP."""
        return self._per_gap(self.u_gap, lambda contact, u: contact.stress(u))

    @property
    def f_el(self) -> FloatArray | None:
        """Electroadhesive force, N, shape (n_t,); None for a circuit without GAP."""
        return self.record.force if self.gaps else None

    @cached_property
    def f_t(self) -> FloatArray | None:
        """Friction force (Eq. 1), N, shape (n_t,); None for a circuit without GAP."""
        return self._per_gap(self.f_el, lambda contact, f: contact.mu * (contact.f_n + f))

    @cached_property
    def friction(self) -> FloatArray | None:
        """Friction coefficient f_t / f_n, shape (n_t,); None for a circuit without GAP."""
        return self._per_gap(self.f_t, lambda contact, f: f / contact.f_n)

    def _per_gap(self, x: FloatArray | None, make: Callable[[Contact, FloatArray], FloatArray]) -> FloatArray | None:
        """Another signal of every gap from one of them."""
        if x is None:
            return None
        contacts = [contact for _, contact in self.record.fingers]
        if len(contacts) == 1:
            return sealed(make(contacts[0], x))
        return sealed(np.column_stack([make(contact, x[:, i]) for i, contact in enumerate(contacts)]))

    def by_name(self, key: str) -> dict[str, FloatArray]:
        """A signal under its name, or the columns of several gaps or sources under ``name:element``."""
        value = getattr(self, key)
        if value is None:
            return {}
        if value.ndim == 1:
            return {key: value}
        names = self.sources if key.endswith("_source") else self.gaps
        return {f"{key}:{name}": value[:, i] for i, name in enumerate(names)}

    @property
    def message(self) -> str:
        """How the run ended, in words."""
        return self.status.cause if self.failure is None else str(self.failure)

    @property
    def success(self) -> bool:
        """Whether the run reached its end with the error met."""
        return self.status is Status.SUCCESS

    @property
    def f_elmean(self) -> float | None:
        """Mean electroadhesive force over the run, N; None without a GAP."""
        return self.summary().get("f_el_mean")

    @property
    def f_el_mean_periodic(self) -> float | None:
        """Mean electroadhesive force over the source's last period, N; None where the run holds none."""
        return self.summary().get("f_el_mean_periodic")

    @property
    def signals(self) -> dict[str, tuple[FloatArray, str, str]]:
        """Every time series by name: values (n_t,), unit, long name."""
        out: dict[str, tuple[FloatArray, str, str]] = {
            name: (value, "V", "source voltage") for name, value in self.by_name("u_source").items()
        }
        for i, name in enumerate(self.layers):
            out[f"u_layer:{name}"] = (self.u_layer[:, i], "V", f"voltage of {name}")
        for key, unit, text in (
            ("u_gap", "V", "gap voltage"),
            ("area", "m^2", "ridge contact area"),
            ("sigma_el", "Pa", "electroadhesive stress"),
            ("f_el", "N", "electroadhesive force"),
            ("f_t", "N", "friction force"),
            ("friction", "1", "friction coefficient f_t / f_n"),
            ("q_source", "C", "charge delivered by the source"),
            ("i_source", "A", "source current, regular part"),
            ("fold_margin", "1", "distance to the fold of the mobile law"),
        ):
            out.update({name: (value, unit, text) for name, value in self.by_name(key).items()})
        for name, value in self.node_voltages.items():
            out[f"v:{name}"] = (value, "V", f"voltage of node {name}")
        return out

    def summary(self) -> dict[str, Any]:
        """Figures of the run: peak, rms, mean, ripple, amplitude and phase at the fundamental; SI units.

        Means are integrals of cubics through the outputs. `f_el_mean` is over the whole run, `f_el_mean_periodic` over
        the last period of the source; the entries of a period are None where the run holds none. A circuit without
        GAP has its layer voltages (``u_layer:Xcoat_max``) in place of gap voltage and forces.
        """
        out: dict[str, Any] = {
            "t_stop": float(self.t[-1]) if self.t.size else None,
            "status": self.status.name,
        }
        out.update({f"error_{k}": v for k, v in vars(self.error).items()})
        if self.t.size < 2:
            return out
        last = self._last_period()
        for key, x in self._summarised().items():
            out[f"{key}_max"] = float(x.max())
            out[f"{key}_min"] = float(x.min())
            out[f"{key}_peak"] = float(np.abs(x).max())
            out[f"{key}_mean"] = mean(self.t, x)
            out[f"{key}_rms"] = float(np.sqrt(mean(self.t, x**2)))
            out[f"{key}_mean_periodic"] = None
            if last is not None:
                periodic = mean(last[0], last[1][key])
                out[f"{key}_mean_periodic"] = periodic
                if key.partition(":")[0] in ("area", "f_el", "f_t", "friction"):
                    out[f"{key}_ripple"] = float(np.ptp(last[1][key]))
                else:
                    out[f"{key}_rms_periodic"] = float(np.sqrt(mean(last[0], last[1][key] ** 2)))
        if last is not None and self.fundamental is not None:
            f0 = self.fundamental
            for key in ("u_source", "u_gap"):
                if key in last[1]:
                    p = fundamental(last[0], last[1][key], f0.frequency)
                    out[f"{key}_amplitude"] = abs(p)
                    out[f"{key}_phase_deg"] = float(np.degrees(np.angle(p)))
            out["fundamental"] = f0.frequency
        if self.f_el is not None:
            out["fold_margin_min"] = min(self.fold_margin_min, float(self.fold_margin.min()))
        return out

    def _summarised(self) -> dict[str, FloatArray]:
        """What the summary gives figures of; without a gap, every layer."""
        if self.u_gap is not None:
            shown = ("u_source", "u_gap", "area", "f_el", "f_t", "friction")
            return {name: x for key in shown for name, x in self.by_name(key).items()}
        # Without layers either, what there is to see are the nodes.
        inside = {f"u_layer:{name}": self.u_layer[:, i] for i, name in enumerate(self.layers)} or {
            f"v:{name}": v for name, v in self.node_voltages.items()
        }
        return {**self.by_name("u_source"), **inside, **self.by_name("area")}

    def _last_period(self) -> tuple[FloatArray, dict[str, FloatArray]] | None:
        """Times and signals of the last period, with an interpolated first point; None where there is none."""
        if self.period is None:
            return None
        start = self.t[-1] - self.period
        tolerance = 1e-9 * self.period
        if start < self.t[0] - tolerance or np.count_nonzero(self.t >= start) < 8:
            return None
        first = int(np.searchsorted(self.t, start - tolerance, side="right"))
        exact = abs(self.t[first] - start) <= tolerance
        if exact:
            # At a jump the period starts with the right-hand value.
            first = int(np.searchsorted(self.t, start + tolerance, side="right")) - 1
        signals = {}
        for key, x in self._summarised().items():
            head = [] if exact else [np.interp(start, self.t, x)]
            signals[key] = np.concatenate([head, x[first:]])
        return np.concatenate([[] if exact else [start], self.t[first:]]), signals

    def provenance(self) -> dict[str, str]:
        """What it takes to repeat the run, as text."""
        from fingerspice import __version__

        return {
            "program": f"fingerspice {__version__}",
            "title": self.circuit.title,
            "deck": self.circuit.text,
            "overrides": json.dumps(dict(self.circuit.overrides)),
            "charge_law": self.charge_law,
            "area": self.area_mode,
            "method": self.method,
            "rtol": repr(self.rtol),
            "error_u_gap_V": repr(self.error.u_gap),
            "error_f_el_N": repr(self.error.f_el),
            "error_q_source_C": repr(self.error.q_source),
            "status": self.status.name,
            "message": self.message,
        }

    def to_csv(self, path: str | Path) -> Path:
        """Write every signal as CSV, names and units in the header; both rows of a jump are kept.

        Raises
        ------
        InputError
            Where the folder cannot be written.
        """
        signals = self.signals
        header = ["t [s]", *(f"{name} [{unit}]" for name, (_, unit, _) in signals.items())]
        table = np.column_stack([self.t, *(value for value, _, _ in signals.values())])

        def write(target: Path) -> None:
            with target.open("w", newline="", encoding="utf-8") as stream:
                writer = csv.writer(stream)
                writer.writerow(header)
                writer.writerows([repr(float(x)) for x in row] for row in table)

        return write_aside(Path(path), write)

    def _dataset(self, jumps: str) -> tuple[dict[str, _Variable], dict[str, _Variable]]:
        """Variables and coordinates of the data files, as (dimensions, values, attributes)."""
        from fingerspice.circuit.waveforms import require

        require(jumps in ("right", "both"), "jumps", repr(jumps), "'right' or 'both'")
        keep = np.ones(self.t.size, bool)
        if jumps == "right" and self.t.size:
            keep[:-1] = np.diff(self.t) > 0.0
        data: dict[str, _Variable] = {
            name: (("time",), value[keep], {"units": unit, "long_name": text})
            for name, (value, unit, text) in self.signals.items()
            if not name.startswith(("u_layer:", "v:"))
        }
        data["u_layer"] = (("time", "layer"), self.u_layer[keep], {"units": "V", "long_name": "layer voltage"})
        nodes = np.column_stack(list(self.node_voltages.values()))[keep]
        data["v"] = (("time", "node"), nodes, {"units": "V", "long_name": "node voltage"})
        coords: dict[str, _Variable] = {
            "time": (("time",), self.t[keep], {"units": "s", "long_name": "time"}),
            "layer": (("layer",), np.array(self.layers, dtype=object), {}),
            "node": (("node",), np.array(list(self.node_voltages), dtype=object), {}),
        }
        return data, coords

    def to_xarray(self, *, jumps: str = "right") -> xarray.Dataset:
        """The run as an xarray Dataset with units and provenance.

        Parameters
        ----------
        jumps : str
            ``"right"``: times are unique, with the right-hand value at a jump; ``"both"``: as in the arrays.

        Raises
        ------
        InputError
            For another value of `jumps`.
        """
        import xarray

        data, coords = self._dataset(jumps)
        return xarray.Dataset(data, coords=coords, attrs=self.provenance())

    def to_netcdf(self, path: str | Path, *, jumps: str = "right") -> Path:
        """Write `to_xarray` as a NetCDF file, without the cost of loading xarray.

        Raises
        ------
        InputError
            Where the folder cannot be written, or for another value of `jumps`.
        """
        import h5netcdf
        import h5py

        data, coords = self._dataset(jumps)

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
                for key, text in self.provenance().items():
                    file.attrs[key] = text
            target.write_bytes(content.getbuffer())

        return write_aside(Path(path), write)

    def plot(self) -> Figure:
        """Source and gap voltage, force and area against time."""
        from fingerspice.plotting import plot_solution

        return plot_solution(self)
