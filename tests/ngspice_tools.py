"""Run a netlist of `circuits/` in ngspice and read the transient back.

Used by the tests that compare with ngspice; independent of the model.
"""

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

CIRCUITS = Path(__file__).resolve().parent.parent / "circuits"
LIBRARIES = {"local": "fingerspice.lib", "mobile": "fingerspice_mobile.lib"}
GAP_SIGNALS = ("v(top)-v(skin)", "v(area)")
"""Gap voltage [V] and ridge contact area [mm^2] of the shipped decks."""


class NgspiceError(RuntimeError):
    """ngspice stopped before the end of the run; the text holds what it said."""


WITHOUT = "ngspice is not installed"
"""Why a comparison is skipped."""


def call_ngspice(folder: Path, *arguments: str, timeout: float = 30.0) -> subprocess.CompletedProcess[str]:
    """`ngspice -b ARGUMENTS` in a folder; without ngspice the test is skipped, and where CI is set it fails."""
    if shutil.which("ngspice") is None:
        if os.environ.get("CI", "").lower() not in ("", "0", "false"):
            pytest.fail(f"{WITHOUT}, which CI asks for: apt-get install ngspice")
        pytest.skip(WITHOUT)
    return subprocess.run(
        ["ngspice", "-b", *arguments], cwd=folder, capture_output=True, text=True, errors="replace", timeout=timeout,
        check=False,
    )  # fmt: skip


def with_charge_law(deck: str, law: str) -> str:
    """Deck text that includes the library of the charge law `law` (`local` or `mobile`)."""
    pattern = "|".join(re.escape(name) for name in LIBRARIES.values())
    swapped, count = re.subn(rf"(?<![\w.-])(?:{pattern})(?![\w.-])", LIBRARIES[law], deck)
    if count == 0:
        raise ValueError(f"the deck includes none of {', '.join(LIBRARIES.values())}")
    return swapped


def with_max_step(deck: str, max_step: float) -> str:
    """Deck text whose `.tran` line has `max_step` [s] as its TMAX."""

    def rewrite(match: re.Match[str]) -> str:
        words = match.group(2).split()
        numbers = [word for word in words if word.lower() != "uic"]
        start = numbers[2] if len(numbers) > 2 else "0"
        uic = ["uic"] if len(numbers) < len(words) else []
        return " ".join([match.group(1), *numbers[:2], start, repr(float(max_step)), *uic])

    rewritten, count = re.subn(r"(?im)^[ \t]*(\.tran)\b([^;$\n]*).*$", rewrite, deck)
    if count != 1:
        raise ValueError(f"the deck has {count} .tran lines, one is needed")
    return rewritten


def run_ngspice(
    text: str, signals: Sequence[str] = GAP_SIGNALS, max_step: float | None = None, timeout: float = 300.0
) -> dict[str, NDArray[np.float64]]:
    """Run the `.tran` of a deck's text in ngspice, in a temporary folder with the libraries of `circuits/`.

    A `.control` block in it is left out. `signals` are ngspice's expressions of node voltages, such as
    ``v(top)-v(skin)``; `max_step` [s], which the error follows, takes the place of the deck's TMAX; `timeout` is in s.
    Returns ``time`` [s], ngspice's own, and each signal under its own expression, arrays of shape (points,).

    Raises
    ------
    NgspiceError
        If ngspice refuses the deck or stops before TSTOP.
    """
    text = _with_control(text if max_step is None else with_max_step(text, max_step), signals)
    with tempfile.TemporaryDirectory(prefix="ngspice-") as temporary:
        folder = Path(temporary)
        for name in LIBRARIES.values():
            shutil.copy(CIRCUITS / name, folder / name)
        (folder / "deck.cir").write_text(text, encoding="utf-8")
        done = call_ngspice(folder, "deck.cir", timeout=timeout)
        out = folder / "out.txt"
        table = np.loadtxt(out, ndmin=2) if out.exists() else np.empty((0, 1 + len(signals)))
    said = f"{done.stderr.strip()}\n{done.stdout.strip()}".strip()
    if done.returncode != 0 or len(table) == 0 or "aborted" in said:
        reached = f"at t = {table[-1, 0]:.9g} s" if len(table) else "before the first time point"
        raise NgspiceError(f"ngspice stopped {reached} (exit {done.returncode}):\n{said}")
    return {"time": table[:, 0], **{s: table[:, 1 + i] for i, s in enumerate(signals)}}


def _with_control(deck: str, signals: Sequence[str]) -> str:
    """Deck that runs, writes `signals` with all digits to `out.txt`, and exits with 0."""
    deck = re.sub(r"(?ims)^[ \t]*\.control\b.*?^[ \t]*\.endc\b[^\n]*\n?", "", deck)
    deck = re.sub(r"(?im)^[ \t]*\.end[ \t]*$.*", "", deck)
    block = [".control", "run", *(f"let signal{i} = {signal}" for i, signal in enumerate(signals))]
    block += ["set wr_singlescale", "set numdgt=15"]
    block += ["wrdata out.txt " + " ".join(f"signal{i}" for i in range(len(signals)))]
    return "\n".join([deck.rstrip("\n"), *block, "quit 0", ".endc", ".end", ""])
