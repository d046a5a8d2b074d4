"""A series stack as a network, for the methods that step any circuit: the problem one way, the run the other way."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.circuit import Element
from fingerspice.circuit.network import Cell, Network
from fingerspice.circuit.topology import Area
from fingerspice.engine.model import branch_area, choose_branch, dot, fold_margin, gap_voltage
from fingerspice.engine.network import Net
from fingerspice.physics.contact import inverse_area, inverse_areas
from fingerspice.results.outcome import NetworkState, State, Status
from fingerspice.results.record import sided
from fingerspice.solve.folding import lead_to_fold
from fingerspice.solve.netruns import NetworkRun
from fingerspice.solve.networks import NetworkProblem, NetworkScene
from fingerspice.solve.nodal import solve_coupled
from fingerspice.solve.problem import Problem, Scene
from fingerspice.solve.runs import BoolArray, Progress, Run

FloatArray = NDArray[np.float64]


def solve_otherwise(
    problem: Problem, method: str, rtol: float, t_out: FloatArray, left: BoolArray, progress: Progress | None = None
) -> Run:
    """Integrate a stack by ``"radau"`` or a library's method, as any network. A fold is met to rounding."""
    network = as_network(problem)
    if method == "radau":
        run = as_stack(problem, network, solve_coupled(network, rtol, t_out, left, progress))
        return (lead_to_fold(problem, run, t_out, left) or run) if run.status is Status.FOLD else run
    from fingerspice.solve.foreign import solve_foreign

    return as_stack(problem, network, solve_foreign(network, method, rtol, t_out, left, progress))


def as_network(problem: Problem) -> NetworkProblem:
    """The problem of a stack in the states of `engine.network`: all its cells' voltages but one, and the charge."""
    scene: NetworkScene | None = problem.scene.prepared.get("network")
    if scene is None:
        scene = problem.scene.prepared.setdefault("network", _scene(problem.scene))
    return NetworkProblem(
        problem.circuit, scene, problem.t_start, problem.t_stop, problem.first, problem.step, _initial(problem),
        problem.charge,
    )  # fmt: skip


def _scene(scene: Scene) -> NetworkScene:
    model, network = scene.model, _network(scene)
    net = Net(
        mobile=model.mobile,
        p=network.p,
        q=network.q,
        c=np.array([cell.c for cell in network.cells]),
        g_total=np.array([cell.g_total for cell in network.cells]),
        g_area=np.array([cell.g_area for cell in network.cells]),
        place=np.zeros(len(network.cells), np.int64),
        k=network.k,
        b=network.b,
        through=network.through,
        delivered=network.delivered,
        gap=np.array([network.gaps[0] if model.coupled else -1], np.int64),
        area0=np.array([model.area0]),
        tau=np.zeros(1),
        slow=np.full(1, -1, np.int64),
        curves=model.curve[None, :].copy(),
    )
    fixed = None if model.coupled else model.area0
    return NetworkScene(network, net, scene.charge_law, scene.area_mode, (fixed,), scene.u_peak)


def _network(scene: Scene) -> Network:
    """The loop with its sources as one, cells in the order of the stack's states, voltages along the loop."""
    stack, nodes = scene.stack, ("1", "0")
    order = stack.state_order
    n = len(order) - 1
    layers = [stack.layers[stack.layer_of(i)] for i in order]
    constants = np.column_stack([stack.c, stack.g_total, stack.g_area])[list(order)].tolist()
    cells = tuple(Cell(e, nodes, c, g, g_area, 0) for e, (c, g, g_area) in zip(layers, constants, strict=True))
    gap_layer = stack.gap_layer
    # The current is that of the cell that leaks least, where it suffers least from cancellation.
    slowest = order.index(int(np.argmin(stack.leak_rates(scene.model.area0))))
    return Network(
        sources=(Element("loop", "V", nodes, nodes, MappingProxyType({}), scene.waveform),),
        n_voltage=1,
        cells=cells,
        layers=stack.layers,
        live=tuple(range(n)),
        areas=(Area("area", None if gap_layer is None else stack.layers[gap_layer], stack.area_given, None),),
        contacts=(stack.contact,),
        gaps=(None if stack.gap is None else order.index(stack.gap),),
        p=np.vstack([np.eye(n), -np.ones((1, n))]),
        q=np.eye(n + 1)[:, -1:].copy(),
        k=np.zeros((n, n)),
        b=np.zeros((n, 1)),
        through=np.eye(n + 1)[slowest : slowest + 1].copy(),
        delivered=np.zeros((1, n + 1)),
        resistor_factor=np.zeros((0, n)),
        resistor_factor_s=np.zeros((0, 1)),
        node_names=(),
        nodes=np.zeros((0, n + 1)),
    )


