"""The initial state of a run, and the form that a state has in a stack's own equations.

The live voltages along the loop are k U + v. The stack's own state x is v under `local`, and v A / A_0 under `mobile`
(see `engine.one_area.model`). The charge delivered by the source is z under `local`, and z + A U / S under `mobile`.

A run starts from an earlier solution, or from the capacitors' voltages at t = 0 by the deck, made consistent with
Kirchhoff's voltage law. The rules are those of SPICE (docs/netlist.md), compared with ngspice 39. A voltage source
overrides ``.ic``; for nodes tied together by voltage sources, the mean is used. ``.ic`` of an area node (mm^2) holds
the area in the operating point, and starts an area with a time constant.

Start voltages that contradict Kirchhoff's voltage law settle at once: charge flows round the loops of capacitors and
sources as if through vanishing resistances, and is conserved on every island of nodes. With fixed areas the result
minimises the sum of C (u - u_start)^2. Where areas follow the voltage, the residual of Kirchhoff's law in the loops is
reduced linearly to 0, because a jump of the sources is the limit of a ramp.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from fingerspice.base.arrays import FloatArray, read_only
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.network import Network, build_network
from fingerspice.circuit.statespace import Stack, spanning_tree
from fingerspice.engine.implicit import N_COUNTERS, Nodal, new_work, pass_jump
from fingerspice.engine.network import Net, new_room, ramp
from fingerspice.engine.one_area.model import Model, choose_branch, gap_voltage
from fingerspice.numerics.lobatto import radau_scheme
from fingerspice.physics.contact import inverse_area, inverse_areas
from fingerspice.results.outcome import State
from fingerspice.results.solution import Solution
from fingerspice.solve.scenes import Scene
from fingerspice.waveforms.waveform import DC


def model_of(scene: Scene) -> Model:
    """The model of a scene that is known to be a stack."""
    assert scene.model is not None
    return scene.model


def to_loop(scene: Scene, state: State) -> tuple[FloatArray, float]:
    """A stack's state in its own equations, x (V) and last z (C), (n + 1,), and the gap voltage along the loop, V."""
    model, y = model_of(scene), state.y.copy()
    if not any(state.y.tolist()) and not any(state.s_before.tolist()):
        return y, 0.0
    before, along = float(state.s_before[0]), scene.turn * state.y[:-1]
    u_gap = float(np.einsum("k,k->", along[: model.gap.size], model.gap))
    # If the gap's voltage is no state, it is the source's voltage less the states, whose weights are -1.
    u_gap += 0.0 if model.gap.size and model.gap.max() > 0.0 else before
    share = model.k[:-1] * before
    y[:-1] = along - share
    # A remainder within the rounding of the capacitive share is no stored charge: an uncharged start gives exactly 0.
    y[:-1][np.abs(y[:-1]) <= 4e-16 * np.abs(share)] = 0.0
    if model.mobile:
        inverse = inverse_area(abs(u_gap), model.curve)[0]
        y[:-1] /= model.area0 * inverse
        y[-1] -= before / inverse / model.s
    return y, u_gap


def from_loop(scene: Scene, t: float, y: FloatArray, before: float, u_gap: float) -> State:
    """The state used for all circuits, from that of `to_loop` at time t (s), with `before` (V) around the loop."""
    model, stack, sign, scale, y = model_of(scene), scene.network.stack, 0.0, 1.0, y.copy()
    if model.mobile:
        inverse = inverse_area(abs(u_gap), model.curve)[0]
        scale = model.area0 * inverse
        y[-1] += before / inverse / model.s
        if stack is not None and stack.gap is not None and u_gap != 0.0:
            sign = math.copysign(1.0, u_gap) * float(stack.sign[stack.gap])
    y[:-1] = scene.turn * (model.k[:-1] * before + scale * y[:-1])
    return State(t, y, np.array([before]), np.array([sign]), scene.charge_law)


def as_shown(scene: Scene, row: FloatArray) -> FloatArray:
    """A row as in `Record`, or several, with a voltage for each layer in place of each cell, as in `Scene.shown`."""
    if scene.network.stack is None or scene.shown is scene:
        return row
    n = scene.turn.size
    live = scene.shown.turn * ((scene.turn * row[..., :n]) @ scene.network.stack.grouping.T)
    return np.concatenate([live, row[..., n:]], axis=-1)


