"""Every waveform class with an independent formula: the registry over which tests iterate."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

import fingerspice as fs
from fingerspice.engine.network import source
from fingerspice.waveforms.sampling import SourceTable

TAU = 2.0 * math.pi
Formula = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Case:
    """A waveform, its formula for times off the edges, where it is not smooth in [0, end], its period, and its tone if
    that is not 1 / period."""

    name: str
    waveform: fs.Waveform
    formula: Formula
    edges: tuple[float, ...] = ()
    end: float = 0.05
    period: float | None = None
    tone: float | None = None
    settled: float = 0.0

    def __post_init__(self) -> None:
        if self.period and not self.tone:
            object.__setattr__(self, "tone", 1.0 / self.period)


def compiled(table: SourceTable, t: np.ndarray) -> np.ndarray:
    """Voltage and slope (n_t, 2) of a table by compiled code, right-hand at its edges."""
    index = np.clip(np.searchsorted(table.edges, t, side="right") - 1, 0, table.edges.size - 2)
    starts, spans = table.edges[index], np.diff(table.edges)[index]
    parts = zip(table.terms[index], table.series[index], spans, t - starts, strict=True)
    return np.array([source(*one) for one in parts])


def turns(t: np.ndarray, f: float, delay: float = 0.0, phase_deg: float = 0.0) -> np.ndarray:
    """Fraction of the period passed, in [0, 1)."""
    x = f * (t - delay) + phase_deg / 360.0
    return x - np.floor(x)


def sine(
    t: np.ndarray, a: float, f: float, o: float = 0.0, deg: float = 0.0, td: float = 0.0, k: float = 0.0
) -> np.ndarray:
    """SPICE's SIN(o a f td k deg)."""
    s = np.maximum(t - td, 0.0)
    return o + a * np.exp(-k * s) * np.sin(TAU * f * s + math.radians(deg))


def chirp(
    t: np.ndarray, a: float, f0: float, f1: float, duration: float, o: float = 0.0, deg: float = 0.0
) -> np.ndarray:
    """The phase is the integral of the frequency: f0, then rising, then f1."""
    rising = np.clip(t, 0.0, duration)
    phase = f0 * rising + (f1 - f0) / duration * rising**2 / 2.0 + f1 * np.maximum(t - duration, 0.0)
    return o + a * np.sin(TAU * phase + math.radians(deg))


def spice_exp(t: np.ndarray, v1: float, v2: float, td1: float, tau1: float, td2: float, tau2: float) -> np.ndarray:
    """SPICE's EXP as its manual writes it."""
    rise = np.where(t > td1, (v2 - v1) * (1.0 - np.exp(-np.maximum(t - td1, 0.0) / tau1)), 0.0)
    fall = np.where(t > td2, (v1 - v2) * (1.0 - np.exp(-np.maximum(t - td2, 0.0) / tau2)), 0.0)
    return v1 + rise + fall


def spice_pulse(
    t: np.ndarray, v1: float, v2: float, td: float, tr: float = 0.0, tf: float = 0.0, pw: float = math.inf,
    per: float = math.inf,
) -> np.ndarray:  # fmt: skip
    """SPICE's PULSE, one time after the other, as its manual tabulates it."""
    out = []
    for time in np.atleast_1d(t):
        s = time - td
        if s > 0.0 and math.isfinite(per):
            s = math.fmod(s, per)
        if s <= 0.0:
            v = v1
        elif s < tr:
            v = v1 + (v2 - v1) * s / tr
        elif s < tr + pw:
            v = v2
        elif s < tr + pw + tf:
            v = v2 + (v1 - v2) * (s - tr - pw) / tf
        else:
            v = v1
        out.append(v)
    return np.array(out)


def pwl(t: np.ndarray, *points: tuple[float, float], repeat: float | None = None) -> np.ndarray:
    """Straight lines, one time after the other; held outside, or the stretch from `repeat` on runs again."""
    out = []
    first, last = points[0], points[-1]
    for time in np.atleast_1d(t):
        s = float(time)
        if repeat is not None and s > last[0]:
            s = repeat + math.fmod(s - repeat, last[0] - repeat)
        v = first[1] if s <= first[0] else last[1]
        for (t0, v0), (t1, v1) in pairwise(points):
            if t0 < s <= t1:
                v = v0 + (v1 - v0) * (s - t0) / (t1 - t0)
        out.append(v)
    return np.array(out)


def square(
    t: np.ndarray, a: float, f: float, duty: float = 0.5, o: float = 0.0, deg: float = 0.0, td: float = 0.0
) -> np.ndarray:
    return o + np.where(turns(t, f, td, deg) < duty, a, -a)


