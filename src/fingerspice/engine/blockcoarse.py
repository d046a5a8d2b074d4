"""Steps of several samples, for recordings that vary little from one sample to the next, in stacks under `local`.

Such a step has two or four samples. Within it the source is a straight line and three triangles (`blockforms.Coarse`),
to which the response of the modes is exact, as it is to the straight line alone in steps of one sample. The triangles
that follow in the drives are known, too (`engine.blockhats`).
"""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.blockcourse import Course
from fingerspice.engine.blockforms import BLOCK, FIRST_QUARTER, LAST_QUARTER, MIDDLE, ONE, PLACES, SPAN
from fingerspice.engine.blockhats import add_hats
from fingerspice.engine.blockkinks import add_where, respond_to_kinks
from fingerspice.engine.blockrows import (
    PAD,
    add,
    add_to_all,
    add_two,
    add_with_bumps,
    both_ends,
    forced_by,
    largest_of,
    sum_of,
)
from fingerspice.engine.relaxation import NEWTON, look_at_ends, project_at_ends
from fingerspice.numerics.moments import moments

# Largest triangle in the middle of a step, over the largest voltage of a block. The errors of gap voltage and force are
# measured, and would often allow larger ones; that of the charge would then be several times that of single samples.
SMOOTH = 0.03


@jit
def span_of(level: int) -> int:
    """Number of samples in a step, 1 for halvings of a sample."""
    return 1 << max(ONE - level, 0)


@jit
def halved(level: int) -> int:
    """Number of steps of a sample, 1 for steps of several samples."""
    return 1 << max(level - ONE, 0)


@jit
def steps_of(level: int, count: int) -> int:
    """Number of steps of `count` samples."""
    return count * halved(level) // span_of(level)


@jit
def most_samples(level: int) -> int:
    """Number of samples in a block."""
    return BLOCK * span_of(level) // halved(level)


@jit
def fitting(level: int, count: int) -> int:
    """The longest step length from `level` on that is not longer than `count` samples."""
    while span_of(level) > count:
        level += 1
    return level


@jit_rows
def _fill(n: int, span: int, values: FloatArray, s: FloatArray, bumps: FloatArray) -> None:
    """The source at the ends of n steps of 2 or 4 samples, and the triangles' heights."""
    for i in range(n + 1):
        s[i] = values[i * span]
    half, quarter = span // 2, span // 4
    for i in range(n):
        a, e = s[i], s[i + 1]
        b = values[i * span + half] - 0.5 * (a + e)
        bumps[MIDDLE, i] = b
        bumps[FIRST_QUARTER, i] = values[i * span + quarter] - (0.75 * a + 0.25 * e) if quarter > 0 else 0.5 * b
        bumps[LAST_QUARTER, i] = values[i * span + 3 * quarter] - (0.25 * a + 0.75 * e) if quarter > 0 else 0.5 * b


