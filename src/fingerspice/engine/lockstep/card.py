"""Scenes of a batch in lockstep on a graphics card, each in a thread of its own, by the processor's own functions.

The functions of `engine.lockstep.march` are compiled a second time, for the card and for blocks of one scene: method,
steps and results are the same but for rounding. A thread keeps constants, weights and state of its scene in memory of
its own, whose sizes are constants of the kernel. It reads a column of the table and writes sums over the run, so that
nothing that grows with the number of steps leaves the card.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.card import card_compiler, for_card
from fingerspice.engine.lockstep.march import How, Source, march_block
from fingerspice.engine.lockstep.scenes import Scenes, block_shapes
from fingerspice.engine.lockstep.step import Marks, marks_of

Lengths = tuple[int, int, int, int, int]
"""Numbers of modes, waves, leaks, powers and moments."""
THREADS = 64
"""Threads of a block on the card."""
# The compiler, loaded where it is needed; its simulator looks for it among a kernel's global names.
cuda: Any = None
# Copies and kernels of several threads of the processor would only wait for each other.
_CARD = Lock()


@lru_cache(maxsize=64)
def thread_kernel(lengths: Lengths, rows: int, pieces: int) -> Callable[..., None]:
    """The function of a thread, for tables of so many rows and at most so many pieces of a half period, 0 for none."""
    global cuda
    cuda, integrate = card_compiler(), for_card(march_block)
    marks: Marks = marks_of(*lengths, lanes=1)
    modes = lengths[0]
    found, scratches, steppings = block_shapes(rows, pieces or 4, marks)
    (constants,), (cells,), (both,), (points,) = found[0], scratches[0], scratches[5], scratches[7]
    (row,), (most, _, _), (states,), (sums,), *_ = steppings
    jumping = pieces > 0

    def kernel(
        table: Any, pending: Any, gap: int, leaks: Any, series: Any, nodes: Any, matrix: Any, tones: Any, coarse: Any,
        fine: Any, halves: int, half: int, count: int, periodic: bool, tol: float, covered: float, out: Any,
    ) -> None:  # fmt: skip
        first = cuda.grid(1)
        if first >= pending.size:
            return
        scratch = (
            cuda.local.array(cells, np.float64), cuda.local.array(cells, np.float64),
            cuda.local.array(cells, np.float64), cuda.local.array(1, np.float64), cuda.local.array(modes, np.float64),
            cuda.local.array(both, np.float64), cuda.local.array(both, np.float64),
            cuda.local.array(points, np.float64), cuda.local.array((2, cells), np.float64),
            cuda.local.array((2, modes), np.float64), cuda.local.array((2, cells, modes), np.float64),
            cuda.local.array((2, cells), np.float64), cuda.local.array((2, cells), np.int64),
        )  # fmt: skip
        columns = (
            cuda.local.array(constants, np.float64), cuda.local.array(modes, np.float64),
            cuda.local.array((modes, 1), np.float64), cuda.local.array((modes, 1), np.float64),
            cuda.local.array(rows, np.float64), cuda.local.array(1, np.float64),
            cuda.local.array(1, np.float64),
        )  # fmt: skip
        stepping = (
            cuda.local.array(row, np.float64), cuda.local.array((most, 3, row), np.float64),
            cuda.local.array(states, np.float64), cuda.local.array(sums, np.float64),
            cuda.local.array(modes, np.float64), cuda.local.array(modes, np.float64), cuda.local.array(1, np.float64),
            cuda.local.array(1, np.float64), cuda.local.array((11, 1), np.float64),
        )  # fmt: skip
        how = (halves, half, count if jumping else 0, periodic, tol, covered)
        scenes, none = (table, pending, (gap, leaks), (series, nodes, matrix)), columns[5][:0]
        block = (columns, scratch, stepping)
        integrate(scenes, first, (tones, (coarse, fine)), how, block, out, (none, none), marks)

    return kernel


@lru_cache(maxsize=64)
def _compiled(lengths: Lengths, rows: int, pieces: int) -> Any:
    """The kernel, which is compiled at its first call."""
    return card_compiler().jit(thread_kernel(lengths, rows, pieces))


def march_on_card(scenes: Scenes, source: Source, how: How, most_pieces: int, lengths: Lengths) -> FloatArray:
    """Integrate scenes of a table as `march.march` does, and return its `out`; `most_pieces` as for `thread_kernel`."""
    table, pending, (gap, leaks), curves = scenes
    kernel = _compiled(lengths, table.shape[0], most_pieces)
    chosen = np.ascontiguousarray(table[:, pending])  # Not always in the order of the table
    with _CARD:
        given = (chosen, np.arange(pending.size), leaks, *curves, source[0], *source[1])
        columns, order, *arrays = (cuda.to_device(x) for x in given)
        out = cuda.device_array((2, 2 * lengths[4] + 3, pending.size))
        kernel[-(-pending.size // THREADS), THREADS](columns, order, gap, *arrays, *how, out)
        return np.asarray(out.copy_to_host())