def triangle(t: np.ndarray, a: float, f: float, o: float, deg: float, td: float) -> np.ndarray:
    return o + 2.0 * a / math.pi * np.arcsin(np.sin(TAU * (f * (t - td) + deg / 360.0)))


def sawtooth(t: np.ndarray, a: float, f: float, o: float, deg: float, td: float) -> np.ndarray:
    return o + a * (2.0 * turns(t, f, td, deg) - 1.0)


def am(t: np.ndarray, a: float, fc: float, fm: float, depth: float, deg: float) -> np.ndarray:
    """Largest envelope `a`."""
    envelope = (1.0 + depth * np.sin(TAU * fm * t + math.radians(deg))) / (1.0 + depth)
    return a * envelope * np.sin(TAU * fc * t)


def decay(t: np.ndarray) -> np.ndarray:
    """Decays from 1 for 13 ms, then -1 for 7 ms."""
    return np.where(t % 0.02 < 0.013, np.exp(-30.0 * (t % 0.02)), -1.0)


def comb(first: float, step: float, end: float) -> tuple[float, ...]:
    """first, first + step, ... within [0, end]."""
    return tuple(x for x in (first + step * k for k in range(-5, 2000)) if -1e-12 <= x <= end + 1e-12)


def merge(*lists: tuple[float, ...]) -> tuple[float, ...]:
    """Distinct times, ascending; equal up to rounding counts once."""
    out: list[float] = []
    for x in sorted(x for xs in lists for x in xs):
        if not out or x - out[-1] > 1e-12:
            out.append(x)
    return tuple(out)


SAMPLED = np.array([0.0, 3.0, -2.0, 5.0, 5.0, 1.0, 0.5, -4.0])
POINTS = ((0.004, 1.0), (0.01, 5.0), (0.01, -3.0), (0.022, -3.0), (0.03, 2.0))
CORNER, TRAIN = 0.0011 - 50.0 / 360.0 / 130.0, (0.0, 0.001, 0.005, 0.007)


def of(name: str, kind: type[fs.Waveform], formula: Callable[..., np.ndarray], *given: float, **other: Any) -> Case:
    """A waveform and its formula, which take the same numbers in the same order."""
    return Case(name, kind(*given), lambda t: formula(t, *given), **other)


