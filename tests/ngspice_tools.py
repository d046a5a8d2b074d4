"""Run a netlist in ngspice, read the transient back, and run the same circuit beside it."""

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import fingerspice as fs

CIRCUITS = Path(__file__).resolve().parent.parent / "circuits"
LIBRARIES = {"local": "fingerspice.lib", "mobile": "fingerspice_mobile.lib"}

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
    assert count, f"the deck includes none of {', '.join(LIBRARIES.values())}"
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
    assert count == 1, f"the deck has {count} .tran lines, one is needed"
    return rewritten


def run_ngspice(text: str, signals: Sequence[str], max_step: float | None = None) -> dict[str, NDArray[np.float64]]:
    """Run the `.tran` of a deck's text in ngspice, in a temporary folder with the libraries of `circuits/`.

    A `.control` block in it is left out. `signals` are ngspice's expressions of node voltages, such as
    ``v(top)-v(skin)``; `max_step` [s], which the error follows, takes the place of the deck's TMAX. Returns ``time``
    [s], ngspice's own, and each signal under its own expression, arrays of shape (points,). A deck that
    ngspice refuses or stops before TSTOP fails the test with what it said.
    """
    text = _with_control(text if max_step is None else with_max_step(text, max_step), signals)
    with tempfile.TemporaryDirectory(prefix="ngspice-") as temporary:
        folder = Path(temporary)
        for name in LIBRARIES.values():
            shutil.copy(CIRCUITS / name, folder / name)
        (folder / "deck.cir").write_text(text, encoding="utf-8")
        done = call_ngspice(folder, "deck.cir", timeout=300.0)
        out = folder / "out.txt"
        table = np.loadtxt(out, ndmin=2) if out.exists() else np.empty((0, 1 + len(signals)))
    said = f"{done.stderr.strip()}\n{done.stdout.strip()}".strip()
    if done.returncode != 0 or len(table) == 0 or "aborted" in said:
        reached = f"at t = {table[-1, 0]:.9g} s" if len(table) else "before the first time point"
        pytest.fail(f"ngspice stopped {reached} (exit {done.returncode}):\n{said}")
    return {"time": table[:, 0], **{s: table[:, 1 + i] for i, s in enumerate(signals)}}


def _with_control(deck: str, signals: Sequence[str]) -> str:
    """Deck that runs, writes `signals` with all digits to `out.txt`, and exits with 0."""
    deck = re.sub(r"(?ims)^[ \t]*\.control\b.*?^[ \t]*\.endc\b[^\n]*\n?", "", deck)
    deck = re.sub(r"(?im)^[ \t]*\.end[ \t]*$.*", "", deck)
    block = [".control", "run", *(f"let signal{i} = {signal}" for i, signal in enumerate(signals))]
    block += ["set wr_singlescale", "set numdgt=15"]
    block += ["wrdata out.txt " + " ".join(f"signal{i}" for i in range(len(signals)))]
    return "\n".join([deck.rstrip("\n"), *block, "quit 0", ".endc", ".end", ""])


class Beside(NamedTuple):
    """A run, and what ngspice has at the same times; of one GAP without the axis of the gaps, as in the run."""

    run: fs.Solution
    nodes: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    """Ours and theirs of every node but those of areas, V."""
    u_gap: NDArray[np.float64] | None
    """Theirs, V."""
    area: NDArray[np.float64] | None
    """Theirs, mm^2; of a circuit without a GAP that of its layers."""


def beside(
    circuit: fs.Circuit, text: str = "", law: str | None = None, *, max_step: float | None = None, after: float = 0.0,
    edge: float = 3e-9, **how: Any,
) -> Beside:  # fmt: skip
    """Run a circuit, with options `how`, at the times of ngspice, which runs `text` or what is exported of it.

    Left out are times before `after` (s), as ngspice's first steps are of first order and do not become shorter with
    its largest one, and times within `edge` (s) of the start and of the sources' edges, which take up to 1 ns there.
    """
    gaps = circuit.by_device("GAP")
    of_layers = {e.node_names[2]: None for e in circuit.elements if e.spec.is_layer}
    areas = [gap.node_names[2] for gap in gaps] or list(of_layers)
    ends = [zip(e.nodes[:2], e.node_names[:2], strict=True) for e in circuit.elements]
    nodes = {name for pair in ends for node, name in pair if node != "0" and name not in of_layers}
    shown = {name: f"v({name if text else name.replace('.', '_')})" for name in (*nodes, *areas)}
    theirs = run_ngspice(text or fs.export_netlist(circuit, charge_law=law), list(shown.values()), max_step)
    t, first = np.unique(np.minimum(theirs["time"], circuit.tran.stop), return_index=True)
    waves = [e.waveform for e in circuit.by_device("V", "I") if e.waveform is not None]
    edges = np.concatenate([np.zeros(1), *(wave.breakpoints(0.0, t[-1]) for wave in waves)])
    kept = (np.abs(t[:, None] - edges[None, :]).min(axis=1) > edge) & (t >= after)
    run = fs.simulate(circuit, charge_law=law, t_eval=t[kept], **how)
    ours = {name.lower(): v for name, v in run.node_voltages.items()}
    there = {name: theirs[signal][first][kept] for name, signal in shown.items()}

    def columns(found: list[NDArray[np.float64]]) -> NDArray[np.float64] | None:
        if len(found) < 2:
            return found[0] if found else None
        return np.column_stack(found)

    across = [[there.get(name, 0.0) for name in gap.node_names[:2]] for gap in gaps]
    return Beside(
        run, {name: (ours[name.lower()], there[name]) for name in nodes}, columns([p - n for p, n in across]),
        columns([there[name] for name in areas]),
    )  # fmt: skip
