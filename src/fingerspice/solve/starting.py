"""Start of a circuit: the capacitors' voltages at t = 0 by the deck, made consistent with Kirchhoff's voltage law.

The rules are those of SPICE, compared with ngspice 39:

- With ``uic`` each capacitor has the voltage of its ``IC=``, else the difference of its nodes' ``.ic``, else 0 V.
- Without ``uic`` the start is the DC operating point with the nodes of ``.ic`` held, which are then released; ``IC=``
  has no effect. A voltage source overrides ``.ic``; for nodes tied together by voltage sources, the mean is used.
- ``.ic`` of an area node (mm^2) holds the area in the operating point, and starts an area with a time constant.

Start voltages that contradict Kirchhoff's voltage law settle at once: charge flows round the loops of capacitors and
sources as if through vanishing resistances, and is conserved on every island of nodes. With fixed areas the result
minimises the sum of C (u - u_start)^2. Where areas follow the voltage, the residual of Kirchhoff's law in the loops is
reduced linearly to 0, because a jump of the sources is the limit of a ramp.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.network import Network, build_network
from fingerspice.engine.network import Net
from fingerspice.physics.contact import Contact, inverse_area
from fingerspice.waveforms.waveform import DC

# Residual of Kirchhoff's law, relative to the largest start voltage, that rounded decimals of a deck may cause.
ROUNDING = 1e-12
# Tolerances of a step towards consistent start voltages, relative to the largest voltage and to each voltage itself.
STEP_ERROR, STEP_RTOL = 1e-14, 2.3e-14
PAST_FOLD = "past the fold of the mobile law; allowed: less voltage, more load, or the local law"


def starts_uncharged(circuit: Circuit) -> bool:
    """Whether capacitors start with the voltages of ``IC=`` and ``.ic`` (else 0 V), not with the operating point."""
    return circuit.tran is None or circuit.tran.uic


def start_voltage(element: Element, initial: Mapping[str, float]) -> float:
    """Voltage (V) from p to n of a capacitor or layer at a start with ``uic``."""
    if element.initial is not None:
        return element.initial
    return initial.get(element.nodes[0], 0.0) - initial.get(element.nodes[1], 0.0)


def start_voltages(elements: Sequence[Element], c: FloatArray, initial: Mapping[str, float]) -> FloatArray:
    """Start voltage of every cell (n_cell,), V, from the cells' elements and capacitances.

    The slabs of a dispersive layer share its voltage in proportion to their elastances, as in a jump.
    """
    total: dict[str, float] = {}
    for element, one in zip(elements, c, strict=True):
        total[element.name] = total.get(element.name, 0.0) + 1.0 / one
    return np.array([start_voltage(e, initial) / (one * total[e.name]) for e, one in zip(elements, c, strict=True)])


def held_sources(circuit: Circuit, initial: Mapping[str, float]) -> tuple[Element, ...]:
    """Voltage sources that hold the nodes of ``.ic`` (V) while the operating point is found."""
    tied: dict[str, dict[str, float]] = {}
    for element in circuit.by_device("V"):
        # Groups of nodes tied together by sources, with the voltage of each node above one of its group.
        p, n = (tied.setdefault(node, {node: 0.0}) for node in element.nodes)
        assert element.waveform is not None
        shift = n[element.nodes[1]] + float(element.waveform.value(0.0, "left")) - p[element.nodes[0]]
        n.update({node: above + shift for node, above in p.items()})
        tied.update(dict.fromkeys(p, n))
    out = []
    done: set[str] = set()
    for node in initial:
        group = tied.get(node, {node: 0.0})
        if node in done or "0" in group or node == "0":
            continue
        done |= group.keys()
        value = float(np.mean([initial[x] - group[x] for x in group if x in initial])) + group[node]
        # This name contains characters that no netlist can contain, so that it cannot clash with an element's.
        out.append(Element(f"v({node}) held", "V", (node, "0"), (node, "0"), MappingProxyType({}), DC(value)))
    return tuple(out)


def operating_point(
    circuit: Circuit,
    network: Network,
    area0: FloatArray,
    contacts: Sequence[Contact | None],
    initial: Mapping[str, float],
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Voltages of all cells (V) and areas (m^2) at the DC operating point, and which areas ``.ic`` holds.

    The sources have their values at 0-, and the nodes in `initial` are held. Areas follow their gaps by `contacts`; an
    area without contact is fixed at `area0` (m^2).

    A node without a path for direct current is refused, and areas that find no operating point.
    """
    conductors = {node for e in circuit.elements for node in e.nodes[:2]} - {a.node for a in network.areas}
    held = held_sources(circuit, {node: v for node, v in initial.items() if node in conductors})
    if held:
        network = build_network(replace(circuit, work="gap"), held)
    waves = [e.waveform for e in network.sources]
    s = np.array([float(w.value(0.0, "left")) for w in waves if w is not None])
    area = area0.copy()
    fixed = np.array([contact is None for contact in contacts], bool)
    asked = np.array([a.node in initial for a in network.areas], bool) & ~fixed
    area[asked] = [1e-6 * initial[a.node] for a, mark in zip(network.areas, asked, strict=True) if mark]
    _refuse_floating_at_dc(network, area)
    part, before = 1.0, math.inf
    for _ in range(500):
        k, b = network.stiffness(area)
        x = np.linalg.solve(k, -b @ s) if k.size else np.zeros(0)
        u = network.p @ x + network.q @ s
        new = area.copy()
        for i, (contact, gap) in enumerate(zip(contacts, network.gaps, strict=True)):
            if contact is not None and gap is not None and not asked[i]:
                new[i] = float(contact.area(abs(float(u[gap]))))
        off = float(np.max(np.abs(new / area - 1.0), initial=0.0))
        # The iteration has converged, or round-off lets it come no nearer.
        if off <= 4e-16 or 0.8 * before < off <= 1e-13:
            return u, area, asked
        # Damping, because leaks that scale with the area may make the iteration oscillate.
        part *= 0.7 if off > 0.8 * before else 1.0
        area, before = area + part * (new - area), off
    raise InputError("the areas find no DC operating point; allowed: uic in .tran, to start uncharged")


