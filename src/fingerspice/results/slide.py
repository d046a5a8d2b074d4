"""Friction of a finger whose contact forms anew over a distance (Dahl 1968): F_t' = (v / slip) (F_c - F_t).

F_c is the friction of a contact that has formed, v the finger's speed. On panels of a run on which F_c and v are
polynomials and the finger slides at most one slip length, this is integrated as it stands.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.polynomial import chebyshev

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.numerics.lobatto import NODES, POINTS, TO_SERIES
from fingerspice.results.record import Frictions, Record, Signals
from fingerspice.results.solution import Solution
from fingerspice.results.steps import Make, Recorded, Stretch, basis, halved, missed
from fingerspice.waveforms.waveform import DC, Waveform, refuse

# Values at the nodes to integrals from the panel's start to each of them, over the panel's length.
_INTEGRAL = TO_SERIES[:, :NODES] @ (
    chebyshev.chebvander(2.0 * POINTS[:NODES] - 1.0, NODES) @ chebyshev.chebint(np.eye(NODES), lbnd=-1.0, scl=0.5)
).T  # fmt: skip
_TOLERANCE = 1e-11  # Of the polynomials, relative to the largest values
_MOST_HALVINGS = 60


def slid(solution: Solution, speed: Waveform | None = None) -> Solution:
    """The run with the friction of fingers that have a ``slip``, at a speed (m/s), or at their own ``v``.

    It starts with contacts that have formed, and from the periodic state in that of the friction.

    Raises
    ------
    InputError
        If no GAP has a slip, a speed is below 0, or the run is not known between its outputs from its start on.
    """
    circuit = solution.circuit
    gaps = [circuit[name].values for name in solution.gaps]
    refuse(all(gap["slip"] == 0.0 for gap in gaps), "no GAP has a slip; allowed: a slip length, such as slip=11.5u")
    tran, stretch = circuit.tran, solution._stretch(solution.first, solution.t_stop)
    late = tran is not None and tran.start > 0.0 and solution.start != "periodic"
    said = "a friction with a slip needs the run between its outputs from its start on"
    refuse(late, f"{said}, and TSTART is above 0; allowed: TSTART 0")
    refuse(stretch is None, f"{said}, which is not known here; allowed: method 'auto', a shorter run that is no stream")
    assert stretch is not None
    run = stretch.run.each_once()
    formed = replace(run, make=partial(_record, run.make, ()))
    slides = tuple(
        _friction(solution, formed, name, gap, speed or DC(gap["v"])) if gap["slip"] > 0.0 else None
        for name, gap in zip(solution.record.names("f_t"), gaps, strict=True)
    )
    assert isinstance(solution.record, Record)
    return replace(
        solution,
        record=replace(solution.record, slides=slides),
        continuous=replace(run, make=partial(_record, run.make, slides)),
    )


def _friction(
    solution: Solution, run: Recorded, name: str, gap: Mapping[str, float], speed: Waveform
) -> Callable[[FloatArray], FloatArray]:
    """The friction (N) of a GAP as a function of times (s)."""
    stretch = Stretch(run, solution.first, solution.t_stop, solution.rtol)
    panels = stretch.resolved(name, _TOLERANCE)
    for _ in range(_MOST_HALVINGS):
        t, x = run.at_points(name, panels)
        rate = np.asarray(speed.value(t), float) / gap["slip"]
        refuse(not rate.min() >= 0.0, f"the speed of {name} is {rate.min() * gap['slip']:g} m/s; allowed: 0 or more")
        slid = panels[3, :, None] * (rate[:, :NODES] @ _INTEGRAL)
        wrong = (slid[:, -1] > 1.0) | (missed(rate) > _TOLERANCE * rate.max(initial=0.0))
        if not wrong.any():
            break
        panels = np.concatenate([panels[:, ~wrong], halved(panels[:, wrong])], axis=1)
    order = t[:, 0].argsort()
    t, x, rate, slid, length = t[order], x[order, :NODES], rate[order, :NODES], slid[order], panels[3, order]
    kept, gained = np.exp(-slid), length[:, None] * ((np.exp(slid) * rate * x) @ _INTEGRAL)
    ends, begins = list(zip(kept[:, -1].tolist(), (kept * gained)[:, -1].tolist(), strict=True)), t[:, 0]

    def from_start(start: float) -> _Friction:
        starts = list(itertools.accumulate(ends[:-1], lambda f, end: end[0] * f + end[1], initial=start))
        return _Friction(begins, length, kept * (np.array(starts)[:, None] + gained))

    start = float(x[0, 0])
    if solution.start == "periodic" and solution.period is not None:
        # A period later the friction is a linear function of that at the start.
        later = np.array([solution.first + solution.period])
        of_none, of_one = (float(from_start(one)(later)[0]) for one in (0.0, 1.0))
        start = of_none / (1.0 - (of_one - of_none)) if of_one - of_none < 1.0 else start
    return from_start(start)


@dataclass(frozen=True)
class _Friction:
    """Friction (N) as polynomials through values (p, NODES) on panels with their begins and lengths (p,), s."""

    begins: FloatArray
    length: FloatArray
    values: FloatArray

    def __call__(self, at: FloatArray) -> FloatArray:
        panel = np.clip(np.searchsorted(self.begins, at, side="right") - 1, 0, self.begins.size - 1)
        fraction = np.clip((at - self.begins[panel]) / self.length[panel], 0.0, 1.0)
        return np.asarray((self.values[panel] * basis(fraction[:, None])[:, 0]).sum(axis=1))


def _record(make: Make, slides: Frictions, t: FloatArray, left: BoolArray, rows: FloatArray) -> Signals:
    """A record with the friction of fingers that slide."""
    made = make(t, left, rows)
    assert isinstance(made, Record)
    return replace(made, slides=slides)
