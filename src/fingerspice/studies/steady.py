"""Phasors of a circuit (Eqs. 9 to 15), its periodic state and its response to sines; and one beside the other."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, positive_row, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import AcSweep, Circuit, Element
from fingerspice.circuit.describe import Parameters, Sources, area_given, head_lines, overridden, require_circuit
from fingerspice.circuit.devices import beyond_fingers
from fingerspice.circuit.network import build_network, linear_scene, network_of, phasor_areas, with_skin_held
from fingerspice.physics.materials import SKIN_BAND
from fingerspice.plots import drawing, traces
from fingerspice.results.measures import Measured, Sweep, measured
from fingerspice.results.outcome import ErrorEstimate, SolveError
from fingerspice.results.solution import Figured, Sensitivity, Solution, Value
from fingerspice.results.spectrum import PhasorSolution
from fingerspice.results.steps import weigh_outputs
from fingerspice.solve.derivatives import check_request, sensitivities_of
from fingerspice.solve.periodic import close_period
from fingerspice.solve.problem import Problem, prepare
from fingerspice.solve.runs import Progress, warn
from fingerspice.solve.simulation import rtol_given, run_problem
from fingerspice.waveforms.waveform import Fundamental, Sine, refuse, require

# Largest number of frequencies; outputs in a period, through which cubics interpolate a sine to 1e-9 of its amplitude.
MAX_FREQUENCIES, POINTS = 1_000_000, 400


def sweep_drive(
    sources: tuple[tuple[Element, float], ...], fundamental: Fundamental | None, swept: bool
) -> tuple[float, float, str]:
    """Amplitude (V or A, else NaN), phase (rad) and origin of a drive: in a sweep AC if given, or the fundamental."""
    given = [(e, sign, e.ac) for e, sign in sources if e.ac is not None]
    if swept and given:
        # As in ngspice, a source without AC has an AC amplitude of 0.
        total = sum(sign * ac.phasor for _, sign, ac in given)
        words = [f"AC {ac.magnitude:g} {ac.phase_deg:g} of {e.name}" for e, _, ac in given]
        return abs(total), math.atan2(total.imag, total.real), " and ".join(words)
    names = " and ".join(e.name for e, _ in sources)
    if fundamental is None:
        return math.nan, 0.0, f"no fundamental of {names}"
    return fundamental.amplitude, fundamental.phase, f"the fundamental of {names}"


def sweep_notes(circuit: Circuit, f: FloatArray, note: str, skin: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Remarks on a sweep (Hz), on the frequency of the skin's data and a `note`, and warnings about extrapolation."""
    skins = {e.name: e.values["f"] for e in circuit.by_device("SKIN")}
    own, said = ", ".join(f"{name} f = {x:g} Hz" for name, x in skins.items()), ""
    if skins and skin == "own":
        said = f"the skin's data are held at the deck's own frequency ({own}) over the whole sweep"
    elif any(np.any(np.abs(f / x - 1.0) > 1e-9) for x in skins.values()):
        said = f"the skin's data are taken at each frequency of the sweep, not at the deck's own ({own})"
    low, high = float(f.min()), float(f.max())
    ends = ("down to", low, SKIN_BAND[0] / low, "below"), ("up to", high, high / SKIN_BAND[1], "above")
    # The tolerance of 1e-6 allows for rounding of a sweep's end.
    beyond = [f"{to} {x:g} Hz, {math.log10(by):.2g} decades {side}" for to, x, by, side in ends if by > 1.0 + 1e-6]
    warned = (f"the sweep goes {' and '.join(beyond)} the 10 Hz to 100 kHz of the skin's data (Eqs. 18, 19): what it "
              "shows there is extrapolated",)  # fmt: skip
    used = circuit.by_device("SKIN_DISPERSIVE") or (skins and skin != "own")
    return tuple(filter(None, (said, note))), warned if beyond and used else ()


