"""How long a run is, and how far apart its outputs are."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.waveforms import require
from fingerspice.errors import InputError

FloatArray = NDArray[np.float64]


def run_times(circuit: Circuit, t_start: float, t_stop: float | None, t_eval: FloatArray | None) -> tuple[float, float]:
    """End of the run and output spacing, s."""
    tran = circuit.tran
    if t_stop is None:
        if tran is not None:
            t_stop = t_start + tran.stop
        elif t_eval is not None and t_eval.size:
            t_stop = float(t_eval[-1])
        else:
            raise InputError("no t_stop: the deck has no .tran line and none was given; give t_stop in s")
    require(math.isfinite(t_stop) and t_stop > t_start, "t_stop", f"{t_stop:g} s", f"more than {t_start:g} s")
    if t_eval is not None:
        require(t_eval.ndim == 1 and t_eval.size > 0, "t_eval", f"of shape {t_eval.shape}", "one row of times")
        require(bool(np.all(t_eval[1:] >= t_eval[:-1])), "t_eval", "not in order", "ascending times")
        require(
            bool(t_eval[0] >= t_start and t_eval[-1] <= t_stop),
            "t_eval",
            f"{t_eval[0]:g} s to {t_eval[-1]:g} s",
            f"times from {t_start:g} s to t_stop = {t_stop:g} s",
        )
    step = tran.step if tran is not None else (t_stop - t_start) / 1000.0
    return t_stop, step
