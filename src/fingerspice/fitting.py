"""From measured resistivity and permittivity to a passive ladder, and how consistent the data are."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.circuit.reader import read_text
from fingerspice.circuit.waveforms import require
from fingerspice.errors import InputError
from fingerspice.pages import Page, Shown
from fingerspice.physics.ladder import Ladder
from fingerspice.physics.materials import EPS0

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MOST_POLES = 12
# Poles per decade and decades beyond the band, of the fit that any causal and passive material would match.
_DENSE, _BEYOND = 8, 2.0
# Of data, in Hz, ohm m and 1: far from any material's, so that products and quotients stay numbers.
_LEAST, _MOST = 1e-20, 1e20


@dataclass(frozen=True)
class ColeCole:
    """A material by Cole and Cole's equation (J. Chem. Phys. 9, 341, 1941; Gabriel 1996 with several terms).

    eps = eps_inf + sum of delta / (1 + (2 pi i f tau)^(1 - alpha)) + conductivity / (2 pi i f eps0)

    Attributes
    ----------
    eps_inf : float
    terms : tuple of (delta, tau, alpha)
        Drop of the permittivity, time constant (s), and 0 <= alpha < 1.
    conductivity : float
        S/m.
    band : tuple of float
        Frequencies to fit over, Hz.
    """

    eps_inf: float
    terms: tuple[tuple[float, float, float], ...]
    conductivity: float = 0.0
    band: tuple[float, float] = (10.0, 1e5)

    def __post_init__(self) -> None:
        require(self.eps_inf > 0.0, "eps_inf", f"{self.eps_inf:g}", "more than 0")
        require(self.conductivity >= 0.0, "conductivity", f"{self.conductivity:g} S/m", "0 or more")
        require(0.0 < self.band[0] < self.band[1], "band", self.band, "two frequencies above 0 Hz, ascending")
        for delta, tau, alpha in self.terms:
            require(delta > 0.0, "delta", f"{delta:g}", "more than 0")
            require(tau > 0.0, "tau", f"{tau:g} s", "more than 0")
            require(0.0 <= alpha < 1.0, "alpha", f"{alpha:g}", "0 up to, not including, 1")

    def admittivity(self, frequency: ArrayLike) -> ComplexArray:
        """y = 2 pi i f eps0 eps, S/m, at frequencies in Hz."""
        s = 2j * np.pi * np.asarray(frequency, float)
        eps = self.eps_inf + sum(delta / (1.0 + (s * tau) ** (1.0 - alpha)) for delta, tau, alpha in self.terms)
        return np.asarray(self.conductivity + s * EPS0 * eps)


@dataclass(frozen=True)
class Consistency:
    """How near the data are to any causal and passive material (Kramers and Kronig's relations).

    Attributes
    ----------
    rms, largest : float
        Misfit |y_fit / y - 1| of the best sum of Debye terms with poles everywhere.
    frequency, misfit : ndarray, shape (n,)
        The same by frequency, Hz.
    """

    rms: float
    largest: float
    frequency: FloatArray
    misfit: FloatArray


@dataclass(frozen=True, repr=False)
class MaterialFit(Shown):
    """A ladder fitted to data.

    Attributes
    ----------
    ladder : Ladder
    rms, largest : float
        |y_fit / y - 1| over the data.
    frequency : ndarray, shape (n,)
        Of the data, Hz.
    misfit : ndarray, shape (n,)
        |y_fit / y - 1| at each.
    kramers_kronig : Consistency
        What no ladder can do better than.
    """

    ladder: Ladder
    rms: float
    largest: float
    frequency: FloatArray
    misfit: FloatArray
    kramers_kronig: Consistency

    def _page(self) -> Page:
        from fingerspice.report import fit_page

        return fit_page(self)

    def to_netlist(self, name: str) -> str:
        """A subcircuit of slabs in series, with its thickness as parameter; for decks here and for ngspice.

        Use it as ``Xskin p n area NAME d=350u``.

        Raises
        ------
        InputError
            For a name that a netlist cannot hold.
        """
        require(name.isidentifier(), "name", repr(name), "letters, digits and _, not first a digit")
        return subcircuit(self.ladder, name)


def subcircuit(ladder: Ladder, name: str) -> str:
    """Netlist text of a ladder as slabs in series."""
    eps_r, rho = ladder.cells()
    nodes = ["p", *(f"c{i}" for i in range(1, eps_r.size)), "n"]
    lines = [f".subckt {name} p n area params: d=350u"]
    for i, (eps, resistivity) in enumerate(zip(eps_r, rho, strict=True)):
        lines.append(f"X{i + 1} {nodes[i]} {nodes[i + 1]} area SLAB d={{d}} eps_r={eps:.10g} rho={resistivity:.10g}")
    return "\n".join([*lines, ".ends", ""])


def fit_material(
    data: ColeCole | ArrayLike | str | Path, *, poles: int | None = None, error: float | None = None
) -> MaterialFit:
    """Fit a passive ladder: non-negative least squares of the relative misfit, the poles placed by Gauss-Newton.

    Parameters
    ----------
    data : ColeCole, array_like or path
        Cole-Cole parameters; or rows of frequency (Hz), resistivity (ohm m) and relative permittivity, as an array
        (n, 3) or a CSV file of three columns, with or without a line of names.
    poles : int, optional
        How many branches.
    error : float, optional
        Fewest branches whose rms misfit is at most this, or within a twentieth of what the data's own inconsistency
        leaves. 0.02 if neither is given.

    Returns
    -------
    MaterialFit

    Raises
    ------
    InputError
        For data that cannot be read or are no material's, and where both `poles` and `error` are given.
    """
    if poles is not None and error is not None:
        raise InputError("poles and error are both given; allowed: one of them")
    if poles is not None:
        require(1 <= poles <= MOST_POLES, "poles", poles, f"1 to {MOST_POLES}")
    error = 0.02 if error is None else error
    require(error > 0.0, "error", f"{error:g}", "more than 0")
    f, y = _admittivity(data)
    consistency = _consistency(f, y)
    for count in [poles] if poles is not None else range(1, MOST_POLES + 1):
        ladder, misfit = _fit(f, y, count)
        rms = float(np.sqrt(np.mean(misfit**2)))
        if rms <= max(error, 1.05 * consistency.rms):
            break
    return MaterialFit(ladder, rms, float(misfit.max()), f, misfit, consistency)


def _admittivity(data: ColeCole | ArrayLike | str | Path) -> tuple[FloatArray, ComplexArray]:
    """Frequencies (Hz) and admittivities (S/m) of the data."""
    if isinstance(data, ColeCole):
        low, high = data.band
        f = np.geomspace(low, high, max(2, round(40 * np.log10(high / low)) + 1))
        return f, data.admittivity(f)
    table = _read_csv(Path(data)) if isinstance(data, (str, Path)) else np.asarray(data, float)
    require(
        table.ndim == 2 and table.shape[1] == 3, "material data", f"of shape {table.shape}", "rows of f, rho, eps_r"
    )
    require(table.shape[0] >= 3, "material data", f"{table.shape[0]} rows", "three frequencies or more")
    for column, name in enumerate(("frequency", "resistivity", "permittivity")):
        bad = np.flatnonzero(~((table[:, column] >= _LEAST) & (table[:, column] <= _MOST)))
        if bad.size:
            raise InputError(
                f"{name} in row {bad[0] + 1} is {table[bad[0], column]:g}; allowed: more than 0, from {_LEAST:g} to "
                f"{_MOST:g}"
            )
    table = table[np.argsort(table[:, 0])]
    f = table[:, 0].copy()
    require(bool(np.all(np.diff(f) > 0.0)), "frequencies", "repeated", "each once")
    return f, 1.0 / table[:, 1] + 2j * np.pi * f * EPS0 * table[:, 2]


def _read_csv(path: Path) -> FloatArray:
    try:
        lines = read_text(path, str(path)).splitlines(keepends=True)
        rows = [row for row in csv.reader(lines) if row and not row[0].lstrip().startswith("#")]
    except csv.Error as error:
        raise InputError(f"{path} cannot be read as CSV: {error}") from error
    numbers = []
    for place, row in enumerate(rows):
        try:
            numbers.append([float(x) for x in row])
        except ValueError:
            if place > 0:
                raise InputError(f"{path}, row {place + 1}: {','.join(row)!r}; allowed: three numbers") from None
    if any(len(row) != 3 for row in numbers):
        raise InputError(f"{path} has rows that are not three numbers: frequency (Hz), rho (ohm m), eps_r")
    return np.array(numbers, float).reshape(-1, 3)


def _weights(f: FloatArray, y: ComplexArray, poles: FloatArray) -> tuple[FloatArray, ComplexArray]:
    """Best weights (g0, eps0 eps_inf, k_j), none negative, and the relative misfit they leave."""
    from scipy.optimize import nnls

    s = 2j * np.pi * f
    columns = np.column_stack([np.ones_like(s), s, *(s / (s + p) for p in poles)]) / y[:, None]
    matrix = np.vstack([columns.real, columns.imag])
    size = np.linalg.norm(matrix, axis=0)
    x, _ = nnls(matrix / size, np.concatenate([np.ones(f.size), np.zeros(f.size)]))
    x = x / size
    return x, columns @ x - 1.0


def _fit(f: FloatArray, y: ComplexArray, count: int) -> tuple[Ladder, FloatArray]:
    """The ladder of so many branches, and its misfit."""
    from scipy.optimize import least_squares

    low, high = np.log10(2.0 * np.pi * f[[0, -1]])
    start = low + (high - low) * (np.arange(count) + 0.5) / count

    def residual(place: FloatArray) -> FloatArray:
        _, left = _weights(f, y, 10.0**place)
        return np.concatenate([left.real, left.imag])

    # A pole far above the band would do eps_inf's work, and none would be left for it.
    found = least_squares(residual, start, bounds=(low - 0.5, high + 0.25), max_nfev=60)
    poles = 10.0 ** np.sort(found.x)
    x, left = _weights(f, y, poles)
    if not (x[0] > 0.0 and x[1] > 0.0):
        missing = "conductivity at zero frequency" if x[0] <= 0.0 else "eps_inf"
        raise InputError(f"the data leave no {missing} above 0 with {count} poles; allowed: fewer poles, or more data")
    kept = x[2:] > 0.0
    ladder = Ladder(
        float(x[0]), float(x[1] / EPS0), tuple(map(float, poles[kept])), tuple(map(float, x[2:][kept]))
    )  # fmt: skip
    return ladder, np.abs(left)


def _consistency(f: FloatArray, y: ComplexArray) -> Consistency:
    low, high = np.log10(2.0 * np.pi * f[[0, -1]])
    count = round(_DENSE * (high - low + 2.0 * _BEYOND)) + 1
    _, left = _weights(f, y, np.logspace(low - _BEYOND, high + _BEYOND, count))
    misfit = np.abs(left)
    return Consistency(float(np.sqrt(np.mean(misfit**2))), float(misfit.max()), f, misfit)
