"""What the command line says, without control characters and tracebacks, and its answers with `--json`."""

from __future__ import annotations

import json
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import fingerspice as fs
from fingerspice.base.errors import FingerspiceWarning, InputError, printable
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
        "run": "area tier t_stop figures_from error fundamental fold_margin_min signals feel stream",
        "ac": "area skin sweeps",
        "plan": "area tier reasons start rates stiff sensitivity error_bound plan_area",
        "compare": "frequency gaps phasor transient_mean_area transient_coupled",
        "limits": "peak voltage sweeps capability",
        "design": "kind rate samples carrier limit slew lead peak at_limit worst rms worst_share rms_share "
        "largest_wanted largest_reached corrections",
        "fit": "parameters correlation groups signal count residual_rms objective objectives notes profiles",
        "fit-contact": "gap parameters correlation relations objective notes profiles",
        "sweep": "scenes failed n seed figures shares store",
        "export": "", "figures": "", "explore": "url", "sets": "parameter_sets", "check": "chunks",
    }.items()
}  # fmt: skip
#: Keys that are options, too.
AS_ASKED = ("charge_law", "method", "rtol", "area", "skin")
#: Figures of a signal; a figure that a signal lacks is null.
FIGURES = ("min", "max", "peak", "mean", "rms", "mean_periodic", "rms_periodic", "ripple", "amplitude", "phase_deg")


def blank(command: str | None) -> dict[str, Any]:
    """An answer with all its keys, before any result is known."""
    keys = (*COMMON, *OWN.get(command or "", ()))
    empty = {"success": False, "warnings": [], "files": [], "overrides": {}, "sets": []}
    return {**dict.fromkeys(keys), **empty, "version": fs.__version__, "command": command}


def of_run(solution: fs.Solution) -> dict[str, Any]:
    """The part of an answer that describes a run: its method and error, and figures of every signal in SI units."""
    from fingerspice.results.record import SIGNALS

    s, rows = solution.summary(), []
    for name in [key.removesuffix("_peak") for key in s if key.endswith("_peak")]:
        signal, _, element = name.partition(":")
        if not element and signal in ("u_gap", "area", "f_el", "f_t", "friction") and len(solution.gaps) == 1:
            element = solution.gaps[0]
        figures = {figure: s.get(f"{name}_{figure}") for figure in FIGURES}
        rows.append({"signal": signal, "element": element or None, "unit": SIGNALS[signal][0], **figures})
    return {
        "charge_law": solution.charge_law, "method": solution.method, "area": solution.area_mode,
        "tier": solution.plan.tier, "error": vars(solution.error), "signals": rows, "t_stop": s["t_stop"],
        **{key: s.get(key) for key in ("figures_from", "fundamental", "fold_margin_min")},
    }  # fmt: skip


#: Largest number of characters of a printed line; the middle of a longer line is left out.
LONGEST_LINE = 2000
Write = Callable[[], Path | None]


def say(text: str = "", end: str = "\n") -> None:
    """Print lines of text, which may come from a deck, in printable characters."""
    _print("\n".join(printable(line, LONGEST_LINE) for line in text.split("\n")), end)


def say_json(data: dict[str, Any]) -> None:
    """Print data as JSON in ASCII, with null for NaN and infinities, which JSON lacks."""
    finite = json.loads(json.dumps(data), parse_constant=lambda _: None)
    _print(json.dumps(finite, indent=2), "\n")


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


class Answering(dict[str, Any]):
    """The answer of one command, collected while it runs and printed at its end as text or JSON.

    It is used as a context. Each warning becomes one line on stderr and a part of the answer. If JSON is wanted, it is
    printed even when the command ends with an error. Of the options given it has some as they are, until more is known.
    """

    def __init__(self, command: str, **given: Any) -> None:
        super().__init__(blank(command))
        self.json_wanted = given["json"]
        self.update({key: given[key] for key in AS_ASKED if key in given and key in self})
        self._warnings = warnings.catch_warnings(action="always", category=FingerspiceWarning)

    def __enter__(self) -> Answering:
        self._warnings.__enter__()
        warnings.showwarning = self._show
        return self

    def _show(self, message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        text = str(message)
        if text not in self["warnings"]:
            self["warnings"].append(text)
            complain(f"warning: {text}")

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: Any) -> None:
        self._warnings.__exit__(kind, error, None)
        if not self.json_wanted or not (error is None or isinstance(error, Exception)):
            return
        if error is None:
            self.update(success=True, status="SUCCESS", message="success")
        else:
            _, status, said = outcome(error)
            failure = error.failure.to_dict() if isinstance(error, SolveError) else None
            self.update(status=status, message=said, failure=failure)
        say_json(self)

    def give(self, text: Callable[[], str], writes: Sequence[Write] = ()) -> None:
        """Write files, then print the result as text unless JSON is wanted.

        Each of `writes` writes a file and returns its path, or None for no file. If one cannot be written, the text is
        still printed before the error is raised.
        """
        files: list[str] = self["files"]
        try:
            for write in writes:
                files += [str(file)] if (file := write()) is not None else []
        finally:
            said = [*filter(None, [text()]), *(f"wrote {file}" for file in files)]
            if said and not self.json_wanted:
                say("\n".join(said))
