"""Error against time of this package and of all other libraries that can solve the same scenes.

Run: python benchmarks/work_precision.py [--quick] [--repeats 7] [--limit 6] [--problems NAME ...]
[--contestants WORD ...] [--output FILE], then python benchmarks/report.py. A full run takes about half an hour and
writes results/work_precision.json, for which all libraries have to be there; a selection is only printed, unless
--output says where to keep it.

The problems are the stacks of `problems.py` and the networks of `network_problems.py`, with 100 outputs per period.
Every contestant gets the compiled right-hand side of `right_hand_side.py` and `network_rates.py`, pieces split at the
source's jumps, and, as `+kinks`, the exact times of the gap voltages' zeros at no cost. The error is the larger of the
errors of gap voltage and force over all outputs, each finger's relative to its own peak.

Every point is timed once. A point that took at most `FAR` times the time of the fastest point of at most its error is
timed seven times (three times if it takes longer than `LONG` s); all other points keep their single time, with
`repeats` = 1.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import statistics
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from network_problems import NetworkProblem, every
from peers import contestants
from peers.contest import Contestant, NotSolvedError, Outcome, Plan
from problems import OUTPUTS_PER_PERIOD, Problem
from reference import AGREEMENT, Reference, reference
from right_hand_side import compiled

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "work_precision.json"
REPEATS, LIMIT = 7, 6.0
FAR, LONG = 100.0, 0.3
QUICK_RTOL, QUICK_STEPS = 1e-6, 200.0
QUICK_PROBLEMS = (("sine_100Hz", 2), ("square_5kHz", 5), ("two_fingers_sine_5kHz", 2))
TOO_LONG, FAILED_TWICE = "took too long", "not tried after two failures"
FAILURES = (NotSolvedError, ArithmeticError, AssertionError, RuntimeError, ValueError)
"""Exceptions that count as failures of a library; SolveError of this package is a RuntimeError."""
Report = dict[str, Any]
Run = Callable[[float], Outcome]


class TooLongError(Exception):
    """A run took longer than its time limit."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise TooLongError in the block after `seconds`; a library's compiled loop is not interrupted."""

    def stop(*_: object) -> None:
        raise TooLongError

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def timed(run: Run, setting: float) -> tuple[float, Outcome]:
    """Wall time (s) of a run, and its outcome."""
    begin = time.perf_counter()
    outcome = run(setting)
    seconds = time.perf_counter() - begin
    return (seconds if outcome.seconds is None else outcome.seconds), outcome


def in_time(run: Run, setting: float, limit: float) -> tuple[float, Outcome]:
    """`timed`, within a limit (s); a run that took longer is repeated once, because a shared machine may pause."""
    try:
        with at_most(limit):
            return timed(run, setting)
    except TooLongError:
        with at_most(limit):
            return timed(run, setting)


def point(run: Run, setting: float, plan: Plan, truth: Reference, limit: float) -> Report:
    """One setting of a contestant, run once: errors, time and evaluations, or the reason for none in `status`."""
    found: Report = {"setting": setting, "status": "ok"}
    try:
        seconds, outcome = in_time(run, setting, limit)
    except TooLongError:
        return found | {"status": TOO_LONG}
    except FAILURES as error:
        said = (str(error).strip().splitlines() or [""])[0][:200]
        own = isinstance(error, NotSolvedError)
        return found | {"status": said if own else f"{type(error).__name__}: {said}"}
    if not (np.all(np.isfinite(outcome.u_gap)) and np.all(np.isfinite(outcome.f_el))):
        return found | {"status": "NaN, called a success"}
    error_u, error_f = truth.errors(outcome.u_gap, outcome.f_el)
    return found | {
        "error": max(error_u, error_f),
        "error_u": error_u,
        "error_f": error_f,
        "us_per_period": 1e6 * seconds / plan.periods,
        "nfev_per_period": None if outcome.nfev is None else outcome.nfev / plan.periods,
        "repeats": 1,
    }


