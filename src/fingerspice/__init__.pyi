from typing import TYPE_CHECKING

__version__: str

# In this way mypy comes to these last, as they import this module in turn.
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
    from fingerspice.sets import Citation as Citation
    from fingerspice.sets import ParameterSet as ParameterSet
    from fingerspice.sets import parameters as parameters
    from fingerspice.solve.simulation import plan as plan
    from fingerspice.solve.simulation import simulate as simulate
    from fingerspice.solve.streaming import stream as stream
    from fingerspice.studies.batch.batch import batch as batch
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
    from fingerspice.studies.steady import Comparison as Comparison
    from fingerspice.studies.steady import SteadyState as SteadyState
    from fingerspice.studies.steady import compare as compare
    from fingerspice.studies.steady import large_signal as large_signal
    from fingerspice.studies.steady import phasor as phasor
    from fingerspice.studies.steady import steady_state as steady_state
    from fingerspice.studies.sweep.populations import sobol as sobol
    from fingerspice.studies.sweep.populations import sweep as sweep
    from fingerspice.waveforms.periodic import PWL as PWL
    from fingerspice.waveforms.periodic import Burst as Burst
    from fingerspice.waveforms.periodic import Pulse as Pulse
    from fingerspice.waveforms.periodic import Repeat as Repeat
    from fingerspice.waveforms.periodic import Sawtooth as Sawtooth
    from fingerspice.waveforms.periodic import Square as Square
    from fingerspice.waveforms.periodic import Triangle as Triangle
    from fingerspice.waveforms.samples import Samples as Samples
    from fingerspice.waveforms.sampling import Function as Function
    from fingerspice.waveforms.waveform import AM as AM
    from fingerspice.waveforms.waveform import DC as DC
    from fingerspice.waveforms.waveform import Chirp as Chirp
    from fingerspice.waveforms.waveform import Exp as Exp
    from fingerspice.waveforms.waveform import Product as Product
    from fingerspice.waveforms.waveform import Sine as Sine
    from fingerspice.waveforms.waveform import Sum as Sum
    from fingerspice.waveforms.waveform import Waveform as Waveform
