"""Electrical properties of stratum corneum against frequency (Eqs. 18, 19).

Equation 18 is damaged in print: z^3 stands twice. The reading used here is the cubic

    rho_sc = 10^(-0.023 z^3 + 0.0795 z^2 - 0.2133 z + 4.9229) Ohm m,   z = log10(f / Hz).

It is the reading that causality asks for: resistivity and permittivity of one passive material are one
function (Kramers-Kronig), and of all exponent triples 1..6 the cubic agrees best with Eq. 19.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

EPS0 = 8.854e-12
"""Permittivity of free space, F/m, as printed in Table 1."""

SKIN_BAND = (10.0, 1e5)
"""Frequencies over which the data behind Eqs. 18 and 19 were measured, Hz."""

_RHO = (-0.023, 0.0795, -0.2133, 4.9229)
_EPS = (-0.00286, 0.03564, -0.15785, 0.33963, -0.6235, 4.1598)


def skin_resistivity(frequency: ArrayLike) -> NDArray[np.float64]:
    """Resistivity of stratum corneum (Eq. 18, cubic reading).

    Parameters
    ----------
    frequency : array_like
        Frequency in Hz, positive.

    Returns
    -------
    ndarray
        Resistivity in Ohm m, shape of `frequency`.
    """
    return np.asarray(10.0 ** np.polyval(_RHO, np.log10(np.asarray(frequency, float))))


def skin_permittivity(frequency: ArrayLike) -> NDArray[np.float64]:
    """Relative permittivity of stratum corneum (Eq. 19).

    Parameters
    ----------
    frequency : array_like
        Frequency in Hz, positive.

    Returns
    -------
    ndarray
        Relative permittivity, shape of `frequency`.
    """
    return np.asarray(10.0 ** np.polyval(_EPS, np.log10(np.asarray(frequency, float))))
