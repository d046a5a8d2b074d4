"""What the modules of `fingerspice.torch` are asked for, checked; and tensors of what they are given."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from fingerspice.base.errors import InputError
from fingerspice.circuit.arguments import require_number, times_given
from fingerspice.circuit.circuit import Circuit
from fingerspice.solve.simulation import RTOL_RANGE
from fingerspice.torch.scenes import MEANS, SIGNALS, Scenes
from fingerspice.waveforms.waveform import require

# What batches and runs accept both.
_LEAST_RTOL = 1e-12


def request(
    circuit: Circuit, names: tuple[str, ...], t: ArrayLike | None, t_stop: float | None, periodic: bool, rtol: float
) -> Scenes:
    """The checked request."""
    for name in names:
        if name not in (*MEANS, *SIGNALS):
            raise InputError(f"unknown output {name!r}; allowed: {', '.join((*MEANS, *SIGNALS))}")
    require(len(names) > 0, "outputs", "empty", "one or more names")
    require(len(set(names)) == len(names), "outputs", repr(names), "every name once")
    signals = [name for name in names if name in SIGNALS]
    times = times_given("t", t)
    if signals and (times is None or times.ndim != 1 or not times.size):
        raise InputError(f"{signals[0]} is asked for, and t is {t!r}; allowed: a row of times in s")
    if not signals and times is not None:
        raise InputError(f"t is given, and no signal is asked for; allowed: outputs such as {', '.join(SIGNALS)}")
    if t_stop is not None:
        require_number("t_stop", t_stop, "a number in s")
        require(math.isfinite(t_stop) and t_stop > 0.0, "t_stop", t_stop, "more than 0")
    elif circuit.tran is not None:
        t_stop = circuit.tran.stop
    elif signals or not periodic:
        raise InputError("no t_stop: the deck has no .tran line and none was given; give t_stop in s")
    require_number("rtol", rtol, "1e-12 to 0.1")
    require(_LEAST_RTOL <= rtol <= RTOL_RANGE[1], "rtol", rtol, "1e-12 to 0.1")
    return Scenes(circuit, names, np.zeros(0) if times is None else times, t_stop, bool(periodic), float(rtol))


def tensor_of(path: str, one: Tensor | ArrayLike) -> Tensor:
    """A value in double precision on the processor."""
    if not isinstance(one, Tensor):
        try:
            one = torch.from_numpy(np.array(one, float))
        except (TypeError, ValueError):
            raise InputError(f"{path} is {one!r}; allowed: a tensor or array of numbers") from None
    if one.is_complex():
        raise InputError(f"{path} is complex; allowed: real numbers")
    return one.to("cpu", torch.float64)
