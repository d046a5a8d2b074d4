"""Tuples of arrays that compiled code passes by their address, and functions chosen by the class of such a tuple."""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from fingerspice.base.compiled import borrow, jit, jit_by_kind


class Inner(NamedTuple):
    x: np.ndarray
    n: int


class Outer(NamedTuple):
    inner: Inner
    pair: tuple[np.ndarray, np.ndarray]
    y: np.ndarray
    on: bool
    scale: float


class Alike(NamedTuple):
    """All of one type: numba knows such tuples as another kind."""

    x: np.ndarray
    y: np.ndarray


def outer() -> Outer:
    return Outer(Inner(np.arange(3.0), 7), (np.ones(2), np.full(2, 5.0)), np.zeros((2, 3)), True, 0.5)


@njit
def _fill(c: Outer) -> float:
    c.y[1] = c.scale * c.inner.x
    return c.inner.n + c.pair[1][0] + (100.0 if c.on else 0.0)


@njit
def _filled(c: Outer) -> float:
    c = borrow(c)
    return _fill(c)


@njit
def _sum_inner(c: Outer) -> float:
    inner = borrow(borrow(c)).inner
    return inner.x.sum()


@njit
def _swapped(c: Alike) -> None:
    c = borrow(c)
    for i in range(c.x.size):
        c.x[i], c.y[i] = c.y[i], c.x[i]


def test_a_borrowed_tuple_is_read_and_its_arrays_are_written_as_those_of_the_tuple_itself() -> None:
    c = outer()
    assert _filled(c) == 7 + 5.0 + 100.0
    assert _filled(c._replace(on=False)) == 7 + 5.0
    np.testing.assert_array_equal(c.y, [[0.0, 0.0, 0.0], [0.0, 0.5, 1.0]])


def test_a_tuple_inside_a_borrowed_one_and_a_borrowed_one_borrowed_again_are_the_same() -> None:
    assert _sum_inner(outer()) == 3.0


def test_a_tuple_of_alike_arrays_can_be_borrowed() -> None:
    c = Alike(np.arange(3.0), np.full(3, 9.0))
    _swapped(c)
    np.testing.assert_array_equal(c.x, 9.0)
    np.testing.assert_array_equal(c.y, np.arange(3.0))


def test_borrowing_leaves_every_reference_count_as_it_was() -> None:
    c = outer()
    arrays = (c.inner.x, *c.pair, c.y)
    before = [sys.getrefcount(x) for x in arrays]
    for _ in range(100):
        _filled(c)
    assert [sys.getrefcount(x) for x in arrays] == before


def test_a_name_that_the_tuple_does_not_have_is_refused_when_it_is_compiled() -> None:
    @njit
    def wrong(c: Outer) -> float:
        return borrow(c).missing

    with pytest.raises(TypingError, match="missing"):
        wrong(outer())


@jit
def _of_outer(c: Outer, factor: float) -> float:
    return factor * c.scale


@jit
def _of_alike(c: Alike, factor: float) -> float:
    return factor * c.x.sum()


@jit_by_kind(Outer=_of_outer, Alike=_of_alike)
def _chosen(c: Outer | Alike, factor: float) -> float:
    raise NotImplementedError


@njit
def _either(c: Outer | Alike, is_borrowed: bool) -> float:
    return _chosen(borrow(c), 2.0) if is_borrowed else _chosen(c, 3.0)


def test_a_function_by_kind_is_that_of_the_tuples_class_borrowed_or_not() -> None:
    alike = Alike(np.arange(3.0), np.zeros(3))
    assert _either(outer(), True) == 2.0 * 0.5
    assert _either(outer(), False) == 3.0 * 0.5
    assert _either(alike, True) == 2.0 * 3.0
    assert _either(alike, False) == 3.0 * 3.0
