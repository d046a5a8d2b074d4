"""Periodic state of a circuit under a periodic source, found by Newton's method, with its defect and stability."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from fingerspice.base.arrays import FloatArray, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.pages import Page, Shown
from fingerspice.base.units import format_si
from fingerspice.circuit.arguments import Parameters, Sources, overridden
from fingerspice.circuit.circuit import Circuit
from fingerspice.results.outcome import ErrorEstimate, SolveError
from fingerspice.results.sensitivity import Sensitivity
from fingerspice.results.solution import Solution
from fingerspice.results.summary import Figured, Figures
from fingerspice.solve.periodic.search import close_period
from fingerspice.solve.problem import Problem, prepare
from fingerspice.solve.sensitivities import check_request, period_of, sensitivities_of
from fingerspice.solve.simulation import rtol_given, run_problem

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class SteadyState(Shown, Figured):
    """The periodic state with its defect, stability and error; its figures (`f_el_mean`, ...) are those of the period.

    Attributes
    ----------
    problem : Problem
        The run of one period from the periodic state, at the first whole period after the source has settled.
    rtol : float
    defect : float
        Largest change of a capacitor's or layer's voltage over a further period, V.
    map_slope : ndarray, shape (n, n)
        Derivative of the map of a period, to about 1e-5, in the circuit's modes: the independent voltages (one less
        than the cells of a stack), and the areas with a time constant.
    memory : float
        Ratio of the error of the periodic state to the error of one period; large if a disturbance lasts many periods.
    error : ErrorEstimate
        Estimated error of the state, as its effect on the gap voltage and the force of the period.
    periods : float
        Number of periods integrated to find the state.
    area : str or float
        As in `simulate`.
    asked : tuple of str
        Parameters by which `sensitivities` are wanted.
    """

    problem: Problem
    rtol: float
    defect: float
    map_slope: FloatArray
    memory: float
    error: ErrorEstimate
    periods: float
    area: str | float = "coupled"
    asked: tuple[str, ...] = ()

    def _page(self) -> Page:
        largest = 1.0 - self.stability_margin
        found = f"periodic state of {format_si(self.period, 's')}, found in {self.periods:.3g} periods"
        left = (
            f"a further period changes the voltages by {self.defect:.2g} V at most, and leaves {100.0 * largest:.3g} % "
            "of a small disturbance"
        )
        try:
            period = self.solution._page().blocks
        except SolveError as error:
            period = (error.message,)
        return Page([found, left, "", *period])

    def plot(self, signals: str | Sequence[str] | None = None) -> Figure:
        """The period's signals against time; `signals` as in `Solution.plot`."""
        return self.solution.plot(signals)

    @property
    def period(self) -> float:
        """Period of the source, s."""
        assert self.problem.waveform.period is not None
        return self.problem.waveform.period

    @property
    def multipliers(self) -> FloatArray:
        """Absolute values of the Floquet multipliers, the factors of small disturbances over a period, shape (n,)."""
        return np.abs(np.linalg.eigvals(self.map_slope)) if self.map_slope.size else np.zeros(0)

    @property
    def stability_margin(self) -> float:
        """1 minus the largest multiplier: 0 if a disturbance never decays."""
        return 1.0 - float(self.multipliers.max(initial=0.0))

    @property
    def _figures(self) -> Figures:
        return self.solution._figures

    @property
    def sensitivities(self) -> Mapping[str, Sensitivity]:
        """Derivatives of the period's signals and means, by the path of each parameter that was asked for."""
        return self.solution.sensitivities

    def _run(self, circuit: Circuit, rtol: float) -> Solution:
        """The run from the periodic state of another circuit, as long as the period of this one."""
        one = self.problem
        other = prepare(
            circuit, t_stop=self.period, t_eval=None, charge_law=one.scene.charge_law, area=self.area,
            start="periodic", charge=False,
        )  # fmt: skip
        return run_problem(close_period(dataclasses.replace(other, first=0.0, step=one.step), 0.5 * rtol)[0], rtol=rtol)

    @cached_property
    def solution(self) -> Solution:
        """The period's signals, integrated at the first access, which also gives the warnings.

        Raises
        ------
        SolveError
            If the integration fails.
        """
        solution = run_problem(self.problem, rtol=self.rtol)
        if solution.failure is not None:
            raise SolveError(solution.failure, solution)
        if self.asked:
            found = sensitivities_of(self.problem, solution, self.asked, self._run, over_period=True)
            solution = dataclasses.replace(solution, sensitivities=found)
        for text in solution.warnings:
            if text not in self.problem.circuit.warnings:
                # The third level is the caller's line, beyond the frame of `cached_property`.
                warnings.warn(text, FingerspiceWarning, stacklevel=3)
        return solution


def steady_state(
    circuit: Circuit,
    *,
    sources: Sources | None = None,
    parameters: Parameters | None = None,
    charge_law: str | None = None,
    area: str | float = "coupled",
    rtol: float = 1e-8,
    points: int = 200,
    charge: bool = True,
    sensitivities: Sequence[str] = (),
) -> SteadyState:
    """Periodic state of a circuit, by Newton's method on the map of one period.

    A charge that no conductance drains is not determined by periodicity: it keeps the value of the uncharged start.

    Parameters
    ----------
    circuit : Circuit
        A circuit with a periodic source, or with several sources that have a common period.
    sources, parameters, charge_law, area, rtol, charge
        As in `simulate`; the error is relative to the peaks over the period.
    points : int
        Output steps in the period.
    sensitivities : sequence of str
        As in `simulate`: how the periodic state changes with these parameters.

    Returns
    -------
    SteadyState

    Raises
    ------
    InputError
        If the source has no period.
    SolveError
        If a period cannot be integrated, or Newton's method does not converge.
    """
    rtol = rtol_given(rtol)
    points = whole_number("points", points, 1)
    circuit = overridden(circuit, sources, parameters)
    period = period_of(circuit)
    if period is None:
        raise InputError("the source has no period, so there is no periodic state to find")
    problem = prepare(
        circuit, t_stop=period, t_eval=None, charge_law=charge_law, area=area, start="periodic", charge=charge
    )
    if sensitivities:
        check_request(problem, sensitivities, "auto", "periodic")
    problem, found = close_period(dataclasses.replace(problem, first=0.0, step=period / points), 0.5 * rtol)
    error = ErrorEstimate(*map(float, found.gap_errors.max(axis=0, initial=0.0)))
    return SteadyState(
        problem, rtol, found.defect, found.map_slope, found.memory, error, found.periods, area, tuple(sensitivities)
    )
