"""Types of numpy arrays, the numbers that a user gives, several arrays in one, and what objects and a process keep."""

from __future__ import annotations

import ctypes
import math
import os
import reprlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cache, cached_property
from numbers import Real
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.errors import InputError

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
_NO_NUMBERS = {"c": "complex numbers", "b": "booleans", "U": "texts", "S": "texts", "M": "dates", "m": "durations"}
T = TypeVar("T")
Array = TypeVar("Array", bound=np.ndarray[Any, Any])


def aligned(shapes: Iterable[tuple[int, ...]]) -> list[FloatArray]:
    """Zeros that begin at multiples of 64 bytes, as no vector should cross the lines of the cache."""
    whole = [(shape, math.prod(shape)) for shape in shapes]
    raw = np.zeros(8 + sum(size + 8 for _, size in whole))
    at, out = -(raw.ctypes.data // raw.itemsize) % 8, []
    for shape, size in whole:
        out.append(raw[at : at + size].reshape(shape))
        at += -(-size // 8) * 8
    return out


def read_only(x: Array) -> Array:
    """A view that cannot be written, as compiled code takes what it only reads: another type would be compiled anew."""
    view = x.view()
    view.flags.writeable = False
    return view


def real_numbers(what: str, given: object, allowed: str) -> FloatArray:
    """Numbers that a user gives as doubles, of any shape; they may be the given array itself.

    Refused are complex and masked ones, and what is no number (texts, booleans, dates, other objects, rows of unequal
    length); for the message, `what` names the numbers and `allowed` says what they may be.
    """
    kind = f", a {type(given).__name__}"
    with suppress(TypeError, ValueError, RuntimeError):  # NumPy makes no array of tensors with gradients or on a card.
        array = np.asarray(given)
        if np.ma.is_masked(given):
            kind += " with masked values"
        elif array.dtype.kind in "iuf":
            return np.asarray(array, float)
        else:
            kind = f"{kind} of {_NO_NUMBERS.get(array.dtype.kind, 'objects')}" if array.ndim else ""
    raise InputError(f"{what} is {reprlib.repr(given)}{kind}; allowed: {allowed}")


def real_number(what: str, given: object, allowed: str) -> float:
    """As `real_numbers`, of one number of any type, also an array or a tensor of no dimension."""
    if isinstance(given, Real) and not isinstance(given, (bool, np.timedelta64)):
        with suppress(OverflowError):
            return float(given)
    array = real_numbers(what, given, allowed)
    if array.ndim:
        raise InputError(f"{what} is {reprlib.repr(given)}, a {type(given).__name__}; allowed: {allowed}")
    return float(array)


def whole_number(what: str, given: object, least: int, most: float = math.inf) -> int:
    """As `real_number`, of a whole number from `least` to `most`."""
    allowed = f"{least} to {most:g}, a whole number" if most < math.inf else f"a whole number, {least} or more"
    number = real_number(what, given, allowed)
    if not (number.is_integer() and least <= number <= most):
        raise InputError(f"{what} is {given}; allowed: {allowed}")
    return int(number)


def positive_number(what: str, given: object, unit: str = "") -> float:
    """As `real_number`, of a finite number above 0."""
    allowed = f"a number{f' of {unit}' if unit else ''}, > 0"
    number = real_number(what, given, allowed)
    if not 0.0 < number < math.inf:
        raise InputError(f"{what} is {number:g} {unit}".rstrip() + f"; allowed: {allowed}")
    return number


def positive_row(what: str, given: object, unit: str) -> FloatArray:
    """As `real_numbers`, of finite numbers above 0, one or a row of them, as a row."""
    row = np.atleast_1d(real_numbers(what, given, f"positive numbers of {unit}"))
    if row.ndim > 1 or not np.all((row > 0.0) & (row < np.inf)):
        raise InputError(f"{what} is {reprlib.repr(given)} {unit}; allowed: positive numbers")
    return row


def views_of(shapes: Sequence[tuple[int, ...]]) -> tuple[FloatArray, list[FloatArray]]:
    """One row of zeros, and arrays of these shapes that are views of it, one after the other."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    numbers = np.zeros(ends[-1] if len(ends) else 0)
    return numbers, [part.reshape(shape) for part, shape in zip(np.split(numbers, ends)[:-1], shapes, strict=True)]


class Remembering:
    """An object that does not change, and remembers what follows from it; a pickled one does not."""

    @cached_property
    def kept(self) -> dict[Any, Any]:
        """What follows from the object, by key; it may be shared by objects that differ in something else only."""
        return {}

    def remember(self, key: tuple[Any, ...], make: Callable[[], T], most: int = 16) -> T:
        """The result of `make`, kept by its key, of which at most `most` share the first part; else all of these go.

        Other threads may remove entries at any time, or call `make` too, with the same result.
        """
        found: tuple[T] | None = self.kept.get(key)
        if found is None:
            alike = [name for name in list(self.kept) if name[0] == key[0]] if len(self.kept) >= most else ()
            for name in alike if len(alike) >= most else ():
                self.kept.pop(name, None)
            found = self.kept[key] = (make(),)
        return found[0]

    def __getstate__(self) -> dict[str, Any]:
        """All but what is computed when it is first asked for."""
        return {k: v for k, v in vars(self).items() if not isinstance(getattr(type(self), k, None), cached_property)}


@cache
def keep_freed_memory() -> None:
    """Keep up to 128 MB of freed memory in this process, if its environment asks glibc to give all of it back.

    Dask's workers start with MALLOC_TRIM_THRESHOLD_=65536, so that every array of a batch is memory that the system
    fetches and clears anew: a third of the time of fast scenes. Other C libraries have no such parameters.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if "MALLOC_TRIM_THRESHOLD_" in os.environ else None
    if mallopt is not None:
        # As in malloc.h: M_TRIM_THRESHOLD, what may be free at the top of the heap, and M_MMAP_THRESHOLD, the size
        # below which blocks come from the heap.
        for parameter in (-1, -3):
            mallopt(parameter, 128 << 20)
