"""Scenes of a batch in lockstep on a graphics card, each in a thread of its own, by the processor's own functions.

The compiler for cards is an optional package: numba-cuda, or its successor numba-cuda-mlir.

The functions of `engine.lockstep.march` are compiled a second time, for the card and for blocks of one scene: method,
steps and results are the same but for rounding. A thread keeps constants, weights and state of its scene in memory of
its own, whose sizes are constants of the kernel. It reads a column of the table and writes sums over the run, so that
nothing that grows with the number of steps leaves the card.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from functools import cache, lru_cache
from importlib.util import find_spec
from threading import Lock
from types import FunctionType
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.engine.lockstep.march import How, Source, march_block
from fingerspice.engine.lockstep.scenes import Scenes, block_shapes
from fingerspice.engine.lockstep.step import Marks, marks_of

# The package to look for, and the module to import; numba-cuda puts itself in the place of numba's own module.
_COMPILERS = (("numba_cuda", "numba.cuda"), ("numba_cuda_mlir", "numba_cuda_mlir.cuda"))
_HINT = "allowed: 'cpu', or 'cuda' on a machine with an NVIDIA card, its driver and `pip install 'fingerspice[gpu]'`"


@cache
def card_compiler() -> Any:
    """The module with `jit`, `grid`, `local` and `to_device`; numba's simulator where NUMBA_ENABLE_CUDASIM is 1."""
    simulated = os.environ.get("NUMBA_ENABLE_CUDASIM") == "1"
    for package, module in _COMPILERS:
        if simulated or find_spec(package):
            return importlib.import_module(module)
    raise InputError(f"device is 'cuda', and no compiler for graphics cards is installed; {_HINT}")


@cache
def for_card(compiled: Any) -> Any:
    """A function that `base.compiled` compiled for the processor, and all that it calls, as functions of the card."""
    # numba-cuda would do that by itself, but numba-cuda-mlir does not know numba's functions.
    function = compiled.py_func
    known = dict(function.__globals__)
    for name in function.__code__.co_names:
        if hasattr(known.get(name), "py_func"):
            known[name] = for_card(known[name])
    copied = FunctionType(function.__code__, known, function.__name__, function.__defaults__, function.__closure__)
    copied.__qualname__, copied.__module__ = function.__qualname__, function.__module__
    return card_compiler().jit(copied, device=True)


def require_card() -> None:
    """Raise `InputError` if there is no compiler for graphics cards, or no card that it can use."""
    if not card_compiler().is_available():
        raise InputError(f"device is 'cuda', and no card was found that its compiler can use; {_HINT}")


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
    (most, row), (states,), (sums,), *_ = steppings
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
            cuda.local.array((most, row), np.float64), cuda.local.array(states, np.float64),
            cuda.local.array(sums, np.float64), cuda.local.array(modes, np.float64),
            cuda.local.array(modes, np.float64), cuda.local.array(1, np.float64), cuda.local.array(1, np.float64),
            cuda.local.array((9, 1), np.float64),
        )  # fmt: skip
        how = (halves, half, count if jumping else 0, periodic, tol, covered)
        scenes, none = (table, pending, (gap, leaks), (series, nodes, matrix)), columns[2][:0]
        block = (columns, scratch, stepping)
        integrate(scenes, first, (tones, (coarse, fine), False), how, block, out, (none, none), marks)

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
