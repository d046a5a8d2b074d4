"""The answers of `--json`: each command has the same keys for every circuit and every outcome (docs/json.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fingerspice import __version__

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit
    from fingerspice.results.plan import Plan
    from fingerspice.results.solution import Solution

Answer = dict[str, Any]
#: Keys of every answer.
COMMON = (
    *("version", "command", "success", "status", "message", "failure", "warnings", "files"),
    *("title", "overrides", "sets", "charge_law", "method", "rtol"),
)
#: Further keys of each command.
OWN: dict[str, tuple[str, ...]] = {
    "run": (
        "area",
        "tier",
        "t_stop",
        "figures_from",
        "error",
        "fundamental",
        "fold_margin_min",
        "signals",
        "feel",
        "stream",
    ),
    "ac": ("area", "skin", "sweeps"),
    "plan": ("area", "tier", "reasons", "start", "rates", "stiff", "sensitivity", "error_bound", "plan_area"),
    "compare": ("frequency", "gaps", "phasor", "transient_mean_area", "transient_coupled"),
    "limits": ("peak", "voltage", "sweeps", "capability"),
    "design": (
        *("kind", "rate", "samples", "carrier", "limit", "slew", "lead", "peak", "at_limit", "worst", "rms"),
        *("worst_share", "rms_share", "largest_wanted", "largest_reached", "corrections"),
    ),
    "fit": (
        "parameters",
        "correlation",
        "groups",
        "signal",
        "count",
        "residual_rms",
        "objective",
        "objectives",
        "notes",
        "profiles",
    ),
    "fit-contact": ("gap", "parameters", "correlation", "relations", "objective", "notes", "profiles"),
    "sweep": ("scenes", "failed", "n", "seed", "figures", "shares", "store"),
    "export": (),
    "figures": (),
    "explore": ("url",),
    "sets": ("parameter_sets",),
    "check": ("chunks",),
}
#: Figures of a signal; a figure that a signal lacks is null.
FIGURES = ("min", "max", "peak", "mean", "rms", "mean_periodic", "rms_periodic", "ripple", "amplitude", "phase_deg")
_UNITS = {"u_source": "V", "u_gap": "V", "u_layer": "V", "v": "V", "area": "m^2", "f_el": "N", "f_t": "N"}


def blank(command: str | None) -> Answer:
    """An answer with all its keys, before any result is known."""
    keys = (*COMMON, *OWN.get(command or "", ()))
    known = {"version": __version__, "command": command, "success": False}
    return {**dict.fromkeys(keys), "warnings": [], "files": [], "overrides": {}, "sets": [], **known}


def of_circuit(circuit: Circuit, charge_law: str | None) -> Answer:
    """The part of an answer that describes the circuit.

    Raises
    ------
    InputError
        If the charge law is unknown.
    """
    from fingerspice.circuit.circuit import CHARGE_LAWS
    from fingerspice.waveforms.waveform import require

    law = charge_law or circuit.charge_law or "local"
    require(law in CHARGE_LAWS, "charge_law", repr(law), " or ".join(map(repr, CHARGE_LAWS)))
    known = {"title": circuit.title, "overrides": dict(circuit.overrides), "sets": list(circuit.sets)}
    return {**known, "charge_law": law}


def of_run(solution: Solution) -> Answer:
    """The part of an answer that describes a run: its method and error, and figures of every signal in SI units."""
    s = solution.summary()
    names = [key.removesuffix("_peak") for key in s if key.endswith("_peak")]
    return {
        "charge_law": solution.charge_law,
        "method": solution.method,
        "area": solution.area_mode,
        "tier": solution.plan.tier,
        "t_stop": s["t_stop"],
        "figures_from": s.get("figures_from"),
        "error": vars(solution.error),
        "fundamental": s.get("fundamental"),
        "fold_margin_min": s.get("fold_margin_min"),
        "signals": [_row(solution, name, s) for name in names],
    }


def of_plan(plan: Plan) -> Answer:
    """The part of an answer that describes a plan; `plan_area` is the area of a model with one area."""
    found = plan.to_dict()
    return {**{key: found[key] for key in OWN["plan"] if key in found and key != "area"}, "plan_area": plan.area}


def _row(solution: Solution, name: str, summary: dict[str, Any]) -> Answer:
    signal, _, element = name.partition(":")
    if not element and signal in ("u_gap", "area", "f_el", "f_t", "friction") and len(solution.gaps) == 1:
        element = solution.gaps[0]
    figures = {figure: summary.get(f"{name}_{figure}") for figure in FIGURES}
    return {"signal": signal, "element": element or None, "unit": _UNITS.get(signal, "1"), **figures}
