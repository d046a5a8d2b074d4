"""One period of a circuit for the search of its periodic state: tables of the sources, and the linear circuit's state.

The search solves for the modes' amplitudes at the start of the period, so this module converts between them and the
voltages of the tree capacitors, and gives the periodic state of the circuit with fixed areas as a first guess.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.circuit.network import Modes
from fingerspice.engine.network import Sources
from fingerspice.numerics import linear
from fingerspice.results.outcome import State, Status
from fingerspice.solve.problem import Problem
from fingerspice.solve.sources import joined
from fingerspice.waveforms.sampling import SourceTable, source_table
from fingerspice.waveforms.waveform import DC

# Number of equidistant times of a period from which mean areas are computed.
SAMPLES = 64
# Nodes and weights of Gauss-Legendre quadrature on [0, 1], for integrals over a voltage from 0 V to its value.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_GAUSS = 0.5 + 0.5 * _NODES, 0.5 * _WEIGHTS


CHARGING = "a current source charges, from period to period, what nothing drains"


@dataclass(frozen=True)
class Found:
    """Figures of a periodic state for `Closed`; `gap_errors` (n_gap, 2): errors of gap voltage (V) and force (N)."""

    defect: float
    map_slope: FloatArray
    memory: float
    gap_errors: FloatArray
    periods: float


class Stopped(Exception):
    """A period that could not be integrated."""

    def __init__(self, status: Status, t: float) -> None:
        self.status, self.t = status, t


def first_period(problem: Problem) -> float:
    """Start (s) of the first whole period after the source has become periodic, and not before the run's start."""
    waveform = problem.waveform
    assert waveform.period is not None
    return waveform.period * float(np.ceil(max(waveform.settled, problem.t_start) / waveform.period))


