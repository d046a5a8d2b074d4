"""The one finger of a circuit with one source: gap voltages for forces, and the source's voltage for those.

The source's voltage follows step by step in a series stack, and from the linear response of another network.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from fingerspice.base.arrays import BoolArray, ComplexArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit
from fingerspice.circuit.network import Network, network_of
from fingerspice.circuit.statespace import find_branches
from fingerspice.engine.inverse import drive_stack, hold
from fingerspice.physics.contact import fixed_area_curve
from fingerspice.waveforms.waveform import require

#: Source voltages for gap voltages u (V, shape (n,), positive in the direction of the source) at intervals h (s), and
#: the samples at a limit: of `inverter(u, h, largest voltage (V), largest slew rate (V/s))`.
Inverter = Callable[[FloatArray, float, float, float], tuple[FloatArray, BoolArray]]
#: Gap voltages (V) that rise in some steps, and then produce forces (N): of `voltages(forces, steps)`.
Voltages = Callable[[FloatArray, int], FloatArray]

# Default time in which the force rises to its first value, for networks other than a series stack, s.
_LEAD = 2e-3
# Over the length of the Fourier transform a signal is damped by exp(-_DAMPING), so that its end does not wrap round to
# its beginning. The signal fills at most half of that length, so undoing the damping amplifies round-off by the square
# root of that factor.
_DAMPING = 14.0
# Smallest response of the gap voltage to the source, relative to the largest over all frequencies; a smaller response
# counts as none.
_DEAF = 1e-9
# Number of amplitudes of the carrier between which the mean force is interpolated.
_GRID = 80


class Finger:
    """The one finger of a circuit with one V source, under a charge law; others, and a delayed area, are refused."""

    def __init__(self, circuit: Circuit, charge_law: str | None) -> None:
        self.circuit, self.law = circuit, charge_law or circuit.charge_law or "local"
        require(self.law in CHARGE_LAWS, "charge_law", repr(self.law), " or ".join(map(repr, CHARGE_LAWS)))
        gaps = circuit.by_device("GAP")
        if len(gaps) != 1:
            found = ", ".join(g.name for g in gaps) or "none"
            raise InputError(
                f"an inverse drive is that of one finger; this circuit has the GAPs {found}; allowed: one GAP"
            )
        sources = [e for e in find_branches(circuit)[1] if e.device in "VI"]
        if len(sources) != 1 or sources[0].device != "V":
            found = ", ".join(e.name for e in sources) or "none"
            raise InputError(
                f"an inverse drive is that of one V source; this circuit has {found}; allowed: one V element"
            )
        (self.gap,), (self.source,) = gaps, sources
        tau = self.gap.values["tau"]
        if tau > 0.0:
            raise InputError(f"{self.gap.name} has tau={tau:g} s: its area follows with a delay; allowed here: tau=0")
        self.network = network_of(circuit)
        (place,), stack = self.network.fingers, self.network.stack
        contact = self.network.contacts[place]
        assert contact is not None
        self.contact = contact
        self.area = self.network.areas[place].given  # Fixed by the deck, m^2, or None
        # Default time in which the force rises to its first value, s: a stack's gap voltage jumps with the source.
        self.lead = _LEAD if stack is None else 0.0
        # Sign of the GAP's voltage, from p to n, relative to the voltage along the source.
        self.sign = 1.0 if stack is None else float(stack.sign[stack.gap]) * stack.sources[0][1]

    def force(self, u: FloatArray | float) -> FloatArray:
        """Electroadhesive force (N) at gap voltages (V), same shape."""
        return np.asarray(self.contact.stress(u) * (self.contact.area(u) if self.area is None else self.area))

    def voltages(self, most: float, rate: float, carrier: float | None) -> Voltages:
        """What computes gap voltages for forces up to `most` (N), which are means over each period of a carrier (Hz).

        Between its samples, at `rate` (Hz), the voltage is linear.
        """
        from scipy.interpolate import CubicSpline

        shape, weight = np.ones(1), np.ones(1)
        if carrier is not None:
            points = rate / carrier
            count = round(points) if abs(points - round(points)) < 1e-9 else round(8 * points)
            at = np.sin(2.0 * np.pi * np.arange(count + 1) / points)
            shape = np.abs(np.concatenate([at[:-1], 0.5 * (at[1:] + at[:-1])]))
            # Simpson's rule between samples: the voltage is linear there, so the force is a parabola but for the change
            # of the area.
            weight = np.repeat([1.0 / 3.0, 2.0 / 3.0], count) / count

        def mean(amplitude: FloatArray) -> FloatArray:
            return np.asarray(self.force(amplitude[:, None] * shape) @ weight)

        top = 1.0
        while mean(np.array([top]))[0] < 1.01 * most:
            if top > 1e6:
                raise InputError(
                    f"the force wanted, {most:g} N, is reached by no voltage: at 1 MV the gap has "
                    f"{float(mean(np.array([1e6]))[0]):.3g} N; allowed: less"
                )
            top *= 1.4
        amplitude = top * np.arange(1, _GRID + 1) / _GRID
        force = mean(amplitude)
        rising = np.append(np.diff(force) > 0.0, False)
        amplitude, root = amplitude[: rising.argmin() + 1], np.sqrt(force[: rising.argmin() + 1])
        if root[-1] ** 2 < most:
            raise InputError(f"the force wanted, {most:g} N, is reached by no voltage; allowed: at most "
                             f"{root[-1] ** 2:.3g} N")  # fmt: skip
        # The voltage over the root of the force, which at 0 V is that of a small voltage.
        at_zero = math.sqrt(1.0 / float(weight @ shape**2) / (float(self.force(np.array([1e-3]))[0]) / 1e-3**2))
        spline = CubicSpline(np.append(0.0, root), np.append(at_zero, amplitude / root))

        def voltages(force: FloatArray, lead: int) -> FloatArray:
            u = np.sqrt(force) * spline(np.sqrt(force))
            # The rise has zero first and second derivative at both ends.
            x = np.arange(lead) / max(lead, 1)
            u = np.append(u[0] * (x**3 * (10.0 - 15.0 * x + 6.0 * x * x)), u)
            if carrier is not None:
                u *= np.sin(2.0 * np.pi * carrier / rate * (np.arange(u.size) - lead))
            return u

        return voltages

    def inverter(self, u_max: float) -> Inverter:
        """What computes the source voltage for gap voltages up to `u_max` (V).

        A stack is inverted step by step; while a limit holds the source, its layers' state follows from the source.
        """
        stack = self.network.stack
        if stack is None:
            wish = _linear_inverse(self.network)
        else:
            assert stack.gap is not None
            gap, cells = stack.gap, np.column_stack([stack.c, stack.g_total, stack.g_area])
            long = 1.2 * max(u_max, 1.0)
            curve = self.contact.curve(long) if self.area is None else fixed_area_curve(self.area)

        def drive(u: FloatArray, h: float, limit: float, slew: float) -> tuple[FloatArray, BoolArray]:
            out, held = np.empty(u.size), np.empty(u.size, np.bool_)
            if stack is None:
                hold(wish(u, h), limit, slew * h, out, held)
            else:
                drive_stack(u, h, curve, cells, gap, self.law == "mobile", limit, slew * h, out, held)
            return out, held

        return drive


def _linear_inverse(net: Network) -> Callable[[FloatArray, float], FloatArray]:
    """Inverts the linear response of a network at its areas at rest: source voltages from gap voltages and interval.

    The signals are damped by exp(-a t), which evaluates the response at s = a + i omega. There it has no zero (a
    floating body passes no direct voltage, a zero at s = 0), and the end of the signal does not wrap round.
    """
    from scipy.fft import irfft, next_fast_len, rfft

    areas = net.areas_at_rest
    leak, c = net.leak(areas), net.capacitance(areas)
    gap = next(g for g in net.gaps if g is not None)

    # It takes longer than the transforms, and is asked for again and again for drives of one length.
    @lru_cache(maxsize=1)
    def response(m: int, h: float) -> ComplexArray:
        s = _DAMPING / (m * h) + 2j * np.pi * np.arange(m // 2 + 1) / (m * h)
        y = leak + s[:, None] * c
        kernel = net.k + np.einsum("ci,fc,cj->fij", net.p, y, net.p, optimize=True)
        right = net.b[:, 0] + np.einsum("ci,fc,c->fi", net.p, y, net.q[:, 0], optimize=True)
        x = np.linalg.solve(kernel, -right[:, :, None])[:, :, 0]
        gain = x @ net.p[gap] + net.q[gap, 0]
        if not np.all(np.abs(gain) > _DEAF * np.abs(gain).max(initial=0.0)):
            raise InputError(
                f"{net.sources[0].name} does not drive the gap at every frequency of the drive; allowed: a source with "
                "a path to the GAP, and a lower rate"
            )
        return np.asarray(gain)

    def wish(u: FloatArray, h: float) -> FloatArray:
        n, m = u.size, next_fast_len(2 * u.size, real=True)
        damp = np.exp(-_DAMPING / (m * h) * h * np.arange(m))
        spectrum = rfft(np.append(u, np.full(m - n, u[-1])) * damp)
        return np.asarray(irfft(spectrum / response(m, h), m)[:n] / damp[:n])

    return wish