def initial_state(circuit: Circuit, scene: Scene, start: str | Solution) -> State:
    """State just before the start."""
    network = scene.network
    size = sum(network.b.shape) + int(np.count_nonzero(scene.net.slow >= 0))
    if isinstance(start, Solution):
        names = tuple(e.name for e in network.layers)
        if start.layers != names or start.state.y.size != size or start.charge_law != scene.charge_law:
            raise InputError(
                f"the solution to start from has layers {', '.join(start.layers)} and the {start.charge_law} law, or "
                f"is another circuit's; allowed: one of this circuit, {', '.join(names)} and {scene.charge_law}"
            )
        return start.state
    asked = start == "deck"

    def make() -> State:
        if start == "dc" or (asked and not starts_uncharged(circuit)):
            return _state(scene, *_at_rest(circuit, scene, circuit.initial if asked else {}))
        # An area is NaN if it follows its voltage without delay, or if it starts in equilibrium with it.
        u, area = np.zeros(len(network.cells)), np.full(len(network.areas), np.nan)
        if asked and (circuit.initial or any(e.initial is not None for e in circuit.elements)):
            # The slabs of a dispersive layer share its voltage in proportion to their elastances, as in a jump.
            _, layer = np.unique([cell.element.name for cell in network.cells], return_inverse=True)
            share = (1.0 / scene.net.c) / np.bincount(layer, 1.0 / scene.net.c)[layer]
            u = share * [start_voltage(cell.element, circuit.initial) for cell in network.cells]
            if network.coils.size:
                currents = [e.initial or 0.0 for e in circuit.by_device("L")]
                u[-len(network.coils) :] = network.coils @ currents
            for i, one in enumerate(network.areas):
                if scene.net.slow[i] >= 0:
                    area[i] = 1e-6 * circuit.initial.get(one.node, math.nan)
        return _state(scene, u, area, None)

    return scene.remember(("initial", start), make, 3)