CASES = (
    Case("dc", fs.DC(12.5), lambda t: 12.5 + 0.0 * t),
    of("sine", fs.Sine, sine, 200.0, 100.0, period=0.01),
    of(
        "sine with everything", fs.Sine, sine, -20.0, 130.0, 3.0, 40.0, 0.0071,
        edges=(0.0071,), period=1.0 / 130.0, settled=0.0071,
    ),
    of("damped sine", fs.Sine, sine, 20.0, 130.0, 3.0, 40.0, 0.0071, 90.0, edges=(0.0071,)),
    of("chirp", fs.Chirp, chirp, 7.0, 50.0, 900.0, 0.03, -1.0, 30.0, edges=(0.0, 0.03)),
    of("falling chirp", fs.Chirp, chirp, 7.0, 900.0, 50.0, 0.03, edges=(0.0, 0.03)),
    of("exp", fs.Exp, spice_exp, 1.0, 9.0, 0.005, 0.002, 0.02, 0.007, edges=(0.005, 0.02)),
    of("am", fs.AM, am, 200.0, 2000.0, 100.0, 0.7, 25.0, period=0.01, tone=2000.0),
    of("square", fs.Square, square, 200.0, 100.0, edges=comb(0.0, 0.005, 0.05), period=0.01),
    of(
        "square with everything", fs.Square, square, 20.0, 130.0, 0.3, 2.0, 50.0, 0.0011, period=1.0 / 130.0,
        edges=merge(comb(CORNER, 1.0 / 130.0, 0.05), comb(CORNER + 0.3 / 130.0, 1.0 / 130.0, 0.05)),
    ),
    of(
        "triangle", fs.Triangle, triangle, 20.0, 130.0, 2.0, 50.0, 0.0011, period=1.0 / 130.0,
        edges=comb(CORNER + 0.25 / 130.0, 0.5 / 130.0, 0.05),
    ),
    of(
        "sawtooth", fs.Sawtooth, sawtooth, 20.0, 130.0, 2.0, 50.0, 0.0011, period=1.0 / 130.0,
        edges=comb(CORNER, 1.0 / 130.0, 0.05),
    ),
    of(
        "pulse train", fs.Pulse, spice_pulse, -1.0, 5.0, 0.003, 0.001, 0.002, 0.004, 0.012, period=0.012, settled=0.003,
        edges=merge(*(comb(0.003 + x + k * 0.012, 1.0, 0.05) for x in TRAIN for k in range(5))),
    ),
    of(
        "ideal pulses without a pause", fs.Pulse, spice_pulse, -1.0, 5.0, 0.003, 0.0, 0.002, 0.010, 0.012,
        edges=tuple(0.003 + 0.012 * k + x for k in range(4) for x in (0.0, 0.010)), period=0.012, settled=0.003,
    ),
    of(
        "one pulse", fs.Pulse, spice_pulse, -1.0, 5.0, 0.003, 0.001, 0.002, 0.004, edges=(0.003, 0.004, 0.008, 0.010)
    ),
    of("step", fs.Pulse, spice_pulse, -1.0, 5.0, 0.003, edges=(0.003,)),
    Case("pwl", fs.PWL(*zip(*POINTS, strict=True)), lambda t: pwl(t, *POINTS), (0.004, 0.01, 0.022, 0.03)),
    Case(
        "repeated pwl", fs.PWL(*zip(*POINTS, strict=True), repeat=0.022), lambda t: pwl(t, *POINTS, repeat=0.022),
        (0.004, 0.01, 0.022, 0.03, 0.038, 0.046), period=0.008, settled=0.03,
    ),
    Case(
        "samples", fs.Samples(SAMPLED, 250.0, start=0.002),
        lambda t: np.interp(t, 0.002 + np.arange(8) / 250.0, SAMPLED), tuple(0.002 + np.arange(8) / 250.0),
    ),
    Case(
        "sum", fs.Sine(20.0, 100.0, phase_deg=10.0) + fs.Square(5.0, 300.0) + 4.0,
        lambda t: sine(t, 20.0, 100.0, 0.0, 10.0) + square(t, 5.0, 300.0) + 4.0, comb(0.0, 1.0 / 600.0, 0.05),
        period=0.01,
    ),
    Case(
        "product", fs.Sine(20.0, 1000.0, phase_deg=10.0) * fs.Triangle(1.0, 100.0, offset=1.5) * 2.0,
        lambda t: 2.0 * sine(t, 20.0, 1000.0, 0.0, 10.0) * triangle(t, 1.0, 100.0, 1.5, 0.0, 0.0),
        comb(0.0025, 0.005, 0.05), period=0.01, tone=1000.0,
    ),
    Case(
        "product of a chirp, a ramp and an exponential",
        fs.Chirp(7.0, 50.0, 400.0, 0.03) * fs.PWL((0.0, 0.05), (1.0, 3.0)) * fs.Exp(1.0, 2.0, 0.0, 0.01, 0.02, 0.01),
        lambda t: (
            chirp(t, 7.0, 50.0, 400.0, 0.03) * (1.0 + 40.0 * t) * spice_exp(t, 1.0, 2.0, 0.0, 0.01, 0.02, 0.01)
        ),
        (0.0, 0.02, 0.03, 0.05),
    ),
    Case(
        "burst", fs.Burst(fs.Sine(20.0, 1000.0, phase_deg=90.0), 0.0035, 0.0071),
        lambda t: np.where((t > 0.0071) & (t < 0.0106), sine(t - 0.0071, 20.0, 1000.0, 0.0, 90.0), 0.0),
        (0.0071, 0.0106),
    ),
    Case(
        "burst of pulses", fs.Burst(fs.Square(5.0, 300.0), 0.0123, 0.001),
        lambda t: np.where((t > 0.001) & (t < 0.0133), square(t, 5.0, 300.0, td=0.001), 0.0),
        (*(0.001 + k / 600.0 for k in range(8)), 0.0133),
    ),
    Case(
        "repeated bursts", fs.Repeat(fs.Burst(fs.Sine(20.0, 1000.0), 0.0035, 0.001), 0.007),
        lambda t: np.where((t % 0.007 > 0.001) & (t % 0.007 < 0.0045), sine(t % 0.007, 20.0, 1000.0, td=0.001), 0.0),
        merge(comb(0.001, 0.007, 0.05), comb(0.0045, 0.007, 0.05)), period=0.007, tone=1000.0,
    ),
    Case(
        "repeated samples", fs.Repeat(fs.Samples(SAMPLED, 250.0, start=0.002), 0.0213),
        lambda t: np.interp(t % 0.0213, 0.002 + np.arange(8) / 250.0, SAMPLED),
        merge(comb(0.0, 0.0213, 0.05), *(comb(0.002 + j / 250.0, 0.0213, 0.05) for j in range(5))), period=0.0213,
    ),
    Case(
        "repeated function", fs.Repeat(fs.Function(decay, (0.013,)), 0.0177), lambda t: decay(t % 0.0177),
        merge(comb(0.013, 0.0177, 0.05), comb(0.0, 0.0177, 0.05)), period=0.0177,
    ),
    Case("function", fs.Function(decay, (0.0, 0.013), 0.02), decay, (0.0, 0.013, 0.02, 0.033, 0.04), period=0.02),
)  # fmt: skip
