"""The finger of an inverse drive, and the source voltage for a gap voltage wanted there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import BoolArray, ComplexArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit, Element
from fingerspice.circuit.loop import network_of
from fingerspice.circuit.network import Network
from fingerspice.circuit.response import areas_at_rest
from fingerspice.circuit.statespace import Stack
from fingerspice.circuit.topology import find_branches
from fingerspice.engine.inverse import drive_stack, hold
from fingerspice.physics.contact import Contact, fixed_area_curve
from fingerspice.studies.wanted import ForceCurve
from fingerspice.waveforms.waveform import require

# Default time in which the force rises to its first value, for networks other than a series stack, s.
_LEAD = 2e-3
# Over the length of the Fourier transform a signal is damped by exp(-_DAMPING), so that its end does not wrap round to
# its beginning. The signal fills at most half of that length, so undoing the damping amplifies round-off by the square
# root of that factor.
_DAMPING = 14.0
# Smallest response of the gap voltage to the source, relative to the largest over all frequencies; a smaller response
# counts as none.
_DEAF = 1e-9


class Limits(NamedTuple):
    """Limits of the source."""

    voltage: float = math.inf  # Largest absolute voltage, V
    slew: float = math.inf  # Largest slew rate, V/s


@dataclass(frozen=True)
class Finger:
    """The one finger of a circuit with one source, under a charge law."""

    circuit: Circuit
    law: str
    gap: Element
    source: Element
    contact: Contact
    area: float | None  # Area fixed by the deck, m^2, or None
    network: Network

    @property
    def lead(self) -> float:
        """Default time in which the force rises, s: none for a stack, whose gap voltage jumps with the source."""
        return _LEAD if self.network.stack is None else 0.0

    def inverter(self, u_max: float) -> StackInverter | NetworkInverter:
        """What computes the source voltage for gap voltages up to `u_max` (V)."""
        stack = self.network.stack
        return NetworkInverter(self.network) if stack is None else StackInverter(stack, u_max, self.law == "mobile")


def the_finger(circuit: Circuit, charge_law: str | None) -> Finger:
    """The finger and the source of a circuit that has one of each; others, and a delayed area, are refused."""
    law = charge_law or circuit.charge_law or "local"
    require(law in CHARGE_LAWS, "charge_law", repr(law), " or ".join(map(repr, CHARGE_LAWS)))
    gaps = circuit.by_device("GAP")
    if len(gaps) != 1:
        found = ", ".join(g.name for g in gaps) or "none"
        raise InputError(f"an inverse drive is that of one finger; this circuit has the GAPs {found}; allowed: one GAP")
    sources = [e for e in find_branches(circuit)[1] if e.device in "VI"]
    if len(sources) != 1 or sources[0].device != "V":
        found = ", ".join(e.name for e in sources) or "none"
        raise InputError(f"an inverse drive is that of one V source; this circuit has {found}; allowed: one V element")
    tau = gaps[0].values["tau"]
    if tau > 0.0:
        raise InputError(f"{gaps[0].name} has tau={tau:g} s: its area follows with a delay; allowed here: tau=0")
    network = network_of(circuit)
    (place,) = network.fingers
    contact = network.contacts[place]
    assert contact is not None
    return Finger(circuit, law, gaps[0], sources[0], contact, network.areas[place].given, network)


class StackInverter:
    """Inverts a stack step by step; while a limit holds the source, it integrates the layers' state from the source."""

    def __init__(self, stack: Stack, u_max: float, mobile: bool) -> None:
        assert stack.contact is not None
        assert stack.gap is not None
        area = stack.area_given
        self._curve = stack.contact.curve(1.2 * max(u_max, 1.0)) if area is None else fixed_area_curve(area)
        self._cells = np.column_stack([stack.c, stack.g_total, stack.g_area])
        self._gap, self._mobile = stack.gap, mobile
        #: Sign of the GAP's voltage, from p to n, relative to the voltage along the source.
        self.sign = float(stack.sign[stack.gap]) * stack.sources[0][1]

    def drive(self, u: FloatArray, h: float, limits: Limits) -> tuple[FloatArray, BoolArray]:
        """Source voltages for gap voltages `u` (V, shape (n,)) at intervals `h` (s), and the samples at a limit.

        `u` is positive in the direction of the source.
        """
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
        self._last: tuple[tuple[int, float], ComplexArray] | None = None

    def response(self, s: ComplexArray) -> ComplexArray:
        """Ratio of the gap voltage to the source voltage at complex frequencies (1/s), shape (n,)."""
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
        """As `StackInverter.drive`."""
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


def gap_voltages(curve: ForceCurve, force: FloatArray, rate: float, carrier: float | None, lead: int) -> FloatArray:
    """Gap voltages (V) at a rate (Hz) that rise in `lead` steps, and then produce the forces (N) on a carrier (Hz)."""
    u = curve.amplitude(force)
    # The rise has zero first and second derivative at both ends.
    x = np.arange(lead) / max(lead, 1)
    u = np.append(u[0] * (x**3 * (10.0 - 15.0 * x + 6.0 * x * x)), u)
    if carrier is not None:
        u *= np.sin(2.0 * np.pi * carrier / rate * (np.arange(u.size) - lead))
    return u
