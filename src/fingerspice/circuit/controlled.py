"""Controlled sources and inductors in the equations of a network.

A network is reduced as if each of them were a source w like the deck's own, and `closed` then puts in what they follow:

- E and G the voltages between nodes, F and H the currents j that voltage sources deliver; these are linear equations.
- Inductors have currents i = sqrt(c) W z + N a, with W^T M W = 1 and M N = 0 for their matrix M of inductances. The
  further states z are voltages of capacitors c that hold the same energy, c z' = sqrt(c) W^T u with the inductors'
  voltages u. Only windings with a coupling of 1 have currents N a without flux, which keep N^T u = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Element
from fingerspice.waveforms.waveform import refuse

# A loop gain this close to 1, relative to the terms that cancel in it, is one; and what is rounding in a row.
_SINGULAR, _ROUNDING = 1e-12, 1e-13


class Matrices(NamedTuple):
    """Matrices of a `Network` of the same names; `nodes` may have columns for the delivered currents, too."""

    p: FloatArray
    q: FloatArray
    k: FloatArray
    b: FloatArray
    through: FloatArray
    delivered: FloatArray
    nodes: FloatArray
    cut: FloatArray


class Closed(NamedTuple):
    """What is left when controlled sources and inductors are eliminated."""

    matrices: Matrices
    sources: FloatArray  # (n_w, n_s): All sources as the deck's own determine them
    flux: FloatArray  # (n_z, n_coil): The states z of inductors with these currents, V/A
    reciprocal: bool  # Whether all modes decay without oscillation, as controlled voltages follow sources alone


def inductances(coils: Sequence[Element], couplings: Sequence[Element]) -> FloatArray:
    """Inductances over the geometric means of their inductors' own, shape (n_coil, n_coil)."""
    place, out = {e.name.lower(): i for i, e in enumerate(coils)}, np.eye(len(coils))
    for one in couplings:
        refuse(len(set(one.control)) < len(one.control), f"{one.name} couples an inductor with itself", one)
        rows = [place[name] for name in one.control]
        for i in rows:
            for j in rows:
                twice = i != j and out[i, j] not in (0.0, one.values["k"])
                refuse(twice, f"{one.name} couples {coils[i].name} and {coils[j].name}, which are coupled already", one)
                out[i, j] = 1.0 if i == j else one.values["k"]
    least = float(np.linalg.eigvalsh(out).min(initial=1.0))
    if least < -1e-9:
        raise InputError("the couplings exclude each other: the windings would give off energy; allowed: smaller k",
                         couplings[-1].where)  # fmt: skip
    return out


def _windings(coils: Sequence[Element], couplings: Sequence[Element], c: float) -> tuple[FloatArray, ...]:
    """sqrt(c) W, N, and the flux W^-1 / sqrt(c) of inductors, for capacitors c (F)."""
    size = np.sqrt([e.values["value"] for e in coils])[:, None]
    strength, turns = np.linalg.eigh(inductances(coils, couplings))
    kept = strength > 1e-12
    root = np.sqrt(strength[kept])
    return (
        np.sqrt(c) * turns[:, kept] / root / size, turns[:, ~kept] / size, ((turns[:, kept] * root) * size).T / c**0.5
    )  # fmt: skip


def _solved(matrix: FloatArray, right: FloatArray, size: FloatArray, elements: Sequence[Element]) -> FloatArray:
    """Solution of equations, one for each element, whose terms have these sizes; refused where there is none."""
    inverse, cancelled = np.zeros_like(matrix), np.full(len(matrix), np.inf)
    with suppress(np.linalg.LinAlgError):
        inverse = np.asarray(np.linalg.inv(matrix), float)
        cancelled = np.diag(np.abs(inverse) @ size) * _SINGULAR
    if not np.all(cancelled < 1.0):
        named = [e for e, x in zip(elements, cancelled.tolist(), strict=True) if not x < 1.0]
        said = f"the equations of {', '.join(dict.fromkeys(e.name for e in named))} have no solution"
        allowed = "another gain, a coupling below 1, or an R in the loop"
        raise InputError(f"{said}: a loop gain is 1, or no resistance is in a loop; allowed: {allowed}", named[0].where)
    return np.asarray(inverse @ right)


