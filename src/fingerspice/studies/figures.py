"""The paper's Figs. 2 to 5, each as a picture with its data, without the measured points that it shows in grey."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning
from fingerspice.base.files import write_csv
from fingerspice.circuit.circuit import Circuit
from fingerspice.netlist.netlist import parse_netlist
from fingerspice.netlist.reader import shipped_text
from fingerspice.physics.materials import SKIN_BAND, skin_permittivity, skin_resistivity
from fingerspice.plots import drawing
from fingerspice.results.solution import Solution
from fingerspice.solve.runs import Progress
from fingerspice.studies.steady import phasor, steady_state
from fingerspice.waveforms.periodic import Square
from fingerspice.waveforms.waveform import Sine, Waveform, require

#: Source amplitudes of Fig. 3, and of Figs. 4 and 5, V; and the frequencies of the latter, Hz.
U0_FORCE, U0_TIME, FREQUENCIES = 140.0, 200.0, (100.0, 5000.0)
# Letters of units in a data file.
_ASCII = str.maketrans({"µ": "u", "²": "^2", "Ω": "ohm"})


def table1_circuit(*, dispersive: bool = False) -> Circuit:
    """Table 1 under a sine of 200 V and 100 Hz (Fig. 4, left); with `dispersive` its skin follows the frequency."""
    deck = shipped_text("fingerpad.cir")
    return parse_netlist(deck.replace("SKIN  d=350u f=100", "SKIN_DISPERSIVE d=350u") if dispersive else deck)


class Variation(NamedTuple):
    """One panel of Fig. 3: a parameter, its values, and the circuit parameters that it changes."""

    title: str
    symbol: str  # In TeX
    unit: str
    name: str  # Name in the data file
    paths: tuple[str, ...]  # Paths of the circuit parameters that are proportional to the varied parameter
    base: float  # Value in Table 1, in `unit`
    values: tuple[float, ...]  # Value for each curve, in `unit`

    def apply(self, circuit: Circuit, value: float) -> Circuit:
        """The circuit with this parameter at `value`, in `unit`."""
        return circuit.varied({path: value / self.base * circuit.parameters[path].value for path in self.paths})


def variations() -> tuple[Variation, ...]:
    """The four panels of Fig. 3, in the paper's order."""
    gap = table1_circuit().parameters
    # Ridge area without voltage and friction (Eq. 5): alpha and beta are scaled together, and the exponents are kept.
    area = gap["Xgap.alpha"].value * gap["Xgap.fn"].value ** gap["Xgap.m_exp"].value
    scale_area = ("Xgap.alpha", "Xgap.beta")
    return (
        Variation("Skin thickness", r"d_\mathrm{sc}", "µm", "d_sc", ("Xskin.d",), 350.0, (200.0, 350.0, 450.0)),
        Variation("Ridge contact area", r"A_\mathrm{R0}", "mm²", "area", scale_area, area, (30.0, area, 45.0)),
        Variation("Gap resistance", r"R_\mathrm{a}", "MΩ", "r_a", ("Xgap.r",), 1.0, (0.5, 1.0, 2.0, 7.0)),
        Variation("Gap thickness", r"d_\mathrm{a}", "µm", "d_a", ("Xgap.d",), 3.5, (2.0, 3.5, 5.0)),
    )


def make_figures(
    folder: str | Path, *, only: int | Iterable[int] | None = None, progress: Progress | None = None
) -> list[Path]:
    """Write the paper's figures, each as ``figN.png`` with its data in ``figN.csv``, and return the files' paths.

    `only` names the wanted figures, from 2 to 5; all by default. A folder that does not exist is created.
    """
    wanted = sorted({only} if isinstance(only, int) else set(FIGURES if only is None else only))
    for number in wanted:
        require(number in FIGURES, "figure", f"{number}", ", ".join(map(str, FIGURES)))
    written = []
    for place, number in enumerate(wanted):
        if progress is not None:
            progress(place / len(wanted))
        figure, columns = FIGURES[number]()
        rows = ([f"{x:.10g}" for x in row] for row in zip(*columns.values(), strict=True))
        written.append(drawing.save(figure, Path(folder) / f"fig{number}.png"))
        written.append(write_csv(Path(folder) / f"fig{number}.csv", columns, rows))
    return written