def sweep_frequencies(sweep: AcSweep) -> FloatArray:
    """Frequencies (Hz) of an ``.ac`` line, of which at most `MAX_FREQUENCIES` are allowed."""
    base, ratio = (10.0 if sweep.scale == "dec" else 2.0), sweep.stop / sweep.start
    count = sweep.points - 1.0 if sweep.scale == "lin" else math.log(ratio) / math.log(base) * sweep.points
    refuse(count >= MAX_FREQUENCIES, f"the sweep has {count + 1.0:.3g} frequencies; allowed: at most {MAX_FREQUENCIES}")
    if sweep.scale == "lin":
        return np.linspace(sweep.start, sweep.stop, sweep.points)
    n = math.floor(count + 1e-9)
    out = sweep.start * base ** (np.arange(n + 1) / sweep.points)
    return np.asarray(np.append(out, sweep.stop) if count - n > 1e-9 else out)


def phasor(
    circuit: Circuit,
    frequency: ArrayLike | None = None,
    *,
    sources: Sources | None = None,
    parameters: Parameters | None = None,
    area: str | float = "mean",
    skin: str = "swept",
    finger: str | None = None,
) -> PhasorSolution:
    """Phasor solution of a circuit.

    Parameters
    ----------
    circuit : Circuit
    frequency : array_like, optional
        Hz, positive; the source's fundamental by default. If frequencies are given, the drive is the deck's
        ``AC magnitude [phase]``, as in ngspice; without AC, or without frequencies, it is the source's fundamental.
    sources, parameters
        As in `simulate`. Without a GAP the result has the node voltages, and every source's AC counts.
    area : str or float
        ``"mean"``: the area under the mean stress at the amplitude of the source's fundamental; ``"frozen"``: the area
        at 0 V; or an area in m^2. An area that the deck fixes takes precedence over ``"mean"`` and ``"frozen"``.
    skin : str
        ``"swept"``: SKIN's data at each frequency; ``"own"``: its data at its own f, as in ngspice.
    finger : str, optional
        Name of the GAP whose figures are wanted; needed if the circuit has several.

    Raises
    ------
    InputError
        If none of several GAPs is named, a network with a GAP has several sources, a fundamental is needed and missing,
        a frequency or the area is not positive, or a result is not finite.
    """
    require(skin in ("swept", "own"), "skin", repr(skin), "'swept' or 'own'")
    if isinstance(area, str):
        require(area in ("mean", "frozen"), "area", repr(area), "'mean', 'frozen' or a number in m^2")
    else:
        area = area_given(area)
    circuit = overridden(circuit, sources, parameters)
    held = circuit if skin == "swept" else with_skin_held(circuit)
    scene = None if finger is None and not circuit.by_device("GAP") else linear_scene(held, finger)
    network = build_network(held).alone if scene is None else scene.network
    alone = len(network.sources) == 1
    fundamental = network.waveforms[0].fundamental if alone else None
    asked = frequency if frequency is not None or fundamental is None else fundamental.frequency
    if asked is None:
        raise InputError("the source has no fundamental: give the frequencies in Hz")
    f = positive_row("frequency", asked, "Hz")
    amplitude, phase, drive = sweep_drive(network.drives, fundamental, frequency is not None)
    if scene is None and math.isnan(amplitude):
        raise InputError("no source has an amplitude; allowed: AC on a source, such as V1 in 0 AC 1, or one sine")
    fixed = scene is None or network.areas[scene.finger].given is not None
    if area == "mean" and math.isnan(amplitude) and not fixed:
        raise InputError("area='mean' needs the amplitude of the source's fundamental, and this source has none; "
                         "allowed: 'frozen' or an area in m^2")  # fmt: skip
    notes, warned = sweep_notes(circuit, f, "" if scene is None else scene.note, skin)
    none = np.full(f.size, math.nan)
    with np.errstate(all="ignore"):
        areas = np.array([phasor_areas(network, area, float(x), amplitude) for x in f])
        # As in ngspice, the AC of every source counts.
        own = amplitude * np.exp(1j * phase)
        s = np.array([own if alone else e.ac.phasor if e.ac is not None else 0.0 for e in network.sources], complex)
        v = np.array([network.node_phasors(float(x), a, s) for x, a in zip(f, areas, strict=True)])
        if scene is None:
            layers, gain, u_gap, size, force = np.zeros((f.size, 0), complex), none + 0j, none + 0j, none, none
            results: tuple[NDArray[np.inexact], ...] = (v,)
        else:
            layers = np.array([network.layer_gain(float(x), a) for x, a in zip(f, areas, strict=True)])
            gain, size = layers[:, scene.gap], areas[:, scene.finger].copy()
            u_gap = gain * amplitude * np.exp(1j * phase)
            force = scene.contact.per_volt * np.abs(u_gap) ** 2 * network.pulled(scene.finger, areas.T)
            stress, force = force / size, 0.5 * force  # At a constant area a sine's mean is half the peak
            results = (layers, size, u_gap, force)[: 4 if math.isfinite(amplitude) else 2]
            warned = (*warned, *beyond_fingers("", *(float(np.max(x)) for x in (force, stress, size))))
        impedance = np.array([network.impedance(float(x), a) for x, a in zip(f, areas, strict=True)]) if alone else None
    finite = np.logical_and.reduce([np.isfinite(x).reshape(f.size, -1).all(axis=1) for x in results])
    if not finite.all():
        nearer = "frequencies nearer to the 10 Hz to 100 kHz of the skin's data, and values nearer to Table 1's"
        raise InputError(f"the phasor at {f[np.argmin(finite)]:g} Hz is beyond the range of numbers; allowed: {nearer}")
    for text in warned:
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    names = () if scene is None else tuple(e.name for e in network.layers)
    found = {} if frequency is None else _measured(circuit, f, {"area": area, "skin": skin, "finger": finger})
    return PhasorSolution(
        f, gain, layers, u_gap, size, force, amplitude, names, phase, drive, notes, warned, circuit, impedance,
        network.node_names, v, found,
    )  # fmt: skip