def closed(
    found: Matrices, sources: Sequence[Element], names: Sequence[str], couplings: Sequence[Element], c: float
) -> Closed:
    """A network whose controlled sources and inductors are sources, with these put in.

    `names` are those of the nodes, and `c` (F) the capacitance that stands for inductors.
    """
    n = found.k.shape[1]
    own, coils, ruled = ([i for i, e in enumerate(sources) if e.device in kind] for kind in ("VI", "L", "EGFH"))
    at = {name.lower(): row for name, row in zip(names, found.nodes, strict=True)} | {"0": 0.0 * found.nodes[:1].sum(0)}
    turns, still, flux = _windings([sources[i] for i in coils], couplings, c)
    n_x, n_s = n + turns.shape[1], len(own)
    # Rows over what is known, a = (x, z, s, j), and over what is wanted: controlled values, currents without flux.
    w_a, w_v = np.zeros((len(sources), n_x + 2 * n_s)), np.zeros((len(sources), len(ruled) + still.shape[1]))
    w_a[own, n_x : n_x + n_s], w_v[ruled, : len(ruled)] = np.eye(n_s), np.eye(len(ruled))
    w_a[coils, n:n_x], w_v[coils, len(ruled) :] = turns, still

    def over(rows: FloatArray, w: FloatArray) -> FloatArray:
        """Rows over (x, w) as rows over a."""
        return np.pad(rows[:, :n], ((0, 0), (0, w.shape[1] - n))) + rows[:, n:] @ w

    place = {sources[i].name.lower(): j for j, i in enumerate(own) if sources[i].device == "V"}
    felt, carried = np.zeros((len(ruled), n + len(sources))), np.zeros((len(ruled), w_a.shape[1]))
    for row, e in enumerate(sources[i] for i in ruled):
        (gain,) = e.values.values()
        if e.device in "EG":
            felt[row] = gain * (at[e.control[0]] - at[e.control[1]])
        else:
            # The current through a source, from p to n, is less the one that it delivers.
            carried[row, n_x + n_s + place[e.control[0]]] = -gain
    windings = np.array([at[sources[i].nodes[0]] - at[sources[i].nodes[1]] for i in coils]).reshape(-1, felt.shape[1])
    rows, m = np.vstack([felt, -still.T @ windings]), len(ruled)
    size = np.eye(len(rows), w_v.shape[1]) + np.abs(rows[:, n:]) @ np.abs(w_v)
    matrix = np.eye(len(rows), w_v.shape[1]) * (np.arange(len(rows)) < m)[:, None] - rows[:, n:] @ w_v
    known = over(rows, w_a)
    known[:m] += carried
    concerned = [*(sources[i] for i in ruled), *(sources[i] for i in coils[:1] * still.shape[1])]
    w = w_a + w_v @ _solved(matrix, known, size, concerned)
    w[np.abs(w) <= _ROUNDING * np.abs(w[:, : n_x + n_s]).max(axis=1, initial=0.0)[:, None]] = 0.0
    # The currents j from (x, z, s) and the currents of the cells.
    known = over(found.delivered[own], w)
    loops, by_j = np.abs(found.delivered[own][:, n:]) @ np.abs(w[:, n_x + n_s :]), w[:, n_x + n_s :]
    flows = np.hstack([known[:, : n_x + n_s], found.through[own]])
    j = _solved(np.eye(n_s) - known[:, n_x + n_s :], flows, np.eye(n_s) + loops, [sources[i] for i in own])
    every = np.hstack([w[:, : n_x + n_s], np.zeros((len(sources), len(found.p)))]) + by_j @ j
    nodes = over(found.nodes, w)
    made = _matrices(found, turns, windings, every, n_s)._replace(
        through=np.pad(j[:, n_x + n_s :], ((0, 0), (0, n_x - n))), delivered=j[:, : n_x + n_s],
        nodes=nodes if nodes[:, n_x + n_s :].any() else nodes[:, : n_x + n_s],
    )  # fmt: skip
    fed = np.abs(found.q @ every[:, n_x + n_s :]).max(initial=0.0)
    if fed > 0.0:
        names_of = [sources[i].name for i in ruled if every[i, n_x + n_s :].any()]
        said = f"{', '.join(names_of)} would set the voltage of a capacitor by the current of a capacitor"
        raise InputError(f"{said}; allowed: an R in series with it", sources[ruled[0]].where)
    by_sources = [i for i in ruled if sources[i].device in "EH"]
    currents = [j for j, i in enumerate(own) if sources[i].device == "I"]
    free = not every[:, :n_x].any() and not every[by_sources][:, [n_x + j for j in currents]].any()
    reciprocal = free and not coils and not by_j.any() and len(by_sources) == len(ruled)
    return Closed(made, every[:, n_x : n_x + n_s], flux, reciprocal)


def _matrices(found: Matrices, turns: FloatArray, windings: FloatArray, every: FloatArray, n_s: int) -> Matrices:
    """The equations with all sources (rows of `every`) from the states, the deck's sources and the cells' currents."""
    n, n_z = found.k.shape[1], turns.shape[1]
    by_x, by_s, by_i = np.split(every, [n + n_z, n + n_z + n_s], axis=1)
    wider = ((0, 0), (0, n_z))
    across, driven = np.pad(windings[:, :n], wider) + windings[:, n:] @ by_x, windings[:, n:]
    return found._replace(
        p=np.vstack([np.pad(found.p, wider) + found.q @ by_x, np.eye(n_z, n + n_z, n)]),
        q=np.vstack([found.q @ by_s, np.zeros((n_z, n_s))]),
        k=np.vstack([np.pad(found.k, wider) + found.b @ by_x, -turns.T @ across]),
        b=np.vstack([found.b @ by_s, -turns.T @ driven @ by_s]),
        cut=np.vstack([
            np.hstack([found.p + by_i.T @ found.b.T, -by_i.T @ driven.T @ turns]), np.eye(n_z, n + n_z, n)
        ]),
    )  # fmt: skip
