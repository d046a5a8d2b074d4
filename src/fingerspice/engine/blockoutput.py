"""Outputs of a recording at its samples, block by block, all at once; others one by one (`engine.blockpoints`)."""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_within
from fingerspice.engine.blockcourse import Course
from fingerspice.engine.blockcurrent import current_block
from fingerspice.engine.blockforms import OUTPUT
from fingerspice.engine.blockpoints import write_points
from fingerspice.engine.blockrows import largest_off, modes_into, scaled


@jit
def _spread(step: int, count: int, x: FloatArray, out: FloatArray) -> None:
    """Copy every entry of x at the distance `step`."""
    for j in range(count):
        out[j] = x[j * step]


@jit_within
def _column(c: Course, r: int, column: int, n: int, row: FloatArray) -> None:
    """A recorded voltage at the starts of n steps, into `row`."""
    form, shown, room = c.form, c.shown, c.room
    scaled(n, 0.0, room.s, row)
    modes_into(n, 0, shown.columns[r, column], room.w, row)
    for i in range(n):
        row[i] = shown.k[column] * room.s[i] + form.area0 * c.charges.q[0, i] * row[i]


@jit
def write_samples(c: Course, r: int, level: int, count: int, out: FloatArray, first: int) -> None:
    """Write the outputs at the first `count` samples of a block, from number `first` on."""
    room, shown, sub, own, last = c.room, c.shown, 1 << level, c.charges, first + count
    for column in range(shown.k.size):
        _column(c, r, column, count * sub, room.before)
        _spread(sub, count, room.before, out[column, first:last])
    if shown.charge:
        current_block(c, r, count * sub)
        _spread(sub, count, own.z, out[shown.k.size, first:last])
        _spread(sub, count, own.current, out[shown.k.size + 1, first:last])


@jit
def write_block(
    c: Course, r: int, level: int, count: int, h: float, start: float, t_out: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    """Write the outputs of a block of `count` samples from its start (s) on, without those at its very end."""
    n, first = count << level, c.counters[OUTPUT]
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
    if not aligned:
        for i in range(n + 1):
            c.charges.t[i] = start + i * h
        write_points(c, r, n, slack, t_out, out, last)
    else:
        write_samples(c, r, level, count, out, first)
    c.counters[OUTPUT] = last