def _initial(problem: Problem) -> NetworkState:
    """The state of a stack with its live voltages and the charge delivered so far."""
    model, state = problem.model, problem.initial
    x, u_before = state.y[:-1], state.u_before
    k_u, x_gap = model.k_gap * u_before, float(dot(model.gap, state.y))
    known = np.isfinite(state.u_gap) and state.u_gap != 0.0
    sign = float(np.sign(state.u_gap)) if known else float(choose_branch(model, u_before, state.y))
    u_gap = float(gap_voltage(model, k_u, x_gap, sign, state.u_gap if known else k_u))
    if not np.isfinite(u_gap):
        # A run that stopped at a fold: by rounding alone its state may have no root any more.
        u_gap = state.u_gap
    inverse, _ = branch_area(model, sign, u_gap)
    scale = model.area0 * inverse if model.mobile else 1.0
    held = u_before / inverse / model.s if model.mobile else 0.0
    charge = held + state.y[-1] - state.charge_offset
    y = np.append(model.k[:-1] * u_before + x * scale, charge)
    return NetworkState(state.t, y, np.array([u_before]), np.zeros(1))


def as_stack(problem: Problem, network: NetworkProblem, run: NetworkRun) -> Run:
    """What the run of `as_network` gives, as a run of the stack itself."""
    model, stack, offset = problem.model, problem.stack, problem.initial.charge_offset
    n = model.gap.size
    u = sided(problem.waveform, run.t, run.left)
    live = run.rows[:, :n].T
    u_gap = live[network.network.gaps[0]] if model.coupled and n else u
    z = run.rows[:, n] + offset
    if model.mobile:
        z = z - u / inverse_areas(u_gap, model.curve) / model.s
    y, u_before = run.state.y, float(run.state.s_before[0])
    here = float(network.network.p[_probe(network)] @ y[:n] + network.network.q[_probe(network)] @ run.state.s_before)
    inverse = inverse_area(abs(here), model.curve)[0]
    scale = model.area0 * inverse if model.mobile else 1.0
    held = u_before / inverse / model.s if model.mobile else 0.0
    state = np.append((y[:n] - model.k[:-1] * u_before) / scale, y[n] + offset - held)
    peak_u, peak_f = run.gaps[0, :2]
    margin = run.margin
    if model.coupled:
        # At 0 V the branch that follows may be past its fold.
        margin = min(margin, float(fold_margin(model, float(dot(model.gap, state)), here, run.state.sign[0] or 1.0)))
    return Run(
        run.t, run.left, np.ascontiguousarray(live if len(stack.layers) > n else stack.grouping @ live),
        z if problem.charge else None,
        run.rows[:, n + 1].copy() if problem.charge else None,
        run.status, run.error, max(float(peak_u), float(run.peaks[0])), float(peak_f), run.nfev, run.stats,
        State(run.state.t, state, u_before, offset, problem.scene.charge_law, here),
        t_failed=run.t_failed, detail=run.detail, unseen=run.unseen and run.unseen[:2], margin=margin, tried=run.tried,
    )  # fmt: skip


def _probe(network: NetworkProblem) -> int:
    gap = network.network.gaps[0]
    return 0 if gap is None else gap
