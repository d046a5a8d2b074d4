"""Fits of a passive ladder to measured resistivity and permittivity, tables of such data, and their consistency."""

from __future__ import annotations

import csv
import math
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import ComplexArray, FloatArray, positive_number, real_numbers, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.netlist.reader import read_text
from fingerspice.physics.materials import EPS0, Ladder
from fingerspice.plots import drawing
from fingerspice.studies.fit.fitting import PREFIXES
from fingerspice.waveforms.waveform import refuse, require

#: Columns of measured materials, and what they may be in words.
COLUMNS = ("frequency", "resistivity", "permittivity")
ALLOWED = "frequency (Hz), resistivity (ohm m), relative permittivity"
MOST_POLES = 12
# Densely placed poles stand for any causal and passive material: number per decade, and decades beyond the band.
_DENSE, _BEYOND = 8, 2.0
# Misfit (rms), of a fit or of the data to any material, above which a warning is given, and above which it is refused.
NOTABLE, TOO_MUCH = 0.1, 0.3
# Misfit of the data to any material from which on it is examined for a course over frequency, which noise has not: so
# many frequencies are needed, and neighbouring misfits are then correlated by more than this.
_SMALL, _FEWEST, _COURSE = 0.03, 10, 0.5
# Range allowed of data in Hz, ohm m and 1: wide enough for any material, and narrow enough to avoid overflow.
_LEAST, _MOST = 1e-20, 1e20
_PREFIXES = PREFIXES | {"G": 1e9, "p": 1e-12}
_PREFIX, _METRES = f"(?P<prefix>[{''.join(_PREFIXES)}]?)", {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_METRE = "(?P<metre>cm|mm|m)"
_FREQUENCY = "f|freq|frequency|frequenz|hz"
_PERMITTIVITY = (
    "eps|eps_r|epsr|eps'|eps_r'|epsilon|epsilon_r|ε|ε_r|εr|ε'|eps_r_sc|permittivity|relative permittivity|"
    "relative_permittivity|dielectric constant|dk"
)
# What a column may hold by its name and unit, of which several with a name the first is that without a unit: the one of
# `COLUMNS` that it tells, patterns of names and units, and power and factor from SI units to those of the column.
_KINDS = (
    ("frequency", _FREQUENCY, f"{_PREFIX}[Hh]z|1/s", 1.0, 1.0),
    ("frequency", _FREQUENCY, "rad/s", 1.0, 0.5 / np.pi),
    ("frequency", "w|omega|ω|angular frequency|angular_frequency", "rad/s|1/s", 1.0, 0.5 / np.pi),
    ("resistivity", "rho|ρ|rho_sc|resistivity|resistance",
     f"{_PREFIX}(?:[Oo]hms?|[\u03a9\u2126])[ *·.-]?{_METRE}", 1.0, 1.0),
    ("resistivity", "sigma|σ|kappa|conductivity|conductance", f"{_PREFIX}S/{_METRE}", -1.0, 1.0),
    ("permittivity", _PERMITTIVITY, "1|-", 1.0, 1.0),
    ("permittivity", _PERMITTIVITY, f"{_PREFIX}F/{_METRE}", 1.0, 1.0 / EPS0),
)  # fmt: skip
# Possible slips of the user: columns of the table as given, in the order meant; power of the second; and factors.
_SLIPS = (
    ("the frequency is in rad/s", (0, 1, 2), 1.0, (0.5 / np.pi, 1.0, 1.0)),
    ("the second column is a conductivity in S/m", (0, 1, 2), -1.0, (1.0, 1.0, 1.0)),
    ("the frequency is in kHz", (0, 1, 2), 1.0, (1e3, 1.0, 1.0)),
    ("the resistivity is in ohm cm", (0, 1, 2), 1.0, (1.0, 1e-2, 1.0)),
    ("the resistivity is in kohm m", (0, 1, 2), 1.0, (1.0, 1e3, 1.0)),
    ("resistivity and permittivity have changed places", (0, 2, 1), 1.0, (1.0, 1.0, 1.0)),
    ("frequency and resistivity have changed places", (1, 0, 2), 1.0, (1.0, 1.0, 1.0)),
    ("frequency and permittivity have changed places", (2, 1, 0), 1.0, (1.0, 1.0, 1.0)),
    ("the columns are resistivity, permittivity, frequency", (2, 0, 1), 1.0, (1.0, 1.0, 1.0)),
    ("the columns are permittivity, frequency, resistivity", (1, 2, 0), 1.0, (1.0, 1.0, 1.0)),
    ("the second column is a conductivity in mS/m", (0, 1, 2), -1.0, (1.0, 1e3, 1.0)),
    ("the second column is a conductivity in uS/cm", (0, 1, 2), -1.0, (1.0, 1e4, 1.0)),
    ("the second column is a conductivity in S/cm", (0, 1, 2), -1.0, (1.0, 1e-2, 1.0)),
    ("the frequency is in MHz", (0, 1, 2), 1.0, (1e6, 1.0, 1.0)),
    ("the permittivity is in F/m", (0, 1, 2), 1.0, (1.0, 1.0, 1.0 / EPS0)),
)


def read_table(path: Path) -> FloatArray:
    """Rows of frequency (Hz), resistivity (ohm m) and relative permittivity from a text file of three columns.

    Columns are separated by commas, tabs or semicolons; with semicolons decimal commas are allowed. A line of names
    may give quantities, order and units of the columns; conductivities and angular frequencies are converted.
    """
    try:
        lines = read_text(path, str(path)).splitlines(keepends=True)
        mark = next((mark for mark in ";\t" if any(mark in line for line in lines)), ",")
        rows = [row for row in csv.reader(lines, delimiter=mark) if row and not row[0].lstrip().startswith("#")]
    except csv.Error as error:
        raise InputError(f"{path} cannot be read as CSV: {error}") from error
    head, numbers = list[str](), list[list[float]]()
    for place, row in enumerate(rows):
        try:
            numbers.append([float(x.replace(",", ".") if mark == ";" else x) for x in row])
        except ValueError:
            if place > 0:
                raise InputError(f"{path}, row {place + 1}: {','.join(row)!r}; allowed: three numbers") from None
            head = row
    refuse(any(len(row) != 3 for row in numbers), f"{path} has rows that are not three numbers; allowed: {ALLOWED}")
    columns = np.array(numbers, float).reshape(-1, 3).T
    found = [_converted(*one, path) for one in zip(head if len(head) == 3 else [""] * 3, columns, strict=True)]
    named = [column for column, _ in found if column]
    for column in named:
        said = f"two columns are a {column} by their names, {', '.join(head)}; allowed: {ALLOWED}"
        refuse(named.count(column) > 1, f"{path}: {said}")
    # Columns with unknown names fill the places that the others leave.
    free = (column for column in COLUMNS if column not in named)
    table = {column or next(free): x for column, x in found}
    return np.column_stack([table[column] for column in COLUMNS])


def _converted(name: str, x: FloatArray, file: Path) -> tuple[str, FloatArray]:
    """The column that a name in a header tells, or "", and its values in SI units."""
    name, bare = name.strip(), name.strip().strip("\"'")
    for column, names, units, power, factor in _KINDS:
        # In brackets, behind a slash, or, as in f_kHz, at the name's end.
        unit = rf"(?:(?P<open>[\[(])|[/_])\s*(?P<unit>(?:{units})?)\s*(?(open)[\])])"
        if found := re.fullmatch(rf"(?i:{names})\s*(?:{unit})?", bare):
            parts = found.groupdict()
            metre = _METRES[parts.get("metre") or "m"] ** (-1 if "/" in (found["unit"] or "") else 1)
            with np.errstate(divide="ignore"):
                return column, (_PREFIXES[parts.get("prefix") or ""] * metre * x) ** power * factor
    another = r"\s*(?:[\[(][^\])]*[\])]|/.+|_[^_\[(/]*)"
    known = any(re.fullmatch(rf"(?i:{names}){another}", bare) for _, names, *_ in _KINDS)
    require(not known, f"{file}: the unit of column {name!r}", "not known", "Hz, rad/s, ohm m, S/m, and 1 or F/m")
    return "", x


@dataclass(frozen=True)
class ColeCole:
    """A material that follows Cole and Cole's equation (J. Chem. Phys. 9, 341, 1941; several terms: Gabriel 1996).

    eps = eps_inf + sum of delta / (1 + (2 pi i f tau)^(1 - alpha)) + conductivity / (2 pi i f eps0)

    Attributes
    ----------
    eps_inf : float
    terms : tuple of (delta, tau, alpha)
        Drop of the permittivity, time constant (s), and 0 <= alpha < 1.
    conductivity : float
        S/m.
    band : tuple of float
        Lowest and highest frequency of the fit, Hz.
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

    def to_netlist(self, name: str) -> str:
        """A subcircuit with the thickness as parameter, as `MaterialFit.to_netlist`, and exact in sweeps.

        Each term is a slab in series with a constant-phase element, q = eps0 delta tau^(alpha - 1) and n_cpe = alpha.

        Raises
        ------
        InputError
            If the name is not allowed in a netlist.
        """
        rho = 1.0 / self.conductivity if self.conductivity > 0.0 else math.inf
        lines = [f"X0 p n area SLAB d={{d}} eps_r={self.eps_inf!r} rho={rho!r}"]
        for i, (delta, tau, alpha) in enumerate(self.terms, 1):
            lines.append(f"Xe{i} p c{i} area SLAB d={{d}} eps_r={delta!r} rho=inf")
            q = EPS0 * delta * tau ** (alpha - 1.0)
            # With an exponent of 0 it is a resistor, which a constant-phase element is as well with almost none.
            lines.append(f"Xq{i} c{i} n area CPE_LAYER q={{{q!r}/d}} n_cpe={max(alpha, 1e-6)!r}")
        return _subcircuit(name, lines)


def _subcircuit(name: str, lines: list[str]) -> str:
    require(name.isidentifier(), "name", repr(name), "letters, digits and _, not first a digit")
    return "\n".join([f".subckt {name} p n area params: d=350u", *lines, ".ends", ""])


@dataclass(frozen=True)
class Consistency:
    """Distance of data from the nearest causal and passive material (relations of Kramers and Kronig).

    The misfit is ``|y_fit / y - 1|`` of the best sum of Debye terms with densely placed poles.
    """

    rms: float
    largest: float
    frequency: FloatArray  # (n,): Hz
    misfit: FloatArray  # (n,): At each frequency
    # Correlation of the complex misfits of neighbouring frequencies: about 0 for noise, near 1 for a drift or a wrong
    # scale of a column
    systematic: float


@dataclass(frozen=True, repr=False)
class MaterialFit(Shown):
    """A ladder fitted to data.

    Attributes
    ----------
    ladder : Ladder
    rms, largest : float
        Misfit ``|y_fit / y - 1|`` over the data.
    frequency, misfit : ndarray, shape (n,)
        Frequencies of the data, Hz, and the misfit at each.
    kramers_kronig : Consistency
        Smallest misfit that any ladder can have.
    data : ndarray of complex, shape (n,)
        Admittivity of the data, S/m.
    """

    ladder: Ladder
    rms: float
    largest: float
    frequency: FloatArray
    misfit: FloatArray
    kramers_kronig: Consistency
    data: ComplexArray

    def _page(self) -> Page:
        ladder, f = self.ladder, self.frequency
        poles = [format_si(p / (2.0 * math.pi), "Hz") for p in ladder.poles]
        rows = list(zip(poles, (f"{k:.4g} S/m" for k in ladder.weights), strict=True))
        low, high = (format_si(float(x), "Hz") for x in f[[0, -1]])
        return Page([
            f"material fitted at {f.size} frequencies from {low} to {high}",
            f"misfit of the admittivity: {100.0 * self.rms:.2g} % rms, {100.0 * self.largest:.2g} % at most",
            f"no causal and passive material comes nearer than {100.0 * self.kramers_kronig.rms:.2g} % rms",
            "",
            f"{ladder.conductivity:.4g} S/m at zero frequency, eps_r = {ladder.eps_inf:.4g} above all poles, and",
            Table(("pole", "weight"), rows),
        ])  # fmt: skip

    def to_netlist(self, name: str) -> str:
        """A subcircuit of slabs in series with the thickness as parameter, for decks here and in ngspice.

        Write it to ``myskin.lib`` in the folder of the deck; ``.include myskin.lib`` and
        ``Xskin skin 0 area NAME d=350u`` then replace a SKIN.

        Raises
        ------
        InputError
            If the name is not allowed in a netlist.
        """
        eps_r, rho = self.ladder.cells()
        nodes = ["p", *(f"c{i}" for i in range(1, eps_r.size)), "n"]
        lines = [
            f"X{i + 1} {nodes[i]} {nodes[i + 1]} area SLAB d={{d}} eps_r={eps:.10g} rho={resistivity:.10g}"
            for i, (eps, resistivity) in enumerate(zip(eps_r, rho, strict=True))
        ]
        return _subcircuit(name, lines)

    def plot(self) -> drawing.Picture:
        """Resistivity and permittivity of the data and of the ladder, and the misfit, against frequency."""
        figure, axes = drawing.new_figure(1, 3, height=2.7)
        f = np.geomspace(self.frequency[0], self.frequency[-1], 400)
        measured = 1.0 / self.data.real, self.data.imag / (2.0 * np.pi * self.frequency * EPS0)
        fitted = self.ladder.resistivity(f), self.ladder.permittivity(f)
        limit, fine = self.kramers_kronig, {"color": drawing.BLUE, "linewidth": 1.4}
        rough = {"color": drawing.VERMILION, "linewidth": 1.0, "label": "any material"}
        for ax, points, line in zip(axes, measured, fitted, strict=False):
            ax.loglog(self.frequency, points, "o", color=drawing.GREY, markersize=2.5, label="data")
            ax.loglog(f, line, label=f"ladder of {len(self.ladder.poles)} poles", **fine)
        axes[2].semilogx(self.frequency, 100.0 * self.misfit, label="ladder", **fine)
        axes[2].semilogx(limit.frequency, 100.0 * limit.misfit, "--", **rough)
        for ax, label in zip(axes, ("Resistivity [Ω m]", "Relative permittivity", "Misfit [%]"), strict=True):
            drawing.dress(ax, label, "Frequency [Hz]")
        for ax in (axes[0], axes[2]):
            ax.legend(fontsize=drawing.FONT - 0.5, frameon=False)
        nearest = f"no causal and passive material is nearer than {100.0 * limit.rms:.2g} % rms"
        drawing.caption(figure, f"misfit {100.0 * self.rms:.2g} % rms; {nearest}")
        return figure


def fit_material(
    data: ColeCole | ArrayLike | str | Path, *, poles: int | None = None, error: float | None = None
) -> MaterialFit:
    """Fit a passive ladder, by non-negative least squares of the relative misfit with poles placed by Gauss-Newton.

    Parameters
    ----------
    data : ColeCole, array_like or path
        Cole-Cole parameters; or rows of frequency (Hz), resistivity (ohm m) and relative permittivity, as an array
        (n, 3) or a CSV file of three columns. A line of names in the file gives quantities, order and units of the
        columns, as in ``omega [rad/s],sigma [S/m],eps_r``.
    poles : int, optional
        Number of branches.
    error : float, optional
        Take the fewest branches whose rms misfit is at most `error`, or at most 1.05 times the misfit of the data to
        any material. The default, if `poles` is not given either, is 0.02.

    Raises
    ------
    InputError
        If the data cannot be read or fit no material (the message names likely slips), if the misfit is above 30 %, or
        if both `poles` and `error` are given.

    Warns
    -----
    FingerspiceWarning
        If the misfit is above 10 %, either of the data to any causal and passive material, or of the fit to the data;
        or if the former is above 3 % and has a course over frequency, which noise has not.

    Examples
    --------
    From data to a deck that has ``.include myskin.lib`` and ``Xskin skin 0 area MYSKIN d=350u``::

        fit = fs.fit_material("skin.csv")
        fit.plot()
        Path("myskin.lib").write_text(fit.to_netlist("MYSKIN"))
    """
    refuse(poles is not None and error is not None, "poles and error are both given; allowed: one of them")
    counts = range(1, MOST_POLES + 1) if poles is None else [whole_number("poles", poles, 1, MOST_POLES)]
    error = 0.02 if error is None else positive_number("error", error)
    if isinstance(data, ColeCole):
        low, high = data.band
        f = np.geomspace(low, high, max(2, round(40 * np.log10(high / low)) + 1))
        y = data.admittivity(f)
        consistency, doubt = _consistency(f, y), ""
    else:
        data = read_table(Path(data)) if isinstance(data, (str, Path)) else data
        table, what = real_numbers("material data", data, f"rows of {ALLOWED}, or a file"), "material data"
        require(table.ndim == 2 and table.shape[1] == 3, what, f"of shape {table.shape}", "rows of f, rho, eps_r")
        require(table.shape[0] >= 3, what, f"{table.shape[0]} rows", "three frequencies or more")
        bad = np.argwhere(~((table.T >= _LEAST) & (table.T <= _MOST)))
        if bad.size:
            (column, row), allowed = bad[0], f"more than 0, from {_LEAST:g} to {_MOST:g}"
            raise InputError(f"{COLUMNS[column]} in row {row + 1} is {table[row, column]:g}; allowed: {allowed}")
        table = table[np.argsort(table[:, 0])]
        require(bool(np.all(np.diff(table[:, 0]) > 0.0)), "frequencies", "repeated", "each once")
        f, y = _admittivity(table)
        doubt = _doubt(table, consistency := _consistency(f, y))
    ladder, refused, enough = None, "", max(error, 1.05 * consistency.rms)
    for count in counts:
        try:
            ladder, misfit = _fit(f, y, count)
        except InputError as problem:
            # A fit with more branches may succeed.
            refused = problem.message
            continue
        rms = float(np.sqrt(np.mean(misfit**2)))
        if rms <= enough:
            break
    if ladder is None:
        raise InputError(f"{doubt}; {refused}" if doubt else refused)
    said = f"the ladder misses the data by {100.0 * rms:.2g} % rms"
    if rms > TOO_MUCH:
        raise InputError(f"{said}; allowed: at most {100.0 * TOO_MUCH:g} %, so more poles, or data of a narrower band")
    if rms > max(NOTABLE, 1.05 * consistency.rms):
        warnings.warn(f"{said}; more poles would come nearer", FingerspiceWarning, stacklevel=2)
    return MaterialFit(ladder, rms, float(misfit.max()), f, misfit, consistency, y)


def _admittivity(table: FloatArray) -> tuple[FloatArray, ComplexArray]:
    """Frequencies (Hz) and admittivities (S/m) of a table."""
    f = table[:, 0].copy()
    return f, 1.0 / table[:, 1] + 2j * np.pi * f * EPS0 * table[:, 2]


def _doubt(table: FloatArray, found: Consistency) -> str:
    """Warn about data that no material can have, or refuse them, with likely slips; returns the warning, else ''."""
    course = found.rms > _SMALL and found.frequency.size >= _FEWEST and found.systematic > _COURSE
    if found.rms <= NOTABLE and not course:
        return ""
    slips = []
    for text, order, power, factors in _SLIPS:
        other = table[:, order] ** (1.0, power, 1.0) * factors
        other = other[np.argsort(other[:, 0])]
        if np.all(np.diff(other[:, 0]) > 0.0):
            slips.append((_consistency(*_admittivity(other)).rms, text))
    best = min((rms for rms, _ in slips), default=np.inf)
    # Those that reduce the misfit to less than a third; of the same factor there are two, such as kHz and kohm m.
    likely = [text for rms, text in slips if rms <= min(1.1 * best, found.rms / 3.0)][:2]
    said = f"the data are {100.0 * found.rms:.2g} % (rms) from any causal and passive material (Kramers-Kronig)"
    if likely:
        said += f"; likely {' or '.join(likely)}"
    elif course:
        said += ", not by noise but along a smooth course, as of a drift or of a wrong scale of a column"
    refuse(found.rms > TOO_MUCH, f"{said}; allowed: at most {100.0 * TOO_MUCH:g} %, columns of {ALLOWED}")
    warnings.warn(said, FingerspiceWarning, stacklevel=3)
    return said


def _weights(f: FloatArray, y: ComplexArray, poles: FloatArray) -> tuple[FloatArray, ComplexArray]:
    """Best non-negative weights (g0, eps0 eps_inf, k_j), and the complex relative residual."""
    from scipy.optimize import nnls

    s = 2j * np.pi * f
    columns = np.column_stack([np.ones_like(s), s, *(s / (s + p) for p in poles)]) / y[:, None]
    matrix = np.vstack([columns.real, columns.imag])
    size = np.linalg.norm(matrix, axis=0)
    x = nnls(matrix / size, np.concatenate([np.ones(f.size), np.zeros(f.size)]))[0] / size
    return x, columns @ x - 1.0


def _fit(f: FloatArray, y: ComplexArray, count: int) -> tuple[Ladder, FloatArray]:
    """The ladder with `count` branches, and its misfit."""
    from scipy.optimize import least_squares

    low, high = np.log10(2.0 * np.pi * f[[0, -1]])
    start = low + (high - low) * (np.arange(count) + 0.5) / count

    def residual(place: FloatArray) -> FloatArray:
        _, left = _weights(f, y, 10.0**place)
        return np.concatenate([left.real, left.imag])

    # A pole far above the band cannot be distinguished from eps_inf, which would then be fitted as 0: bound the poles.
    found = least_squares(residual, start, bounds=(low - 0.5, high + 0.25), max_nfev=60)
    poles = 10.0 ** np.sort(found.x)
    x, left = _weights(f, y, poles)
    if not (x[0] > 0.0 and x[1] > 0.0):
        missing = "conductivity at zero frequency" if x[0] <= 0.0 else "eps_inf"
        raise InputError(f"the data leave no {missing} above 0 with {count} poles; allowed: fewer poles, or more data")
    kept = x[2:] > 0.0
    weights = x[2:][kept]
    return Ladder(float(x[0]), float(x[1] / EPS0), tuple(poles[kept].tolist()), tuple(weights.tolist())), np.abs(left)


def _consistency(f: FloatArray, y: ComplexArray) -> Consistency:
    """The linear Kramers-Kronig test (Boukamp, J. Electrochem. Soc. 142, 1885, 1995), with weights that are passive."""
    low, high = np.log10(2.0 * np.pi * f[[0, -1]])
    count = round(_DENSE * (high - low + 2.0 * _BEYOND)) + 1
    _, left = _weights(f, y, np.logspace(low - _BEYOND, high + _BEYOND, count))
    misfit = np.abs(left)
    power = float(np.sum(misfit**2))
    neighbours = float(np.sum((left[1:] * left[:-1].conj()).real)) / power if power > 0.0 else 0.0
    return Consistency(float(np.sqrt(np.mean(misfit**2))), float(misfit.max()), f, misfit, neighbours)