def _refuse_floating_at_dc(network: Network, area: FloatArray) -> None:
    """Refuse a network in which some voltage is determined by capacitors only, so that it has no DC value."""
    factor = np.vstack([network.resistor_factor, np.sqrt(network.leak(area))[:, None] * network.p])
    if not factor.shape[1]:
        return
    # Scale the columns before the rank is determined, because conductances range over many decades.
    size = np.linalg.norm(factor, axis=0)
    _, sigma, turned = np.linalg.svd(factor / np.where(size > 0.0, size, 1.0))
    rank = int(np.count_nonzero(sigma > 1e-12 * max(1.0, sigma.max(initial=0.0))))
    if rank == factor.shape[1]:
        return
    held = np.abs(network.p @ turned[rank:].T).max(axis=1) > 1e-9
    names = dict.fromkeys(c.element.name for c, mark in zip(network.cells, held, strict=True) if mark)
    raise InputError(
        f"no DC operating point: {' and '.join(names)} leave nodes that are reached by capacitors only; allowed: a "
        "leakage (r=... or an R), or uic in .tran to start uncharged"
    )


def at_own_area(u: float, area: float, curve: FloatArray) -> float:
    """The gap voltage (V) on its own area that has the same charge as `u` (V) on `area` (m^2), under ``mobile``.

    Where no voltage has that charge, the start is past the fold and refused.
    """

    def charge(v: float) -> float:
        return v / inverse_area(v, curve)[0]

    wanted, low, high = area * abs(u), 0.0, 1e-3 * abs(u)
    # The charge grows with the voltage up to the fold, so the first interval found contains the root on the branch
    # that starts at 0 V.
    while charge(high) < wanted:
        low, high = high, 1.05 * high
        if high > 100.0 * abs(u):
            raise InputError(f"the start has {u:.4g} V across a gap of {area * 1e6:.4g} mm^2, {PAST_FOLD}")
    while low < 0.5 * (low + high) < high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if charge(middle) < wanted else (low, middle)
    return math.copysign(high, u)


