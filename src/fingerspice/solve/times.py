"""Length of a run and spacing of its outputs, and the limits of both: a run beyond them would never finish."""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.notices import time_slip
from fingerspice.waveforms.sampling import same_time
from fingerspice.waveforms.waveform import Waveform, require

#: Most periods (or shortest time scales) of the source in a run, and most breakpoints: they take hours and a gigabyte.
MOST_PERIODS, MOST_BREAKPOINTS = 1e10, 4e9
#: Most bytes of the signals at the deck's own output times; writing a file needs three times as much memory.
MOST_BYTES = 2e9


def run_times(circuit: Circuit, t_start: float, t_stop: float | None, t_eval: FloatArray | None) -> tuple[float, float]:
    """End of the run and output spacing, s; times of `t_eval` that pass an end by rounding are set to it, in place."""
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
        to_ends(t_eval, t_start, t_stop)
        first, last = float(t_eval[0]), float(t_eval[-1])
        require(
            first >= t_start and last <= t_stop,
            "t_eval",
            f"{first:g} s to {last:g} s",
            f"times from {t_start:g} s to t_stop = {t_stop:g} s{time_slip(first, last, t_stop)}",
        )
    step = tran.step if tran is not None else (t_stop - t_start) / 1000.0
    return t_stop, step


def to_ends(t: FloatArray, t_start: float, t_stop: float) -> None:
    """Set times (s, ascending) that pass an end of the run by rounding to that end, in place."""
    slack = same_time(t_stop)
    t[(t < t_start) & (t >= t_start - slack)] = t_start
    t[(t > t_stop) & (t <= t_stop + slack)] = t_stop


# Most signals that one element adds to the outputs: a GAP adds most, with its two nodes and its area.
_MOST_COLUMNS = 12


def check_length(waveform: Waveform, t_start: float, t_stop: float) -> None:
    """Refuse a run with more periods or breakpoints than can be computed.

    Raises
    ------
    InputError
        Its message tells their number.
    """
    span = t_stop - t_start
    periods = span / waveform.shortest_time()
    require(
        periods <= MOST_PERIODS,
        "the run",
        f"{span:g} s long, {periods:.3g} periods or time constants of its source",
        f"at most {MOST_PERIODS:.0e} of them",
    )
    breakpoints = span * waveform.breakpoint_rate()
    require(
        breakpoints <= MOST_BREAKPOINTS,
        "the run",
        f"{span:g} s long, {breakpoints:.3g} breakpoints of its source",
        f"at most {MOST_BREAKPOINTS:.0e} of them",
    )


def check_outputs(circuit: Circuit, count: float) -> None:
    """Refuse a number of output times for whose signals memory is too small.

    Raises
    ------
    InputError
        Its message tells the memory needed.
    """
    if 8.0 * count * _MOST_COLUMNS * len(circuit.elements) <= MOST_BYTES:
        return
    devices = [element.device for element in circuit.elements]
    layers = sum(element.spec.is_layer for element in circuit.elements)
    nodes = len({node for element in circuit.elements for node in element.nodes})
    columns = layers + nodes + 7 * devices.count("GAP") + 3 * (devices.count("V") + devices.count("I")) + 1
    size = 8.0 * columns * count
    require(
        size <= MOST_BYTES,
        "the run",
        f"one of {count:.3g} outputs with {columns} signals, {size / 1e9:.3g} GB",
        f"at most {MOST_BYTES / 1e9:g} GB: a longer TSTEP, or a TSTART that leaves out the beginning",
    )
