"""What the command line says, without control characters and tracebacks, and its answers with `--json`."""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import fingerspice as fs
from fingerspice.base.errors import InputError, printable
from fingerspice.results.outcome import SolveError

#: Keys of every answer, whatever its outcome (docs/json.md).
COMMON = (
    *("version", "command", "success", "status", "message", "failure", "warnings", "files"),
    *("title", "overrides", "sets", "charge_law", "method", "rtol"),
)
#: Further keys of each command.
OWN = {
    command: tuple(keys.split())
    for command, keys in {
        "run": "area tier t_stop figures_from error fundamental fold_margin_min signals saved measures fourier feel "
        "stream steps op dc sweeps",
        "ac": "area skin sweeps",
        "plan": "area tier reasons start rates stiff sensitivity error_bound plan_area",
        "compare": "frequency gaps phasor transient_mean_area transient_coupled vectors times",
        "limits": "peak voltage sweeps capability",
        "design": "kind rate samples carrier limit slew lead peak at_limit worst rms worst_share rms_share "
        "largest_wanted largest_reached corrections",
        "fit": "parameters correlation groups signal count residual_rms objective objectives notes profiles",
        "fit-contact": "gap parameters correlation relations objective notes profiles",
        "sweep": "scenes failed n seed figures shares store",
        "export": "", "figures": "", "explore": "url", "sets": "parameter_sets", "check": "chunks",
        "help-deck": "vocabulary", "warm": "",
    }.items()
}  # fmt: skip
#: Keys that are options, too: an answer has them as they are given, until more is known.
AS_ASKED = ("charge_law", "method", "rtol", "area", "skin")
#: Figures of a signal; a figure that a signal lacks is null.
FIGURES = ("min", "max", "peak", "mean", "rms", "mean_periodic", "rms_periodic", "ripple", "amplitude", "phase_deg")


def blank(command: str | None, given: Mapping[str, Any] = MappingProxyType({})) -> dict[str, Any]:
    """An answer with all its keys, before any result is known, to a command with the options given."""
    answer = dict.fromkeys((*COMMON, *OWN.get(command or "", ())))
    answer |= {key: given[key] for key in AS_ASKED if key in given and key in answer}
    empty = {"success": False, "warnings": [], "files": [], "overrides": {}, "sets": []}
    return {**answer, **empty, "version": fs.__version__, "command": command}


def of_run(solution: fs.Solution) -> dict[str, Any]:
    """The part of an answer that describes a run: its method and error, and figures of every signal in SI units."""
    from fingerspice.results.measures import saved_figures
    from fingerspice.results.record import SIGNALS

    s, rows = solution.summary(), []
    for name in [key.removesuffix("_peak") for key in s if key.endswith("_peak")]:
        signal, _, element = name.partition(":")
        if not element and SIGNALS[signal].of == "gap" and len(solution.gaps) == 1:
            element = solution.gaps[0]
        figures = {figure: s.get(f"{name}_{figure}") for figure in FIGURES}
        rows.append({"signal": signal, "element": element or None, "unit": SIGNALS[signal].unit, **figures})
    return {
        "charge_law": solution.charge_law, "method": solution.method, "area": solution.area_mode,
        "tier": solution.plan.tier, "error": vars(solution.error), "signals": rows, "t_stop": s["t_stop"],
        "saved": saved_figures(solution),
        "fourier": [one.plain() for one in solution.fourier.values() if not isinstance(one, str)],
        "measures": [{"name": name, **one._asdict()} for name, one in solution.measured.items()],
        **{key: s.get(key) for key in ("figures_from", "fundamental", "fold_margin_min")},
    }  # fmt: skip


LONGEST_LINE = 2000  # Largest number of characters of a printed line; the middle of a longer line is left out.


def say(text: str = "", end: str = "\n") -> None:
    """Print lines of text, which may come from a deck, in printable characters."""
    _print("\n".join(printable(line, LONGEST_LINE) for line in text.split("\n")), end)


def say_json(data: dict[str, Any]) -> None:
    """Print data as JSON in ASCII, with null for NaN and infinities, which JSON lacks."""
    _print(json.dumps(json.loads(json.dumps(data), parse_constant=lambda _: None), indent=2), "\n")


def _print(text: str, end: str) -> None:
    """Print and flush; a full disk is an `InputError`."""
    try:
        print(text, end=end, flush=True)
    except OSError as error:
        # Redirect stdout, since Python flushes it again at exit and would report the error a second time.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise InputError(f"cannot write to the standard output: {error.strerror}") from None


def complain(text: str) -> None:
    """Write a line to stderr."""
    print(f"fingerspice: {printable(text, LONGEST_LINE)}", file=sys.stderr, flush=True)


def outcome(error: Exception) -> tuple[int, str, str]:
    """The exit code of a command that ended with an error, its status, and the error in one sentence."""
    if isinstance(error, SolveError):
        return 1, error.failure.status.name, error.message
    if isinstance(error, InputError):
        return 2, "BAD_INPUT", str(error)
    if isinstance(error, MemoryError):
        allowed = "fewer outputs (a longer TSTEP, or TSTART), or a shorter run"
        return 2, "BAD_INPUT", f"not enough memory; allowed: {allowed}"
    place = traceback.extract_tb(error.__traceback__)[-1]
    said = f"{type(error).__name__} in {Path(place.filename).name}:{place.lineno}, {error}"
    return 1, "FAULT", f"this is a fault of fingerspice, please report it with the deck ({said})"
