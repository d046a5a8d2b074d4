"""Electrical properties of stratum corneum against frequency (Eqs. 18, 19), and materials as passive ladders.

Of Eq. 18, in which z^3 stands twice, the cubic is read (docs/theory/model.md says why):
rho_sc = 10^(-0.023 z^3 + 0.0795 z^2 - 0.2133 z + 4.9229) ohm m, z = log10(f / Hz). A ladder is a sum of Debye terms,

    y(s) = g0 + s eps0 eps_inf + sum over j of s k_j / (s + p_j)      S/m,

with no negative weight: causal and passive, and equal to slabs in series, each a resistor beside a capacitor (Foster).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import ComplexArray, FloatArray

EPS0 = 8.854e-12
"""Permittivity of free space, F/m, as printed in Table 1."""

SKIN_BAND = (10.0, 1e5)
"""Frequencies over which the data behind Eqs. 18 and 19 were measured, Hz."""

_RHO = (-0.023, 0.0795, -0.2133, 4.9229)
_EPS = (-0.00286, 0.03564, -0.15785, 0.33963, -0.6235, 4.1598)


def skin_resistivity(frequency: ArrayLike) -> FloatArray:
    """Resistivity of stratum corneum (Eq. 18, cubic reading), ohm m, at frequencies in Hz, which are positive."""
    return np.asarray(10.0 ** np.polyval(_RHO, np.log10(np.asarray(frequency, float))))


def skin_permittivity(frequency: ArrayLike) -> FloatArray:
    """Relative permittivity of stratum corneum (Eq. 19) at frequencies in Hz, which are positive."""
    return np.asarray(10.0 ** np.polyval(_EPS, np.log10(np.asarray(frequency, float))))


@dataclass(frozen=True)
class Ladder:
    """A material as a passive ladder."""

    conductivity: float  # g0, at zero frequency, S/m; above 0
    eps_inf: float  # Relative permittivity far above the poles; above 0
    poles: tuple[float, ...]  # p_j, rad/s, ascending
    weights: tuple[float, ...]  # k_j, S/m; above 0

    def admittivity(self, frequency: ArrayLike) -> ComplexArray:
        """y(2 pi i f), S/m, at frequencies in Hz."""
        s = 2j * np.pi * np.asarray(frequency, float)[..., None]
        branches = s * np.array(self.weights) / (s + np.array(self.poles))
        return np.asarray(self.conductivity + s[..., 0] * EPS0 * self.eps_inf + branches.sum(axis=-1))

    def resistivity(self, frequency: ArrayLike) -> FloatArray:
        """1 / Re y, ohm m, at frequencies in Hz."""
        return np.asarray(1.0 / self.admittivity(frequency).real)

    def permittivity(self, frequency: ArrayLike) -> FloatArray:
        """Im y / (2 pi f eps0) at frequencies in Hz."""
        f = np.asarray(frequency, float)
        return np.asarray(self.admittivity(f).imag / (2.0 * np.pi * f * EPS0))

    def cells(self) -> tuple[FloatArray, FloatArray]:
        """The same material as slabs in series, each as thick as the layer.

        They are given by their relative permittivities and resistivities (ohm m), shape (n + 1,) each for n poles.
        """
        p, k, c = np.array(self.poles), np.array(self.weights), EPS0 * self.eps_inf
        # Zeros of y: the rates at which an open layer comes to rest.
        edge = np.sqrt(k * p / c)
        matrix = np.diag(np.append((self.conductivity + k.sum()) / c, p))
        matrix[0, 1:] = matrix[1:, 0] = -edge
        rates = np.linalg.eigvalsh(matrix)
        for _ in range(3):
            # Newton's, as a small eigenvalue beside large ones has lost digits.
            apart = p - rates[:, None]
            value = self.conductivity - rates * (c + (k / apart).sum(axis=1))
            slope = -c - (k * p / apart**2).sum(axis=1)
            rates = rates - value / slope
        capacitance = c + (k * p / (p - rates[:, None]) ** 2).sum(axis=1)
        return capacitance / EPS0, 1.0 / (rates * capacitance)


SKIN_LADDER = Ladder(
    conductivity=1.69442e-5,
    eps_inf=1004.82,
    poles=(173.895, 1211.37, 7409.85, 58008.2, 1117330.0),
    weights=(4.22784e-6, 1.01846e-5, 2.77962e-5, 7.12547e-5, 4.89089e-3),
)
"""Stratum corneum (Eqs. 18, 19) from 10 Hz to 100 kHz: 2.1 % rms, of which the data's own inconsistency is 2.0 %."""