def _measured(circuit: Circuit, f: FloatArray, options: Mapping[str, Any]) -> dict[str, Measured]:
    """The deck's `.meas ac` lines over a sweep (Hz)."""
    bare = dataclasses.replace(circuit, measures=())

    def solve(at: FloatArray) -> PhasorSolution:
        with warnings.catch_warnings(action="ignore"):
            return phasor(bare, at, **options)

    return measured(Sweep(circuit, f, solve))


@dataclass(frozen=True, repr=False)
class SteadyState(Shown, Figured):
    """The periodic state with its defect, stability and error; its figures (`f_el_mean`, ...) are those of the period.

    Attributes
    ----------
    problem : Problem
        The run of one period from the periodic state, at the first whole period after the source has settled.
    rtol : float
    defect : float
        Largest change of a capacitor's or layer's voltage over a further period, V.
    memory : float
        Ratio of the error of the periodic state to the error of one period; large if a disturbance lasts many periods.
    error : ErrorEstimate
        Estimated error of the state, as its effect on the gap voltage and the force of the period.
    periods : float
        Number of periods integrated to find the state.
    area : str or float
        As in `simulate`.
    asked : tuple of str
        Parameters by which `sensitivities` are wanted.
    """

    problem: Problem
    rtol: float
    defect: float
    memory: float
    error: ErrorEstimate
    periods: float
    _slope: Callable[[], FloatArray]
    area: str | float = "coupled"
    asked: tuple[str, ...] = ()

    def _page(self) -> Page:
        found = f"periodic state of {format_si(self.period, 's')}, found in {self.periods:.3g} periods"
        left = f"{100.0 * (1.0 - self.stability_margin):.3g} % of a small disturbance"
        changes = f"a further period changes the voltages by {self.defect:.2g} V at most, and leaves {left}"
        try:
            period = self.solution._page().blocks
        except SolveError as error:
            period = (error.message,)
        return Page([found, changes, "", *period])

    def plot(self, signals: str | Sequence[str] | None = None) -> drawing.Figure:
        """The period's signals against time; `signals` as in `Solution.plot`."""
        return self.solution.plot(signals)

    @property
    def period(self) -> float:
        """Period of the source, s."""
        assert self.problem.network.waveform.period is not None
        return self.problem.network.waveform.period

    @cached_property
    def map_slope(self) -> FloatArray:
        """Derivative of the map of a period, shape (n, n), to about 1e-5, integrated at the first access.

        Its variables are the circuit's modes: the independent voltages (one less than the cells of a stack), and the
        areas with a time constant.
        """
        return self._slope()

    @property
    def multipliers(self) -> FloatArray:
        """Absolute values of the Floquet multipliers, the factors of small disturbances over a period, shape (n,)."""
        return np.abs(np.linalg.eigvals(self.map_slope)) if self.map_slope.size else np.zeros(0)

    @property
    def stability_margin(self) -> float:
        """1 minus the largest multiplier: 0 if a disturbance never decays."""
        return 1.0 - float(self.multipliers.max(initial=0.0))

    def _figure(self, key: str, kind: str) -> Value:
        return self.solution._figure(key, kind)

    @property
    def sensitivities(self) -> Mapping[str, Sensitivity]:
        """Derivatives of the period's signals and means, by the path of each parameter that was asked for."""
        return self.solution.sensitivities

    def _run(self, circuit: Circuit, rtol: float) -> Solution:
        """The run from the periodic state of another circuit, as long as the period of this one."""
        law, step = self.problem.scene.charge_law, self.problem.step
        other = prepare(circuit, t_stop=self.period, charge_law=law, area=self.area, start="periodic", charge=False)
        return run_problem(close_period(dataclasses.replace(other, first=0.0, step=step), 0.5 * rtol)[0], rtol=rtol)

    @cached_property
    def solution(self) -> Solution:
        """The period's signals, integrated at the first access, which also gives the warnings.

        Raises
        ------
        SolveError
            If the integration fails.
        """
        solution = run_problem(self.problem, rtol=self.rtol)
        if solution.failure is not None:
            raise SolveError(solution.failure, solution)
        if self.asked:
            found = sensitivities_of(self.problem, solution, self.asked, self._run, over_period=True)
            solution = dataclasses.replace(solution, sensitivities=found)
        # The third level is the caller's line, beyond the frame of `cached_property`.
        warn(solution, 3)
        return solution


