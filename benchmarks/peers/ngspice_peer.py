"""ngspice on the exported netlist with a given largest step; cubic splines through its time points give the outputs.

A run is a process; its time is the time of the process less the start-up time, measured with a deck of one resistor.
Reading the file and the splines are not timed.
"""

from __future__ import annotations

import re
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

import fingerspice as fs
from peers.contest import Contestant, FloatArray, NotSolvedError, Outcome, Plan
from problems import Problem

LIBRARY = "ngspice"
TIMEOUT = 60.0
EMPTY = "start-up alone\nVdrive drive 0 1\nRload drive 0 1k\n.tran 1m 1m uic\n.end\n"


def version() -> str | None:
    """Version of the ngspice on the path."""
    if shutil.which("ngspice") is None:
        return None
    said = subprocess.run(["ngspice", "--version"], capture_output=True, text=True, check=False).stdout
    found = re.search(r"ngspice-(\S+)", said)
    return f"ngspice {found.group(1)}" if found else "ngspice"


def deck(problem: Problem, t_stop: float, max_step: float) -> str:
    """The problem's exported netlist with its own source and largest step (s)."""
    text = fs.export_netlist(problem.circuit().replace({"Vdrive": fs.DC(0.0)}))
    behavioural = problem.ngspice.startswith("{")
    source = rf"Bdrive \1 V={problem.ngspice}" if behavioural else rf"Vdrive \1 {problem.ngspice}"
    text, sources = re.subn(r"(?m)^Vdrive (\S+ \S+) .*$", source, text)
    saved = " ".join(f"v({node})" for nodes in problem.exported for node in nodes)
    tran = f".save {saved}\n.tran {max_step!r} {t_stop!r} 0 {max_step!r} uic"
    text, trans = re.subn(r"(?m)^\.tran .*$", tran, text)
    assert sources == trans == 1
    return text


def _run(text: str, folder: Path) -> None:
    (folder / "deck.cir").write_text(text, encoding="utf-8")
    done = subprocess.run(
        ["ngspice", "-b", "-r", "out.raw", "deck.cir"],
        cwd=folder, capture_output=True, text=True, errors="replace", timeout=TIMEOUT, check=False,
    )  # fmt: skip
    if done.returncode != 0 or "aborted" in done.stdout + done.stderr:
        lines = [x for x in (done.stderr + done.stdout).splitlines() if "too small" in x or "rror" in x]
        raise NotSolvedError(lines[0].strip() if lines else f"exit {done.returncode}")


def read_raw(path: Path) -> dict[str, FloatArray]:
    """Variables of a binary raw file, by name."""
    data = path.read_bytes()
    head, _, body = data.partition(b"Binary:\n")
    text = head.decode("ascii", "replace")
    variables = int(re.findall(r"No\. Variables: (\d+)", text)[0])
    points = int(re.findall(r"No\. Points: (\d+)", text)[0])
    names = re.findall(r"(?m)^\t\d+\t(\S+)\t", text)
    table = np.frombuffer(body, float, variables * points).reshape(points, variables)
    return {name: table[:, i] for i, name in enumerate(names)}


def _at_outputs(plan: Plan, raw: dict[str, FloatArray], name: str, max_step: float) -> FloatArray:
    """A signal at the outputs, from a cubic spline through ngspice's points of each piece."""
    out = np.empty(plan.t_eval.size)
    t, y = raw["time"], raw[name]
    for piece in plan.pieces:
        # Leave out the 1 ns edges at the jumps, and points less than a thousandth of a step apart, where the
        # differences of a spline would be round-off.
        inside = np.flatnonzero((t > piece.t0 + 1e-9) & (t < piece.t1 - 1e-9))
        kept = inside[np.concatenate([[True], np.diff(t[inside]) > 1e-3 * max_step])]
        out[piece.first : piece.last] = CubicSpline(t[kept], y[kept])(plan.t_eval[piece.first : piece.last])
    return out


def _setup(plan: Plan) -> Callable[[float], Outcome]:
    fingers = list(zip(plan.problem.exported, plan.problem.stresses, strict=True))
    text = {}

    def run(steps: float) -> Outcome:
        empty = start_up()
        max_step = plan.problem.period / steps
        if steps not in text:
            text[steps] = deck(plan.problem, plan.t_stop, max_step)
        with tempfile.TemporaryDirectory() as folder:
            begin = time.perf_counter()
            _run(text[steps], Path(folder))
            seconds = time.perf_counter() - begin
            raw = read_raw(Path(folder) / "out.raw")
        u_gap, force = np.empty((2, plan.t_eval.size, len(fingers)))
        for i, (nodes, stress) in enumerate(fingers):
            top, skin, area = (_at_outputs(plan, raw, f"v({node})", max_step) for node in nodes)
            u_gap[:, i] = top - skin
            force[:, i] = stress * u_gap[:, i] ** 2 * 1e-6 * area
        # The signals of a single finger have one axis, as in the package.
        shape = (-1, len(fingers)) if len(fingers) > 1 else -1
        return Outcome(u_gap.reshape(shape), force.reshape(shape), None, seconds - empty)

    return run


@lru_cache(maxsize=1)
def start_up() -> float:
    """Median wall time of ngspice for a deck of one resistor, s."""
    times = []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(7):
            begin = time.perf_counter()
            _run(EMPTY, Path(folder))
            times.append(time.perf_counter() - begin)
    return statistics.median(times)


def contestants() -> list[Contestant]:
    """One contestant: ngspice's trapezoidal rule, whose largest step determines the error."""
    steps = (30.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 5000.0)
    return [Contestant("ngspice", LIBRARY, steps, _setup, "steps per period", networks=True, slow=True)]
