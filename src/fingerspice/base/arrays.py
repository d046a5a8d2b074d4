"""Types of numpy arrays, named once for the whole package; and several arrays in one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Array = TypeVar("Array", bound=np.ndarray[Any, Any])


def read_only(x: Array) -> Array:
    """A view that cannot be written, as compiled code takes what it only reads.

    To the compiler an array that can be written is of another type, for which a loop would be compiled once more.
    """
    view = x.view()
    view.flags.writeable = False
    return view


def views_of(shapes: Sequence[tuple[int, ...]]) -> tuple[FloatArray, list[FloatArray]]:
    """One row of zeros, and arrays of these shapes that are views of it, one after the other."""
    sizes = [math.prod(shape) for shape in shapes]
    numbers = np.zeros(sum(sizes))
    ends = np.cumsum(sizes)
    return numbers, [
        numbers[end - size : end].reshape(shape) for shape, size, end in zip(shapes, sizes, ends, strict=True)
    ]
