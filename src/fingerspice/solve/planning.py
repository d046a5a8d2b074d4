"""Which model a scene needs, and why: the lightest that is right for what is asked."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.errors import InputError
from fingerspice.numerics.modes import modes
from fingerspice.physics.contact import areas
from fingerspice.results.plan import Plan
from fingerspice.solve.networks import NetworkProblem
from fingerspice.solve.problem import Problem
from fingerspice.solve.settling import FEWEST_PERIODS

FloatArray = NDArray[np.float64]

TIERS = ("algebraic", "linear", "coupled")
# A frozen stack this many times faster than its source would hold an explicit method back by stability alone.
STIFF = 300.0
REPEATS = "periodic: once a period no longer changes the state, later ones repeat it"


def make_plan(problem: Problem, rtol: float, tier: str = "auto", start: str = "deck") -> Plan:
    """Choose the model for a problem.

    Parameters
    ----------
    problem : Problem
    rtol : float
        Error asked for.
    tier : str
        ``"auto"``, or the tier to force.
    start : str
        How the run starts.

    Raises
    ------
    InputError
        For an unknown tier, or one that cannot describe the circuit at all.
    """
    if tier not in ("auto", *TIERS):
        raise InputError(f"unknown tier {tier!r}; allowed: auto, {', '.join(TIERS)}")
    key = ("plan", rtol, tier, start, problem.charge, bool(np.any(problem.initial.y[:-1])))
    if key not in problem.scene.prepared:
        problem.scene.prepared[key] = _choose(problem, rtol, tier, start)
    plan: Plan = problem.scene.prepared[key]
    return plan


def plan_network(problem: NetworkProblem, tier: str = "auto", start: str = "deck") -> Plan:
    """The model for a network: closed form where its areas are fixed, else stepped.

    Beside other capacitors an area that changes by little may still do much to the voltages, over many periods; of that
    no bound is known beforehand that is any use, so it is stepped however little the area changes.

    Raises
    ------
    InputError
        For an unknown tier, or one that cannot describe the circuit.
    """
    if tier not in ("auto", *TIERS):
        raise InputError(f"unknown tier {tier!r}; allowed: auto, {', '.join(TIERS)}")
    scene = problem.scene
    best = "coupled" if scene.coupled else "linear"
    if tier == "algebraic" or (tier == "linear" and scene.coupled):
        raise InputError(f"the {tier} tier is not for this network; allowed: auto, {best} or coupled")
    sensitivity, reason = _area_of_network(problem)
    rates = scene.modes.rates
    shortest = min(problem.waveform.shortest_time(), problem.t_stop - problem.t_start)
    stiff = float(rates.max(initial=0.0)) * shortest > STIFF
    chosen = best if tier == "auto" else tier
    if chosen != best:
        reason = f"asked for; the lightest that is right would be {best}: {reason}"
    reasons: tuple[str, ...] = (reason,)
    period = problem.waveform.period
    if scene.coupled and period and (problem.t_stop - problem.t_start) / period >= FEWEST_PERIODS:
        reasons = (reason, REPEATS)
    area = float(scene.area0[0]) if scene.area0.size else math.nan
    return Plan(chosen, reasons, start, tuple(sorted(map(float, rates))), stiff, sensitivity, 0.0, area)


def _area_of_network(problem: NetworkProblem) -> tuple[float, str]:
    """Largest relative change of 1/A of any finger over the run, as `_sensitivity`, and what it means for the model.

    NaN where a current source sets no bound to the voltages.
    """
    scene, network = problem.scene, problem.network
    if not network.areas:
        return 0.0, "no element has an area, so the circuit is linear"
    if not scene.coupled:
        return 0.0, f"the areas are {scene.area_mode}, so the circuit is linear"
    several = len(network.fingers) > 1
    follows = f"a network whose area{'s follow' if several else ' follows'} the gap voltage"
    if len(network.sources) > network.n_voltage:
        return math.nan, f"{follows}; by how much is not known beforehand: a current source sets no bound"
    curves = [scene.net.curves[i] for i in np.flatnonzero(scene.net.gap >= 0)]
    largest = max(_change(curve, scene.u_peak)[0] for curve in curves)
    return largest, f"{follows}, {'each' if several else ''} by up to {100.0 * largest:.2g} % of its middle"


def _choose(problem: Problem, rtol: float, tier: str, start: str) -> Plan:
    stack, model = problem.stack, problem.model
    leaking = stack.layers_of(stack.g_total + stack.g_area > 0.0)
    sensitivity, area = _sensitivity(problem)
    best, reasons = _lightest(problem, rtol, leaking, sensitivity)
    if tier == "algebraic" and best != "algebraic":
        what = f"a stack without leaks; here {', '.join(leaking)} leak"
        raise InputError(f"the algebraic tier needs {what if leaking else 'a start without stored charge'}")
    if tier == "linear" and model.coupled and (model.mobile or problem.charge):
        what = "the mobile law" if model.mobile else "the charge (charge=False leaves it out)"
        raise InputError(f"the linear tier takes the area as fixed, and {what} needs the one that follows the voltage")
    if tier != "auto" and tier != best:
        reasons = (f"asked for; the lightest that is right would be {best}: {reasons[0]}",)
    chosen = best if tier == "auto" else tier
    rates, _, _, _ = modes(np.ascontiguousarray(model.rate + model.rate0 / model.area0), model.k)
    fastest = float(rates.max(initial=0.0))
    shortest = min(problem.waveform.shortest_time(), problem.t_stop - problem.t_start)
    stiff = fastest * shortest > STIFF
    if stiff:
        reasons = (
            *reasons,
            f"stiff: the fastest rate {fastest:.3g} 1/s against {1.0 / shortest:.3g} 1/s of the source",
        )
    period = problem.waveform.period
    if chosen == "coupled" and period and (problem.t_stop - problem.t_start) / period >= FEWEST_PERIODS:
        reasons = (*reasons, REPEATS)
    needed = sensitivity if chosen == "linear" and model.coupled and np.any(model.rate0 > 0.0) else 0.0
    skin = problem.scene.skin
    if skin is not None:
        reasons = (*reasons, f"skin at {skin.frequency:g} Hz: its dispersion moves the gap voltage by {skin.error:.1g}")
        needed += skin.error
    elif problem.circuit.by_device("SKIN_DISPERSIVE"):
        reasons = (*reasons, f"skin dispersive: no one frequency serves to rtol = {rtol:g}")
    return Plan(chosen, reasons, start, tuple(sorted(map(float, rates))), stiff, sensitivity, needed, area)


def _lightest(problem: Problem, rtol: float, leaking: list[str], sensitivity: float) -> tuple[str, tuple[str, ...]]:
    model = problem.model
    stored = model.mobile and model.coupled and bool(np.any(problem.initial.y[:-1]))
    if not leaking and not stored:
        return "algebraic", ("no layer leaks, so the voltages follow the source at once",)
    if not model.coupled:
        return "linear", (f"the area is {problem.scene.area_mode}, so the circuit is linear",)
    if not model.mobile:
        free = not np.any(model.rate0 > 0.0)
        if free and not problem.charge:
            return "linear", ("every leak scales with the area, so under the local law no voltage feels it",)
        if sensitivity <= 0.2 * rtol and not problem.charge:
            return "linear", (f"the area changes the leaks by {sensitivity:.2g} at most, against rtol = {rtol:g}",)
        if free or sensitivity <= 0.2 * rtol:
            return "coupled", ("only the charge needs the area at every instant; charge=False leaves it out",)
    return "coupled", (f"the area follows the voltage and moves the leaks by up to {100.0 * sensitivity:.2g} %",)


def _sensitivity(problem: Problem) -> tuple[float, float]:
    """Largest relative change of 1/A over the run's voltages, from the area in the middle, and that area (m^2)."""
    model = problem.model
    if not model.coupled:
        return 0.0, model.area0
    return _change(model.curve, problem.scene.u_peak)


def _change(curve: FloatArray, u_peak: float) -> tuple[float, float]:
    """The same of one area curve under sources of that peak (V)."""
    # A gap may take all of the voltage, and as much again where charge is stored when the source turns.
    u = np.linspace(0.0, 2.0 * u_peak, 65)
    a = areas(u, curve)
    middle = 2.0 / (1.0 / a.min() + 1.0 / a.max())
    return float(max(a.max() / middle, middle / a.min()) - 1.0), float(middle)
