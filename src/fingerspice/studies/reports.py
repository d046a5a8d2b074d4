"""Pages and tables of the studies: periodic states, comparisons, folds and fitted materials."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.describe import head_lines
from fingerspice.results.outcome import SolveError
from fingerspice.results.report import summary_table

if TYPE_CHECKING:
    from fingerspice.studies.comparison import Comparison
    from fingerspice.studies.fitting import MaterialFit
    from fingerspice.studies.limits import FoldLimits
    from fingerspice.studies.steady import SteadyState


def steady_page(state: SteadyState) -> Page:
    """A periodic state: its defect and stability, and the figures of its period."""
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
    """A fitted ladder: its branches, and its misfit to the data."""
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


def comparison_table(comparison: Comparison) -> Page:
    """A comparison as a table, with its result in words."""
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
        # Round before formatting, and add 0.0, so that -0.00 is not printed.
        total = round(100.0 * (coupled / reference - 1.0), 2) + 0.0
        waveform = round(100.0 * (mean / reference - 1.0), 2) + 0.0
        said.append(
            f"mean force{f' of {gap}' if len(comparison.gaps) > 1 else ''}: {total:+.2f} % against the phasor; "
            f"{total - waveform:+.2f} % of that is the ripple of the area, {waveform:+.2f} % is the waveform's (zero "
            "for a sine)"
        )
    return Page(
        [
            *head_lines(comparison.solution.circuit),
            f"periodic state at {format_si(comparison.frequency, 'Hz')}, charge law {comparison.solution.charge_law}",
            "",
            Table(head, rows),
            "",
            *said,
        ]
    )


def limits_text(limits: FoldLimits) -> Page:
    """A map of the mobile law's fold: a sentence, and a table for each parameter."""
    own = format_si(limits.peak, "V")
    if math.isfinite(limits.voltage):
        head = (
            f"under the mobile law this deck folds at {format_si(limits.voltage, 'V')} peak; its source reaches {own}, "
            f"{100.0 * limits.peak / limits.voltage:.3g} % of that"
        )
    else:
        head = f"under the mobile law this deck does not fold; its source reaches {own}"
    lines: list[str | Table] = [*head_lines(limits.circuit), head]
    for sweep in limits.sweeps:
        rows = [
            (format_si(x, sweep.unit), format_si(u, "V") if math.isfinite(u) else "none")
            for x, u in zip(sweep.values.tolist(), sweep.voltages.tolist(), strict=True)
        ]
        lines += ["", Table((sweep.name, "folds at"), rows)]
    return Page(lines)


def limits_csv(limits: FoldLimits, path: Path) -> Path:
    """Write a map of the fold as CSV; a row without a fold has an empty voltage."""
    rows = [
        (sweep.name, x, sweep.unit, u if math.isfinite(u) else "")
        for sweep in limits.sweeps
        for x, u in zip(sweep.values.tolist(), sweep.voltages.tolist(), strict=True)
    ]
    return write_csv(path, ("parameter", "value [SI]", "unit", "fold [V]"), rows)
