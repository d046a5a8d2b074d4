"""fingerspice: SPICE for the sliding fingertip.

    import fingerspice as fs
    circuit = fs.read_netlist("circuits/fingerpad.cir")
    solution = fs.simulate(circuit)
    solution.plot()

Each name is loaded when it is first used, so that importing the package takes next to no time.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from fingerspice import torch as torch
    from fingerspice.base.errors import FingerspiceError as FingerspiceError
    from fingerspice.base.errors import FingerspiceWarning as FingerspiceWarning
    from fingerspice.base.errors import InputError as InputError
    from fingerspice.circuit.circuit import Circuit as Circuit
    from fingerspice.explorer.server import Explorer as Explorer
    from fingerspice.explorer.server import explore as explore
    from fingerspice.netlist.netlist import parse_netlist as parse_netlist
    from fingerspice.netlist.netlist import read_netlist as read_netlist
    from fingerspice.results.outcome import Plan as Plan
    from fingerspice.results.outcome import SolveError as SolveError
    from fingerspice.results.outcome import Status as Status
    from fingerspice.results.runfile import load as load
    from fingerspice.results.solution import Solution as Solution
    from fingerspice.sets.parameters import Citation as Citation
    from fingerspice.sets.parameters import ParameterSet as ParameterSet
    from fingerspice.sets.parameters import parameters as parameters
    from fingerspice.solve.simulation import plan as plan
    from fingerspice.solve.simulation import simulate as simulate
    from fingerspice.solve.streaming import stream as stream
    from fingerspice.studies.batch.batch import batch as batch
    from fingerspice.studies.comparison import Comparison as Comparison
    from fingerspice.studies.comparison import compare as compare
    from fingerspice.studies.comparison import large_signal as large_signal
    from fingerspice.studies.export import export_netlist as export_netlist
    from fingerspice.studies.feel import Feel as Feel
    from fingerspice.studies.feel import feel as feel
    from fingerspice.studies.fit.circuitfit import Fit as Fit
    from fingerspice.studies.fit.circuitfit import fit as fit
    from fingerspice.studies.fit.contactfit import ContactFit as ContactFit
    from fingerspice.studies.fit.contactfit import fit_contact as fit_contact
    from fingerspice.studies.fit.materialfit import ColeCole as ColeCole
    from fingerspice.studies.fit.materialfit import MaterialFit as MaterialFit
    from fingerspice.studies.fit.materialfit import fit_material as fit_material
    from fingerspice.studies.inverse import InverseDrive as InverseDrive
    from fingerspice.studies.inverse import inverse_drive as inverse_drive
    from fingerspice.studies.limits import Capability as Capability
    from fingerspice.studies.limits import FoldLimits as FoldLimits
    from fingerspice.studies.limits import capability as capability
    from fingerspice.studies.limits import fold_limits as fold_limits
    from fingerspice.studies.steady import SteadyState as SteadyState
    from fingerspice.studies.steady import phasor as phasor
    from fingerspice.studies.steady import steady_state as steady_state
    from fingerspice.studies.sweep.populations import sobol as sobol
    from fingerspice.studies.sweep.populations import sweep as sweep
    from fingerspice.waveforms.combinations import AM as AM
    from fingerspice.waveforms.combinations import Burst as Burst
    from fingerspice.waveforms.combinations import Product as Product
    from fingerspice.waveforms.combinations import Repeat as Repeat
    from fingerspice.waveforms.combinations import Sum as Sum
    from fingerspice.waveforms.periodic import PWL as PWL
    from fingerspice.waveforms.periodic import Chirp as Chirp
    from fingerspice.waveforms.periodic import Exp as Exp
    from fingerspice.waveforms.periodic import Pulse as Pulse
    from fingerspice.waveforms.periodic import Sawtooth as Sawtooth
    from fingerspice.waveforms.periodic import Square as Square
    from fingerspice.waveforms.periodic import Triangle as Triangle
    from fingerspice.waveforms.samples import Samples as Samples
    from fingerspice.waveforms.sampling import Function as Function
    from fingerspice.waveforms.waveform import DC as DC
    from fingerspice.waveforms.waveform import Sine as Sine
    from fingerspice.waveforms.waveform import Waveform as Waveform

_HOMES = {
    "circuit.circuit": ("Circuit",),
    "netlist.netlist": ("parse_netlist", "read_netlist"),
    "waveforms.periodic": ("Chirp", "Exp", "Pulse", "Sawtooth", "Square", "Triangle", "PWL"),
    "waveforms.samples": ("Samples",),
    "waveforms.sampling": ("Function",),
    "waveforms.combinations": ("AM", "Burst", "Product", "Repeat", "Sum"),
    "waveforms.waveform": ("DC", "Sine", "Waveform"),
    "studies.batch.batch": ("batch",),
    "studies.inverse": ("InverseDrive", "inverse_drive"),
    "studies.comparison": ("Comparison", "compare", "large_signal"),
    "base.errors": ("FingerspiceError", "FingerspiceWarning", "InputError"),
    "explorer.server": ("Explorer", "explore"),
    "studies.fit.contactfit": ("ContactFit", "fit_contact"),
    "studies.export": ("export_netlist",),
    "studies.feel": ("Feel", "feel"),
    "studies.fit.circuitfit": ("Fit", "fit"),
    "studies.fit.materialfit": ("ColeCole", "MaterialFit", "fit_material"),
    "studies.steady": ("phasor", "SteadyState", "steady_state"),
    "studies.limits": ("Capability", "capability", "FoldLimits", "fold_limits"),
    "studies.sweep.populations": ("sobol", "sweep"),
    "results.runfile": ("load",),
    "results.outcome": ("Plan", "SolveError", "Status"),
    "sets.parameters": ("Citation", "ParameterSet", "parameters"),
    "solve.simulation": ("plan", "simulate"),
    "solve.streaming": ("stream",),
    "results.solution": ("Solution",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}
__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    if name == "torch":
        # Not among the names of the package, which all load without torch.
        return import_module("fingerspice.torch")
    if name not in _HOME:
        raise AttributeError(f"module 'fingerspice' has no attribute {name!r}")
    value = getattr(import_module(f"fingerspice.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
