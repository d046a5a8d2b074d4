"""The hard cases with this package and all other libraries that could solve them: right, wrong, refused, or hung.

Run: python benchmarks/hard_cases.py [--quick] [--cases NAME ... [--update]] [--tools WORD ...]. A full run takes about
20 minutes and writes results/hard_cases.json and hard_cases.md; --update renews the cases named in them.

The requested error is 1e-6 of the peak of gap voltage and force. Peers control the error of a step, not of the result:
they are run at 1e-8, split at the declared jumps, on the compiled right-hand side of `right_hand_side.py` (which is NaN
if its equation has no solution), with an absolute tolerance proportional to the source. ngspice is run with 1000 steps
per period and at least 100 in every piece longer than 10 ns, and its requested error is 1e-4. An answer is right if its
error is at most ten times the requested one; a refusal is right if the case has no answer and the message names the
true reason. Every run is a process of its own with a limit of 10 s for the solve; compilation comes before it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import polynomial

import fingerspice as fs
from hard_scenes import DECKS, SCENES, Deck, HardProblem
from peers import MODULES, contestants, ngspice_peer
from peers.contest import FloatArray, NotSolvedError, Plan
from problems import DECK, by_name
from work_precision import machine, warm

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "hard_cases.json"
LIMIT, COMPILE_LIMIT = 10.0, 60.0
MAX_STEPS = 3_000_000
ASKED, ASKED_OF_NGSPICE, PEERS_RTOL, STEPS = 1e-6, 1e-4, 1e-8, 1000.0
TOOLS = (
    "fingerspice", "scipy LSODA", "scipy Radau", "scipy BDF", "scipy DOP853", "CVODE BDF", "diffrax Tsit5",
    "diffrax Kvaerno5", "torchdiffeq dopri5", "ngspice",
)  # fmt: skip
MARKS = {
    "right": "✓",
    "wrong silently": "**wrong**",
    "failed with message": "message",
    "warned": "warned",
    "hung": "hung",
    "n/a": "–",
}
Report = dict[str, Any]
Case = HardProblem | Deck


def solver(case: Case, tool: str) -> Callable[[], tuple[FloatArray, FloatArray] | str]:
    """The function that runs a case: it returns gap voltage and force at the outputs, or a deck's messages."""
    if isinstance(case, Deck):
        return lambda: run_deck(case, tool)
    plan = Plan(case, case.periods)
    if tool == "ngspice":
        return lambda: run_ngspice(plan)
    for name in MODULES:
        module = import_module(f"peers.{name}")
        if hasattr(module, "AMPLITUDE"):
            # The peers' absolute tolerances are proportional to AMPLITUDE.
            module.AMPLITUDE = case.peak
        if hasattr(module, "MAX_STEPS"):
            module.MAX_STEPS = MAX_STEPS
    field, _ = contestants()
    run = next(c for c in field if c.name == tool).setup(plan)
    rtol = ASKED if tool == "fingerspice" else PEERS_RTOL
    if tool == "fingerspice":
        # Run another scene of the same law first, so that the compiled code is loaded.
        scene = by_name()["sine_100Hz" if case.law == "local" else "sine_100Hz_mobile"]
        fs.simulate(scene.circuit(), t_stop=0.01, rtol=rtol, charge_law=case.law, charge=False)
    if tool.startswith("diffrax"):
        # This run only compiles; its result is ignored.
        with contextlib.suppress(NotSolvedError):
            run(0.1)

    def solve() -> tuple[FloatArray, FloatArray]:
        outcome = run(rtol)
        return outcome.u_gap, outcome.f_el

    return solve


def run_ngspice(plan: Plan) -> tuple[FloatArray, FloatArray]:
    """Run ngspice; outputs are interpolated linearly between its own points."""
    lengths = [p.t1 - p.t0 for p in plan.pieces if p.t1 - p.t0 > 1e-8]
    text = ngspice_peer.deck(plan.problem, plan.t_stop, min(plan.problem.period / STEPS, min(lengths) / 100.0))
    with tempfile.TemporaryDirectory() as folder:
        ngspice_peer._run(text, Path(folder))
        raw = ngspice_peer.read_raw(Path(folder) / "out.raw")
    u_gap = np.interp(plan.t_eval, raw["time"], raw["v(top)"] - raw["v(skin)"])
    # The area is a nonlinear function of the gap voltage: compute it from the interpolated voltage, not by
    # interpolation.
    known = plan.problem.constants
    inverse = polynomial.polyval(np.minimum(2.0 * np.abs(u_gap) / known.reach, 2.0) - 1.0, known.series)
    return u_gap, known.stress * u_gap**2 / inverse


