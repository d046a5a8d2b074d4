"""Choice of the model for a scene: the lightest tier whose error is below the error asked for, and the reasons."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.units import format_si
from fingerspice.engine.model import Model
from fingerspice.physics.contact import inverse_area_range
from fingerspice.results.outcome import Plan
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import kept_with
from fingerspice.solve.sources import shortest_event
from fingerspice.solve.stepping import FEWEST_PERIODS

# Number of plans cached with a scene.
MOST_PLANS = 16
TIERS = ("algebraic", "linear", "coupled")
# A scene is called stiff if its fastest rate times the source's shortest time exceeds this: stability alone would then
# limit the steps of an explicit method.
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
        Start of the run, as given to `simulate`; it is copied into the plan.

    Raises
    ------
    InputError
        For an unknown tier, or a tier that cannot describe the circuit.
    """
    if tier not in ("auto", *TIERS):
        raise InputError(f"unknown tier {tier!r}; allowed: auto, {', '.join(TIERS)}")
    key = ("plan", rtol, tier, start, problem.charge, _stores(problem), problem.t_start, problem.t_stop)
    plan: Plan = kept_with(problem.scene.prepared, key, MOST_PLANS, lambda: _plan(problem, rtol, tier, start))
    return plan


@dataclass(frozen=True)
class _Choice:
    """The lightest valid tier and its reason; the largest relative change of 1/A, and the area it refers to (m^2)."""

    tier: str
    reason: str
    sensitivity: float
    area: float


def _plan(problem: Problem, rtol: float, tier: str, start: str) -> Plan:
    scene, span = problem.scene, problem.t_stop - problem.t_start
    best = _of_network(problem) if scene.model is None else _of_stack(problem, scene.model, rtol)
    chosen, reason = (best.tier, best.reason) if tier == "auto" else (tier, best.reason)
    if chosen != best.tier:
        _refuse(problem, chosen, best.tier)
        reason = f"asked for; the lightest that is right would be {best.tier}: {reason}"
    rates, shortest = scene.rates, min(problem.waveform.shortest_time(), span)
    fastest = float(rates.max(initial=0.0))
    reasons, stiff, needed = [reason], fastest * shortest > STIFF, 0.0
    if stiff:
        reasons.append(f"stiff: the fastest rate {fastest:.3g} 1/s against {1.0 / shortest:.3g} 1/s of the source")
    if chosen == "coupled" and scene.coupled and problem.waveform.period:
        reasons += [REPEATS] if span / problem.waveform.period >= FEWEST_PERIODS else []
    if chosen == "linear" and scene.model is not None and scene.coupled and np.any(scene.model.rate0 > 0.0):
        needed = best.sensitivity
    if scene.skin is not None:
        f, error = scene.skin.frequency, scene.skin.error
        reasons.append(f"skin at {f:g} Hz: its dispersion moves the gap voltage by {error:.1g}")
        needed += error
    elif scene.stack is not None and problem.circuit.by_device("SKIN_DISPERSIVE"):
        reasons.append(f"skin dispersive: no one frequency serves to rtol = {rtol:g}")
    if scene.is_sampled:
        event = format_si(shortest_event(problem), "s")
        reasons.append(f"a source is a function: an event in it shorter than {event} may be missed without breaks=")
    found = tuple(sorted(map(float, rates)))
    return Plan(chosen, tuple(reasons), start, found, stiff, best.sensitivity, needed, best.area)


def _refuse(problem: Problem, tier: str, best: str) -> None:
    """Refuse a tier that cannot describe the circuit.

    Raises
    ------
    InputError
    """
    stack, mobile = problem.scene.stack, problem.scene.charge_law == "mobile"
    if stack is None and tier != "coupled":
        raise InputError(f"the {tier} tier is not for this network; allowed: auto, {best} or coupled")
    if stack is not None and tier == "algebraic":
        leaking = stack.layers_of(stack.g_total + stack.g_area > 0.0)
        what = f"a stack without leaks; here {', '.join(leaking)} leak"
        raise InputError(f"the algebraic tier needs {what if leaking else 'a start without stored charge'}")
    if tier == "linear" and problem.scene.coupled and (mobile or problem.charge):
        what = "the mobile law" if mobile else "the charge (charge=False leaves it out)"
        raise InputError(f"the linear tier takes the area as fixed, and {what} needs the one that follows the voltage")


def _stores(problem: Problem) -> bool:
    """Whether a stack starts with charge on the interfaces between its layers."""
    return problem.scene.stack is not None and bool(np.any(problem.inner.y[:-1]))


def _of_network(problem: Problem) -> _Choice:
    """The tier of a network: linear where its areas are fixed, else coupled.

    With capacitors outside the layers, a small change of an area may have a large effect on the voltages over many
    periods. No useful bound of that effect is known beforehand: a network is coupled however little its areas change.
    """
    scene, network = problem.scene, problem.network
    area = float(scene.area0[0]) if network.areas else math.nan
    if not scene.coupled:
        which = f"the areas are {scene.area_mode}" if network.areas else "no element has an area"
        return _Choice("linear", f"{which}, so the circuit is linear", 0.0, area)
    several = len(network.fingers) > 1
    follows = f"a network whose area{'s follow' if several else ' follows'} the gap voltage"
    if len(network.sources) > network.n_voltage:
        reason = f"{follows}; by how much is not known beforehand: a current source sets no bound"
        return _Choice("coupled", reason, math.nan, area)
    largest = max(_change(curve, scene.u_peak)[0] for curve in scene.net.curves[scene.net.gap >= 0])
    reason = f"{follows}, {'each ' if several else ''}by up to {_percent(largest)} of its middle"
    return _Choice("coupled", reason, largest, area)


def _of_stack(problem: Problem, model: Model, rtol: float) -> _Choice:
    """The tier of a stack: the lightest of all three that is valid."""
    scene = problem.scene
    changed, area = _change(model.curve, scene.u_peak) if model.coupled else (0.0, model.area0)
    if not np.any((model.rate > 0.0) | (model.rate0 > 0.0)) and not (
        model.mobile and model.coupled and _stores(problem)
    ):
        return _Choice("algebraic", "no layer leaks, so the voltages follow the source at once", changed, area)
    if not model.coupled:
        return _Choice("linear", f"the area is {scene.area_mode}, so the circuit is linear", changed, area)
    free, little = not np.any(model.rate0 > 0.0), changed <= 0.2 * rtol
    reason = f"the area follows the voltage and moves the leaks by up to {_percent(changed)}"
    if not model.mobile and (free or little):
        reason = "only the charge needs the area at every instant; charge=False leaves it out"
        if not problem.charge and free:
            reason = "every leak scales with the area, so under the local law no voltage feels it"
        elif not problem.charge:
            reason = f"the area changes the leaks by {changed:.2g} at most, against rtol = {rtol:g}"
    tier = "linear" if not (model.mobile or problem.charge) and (free or little) else "coupled"
    return _Choice(tier, reason, changed, area)


def _percent(share: float) -> str:
    """A share in percent to two digits, without an exponent where it has three."""
    return f"{float(f'{100.0 * share:.2g}'):g} %"


def _change(curve: FloatArray, u_peak: float) -> tuple[float, float]:
    """Largest relative change of 1/A under sources with peak `u_peak` (V) from its middle value, and its area (m^2)."""
    # The gap may hold the whole source voltage, and up to twice that if stored charge adds to a reversed source.
    least, largest = inverse_area_range(2.0 * u_peak, 65, curve)
    middle = 0.5 * (least + largest)
    return max(middle / least, largest / middle) - 1.0, 1.0 / middle
