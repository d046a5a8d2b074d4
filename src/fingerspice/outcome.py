"""How a run ended: its status, its stated error, and the state for another one to go on from."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class Status(Enum):
    """How a run ended; the text says what happened and what to do."""

    SUCCESS = "success"
    FOLD = (
        "the mobile charge law has no solution past this time: with the charge stored on the interfaces, less area "
        "means more voltage means less area; use less voltage, more load, or the local law"
    )
    SOURCE_NOT_FINITE = "a source gave NaN or inf; nothing after this time is a result"
    STEP_UNDERFLOW = "no step is small enough for the error asked for; ask for a larger rtol, or check the source"
    TOO_MANY_STEPS = "the run took two million steps without coming to its end; ask for a larger rtol, or a shorter run"
    ERROR_NOT_MET = "the error estimate stayed above the error asked for; ask for a larger rtol"
    METHOD_FAILED = "the chosen method gave up; use method='auto'"


@dataclass(frozen=True)
class ErrorEstimate:
    """Estimated largest error over the run: of the gap voltage (V), the electroadhesive force (N) and the charge (C).

    Without a GAP, `u_gap` is that of the voltage of the layer with the smallest capacitance, and `f_el` is 0.
    `q_source` is None where the charge was left out or has no estimate: only the coupled tier's own steps give one, and
    not from the periodic state on.
    """

    u_gap: float
    f_el: float
    q_source: float | None = None


@dataclass(frozen=True)
class State:
    """Where a run stopped, for another one to go on from."""

    t: float
    y: FloatArray
    u_before: float
    charge_offset: float
    charge_law: str


@dataclass(frozen=True)
class NetworkState:
    """Where the run of a network stopped: `y` as in `engine.network`, sources before a jump, branches of the areas."""

    t: float
    y: FloatArray
    s_before: FloatArray
    sign: FloatArray
