"""The problems of the benchmarks, each defined once: scene, source, outputs, and times at which runs are split.

All start uncharged at t = 0 with Table 1's finger and the skin frozen at one frequency. Squares have ideal jumps.
Outputs are half an output spacing away from the jumps, so that no contestant has to choose a side of a jump.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev, polynomial
from numpy.typing import NDArray

import fingerspice as fs
from fingerspice.circuit.statespace import build_stack
from fingerspice.physics.contact import JkrContact

FloatArray = NDArray[np.float64]
DECK = Path(__file__).resolve().parent.parent / "circuits" / "fingerpad.cir"
AMPLITUDE = 200.0
OUTPUTS_PER_PERIOD = 100
SERIES_ERROR = 1e-14
BELOW = 1.1
"""Negative of the series' argument at which the continuation below 0 V ends; 0 V is at 1."""

Drive = Callable[[Callable[[Any], Any]], Callable[[Any, Any], Any]]
"""Function from a library's sine to U(t, level) in V; `level` (V) is the value of a square on a piece."""


@dataclass(frozen=True)
class Piece:
    """A smooth stretch of a run, in the form that peers are given.

    Attributes
    ----------
    t0, t1 : float
        s.
    level : float
        Voltage of a square on the piece, V.
    sign : float
        Sign of the gap voltage, if pieces end on its zeros; 0 if the gap voltage may cross zero in the piece. For
        several gaps see `network_rates.code`.
    first, last : int
        The outputs in the piece are t_eval[first:last].
    """

    t0: float
    t1: float
    level: float
    sign: float
    first: int
    last: int


@dataclass(frozen=True)
class Problem:
    """A scene to be integrated.

    Attributes
    ----------
    name, title : str
        Key in the results, and name in tables.
    waveform : fs.Waveform
        Waveform of the source, V.
    drive : Drive
        The same waveform for peers.
    ngspice : str
        The same waveform as ngspice's source.
    skin_frequency : float
        Frequency at which the skin is evaluated, Hz.
    period : float
        Length of one period in results "per period", s.
    periods : int
        Length of the run in periods.
    law : str
        Charge law.
    r_coat : float
        Resistance of the coating, ohm.
    divisible : bool
        Whether a shorter run costs the same per period, so that slow peers may be given a shorter one.
    stiff : bool
        Whether the second reference uses an implicit method.
    reach : float
        Upper bound of the gap voltages of the problem, V.
    exported : tuple
        For each finger, the exported deck's names of the two nodes of the gap and of the area node.
    """

    name: str
    title: str
    waveform: fs.Waveform
    drive: Drive
    ngspice: str
    skin_frequency: float
    period: float
    periods: int
    law: str = "local"
    r_coat: float = 2e5
    divisible: bool = True
    stiff: bool = False
    reach: float = AMPLITUDE
    exported: tuple[tuple[str, str, str], ...] = (("top", "skin", "area"),)

    def t_stop(self, periods: int) -> float:
        """End time of a run of this many periods, s."""
        return periods * self.period

    def t_eval(self, periods: int) -> FloatArray:
        """Output times, s, shape (periods * OUTPUTS_PER_PERIOD,)."""
        return (np.arange(periods * OUTPUTS_PER_PERIOD) + 0.5) * (self.period / OUTPUTS_PER_PERIOD)

    def circuit(self) -> fs.Circuit:
        """The netlist of this problem."""
        text = DECK.read_text(encoding="utf-8")
        if self.law == "mobile":
            text = text.replace(".include fingerspice.lib", ".include fingerspice_mobile.lib")
        circuit = fs.parse_netlist(text)
        return circuit.replace(
            {"Vdrive": self.waveform, "Xskin.f": self.skin_frequency, "Xcoat.r": self.r_coat},
        )

    @cached_property
    def constants(self) -> Constants:
        """Constants of the right-hand side."""
        return constants(self.circuit(), self.reach)

    @property
    def stresses(self) -> tuple[float, ...]:
        """sigma_el / u_gap^2 of each finger, Pa/V^2."""
        return (self.constants.stress,)

    def pieces(self, periods: int, zeros: Sequence[float] = (), signs: Sequence[float] = ()) -> tuple[Piece, ...]:
        """The run, split at the source's jumps and, if they are given, at the zeros of the gap voltage.

        `signs` holds the sign of the gap voltage on every piece of the whole run.
        """
        stop = self.t_stop(periods)
        edges = split_times(self, periods, zeros)
        outputs = np.searchsorted(self.t_eval(periods), edges)
        level = self.waveform.value(0.5 * (edges[1:] + edges[:-1]))
        side = list(signs) if len(signs) else [0.0] * (edges.size - 1)
        return tuple(
            Piece(float(edges[i]), min(float(edges[i + 1]), stop), float(level[i]), float(side[i]),
                  int(outputs[i]), int(outputs[i + 1]))
            for i in range(edges.size - 1)
        )  # fmt: skip