def steady_state(
    circuit: Circuit,
    *,
    sources: Sources | None = None,
    parameters: Parameters | None = None,
    charge_law: str | None = None,
    area: str | float = "coupled",
    rtol: float = 1e-8,
    points: int = 200,
    charge: bool = True,
    sensitivities: Sequence[str] = (),
) -> SteadyState:
    """Periodic state of a circuit, by Newton's method on the map of one period.

    A charge that no conductance drains is not determined by periodicity: it keeps the value of the uncharged start.

    Parameters
    ----------
    circuit : Circuit
        A circuit with a periodic source, or with several sources that have a common period.
    sources, parameters, charge_law, area, rtol, charge
        As in `simulate`; the error is relative to the peaks over the period.
    points : int
        Output steps in the period.
    sensitivities : sequence of str
        As in `simulate`: how the periodic state changes with these parameters.

    Raises
    ------
    InputError
        If the source has no period.
    SolveError
        If a period cannot be integrated, or Newton's method does not converge.
    """
    rtol, points = rtol_given(rtol), whole_number("points", points, 1)
    circuit = overridden(circuit, sources, parameters)
    period = network_of(circuit).waveform.period
    if period is None:
        raise InputError("the source has no period, so there is no periodic state to find")
    problem = prepare(circuit, t_stop=period, charge_law=charge_law, area=area, start="periodic", charge=charge)
    if sensitivities:
        check_request(problem, sensitivities, "auto")
    problem, found = close_period(dataclasses.replace(problem, first=0.0, step=period / points), 0.5 * rtol)
    error = ErrorEstimate(*map(float, found.gap_errors.max(axis=0, initial=0.0)))
    return SteadyState(
        problem, rtol, found.defect, found.memory, error, found.periods, found.map_slope, area, tuple(sensitivities)
    )


