"""Source voltage for a wanted gap voltage; the rise of a drive, and means of its force."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.loop import network_of
from fingerspice.circuit.network import Network
from fingerspice.circuit.response import areas_at_rest
from fingerspice.circuit.statespace import Stack, build_stack, contact_of, is_stack
from fingerspice.circuit.topology import find_branches
from fingerspice.engine.inverse import drive_stack, hold
from fingerspice.physics.contact import Contact, fixed_area_curve

BoolArray = NDArray[np.bool_]

# Over the length of the Fourier transform a signal is damped by exp(-_DAMPING), so that its end does not wrap round to
# its beginning. The signal fills at most half of that length, so undoing the damping amplifies round-off by the square
# root of that factor.
_DAMPING = 14.0
# Smallest response of the gap voltage to the source, relative to the largest over all frequencies; a smaller response
# counts as none.
_DEAF = 1e-9


@dataclass(frozen=True)
class Limits:
    """Limits of the source: its largest absolute `voltage` (V) and its largest `slew` rate (V/s)."""

    voltage: float = math.inf
    slew: float = math.inf


class Inverter(Protocol):
    """Computes the source voltage for a wanted gap voltage."""

    sign: float

    def drive(self, u: FloatArray, h: float, limits: Limits) -> tuple[FloatArray, BoolArray]:
        """Source voltages for gap voltages `u` (V, shape (n,)) at intervals `h` (s), and the samples at a limit."""
        ...


@dataclass(frozen=True)
class Finger:
    """The one finger of a circuit."""

    gap: Element
    source: Element
    contact: Contact
    area: float | None  # Area fixed by the deck, m^2, or None
    direct: bool  # Whether the circuit is a series stack, so that the gap voltage jumps with the source


def the_finger(circuit: Circuit) -> Finger:
    """The finger and the source of a circuit that has one of each.

    Raises
    ------
    InputError
        If there is not exactly one finger and one voltage source, or if the area follows with a delay.
    """
    gaps = circuit.by_device("GAP")
    if len(gaps) != 1:
        found = ", ".join(g.name for g in gaps) or "none"
        raise InputError(f"an inverse drive is that of one finger; this circuit has the GAPs {found}; allowed: one GAP")
    sources = [e for e in find_branches(circuit)[1] if e.device in "VI"]
    if len(sources) != 1 or sources[0].device != "V":
        found = ", ".join(e.name for e in sources) or "none"
        raise InputError(f"an inverse drive is that of one V source; this circuit has {found}; allowed: one V element")
    if gaps[0].values["tau"] > 0.0:
        tau = gaps[0].values["tau"]
        raise InputError(f"{gaps[0].name} has tau={tau:g} s: its area follows with a delay; allowed here: tau=0")
    if is_stack(circuit):
        stack = build_stack(circuit)
        assert stack.contact is not None
        return Finger(gaps[0], sources[0], stack.contact, stack.area_given, True)
    network = network_of(circuit)
    area = next(a for a in network.areas if a.gap is not None and a.gap.name == gaps[0].name)
    return Finger(gaps[0], sources[0], contact_of(gaps[0]), area.given, False)


def inverter_of(circuit: Circuit, u_max: float, law: str) -> Inverter:
    """The inverter of a circuit for gap voltages up to `u_max` (V) under a charge law."""
    if not is_stack(circuit):
        return NetworkInverter(network_of(circuit))
    return StackInverter(build_stack(circuit), u_max, law == "mobile")


class StackInverter:
    """Inverts a stack step by step; while a limit holds the source, it integrates the layers' state from the source."""

    def __init__(self, stack: Stack, u_max: float, mobile: bool) -> None:
        assert stack.contact is not None
        assert stack.gap is not None
        area = stack.area_given
        self._curve = stack.contact.curve(1.2 * max(u_max, 1.0)) if area is None else fixed_area_curve(area)
        self._cells = np.column_stack([stack.c, stack.g_total, stack.g_area])
        self._gap, self._mobile = stack.gap, mobile
        self._source = stack.sources[0][1]
        #: Sign of the GAP's voltage, from p to n, relative to the voltage along the source.
        self.sign = float(stack.sign[stack.gap]) * self._source

    def drive(self, u: FloatArray, h: float, limits: Limits) -> tuple[FloatArray, BoolArray]:
        """As `Inverter.drive`; `u` is positive in the direction of the source."""
        out, held = np.empty(u.size), np.empty(u.size, np.bool_)
        drive_stack(
            u, h, self._curve, self._cells, self._gap, self._mobile, limits.voltage, limits.slew * h, out, held
        )  # fmt: skip
        return out, held


