"""Tables and data files for people: what the command line prints."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.errors import SolveError
from fingerspice.base.files import write_aside
from fingerspice.base.pages import Page, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.describe import drive_text, heading, waveform_text

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit
    from fingerspice.results.phasor_solution import PhasorSolution
    from fingerspice.results.plan import Plan
    from fingerspice.results.solution import Solution
    from fingerspice.studies.comparison import Comparison
    from fingerspice.studies.fitting import MaterialFit
    from fingerspice.studies.limits import FoldLimits
    from fingerspice.studies.steady import SteadyState

#: Elements of a circuit that are listed.
MOST_ELEMENTS = 25


def _value(value: float | None, unit: str, factor: float = 1.0, peak: float = 0.0) -> str:
    if value is None:
        return "-"
    # Rounding of a mean that is zero would otherwise read as a figure.
    value = 0.0 if abs(value) <= 1e-12 * peak else value
    if unit in ("mm^2", "", "deg"):
        return f"{value * factor:.4g} {unit}".rstrip()
    return format_si(value * factor, unit)


def summary_table(solution: Solution) -> Page:
    """The figures of a run as a table."""
    s = solution.summary()
    out: list[str | Table] = [heading(solution.circuit), *_driven(solution.circuit), _scene(solution), ""]
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
            # Several gaps or sources have a row each.
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
            out.append("last period: the mean over it, and so are rms and ripple (max - min)")
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
    if solution.u_gap is None:
        inside = "layer" if solution.layers else "capacitor"
        out.append(f"no GAP, no forces; estimated error: {inside} voltage {solution.error.u_gap:.2g} V")
    else:
        out.append(f"estimated error: gap voltage {solution.error.u_gap:.2g} V, force {solution.error.f_el:.2g} N")
    if s.get("figures_from") == "outputs":
        out.append("figures are those of the outputs: what lies between them is not known")
    if solution.charge_law == "mobile" and "fold_margin_min" in s:
        out.append(f"distance to the fold: {s['fold_margin_min']:.3g} at least (1 far, 0 at the fold)")
    out.append(f"status: {solution.message}")
    if solution.failure is not None and solution.failure.tried:
        out += ["", "last steps tried:", solution.failure.history()]
    return Page(out)


def _driven(circuit: Circuit) -> list[str]:
    drive = drive_text(circuit)
    return [drive] if drive else []


def _scene(solution: Solution) -> str:
    end = format_si(float(solution.t[-1]), "s") if solution.t.size else "nothing"
    return (
        f"{end} simulated; charge law {solution.charge_law}, area {solution.area_mode}, method {solution.method}, "
        f"rtol {solution.rtol:g}"
    )


def circuit_page(circuit: Circuit) -> Page:
    """What a circuit is made of, and what its deck asks for."""
    rows = []
    for element in circuit.elements[:MOST_ELEMENTS]:
        said = [f"{name}={_deck_value(value)}" for name, value in element.values.items() if math.isfinite(value)]
        if element.waveform is not None:
            said.append(waveform_text(element.waveform, "A" if element.device == "I" else "V"))
        rows.append((element.name, element.device, " ".join(element.node_names), _cut(" ".join(said), 96)))
    lines: list[str | Table] = [heading(circuit), ""]
    lines.append(Table(("", "device", "nodes", "values, in the units of the netlist"), rows, left=4))
    if len(circuit.elements) > MOST_ELEMENTS:
        lines.append(f"... and {len(circuit.elements) - MOST_ELEMENTS} more elements")
    lines.append("")
    if circuit.tran is not None:
        since = f" from {format_si(circuit.tran.start, 's')} on" if circuit.tran.start else ""
        lines.append(
            f".tran: {format_si(circuit.tran.stop, 's')}, an output every {format_si(circuit.tran.step, 's')}{since}"
        )
    if circuit.ac is not None:
        lines.append(f".ac: {format_si(circuit.ac.start, 'Hz')} to {format_si(circuit.ac.stop, 'Hz')}")
    lines.append(f"charge law: {circuit.charge_law or 'local (the deck names none)'}")
    return Page(lines)


def _deck_value(value: float) -> str:
    """A number as a deck has it: ``3.5u``, ``0.2meg``, ``0.3``."""
    if 0.01 <= abs(value) < 1e4:
        return f"{value:.4g}"
    text = format_si(value, "").replace(" ", "")
    # SPICE reads M as milli, and knows no P and E.
    return f"{text[:-1]}meg" if text.endswith("M") else f"{value:.4g}" if text[-1:] in "PEZY" else text


def _cut(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest - 4]} ..."


def steady_page(state: SteadyState) -> Page:
    """A periodic state: what vouches for it, and the figures of its period."""
    largest = 1.0 - state.stability_margin
    found = f"periodic state of {format_si(state.period, 's')}, found in {state.periods:.3g} periods"
    left = (
        f"a further period changes the voltages by {state.defect:.2g} V at most, and leaves {100.0 * largest:.3g} % of "
        "a small disturbance"
    )
    try:
        period = summary_table(state.solution).blocks
    except SolveError as error:
        period = (error.message,)
    return Page([found, left, "", *period])


def fit_page(fit: MaterialFit) -> Page:
    """A fitted ladder: its branches, and how far it is from the data."""
    ladder = fit.ladder
    rows = [
        (format_si(p / (2.0 * math.pi), "Hz"), f"{k:.4g} S/m")
        for p, k in zip(ladder.poles, ladder.weights, strict=True)
    ]
    f = fit.frequency
    return Page(
        [
            f"material fitted at {f.size} frequencies from {format_si(float(f[0]), 'Hz')} to "
            f"{format_si(float(f[-1]), 'Hz')}",
            f"misfit of the admittivity: {100.0 * fit.rms:.2g} % rms, {100.0 * fit.largest:.2g} % at most",
            f"no causal and passive material comes nearer than {100.0 * fit.kramers_kronig.rms:.2g} % rms",
            "",
            f"{ladder.conductivity:.4g} S/m at zero frequency, eps_r = {ladder.eps_inf:.4g} above all poles, and",
            Table(("pole", "weight"), rows),
        ]
    )


def plan_text(plan: Plan, circuit: Circuit | None = None) -> Page:
    """A plan in words, under the heading of its circuit where that is given."""
    rates = ", ".join(f"{r:.4g}" for r in plan.rates) or "none"
    head: list[str | Table] = [] if circuit is None else [heading(circuit), *_driven(circuit), ""]
    lines = [*head, f"model: {plan.tier}", *(f"  because {r}" for r in plan.reasons)]
    lines.append(f"rates, area frozen: {rates} 1/s ({'' if plan.stiff else 'not '}stiff for this source)")
    if not math.isnan(plan.sensitivity):
        lines.append(f"the area differs from its middle by at most {100.0 * plan.sensitivity:.3g} %")
    return Page(lines)


def comparison_table(comparison: Comparison) -> Page:
    """A comparison as a table, with what it says in words."""
    names = {
        "amplitude": "gap voltage amplitude",
        "phase_deg": "lead over the source",
        "f_el_mean": "mean force",
        "area_mean": "mean area",
    }
    rows = []
    for row in comparison.rows():
        name, _, gap = row[0].partition(":")
        rows.append((f"{names[name]} {gap}".rstrip() + f" [{row[1]}]", *(f"{x:.6g}" for x in row[2:])))
    head = ("", "phasor", "transient, mean area", "transient, coupled", "coupled - phasor", "of it, ripple")
    said = []
    for i, gap in enumerate(comparison.gaps):
        figures = comparison.phasor, comparison.mean, comparison.coupled
        reference, mean, coupled = (f.of_gap(i)["f_el_mean"] for f in figures)
        # Rounded here, and 0.0 added: -0.00 is not a figure.
        total = round(100.0 * (coupled / reference - 1.0), 2) + 0.0
        waveform = round(100.0 * (mean / reference - 1.0), 2) + 0.0
        said.append(
            f"mean force{f' of {gap}' if len(comparison.gaps) > 1 else ''}: {total:+.2f} % against the phasor; "
            f"{total - waveform:+.2f} % of that is the ripple of the area, {waveform:+.2f} % is the waveform's (zero "
            "for a sine)"
        )
    return Page(
        [
            heading(comparison.solution.circuit),
            *_driven(comparison.solution.circuit),
            f"periodic state at {format_si(comparison.frequency, 'Hz')}, charge law {comparison.solution.charge_law}",
            "",
            Table(head, rows),
            "",
            *said,
        ]
    )


def limits_text(limits: FoldLimits) -> Page:
    """Where the mobile law folds, in words and a table per parameter."""
    own = format_si(limits.peak, "V")
    if math.isfinite(limits.voltage):
        head = (
            f"under the mobile law this deck folds at {format_si(limits.voltage, 'V')} peak; its source reaches {own}, "
            f"{100.0 * limits.peak / limits.voltage:.3g} % of that"
        )
    else:
        head = f"under the mobile law this deck does not fold; its source reaches {own}"
    lines: list[str | Table] = [heading(limits.circuit), *_driven(limits.circuit), head]
    for sweep in limits.sweeps:
        rows = [
            (format_si(x, sweep.unit), format_si(u, "V") if math.isfinite(u) else "none")
            for x, u in zip(sweep.values.tolist(), sweep.voltages.tolist(), strict=True)
        ]
        lines += ["", Table((sweep.name, "folds at"), rows)]
    return Page(lines)


def limits_csv(limits: FoldLimits, path: Path) -> Path:
    """Write a map of the fold as CSV; no voltage where there is no fold."""

    def write(target: Path) -> None:
        with target.open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["parameter", "value [SI]", "unit", "fold [V]"])
            for sweep in limits.sweeps:
                for x, u in zip(sweep.values.tolist(), sweep.voltages.tolist(), strict=True):
                    writer.writerow([sweep.name, repr(x), sweep.unit, repr(u) if math.isfinite(u) else ""])

    return write_aside(path, write)


def phasor_dict(result: PhasorSolution) -> dict[str, Any]:
    """A sweep as plain data, SI units."""
    return {
        "frequency": result.frequency.tolist(),
        "gain": np.abs(result.gain).tolist(),
        "phase_deg": np.degrees(np.angle(result.gain)).tolist(),
        "u_gap": np.abs(result.u_gap).tolist(),
        "area": result.area.tolist(),
        "f_el_mean": result.f_el_mean.tolist(),
        "amplitude": result.amplitude,
        "source_phase_deg": math.degrees(result.phase),
        "drive": result.drive,
        "notes": list(result.notes),
        "warnings": list(result.warnings),
    }


def phasor_tables(results: Sequence[PhasorSolution], circuit: Circuit) -> str:
    """Sweeps of a circuit at several amplitudes as tables."""
    return "\n\n".join([heading(circuit), *(phasor_table(r) for r in results)])


def phasor_table(result: PhasorSolution, most: int = 40) -> Page:
    """A sweep as a table, thinned to about `most` rows."""
    data = phasor_dict(result)
    keep = range(0, result.frequency.size, max(1, -(-result.frequency.size // most)))
    rows = [
        (
            f"{data['frequency'][i]:.6g}",
            f"{data['gain'][i]:.5f}",
            f"{data['phase_deg'][i]:.3f}",
            f"{data['u_gap'][i]:.5g}",
            f"{1e6 * data['area'][i]:.5g}",
            f"{data['f_el_mean'][i]:.5g}",
        )
        for i in keep
    ]
    head = ("frequency [Hz]", "|u_gap/U|", "phase [deg]", "u_gap [V]", "area [mm^2]", "mean force [N]")
    drive = f"source amplitude {format_si(result.amplitude, 'V')}, phase {math.degrees(result.phase):.4g} deg"
    said = [f"{drive}: {result.drive}", *result.notes]
    return Page([*said, Table(head, rows)])


def phasor_csv(results: Sequence[PhasorSolution], path: Path) -> Path:
    """Write sweeps as CSV, one after the other where there are several amplitudes."""
    columns = ("frequency", "gain", "phase_deg", "u_gap", "area", "f_el_mean")
    units = ("Hz", "1", "deg", "V", "m^2", "N")

    def write(target: Path) -> None:
        with target.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            head = [f"{c} [{u}]" for c, u in zip(columns, units, strict=True)]
            writer.writerow([*head, "amplitude [V]"])
            for result in results:
                data = phasor_dict(result)
                for row in zip(*(data[c] for c in columns), strict=True):
                    writer.writerow([*map(repr, row), repr(result.amplitude)])

    return write_aside(path, write)
