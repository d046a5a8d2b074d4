"""Circuits for the tests: Table 1's deck with the changes that a test needs."""

import os
import re
import tomllib
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from scipy.stats import binom

import fingerspice as fs

CIRCUITS = Path(__file__).parents[1] / "circuits"
DECKS = Path(__file__).with_name("decks")
CASES = tomllib.loads(Path(__file__).with_name("cases.toml").read_text("utf-8"))
LAWS = ("local", "mobile")
every_law = pytest.mark.parametrize("law", LAWS)
T = TypeVar("T")
COAT = {"d": "1u", "eps_r": 3.9, "r": "0.2meg"}
GAP = {
    "d": "3.5u", "eps_r": 1, "r": "1meg", "fn": 0.5, "mu": 0.3, "alpha": 54.4, "m_exp": 0.52, "beta": 32, "n_exp": 1.41,
    "c2": 5000,
}  # fmt: skip


def cases(whole: T, few: T) -> T:
    """How many random cases a statistic takes, or which: `whole` in ``make stress``, which sets STRESS, else `few`."""
    return whole if os.environ.get("STRESS") else few


def listed(kind: str) -> list[Any]:
    """A table of `cases.toml`, such as of what is wrong and what is said."""
    rows: list[Any] = CASES[kind]
    return rows


def refuses(said: str, call: Callable[..., object], *given: Any, **named: Any) -> str:
    """Wrong input is refused in one line, in which the regular expression `said` is found, if any; gives the line."""
    with pytest.raises(fs.InputError, match=said or None) as told:
        call(*given, **named)
    assert "\n" not in str(told.value)
    return str(told.value)


def warns(said: str, call: Callable[..., T], *given: Any, **named: Any) -> T:
    """What a call gives that warns in a sentence in which the regular expression `said` is found."""
    with pytest.warns(fs.FingerspiceWarning, match=said):
        return call(*given, **named)


def heard(call: Callable[..., T], *given: Any, **named: Any) -> tuple[T, list[str]]:
    """What a call gives, and its warnings, all of which are the package's own."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = call(*given, **named)
    assert all(one.category is fs.FingerspiceWarning for one in caught)
    return found, [str(one.message) for one in caught]


def quietly(call: Callable[..., T], *given: Any, **named: Any) -> T:
    """What a call gives, whatever it warns of."""
    return heard(call, *given, **named)[0]


def by_turns(values: Iterable[T]) -> list[tuple[T, str]]:
    """Every value with both laws in ``make stress``, and with one and the other by turns in the suite."""
    both = [(value, law) for value in values for law in LAWS]
    return cases(both, [both[2 * i + i % 2] for i in range(len(both) // 2)])


def covers(hits: int, count: int) -> bool:
    """Whether `hits` of `count` intervals of 95 % held the truth: fewer would have a probability of 0.1 % or less."""
    return bool(binom.cdf(hits, count, 0.95) >= 1e-3)


def assignments(values: dict[str, Any]) -> str:
    """``key=value`` pairs; a value of None leaves the parameter out."""
    return " ".join(f"{k}={v!r}" if isinstance(v, float) else f"{k}={v}" for k, v in values.items() if v is not None)


def table1_deck(
    source: str = "SIN(0 200 100)",
    f: float = 100.0,
    *,
    coat: dict[str, Any] | None = None,
    gap: dict[str, Any] | None = None,
    skin: dict[str, Any] | None = None,
    tran: str = "10u 50m uic",
    library: str = "fingerspice.lib",
    extra: str = "",
) -> str:
    """Text of Table 1's deck; `coat`, `gap`, `skin` override parameters, `extra` adds lines."""
    return "\n".join(
        (
            "Table 1",
            f".include {library}",
            f"Vdrive drive 0 {source}",
            f"Xcoat drive top area LAYER {assignments(COAT | (coat or {}))}",
            f"Xgap top skin area GAP {assignments(GAP | (gap or {}))}",
            f"Xskin skin 0 area SKIN {assignments({'d': '350u', 'f': float(f)} | (skin or {}))}",
            f".tran {tran}",
            *([extra] if extra else []),
            ".end",
            "",
        )
    )