def large_signal(
    circuit: Circuit,
    frequency: ArrayLike,
    amplitude: ArrayLike | None = None,
    *,
    charge_law: str | None = None,
    rtol: float = 1e-8,
    finger: str | None = None,
    progress: Progress | None = None,
) -> tuple[PhasorSolution, ...]:
    """Periodic states under sines, for each frequency and amplitude; SKIN is evaluated at each frequency.

    Parameters
    ----------
    circuit : Circuit
        A circuit with a GAP and one source.
    frequency : array_like
        Hz, positive.
    amplitude : array_like, optional
        V (A for a current source), positive; by default the amplitude of the source's ``AC``, or without AC that of its
        fundamental.
    charge_law, rtol, progress
        As in `simulate`.
    finger : str, optional
        Name of the GAP whose figures are wanted; needed if the circuit has several.

    Returns
    -------
    tuple of PhasorSolution
        One per amplitude. Gains are those of the fundamental; area and force are means over the period.

    Raises
    ------
    InputError
        If the circuit has no GAP or several sources, if none of several GAPs is named, or if a frequency or amplitude
        is not positive.
    SolveError
        If there is no periodic state.
    """
    require_circuit(circuit)
    scene = linear_scene(circuit, finger)
    driving = scene.network.drives
    names = ", ".join(e.name for e, _ in driving)
    refuse(len(driving) != 1, f"a large-signal sweep drives one source, and this circuit has {names}")
    own = sweep_drive(driving, scene.network.waveforms[0].fundamental, swept=True)
    if amplitude is None and math.isnan(own[0]):
        raise InputError("the source has no fundamental to take the amplitude of: give the amplitudes in V")
    given = positive_row("amplitude", own[0] if amplitude is None else amplitude, "V")
    f = positive_row("frequency", frequency, "Hz")
    notes, warned = sweep_notes(circuit, f, scene.note, "swept")
    for text in warned:
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    drives = [own] if amplitude is None else [(float(a), 0.0, "the amplitude given") for a in given]
    ((source, sign),), skins, found = driving, [f"{e.name}.f" for e in circuit.by_device("SKIN")], []
    for place, (size, phase, drive) in enumerate(drives):
        rows = []
        for number, x in enumerate(f.tolist(), place * f.size + 1):
            changed = circuit.varied({**dict.fromkeys(skins, x), source.name: Sine(size, x)})
            s = steady_state(changed, charge_law=charge_law, rtol=rtol, points=POINTS, charge=False).solution
            # The output starts at a multiple of the period: phases from its start are relative to the source.
            period, end = s.t - s.t[0], "" if len(s.gaps) == 1 else f":{s.layers[scene.gap]}"
            means = [weigh_outputs(period, s.record.one(key + end)).mean() for key in ("area", "f_el")]
            rows.append([*means, *(weigh_outputs(period, u).phasor(x) * sign / size for u in s.u_layer.T)])
            if progress is not None:
                progress(number / (f.size * len(drives)))
        table = np.array(rows, np.complex128)
        (areas, forces), gain = table[:, :2].real.T.copy(), table[:, 2:].copy()
        u_gap = gain[:, scene.gap] * size * np.exp(1j * phase)
        largest = forces.max(), scene.contact.stress(np.abs(u_gap)).max(), areas.max()
        found.append(PhasorSolution(
            f, gain[:, scene.gap], gain, u_gap, areas, forces, size, s.layers, phase, drive, notes,
            (*warned, *beyond_fingers("", *map(float, largest))), circuit,
        ))  # fmt: skip
    return tuple(found)


@dataclass(frozen=True)
class Figures:
    """Gap voltage at the fundamental, mean force and mean area from one method; arrays (n_gap,) of several GAPs."""

    amplitude: float | NDArray[np.float64]  # V
    phase_deg: float | NDArray[np.float64]  # Lead over the source's fundamental, degrees
    f_el_mean: float | NDArray[np.float64]  # N
    area_mean: float | NDArray[np.float64]  # m^2

    def of_gap(self, i: int) -> dict[str, float]:
        """The figures of one GAP by their names."""
        return {name: np.atleast_1d(value)[i].item() for name, value in vars(self).items()}


