"""Reference areas of a network: which of them fits the present areas, and the change from one to another."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit
from fingerspice.engine.netform import Form
from fingerspice.numerics.small import copy_to

# Ratio of neighbouring reference areas, and the ratio of an area to its reference beyond which another one is taken.
LEVEL_RATIO, FARTHEST = 1.28, 1.2


class References(NamedTuple):
    """The forms of a network around several reference areas."""

    levels: IntArray  # (room, n_area): Areas of each reference over those at 0 V, as powers of LEVEL_RATIO
    numbers: FloatArray  # (room, size): See `Form`
    # used, wanted (1,): Number of references; the levels that were looked for last
    used: IntArray
    wanted: IntArray


@jit
def far_from(form: Form, area: FloatArray) -> bool:
    """Whether some area (n_area,) is too far away from its reference."""
    for a in range(area.size):
        if form.cell[a] >= 0 and max(area[a] / form.area0[a], form.area0[a] / area[a]) > FARTHEST:
            return True
    return False


@jit
def find(references: References, form: Form, area: FloatArray) -> int:
    """The reference nearest to these areas (n_area,), or -1 if it has not been made; its levels into `wanted`."""
    wanted = references.wanted
    for a in range(area.size):
        wanted[a] = 0
        if form.cell[a] >= 0:
            wanted[a] = round(math.log(area[a] / form.unit[a]) / math.log(LEVEL_RATIO))
    for one in range(references.used[0]):
        same = True
        for a in range(area.size):
            same &= references.levels[one, a] == wanted[a]
        if same:
            return one
    return -1


@jit
def go_over(references: References, one: int, form: Form, error: FloatArray) -> None:
    """Turn a form into that of another reference, and transform the error of the modes."""
    n = form.shape.shape[0]
    x = np.zeros(n)
    for i in range(n):
        for k in range(n):
            x[i] += form.shape[i, k] * error[k]
    copy_to(form.numbers, references.numbers[one])
    for k in range(n):
        error[k] = 0.0
        for i in range(n):
            error[k] += form.inverse[k, i] * x[i]


@jit
def start_at(area0: FloatArray, area: FloatArray) -> None:
    """Areas (n_area, ROWS) as at their references."""
    for a in range(area0.size):
        for i in range(area.shape[1]):
            area[a, i] = area0[a]
