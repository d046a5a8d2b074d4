"""What the modules of `fingerspice.torch` are asked for, checked; and tensors of what they are given."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from fingerspice.base.arrays import positive_number, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.results.sensitivity import MEANS, SIGNALS
from fingerspice.solve.simulation import rtol_given
from fingerspice.studies.batch import LEAST_RTOL
from fingerspice.torch.scenes import Scenes
from fingerspice.waveforms.waveform import require


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
    times = None if t is None else real_numbers("t", t, "numbers in s")
    if signals and (times is None or times.ndim != 1 or not times.size):
        raise InputError(f"{signals[0]} is asked for, and t is {t!r}; allowed: a row of times in s")
    if not signals and times is not None:
        raise InputError(f"t is given, and no signal is asked for; allowed: outputs such as {', '.join(SIGNALS)}")
    if t_stop is not None:
        t_stop = positive_number("t_stop", t_stop, "s")
    elif circuit.tran is not None:
        t_stop = circuit.tran.stop
    elif signals or not periodic:
        raise InputError("no t_stop: the deck has no .tran line and none was given; give t_stop in s")
    return Scenes(
        circuit, names, np.zeros(0) if times is None else times, t_stop, bool(periodic), rtol_given(rtol, LEAST_RTOL)
    )


def tensor_of(path: str, one: Tensor | ArrayLike) -> Tensor:
    """A value in double precision on the processor."""
    if not isinstance(one, Tensor):
        one = torch.from_numpy(real_numbers(path, one, "a tensor or array of numbers").copy())
    if one.is_complex() or one.dtype == torch.bool:
        raise InputError(f"{path} is a tensor of {one.dtype}; allowed: real numbers")
    return one.to("cpu", torch.float64)
