"""The model chosen for a run."""

from __future__ import annotations

from dataclasses import dataclass

from fingerspice.base.pages import Page, Shown


@dataclass(frozen=True, repr=False)
class Plan(Shown):
    """The model chosen for a run.

    Attributes
    ----------
    tier : str
        ``algebraic``: the voltages follow the source at once; ``linear``: closed form at one area; ``coupled``:
        stepped, the area followed at every instant.
    reasons : tuple of str
        Why, one sentence each.
    start : str
        ``periodic`` where the run starts from the periodic state, which is solved for directly; else how it starts.
    rates : tuple of float
        Rates of the stack with its area frozen, 1/s, ascending.
    stiff : bool
        Whether an explicit method would be held back by stability.
    sensitivity : float
        Largest relative change of 1/A over the run, and with it of the leak rates: of the area that changes most, with
        gap voltages up to twice the sources' peak. NaN where a current source sets them no bound.
    error_bound : float
        What taking one area, or a dispersive skin at one frequency, costs, relative to the peaks.
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
        from fingerspice.results.report import plan_text

        return plan_text(self)

    def to_dict(self) -> dict[str, object]:
        """The plan as plain data."""
        return {**vars(self), "reasons": list(self.reasons), "rates": list(self.rates)}
