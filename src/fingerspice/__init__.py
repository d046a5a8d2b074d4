"""fingerspice: SPICE for the sliding fingertip.

    import fingerspice as fs
    circuit = fs.read_netlist("circuits/fingerpad.cir")
    solution = fs.simulate(circuit)
    solution.plot()

Names are loaded on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit as Circuit
    from fingerspice.circuit.combinations import AM as AM
    from fingerspice.circuit.combinations import Product as Product
    from fingerspice.circuit.combinations import Sum as Sum
    from fingerspice.circuit.netlist import parse_netlist as parse_netlist
    from fingerspice.circuit.netlist import read_netlist as read_netlist
    from fingerspice.circuit.ramps import PWL as PWL
    from fingerspice.circuit.ramps import Pulse as Pulse
    from fingerspice.circuit.ramps import Samples as Samples
    from fingerspice.circuit.ramps import Sawtooth as Sawtooth
    from fingerspice.circuit.ramps import Square as Square
    from fingerspice.circuit.ramps import Triangle as Triangle
    from fingerspice.circuit.sampling import Function as Function
    from fingerspice.circuit.waveforms import DC as DC
    from fingerspice.circuit.waveforms import Chirp as Chirp
    from fingerspice.circuit.waveforms import Exp as Exp
    from fingerspice.circuit.waveforms import Sine as Sine
    from fingerspice.circuit.waveforms import Waveform as Waveform
    from fingerspice.comparison import Comparison as Comparison
    from fingerspice.comparison import compare as compare
    from fingerspice.errors import FingerspiceError as FingerspiceError
    from fingerspice.errors import FingerspiceWarning as FingerspiceWarning
    from fingerspice.errors import InputError as InputError
    from fingerspice.errors import SolveError as SolveError
    from fingerspice.export import export_netlist as export_netlist
    from fingerspice.fitting import ColeCole as ColeCole
    from fingerspice.fitting import MaterialFit as MaterialFit
    from fingerspice.fitting import fit_material as fit_material
    from fingerspice.largesignal import large_signal as large_signal
    from fingerspice.limits import FoldLimits as FoldLimits
    from fingerspice.limits import fold_limits as fold_limits
    from fingerspice.loading import load as load
    from fingerspice.outcome import Status as Status
    from fingerspice.phasors import phasor as phasor
    from fingerspice.planning import Plan as Plan
    from fingerspice.simulation import plan as plan
    from fingerspice.simulation import simulate as simulate
    from fingerspice.solution import Solution as Solution
    from fingerspice.steady import SteadyState as SteadyState
    from fingerspice.steady import steady_state as steady_state

_HOMES = {
    "circuit.circuit": ("Circuit",),
    "circuit.netlist": ("parse_netlist", "read_netlist"),
    "circuit.ramps": ("PWL", "Pulse", "Samples", "Sawtooth", "Square", "Triangle"),
    "circuit.sampling": ("Function",),
    "circuit.combinations": ("AM", "Product", "Sum"),
    "circuit.waveforms": ("DC", "Chirp", "Exp", "Sine", "Waveform"),
    "comparison": ("Comparison", "compare"),
    "errors": ("FingerspiceError", "FingerspiceWarning", "InputError", "SolveError"),
    "export": ("export_netlist",),
    "fitting": ("ColeCole", "MaterialFit", "fit_material"),
    "largesignal": ("large_signal",),
    "limits": ("FoldLimits", "fold_limits"),
    "loading": ("load",),
    "phasors": ("phasor",),
    "planning": ("Plan",),
    "simulation": ("plan", "simulate"),
    "outcome": ("Status",),
    "solution": ("Solution",),
    "steady": ("SteadyState", "steady_state"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}
__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'fingerspice' has no attribute {name!r}")
    value = getattr(import_module(f"fingerspice.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
