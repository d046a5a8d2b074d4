"""The result of a run: read-only arrays with their status, error and provenance."""

from __future__ import annotations

import cmath
import dataclasses
import json
import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.datafiles import variables, write_csv, write_netcdf
from fingerspice.measures import Weighed, weigh_outputs, weigh_run
from fingerspice.network_record import NetworkRecord
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
    from fingerspice.refined import ClosedForm
    from fingerspice.steps import Recorded

FloatArray = NDArray[np.float64]
# What a polynomial may miss of a signal where figures are taken of it, over its peak.
_SMOOTH = 1e-12
# Signals with what their values weigh, and the range of each.
_Figures = tuple[Weighed, dict[str, tuple[float, float]]]


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
    first, t_stop : float
        TSTART and the end of the run, s.
    continuous : Recorded or ClosedForm or None
        The run between its outputs, where that is known.
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
    first: float = 0.0
    t_stop: float = 0.0
    continuous: Recorded | ClosedForm | None = field(default=None, repr=False)

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
    def f_el_mean(self) -> float | None:
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

        They are those of the run itself, from TSTART to its end, whatever outputs were asked for: ``figures_from`` is
        ``"steps"``. Where the run between its outputs is not known, because another method or a failed run made them or
        because it is too long, it is ``"outputs"``: means are integrals of cubics through the outputs then, and
        extremes those of the outputs. `f_el_mean` is over the whole run, `f_el_mean_periodic` over the last period of
        the source; the entries of a period are None where the run holds none. A circuit without GAP has its layer
        voltages (``u_layer:Xcoat_max``) in place of gap voltage and forces.
        """
        return dict(self._summary)

    @cached_property
    def _summary(self) -> dict[str, Any]:
        out: dict[str, Any] = {
            "t_stop": float(self.t[-1]) if self.t.size else None,
            "status": self.status.name,
        }
        out.update({f"error_{k}": v for k, v in vars(self.error).items()})
        whole = self._measured(self.first, self.t_stop)
        if whole is None and self.t.size < 2:
            return out
        out["figures_from"] = "outputs" if whole is None else "steps"
        values, ranges = whole or self._of_outputs(0)
        last = self._last_period()
        for key, (low, high) in ranges.items():
            out[f"{key}_max"], out[f"{key}_min"], out[f"{key}_peak"] = high, low, max(high, -low)
            out[f"{key}_mean"], out[f"{key}_rms"] = values.mean(key), math.sqrt(values.mean(key, 2))
            out[f"{key}_mean_periodic"] = None if last is None else last[0].mean(key)
            if last is not None and key.partition(":")[0] in ("area", "f_el", "f_t", "friction"):
                out[f"{key}_ripple"] = last[1][key][1] - last[1][key][0]
            elif last is not None:
                out[f"{key}_rms_periodic"] = math.sqrt(last[0].mean(key, 2))
        if last is not None and self.fundamental is not None:
            for key in ("u_source", "u_gap"):
                if key in last[1]:
                    p = last[0].phasor(key, self.fundamental.frequency)
                    out[f"{key}_amplitude"], out[f"{key}_phase_deg"] = abs(p), math.degrees(cmath.phase(p))
            out["fundamental"] = self.fundamental.frequency
        if self.f_el is not None:
            out["fold_margin_min"] = min(self.fold_margin_min, float(self.fold_margin.min(initial=1.0)))
        return out

    def _measured(self, since: float, until: float) -> _Figures | None:
        """Figures between two times (s) from the run between its outputs; None where that is not known."""
        run = None if self.continuous is None else self.continuous.run(self._read, since, until)
        return None if run is None else weigh_run(run, self._read, since, until, _SMOOTH)

    def _read(self, record: Record | NetworkRecord) -> dict[str, FloatArray]:
        """The signals that figures are taken of, from other outputs of this run."""
        return dataclasses.replace(self, t=record.t, record=record)._summarised()

    def _of_outputs(self, first: int) -> _Figures:
        """Figures of the outputs from number `first` on."""
        t, signals = self.t[first:], {name: x[first:] for name, x in self._summarised().items()}
        ranges = {name: (float(x.min()), float(x.max())) for name, x in signals.items()}
        return weigh_outputs(t, signals), ranges

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

    def _last_period(self) -> _Figures | None:
        """Figures of the last period of the source; None where the run holds none."""
        if self.period is None or not self.t.size:
            return None
        tolerance = 1e-9 * self.period
        if self.continuous is not None and self.t_stop - self.period >= self.first - tolerance:
            found = self._measured(max(self.t_stop - self.period, self.first), self.t_stop)
            if found is not None:
                return found
        start = self.t[-1] - self.period
        if start < self.t[0] - tolerance or np.count_nonzero(self.t >= start) < 8:
            return None
        first = int(np.searchsorted(self.t, start - tolerance, side="right"))
        if abs(self.t[first] - start) <= tolerance:
            # At a jump the period starts with the right-hand value.
            return self._of_outputs(int(np.searchsorted(self.t, start + tolerance, side="right")) - 1)
        t, signals = self.t[first:], self._summarised()
        cut = {name: np.append(np.interp(start, self.t, x), x[first:]) for name, x in signals.items()}
        ranges = {name: (float(x.min()), float(x.max())) for name, x in cut.items()}
        return weigh_outputs(np.append(start, t), cut), ranges

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
        return write_csv(self, Path(path))

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

        data, coords = variables(self, jumps)
        return xarray.Dataset(data, coords=coords, attrs=self.provenance())

    def to_netcdf(self, path: str | Path, *, jumps: str = "right") -> Path:
        """Write `to_xarray` as a NetCDF file, without the cost of loading xarray.

        Raises
        ------
        InputError
            Where the folder cannot be written, or for another value of `jumps`.
        """
        return write_netcdf(self, Path(path), jumps)

    def plot(self) -> Figure:
        """Source and gap voltage, force and area against time."""
        from fingerspice.plotting import plot_solution

        return plot_solution(self)
