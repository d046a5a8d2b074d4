"""The result of a run: read-only signals with their status, error and provenance."""

from __future__ import annotations

import json
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fingerspice.base.arrays import FloatArray
from fingerspice.base.pages import Page
from fingerspice.results.datafiles import dataset, to_dataframe, write_csv, write_netcdf
from fingerspice.results.doors import Doors
from fingerspice.results.outcome import ErrorEstimate, Failure, State, Status
from fingerspice.results.record import Sealed, sealed
from fingerspice.results.signals import SIGNALS, AnyRecord, Signals
from fingerspice.results.summary import Figured, Figures, KeptFigures

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas
    import xarray

    from fingerspice.circuit.circuit import Circuit
    from fingerspice.results.outcome import Plan
    from fingerspice.results.sensitivity import Sensitivity
    from fingerspice.results.signals import StoredRun
    from fingerspice.results.spectrum import Spectrum
    from fingerspice.results.steps import ClosedForm, Recorded
    from fingerspice.waveforms.waveform import Fundamental


@dataclass(frozen=True, repr=False)
class Solution(Sealed, Doors, Figured):
    """Time response of a circuit.

    Signals are read-only arrays in SI units, computed when they are first asked for. A jump of the source has two rows
    with the same time. Where a circuit has several GAPs, their signals (`u_gap`, `area`, `sigma_el`, `f_el`, `f_t`,
    `friction`) have the shape (n_t, n_gap), in the order of `gaps`. In the same way `u_source`, `q_source` and
    `i_source` have a column for each of several sources, in the order of `sources`.

    Attributes
    ----------
    t : ndarray, shape (n_t,)
        s.
    record : Record or StoredRecord
        Outputs of the run, from which all signals follow.
    status : Status
    failure : Failure or None
        Why, when and where the run failed, and what to change.
    nfev : int
        Evaluations of the right-hand side.
    stats : dict
        Numbers of steps, rejected steps, zeros of the gap voltage and repeated periods; the wall time (s).
    error, rtol : ErrorEstimate, float
        Error stated, and error asked for relative to the peaks.
    charge_law, area_mode, method : str
    plan : Plan
        The model that was run, and the reasons for it.
    circuit, state : Circuit, State
    first, t_stop : float
        TSTART and the end of the run, s.
    start : str
        How the run started, as in `simulate`; ``"given"`` where it went on from another one.
    continuous : Recorded or ClosedForm or StoredRun or None
        The run between its outputs, or the last period of one from a file; None where only its outputs are known.
    fundamental, period : Fundamental or None, float or None
        Fundamental and period (s) of the source; None where it has none.
    fold_margin_min : float
        Smallest distance to the fold in the run's steps.
    sensitivities : mapping of str to Sensitivity
        By the path of each parameter that was asked for.
    stored : mapping or None
        The summary of a run that was read from a file.
    """

    t: FloatArray
    record: AnyRecord
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
    state: State
    fundamental: Fundamental | None = None
    period: float | None = None
    fold_margin_min: float = 1.0
    warnings: tuple[str, ...] = field(default=())
    first: float = 0.0
    t_stop: float = 0.0
    start: str = "deck"
    continuous: Recorded | ClosedForm | StoredRun | None = None
    stored: Mapping[str, Any] | None = None
    sensitivities: Mapping[str, Sensitivity] = field(default_factory=dict)

    def __post_init__(self) -> None:
        sealed(self.t)

    def _page(self) -> Page:
        from fingerspice.results.report import summary_table

        return summary_table(self)

    @cached_property
    def all_signals(self) -> Signals:
        """The signals by name, with the elements to which their columns belong."""
        return Signals(self.record)

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the columns of `u_layer`."""
        return self.record.layers

    @property
    def gaps(self) -> tuple[str, ...]:
        """Names of the GAPs."""
        return self.all_signals.gaps

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the sources of a network; of a series stack there is one, its loop."""
        return self.record.sources

    @property
    def u_source(self) -> FloatArray:
        """Voltage of each source, V; for a series stack the voltage around the loop, shape (n_t,)."""
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
        """Charge delivered by the source since the start, C, shape (n_t,), with the impulses at jumps.

        None where the run was asked to leave it out.
        """
        return self.record.charge

    @property
    def i_source(self) -> FloatArray | None:
        """Current of the source, A, shape (n_t,), without the impulses at jumps, which only `q_source` shows."""
        return self.record.current

    @property
    def fold_margin(self) -> FloatArray:
        """Distance to the fold of the `mobile` law: 1 without stored charge, 0 at the fold; 1 under `local`."""
        return self.record.fold_margin

    @property
    def u_gap(self) -> FloatArray | None:
        """Gap voltage, V, shape (n_t,); None for a circuit without GAP."""
        return self.all_signals.value("u_gap")

    @property
    def sigma_el(self) -> FloatArray | None:
        """Electroadhesive stress (Eq. 2), Pa, shape (n_t,); None for a circuit without GAP."""
        return self.all_signals.value("sigma_el")

    @property
    def f_el(self) -> FloatArray | None:
        """Electroadhesive force, N, shape (n_t,); None for a circuit without GAP.

        Its mean is `f_el_mean`, and over the last period `f_el_mean_periodic`. ``f_el.mean()`` is another figure: it
        gives every output the same weight, including both ends of a period and both rows of a jump, which causes an
        error of some per cent at 50 to 200 outputs per period.
        """
        return self.all_signals.value("f_el")

    @property
    def f_t(self) -> FloatArray | None:
        """Friction force (Eq. 1), N, shape (n_t,); None for a circuit without GAP."""
        return self.all_signals.value("f_t")

    @property
    def friction(self) -> FloatArray | None:
        """Friction coefficient f_t / f_n, shape (n_t,); None for a circuit without GAP."""
        return self.all_signals.value("friction")

    def by_name(self, key: str) -> dict[str, FloatArray]:
        """A signal by its name, or the columns of several elements by ``name:element``.

        Raises
        ------
        InputError
            For a name that no signal has.
        """
        return {name: self.all_signals.one(name) for name in self.all_signals.names(key)}

    @property
    def message(self) -> str:
        """How the run ended, in words."""
        return self.status.cause if self.failure is None else str(self.failure)

    @property
    def success(self) -> bool:
        """Whether the run reached its end with the error met."""
        return self.status is Status.SUCCESS

    @property
    def signals(self) -> dict[str, tuple[FloatArray, str, str]]:
        """Every signal by name, with its values (n_t,), unit and long name."""
        out: dict[str, tuple[FloatArray, str, str]] = {}
        for key, (unit, text) in SIGNALS.items():
            for name, value in self.by_name(key).items():
                element = name.partition(":")[2]
                said = {"u_layer": f"voltage of {element}", "v": f"voltage of node {element}"}.get(key, text)
                out[name] = value, unit, said
        return out

    @cached_property
    def _figures(self) -> Figures | KeptFigures:
        # Of a copy, as two objects that hold each other stay in memory until Python looks for such cycles.
        return Figures(copy(self)) if self.stored is None else KeptFigures(self.all_signals, self.stored)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in vars(self).items() if key not in ("_figures", "all_signals", "_summary")}

    def summary(self) -> dict[str, Any]:
        """Figures of the run: peak, rms, mean, ripple, amplitude and phase at the fundamental; SI units.

        Figures are computed from the run itself, from TSTART to its end, whatever outputs were asked for;
        ``figures_from`` is then ``"steps"``. It is ``"outputs"`` where the run between its outputs is not known,
        because a method does not record it, the run failed, or it is too long: means are then integrals of cubics
        through the outputs, and extremes are those of the outputs. `f_el_mean` is the mean over the whole run, and
        `f_el_mean_periodic` the mean over the last period of the source; figures of a period are None where the run is
        shorter. A circuit without GAP has figures of its layer voltages (``u_layer:Xcoat_max``) instead.
        """
        return dict(self._summary)

    @cached_property
    def _summary(self) -> dict[str, Any]:
        return self._figures.summary()

    def provenance(self) -> dict[str, str]:
        """The data needed to repeat the run, as text."""
        from fingerspice import __version__

        return {
            "program": f"fingerspice {__version__}",
            "title": self.circuit.title,
            "file": str(self.circuit.path or ""),
            "deck": self.circuit.text,
            "overrides": json.dumps(dict(self.circuit.overrides)),
            "sets": json.dumps({n: {path: repr(x) for path, x in s.items()} for n, s in self.circuit.sets.items()}),
            "charge_law": self.charge_law,
            "area": self.area_mode,
            "method": self.method,
            "rtol": repr(self.rtol),
            "error_u_gap_V": repr(self.error.u_gap),
            "error_f_el_N": repr(self.error.f_el),
            "error_q_source_C": repr(self.error.q_source),
            "error_v_nodes_V": repr(self.error.v_nodes),
            "status": self.status.name,
            "message": self.message,
        }

    def to_csv(self, path: str | Path) -> Path:
        """Write every signal as CSV with names and units in the header; a jump has both its rows.

        Raises
        ------
        InputError
            Where the folder cannot be written.
        """
        return write_csv(self, Path(path))

    def to_xarray(self, *, jumps: str = "right") -> xarray.Dataset:
        """The run as an xarray Dataset with units and provenance.

        Signals of several GAPs have the dimension ``gap`` besides ``time``, and those of several sources ``source``;
        layer voltages have ``layer`` and node voltages ``node``.

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

        data, coords = dataset(self, jumps)
        return xarray.Dataset(data, coords=coords, attrs=self.provenance())

    def to_dataframe(self, *, jumps: str = "right") -> pandas.DataFrame:
        """The run as a pandas DataFrame: a row for each time (s, the index), a column for each of `signals`.

        Parameters
        ----------
        jumps : str
            As in `to_xarray`.

        Raises
        ------
        InputError
            For another value of `jumps`.
        """
        return to_dataframe(self, jumps)

    def to_netcdf(self, path: str | Path, *, jumps: str = "right") -> Path:
        """Write `to_xarray` as a NetCDF file, without the cost of loading xarray; `fs.load` reads it back.

        The file also has the circuit, with up to 8 million samples of its sources (64 MB), and the last period between
        the outputs, up to 2 million numbers (16 MB), beyond which a loaded run's lines are those of its outputs.

        Raises
        ------
        InputError
            Where the folder cannot be written, or for another value of `jumps`.
        """
        return write_netcdf(self, Path(path), jumps)

    def spectrum(
        self,
        signal: str = "f_t",
        *,
        method: str = "auto",
        highest: float | None = None,
        resolution: float | None = None,
        since: float | None = None,
    ) -> Spectrum:
        """Spectrum of a signal: lines where the source is periodic, else a density by Welch's method.

        The lines are Fourier integrals over the last period of the source, whatever outputs were asked for; the density
        is that of the outputs, with Hann windows that overlap by half.

        Parameters
        ----------
        signal : str
            A key of `signals`; the friction force by default.
        method : str
            ``"auto"``, ``"lines"`` or ``"welch"``.
        highest : float, optional
            Frequency up to which the spectrum goes, Hz; by default 1000 lines, or half the rate of the outputs.
        resolution : float, optional
            Width of the density's bins, Hz; by default that of 8 segments.
        since : float, optional
            Start of the outputs used for a density, s; the first output by default.

        Raises
        ------
        InputError
            For an unknown signal, a signal of several elements, or a value out of range; for ``"lines"`` of a run
            without a whole period, and for a density of outputs that are too few or not evenly spaced.
        """
        from fingerspice.results.spectrum import spectrum_of

        return spectrum_of(self, signal, method, highest, resolution, since)