def _at_rest(circuit: Circuit, scene: Scene, initial: Mapping[str, float]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cell voltages (V), areas (m^2) and sources at the DC operating point (at 0-), the nodes in `initial` held."""
    net, stack = scene.net, scene.network.stack
    s = sources = np.array([float(w.value(0.0, "left")) for w in scene.network.waveforms])
    if stack is not None and scene.model is not None and not initial:
        order = list(stack.state_order)
        return (stack.sign * dc_voltages(stack, float(s[0]), scene.model))[order], scene.net.area0, s
    network, added = scene.network, held_sources(circuit, initial) if initial else ()
    if stack is not None or added:
        # The reduced network of a series loop has no nodes to be held.
        network = build_network(replace(circuit, work="gap"), added)
        sources = np.array([float(w.value(0.0, "left")) for w in network.waveforms])
    area, follows = scene.net.area0.copy(), net.gap >= 0
    held = np.array([a.node in initial for a in network.areas], bool) & follows
    area[held] = [1e-6 * initial[a.node] for a, mark in zip(network.areas, held, strict=True) if mark]
    _refuse_floating_at_dc(network, area)
    part, before = 1.0, math.inf
    for _ in range(500):
        k, b = network.stiffness(network.leak(area))
        x = np.linalg.solve(k, -b @ sources) if k.size else np.zeros(0)
        u, new = network.p @ x + network.q @ sources, area.copy()
        for i in np.flatnonzero(follows & ~held).tolist():
            new[i] = 1.0 / inverse_area(abs(float(u[network.gaps[i]])), net.curves[i])[0]
        off = float(np.max(np.abs(new / area - 1.0), initial=0.0))
        # The iteration has converged, or round-off lets it come no nearer.
        if off <= 4e-16 or 0.8 * before < off <= 1e-13:
            break
        # Damping, because leaks that scale with the area may make the iteration oscillate.
        part *= 0.7 if off > 0.8 * before else 1.0
        area, before = area + part * (new - area), off
    else:
        raise InputError("the areas find no DC operating point; allowed: uic in .tran, to start uncharged")
    if stack is not None:
        of: dict[str, list[float]] = {}
        for layer, count in zip(stack.layers, stack.cells, strict=True):
            each = [v for cell, v in zip(network.cells, u.tolist(), strict=True) if cell.element is layer]
            # A dispersive skin evaluated at one frequency is one cell of the loop, but several of the network.
            of[layer.name] = each if count > 1 else [sum(each)]
        u = np.array([of[cell.element.name].pop(0) for cell in scene.network.cells])
    for place in np.flatnonzero(held & (net.slow < 0)) if net.mobile else ():
        # A held area is released at the start: it becomes that of its gap voltage, and the charge is conserved.
        own = at_own_area(float(u[net.gap[place]]), area[place], net.curves[place])
        u[net.place == place] *= area[place] / (1.0 / inverse_area(abs(own), net.curves[place])[0])
        u[net.gap[place]] = own
    return u, area, s


def _state(scene: Scene, u: FloatArray, area: FloatArray, s: FloatArray | None) -> State:
    """State just before the start from cell voltages u (n_cell,) V; without `s`, the sources are fitted to them."""
    network, net = scene.network, scene.net
    if s is None and not u.any() and not np.any(net.slow >= 0):
        y, still = np.zeros(sum(network.b.shape)), np.zeros(len(network.sources))
        return State(0.0, y, still, np.zeros(len(network.areas)), scene.charge_law)
    slow, x, charge = (area / net.area0)[net.slow >= 0], u[list(network.live)], np.zeros(len(network.sources))
    rest, q = u - network.p @ x, network.q
    before = np.zeros(q.shape[1]) if s is None else s
    if s is None and np.any(rest):
        # The values that agree with the cell voltages in the least-squares sense.
        before = np.asarray(np.linalg.lstsq(q, rest, rcond=None)[0], float)
    after = np.array([float(w.value(0.0)) for w in scene.network.waveforms])
    # The run itself reports a source that is not finite.
    after[~np.isfinite(after)] = 0.0
    if float(np.abs(rest - q @ before).max(initial=0.0)) > ROUNDING * float(np.abs(u).max(initial=0.0)):
        before = after if s is None else s
        x, slow, charge = settle(net, u, slow, before)
    elif np.any(np.isnan(slow)):
        # Areas with a time constant start in equilibrium with the voltages after the sources' first jump.
        _, slow, _ = settle(net, u, slow, after)
    sign = np.zeros(len(network.areas))
    state = State(0.0, np.concatenate([x, slow, charge]), before, sign, scene.charge_law)
    model = scene.model
    if model is not None and network.gaps[0] is not None and np.any(u):
        # Raised from 0 V, the source has to reach the state's gap voltage.
        (x, u_gap), u_before = to_loop(scene, state), float(before[0])
        k_u, branch = model.k_gap * u_before, choose_branch(model, u_before, x)
        found = float(gap_voltage(model, k_u, float(model.gap @ x[:-1]), branch, k_u))
        # Behind an insulating coating, a gap voltage of 0 V is a difference of other voltages, with their round-off.
        if not abs(found - u_gap) <= 1e-9 * abs(u_gap) + 1e-13 * float(np.abs(u).max()):
            raise InputError(f"the start has {u[scene.measured[0]]:.4g} V across the gap, {PAST_FOLD}")
    return state


def dc_voltages(stack: Stack, u_source: float, model: Model) -> FloatArray:
    """Cell voltages (V) along the loop (n_cell,) at the DC operating point; refused where some node has none."""
    insulating = stack.layers_of(stack.g_total + stack.g_area == 0.0)
    if len(insulating) > 1:
        raise InputError(
            f"no DC operating point: {' and '.join(insulating)} do not leak, so the nodes between them are reached "
            "by capacitors only; allowed: a leakage (r=...), or uic in .tran to start uncharged"
        )

    def split(area: float) -> FloatArray:
        g = stack.g_total + stack.g_area * area
        # A layer that does not leak takes all of the voltage.
        r = (g == 0.0) + 0.0 if insulating else 1.0 / g
        return np.asarray(u_source * r / r.sum())

    if stack.gap is None or not model.coupled:
        return split(model.area0)
    low, high = 0.0, abs(u_source)
    while low < (middle := 0.5 * (low + high)) < high:
        more = abs(split(1.0 / inverse_area(middle, model.curve)[0])[stack.gap]) > middle
        low, high = (middle, high) if more else (low, middle)
    return split(1.0 / inverse_area(high, model.curve)[0])


# Residual of Kirchhoff's law that rounded decimals of a deck may cause, relative to the largest start voltage; and
# tolerance of a step towards consistent start voltages, relative to that voltage, and its stages.
ROUNDING, STEP_ERROR, STAGES = 1e-12, 1e-14, 7
PAST_FOLD = "past the fold of the mobile law; allowed: less voltage, more load, or the local law"


def starts_uncharged(circuit: Circuit) -> bool:
    """Whether capacitors start with the voltages of ``IC=`` and ``.ic`` (else 0 V), not with the operating point."""
    return circuit.tran is None or circuit.tran.uic


def start_voltage(element: Element, initial: Mapping[str, float]) -> float:
    """Voltage (V) from p to n of a capacitor or layer at a start with ``uic``."""
    if element.initial is not None:
        return element.initial
    return initial.get(element.nodes[0], 0.0) - initial.get(element.nodes[1], 0.0)


def held_sources(circuit: Circuit, initial: Mapping[str, float]) -> tuple[Element, ...]:
    """Voltage sources that hold the nodes of ``.ic`` (V) while the operating point is found."""
    conductors = {n for e in circuit.elements for n in e.nodes[:2]} - {n for e in circuit.elements for n in e.nodes[2:]}
    initial = {node: v for node, v in initial.items() if node in conductors}
    sources = circuit.by_device("V")
    taken, of_tree = spanning_tree([*(e.nodes for e in sources), *((node, "0") for node in initial)])
    known = [float(e.waveform.value(0.0, "left")) for e in sources if e.waveform is not None]
    own = np.append(known, np.zeros(len(initial)))[taken]
    out = []
    for place, node in enumerate(itertools.compress(initial, taken[len(sources) :]), len(sources)):
        # The nodes that sources tie to this one, which share its row of the tree
        value = np.mean([v - of_tree[x] @ own for x, v in initial.items() if of_tree[x][place] != 0.0])
        # This name contains characters that no netlist can contain, so that it cannot clash with an element's.
        ends = (node, "0")
        out.append(Element(f"v({node}) held", "V", ends, ends, MappingProxyType({}), DC(float(value))))
    return tuple(out)


def _refuse_floating_at_dc(network: Network, area: FloatArray) -> None:
    """Refuse a network in which some voltage is determined by capacitors only, so that it has no DC value."""
    leak = network.leak(area)
    if network.active:
        _refuse_undetermined_at_dc(network, leak)
        return
    if np.all(leak > 0.0) or not network.live:
        return
    factor = np.vstack([network.resistor_factor, np.sqrt(leak)[:, None] * network.p])
    # Scale the columns before the rank is determined, because conductances range over many decades.
    size = np.linalg.norm(factor, axis=0)
    _, sigma, turned = np.linalg.svd(factor / np.where(size > 0.0, size, 1.0))
    rank = int(np.count_nonzero(sigma > 1e-12 * max(1.0, sigma.max(initial=0.0))))
    if rank < factor.shape[1]:
        held = np.abs(network.p @ turned[rank:].T).max(axis=1) > 1e-9
        names = dict.fromkeys(c.element.name for c, mark in zip(network.cells, held, strict=True) if mark)
        raise InputError(
            f"no DC operating point: {' and '.join(names)} leave nodes that are reached by capacitors only; allowed: a "
            "leakage (r=...) or an R, or uic in .tran to start uncharged"
        )


def _refuse_undetermined_at_dc(network: Network, leak: FloatArray) -> None:
    """The same of a network with inductors or amplifiers, whose equations may have no or many solutions."""
    matrix, _ = network.stiffness(leak)
    matrix = matrix / np.maximum(np.abs(matrix).max(axis=1, initial=0.0), 1e-300)[:, None]
    matrix = matrix / (size := np.maximum(np.abs(matrix).max(axis=0, initial=0.0), 1e-300))
    _, sigma, turned = np.linalg.svd(matrix)
    if sigma.size and sigma[-1] <= 1e-13 * sigma[0]:
        free = turned[-1] / size
        live = [network.cells[i].element.name for i in network.live]
        names = ", ".join(dict.fromkeys(np.array(live)[np.abs(free) > 1e-6 * np.abs(free).max()].tolist()))
        raise InputError(
            f"no DC operating point: nothing determines {names}, in a loop of inductors and sources, or at nodes that "
            "are reached by capacitors only; allowed: an R in the loop or beside them, or uic in .tran"
        )


def at_own_area(u: float, area: float, curve: FloatArray) -> float:
    """The gap voltage (V) on its own area that has the same charge as `u` (V) on `area` (m^2), under ``mobile``."""
    # The charge grows with the voltage up to the fold, so the first interval in which it reaches the one wanted
    # contains the root on the branch that starts at 0 V.
    wanted, at = area * abs(u), abs(u) * np.geomspace(1e-3, 100.0, 237)
    reached = np.flatnonzero(at / inverse_areas(at, curve) >= wanted)
    if not reached.size:
        raise InputError(f"the start has {u:.4g} V across a gap of {area * 1e6:.4g} mm^2, {PAST_FOLD}")
    low, high = np.append(0.0, at)[reached[0] : reached[0] + 2].tolist()
    while low < (middle := 0.5 * (low + high)) < high:
        enough = middle / inverse_area(middle, curve)[0] >= wanted
        low, high = (low, middle) if enough else (middle, high)
    return math.copysign(high, u)


def settle(net: Net, u: FloatArray, slow: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Live voltages (n,) V, areas with a time constant over those at 0 V (n_slow,), and delivered charges (n_s,) C.

    These are what the cells' start voltages u (n_cell,) V come to by Kirchhoff's law, with the sources at `s` (n_s,).
    Areas that are NaN in `slow` are set to their equilibrium at the consistent voltages.
    """
    n, free = net.k.shape[0], np.isnan(slow)
    area = np.where(free, 1.0, slow)
    for _ in range(61):
        end, new = _along(net, u - net.q @ s, s, area), area.copy()
        at_end = net.p @ end[:n] + net.q @ s
        for i in np.flatnonzero(net.slow >= 0):
            if free[net.slow[i]]:
                rest = 1.0 / inverse_area(abs(float(at_end[net.gap[i]])), net.curves[i])[0]
                new[net.slow[i]] = rest / net.area0[i]
        if np.all(np.abs(new - area) <= 1e-15):
            break
        area = new
    return end[:n], area, end[n + slow.size :]


def _along(net: Net, off: FloatArray, s: FloatArray, slow: FloatArray) -> FloatArray:
    """The state where Kirchhoff's residual `off` (n_cell,), V, has fallen to 0 linearly: a jump of one more source."""
    n, n_s = net.b.shape
    y, none, signs = np.concatenate([np.zeros(n), slow, np.zeros(n_s + 1)]), np.zeros(0), np.zeros(net.gap.size)
    if np.any(off):
        wide = net._replace(
            q=np.column_stack([net.q, off]), b=np.zeros((n, n_s + 1)), through=np.vstack([net.through, 0.0 * off]),
            delivered=np.zeros((n_s + 1, n + n_s + 1)),
        )  # fmt: skip
        size, held = float(np.abs(off).max()), float(np.abs(net.c * np.append(net.area0, 1.0)[net.place]).sum())
        scale, scheme = np.repeat([size, 1.0, size * held], [n, slow.size, n_s + 1]), radau_scheme(STAGES)
        work, room = new_work(wide, STAGES, scheme.eigenvalues.size, y.size), new_room(wide, y.size)
        before, after = np.append(s, 1.0), np.append(s, 0.0)
        nodal = Nodal(
            wide, room, scheme, work, ramp(before, after), True, scale, STEP_ERROR, y, before, signs, none,
            np.zeros(N_COUNTERS, np.int64), 0.0 * signs, np.zeros((1, 4)), False, read_only(none),
            read_only(none > 0.0), np.empty((0, 0)),
        )  # fmt: skip
        if not pass_jump(nodal, before):
            where = PAST_FOLD if net.mobile else "where no area is left; allowed: less voltage"
            raise InputError(f"the capacitors' start voltages settle {where}")
    return y[:-1]
