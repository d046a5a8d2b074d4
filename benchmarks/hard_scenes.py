"""The hard cases that can be given to other libraries: scenes with their references, and decks for ngspice.

Every scene is a `Problem` of problems.py with a few things of its own; references come from `tests/analytic.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

import fingerspice as fs
from problems import Constants, Drive, FloatArray, Piece, Problem, constants, held, tone
from reference import _analytic

SERIES = 1e-7
"""Error allowed of the area's series: results are asked to 1e-6, and at 2 kV a smaller error needs a high degree."""
NAMES = {"Xcoat.r": "r_i", "Xgap.r": "r_a", "Xgap.d": "d_a", "Xgap.fn": "force_normal"}


@dataclass(frozen=True)
class HardProblem(Problem):
    """A problem with changes of its deck, a source that may be gated, and the same number of outputs on every piece.

    Attributes
    ----------
    changes : mapping
        From a parameter of the deck to its value.
    gate : Waveform or None
        Waveform that gives the `level` of each piece; None for the source's own voltage.
    outputs : int
        Number of outputs on every piece between jumps.
    spacing : str
        ``"even"``, ``"geometric"``, or ``"last period"``.
    peak : float
        Largest |U|, V; peers' absolute tolerances are proportional to it.
    refusal : str
        Pattern that a message with the true reason of a refusal matches; "" for a scene that has a solution.
    """

    changes: Mapping[str, float] = field(default_factory=dict)
    gate: fs.Waveform | None = None
    outputs: int = 200
    spacing: str = "even"
    peak: float = 200.0
    refusal: str = ""

    def circuit(self) -> fs.Circuit:
        return super().circuit().replace(dict(self.changes)) if self.changes else super().circuit()

    @cached_property
    def constants(self) -> Constants:  # type: ignore[override]
        return constants(self.circuit(), self.reach, SERIES, 50)

    def edges(self) -> FloatArray:
        """Start of the run, the source's breakpoints inside, and end, s."""
        stop = self.t_stop(self.periods)
        inner = self.waveform.breakpoints(0.0, stop)
        return np.concatenate([[0.0], inner[(inner > 0.0) & (inner < stop)], [stop]])

    def t_eval(self, periods: int) -> FloatArray:
        edges = self.edges()
        share = (np.arange(self.outputs) + 0.5) / self.outputs
        if self.spacing == "last period":
            return edges[-1] - self.period * (1.0 - share)
        if self.spacing == "geometric":
            return edges[-1] * 1e-7 ** (1.0 - share)
        return np.concatenate([a + share * (b - a) for a, b in pairwise(edges)])

    def pieces(self, periods: int, zeros: Sequence[float] = (), signs: Sequence[float] = ()) -> tuple[Piece, ...]:
        found = super().pieces(periods, zeros, signs)
        if self.gate is None:
            return found
        return tuple(replace(p, level=float(self.gate.value(0.5 * (p.t0 + p.t1)))) for p in found)

    def segments(self) -> list[tuple[float, float, Callable[[FloatArray], FloatArray]]]:
        """The source in the form of `analytic.transient`."""
        u = self.drive(np.sin)
        return [
            (p.t0, p.t1, lambda t, level=p.level: u(np.asarray(t), level) + 0.0 * np.asarray(t))
            for p in self.pieces(self.periods)
        ]

    def truth(self) -> tuple[FloatArray, FloatArray]:
        """Gap voltage (V) and force (N) at the outputs."""
        analytic = _analytic()
        named = {NAMES[key]: value for key, value in self.changes.items()} | {"r_i": self.r_coat}
        if "Xcoat.r" in self.changes:
            named["r_i"] = self.changes["Xcoat.r"]
        options: dict[str, Any] = {
            "law": self.law, "freq": self.skin_frequency, "params": replace(analytic.TABLE1, **named), "tol": 1e-12,
        }  # fmt: skip
        t = self.t_eval(self.periods)
        if self.spacing == "last period" and self.waveform.period == self.period:
            first = self.segments()[0]
            run = analytic.periodic_state(
                [(0.0, self.period, first[2])], t_out=t - (t[-1] // self.period) * self.period, **options
            )
        elif self.spacing == "last period":
            # The state 6 ms earlier changes the result by less than 1e-9: start there, uncharged.
            _, stop, u = self.segments()[-1]
            run = analytic.transient([(stop - 6e-3, stop, u)], t, **options)
        else:
            run = analytic.transient(self.exact_segments(), t, **options)
        return run.u_gap, run.force

    def exact_segments(self) -> list[tuple[float, float, Callable[[FloatArray], FloatArray]]]:
        """`segments`, also split at the corners of an undeclared source."""
        (whole, *rest), corners = self.segments(), UNDECLARED.get(self.name, ())
        if rest or not corners:
            return [whole, *rest]
        edges = [whole[0], *corners, whole[1]]
        return [(a, b, whole[2]) for a, b in pairwise(edges)]


def _gated(sin: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    def u(t: Any, level: Any) -> Any:
        return level * 200.0 * sin(2.0 * math.pi * 5000.0 * t)

    return u


def _slow_envelope(sin: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    def u(t: Any, level: Any) -> Any:
        return 100.0 * (1.0 + sin(2.0 * math.pi * t)) * sin(2.0 * math.pi * 20e3 * t)

    return u


def _trapezoid(start: float, width: float, edge: float) -> Drive:
    after = start + edge + width

    def bind(sin: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
        def u(t: Any, level: Any) -> Any:
            # Written with absolute values, which every library has: min(max(x, 0), 1) = (|x| - |x - 1| + 1) / 2.
            x, y = (t - start) / edge, (t - after) / edge
            return 100.0 * (abs(x) - abs(x - 1.0) - abs(y) + abs(y - 1.0))

        return u

    return bind


def _broken(infinite: bool) -> Drive:
    def bind(sin: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
        def nan(t: Any, level: Any) -> Any:
            return 200.0 * sin(2.0 * math.pi * 100.0 * t) + 0.0 / (1.0 * (t < 3e-3))

        def inf(t: Any, level: Any) -> Any:
            return 200.0 * sin(2.0 * math.pi * 100.0 * t) + (1.0 / (1.0 * (t < 3e-3)) - 1.0)

        return inf if infinite else nan

    return bind


def _function(drive: Drive) -> fs.Waveform:
    u = drive(np.sin)

    def source(t: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):
            return np.asarray(u(np.asarray(t, float), 0.0))

    return fs.Function(source)


def _sine(name: str, title: str, changes: Mapping[str, float] | None = None, *, amplitude: float = 200.0,
          frequency: float = 100.0, **given: Any) -> HardProblem:  # fmt: skip
    return HardProblem(
        **{
            "name": name, "title": title, "waveform": fs.Sine(amplitude, frequency),
            "drive": tone(amplitude, frequency), "ngspice": f"SIN(0 {amplitude!r} {frequency!r})",
            "skin_frequency": frequency, "period": 1.0 / frequency, "periods": 2, "changes": changes or {},
            "peak": amplitude, "reach": amplitude,
        } | given
    )  # fmt: skip


def _steps(name: str, title: str, waveform: fs.Waveform, ngspice: str, **given: Any) -> HardProblem:
    return HardProblem(
        **{
            "name": name, "title": title, "waveform": waveform, "drive": held, "ngspice": ngspice,
            "skin_frequency": 100.0, "period": 0.01, "periods": 1, "reach": 260.0, "outputs": 100,
        } | given
    )  # fmt: skip


NS = 1e-9
START, WIDTH = 3.00123e-3, 20e-6
_PULSE = _trapezoid(START, WIDTH, NS)
_PULSE_TEXT = f"PULSE(0 200 {START!r} 1n 1n {WIDTH!r} 1)"
UNDECLARED = {"undeclared": (START, START + NS, START + NS + WIDTH, START + 2.0 * NS + WIDTH)}
_FOLD = r"fold|no solution|no root"
_NUMBER = r"(?i)\bnan\b|\binf\b|finite|out of range for log"
_GATE = fs.PWL((0.0, 2.6e-4, 2.6e-4, 3.6e-4, 3.6e-4), (0.0, 0.0, 1.0, 1.0, 0.0))

SCENES: tuple[HardProblem, ...] = (
    _sine("stiff_coat", "R_i = 1 Ω", {"Xcoat.r": 1.0}),
    _sine("blocking_coat", "R_i = 1e15 Ω", {"Xcoat.r": 1e15}),
    _sine("blocking_gap", "R_a = 1e12 Ω", {"Xgap.r": 1e12}),
    _sine("capacitors", "coating and gap pure capacitors", {"Xcoat.r": math.inf, "Xgap.r": math.inf}),
    _steps(
        "nanosecond_jumps", "two jumps 1 ns apart",
        fs.PWL((0.0, 3e-3, 3e-3, 3e-3 + NS, 3e-3 + NS), (0.0, 0.0, 200.0, 200.0, -50.0)),
        "PWL(0 0 3m 0 3.000000001m 200 3.000001m 200 3.000001001m -50)",
    ),
    _steps(
        "declared", "pulse of 20 µs, edges of 1 ns declared",
        fs.Pulse(0.0, 200.0, delay=START, rise=NS, fall=NS, width=WIDTH, pulse_period=1.0), _PULSE_TEXT, drive=_PULSE,
    ),
    _steps("undeclared", "the same, undeclared", _function(_PULSE), _PULSE_TEXT, drive=_PULSE, outputs=500),
    _sine("two_kilovolt", "2 kV sine", amplitude=2000.0, reach=800.0),
    _steps(
        "two_kilovolt_square", "2 kV square", fs.Square(2000.0, 100.0), "PULSE(2000 -2000 5m 1n 1n 4.999999m 10m)",
        peak=2000.0, reach=2930.0,
    ),
    _sine("two_kilovolt_mobile", "2 kV sine, mobile", amplitude=2000.0, reach=800.0, law="mobile"),
    _steps(
        "jump_past_fold", "2 kV square, mobile: past its fold", fs.Square(2000.0, 100.0),
        "PULSE(2000 -2000 5m 1n 1n 4.999999m 10m)", peak=2000.0, reach=2930.0, law="mobile", refusal=_FOLD,
    ),
    _sine("fold_thin", "10 nm gap, mobile: past its fold", {"Xgap.d": 10e-9}, law="mobile", reach=1.9, refusal=_FOLD),
    _sine("fold_light", "0.1 mN, mobile: past its fold", {"Xgap.fn": 1e-4}, law="mobile", refusal=_FOLD),
    _steps("nothing", "0 V for 100 s", fs.DC(0.0), "DC 0", period=100.0),
    _sine("tiny", "1e-12 V", amplitude=1e-12, reach=200.0),
    _steps("for_ever", "50 V DC for 1e6 time constants", fs.DC(50.0), "DC 50", period=1000.0, spacing="geometric",
           peak=50.0),
    _sine("nan", "NaN from 3 ms on", waveform=_function(_broken(False)), drive=_broken(False), refusal=_NUMBER,
          ngspice="{200*sin(628.3185307179587*time)+log(3m-time)*0}"),
    _sine("inf", "inf from 3 ms on", waveform=_function(_broken(True)), drive=_broken(True), refusal=_NUMBER,
          ngspice="{200*sin(628.3185307179587*time)+1/u(3m-time)-1}"),
    _sine("long", "1e5 cycles of 5 kHz", frequency=5000.0, periods=100_000, spacing="last period"),
    _sine("burst", "0 → 200 → 0 V inside one cycle", waveform=fs.Sine(200.0, 5000.0) * _GATE, drive=_gated, gate=_GATE,
          ngspice="{200*sin(31415.926535897932*time)*(u(time-0.26m)-u(time-0.36m))}", skin_frequency=5000.0,
          period=2e-4, periods=6, outputs=100, reach=260.0),
    _sine("slow_envelope", "20 kHz under an envelope of 1 Hz, 1 s", waveform=fs.AM(200.0, 20e3, 1.0),
          drive=_slow_envelope, ngspice="{100*(1+sin(6.283185307179586*time))*sin(125663.70614359173*time)}",
          skin_frequency=20e3, period=5e-5, periods=20_000, spacing="last period"),
)  # fmt: skip

_FINGER = (
    "Xcoat drive top area LAYER d=1u eps_r=3.9 r=0.2meg",
    "Xgap top skin area GAP d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000",
    "Xskin skin 0 area SKIN d=350u f=100",
)
_DRIVE, _TRAN = "Vdrive drive 0 SIN(0 200 100)", ".tran 10u 10m uic"


@dataclass(frozen=True)
class Deck:
    """A netlist that must be refused, and the pattern that a message with the true reason matches."""

    name: str
    title: str
    lines: tuple[str, ...]
    refusal: str

    @property
    def text(self) -> str:
        """The netlist."""
        return "\n".join((self.title, ".include fingerspice.lib", *self.lines, ".end", ""))


DECKS = (
    Deck("no_contact", "contact impossible (µ = 1.1)",
         (_DRIVE, *(x.replace("mu=0.3", "mu=1.1") for x in _FINGER), _TRAN), r"(?i)no contact"),
    Deck("floating", "floating node", (_DRIVE, *(x.replace("skin 0", "skin far") for x in _FINGER), _TRAN),
         r"(?i)\bfar\b|xskin"),
    Deck("parallel", "two sources in parallel", (_DRIVE, "Vb drive 0 5", *_FINGER, _TRAN), r"(?i)\bv(b|drive)\b"),
    Deck("loop", "loop of sources", (_DRIVE, "Vb drive mid 5", "Vc mid 0 5", *_FINGER, _TRAN), r"(?i)\bv(b|c|drive)\b"),
    Deck("no_operating_point", "capacitors only, DC start", ("V1 a 0 5", "C1 a b 1n", "C2 b 0 3n", ".tran 1u 1m"),
         r"(?i)\bc[12]\b|node b\b"),
    Deck("zero_r", "R = 0", (_DRIVE, *_FINGER, "R1 top 0 0", _TRAN), r"(?i)\br1\b"),
    Deck("negative_r", "R < 0", (_DRIVE, *_FINGER, "R1 top 0 -1k", _TRAN), r"(?i)\br1\b"),
    Deck("negative_c", "C < 0", (_DRIVE, *_FINGER, "C1 top 0 -1p", _TRAN), r"(?i)\bc1\b"),
    Deck("zero_d", "d = 0", (_DRIVE, *(x.replace("d=3.5u", "d=0") for x in _FINGER), _TRAN), r"(?i)\bd\b|xgap"),
)  # fmt: skip
