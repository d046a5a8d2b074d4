"""Circuits for the tests: Table 1's deck with the changes that a test needs."""

from __future__ import annotations

import os
from typing import Any, TypeVar

from scipy.stats import binom

import fingerspice as fs

T = TypeVar("T")
COAT = {"d": "1u", "eps_r": 3.9, "r": "0.2meg"}
GAP = {
    "d": "3.5u",
    "eps_r": 1,
    "r": "1meg",
    "fn": 0.5,
    "mu": 0.3,
    "alpha": 54.4,
    "m_exp": 0.52,
    "beta": 32,
    "n_exp": 1.41,
    "c2": 5000,
}


def cases(whole: T, few: T) -> T:
    """How many random cases a statistic takes, or which: `whole` in ``make stress``, which sets STRESS, else `few`."""
    return whole if os.environ.get("STRESS") else few


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