#: A picture, and its data: columns by their names with units.
Drawn = tuple["drawing.Picture", dict[str, FloatArray]]


def figure_2() -> Drawn:
    """Resistivity and relative permittivity of stratum corneum against frequency."""
    f = np.geomspace(*SKIN_BAND, 161)
    rho, eps = skin_resistivity(f), skin_permittivity(f)
    figure, (left, right) = drawing.new_figure(1, 2, height=2.7)
    cubic = r"Eq. 18, read as a cubic in $\log_{10} f$"
    for ax, y, label, title, color, limits in (
        (left, rho, r"Resistivity $\rho_\mathrm{sc}$ [Ω m]", cubic, drawing.BLUE, (5e2, 1e5)),
        (right, eps, r"Relative permittivity $\varepsilon_\mathrm{r,sc}$", "Eq. 19", drawing.VERMILION, (1e3, 1e4)),
    ):
        ax.loglog(f, y, color=color, linewidth=1.6)
        drawing.dress(ax, label, "Frequency $f$ [Hz]", xlim=SKIN_BAND, ylim=limits)
        ax.set_title(title, fontsize=drawing.FONT, loc="left")
    return figure, {"frequency [Hz]": f, "rho_sc [ohm m]": rho, "eps_r_sc [1]": eps}


def figure_3(points: int = 46) -> Drawn:
    """Mean electroadhesive force against frequency; each panel varies one parameter."""
    f = np.geomspace(10.0, 1e4, points)
    circuit = table1_circuit().replace({"Vdrive.amplitude": U0_FORCE})
    base = phasor(circuit, f).f_el_mean
    figure, axes = drawing.new_figure(2, 2, height=5.0, sharex=True)
    columns = {"frequency [Hz]": f, "f_el_mean [N] Table 1": base}
    for ax, variation in zip(axes, variations(), strict=True):
        # Table 1 is black, and the others have colours and dashes.
        styles = zip(drawing.CYCLE[:3], drawing.DASHES[1:], strict=True)
        for value in variation.values:
            force, color, dash, width = base, drawing.BLACK, "-", 1.8
            if value != variation.base:
                force, (color, dash), width = phasor(variation.apply(circuit, value), f).f_el_mean, next(styles), 1.5
                columns[f"f_el_mean [N] {variation.name}={value:g} {variation.unit.translate(_ASCII)}"] = force
            label = f"${variation.symbol}$ = {value:.3g} {variation.unit}"
            ax.semilogx(f, force, label=label, color=color, linestyle=dash, linewidth=width)
        other_scale = variation.name == "d_a"
        ax.set_title(variation.title + " (other scale)" * other_scale, fontsize=drawing.FONT, loc="left")
        y_label = r"Mean force $F_\mathrm{el}$ [N]" if ax in axes[::2] else ""
        x_label, top = "Frequency $f$ [Hz]" if ax in axes[2:] else "", 0.25 if other_scale else 0.125
        drawing.dress(ax, y_label, x_label, xlim=(f[0], f[-1]), ylim=(0.0, top))
        # In the corner that the panel's curves leave free.
        ax.legend(loc=4 if variation.name == "r_a" else 2, fontsize=drawing.FONT - 1.0, frameon=False)
    return figure, columns


def time_response(shape: type[Sine] | type[Square], frequency: float, *, dispersive: bool = False) -> Solution:
    """One period of the periodic state of Table 1 at 200 V, with the skin taken at `frequency` (Hz) or dispersive."""
    changes: dict[str, float | Waveform] = {"Vdrive": shape(U0_TIME, frequency)}
    if not dispersive:
        changes["Xskin.f"] = frequency
    # 2 % of a square wave's energy lies above the skin's data, in the paper as here: no warning is needed.
    with warnings.catch_warnings(action="ignore", category=FingerspiceWarning):
        return steady_state(table1_circuit(dispersive=dispersive).replace(changes), points=1000).solution


