"""The page of a run: its figures as a table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fingerspice.base.pages import Page, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.describe import head_lines
from fingerspice.results.signals import signal_of

if TYPE_CHECKING:
    from fingerspice.results.solution import Solution


#: Signals that have rows, in their order.
_ROWS = ("u_source", "u_gap", "u_layer", "v", "f_el", "f_t", "friction", "area")
#: Columns of figures: heading and key.
_COLUMNS = {
    "min": "min", "max": "max", "mean": "mean", "last period": "mean_periodic", "rms": "rms_periodic",
    "ripple": "ripple",
}  # fmt: skip


def summary_table(solution: Solution) -> Page:
    """The figures of a run as a table."""
    s = solution.summary()
    end = format_si(float(solution.t[-1]), "s") if solution.t.size else "nothing"
    out: list[str | Table] = [
        *head_lines(solution.circuit),
        f"{end} simulated; charge law {solution.charge_law}, area {solution.area_mode}, method {solution.method}, "
        f"rtol {solution.rtol:g}",
        "",
    ]
    if solution.t.size >= 2:
        names = [name for key in _ROWS for name in solution.record.names(key) if f"{name}_max" in s]
        out.append(Table(("", *_COLUMNS), [_row(name, s) for name in names]))
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
    return Page([*out, "", *_end(solution, s)])


def _row(name: str, s: dict[str, Any]) -> tuple[str, ...]:
    """Name and figures of a signal."""
    key, _, element = name.partition(":")
    signal = signal_of(name)
    label = {"u_layer": f"{element} voltage", "v": f"node {element}", "friction": f"friction coefficient {element}"}
    cells = [label.get(key, f"{signal.text} {element}").rstrip()]
    for kind in _COLUMNS.values():
        value = s.get(f"{name}_{kind}")
        if value is None:
            cells.append("-")
            continue
        # A mean that is 0 to round-off is written as 0.
        value = 0.0 if abs(value) <= 1e-12 * s[f"{name}_peak"] else value
        # An area takes no prefix, which would be squared with its unit, and a coefficient has none.
        plain = {"m^2": f"{1e6 * value:.4g} mm^2", "1": f"{value:.4g}"}
        cells.append(plain.get(signal.unit) or format_si(value, signal.unit))
    return tuple(cells)


def _end(solution: Solution, s: dict[str, Any]) -> list[str]:
    """What the page says below its table: errors, the distance to the fold, and how the run ended."""
    error = solution.error
    nodes = "" if error.v_nodes is None else f", node voltages {error.v_nodes:.2g} V"
    if solution.gaps:
        out = [f"estimated error: gap voltage {error.u_gap:.2g} V, force {error.f_el:.2g} N{nodes}"]
    else:
        inside = "layer" if solution.layers else "capacitor"
        out = [f"no GAP, no forces; estimated error: {inside} voltage {error.u_gap:.2g} V{nodes}"]
    if s.get("figures_from") == "outputs":
        out.append("figures are those of the outputs: what lies between them is not known")
    if solution.charge_law == "mobile" and "fold_margin_min" in s:
        out.append(f"distance to the fold: {s['fold_margin_min']:.3g} at least (1 far, 0 at the fold)")
    out.append(f"status: {solution.message}")
    if solution.failure is not None and solution.failure.tried:
        out += ["", "last steps tried:", solution.failure.history()]
    return out
