"""Response to sines of given amplitude from the transient's periodic state, with the area coupled at every instant.

It gives the figures of a phasor solution without the approximation of a constant area.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, positive_row
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.arguments import require_circuit
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.response import LinearScene, linear_scene
from fingerspice.circuit.usual import beyond_fingers
from fingerspice.results.measures import weigh_outputs
from fingerspice.results.phasor_solution import PhasorSolution
from fingerspice.solve.runs import Progress
from fingerspice.studies.steady import steady_state
from fingerspice.studies.sweeps import Drive, sweep_drive, sweep_notes
from fingerspice.waveforms.waveform import Sine, Waveform

# Number of outputs in a period; cubics through them interpolate a sine with an error of 1e-9 of its amplitude.
POINTS = 400


def large_signal(
    circuit: Circuit,
    frequency: ArrayLike,
    amplitude: ArrayLike | None = None,
    *,
    charge_law: str | None = None,
    rtol: float = 1e-8,
    finger: str | None = None,
    progress: Progress | None = None,
) -> tuple[PhasorSolution, ...]:
    """Periodic states under sines, for each frequency and amplitude; SKIN is evaluated at each frequency.

    Parameters
    ----------
    circuit : Circuit
        A circuit with a GAP and one source.
    frequency : array_like
        Hz, positive.
    amplitude : array_like, optional
        V (A for a current source), positive; by default the amplitude of the source's ``AC``, or without AC that of its
        fundamental.
    charge_law, rtol, progress
        As in `simulate`.
    finger : str, optional
        Name of the GAP whose figures are wanted; needed if the circuit has several.

    Returns
    -------
    tuple of PhasorSolution
        One per amplitude. Gains are those of the fundamental; area and force are means over the period.

    Raises
    ------
    InputError
        If the circuit has no GAP or several sources, if none of several GAPs is named, or if a frequency or amplitude
        is not positive.
    SolveError
        If there is no periodic state.
    """
    require_circuit(circuit)
    scene = linear_scene(circuit, finger)
    if len(scene.sources) != 1:
        names = ", ".join(e.name for e, _ in scene.sources)
        raise InputError(f"a large-signal sweep drives one source, and this circuit has {names}")
    own = sweep_drive(scene.sources, scene.fundamental, swept=True)
    if amplitude is None and math.isnan(own.amplitude):
        raise InputError("the source has no fundamental to take the amplitude of: give the amplitudes in V")
    given = positive_row("amplitude", own.amplitude if amplitude is None else amplitude, "V")
    f = positive_row("frequency", frequency, "Hz")
    for text in sweep_notes(circuit, f)[1]:
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    drives = [own] if amplitude is None else [Drive(float(a), 0.0, "the amplitude given") for a in given]
    found = itertools.count(1)

    def one() -> None:
        if progress is not None:
            progress(next(found) / (f.size * len(drives)))

    return tuple(_sweep(circuit, scene, f, drive, charge_law, rtol, one) for drive in drives)


def _sweep(
    circuit: Circuit, scene: LinearScene, frequency: FloatArray, drive: Drive, charge_law: str | None, rtol: float,
    one: Callable[[], None],
) -> PhasorSolution:  # fmt: skip
    (source, sign), *_ = scene.sources
    name = scene.layers[scene.gap]
    skins = [e.name for e in circuit.by_device("SKIN")]
    gains, areas, forces, amplitude = [], [], [], drive.amplitude
    for f in frequency:
        changes: dict[str, float | Waveform] = {f"{name}.f": float(f) for name in skins}
        changes[source.name] = Sine(amplitude, float(f))
        state = steady_state(
            circuit.varied(changes), charge_law=charge_law, rtol=rtol, points=POINTS, charge=False
        )  # fmt: skip
        s = state.solution
        # The output starts at a multiple of the period, so that phases from its start are phases relative to the
        # source.
        period = s.t - s.t[0]
        area, force = (s.by_name(key)[key if len(s.gaps) == 1 else f"{key}:{name}"] for key in ("area", "f_el"))
        gains.append([weigh_outputs(period, u).phasor(float(f)) * sign / amplitude for u in s.u_layer.T])
        areas.append(weigh_outputs(period, area).mean())
        forces.append(weigh_outputs(period, force).mean())
        one()
    gain = np.array(gains, np.complex128)
    u_gap = gain[:, scene.gap] * amplitude * np.exp(1j * drive.phase)
    notes, warned = sweep_notes(circuit, frequency)
    notes = (*notes, scene.note) if scene.note else notes
    largest = max(forces), float(scene.contact.stress(np.abs(u_gap)).max()), max(areas)
    return PhasorSolution(
        frequency, gain[:, scene.gap], gain, u_gap, np.array(areas), np.array(forces), amplitude, s.layers, drive.phase,
        drive.text, notes, (*warned, *beyond_fingers("", *largest)), circuit,
    )  # fmt: skip
