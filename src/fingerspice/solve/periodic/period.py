"""One period of a circuit for the search of its periodic state: tables of the sources, and the linear circuit's state.

The search solves for the modes' amplitudes at the start of the period, so this module converts between them and the
voltages of the tree capacitors, and gives the periodic state of the circuit with fixed areas as a first guess.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.circuit.network import Modes
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


class Stopped(Exception):
    """A period that could not be integrated, or that leads to no periodic state, with the time (s) or the cause."""

    def __init__(self, status: Status, t: float | None = None, cause: str = "") -> None:
        self.status, self.t, self.cause = status, t, cause


class Period:
    """One period of a problem, or only its first half if the second half is the first with opposite sign."""

    def __init__(self, problem: Problem) -> None:
        waveform, scene, net = problem.waveform, problem.scene, problem.scene.net
        assert waveform.period is not None
        # The first whole period after the sources have become periodic, and not before the run's start, s.
        self.begin = waveform.period * float(np.ceil(max(waveform.settled, problem.t_start) / waveform.period))
        # Modes of the circuit with its areas at 0 V, and their number.
        self.modes: Modes = scene.modes
        n = self.n = self.modes.rates.size
        # (n_s,): Sources just before the period, V or A.
        self.before = np.array([float(w.value(self.begin, "left")) for w in scene.waveforms])
        # (n + n_slow,): Decay rates of the modes and of the areas with a time constant, 1/s, and which of them are 0:
        # charges that nothing drains.
        self.rates = np.append(self.modes.rates, 1.0 / net.tau[net.slow >= 0])
        self.neutral: BoolArray = self.rates == 0.0
        # (n,): Amplitudes of the neutral modes when the period begins; 0 for all other modes.
        kept = self.modes.inverse @ (problem.initial.y[:n] + self.modes.follow @ problem.initial.s_before)
        self.kept = np.where(self.neutral[:n], kept, 0.0)
        pushed = np.any(self.modes.gains[self.neutral[:n]] != 0.0)
        # The integrated span is one of so many parts of the period; its length, s.
        self.parts = 2 if _turns(problem) and not pushed and not np.any(self.kept) else 1
        self.span = waveform.period / self.parts
        # A function's table depends on the output step as well.
        key = "period", self.begin, self.span, problem.step if scene.is_sampled else 0.0
        self.tables: list[SourceTable] = scene.prepared.get(key, [])
        if not self.tables:
            end = self.begin + self.span
            self.tables = [source_table(w, self.begin, end, 1e-13, problem.step) for w in scene.waveforms]
            scene.prepared[key] = self.tables
        broken = [table.not_finite for table in self.tables if table.not_finite is not None]
        if broken:
            raise Stopped(Status.SOURCE_NOT_FINITE, min(broken))
        self.sources = joined(self.tables)
        self.end = float(min(table.edges[-1] for table in self.tables))
        if pushed and self.begin > problem.t_start:
            # Add the charge that sources drive into the neutral modes between the run's start and the period.
            for j, wave in enumerate(scene.waveforms):
                table = source_table(wave, problem.t_start, self.begin, 1e-13, problem.step)
                gains, still = np.where(self.neutral[:n], self.modes.gains[:, j], 0.0), np.zeros(n)
                self.kept = (
                    self.kept + linear.respond(still, gains, table.edges, table.terms, table.series, still, [])[1]
                )
        # (n + n_slow,): Sign of each entry of a periodic state at the end of the span, relative to its start.
        self.turned = np.where(np.arange(self.rates.size) < n, 1.0 if self.parts == 1 else -1.0, 1.0)
        # The problem restricted to the span, without charge.
        self.problem = dataclasses.replace(
            problem, t_start=self.begin, t_stop=self.end, first=self.begin, charge=False,
            initial=State(self.begin, problem.initial.y, self.before, np.zeros(net.gap.size), scene.charge_law),
        )  # fmt: skip
        # (SAMPLES,): Times of `linear_state`, s.
        self.times = self.begin + (self.end - self.begin) * (np.arange(SAMPLES) + 0.5) / SAMPLES

    def voltages(self, z: FloatArray) -> FloatArray:
        """Live voltages just before the period begins, V, shape (n,)."""
        return np.asarray(self.modes.shape @ z[: self.n] - self.modes.follow @ self.before)

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
        start, end, along = np.zeros(self.n), np.zeros(self.n), np.zeros((SAMPLES, self.n))
        for j, table in enumerate(self.tables):
            gains = np.ascontiguousarray(modes.gains[:, j])
            given = table.edges, table.terms, table.series
            if self.parts == 1:
                v = linear.periodic_state(rates, gains, *given)
            else:
                _, moved = linear.respond(rates, gains, *given, np.zeros(self.n), [])
                v = -moved / (1.0 + np.exp(-rates * (table.edges[-1] - table.edges[0])))
            rows, last = linear.respond(rates, gains, *given, v, self.times)
            start, end, along = start + v, end + last, along + rows
        return start, end, along


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
