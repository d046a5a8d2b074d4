"""What is said of a run that failed: where it was, why, and what to change."""

from __future__ import annotations

import numpy as np

from fingerspice.results.network_record import NetworkRecord
from fingerspice.results.outcome import Failure, Status
from fingerspice.results.record import Record
from fingerspice.solve.netruns import NetworkRun
from fingerspice.solve.networks import NetworkProblem
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Run
from fingerspice.waveforms.sampling import breakpoints_at

ROUGH = "the source function itself is rough by {:.2g} V"


def stack_failure(problem: Problem, run: Run, record: Record) -> Failure:
    """Of a run through a series stack that did not succeed."""
    status, cause = run.status, run.status.cause
    layers = problem.stack.layers
    element = layers[problem.scene.probe_layer].name if layers else ""
    u_gap = area = margin = None
    if status in (Status.SOURCE_NOT_FINITE, Status.SOURCE_UNSEEN):
        element = ", ".join(e.name for e, _ in problem.stack.sources)
    elif status is Status.FOLD and run.t.size and record.left[-1]:
        if run.t_failed is not None and breakpoints_at(problem.waveform, run.t_failed).size:
            cause += " (the source jumps past the fold at this time)"
        u_gap, area, margin = float(record.u_gap[-1]), float(record.area[-1]), float(record.fold_margin[-1])
    if status is Status.SOURCE_UNSEEN and run.unseen is not None:
        cause += f" (by {run.unseen[1]:.3g} V)"
    if run.detail:
        cause += f" ({run.detail})"
    if status is Status.ERROR_NOT_MET:
        cause += f" (estimate {run.error.u_gap:.3g} V of {run.peak_u:.3g} V peak"
        cause += _little(run.peak_u, problem.scene.u_peak) + ")"
    return Failure(status, cause, status.action, run.t_failed, element, u_gap, area, margin, run.tried)


def _little(peak: float, largest: float) -> str:
    """Why the error of a gap at so little of the circuit's largest voltage (V) cannot be met."""
    if not peak < 1e-4 * largest:
        return ""
    return f"; the gap takes almost nothing of the {largest:.3g} V of the source, and rounding of these limits it"


def not_finite_at(problem: NetworkProblem, t: float) -> str:
    """Names of the sources that have no finite value at a time, s."""
    pairs = zip(problem.network.sources, problem.scene.waveforms, strict=True)
    return ", ".join(e.name for e, wave in pairs if not np.isfinite(wave.value(t)))


def network_failure(problem: NetworkProblem, run: NetworkRun, record: NetworkRecord) -> Failure:
    """Of a network's run: what folds is the gap with the least area left of its own."""
    status, cause = run.status, run.status.cause
    names = [name for name, _ in record.fingers]
    element = ", ".join(names)
    u_gap = area = margin = None
    if status is Status.SOURCE_NOT_FINITE and run.t_failed is not None:
        element = not_finite_at(problem, run.t_failed)
    elif status is Status.SOURCE_UNSEEN and run.unseen is not None:
        _, off, place = run.unseen
        source = problem.network.sources[place]
        element = source.name
        cause += f" (by {off:.3g} {'A' if source.device == 'I' else 'V'})"
    elif status is Status.FOLD and run.t.size and names:
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
    return Failure(status, cause, status.action, run.t_failed, element, u_gap, area, margin, run.tried)