def table1(source: str = "SIN(0 200 100)", f: float = 100.0, **changes: Any) -> fs.Circuit:
    """Table 1's circuit; see `table1_deck`."""
    return fs.parse_netlist(table1_deck(source, f, **changes))


def dispersive_deck(source: str = "SIN(0 200 100)", **changes: Any) -> str:
    """`table1_deck` with a dispersive skin."""
    return re.sub(r"SKIN (d=\S+) f=\S+", r"SKIN_DISPERSIVE \1", table1_deck(source, **changes))


def shipped(name: str) -> fs.Circuit:
    """A deck of `circuits/`."""
    return fs.read_netlist(CIRCUITS / f"{name}.cir")


def deck(*lines: str) -> fs.Circuit:
    """A circuit from element lines."""
    return fs.parse_netlist("\n".join(("a deck", *lines, "")))


def finger(p: str, n: str, area: str = "area", name: str = "", f: float = 5000.0, **gap: object) -> list[str]:
    """Table 1's three layers between two nodes."""
    return [
        f"Xcoat{name} {p} top{name} {area} LAYER {assignments(COAT)}",
        f"Xgap{name} top{name} skin{name} {area} GAP {assignments(GAP | gap)}",
        f"Xskin{name} skin{name} {n} {area} SKIN d=350u f={f!r}",
    ]


def floating(source: str = "0", *more: str, **gap: object) -> fs.Circuit:
    """Amplifier, its resistance, Table 1's finger at 5 kHz and a body's capacitance: `network_reference.Floating`."""
    lines = (f"Vdrive amp 0 {source}", "Rout amp drive 47k", *finger("drive", "body", **gap), "Cbody body 0 150p")
    return deck(*lines, *more, ".tran 1u 1m uic")


def random_finger(rng: np.random.Generator) -> fs.Circuit:
    """Table 1 with other leaks, gap, load and skin."""
    changes = {
        "Xgap.r": 10.0 ** rng.uniform(5.0, 9.0),
        "Xgap.d": rng.uniform(2e-6, 8e-6),
        "Xgap.fn": rng.uniform(0.2, 1.0),
        "Xcoat.r": 10.0 ** rng.uniform(2.0, 9.0),
        "Xskin.d": rng.uniform(1e-4, 5e-4),
    }
    return table1().replace(changes)


def random_waveform(rng: np.random.Generator, f: float, u: float) -> fs.Waveform:
    """One of any kind with a frequency (Hz) or times of about its period, and an amplitude of about `u` (V)."""
    makers = (
        lambda: fs.Sine(u, f, offset=rng.uniform(-0.3, 0.3) * u, phase_deg=rng.uniform(0.0, 360.0)),
        lambda: fs.Square(u, f, duty=rng.uniform(0.1, 0.9), offset=rng.uniform(-0.2, 0.2) * u),
        lambda: fs.Triangle(u, f),
        lambda: fs.Sawtooth(u, f, phase_deg=rng.uniform(0.0, 360.0)),
        lambda: fs.Chirp(u, 0.2 * f, 4.0 * f, 1.5 / f),
        lambda: fs.AM(u, 6.0 * f, f, depth=rng.uniform(0.1, 1.0)),
        lambda: fs.Exp(0.0, u, 0.2 / f, 0.3 / f, 1.0 / f, 0.1 / f),
        lambda: fs.PWL((0.0, 0.4 / f, 0.4 / f, 1.1 / f, 1.6 / f), (0.0, u, -0.5 * u, 0.7 * u, 0.0)),
        lambda: fs.Pulse(0.0, u, 0.1 / f, 0.05 / f, 0.0, 0.4 / f, 1.0 / f),
        lambda: fs.Function(lambda t: u * np.sin(5.0 * f * t) * np.exp(-f * t)),
    )
    return makers[rng.integers(len(makers))]()
