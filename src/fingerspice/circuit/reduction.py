"""Reduction of a network to the voltages of a spanning tree's sources and capacitors, for `circuit.network`."""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray

# A current of a source that is this small, relative to what it is the difference of, is rounding.
_ROUNDING = 1e-13


class Tree:
    """A spanning tree that grows branch by branch."""

    def __init__(self) -> None:
        self._parent: dict[str, str] = {}
        self._branches: dict[str, list[tuple[str, int, float]]] = defaultdict(list)
        self._count = 0

    @property
    def names(self) -> list[str]:
        return list(self._branches)

    def _root(self, node: str) -> str:
        while self._parent.setdefault(node, node) != node:
            self._parent[node] = self._parent[self._parent[node]]
            node = self._parent[node]
        return node

    def add(self, p: str, n: str) -> bool:
        """Add a branch if it closes no loop, and return whether it was added."""
        a, b = self._root(p), self._root(n)
        if a == b:
            return False
        self._parent[a] = b
        self._branches[p].append((n, self._count, -1.0))
        self._branches[n].append((p, self._count, 1.0))
        self._count += 1
        return True

    def potentials(self) -> dict[str, FloatArray]:
        """Voltage of every node against ground, as a row of coefficients of the branch voltages."""
        out = {"0": np.zeros(self._count)}
        todo = ["0"]
        while todo:
            node = todo.pop()
            for other, branch, sign in self._branches[node]:
                if other not in out:
                    out[other] = out[node].copy()
                    out[other][branch] = sign
                    todo.append(other)
        return out


class Resistors(NamedTuple):
    """What resistors do in a network, with the voltages of the tree's resistors eliminated.

    The tree's other voltages are e = (s, x), those of its sources and its capacitors.
    """

    # from_e, from_i (n_r, n_e): Voltages of the tree's resistors by e, and by the currents of the current sources
    from_e: FloatArray
    from_i: FloatArray
    # into_e, into_i (n_e, n_e): Currents into the cuts of the tree's sources and capacitors, by both
    into_e: FloatArray
    into_i: FloatArray
    factor: FloatArray  # (n_resistor, n_e): Square roots of the power in each resistor, by e: into_e = factor' factor


def eliminate(over_resistors: FloatArray, over_currents: FloatArray, conductance: FloatArray, n_e: int) -> Resistors:
    """Eliminate the voltages of the tree's resistors: given e, they minimise the dissipated power.

    Parameters
    ----------
    over_resistors, over_currents : ndarray, shape (n_resistor, n_e + n_r) and (n_i, n_e + n_r)
        Voltages of all resistors and current sources by those of the tree's branches, its own resistors last.
    conductance : ndarray, shape (n_resistor,)
        S.
    n_e : int
        Number of the tree's sources and capacitors.
    """
    e, r = slice(0, n_e), slice(n_e, None)
    weight, n_r, n_i = np.sqrt(conductance)[:, None], over_resistors.shape[1] - n_e, over_currents.shape[0]
    orthogonal, upper = np.linalg.qr(weight * over_resistors[:, r])
    from_e = -np.linalg.solve(upper, orthogonal.T @ (weight * over_resistors[:, e])) if n_r else np.zeros((0, n_e))
    back = np.linalg.solve(upper.T, over_currents[:, r].T) if n_r else np.zeros((0, n_i))
    from_i = -np.linalg.solve(upper, back) if n_r else back
    by_e = over_resistors[:, e] + over_resistors[:, r] @ from_e
    by_i = over_resistors[:, r] @ from_i
    into_e = by_e.T @ (conductance[:, None] * by_e)
    into_i = over_resistors[:, e].T @ (conductance[:, None] * by_i) + over_currents[:, e].T
    return Resistors(from_e, from_i, into_e, into_i, weight * by_e)


def source_currents(found: Resistors, n_v: int) -> tuple[FloatArray, FloatArray]:
    """What the sources deliver to resistors, and the cuts of capacitors that are added to their own.

    The current of a small resistance suffers from cancellation. Adding to a source's cut the combination of the
    capacitors' cuts with the least contribution of resistors takes the source's current from the cells instead.

    Parameters
    ----------
    found : Resistors
    n_v : int
        Number of voltage sources, which stand first in e.

    Returns
    -------
    delivered : ndarray, shape (n_v + n_i, n + n_v + n_i)
        Current of each source by the capacitors' voltages, the voltage sources' and the currents of the others, A.
    together : ndarray, shape (n_v, n)
        Shares of the capacitors' cuts in that of each voltage source.
    """
    n_e, n_i = found.into_i.shape
    s, x, n, factor = slice(0, n_v), slice(n_v, n_e), n_e - n_v, found.factor
    into_e, into_i = found.into_e, found.into_i
    together: FloatArray = np.zeros((n_v, n))
    if factor.size:
        together = np.asarray(-np.linalg.lstsq(factor[:, x], factor[:, s], rcond=None)[0].T, float)
    delivered: FloatArray = np.zeros((n_v + n_i, n_e + n_i))
    delivered[:n_v] = np.hstack([into_e[s, x], into_e[s, s], into_i[s]])
    delivered[:n_v] += together @ np.hstack([into_e[x, x], into_e[x, s], into_i[x]])
    largest = np.linalg.norm(factor[:, s], axis=0)[:, None] * np.linalg.norm(factor, axis=0)
    rounding = np.abs(delivered[:n_v, :n_e]) <= _ROUNDING * np.hstack([largest[:, x], largest[:, s]])
    delivered[:n_v, :n_e][rounding] = 0.0
    delivered[n_v:, n_e:] = np.eye(n_i)
    return delivered, together