def split_times(problem: Problem, periods: int, zeros: Sequence[float] = ()) -> FloatArray:
    """Start, jumps, zeros of the gap voltage inside, and end of a run, s, ascending."""
    stop = problem.t_stop(periods)
    jumps = problem.waveform.breakpoints(0.0, stop)
    inner = np.unique(np.concatenate([jumps, np.asarray(zeros, float)]))
    # A zero that differs from a jump or an end only by rounding counts as that jump or end.
    inner = inner[(inner > 1e-12 * stop) & (inner < stop * (1.0 - 1e-12))]
    keep = np.concatenate([[True], np.diff(inner) > 1e-12 * stop]) if inner.size else np.empty(0, bool)
    return np.concatenate([[0.0], inner[keep], [stop]])


@dataclass(frozen=True)
class Constants:
    """A three-layer stack (coating, gap, skin) as numbers.

    Attributes
    ----------
    k : tuple of float
        Fraction of a jump of the source that each layer takes.
    fixed, per_area : tuple of float
        Leakage rate of each layer, fixed + per_area / A_R, 1/s and m^2/s.
    series : tuple of float
        Power series of 1/A_R (1/m^2) in 2 |u_gap| / `reach` - 1, with relative error below `SERIES_ERROR`.
    reach : float
        Largest |u_gap| of the series, V.
    area0 : float
        A_R at 0 V, m^2.
    stress : float
        sigma_el / u_gap^2, Pa/V^2.
    """

    k: tuple[float, float, float]
    fixed: tuple[float, float, float]
    per_area: tuple[float, float, float]
    series: tuple[float, ...]
    reach: float
    area0: float
    stress: float


def area_series(contact: JkrContact, reach: float, error: float = SERIES_ERROR, degrees: int = 24) -> tuple[float, ...]:
    """Power series of 1/A_R (1/m^2) in 2 |u_gap| / `reach` - 1, with a relative error of at most `error`.

    Raises
    ------
    ValueError
        If no series of up to `degrees` has that error.
    """
    check = np.linspace(-1.0, 1.0, 4001)
    exact = 1.0 / contact.area(0.5 * reach * (check + 1.0))
    for degree in range(8, degrees + 1):
        fit = chebyshev.chebinterpolate(lambda x: 1.0 / contact.area(0.5 * reach * (x + 1.0)), degree)
        # Powers allow Horner's rule, which compiles best; on [-1, 1], with decaying coefficients, no digits are lost.
        series = chebyshev.cheb2poly(fit)
        if np.abs(polynomial.polyval(check, series) / exact - 1.0).max() <= error:
            return tuple(series.tolist())
    raise ValueError(f"1/A_R has no series of degree {degrees} or less within {error:g} to {reach:g} V")


def constants(circuit: fs.Circuit, reach: float, error: float = SERIES_ERROR, degrees: int = 24) -> Constants:
    """Constants of a circuit's stack, from the package; the area's series reaches to `reach` (V) within `error`."""
    stack = build_stack(circuit)
    assert stack.contact is not None
    assert stack.gap == 1
    return Constants(
        k=tuple(stack.k.tolist()),
        fixed=tuple((stack.g_area / stack.c).tolist()),
        per_area=tuple((stack.g_total / stack.c).tolist()),
        series=area_series(stack.contact, reach, error, degrees),
        reach=reach,
        area0=float(stack.contact.area(0.0)),
        stress=float(stack.contact.stress(1.0)),
    )