def settle(net: Net, u: FloatArray, slow: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Live voltages (n,) V, areas with a time constant over those at 0 V (n_slow,), and delivered charges (n_s,) C.

    These are what the cells' start voltages u (n_cell,) V come to by Kirchhoff's law, with the sources at `s` (n_s,).
    Areas that are NaN in `slow` are set to their equilibrium at the consistent voltages.

    A start from which this leads past a fold is refused.
    """
    n, free = net.k.shape[0], np.isnan(slow)
    area = np.where(free, 1.0, slow)
    for _ in range(61):
        end = _along(net, u - net.q @ s, s, area)
        at_end, new = net.p @ end[:n] + net.q @ s, area.copy()
        for i in np.flatnonzero(net.slow >= 0):
            if free[net.slow[i]]:
                rest = 1.0 / inverse_area(abs(float(at_end[net.gap[i]])), net.curves[i])[0]
                new[net.slow[i]] = rest / net.area0[i]
        if np.all(np.abs(new - area) <= 1e-15):
            break
        area = new
    return end[:n], area, end[n:]


def _along(net: Net, off: FloatArray, s: FloatArray, slow: FloatArray) -> FloatArray:
    """Live voltages (V) and delivered charges (C) at the end of the homotopy to u = P x + Q s.

    Along it the residual of Kirchhoff's law falls from `off` (n_cell,) V linearly to 0.
    """
    n, follows = net.k.shape[0], np.flatnonzero((net.gap >= 0) & (net.slow < 0))
    y = np.zeros(n + net.q.shape[1])
    if not np.any(off):
        return y
    rate = partial(_rate, net, off, s, slow, follows)
    if not follows.size:
        return rate(0.0, y)
    from scipy.integrate import solve_ivp

    scale = np.concatenate([np.ones(n), np.full(net.q.shape[1], math.inf)]) * np.abs(off).max()
    with warnings.catch_warnings():
        # Past a fold the derivative is NaN, of which numpy and scipy would warn; `status` tells of it.
        warnings.simplefilter("ignore")
        found = solve_ivp(
            rate, (0.0, 1.0), y, "DOP853", first_step=0.1, rtol=STEP_RTOL, atol=STEP_ERROR * scale, t_eval=[1.0]
        )
    if found.status != 0:
        where = PAST_FOLD if net.mobile else "where no area is left; allowed: less voltage"
        raise InputError(f"the capacitors' start voltages settle {where}")
    return np.asarray(found.y[:, -1])


def _rate(
    net: Net, off: FloatArray, s: FloatArray, slow: FloatArray, follows: IntArray, theta: float, y: FloatArray
) -> FloatArray:
    """Derivative of (x, charges) by the homotopy's parameter `theta` in [0, 1]; NaN past a fold.

    `follows` are the areas that change during the homotopy: those that follow their gaps without delay.
    """
    u = net.p @ y[: net.k.shape[0]] + net.q @ s + (1.0 - theta) * off
    area, slope = net.area0.copy(), np.zeros(net.area0.size)
    delayed = net.slow >= 0
    area[delayed] *= slow[net.slow[delayed]]
    for i in follows:
        inverse, change = inverse_area(abs(float(u[net.gap[i]])), net.curves[i])
        area[i], slope[i] = 1.0 / inverse, -change / inverse**2
    held = net.c * np.append(area, 1.0)[net.place]
    met = net.p.T @ (held[:, None] * net.p)
    x = _solved(met, net.p.T @ (held * off))
    along = net.p @ x - off
    current = held * along
    if net.mobile and follows.size:
        # The derivatives of the areas add to the capacitance matrix, in the columns of the gaps that they follow.
        gaps, more = net.gap[follows], np.zeros((net.c.size, follows.size))
        for column, i, gap in zip(more.T, follows, gaps, strict=True):
            at = net.place == i
            # At 0 V the direction of the change decides on the branch.
            column[at] = (net.c * u)[at] * slope[i] * (np.sign(u[gap]) or np.sign(along[gap]))
        x = _solved(met + net.p.T @ more @ net.p[gaps], net.p.T @ (held * off + more @ off[gaps]))
        along = net.p @ x - off
        current = held * along + more @ along[gaps]
    return np.concatenate([x, net.through @ current])


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of a linear system; NaN where its determinant is not positive, as past a fold."""
    if not np.linalg.slogdet(matrix)[0] > 0.0:
        return np.full(right.size, math.nan)
    return np.asarray(np.linalg.solve(matrix, right))
