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
        from fingerspice.results.report import plan_text

        return plan_text(self)

    def to_dict(self) -> dict[str, object]:
        """The plan as plain data."""
        return {**vars(self), "reasons": list(self.reasons), "rates": list(self.rates)}