def tone(amplitude: float, frequency: float, offset: float = 0.0) -> Drive:
    """A sine with an offset, V."""
    omega = 2.0 * math.pi * frequency

    def bind(sin: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
        def u(t: Any, level: Any) -> Any:
            return offset + amplitude * sin(omega * t)

        return u

    return bind


def held(sin: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    """A source that is constant on each piece, at the piece's level (V)."""

    def u(t: Any, level: Any) -> Any:
        return level

    return u


def _modulated(carrier: float, envelope: float) -> Drive:
    fast, slow = 2.0 * math.pi * carrier, 2.0 * math.pi * envelope

    def bind(sin: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
        def u(t: Any, level: Any) -> Any:
            return 0.5 * AMPLITUDE * (1.0 + sin(slow * t)) * sin(fast * t)

        return u

    return bind


def _chirp(f0: float, f1: float, duration: float) -> Drive:
    start, rise = 2.0 * math.pi * f0, math.pi * (f1 - f0) / duration

    def bind(sin: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
        def u(t: Any, level: Any) -> Any:
            return AMPLITUDE * sin((start + rise * t) * t)

        return u

    return bind


def square_text(frequency: float) -> str:
    """A square as ngspice's source."""
    # Edges of 1 ns centred on the jumps change the result by 1e-9 of the peak.
    half, edge = 0.5 / frequency, 1e-9
    times = f"{half - 0.5 * edge!r} {edge!r} {edge!r} {half - edge!r} {2.0 * half!r}"
    return f"PULSE({AMPLITUDE!r} {-AMPLITUDE!r} {times})"


def _scene(kind: str, frequency: float, law: str = "local") -> Problem:
    square = kind == "square"
    label = f"{frequency:g} Hz" if frequency < 1e3 else f"{frequency / 1e3:g} kHz"
    return Problem(
        name=f"{kind}_{label.replace(' ', '')}" + ("" if law == "local" else f"_{law}"),
        title=f"{kind} {label}",
        waveform=fs.Square(AMPLITUDE, frequency) if square else fs.Sine(AMPLITUDE, frequency),
        drive=held if square else tone(AMPLITUDE, frequency),
        ngspice=square_text(frequency) if square else f"SIN(0 {AMPLITUDE!r} {frequency!r})",
        skin_frequency=frequency,
        period=1.0 / frequency,
        periods=200 if frequency < 1e3 else 500,
        law=law,
        # After a jump the gap voltage exceeds the source voltage by the stored charge.
        reach=1.3 * AMPLITUDE if square else AMPLITUDE,
    )


SCENES = (("sine", 100.0), ("square", 100.0), ("sine", 5000.0), ("square", 5000.0))
_AM = Problem(
    name="am_5kHz",
    title="5 kHz, envelope 50 Hz",
    waveform=fs.AM(AMPLITUDE, 5000.0, 50.0),
    drive=_modulated(5000.0, 50.0),
    ngspice=f"{{{0.5 * AMPLITUDE!r}*(1+sin({2 * math.pi * 50.0!r}*time))*sin({2 * math.pi * 5000.0!r}*time)}}",
    skin_frequency=5000.0,
    period=2e-4,
    periods=100,
    divisible=False,
)
_CHIRP = Problem(
    name="chirp",
    title="chirp 20 Hz to 20 kHz",
    waveform=fs.Chirp(AMPLITUDE, 20.0, 20e3, 0.04),
    drive=_chirp(20.0, 20e3, 0.04),
    ngspice=f"{{{AMPLITUDE!r}*sin(({2 * math.pi * 20.0!r}+{math.pi * 19980.0 / 0.04!r}*time)*time)}}",
    skin_frequency=1000.0,
    period=1e-3,
    periods=40,
    divisible=False,
)
_STIFF = Problem(
    name="stiff",
    title="sine 100 Hz, R_i = 1 ohm",
    waveform=fs.Sine(AMPLITUDE, 100.0),
    drive=tone(AMPLITUDE, 100.0),
    ngspice=f"SIN(0 {AMPLITUDE!r} 100.0)",
    skin_frequency=100.0,
    period=0.01,
    periods=20,
    r_coat=1.0,
    stiff=True,
)

LOCAL = (*(_scene(*scene) for scene in SCENES), _AM, _CHIRP, _STIFF)
MOBILE = tuple(_scene(*scene, law="mobile") for scene in SCENES)


@lru_cache(maxsize=1)
def by_name() -> dict[str, Problem]:
    """All problems, `local` ones first."""
    return {problem.name: problem for problem in (*LOCAL, *MOBILE)}
