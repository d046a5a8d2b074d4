"""Phasors of a circuit: gain, gap voltage, area and mean force against frequency (Eqs. 9 to 15)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.circuit.circuit import AcSweep, Circuit
from fingerspice.circuit.network import Network, build_network
from fingerspice.circuit.statespace import Stack, build_stack, is_stack
from fingerspice.circuit.waveforms import Fundamental, require
from fingerspice.errors import InputError
from fingerspice.physics.phasor import coupled_area, layer_gains

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class PhasorSolution:
    """Phasors against frequency; arrays of shape (n_frequency,).

    Attributes
    ----------
    frequency : ndarray
        Hz.
    gain : ndarray of complex
        u_gap / source: modulus is Eq. 11, angle Eq. 13 (V/A for a current source).
    layer_gain : ndarray of complex, shape (n_frequency, n_layer)
        The same for every layer.
    u_gap : ndarray of complex
        Gap voltage amplitude, V (NaN for a source without fundamental).
    area : ndarray
        Ridge contact area, m^2.
    f_el_mean : ndarray
        Mean electroadhesive force, N.
    amplitude : float
        Source amplitude, V.
    layers : tuple of str
    """

    frequency: FloatArray
    gain: ComplexArray
    layer_gain: ComplexArray
    u_gap: ComplexArray
    area: FloatArray
    f_el_mean: FloatArray
    amplitude: float
    layers: tuple[str, ...]


def mean_area(stack: Stack, frequency: float, amplitude: float) -> float:
    """Area of the coupled phasor at one frequency (Hz) and source amplitude (V), m^2."""
    contact, gap = stack.contact, stack.gap_layer
    assert contact is not None
    assert gap is not None
    f = np.array([frequency])

    def gain(area: float) -> float:
        return float(np.abs(layer_gains(stack.admittance(f, np.array([area])))[0, gap]))

    return coupled_area(lambda u: float(contact.area(u)), gain, amplitude)


def mean_network_areas(circuit: Circuit, network: Network, frequency: float | None = None) -> FloatArray:
    """Areas of a network's coupled phasor at one frequency (Hz; its source's by default), m^2, shape (n_area,).

    Raises
    ------
    InputError
        Where there are several sources, or one without fundamental; where the areas do not settle.
    """
    source = network.sources[0]
    fundamental = None if source.waveform is None else source.waveform.fundamental
    if len(network.sources) > 1 or fundamental is None:
        what = "several sources" if len(network.sources) > 1 else "a source without fundamental"
        raise InputError(
            f"area='mean' is the area of the phasor of one source at its fundamental, and this circuit has {what}; "
            "allowed: 'coupled', 'frozen' or an area in m^2"
        )
    f = fundamental.frequency if frequency is None else frequency
    s = np.array([complex(fundamental.amplitude)])
    area = np.array([
        float(c.area(0.0)) if c is not None and a.given is None else a.given
        for a, c in zip(network.areas, network.contacts, strict=True)
    ])  # fmt: skip
    for attempt in range(500):
        u = np.abs(network.phasors(f, area, s))
        new = area.copy()
        for i in network.fingers:
            contact, gap = network.contacts[i], network.gaps[i]
            if network.areas[i].given is None and contact is not None and gap is not None:
                new[i] = float(contact.area(float(u[gap]) / math.sqrt(2.0)))
        if np.all(np.abs(new - area) <= 4e-16 * area):
            return new
        # Two areas may swing against each other.
        area = new if attempt < 50 else 0.5 * (area + new)
    raise InputError("the phasor's areas do not settle; allowed: area='frozen' or an area in m^2")


def _network_phasor(circuit: Circuit, frequency: ArrayLike | None, area: str | float) -> PhasorSolution:
    network = build_network(circuit)
    if len(network.fingers) != 1 or len(network.sources) != 1:
        raise InputError(
            f"a phasor solution needs one GAP and one source; this circuit has {len(network.fingers)} and "
            f"{len(network.sources)}"
        )
    place = network.fingers[0]
    contact, gap = network.contacts[place], network.gaps[place]
    assert contact is not None
    assert gap is not None
    waveform = network.sources[0].waveform
    fundamental = None if waveform is None else waveform.fundamental
    f = _frequencies(frequency, fundamental)
    if isinstance(area, str):
        require(area in ("mean", "frozen"), "area", repr(area), "'mean', 'frozen' or a number in m^2")
    given = [a.given for a in network.areas]
    areas = np.empty((f.size, len(given)))
    for i, x in enumerate(f):
        if not isinstance(area, str):
            areas[i] = area
        elif area == "mean":
            areas[i] = mean_network_areas(circuit, network, float(x))
        else:
            areas[i] = [
                float(c.area(0.0)) if c and g is None else g for c, g in zip(network.contacts, given, strict=True)
            ]
    u = np.array([network.phasors(float(x), a, np.ones(1, complex)) for x, a in zip(f, areas, strict=True)])
    layers = np.einsum("fc,lc->fl", u, network.grouping)
    amplitude = math.nan if fundamental is None else fundamental.amplitude
    u_gap = u[:, gap] * amplitude * np.exp(1j * (fundamental.phase if fundamental else 0.0))
    force = 0.5 * contact.stress(np.abs(u_gap)) * areas[:, place]
    return PhasorSolution(
        f, u[:, gap], layers, u_gap, areas[:, place].copy(), force, amplitude, tuple(e.name for e in network.layers)
    )


def _frequencies(frequency: ArrayLike | None, fundamental: Fundamental | None) -> FloatArray:
    if frequency is None:
        if fundamental is None:
            raise InputError("the source has no fundamental: give the frequencies in Hz")
        frequency = fundamental.frequency
    f = np.atleast_1d(np.asarray(frequency, float))
    require(
        f.ndim == 1 and bool(np.all(np.isfinite(f) & (f > 0.0))),
        "frequency",
        f"{frequency} Hz",
        "positive numbers",
    )
    return f


def phasor(circuit: Circuit, frequency: ArrayLike | None = None, *, area: str | float = "mean") -> PhasorSolution:
    """Phasor solution of a circuit, SKIN evaluated at each frequency.

    Parameters
    ----------
    circuit : Circuit
    frequency : array_like, optional
        Hz, positive; the source's fundamental by default.
    area : str or float
        ``"mean"``: coupled through the mean stress at the source's own amplitude (its fundamental's, if it is
        not a sine); ``"frozen"``: the area at 0 V; or an area in m^2. An area fixed by the deck comes before
        ``"mean"`` and ``"frozen"``.

    Returns
    -------
    PhasorSolution

    Raises
    ------
    InputError
        For a circuit without GAP, a network with several GAPs or sources, a source without fundamental where one is
        needed, or frequencies not positive.
    """
    if not is_stack(circuit):
        return _network_phasor(circuit, frequency, area)
    stack = build_stack(circuit)
    gap = stack.gap_layer
    if gap is None or stack.contact is None:
        raise InputError("a phasor solution needs a GAP; this circuit has none")
    fundamental = stack.waveform.fundamental
    f = _frequencies(frequency, fundamental)
    areas = _areas(stack, f, area, None if fundamental is None else fundamental.amplitude)
    gains = layer_gains(stack.admittance(f, areas))
    gain, sign = gains[:, gap], stack.sign[stack.first_cell]
    amplitude = math.nan if fundamental is None else fundamental.amplitude
    u_gap = gain * amplitude * np.exp(1j * (fundamental.phase if fundamental else 0.0))
    # Mean of sigma A over a period of a sine: half the peak.
    force = 0.5 * stack.contact.stress(np.abs(u_gap)) * areas
    return PhasorSolution(
        f, gain * sign[gap], gains * sign, u_gap * sign[gap], areas, force, amplitude,
        tuple(e.name for e in stack.layers),
    )  # fmt: skip


def _areas(stack: Stack, f: FloatArray, area: str | float, amplitude: float | None) -> FloatArray:
    if not isinstance(area, str):
        require(math.isfinite(area) and area > 0.0, "area", f"{area:g} m^2", "a positive area in m^2")
        return np.full(f.size, float(area))
    require(area in ("mean", "frozen"), "area", repr(area), "'mean', 'frozen' or a number in m^2")
    assert stack.contact is not None
    if stack.area_given is not None:
        return np.full(f.size, stack.area_given)
    if area == "frozen":
        return np.full(f.size, float(stack.contact.area(0.0)))
    if amplitude is None:
        raise InputError(
            "area='mean' needs the amplitude of the source's fundamental, and this source has none; allowed: "
            "'frozen' or an area in m^2"
        )
    return np.array([mean_area(stack, float(x), amplitude) for x in f])


def sweep_frequencies(sweep: AcSweep) -> FloatArray:
    """Frequencies (Hz) of an ``.ac`` line."""
    if sweep.scale == "lin":
        return np.linspace(sweep.start, sweep.stop, sweep.points)
    base = 10.0 if sweep.scale == "dec" else 2.0
    count = math.log(sweep.stop / sweep.start, base) * sweep.points
    n = math.floor(count + 1e-9)
    out = sweep.start * base ** (np.arange(n + 1) / sweep.points)
    return np.asarray(np.append(out, sweep.stop) if count - n > 1e-9 else out)