def race(
    contestant: Contestant, problem: Problem, truth: Reference, settings: tuple[float, ...], limit: float
) -> Iterator[tuple[Report, Run]]:
    """All settings of a contestant on a problem, loose to tight, each run once; with the function to repeat the run."""
    periods = problem.periods
    if contestant.slow and problem.divisible:
        periods = max(1, periods // 5)
    zeros, signs = (truth.zeros, truth.signs) if contestant.kinks else ((), ())
    stop = problem.t_stop(periods)
    plan = Plan(problem, periods, tuple(z for z in zeros if z < stop), tuple(signs))
    run = contestant.setup(plan)
    compile_s, late = warm_up(run, settings[0], limit, contestant.compile_limit)
    failures = 0
    for setting in settings:
        if late or failures == 2:
            found: Report = {"setting": setting, "status": TOO_LONG if late else FAILED_TWICE}
        else:
            found = point(run, setting, plan, truth, limit)
            late = found["status"] == TOO_LONG
            failures = 0 if found["status"] == "ok" else failures + 1
        yield {
            "problem": problem.name, "contestant": contestant.name, "library": contestant.library,
            "what": contestant.what, "periods": periods, "compile_s": compile_s, **found,
        }, run  # fmt: skip


def repeat(entries: list[tuple[Report, Run]], repeats: int) -> None:
    """Repeat the points that are not much slower than the fastest point of at most their error, and enter medians."""
    solved = [(found, run) for found, run in entries if found["status"] == "ok"]
    once = [(found["error"], found["us_per_period"]) for found, _ in solved]
    for found, run in solved:
        best = min(cost for error, cost in once if error <= found["error"])
        seconds = 1e-6 * found["us_per_period"] * found["periods"]
        if found["us_per_period"] <= FAR * best and repeats > 1:
            times = [timed(run, found["setting"])[0] for _ in range(repeats if seconds < LONG else min(repeats, 3))]
            found["us_per_period"] = 1e6 * statistics.median(times) / found["periods"]
            found["us_per_period_least"] = 1e6 * min(times) / found["periods"]
            found["repeats"] = len(times)


def warm_up(run: Run, setting: float, limit: float, compile_limit: float) -> tuple[float | None, bool]:
    """Compilation time (s), the first run's time less the second's (None if unknown); and whether to give up."""
    try:
        first = in_time(run, setting, limit + compile_limit)[0]
        return max(0.0, first - in_time(run, setting, limit)[0]), False
    except TooLongError:
        return None, True
    except FAILURES:
        # The measured run fails in the same way, and records it.
        return None, False


def describe(problem: Problem, truth: Reference) -> Report:
    """The description of a problem in the results."""
    return {
        "title": problem.title,
        "charge_law": problem.law,
        "kind": "network" if isinstance(problem, NetworkProblem) else "stack",
        "period_s": problem.period,
        "periods": problem.periods,
        "outputs_per_period": OUTPUTS_PER_PERIOD,
        "peak_u_gap_V": float(np.abs(truth.u_gap).max()),
        "peak_f_el_N": float(np.abs(truth.f_el).max()),
        "zeros_of_u_gap": int(truth.zeros.size),
        "reference": f"Radau IIA collocation (with tests/analytic.py) and {truth.second}",
        "reference_agreement": truth.agreement,
        "agreement_asked": AGREEMENT,
        "error_floor": max(truth.agreement, 1e-15),
    }


def machine() -> str:
    """Processor, cores, system, Python."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    return f"{model}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"


def warm(problem: Problem) -> float:
    """Compile the shared right-hand side of a problem; returns the time, s."""
    begin = time.perf_counter()
    rhs = compiled(problem)
    x, one = np.zeros(rhs.size), np.ones(1)
    rhs.rates(0.0, x, 0.0, 0.0)
    rhs.jacobian(0.0, x, 0.0, 0.0)
    rhs.observe(one, np.zeros((1, rhs.size)))
    return time.perf_counter() - begin


def measure(
    problems: list[Problem],
    field: list[Contestant],
    versions: dict[str, str],
    repeats: int,
    limit: float,
    path: Path | None,
) -> Report:
    """Run all contestants on all problems, and print a line per point; writes the results after every problem."""
    import fingerspice

    begin = time.perf_counter()
    results: Report = {
        "machine": machine(), "versions": {**versions, "numpy": np.__version__, "fingerspice": fingerspice.__version__},
        "repeats": repeats, "limit_s": limit, "far": FAR, "problems": {}, "points": [],
    }  # fmt: skip
    for problem in problems:
        truth = reference(problem)
        warm(problem)
        results["problems"][problem.name] = describe(problem, truth)
        print(f"{problem.name}: two references agree to {truth.agreement:.1e} of the peak", flush=True)
        entries = []
        for contestant in field:
            if contestant.takes_part(problem):
                entries += list(race(contestant, problem, truth, contestant.settings, limit))
        repeat(entries, repeats)
        for found, _ in entries:
            results["points"].append(found)
            print(line(found), flush=True)
        results["load_average"] = os.getloadavg()
        results["minutes"] = (time.perf_counter() - begin) / 60.0
        print(f"  {results['minutes']:.1f} minutes so far", flush=True)
        if path is not None:
            write(results, path)
    return results


def write(results: Report, path: Path) -> None:
    """Write the results as JSON, with a line per point and numbers of five digits."""
    points = [
        json.dumps({k: float(f"{v:.5g}") if isinstance(v, float) else v for k, v in p.items()})
        for p in results["points"]
    ]
    head = json.dumps({**results, "points": []}, indent=1)
    assert head.count('"points": []') == 1
    path.write_text(head.replace('"points": []', '"points": [\n' + ",\n".join(points) + "\n]") + "\n", encoding="utf-8")


def line(found: Report) -> str:
    """A point as a line of text."""
    head = f"  {found['contestant']:28s} {found['setting']:8.1e}"
    if found["status"] != "ok":
        return f"{head}  {found['status']}"
    nfev = found["nfev_per_period"]
    count = "" if nfev is None else f"  {nfev:9.1f} evaluations"
    return f"{head}  error {found['error']:.1e}  {found['us_per_period']:10.1f} us of {found['repeats']}{count}"


def quick(seconds: float = 5.0) -> list[Report]:
    """Every contestant without a compiler of its own, on three short problems at one setting; writes nothing."""
    field, _ = contestants(without=("diffrax", "torchdiffeq"))
    points = []
    for name, periods in QUICK_PROBLEMS:
        problem = replace(every()[name], periods=periods)
        truth = reference(problem, second=False)
        for contestant in field:
            if contestant.takes_part(problem):
                setting = QUICK_RTOL if contestant.adaptive else QUICK_STEPS
                points += [found for found, _ in race(contestant, problem, truth, (setting,), seconds)]
                print(line(points[-1]))
    return points


def main(arguments: list[str] | None = None) -> list[Report]:
    """Measure and, unless quick or a selection, write the results; returns the points."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="three short problems, one setting each, nothing written")
    parser.add_argument("--repeats", type=int, default=REPEATS, help="runs per point; slow ones get fewer")
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds after which a run is given up")
    parser.add_argument("--problems", nargs="+", choices=list(every()), help="these only")
    parser.add_argument("--contestants", nargs="+", help="those whose names begin with one of these")
    parser.add_argument("--output", type=Path, help="file for the results")
    options = parser.parse_args(arguments)
    with warnings.catch_warnings():
        # Libraries warn about steps that they then repeat; failures are recorded from their exceptions.
        warnings.simplefilter("ignore")
        if options.quick:
            return quick()
        field, versions = contestants()
        if options.contestants:
            field = [c for c in field if c.name.startswith(tuple(options.contestants))]
        problems = [every()[name] for name in options.problems or every()]
        whole = not (options.problems or options.contestants)
        path = options.output or (RESULTS if whole else None)
        absent = [name for name, version in versions.items() if version == "absent"]
        if path == RESULTS and absent:
            # A table without the best peer would flatter.
            parser.error(f"{', '.join(absent)} not installed; allowed: all contestants, or --output for another file "
                         "(pip builds numbalsoda with gfortran)")  # fmt: skip
        results = measure(problems, field, versions, options.repeats, options.limit, path)
    return list(results["points"])


if __name__ == "__main__":
    main()
