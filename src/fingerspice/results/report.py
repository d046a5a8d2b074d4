"""Summaries, plans and phasor sweeps as text and tables, as the command line prints them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.describe import head_lines, heading

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit
    from fingerspice.results.outcome import Plan
    from fingerspice.results.phasor_solution import PhasorSolution
    from fingerspice.results.solution import Solution


def _value(value: float | None, unit: str, factor: float = 1.0, peak: float = 0.0) -> str:
    if value is None:
        return "-"
    # A mean that is 0 to round-off is written as 0.
    value = 0.0 if abs(value) <= 1e-12 * peak else value
    if unit in ("mm^2", "", "deg"):
        return f"{value * factor:.4g} {unit}".rstrip()
    return format_si(value * factor, unit)


def summary_table(solution: Solution) -> Page:
    """The figures of a run as a table."""
    s = solution.summary()
    out: list[str | Table] = [*head_lines(solution.circuit), _scene(solution), ""]
    if solution.t.size >= 2:
        rows = []
        for key, label, unit, factor in (
            ("u_source", "source voltage", "V", 1.0),
            ("u_gap", "gap voltage", "V", 1.0),
            *((f"u_layer:{name}", f"{name} voltage", "V", 1.0) for name in solution.layers),
            *((f"v:{name}", f"node {name}", "V", 1.0) for name in solution.node_voltages),
            ("f_el", "electroadhesive force", "N", 1.0),
            ("f_t", "friction force", "N", 1.0),
            ("friction", "friction coefficient", "", 1.0),
            ("area", "ridge contact area", "mm^2", 1e6),
        ):
            # If there are several gaps or sources, each has its own row.
            for name in [
                n for n in (key, *(f"{key}:{e}" for e in (*solution.gaps, *solution.sources))) if f"{n}_max" in s
            ]:
                rows.append(
                    (
                        label if name == key else f"{label} {name.partition(':')[2]}",
                        *(
                            _value(s.get(f"{name}_{part}"), unit, factor, s[f"{name}_peak"])
                            for part in ("min", "max", "mean", "mean_periodic", "rms_periodic", "ripple")
                        ),
                    )
                )
        out.append(Table(("", "min", "max", "mean", "last period", "rms", "ripple"), rows))
        if any(s.get(f"{name}_mean_periodic") is not None for name in ("u_source", "f_el")):
            out.append("last period: the mean over it; rms and ripple (max - min) are those of the last period, too")
        if "u_gap_amplitude" in s:
            lead = s["u_gap_phase_deg"] - s["u_source_phase_deg"]
            lead = (lead + 180.0) % 360.0 - 180.0
            share = s["u_gap_amplitude"] / s["u_source_amplitude"] if s["u_source_amplitude"] else float("nan")
            out.append("")
            out.append(
                f"at {format_si(s['fundamental'], 'Hz')}: gap voltage {format_si(s['u_gap_amplitude'], 'V')}, "
                f"{100.0 * share:.2f} % of the source, leading by {lead:.2f} deg"
            )
    out.append("")
    nodes = "" if solution.error.v_nodes is None else f", node voltages {solution.error.v_nodes:.2g} V"
    if solution.u_gap is None:
        inside = "layer" if solution.layers else "capacitor"
        out.append(f"no GAP, no forces; estimated error: {inside} voltage {solution.error.u_gap:.2g} V{nodes}")
    else:
        force = f"force {solution.error.f_el:.2g} N"
        out.append(f"estimated error: gap voltage {solution.error.u_gap:.2g} V, {force}{nodes}")
    if s.get("figures_from") == "outputs":
        out.append("figures are those of the outputs: what lies between them is not known")
    if solution.charge_law == "mobile" and "fold_margin_min" in s:
        out.append(f"distance to the fold: {s['fold_margin_min']:.3g} at least (1 far, 0 at the fold)")
    out.append(f"status: {solution.message}")
    if solution.failure is not None and solution.failure.tried:
        out += ["", "last steps tried:", solution.failure.history()]
    return Page(out)


def _scene(solution: Solution) -> str:
    end = format_si(float(solution.t[-1]), "s") if solution.t.size else "nothing"
    return (
        f"{end} simulated; charge law {solution.charge_law}, area {solution.area_mode}, method {solution.method}, "
        f"rtol {solution.rtol:g}"
    )


def plan_text(plan: Plan, circuit: Circuit | None = None) -> Page:
    """A plan in words, below the heading of its circuit if that is given."""
    rates = ", ".join(f"{r:.4g}" for r in plan.rates) or "none"
    head = [] if circuit is None else [*head_lines(circuit), ""]
    lines: list[str | Table] = [*head, f"model: {plan.tier}", *(f"  because {r}" for r in plan.reasons)]
    lines.append(f"rates, area frozen: {rates} 1/s ({'' if plan.stiff else 'not '}stiff for this source)")
    if not math.isnan(plan.sensitivity):
        lines.append(f"the area differs from its middle by at most {100.0 * plan.sensitivity:.3g} %")
    return Page(lines)


def phasor_dict(result: PhasorSolution) -> dict[str, Any]:
    """A sweep as plain data, SI units."""
    own: dict[str, Any] = {
        "gain": np.abs(result.gain).tolist(),
        "phase_deg": np.degrees(np.angle(result.gain)).tolist(),
        "u_gap": np.abs(result.u_gap).tolist(),
        "area": result.area.tolist(),
        "f_el_mean": result.f_el_mean.tolist(),
    }
    if result.v_nodes is not None:
        amplitudes, phases = np.abs(result.v_nodes.T), np.degrees(np.angle(result.v_nodes.T))
        own = {f"v:{node}": v.tolist() for node, v in zip(result.nodes, amplitudes, strict=True)}
        own |= {f"phase_deg:{node}": phase.tolist() for node, phase in zip(result.nodes, phases, strict=True)}
    return {
        "frequency": result.frequency.tolist(),
        **own,
        "impedance": None if result.impedance is None else np.abs(result.impedance).tolist(),
        "impedance_phase_deg": None if result.impedance is None else np.degrees(np.angle(result.impedance)).tolist(),
        "amplitude": result.amplitude,
        "source_phase_deg": math.degrees(result.phase),
        "drive": result.drive,
        "notes": list(result.notes),
        "warnings": list(result.warnings),
    }


def phasor_tables(results: Sequence[PhasorSolution], circuit: Circuit) -> str:
    """Sweeps of a circuit at several amplitudes as tables."""
    return "\n\n".join([heading(circuit), *(phasor_table(r) for r in results)])


#: Columns of a sweep: the key of `phasor_dict`, its unit, and heading, factor and format in a table.
_Column: TypeAlias = tuple[str, str, str, float, str]
_GAP_COLUMNS: tuple[_Column, ...] = (
    ("gain", "1", "|u_gap/U|", 1.0, ".5f"),
    ("phase_deg", "deg", "phase [deg]", 1.0, ".3f"),
    ("u_gap", "V", "u_gap [V]", 1.0, ".5g"),
    ("area", "m^2", "area [mm^2]", 1e6, ".5g"),
    ("f_el_mean", "N", "mean force [N]", 1.0, ".5g"),
)
_IMPEDANCE_COLUMNS: tuple[_Column, ...] = (
    ("impedance", "ohm", "|Z| [ohm]", 1.0, ".5g"),
    ("impedance_phase_deg", "deg", "phase of Z [deg]", 1.0, ".3f"),
)


def _columns(result: PhasorSolution) -> list[_Column]:
    """Columns of a sweep; the amplitude, without heading, only belongs into files."""
    out: list[_Column] = [("frequency", "Hz", "frequency [Hz]", 1.0, ".6g")]
    for node in result.nodes:
        out.append((f"v:{node}", "V", f"|v({node})| [V]", 1.0, ".5g"))
        out.append((f"phase_deg:{node}", "deg", "phase [deg]", 1.0, ".3f"))
    out.extend(() if result.nodes else _GAP_COLUMNS)
    out.append(("amplitude", "V", "", 1.0, ""))
    return [*out, *(() if result.impedance is None else _IMPEDANCE_COLUMNS)]


def phasor_table(result: PhasorSolution, most: int = 40) -> Page:
    """A sweep as a table; of a long one, only every n-th row, so that at most `most` rows remain."""
    data = phasor_dict(result)
    keep = range(0, result.frequency.size, max(1, -(-result.frequency.size // most)))
    columns = [column for column in _columns(result) if column[2]]
    head = tuple(heading for _, _, heading, *_ in columns)
    rows = [tuple(f"{factor * data[key][i]:{form}}" for key, _, _, factor, form in columns) for i in keep]
    drive = f"source amplitude {format_si(result.amplitude, 'V')}, phase {math.degrees(result.phase):.4g} deg"
    said = [f"{drive}: {result.drive}", *result.notes]
    return Page([*said, Table(head, rows)])


def phasor_csv(results: Sequence[PhasorSolution], path: Path) -> Path:
    """Write sweeps as CSV, one after the other where there are several amplitudes."""
    units = {key: unit for key, unit, *_ in _columns(results[0])}
    rows: list[tuple[object, ...]] = []
    for result in results:
        data = phasor_dict(result) | {"amplitude": [result.amplitude] * result.frequency.size}
        rows += zip(*(data[name] for name in units), strict=True)
    return write_csv(path, [f"{name} [{unit}]" for name, unit in units.items()], rows)
