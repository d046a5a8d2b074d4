"""Outputs of a recording at its samples, block by block, all at once; others one by one (`engine.blockpoints`)."""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_within
from fingerspice.engine.blockcharge import charge_within
from fingerspice.engine.blockcoarse import halved, look_within, place_at, slopes_into, span_of, steps_of
from fingerspice.engine.blockcourse import Course
from fingerspice.engine.blockcurrent import current_block
from fingerspice.engine.blockforms import OUTPUT, PLACES, Room
from fingerspice.engine.blockpoints import write_points
from fingerspice.engine.blockrows import add, largest_off, modes_into, of_source_and_modes, scaled
from fingerspice.engine.relaxation import find_kinks


@jit
def _spread(step: int, to: int, count: int, x: FloatArray, out: FloatArray) -> None:
    """Copy every entry of x at the distance `step` to entries of `out` at the distance `to`."""
    for j in range(count):
        out[j * to] = x[j * step]


@jit_within
def _column(c: Course, r: int, room: Room, column: int, n: int, q: FloatArray, row: FloatArray) -> None:
    """A recorded voltage at one place of n steps, whose rows are in `room`, into `row`; q (n,) is 1/A."""
    form, shown = c.form, c.shown
    if form.mobile:
        scaled(n, 0.0, room.s, row)
        modes_into(n, 0, shown.columns[r, column], room.w, row)
        for i in range(n):
            row[i] = shown.k[column] * room.s[i] + form.area0 * q[i] * row[i]
    else:
        of_source_and_modes(n, shown.k[column], room.s, shown.columns[r, column], room.w, row)
        if form.bend.size > 0:
            add(n, shown.bend[column], room.g[room.g.shape[0] - 1], row)


@jit
def _write_within(c: Course, r: int, level: int, j: int, n: int, kinks: int, out: FloatArray, first: int) -> None:
    """Write the outputs at sample j of each of n steps of several samples, from number `first` on.

    `kinks` of the steps have one.
    """
    shown, row, span, place = c.shown, c.room.slope, span_of(level), place_at(j, span_of(level))
    count = (n - 1) * span + 1
    look_within(c, r, level, place, n, kinks)
    for column in range(shown.k.size):
        _column(c, r, c.inner, column, n, c.inner.before, row)
        _spread(1, span, n, row, out[column, first : first + count])
    if shown.charge:
        charge_within(c, PLACES[place], n, row)
        _spread(1, span, n, row, out[shown.k.size, first : first + count])
        slopes_into(c, n, j, row)
        current_block(c, r, c.inner, n, row, c.inner.before)
        _spread(1, span, n, c.charges.current, out[shown.k.size + 1, first : first + count])


@jit
def write_samples(c: Course, r: int, level: int, count: int, out: FloatArray, first: int) -> None:
    """Write the outputs at the first `count` samples of a block, from number `first` on."""
    room, shown, n, sub, span = c.room, c.shown, steps_of(level, count), halved(level), span_of(level)
    last, own = first + count, c.charges
    for column in range(shown.k.size):
        # A row of a row-major array is known to be contiguous, unlike one of a slice of that array.
        whole = sub == 1 and span == 1
        row = out[column, first:last] if whole else room.before
        _column(c, r, room, column, n, own.q[0], row)
        if not whole:
            _spread(sub, span, count // span, row, out[column, first:last])
    if shown.charge:
        slopes_into(c, n, 0, room.slope)
        current_block(c, r, room, n, room.slope, own.q[0])
        _spread(sub, span, count // span, own.z, out[shown.k.size, first:last])
        _spread(sub, span, count // span, own.current, out[shown.k.size + 1, first:last])
    kinks = find_kinks(c.form, room, n) if span > 1 else 0
    for j in range(1, span):
        _write_within(c, r, level, j, n, kinks, out, first + j)


@jit
def write_block(
    c: Course, r: int, level: int, count: int, h: float, start: float, t_out: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    """Write the outputs of a block of `count` samples from its start (s) on, without those at its very end."""
    shown, n, first = c.shown, steps_of(level, count), c.counters[OUTPUT]
    slack = 8e-16 * (abs(start) + n * h)
    end, size, last = start + n * h - slack, t_out.size, first + count
    aligned = last <= size and t_out[last - 1] < end and (last == size or t_out[last] >= end)
    aligned = aligned and largest_off(count, start, h * n / count, t_out[first:last]) <= slack
    if not aligned:
        last = first
        while last < size and t_out[last] < end:
            last += 1
    if last == first:
        return
    if not aligned or shown.flows > 0:
        for i in range(n + 1):
            c.charges.t[i] = start + i * h
        write_points(c, r, n, slack, t_out, out, last)
    else:
        write_samples(c, r, level, count, out, first)
    c.counters[OUTPUT] = last