def two_periods(solution: Solution) -> dict[str, FloatArray]:
    """Columns ``t``, ``u_source``, ``u_gap``, ``f_el``, ``area`` of one period, twice from t = 0, each row once."""
    assert solution.period is not None
    t, end = solution.t - solution.t[0], solution.t.size - 1
    # A period that ends at a jump ends with a left-hand row and the right-hand row that begins the next period.
    rows = np.array([*range(end), *range(end), *([] if t[-1] == t[-2] else [end])])
    shift = np.where(np.arange(rows.size) < end, 0.0, solution.period)
    names = ("u_source", "u_gap", "f_el", "area")
    return {"t": t[rows] + shift, **{name: getattr(solution, name)[rows] for name in names}}


def _time_figure(shape: type[Sine] | type[Square]) -> Drawn:
    """Gap voltage and force over two periods of the periodic state; of a square wave with a dispersive skin, too."""
    header = ["frequency [Hz]", "t [s]", "u_source [V]", "u_gap [V]", "f_el [N]", "area [m^2]"]
    header += ["u_gap_dispersive [V]", "f_el_dispersive [N]"] if shape is Square else []
    figure, axes = drawing.new_figure(2, 2, height=4.3, sharex="col", sharey="row")
    parts, dash = [], drawing.DASHES[1]
    for frequency, upper, lower in zip(FREQUENCIES, axes[:2], axes[2:], strict=True):
        data = two_periods(time_response(shape, frequency))
        factor, unit = drawing.engineering(2.0 / frequency, "s")
        # The last value of the period is put in front, so that an edge at t = 0 is drawn as a vertical line.
        t = factor * np.append(0.0, data["t"])
        y = {name: np.append(x[-1], x) for name, x in data.items()}
        upper.plot(t, y["u_source"], color=drawing.GREY, linewidth=1.2, linestyle=dash, label="source $U$")
        upper.plot(t, y["u_gap"], color=drawing.BLUE, linewidth=1.6, label=r"gap $U_\mathrm{a}$")
        lower.plot(t, y["f_el"], color=drawing.VERMILION, linewidth=1.6, label=r"force $F_\mathrm{el}$")
        if shape is Square:
            broad = two_periods(time_response(shape, frequency, dispersive=True))
            # The name appears only in the legend of the force, which has room for it.
            for ax, name, label in ((upper, "u_gap", "_"), (lower, "f_el", "dispersive")):
                data[f"{name}_dispersive"] = x = broad[name]
                dots = drawing.DASHES[3]
                ax.plot(t, np.append(x[-1], x), label=label, color=drawing.BLACK, linewidth=0.9, linestyle=dots)
        mean = float(np.trapezoid(data["f_el"], data["t"]) / data["t"][-1])
        lower.axhline(mean, color=drawing.BLACK, linewidth=1.0, linestyle=dash, label=f"mean {mean:.3f} N")
        for ax in (upper, lower):
            drawing.legend_above(ax, right=True, math=True)
        upper.set_title(f"{frequency:g} Hz", fontsize=drawing.FONT + 0.5, loc="left", weight="bold")
        ends, marks = (-0.02 * t[-1], 1.02 * t[-1]), np.linspace(0.0, t[-1], 5)
        drawing.dress(lower, "", f"Time [{unit}]", xlim=ends, xticks=marks)
        parts.append((np.full(data["t"].size, frequency), *data.values()))
    drawing.dress(axes[0], "Voltage [V]")
    drawing.dress(axes[2], r"Force $F_\mathrm{el}$ [N]", ylim=(0.0, None))
    return figure, {name: np.concatenate(c) for name, c in zip(header, zip(*parts, strict=True), strict=True)}


FIGURES: dict[int, Callable[[], Drawn]] = {
    2: figure_2, 3: figure_3, 4: partial(_time_figure, Sine), 5: partial(_time_figure, Square)
}  # fmt: skip
"""The function that makes each figure of the paper."""