class NetworkInverter:
    """Inverts the linear response of a network at its areas at rest.

    The signals are damped by exp(-a t), which evaluates the response at s = a + i omega. There it has no zero (a
    floating body passes no direct voltage, a zero at s = 0), and the end of the signal does not wrap round.
    """

    sign = 1.0

    def __init__(self, network: Network) -> None:
        areas = areas_at_rest(network)
        self._leak, self._c = network.leak(areas), network.capacitance(areas)
        self._network = network
        self._gap = next(g for g in network.gaps if g is not None)
        # The last number of frequencies and interval (s), and the response there: it takes longer than the transforms.
        self._last: tuple[tuple[int, float], NDArray[np.complex128]] | None = None

    def response(self, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Ratio of the gap voltage to the source voltage at complex frequencies (1/s), shape (n,).

        Raises
        ------
        InputError
            If the source does not drive the gap at one of the frequencies.
        """
        net = self._network
        y = self._leak + s[:, None] * self._c
        kernel = net.k + np.einsum("ci,fc,cj->fij", net.p, y, net.p, optimize=True)
        right = net.b[:, 0] + np.einsum("ci,fc,c->fi", net.p, y, net.q[:, 0], optimize=True)
        x = np.linalg.solve(kernel, -right[:, :, None])[:, :, 0]
        gain = x @ net.p[self._gap] + net.q[self._gap, 0]
        if not np.all(np.abs(gain) > _DEAF * np.abs(gain).max(initial=0.0)):
            raise InputError(
                f"{net.sources[0].name} does not drive the gap at every frequency of the drive; allowed: a source with "
                "a path to the GAP, and a lower rate"
            )
        return np.asarray(gain)

    def drive(self, u: FloatArray, h: float, limits: Limits) -> tuple[FloatArray, BoolArray]:
        """As `Inverter.drive`."""
        from scipy.fft import irfft, next_fast_len, rfft

        n = u.size
        m = next_fast_len(2 * n, real=True)
        damp = np.exp(-_DAMPING / (m * h) * h * np.arange(m))
        spectrum = rfft(np.append(u, np.full(m - n, u[-1])) * damp)
        if self._last is None or self._last[0] != (m, h):
            s = _DAMPING / (m * h) + 2j * np.pi * np.arange(spectrum.size) / (m * h)
            self._last = (m, h), self.response(s)
        wish = irfft(spectrum / self._last[1], m)[:n] / damp[:n]
        out, held = np.empty(n), np.empty(n, np.bool_)
        hold(wish, limits.voltage, limits.slew * h, out, held)
        return out, held


def rise(count: int) -> FloatArray:
    """A rise from 0 to 1 (left out) in `count` steps, with zero first and second derivative at both ends."""
    x = np.arange(count) / max(count, 1)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x * x))


def means(fine: FloatArray, rate: float, edges: FloatArray) -> FloatArray:
    """Means between `edges` (s), by Simpson's rule, of values at samples of a rate (Hz) and midway between them."""
    parts = (fine[:-2:2] + 4.0 * fine[1::2] + fine[2::2]) / (6.0 * rate)
    total = np.append(0.0, np.cumsum(parts))
    return np.asarray(np.diff(np.interp(edges, np.arange(total.size) / rate, total)) / np.diff(edges))