# Of every figure: its unit in tables, the factor from SI to that unit, and its name on the page and in the picture.
_FIGURES = {
    "amplitude": ("V", 1.0, "gap voltage amplitude", "Gap voltage at the fundamental"),
    "phase_deg": ("deg", 1.0, "lead over the source", "Its lead over the source"),
    "f_el_mean": ("N", 1.0, "mean force", "Mean electroadhesive force"),
    "area_mean": ("mm^2", 1e6, "mean area", "Mean ridge area"),
}


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """The same scene solved by three methods.

    Attributes
    ----------
    phasor : Figures
        Eqs. 9 to 15, with every area coupled through its mean stress.
    mean : Figures
        Transient with the phasor's constant areas; its difference from `phasor` is due to the source's harmonics.
    coupled : Figures
        Transient with the areas coupled at every instant; its difference from `mean` is due to the areas' ripple.
    frequency : float
        Hz.
    solution : Solution
        One period of the coupled transient.
    """

    phasor: Figures
    mean: Figures
    coupled: Figures
    frequency: float
    solution: Solution

    def _page(self) -> Page:
        rows = list(self._lines(2, ".6g", ".6g"))
        head = ("", "phasor", "transient, mean area", "transient, coupled", "coupled - phasor", "of it, ripple")
        state = f"periodic state at {format_si(self.frequency, 'Hz')}, charge law {self.solution.charge_law}"
        page: list[str | Table] = [*head_lines(self.solution.circuit), state, "", Table(head, rows), ""]
        for i, gap in enumerate(self.gaps):
            reference, mean, coupled = (f.of_gap(i)["f_el_mean"] for f in (self.phasor, self.mean, self.coupled))
            # Round before formatting, and add 0.0, so that -0.00 is not printed.
            total, waveform = (round(100.0 * (x / reference - 1.0), 2) + 0.0 for x in (coupled, mean))
            of = f" of {gap}" if len(self.gaps) > 1 else ""
            parts = f"{total - waveform:+.2f} % of that is the ripple of the area, {waveform:+.2f} % is the waveform's"
            page.append(f"mean force{of}: {total:+.2f} % against the phasor; {parts} (zero for a sine)")
        return Page(page)

    def plot(self) -> drawing.Picture:
        """Picture of one period of the transient and of the phasor, with the figures of both."""
        # The table has four rows for each GAP.
        more = 0.53 * (len(self.gaps) - 1)
        figure, axes = drawing.new_figure(3, height=5.6 + 1.67 * more, height_ratios=[1.3, 1.3, 0.75 + more])
        solution, runs = self.solution, [(self.solution, "")]
        start, stop = float(solution.t[0]), float(solution.t[-1])
        turns = 2.0 * np.pi * self.frequency * solution.t
        turns += solution.fundamental.phase if solution.fundamental else 0.0
        t = traces.time_unit(runs)[0] * solution.t
        style: dict[str, Any] = {"color": drawing.BLACK, "linestyle": drawing.DASHES[3], "linewidth": 1.5}
        for ax, keys in zip(axes, (["u_source", "u_gap"], ["f_el"]), strict=False):
            drawn, factor, unit = traces.draw_panel(ax, runs, keys, start, stop)
            for i, trace in enumerate(drawn[-len(self.gaps) :]):
                p = self.phasor.of_gap(i)
                wave = np.sin(turns + np.radians(p["phase_deg"]))
                curve = 2.0 * p["f_el_mean"] * wave**2 if keys == ["f_el"] else p["amplitude"] * wave
                ax.plot(t, factor * curve, label=f"{trace.label}, phasor", **style)
            traces.finish_panel(ax, keys, drawn, factor, unit)
        traces.time_axis(axes[:2], runs, start, stop)
        drawing.caption(figure, f"{traces.about_all(runs)} · periodic state; the phasor is of the fundamental alone")
        figure.align_ylabels(axes[:2])
        split = "transient,\nmean area", "transient,\ncoupled", "coupled −\nphasor", "of it, ripple\nof the area"
        cells = [["", "phasor", *split]]
        for label, *texts in self._lines(3, ".5g", "+.2g"):
            cells.append([label.replace("[deg]", "[°]").replace("^2", "²"), *(x.replace("-", "−") for x in texts)])
        axes[2].axis("off")
        # Names of GAPs need more room.
        first, size = (0.36, drawing.FONT - 0.5) if len(self.gaps) == 1 else (0.42, drawing.SMALL)
        widths = [first, *[0.2 * (1.0 - first)] * 5]
        table = axes[2].table(cells, cellLoc="right", loc="center", edges="horizontal", colWidths=widths)
        table.auto_set_font_size(False)
        table.set_fontsize(size)
        for (row, column), cell in table.get_celld().items():
            cell.set(edgecolor="#BBBBBB", linewidth=0.6, height=(1.0 if row else 1.7) * cell.get_height())
            if column == 0:
                cell.get_text().set_horizontalalignment("left")
                cell.PAD = 0.0
        return figure

    def rows(self) -> list[tuple[str, str, float, float, float, float, float]]:
        """Rows of quantity, unit, phasor, transient at mean area, coupled, coupled - phasor, coupled - mean area.

        If the circuit has several GAPs, the quantity is ``name:gap``.
        """
        out = []
        for i, gap in enumerate(self.gaps):
            for name, (unit, factor, *_) in _FIGURES.items():
                p, m, c = (factor * f.of_gap(i)[name] for f in (self.phasor, self.mean, self.coupled))
                out.append((name if len(self.gaps) == 1 else f"{name}:{gap}", unit, p, m, c, c - p, c - m))
        return out

    def _lines(self, place: int, form: str, change: str) -> Iterator[tuple[str, ...]]:
        """Rows as text: the names at this place of `_FIGURES`, the figures, and the changes of them, in these forms."""
        for what, unit, *numbers in self.rows():
            name, _, gap = what.partition(":")
            texts = map(format, numbers, [form] * 3 + [change] * 2)
            yield f"{_FIGURES[name][place]} {gap}".rstrip() + f" [{unit}]", *texts

    @property
    def gaps(self) -> tuple[str, ...]:
        """Names of the GAPs."""
        return self.solution.gaps

    def to_dict(self) -> dict[str, Any]:
        """The figures as plain data, in SI units."""
        parts = {"phasor": self.phasor, "transient_mean_area": self.mean, "transient_coupled": self.coupled}
        plain = {key: {name: np.asarray(x).tolist() for name, x in vars(part).items()} for key, part in parts.items()}
        return {"frequency": self.frequency, "gaps": list(self.gaps), **plain}


