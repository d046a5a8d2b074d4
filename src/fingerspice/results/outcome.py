"""The model chosen for a run, and how it ended: status or failure, stated error, and the state to go on from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, NamedTuple

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceError, printable
from fingerspice.base.pages import Page, Shown

if TYPE_CHECKING:
    from fingerspice.results.solution import Solution


class Status(Enum):
    """How a run ended: its `cause` in words, and the `action` that the user is advised to take."""

    SUCCESS = ("success", "")
    FOLD = (
        "the mobile charge law has no solution past this time: with the charge stored on the interfaces, area and gap "
        "voltage drive each other on",
        "use less voltage, more load, or the local law",
    )
    SOURCE_NOT_FINITE = ("a source gave NaN or inf", "nothing after this time is a result: mend the source")
    SOURCE_UNSEEN = (
        "the source function has a feature at this output that its samples missed",
        "nothing from this time on is a result: give Function(f, breaks=(...)) the times of its edges",
    )
    STEP_UNDERFLOW = ("no step is small enough for the error asked for", "ask for a larger rtol, or check the source")
    TOO_MANY_STEPS = (
        "the run took more steps than any that was well posed has needed",
        "ask for a larger rtol, or a shorter run",
    )
    ERROR_NOT_MET = ("the error estimate stayed above the error asked for", "ask for a larger rtol")
    METHOD_FAILED = ("the chosen method gave up", "use method='auto'")
    NOT_PERIODIC = (
        "Newton's method did not find a state that a period leads back to",
        "simulate more periods from rest instead, and see what they do",
    )

    def __init__(self, cause: str, action: str) -> None:
        self.cause, self.action = cause, action

    def __repr__(self) -> str:
        return f"Status.{self.name}"


class Attempt(NamedTuple):
    """An attempted step: start and length (s), and its error relative to the allowed one, inf without a solution."""

    t: float
    step: float
    error: float


def last_tried(rows: FloatArray) -> tuple[Attempt, ...]:
    """Attempted steps, oldest first, from rows of start, length, error and number, where number 0 means no step."""
    return tuple(Attempt(*row[:3]) for row in rows[rows[:, 3].argsort()].tolist() if row[3] > 0.0)


@dataclass(frozen=True)
class Failure:
    """Why, when and where a solve failed, and what to do.

    Attributes
    ----------
    status : Status
    cause, action : str
        What happened, with the figures known, and what to change.
    t : float or None
        Time reached, s; None where the failure concerns the run as a whole.
    step : float or None
        Length of the last step tried, s.
    element : str
        Names of the elements concerned, separated by commas.
    u_gap, area, fold_margin : float or None
        Gap voltage (V), ridge contact area (m^2) and distance to the fold at that time.
    tried : tuple of Attempt
        The last steps tried.
    """

    status: Status
    cause: str
    action: str
    t: float | None = None
    element: str = ""
    u_gap: float | None = None
    area: float | None = None
    fold_margin: float | None = None
    tried: tuple[Attempt, ...] = ()

    @property
    def step(self) -> float | None:
        return self.tried[-1].step if self.tried else None

    def __str__(self) -> str:
        text = "" if self.t is None else f"stopped at t = {self.t:.10g} s: "
        text += f"{self.cause}; {self.action}"
        facts = [f"at {self.element}"] if self.element else []
        if self.u_gap is not None and self.area is not None:
            facts.append(f"just before: {self.u_gap:.4g} V across the gap, area {1e6 * self.area:.4g} mm^2")
            if self.fold_margin is not None:
                facts.append(f"distance to the fold {self.fold_margin:.3g}")
        return f"{text} ({', '.join(facts)})" if facts else text

    def history(self) -> str:
        """The last steps tried, as a table."""
        rows = [f"{a.t:<24.15g}{a.step:<14.4g}{a.error:<12.3g}" for a in self.tried]
        return "\n".join([f"{'start [s]':<24}{'step [s]':<14}{'error / allowed':<12}", *rows])

    def to_dict(self) -> dict[str, Any]:
        """Plain data, SI units."""
        order = dict.fromkeys(("status", "cause", "action", "t", "step"), self.step)
        return order | vars(self) | {"status": self.status.name, "tried": [a._asdict() for a in self.tried]}


class SolveError(FingerspiceError, RuntimeError):
    """The solve did not reach its end.

    Attributes
    ----------
    failure : Failure
        Why, when and where it stopped.
    message : str
        The failure as one sentence.
    solution : Solution or None
        The run up to where it stopped; None where there is none.
    """

    def __init__(self, failure: Failure, solution: Solution | None = None) -> None:
        self.failure = failure
        self.message = printable(str(failure))
        self.solution = solution
        super().__init__(self.message)


@dataclass(frozen=True)
class ErrorEstimate:
    """Estimated largest error over the run: of gap voltage (V), electroadhesive force (N), charge (C) and nodes (V).

    `v_nodes` is the largest error of the voltages of all nodes. It is stated, but no run is refined for it: `rtol`
    applies to gap voltage and force only, and a node may have a transient that no gap feels. It is None in runs that
    start from the periodic state, because the error of that state is estimated at the gaps only.

    Area and friction have none of their own: friction is mu (F_N + F_el), with mu times the error of the force, and an
    area without `tau` is a curve over the gap voltage, with at most that voltage's error times its largest slope.

    Without a GAP, `u_gap` is the error of the voltage across the layer with the smallest capacitance, and `f_el` is 0.
    `q_source` is None where the charge was left out, or where its error is not estimated: only the coupled tier's own
    steps and the algebraic tier estimate it, and they do not in runs that start from the periodic state.
    """

    u_gap: float
    f_el: float
    q_source: float | None = None
    v_nodes: float | None = None


@dataclass(frozen=True, repr=False)
class State:
    """Where a run stopped; another run may start from it."""

    t: float  # s
    y: FloatArray  # (n,): Live voltages (V), areas with a time constant (over those at 0 V), charges delivered (C)
    s_before: FloatArray  # (n_source,): Source values just before `t`, V or A
    sign: FloatArray  # (n_area,): Branch of each area: the sign of its gap's voltage, or 0 if that is to choose it
    charge_law: str

    def __repr__(self) -> str:
        return f"<State at t = {self.t:g} s, {self.y.size} numbers, {self.charge_law} law>"


@dataclass(frozen=True, repr=False)
class Plan(Shown):
    """The model chosen for a run.

    Attributes
    ----------
    tier : str
        ``algebraic``: the voltages follow the source instantly; ``linear``: closed form at one area; ``coupled``: steps
        in which the area follows the voltage at every instant.
    reasons : tuple of str
        Reasons for the tier, one sentence each.
    start : str
        Start of the run; ``periodic`` means the periodic state, which is solved for directly.
    rates : tuple of float
        Decay rates of the circuit's modes with its areas fixed, 1/s, ascending.
    stiff : bool
        Whether stability would limit the steps of an explicit method.
    sensitivity : float
        Largest relative change of 1/A, and thus of the leak rates, for gap voltages up to twice the sources' peak; the
        maximum over all areas. NaN with current sources, which do not bound the gap voltage.
    error_bound : float
        Bound of the error (relative to the peaks) from fixing the area, or from a dispersive skin at one frequency.
    area : float
        Area of the `linear` tier, m^2.
    """

    tier: str
    reasons: tuple[str, ...]
    start: str
    rates: tuple[float, ...]
    stiff: bool
    sensitivity: float
    error_bound: float
    area: float

    def _page(self) -> Page:
        rates = ", ".join(f"{r:.4g}" for r in self.rates) or "none"
        stiff = f"rates, area frozen: {rates} 1/s ({'' if self.stiff else 'not '}stiff for this source)"
        lines = [f"model: {self.tier}", *(f"  because {r}" for r in self.reasons), stiff]
        if not math.isnan(self.sensitivity):
            lines.append(f"the area differs from its middle by at most {100.0 * self.sensitivity:.3g} %")
        return Page(lines)

    def to_dict(self) -> dict[str, object]:
        """The plan as plain data."""
        return {**vars(self), "reasons": list(self.reasons), "rates": list(self.rates)}