@jit
def load_source(c: Course, values: FloatArray, at: int, count: int, level: int) -> None:
    """The source in the steps of `count` samples from number `at` on."""
    s, sub, span = c.room.s, halved(level), span_of(level)
    c.control[SPAN] = span
    if span > 1:
        _fill(count // span, span, values[at:], s, c.room.bumps)
    elif sub == 1:
        for j in range(count + 1):
            s[j] = values[at + j]
    else:
        for j in range(count):
            here = values[at + j]
            for i in range(sub):
                s[j * sub + i] = here + (i / sub) * (values[at + j + 1] - here)
        s[count * sub] = values[at + count]


@jit_rows
def _bends(n: int, s: FloatArray, out: FloatArray) -> None:
    """Distances of values from the middle of their neighbours."""
    for i in range(n):
        out[i] = s[i + 1] - 0.5 * (s[i] + s[i + 2])


@jit_within
def may_be_longer(c: Course, n: int) -> bool:
    """Whether the source varies so little in a block of n steps that steps twice as long may do."""
    _bends(n - 1, c.room.s, c.room.slope)
    return largest_of(n - 1, c.room.slope) <= SMOOTH * largest_of(n + 1, c.room.s)


@jit_within
def is_smooth(c: Course, n: int) -> bool:
    """Whether the source varies little enough in a block of n steps, as it does if they are not of several samples."""
    return c.control[SPAN] == 1.0 or largest_of(n, c.room.bumps[MIDDLE]) <= SMOOTH * largest_of(n + 1, c.room.s)


@jit
def place_at(j: int, span: int) -> int:
    """The place of sample j of a step, -1 at the ends of the step."""
    quarters = 4 * j // span
    return -1 if quarters % 4 == 0 else FIRST_QUARTER if quarters == 1 else MIDDLE if quarters == 2 else LAST_QUARTER


@jit_within
def slopes_into(c: Course, n: int, j: int, out: FloatArray) -> None:
    """Slope of the source (V/s) after sample j of every step of a block."""
    room, span = c.room, int(c.control[SPAN])
    _slopes(n, room.s, c.charges.h, out)
    for side, place in ((1.0, place_at(j + 1, span)), (-1.0, place_at(j, span))):
        if place >= 0:
            add(n, side * span / c.charges.h[0], room.bumps[place], out)


@jit_rows
def _slopes(n: int, s: FloatArray, h: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = (s[i + 1] - s[i]) / h[i]


@jit
def _jumps(bumps: FloatArray, i: int) -> tuple[float, float, float, float]:
    """Jumps of the slope of triangles (3, n) at 0, 1/4, 1/2 and 3/4 of step i, per step."""
    early, middle, late = bumps[FIRST_QUARTER, i], bumps[MIDDLE, i], bumps[LAST_QUARTER, i]
    return 4.0 * early, 4.0 * (middle - 2.0 * early), 4.0 * (early - 2.0 * middle + late), 4.0 * (middle - 2.0 * late)


@jit
def bump_at(c: Course, i: int, at: float) -> tuple[float, float]:
    """Height of the triangles at fraction `at` of step i (V), and their slope just after it (V per step)."""
    height, slope = 0.0, 0.0
    if c.control[SPAN] > 1.0:
        for quarter, jump in enumerate(_jumps(c.room.bumps, i)):
            since = at - 0.25 * quarter
            # Times are right to rounding only, and the slope is the one after a sample.
            if since > -1e-6:
                height += jump * max(since, 0.0)
                slope += jump
    return height, slope


@jit
def _response(bumps: FloatArray, i: int, at: float, z: float, found: FloatArray) -> float:
    """Integral of exp(-z (at - x)) times triangles over x from 0 to `at` in step i; `found` (3,) is scratch."""
    total = 0.0
    for quarter, jump in enumerate(_jumps(bumps, i)):
        since = at - 0.25 * quarter
        if since > 0.0:
            moments(z * since, found[:2])
            total += jump * since * since * found[1]
    return total


@jit
def bump_response(c: Course, r: int, k: int, h: float, i: int, at: float, found: FloatArray) -> float:
    """What triangles within step i, of length h (s), add to mode k at the fraction `at`; `found` (3,) is scratch."""
    if c.control[SPAN] == 1.0:
        return 0.0
    form, room, z = c.form, c.room, c.form.rates[r, k] * h
    total = form.gain[r, k] * _response(room.bumps, i, at, z, found)
    for t in range(room.g.shape[0]):
        total += form.feed[r, k, t] * _response(room.hats[t], i, at, z, found)
        moments(z * at, found)
        parabola = 4.0 * at * at * (found[1] - at * found[2])
        total -= form.feed[r, k, t] * room.hats[t, MIDDLE, i] * parabola
    return float(total * h)


@jit_within
def _modes_within(c: Course, r: int, level: int, place: int, n: int, kinks: int) -> None:
    """Modes at a place within the steps, along the polynomials through the drives at all five places."""
    form, room, coarse, h = c.form, c.room, c.form.coarse, c.charges.h[0]
    early, late, part = room.g_within[FIRST_QUARTER], room.g_within[LAST_QUARTER], room.other[PAD:]
    for k in range(c.w.size):
        w, missed = c.inner.w[k], coarse.defect[r, level, place, k]
        forced_by(
            n, coarse.source[r, level, place, k], coarse.drive[r, level, place, k], room.s, room.g,
            room.g_within[MIDDLE], w,
        )  # fmt: skip
        add_with_bumps(
            n, coarse.decay[r, level, place, k], room.w[k], coarse.bump_to[r, level, place, k], room.bumps, w
        )  # fmt: skip
        for t in range(room.g.shape[0]):
            add_two(n, missed[t, 0], early[t], missed[t, 1], late[t], w)
        add_hats(room, coarse.hat_to[r, level, place, k], n, w)
        if kinks > 0:
            sum_of(n + 1, room.kinked[k], room.end[1:], room.slope)
            respond_to_kinks(
                kinks, room.where, form.rates[r, k] * h, PLACES[place], coarse.share[r, level, place, k], room.crossed,
                room.jumps, room.bends, room.slope, part,
            )  # fmt: skip
            add_where(kinks, room.where, part, w)


@jit
def look_within(c: Course, r: int, level: int, place: int, n: int, kinks: int) -> None:
    """Source and modes at a place within the steps, `kinks` of which have one, into `Course.inner`.

    If the charge is wanted, so are gap voltages, drives, the voltages of the slowest layer, and 1/A (`Room.before`).
    """
    form, room, inner = c.form, c.room, c.inner
    both_ends(n, 1.0 - PLACES[place], PLACES[place], room.s, inner.s)
    add(n, 1.0, room.bumps[place], inner.s)
    _modes_within(c, r, level, place, n, kinks)
    if not c.shown.charge:
        return
    look_at_ends(form, inner, r, n, NEWTON)
    for p in range(1 + inner.g.shape[0], form.tap_s.size):
        project_at_ends(form, inner, r, n, p)
    add_to_all(n, form.q0[r], inner.z, inner.before)