def compare(
    circuit: Circuit,
    *,
    sources: Sources | None = None,
    parameters: Parameters | None = None,
    charge_law: str | None = None,
    rtol: float = 1e-8,
) -> Comparison:
    """Compare the periodic state of the transient with the phasor.

    Parameters
    ----------
    circuit : Circuit
        A circuit with at least one GAP and one periodic source with a fundamental; a stack may have several sources.
    sources, parameters, charge_law
        As in `simulate`.
    rtol : float
        Error of the transients, relative to their peaks.

    Raises
    ------
    InputError
        If the circuit has no GAP, a network has several sources, or the source has no period or fundamental.
    SolveError
        If a transient fails.
    """
    circuit = overridden(circuit, sources, parameters)
    names = [name for name, _ in network_of(circuit).named_contacts]
    fundamental = linear_scene(circuit, next(iter(names), None)).network.waveforms[0].fundamental
    if fundamental is None:
        raise InputError("compare needs a source with a fundamental: a periodic one; this source has none")
    found = [phasor(circuit, finger=name) for name in names]
    how: dict[str, Any] = {"charge_law": charge_law, "rtol": rtol, "points": 2000}
    coupled, mean = (steady_state(circuit, area=area, **how).solution for area in ("coupled", "mean"))
    figures = [(abs(p.u_gap[0]), np.degrees(np.angle(p.gain[0])), p.f_el_mean[0], p.area[0]) for p in found]
    ways: list[Any] = [np.array(figures).T]
    for one in (mean, coupled):
        lead = np.asarray(one.u_gap_phase_deg, float) - np.degrees(fundamental.phase)
        area = one._figure("area", "mean_periodic")
        every = one.u_gap_amplitude, (lead + 180.0) % 360.0 - 180.0, one.f_el_mean_periodic, area
        ways.append(np.array(every, float).reshape(len(every), -1))
    first, second, third = (Figures(*(way[:, 0].tolist() if len(found) == 1 else way)) for way in ways)
    return Comparison(first, second, third, fundamental.frequency, coupled)
