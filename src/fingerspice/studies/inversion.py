"""From a wanted force to the gap voltage that makes it, and from that to the drive: of a stack, and of a network."""

from __future__ import annotations

import math

import numpy as np
from scipy.interpolate import CubicSpline

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.network import Network
from fingerspice.circuit.response import mean_areas
from fingerspice.circuit.statespace import Stack
from fingerspice.engine.inverse import Cells, drive
from fingerspice.physics.contact import Contact, forces
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import simulate
from fingerspice.waveforms.ramps import Samples

# Largest gap voltage that is thought of where no limit is given, V.
_MOST_VOLTAGE = 2000.0
# Points of the tables from which a voltage is looked up for a force, and of a quarter of the carrier's period.
_TABLE, _QUARTER = 2049, 32
# Corrections of the drive of a network; the error of the gap voltage (root mean square, over the largest one) at which
# they end; and what each has to leave of it at most.
_MOST_ROUNDS, _GOOD_ENOUGH, _GAINED = 12, 1e-6, 0.8
# Share of the largest gain below which a frequency is not driven for the sake of the gap.
_LEAST_GAIN = 1e-3


def gap_voltage(
    contact: Contact, wanted: FloatArray, carrier: float | None, t: FloatArray, is_force: bool
) -> FloatArray:
    """Gap voltage (V) that has a force (N) at times (s), or has it in the mean over the carrier."""
    top = 10.0
    least, most = float(wanted.min()), float(wanted.max())
    while True:
        table = np.linspace(0.0, top, _TABLE)
        curve, stress = contact.curve(top), float(contact.stress(1.0))
        if carrier is None:
            made = forces(table, curve, stress)
        else:
            sines = np.sin(0.5 * math.pi * (np.arange(_QUARTER) + 0.5) / _QUARTER)
            made = forces((table[:, None] * sines).ravel(), curve, stress).reshape(_TABLE, _QUARTER).mean(axis=1)
        if made[-1] >= most or top >= _MOST_VOLTAGE:
            break
        top = min(2.0 * top, _MOST_VOLTAGE)
    highest = float(made.max())
    if not (least >= -1e-12 * highest and most <= highest):
        shown = [x if is_force else contact.mu * (contact.f_n + x) for x in (least, most, 0.0, highest)]
        what = "force" if is_force else "friction"
        raise InputError(
            f"the wanted {what} goes from {shown[0]:.4g} to {shown[1]:.4g} N; allowed: what a voltage across the gap "
            f"makes, {shown[2]:.4g} N (0 V) to {shown[3]:.4g} N ({_MOST_VOLTAGE:g} V)"
        )
    # The voltage is nearly proportional to the root of the force; cubics between the table's points.
    rising = np.flatnonzero(np.diff(np.maximum.accumulate(made), prepend=-1.0) > 0.0)
    found = np.asarray(CubicSpline(np.sqrt(made[rising]), table[rising])(np.sqrt(np.maximum(wanted, 0.0))), float)
    return found if carrier is None else found * np.sin(2.0 * math.pi * carrier * t)


def stack_drive(
    stack: Stack, contact: Contact, law: str, u: FloatArray, rate: float, bounds: tuple[float, float]
) -> tuple[FloatArray, BoolArray]:
    """Voltages of a stack's source at its samples, and where a limit decides them."""
    assert stack.gap is not None
    others = [i for i in range(stack.c.size) if i != stack.gap]
    cells = Cells(
        law == "mobile", stack.c[others], stack.g_total[others], stack.g_area[others],
        np.array([stack.c[stack.gap], stack.g_total[stack.gap], stack.g_area[stack.gap]]),
        contact.curve(1.05 * float(np.abs(u).max()) + 1e-3),
    )  # fmt: skip
    (_, sign), turned = stack.sources[0], float(stack.sign[stack.gap])
    n = (u.size + 1) // 2
    reached, loop, limited = np.empty(n), np.empty(n), np.zeros(n, bool)
    if not drive(cells, turned * u, 1.0 / rate, *bounds, reached, loop, limited):
        raise InputError("no gap voltage belongs to the limited drive under the mobile law; allowed: a higher limit, "
                         "or less force")  # fmt: skip
    return sign * loop, limited


def run_with(circuit: Circuit, name: str, values: FloatArray, rate: float, law: str, rtol: float) -> Solution:
    t = np.arange(values.size) / rate
    return simulate(
        circuit, sources={name: Samples(values, rate)}, t_stop=float(t[-1]), t_eval=t, charge_law=law, rtol=rtol,
        start="uncharged", charge=False,
    )  # fmt: skip


def network_drive(
    circuit: Circuit, network: Network, name: str, u: FloatArray, rate: float, law: str, rtol: float,
    bounds: tuple[float, float],
) -> tuple[FloatArray, BoolArray, Solution]:  # fmt: skip
    """The drive of a network by corrections with its linear response at the mean area, as long as they help."""
    (gap,) = (gap for gap in network.gaps if gap is not None)
    size = 2 * u.size
    f = np.fft.rfftfreq(size, 1.0 / rate)
    f[0] = 1e-3 * f[1]
    gain = network.phasors(f, np.asarray(mean_areas(network)), np.ones(1, complex))[:, gap]
    undone = gain.conj() / (np.abs(gain) ** 2 + (_LEAST_GAIN * np.abs(gain).max()) ** 2)
    limit, slew = bounds

    def corrected(values: FloatArray, missing: FloatArray) -> FloatArray:
        # Held at its end and led back to its start, so that the transform's period has no jump.
        back = np.linspace(missing[-1], missing[0], u.size)
        more = np.fft.irfft(undone * np.fft.rfft(np.concatenate([missing, back])), size)[: u.size]
        return _within(values + more, limit, slew / rate)

    values = corrected(np.zeros(u.size), u)
    best: tuple[float, FloatArray, Solution] | None = None
    for _ in range(_MOST_ROUNDS):
        solution = run_with(circuit, name, values, rate, law, rtol)
        assert solution.u_gap is not None
        missing = u - solution.u_gap
        # The mean of squares: what no drive reaches at once, such as a jump, hides no progress elsewhere.
        missed = float(np.sqrt(np.mean(missing**2)) / np.abs(u).max())
        if best is not None and missed > _GAINED * best[0]:
            if missed < best[0]:
                best = missed, values, solution
            break
        best = missed, values, solution
        if missed <= _GOOD_ENOUGH:
            break
        values = corrected(values, missing)
    assert best is not None
    _, values, solution = best
    at_limit = np.abs(values) >= limit * (1.0 - 1e-12)
    steep = np.abs(np.diff(values, prepend=values[0])) >= slew / rate * (1.0 - 1e-9)
    return values, at_limit | steep, solution


def _within(values: FloatArray, limit: float, step: float) -> FloatArray:
    """Values within a limit, of which neighbours differ by no more than `step`."""
    values = np.clip(values, -limit, limit)
    if np.any(np.abs(np.diff(values)) > step):
        for i in range(1, values.size):
            values[i] = min(max(values[i], values[i - 1] - step), values[i - 1] + step)
    return values