def run_deck(case: Deck, tool: str) -> str:
    """Run a netlist to its end, or fail; returns the tool's messages."""
    if tool == "fingerspice":
        return fs.simulate(fs.parse_netlist(case.text)).message
    with tempfile.TemporaryDirectory() as name:
        shutil.copy(DECK.parent / "fingerspice.lib", name)
        (Path(name) / "deck.cir").write_text(case.text, encoding="utf-8")
        done = subprocess.run(
            ["ngspice", "-b", "-r", "out.raw", "deck.cir"],
            cwd=name, capture_output=True, text=True, errors="replace", check=False,
        )  # fmt: skip
        lines = (x.strip() for x in done.stderr.splitlines())
        said = list(dict.fromkeys(x for x in lines if x and not x.startswith(("Note", "Trying gmin"))))
        whole = (Path(name) / "out.raw").is_file() and done.returncode == 0 and "aborted" not in " ".join(said)
        if not whole:
            raise NotSolvedError("; ".join(said[:5]) or f"exit {done.returncode}")
    return "; ".join(said[:5])


def can(case: Case, tool: str) -> bool:
    """Whether a case can be expressed for a tool."""
    if isinstance(case, Deck):
        return tool in ("fingerspice", "ngspice")
    # The mobile law's equation is solved in a loop written for numba only; ngspice's sources declare their edges.
    return not (
        (case.law == "mobile" and tool.startswith("diffrax")) or (case.name == "undeclared" and tool == "ngspice")
    )


def worker(case: Case, tool: str, pipe: Any) -> None:
    """The process of one run."""
    os.setsid()
    warnings.simplefilter("ignore")
    ngspice_peer.TIMEOUT = 10.0 * LIMIT
    try:
        solve = solver(case, tool)
        pipe.send(("ready", None))
        begin = time.perf_counter()
        answer = solve()
        pipe.send(("done", (answer, time.perf_counter() - begin)))
    except Exception as error:  # every library fails in its own way
        text = (str(error).strip().splitlines() or [""])[0]
        said = text if isinstance(error, NotSolvedError) else f"{type(error).__name__}: {text}"
        pipe.send(("failed", said[:400]))


def attempt(case: Case, tool: str) -> tuple[str, Any]:
    """Outcome of a run: ("done", (answer, s)), ("failed", message) or ("hung", None)."""
    context = multiprocessing.get_context("fork")
    mine, other = context.Pipe()
    process = context.Process(target=worker, args=(case, tool, other))
    with warnings.catch_warnings():
        # Python warns about a fork with other threads running, whose locks might be held; the child uses none of them.
        warnings.simplefilter("ignore", DeprecationWarning)
        process.start()
    other.close()
    try:
        found: tuple[str, Any] = mine.recv() if mine.poll(COMPILE_LIMIT) else ("hung", None)
        if found[0] == "ready":
            found = mine.recv() if mine.poll(LIMIT) else ("hung", None)
    except EOFError:
        found = ("failed", "the process died")
    if process.is_alive():
        if found[0] == "hung" and process.pid is not None:
            # The process and all processes that it started form one process group of their own: end the group.
            os.killpg(process.pid, signal.SIGKILL)
        process.join()
    return found


def judge(case: Case, tool: str, found: tuple[str, Any], truth: tuple[FloatArray, FloatArray] | None) -> Report:
    """Verdict on the outcome of a run, with error, time or message."""
    kind, what = found
    if kind == "hung":
        return {"verdict": "hung"}
    if kind == "failed":
        named = case.refusal and re.search(case.refusal, what)
        return {"verdict": "right" if named else "failed with message", "message": what}
    answer, seconds = what
    report: Report = {"verdict": "wrong silently", "seconds": float(f"{seconds:.3g}")}
    if isinstance(answer, str):
        warned = re.search(case.refusal, answer)
        return {"verdict": "warned" if warned else "wrong silently", "message": answer}
    if case.refusal or truth is None:
        return report
    if not all(np.all(np.isfinite(x)) for x in answer):
        return report | {"error": None}
    # If the reference is zero, the error is absolute (V or N) instead of relative to the peak.
    errors = [float(np.abs(a - b).max() / (np.abs(b).max() or 1.0)) for a, b in zip(answer, truth, strict=True)]
    allowed = 10.0 * (ASKED_OF_NGSPICE if tool == "ngspice" else ASKED)
    report["error"] = float(f"{max(errors):.3g}")
    return report | ({"verdict": "right"} if max(errors) <= allowed else {})


