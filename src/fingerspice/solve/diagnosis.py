"""Messages about a run that failed: the place and the time of the failure, its cause, and what to change."""

from __future__ import annotations

import numpy as np

from fingerspice.results.outcome import Failure, Status, last_tried
from fingerspice.results.record import Record
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Run
from fingerspice.waveforms.sampling import breakpoints_at

ROUGH = "the source function itself is rough by {:.2g} V"


def run_failure(problem: Problem, run: Run, record: Record) -> Failure:
    """The failure of a run. At a fold, the gap with the smallest area relative to its area at 0 V is named."""
    status, cause = run.status, run.status.cause
    names = _measured(problem)
    element = ", ".join(names)
    u_gap = area = margin = None
    if status is Status.SOURCE_NOT_FINITE and run.t_failed is not None:
        element = _not_finite_at(problem, run.t_failed)
    elif status is Status.SOURCE_UNSEEN and run.unseen is not None:
        _, off, place = run.unseen
        source = problem.network.sources[place]
        element = ", ".join(_written(problem, place))
        cause += f" (by {off:.3g} {'A' if source.device == 'I' else 'V'})"
    elif status is Status.FOLD and run.t.size and record.fingers:
        if run.t_failed is not None and breakpoints_at(problem.waveform, run.t_failed).size:
            cause += " (the source jumps past the fold at this time)"
        shrunk = [record.finger_area(i)[-1] / problem.scene.area0[j] for i, j in enumerate(problem.network.fingers)]
        i = int(np.argmin(shrunk))
        element = names[i]
        u_gap, area = float(record.finger_voltage(i)[-1]), float(record.finger_area(i)[-1])
        margin = float(record.fold_margin[-1])
    detail = run.detail or (ROUGH.format(run.rough) if run.rough > 0.0 else "")
    if detail:
        cause += f" ({detail})"
    if status is Status.ERROR_NOT_MET and len(run.gaps):
        peaks = run.gaps[:, 0]
        worst = int(np.argmax(run.gaps[:, 2] / np.where(peaks > 0.0, peaks, np.inf)))
        element = names[worst] if names else element
        cause += f" (estimate {run.gaps[worst, 2]:.3g} V of {peaks[worst]:.3g} V peak"
        cause += _little(peaks[worst], max(problem.scene.u_peak, float(peaks.max()))) + ")"
    return Failure(status, cause, status.action, run.t_failed, element, u_gap, area, margin, last_tried(run.tried))


def period_failure(problem: Problem, status: Status, t: float | None = None, cause: str = "") -> Failure:
    """The failure of a search for the periodic state."""
    element = ", ".join(_measured(problem))
    if status is Status.SOURCE_NOT_FINITE and t is not None:
        element = _not_finite_at(problem, t)
    why = cause or f"no periodic state was reached: {status.cause}"
    return Failure(status, why, status.action, t, element)


def _measured(problem: Problem) -> list[str]:
    """Names of the elements for whose voltages an error is stated."""
    return [problem.network.cells[i].element.name for i in problem.scene.measured]


def _written(problem: Problem, place: int) -> list[str]:
    """Names of the deck's sources that are combined in source number `place` of the network."""
    stack = problem.scene.stack
    return [problem.network.sources[place].name] if stack is None else [e.name for e, _ in stack.sources]


def _not_finite_at(problem: Problem, t: float) -> str:
    """Names of the sources without a finite value at time t, s."""
    broken = [i for i, wave in enumerate(problem.waveforms) if not np.isfinite(wave.value(t))]
    return ", ".join(name for i in broken for name in _written(problem, i))


def _little(peak: float, largest: float) -> str:
    """Reason why `rtol` cannot be met for a gap with a tiny share of the circuit's largest voltage (V), or ""."""
    if not peak < 1e-4 * largest:
        return ""
    return f"; the gap takes almost nothing of the {largest:.3g} V of the source, and rounding of these limits it"