class Period:
    """One period of a problem, or only its first half if the second half is the first with opposite sign.

    Attributes
    ----------
    begin, end, span : float
        Limits and length of the integrated span, s; the period consists of `parts` such spans.
    parts : int
        1, or 2 where half a period is enough.
    modes : Modes
        Modes of the circuit with its areas at 0 V.
    before : ndarray, shape (n_s,)
        Sources just before the period, V or A.
    rates : ndarray, shape (n + n_slow,)
        Decay rates of the modes and of the areas with a time constant, 1/s.
    n : int
        Number of modes.
    neutral : ndarray of bool, shape (n + n_slow,)
        True for modes that do not decay: charges that nothing drains.
    kept : ndarray, shape (n,)
        Amplitudes of the neutral modes when the period begins; 0 for all other modes.
    turned : ndarray, shape (n + n_slow,)
        Sign of each entry of a periodic state at the end of the span, relative to its start.
    problem : Problem
        The problem restricted to the span, without charge.
    """

    def __init__(self, problem: Problem) -> None:
        waveform, scene, net = problem.waveform, problem.scene, problem.scene.net
        assert waveform.period is not None
        self.begin = first_period(problem)
        self.modes: Modes = scene.modes
        self.before = np.array([float(w.value(self.begin, "left")) for w in scene.waveforms])
        slow = net.slow >= 0
        self.rates = np.append(self.modes.rates, 1.0 / net.tau[slow])
        self.n = self.modes.rates.size
        self.neutral: BoolArray = self.rates == 0.0
        kept = self.modes.inverse @ (problem.initial.y[: self.n] + self.modes.follow @ problem.initial.s_before)
        self.kept = np.where(self.neutral[: self.n], kept, 0.0)
        pushed = np.any(self.modes.gains[self.neutral[: self.n]] != 0.0)
        half = _turns(problem) and not pushed and not np.any(self.kept)
        self.parts = 2 if half else 1
        self.span = waveform.period / self.parts
        end = self.begin + self.span
        self.tables: list[SourceTable] = problem.scene.prepared.get(self._key(problem), [])
        if not self.tables:
            self.tables = [source_table(w, self.begin, end, 1e-13, problem.step) for w in scene.waveforms]
            problem.scene.prepared[self._key(problem)] = self.tables
        broken = [table.not_finite for table in self.tables if table.not_finite is not None]
        if broken:
            raise Stopped(Status.SOURCE_NOT_FINITE, min(broken))
        self.sources: Sources = joined(self.tables)
        self.end = float(min(table.edges[-1] for table in self.tables))
        if pushed and self.begin > problem.t_start:
            self._push(problem)
        self.turned = np.where(np.arange(self.rates.size) < self.n, 1.0 if self.parts == 1 else -1.0, 1.0)
        self.problem = dataclasses.replace(
            problem, t_start=self.begin, t_stop=self.end, first=self.begin, charge=False,
            initial=State(self.begin, problem.initial.y, self.before, np.zeros(net.gap.size), scene.charge_law),
        )  # fmt: skip

    def _key(self, problem: Problem) -> tuple[object, ...]:
        """Key of the sources' tables in the scene's cache; a function's table depends on the output step as well."""
        return "period", self.begin, self.span, problem.step if problem.scene.is_sampled else 0.0

    def _push(self, problem: Problem) -> None:
        """Add to `kept` the charge that sources drive into the neutral modes between the run's start and the period."""
        for j, wave in enumerate(problem.scene.waveforms):
            table = source_table(wave, problem.t_start, self.begin, 1e-13, problem.step)
            gains = np.where(self.neutral[: self.n], self.modes.gains[:, j], 0.0)
            start = np.zeros(self.n)
            _, moved = linear.respond(np.zeros(self.n), gains, table.edges, table.terms, table.series, start, [])
            self.kept = self.kept + moved

    def voltages(self, z: FloatArray) -> FloatArray:
        """Live voltages just before the period begins, V, shape (n,)."""
        return np.asarray(self.modes.shape @ z[: self.n] - self.modes.follow @ self.before)

    def modes_of(self, x: FloatArray) -> FloatArray:
        """Modes (n,) from live voltages (V) just before the period begins."""
        return np.asarray(self.modes.inverse @ (x + self.modes.follow @ self.before))

    def charges(self, z: FloatArray, held: IntArray) -> FloatArray:
        """Conserved charges of the state z, projected on the neutral modes with the indices `held`.

        Under `local` a capacitor holds the integral of C dU from 0 V to its voltage U; under `mobile` it holds C U.
        """
        scene = self.problem.scene
        network, net = scene.network, scene.net
        u = net.p @ self.voltages(z) + net.q @ self.before
        along, weight = (np.ones(1), np.ones(1)) if net.mobile else _GAUSS
        area, charge = scene.area0.copy(), np.zeros(u.size)
        for share, part in zip(along, weight, strict=True):
            for i in np.flatnonzero(net.gap >= 0):
                slow, contact = net.slow[i], network.contacts[i]
                assert contact is not None
                following = float(contact.area(share * abs(u[net.gap[i]])))
                area[i] = following if slow < 0 else net.area0[i] * z[self.n + slow]
            charge += part * network.capacitance(area) * u
        return np.asarray(self.modes.shape[:, held].T @ (net.p.T @ charge))

    def linear_state(self, modes: Modes) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Periodic state of a circuit with fixed areas: its modes at the start, the end and SAMPLES times of the span.

        A neutral mode starts from the amplitude that it keeps; NaN where a current charges it from period to period.
        """
        rates = modes.rates
        t = self.begin + (self.end - self.begin) * (np.arange(SAMPLES) + 0.5) / SAMPLES
        start, end, along = np.zeros(self.n), np.zeros(self.n), np.zeros((SAMPLES, self.n))
        for j, table in enumerate(self.tables):
            gains = np.ascontiguousarray(modes.gains[:, j])
            given = table.edges, table.terms, table.series
            if self.parts == 1:
                v = linear.periodic_state(rates, gains, *given)
            else:
                _, moved = linear.respond(rates, gains, *given, np.zeros(self.n), [])
                v = -moved / (1.0 + np.exp(-rates * (table.edges[-1] - table.edges[0])))
            rows, last = linear.respond(rates, gains, *given, v, t)
            start, end, along = start + v, end + last, along + rows
        return start, end, along

    def sampled(self) -> FloatArray:
        """Sources (V or A) at the times of `linear_state`, shape (SAMPLES, n_s)."""
        t = self.begin + (self.end - self.begin) * (np.arange(SAMPLES) + 0.5) / SAMPLES
        return np.column_stack([wave.value(t) for wave in self.problem.scene.waveforms])


def _turns(problem: Problem) -> bool:
    """Whether the second half period of every source is the first with opposite sign; then so are all voltages.

    The circuit itself has this symmetry: it is linear except for the areas, which depend on the modulus of a voltage.
    """
    period = problem.waveform.period
    for wave in problem.scene.waveforms:
        if wave == DC(0.0):
            continue
        if not wave.half_wave or wave.period is None or period is None:
            return False
        ratio = period / wave.period
        if round(ratio) % 2 == 0 or abs(ratio - round(ratio)) > 1e-9:
            return False
    return True