def contest(cases: list[Case], tools: list[str], versions: dict[str, str], path: Path | None, kept: Report) -> Report:
    """Run all tools on all cases, and print a line for each; writes the results after every case."""
    results: Report = {"machine": machine(), "versions": versions, "limit_s": LIMIT, "asked": ASKED, "cases": kept}
    for case in cases:
        truth = None
        if isinstance(case, HardProblem):
            # Compile before the workers are forked, so that none of them compiles again.
            warm(case)
            truth = None if case.refusal else case.truth()
        row = dict(kept[case.name]["tools"]) if case.name in kept else {}
        for tool in tools:
            able = can(case, tool)
            row[tool] = judge(case, tool, attempt(case, tool), truth) if able else {"verdict": "n/a"}
            print(f"{case.name:20s} {tool:20s}", json.dumps(row[tool]), flush=True)
        results["cases"][case.name] = {
            "title": case.title,
            "refused": bool(case.refusal),
            "peers_rtol": PEERS_RTOL,
            "tools": row,
        }
        known = [c.name for c in (*SCENES, *DECKS)]
        results["cases"] = dict(sorted(results["cases"].items(), key=lambda row: known.index(row[0])))
        if path is not None:
            path.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
            path.with_suffix(".md").write_text(page(results), encoding="utf-8")
    return results


def page(results: Report) -> str:
    """The results as a table in Markdown."""
    tools = list(next(iter(results["cases"].values()))["tools"])
    lines = [
        "# Hard cases", "",
        f"{results['asked']:g} of the peak asked, {results['limit_s']:g} s given, on {results['machine']}. ✓: within "
        "ten times what was asked, or refused for the true reason (cases marked †, which have no answer). **wrong**: "
        "returned as a success, and is none. message: failed and said so, for another reason or where there is an "
        "answer. warned: ran on, with a warning that names the element. –: cannot be expressed.", "",
        "| case | " + " | ".join(tools) + " |",
        "|---" * (len(tools) + 1) + "|",
    ]  # fmt: skip
    for case in results["cases"].values():
        marks = (MARKS[found["verdict"]] for found in case["tools"].values())
        lines.append(f"| {case['title']}{' †' if case['refused'] else ''} | " + " | ".join(marks) + " |")
    right = (sum(c["tools"][t]["verdict"] == "right" for c in results["cases"].values()) for t in tools)
    asked = (sum(c["tools"][t]["verdict"] != "n/a" for c in results["cases"].values()) for t in tools)
    lines.append(
        "| right, of those expressed | " + " | ".join(f"{r}/{n}" for r, n in zip(right, asked, strict=True)) + " |"
    )
    absent = [name for name, version in results["versions"].items() if version == "absent"]
    lines += [
        "",
        "Versions: "
        + ", ".join(v if " " in v else f"{name} {v}" for name, v in results["versions"].items() if v != "absent")
        + ".",
    ]
    return "\n".join([*lines, *([f"Absent: {', '.join(absent)}."] if absent else []), ""])


def main(arguments: list[str] | None = None) -> Report:
    """Run the cases and, unless quick or a selection, write the results; returns them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="three cases, this package and DOP853, nothing written")
    parser.add_argument("--cases", nargs="+", choices=[c.name for c in (*SCENES, *DECKS)], help="these only")
    parser.add_argument("--update", action="store_true", help="keep the other cases of the results, and write")
    parser.add_argument("--tools", nargs="+", help="those whose names begin with one of these")
    options = parser.parse_args(arguments)
    field, versions = contestants()
    present = {c.name for c in field}
    tools = [t for t in TOOLS if t in present]
    cases: list[Case] = [*SCENES, *DECKS]
    chosen, named = options.cases, options.tools
    if options.quick:
        chosen, named = ["blocking_coat", "undeclared", "parallel"], ["fingerspice", "scipy DOP853"]
    if chosen:
        cases = [c for c in cases if c.name in chosen]
    if named:
        tools = [t for t in tools if t.startswith(tuple(named))]
    versions["fingerspice"] = f"fingerspice {fs.__version__}"
    kept = json.loads(RESULTS.read_text(encoding="utf-8"))["cases"] if options.update else {}
    written = options.update or not (chosen or named)
    return contest(cases, tools, versions, RESULTS if written else None, kept)


if __name__ == "__main__":
    main()
