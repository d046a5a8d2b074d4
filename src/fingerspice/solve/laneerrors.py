"""Errors of a block of a recording in lanes.

A window of each piece, where the source moves most, is followed by steps half as long. The difference is the error of
the window; a piece adds as much more as it is longer, and hands it on to the pieces after it, as the modes decay: once
as if all errors were alike, and once as if they came by chance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.solve.laneblock import Block, Window
from fingerspice.solve.laneform import LaneForm, Shown

# Stated over seen errors, of voltages, of the force and of charges: as seen in recordings of tests/recording_errors.py.
SAFETY, OF_FORCE, OF_CHARGE = 2.25, 1.75, 2.5
# Errors by chance look alike to so many times what they add up to, as windows show a part of them only.
LUCK = 2.0


@dataclass(frozen=True)
class Judged:
    """Errors that are seen of a block, without safety."""

    errors: FloatArray  # (4,): Of gap voltage (V), force (N), nodes (V) and charges (C)
    alone: float  # Error of xi (V) that a single piece makes
    alike: FloatArray  # (m,): Errors of the modes that the block hands on, as if they were alike
    chance: FloatArray  # (m, m): Products of two, as if they came by chance


@dataclass(frozen=True)
class _Steep:
    """What an error of xi changes in each piece, at most: between 0 V and its peak."""

    u: FloatArray  # (pieces,): Gap voltage, V/V
    force: FloatArray  # N/V
    moved: FloatArray  # What `Shown.bends` multiplies, m^2
    inverse: FloatArray  # 1/A, 1/m^2/V


def _steep(form: LaneForm, block: Block, top: FloatArray) -> _Steep:
    c = form.lanes
    inverse = form.inverse_area(np.stack([np.zeros(top.size), top]))
    force = _slope_of_force(form, top)
    if not form.mobile:
        e = 1.0 / inverse - 1.0 / c.q0
        u, moved = (np.abs(x / (1.0 + c.kappa * e)).max(axis=0) for x in (1.0, e))
        return _Steep(u, force, moved, np.zeros(top.size))
    u = inverse.max(axis=0) / c.q0 / block.margin
    steep = np.abs(form.slope(np.stack([np.zeros(top.size), top]))) * u
    source = float(np.abs(block.x).max())
    return _Steep(u, force * u, (source * steep / inverse**2).max(axis=0), steep.max(axis=0))


def _slope_of_force(form: LaneForm, xi: FloatArray) -> FloatArray:
    """By |xi|, N/V."""
    return np.asarray((form.force(1.001 * xi) - form.force(xi)) / (1e-3 * xi))


def _changes(form: LaneForm, shown: Shown, window: Window, xi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest changes of quantities in windows, where xi goes to other values, and sums of the modes: (C, pieces)."""
    m = form.lanes.rates.size
    found, whole = np.einsum("ck,kij->cij", shown.columns, window.off[:m]), np.zeros((shown.k.size, 1, 1))
    if shown.by_area.any():
        whole = np.einsum("ck,kij->cij", shown.columns, window.z[:m])
        inverse, other = form.inverse_area(window.xi), form.inverse_area(xi)
        found = np.where(shown.by_area[:, None, None], other * found + (other - inverse) * whole, found)
    if shown.bends.any():
        moved = form.moved(xi, window.source) - form.moved(window.xi, window.source)
        found += shown.bends[:, None, None] * moved
    return np.abs(found).max(axis=-1, initial=0.0), np.abs(whole).max(axis=-1, initial=0.0)


def judge(block: Block, parts: int, peak: float, alike: FloatArray, chance: FloatArray) -> Judged:
    """Errors of a block that has been followed in `parts` steps a sample.

    Parameters
    ----------
    peak : float
        Largest |xi| so far, V.
    alike, chance : ndarray, shape (m,) and (m, m)
        Errors at the start, as in `Judged`.
    """
    form, active = block.form, block.active
    c, window = form.lanes, block.check(parts)
    own = window.off[: c.rates.size, :, -1]
    products = own[:, None] * own
    handed, lucky = block.hand_on(own * window.share, alike), block.hand_on(products * window.of_products, chance)
    # What a piece adds beyond its window.
    alike_more, chance_more = own * (window.share - 1.0), products * (window.of_products - 1.0)

    def added(columns: FloatArray, left: FloatArray) -> FloatArray:
        """Of sums of the modes (C, m): by chance, or by errors that are alike where chance does not explain them.

        `left` (m, pieces) is left of each mode of what a piece starts with.
        """
        there = lucky[..., :-1] * left[:, None] * left + chance_more
        by_chance = np.sqrt(np.maximum(np.einsum("ck,cl,kli->ci", columns, columns, there), 0.0))
        there = np.abs(columns @ (handed[:, :-1] * left + alike_more))
        swept = np.abs(columns[:, :active]) * (block.left[:active] / OF_FORCE)
        return np.asarray(np.maximum(by_chance, there - LUCK * by_chance) + swept @ left[:active])

    least = 1e-9 * peak + 1e-300
    errors, charges = np.zeros(4), form.rows.behind(form.rows.k.size - form.flows)
    over, *others = added(np.vstack([c.shape, form.nodes.columns, charges.columns]), np.ones(own.shape))
    top = np.maximum(block.peaks, least)
    steep, xi = _steep(form, block, top), window.xi + np.einsum("k,kij->ij", form.xi[1], window.off)
    # An error that a fast mode brings into a piece changes the force as much as xi at the first sample allows.
    decay = np.exp(-block.rates[:, None] * (block.h[block.first] if block.own else block.h))
    first_xi = np.maximum(np.abs(block.xi[np.minimum(block.first, block.n)]) + over, least)
    at_first = _slope_of_force(form, first_xi) * (steep.u if form.mobile else 1.0) * over
    of_force = np.maximum(at_first, steep.force * added(c.shape[None], decay * np.ones(own.shape))[0])
    for i, of, more in ((0, form.gap, steep.u * over), (1, form.force, of_force)):
        errors[i] = (np.abs(of(xi) - of(window.xi)).max(axis=1) + more).max()
    for i, shown in ((2, form.nodes), (3, charges)):
        found, whole = _changes(form, shown, window, xi)
        more = np.reshape(others[: shown.k.size], (-1, own.shape[1]))
        more = np.where(shown.by_area[:, None], more * steep.u * c.q0 + whole * steep.inverse * over, more)
        more = more + np.abs(shown.bends)[:, None] * steep.moved * over
        errors[i] = (found + more).max(initial=0.0)
        others = others[shown.k.size :]
    alone = np.abs(np.einsum("k,kij->ij", c.shape, window.off[: c.rates.size])).max()
    alone += np.abs(c.shape @ (own * (window.share - 1.0))).max()
    return Judged(errors, float(alone), handed[:, -1], lucky[..., -1])
