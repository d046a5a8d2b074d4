"""Error against time of this package and of everything else that could solve the same scenes.

Run: python benchmarks/work_precision.py [--quick] [--repeats 7] [--limit 30] [--problems NAME ...]
[--contestants WORD ...] [--output FILE], then python benchmarks/report.py. A full run takes about an hour and writes
results/work_precision.json; a selection is only printed, unless --output says where to keep it.

What is compared: the problems of `problems.py`, 100 outputs a period, every contestant given the compiled right-hand
side of `right_hand_side.py`, splits at the source's jumps, and, as `+kinks`, the exact times of the gap voltage's zeros
for nothing. An error is the larger of those of gap voltage and force over all outputs, each over its peak.
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

from peers import contestants
from peers.contest import Contestant, NotSolvedError, Outcome, Plan
from problems import LOCAL, MOBILE, OUTPUTS_PER_PERIOD, Problem, by_name
from reference import AGREEMENT, Reference, reference
from right_hand_side import compiled

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "work_precision.json"
REPEATS, LIMIT = 7, 30.0
QUICK_RTOL, QUICK_STEPS = 1e-6, 200.0
TOO_LONG = "took too long"
FAILURES = (NotSolvedError, ArithmeticError, AssertionError, RuntimeError, ValueError)
"""How libraries fail; SolveError of this package is a RuntimeError."""
Report = dict[str, Any]


class TooLongError(Exception):
    """A run took more than it was given."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise TooLongError in the block after so many seconds; a library's compiled loop is not interrupted."""

    def stop(*_: object) -> None:
        raise TooLongError

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def timed(run: Callable[[float], Outcome], setting: float) -> tuple[float, Outcome]:
    """Wall time (s) of a run and what it gave."""
    begin = time.perf_counter()
    outcome = run(setting)
    seconds = time.perf_counter() - begin
    return (seconds if outcome.seconds is None else outcome.seconds), outcome


def point(
    run: Callable[[float], Outcome], setting: float, plan: Plan, truth: Reference, repeats: int, limit: float
) -> Report:
    """One setting of a contestant: errors, median time, evaluations; or, in `status`, why there are none."""
    found: Report = {"setting": setting, "status": "ok"}
    try:
        with at_most(limit):
            first, outcome = timed(run, setting)
    except TooLongError:
        return found | {"status": TOO_LONG}
    except FAILURES as error:
        said = (str(error).strip().splitlines() or [""])[0][:200]
        own = isinstance(error, NotSolvedError)
        return found | {"status": said if own else f"{type(error).__name__}: {said}"}
    if not (np.all(np.isfinite(outcome.u_gap)) and np.all(np.isfinite(outcome.f_el))):
        return found | {"status": "NaN, called a success"}
    # Slow runs are repeated less; the first is the warm-up of the others, and counts only where it is alone.
    repeats = repeats if first < 1.0 else min(repeats, 3) if first < 10.0 else 0
    times = [timed(run, setting)[0] for _ in range(repeats)] or [first]
    error_u, error_f = truth.errors(outcome.u_gap, outcome.f_el)
    return found | {
        "error": max(error_u, error_f),
        "error_u": error_u,
        "error_f": error_f,
        "us_per_period": 1e6 * statistics.median(times) / plan.periods,
        "us_per_period_least": 1e6 * min(times) / plan.periods,
        "nfev_per_period": None if outcome.nfev is None else outcome.nfev / plan.periods,
        "repeats": len(times),
    }


def race(
    contestant: Contestant, problem: Problem, truth: Reference, settings: tuple[float, ...], repeats: int, limit: float
) -> Iterator[Report]:
    """All settings of a contestant on a problem, loose to tight."""
    periods = problem.periods
    if contestant.slow and problem.divisible:
        periods = max(1, periods // 5)
    zeros, signs = (truth.zeros, truth.signs) if contestant.kinks else ((), ())
    stop = problem.t_stop(periods)
    plan = Plan(problem, periods, tuple(z for z in zeros if z < stop), tuple(signs))
    run = contestant.setup(plan)
    compile_s, late = warm_up(run, settings[0], limit, contestant.compile_limit)
    for setting in settings:
        if late:
            found: Report = {"setting": setting, "status": TOO_LONG}
        else:
            found = point(run, setting, plan, truth, repeats, limit)
            late = found["status"] == TOO_LONG
        yield {
            "problem": problem.name, "contestant": contestant.name, "library": contestant.library,
            "what": contestant.what, "periods": periods, "compile_s": compile_s, **found,
        }  # fmt: skip


def warm_up(
    run: Callable[[float], Outcome], setting: float, limit: float, compile_limit: float
) -> tuple[float | None, bool]:
    """What the first run takes longer than the second, s: compilation (None where unknown); and whether to give up."""
    try:
        with at_most(limit + compile_limit):
            first = timed(run, setting)[0]
        if first > limit:
            return None, False
        with at_most(limit):
            return max(0.0, first - timed(run, setting)[0]), False
    except TooLongError:
        return None, True
    except FAILURES:
        # The measured run meets the same and says so.
        return None, False


def describe(problem: Problem, truth: Reference) -> Report:
    """A problem as the results state it."""
    return {
        "title": problem.title,
        "charge_law": problem.law,
        "period_s": problem.period,
        "periods": problem.periods,
        "outputs_per_period": OUTPUTS_PER_PERIOD,
        "peak_u_gap_V": float(np.abs(truth.u_gap).max()),
        "peak_f_el_N": float(np.abs(truth.f_el).max()),
        "zeros_of_u_gap": int(truth.zeros.size),
        "reference": f"Radau IIA collocation (tests/analytic.py) and {truth.second}",
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
    """Compile the shared right-hand side of a problem; s."""
    begin = time.perf_counter()
    rhs = compiled(problem)
    x, one = np.zeros(2), np.ones(1)
    rhs.rates(0.0, x, 0.0, 0.0)
    rhs.jacobian(0.0, x, 0.0, 0.0)
    rhs.observe(one, np.zeros((1, 2)))
    return time.perf_counter() - begin


def measure(
    problems: list[Problem],
    field: list[Contestant],
    versions: dict[str, str],
    repeats: int,
    limit: float,
    path: Path | None,
) -> Report:
    """Run everything, printing a line a point; what there is by then is written after every problem."""
    import fingerspice

    results: Report = {
        "machine": machine(), "versions": {**versions, "numpy": np.__version__, "fingerspice": fingerspice.__version__},
        "repeats": repeats, "limit_s": limit, "problems": {}, "points": [],
    }  # fmt: skip
    for problem in problems:
        truth = reference(problem)
        warm(problem)
        results["problems"][problem.name] = describe(problem, truth)
        print(f"{problem.name}: two references agree to {truth.agreement:.1e} of the peak", flush=True)
        for contestant in field:
            if problem.law == "mobile" and not contestant.mobile:
                continue
            for found in race(contestant, problem, truth, contestant.settings, repeats, limit):
                results["points"].append(found)
                print(line(found), flush=True)
        results["load_average"] = os.getloadavg()
        if path is not None:
            write(results, path)
    return results


def write(results: Report, path: Path) -> None:
    """Results as JSON, a point a line, numbers to five digits."""
    points = [
        json.dumps({k: float(f"{v:.5g}") if isinstance(v, float) else v for k, v in p.items()})
        for p in results["points"]
    ]
    head = json.dumps({**results, "points": []}, indent=1)
    assert head.count('"points": []') == 1
    path.write_text(head.replace('"points": []', '"points": [\n' + ",\n".join(points) + "\n]") + "\n", encoding="utf-8")


def line(found: Report) -> str:
    """A point as printed."""
    head = f"  {found['contestant']:28s} {found['setting']:8.1e}"
    if found["status"] != "ok":
        return f"{head}  {found['status']}"
    nfev = found["nfev_per_period"]
    count = "" if nfev is None else f"  {nfev:9.1f} evaluations"
    return f"{head}  error {found['error']:.1e}  {found['us_per_period']:10.1f} us{count}"


def quick(seconds: float = 5.0) -> list[Report]:
    """Every contestant that needs no compiler of its own, on two short problems at one setting; nothing is written."""
    field, _ = contestants(without=("diffrax", "torchdiffeq"))
    points = []
    for name, periods in (("sine_100Hz", 2), ("square_5kHz", 5)):
        problem = replace(by_name()[name], periods=periods)
        truth = reference(problem, second=False)
        for contestant in field:
            setting = QUICK_RTOL if contestant.adaptive else QUICK_STEPS
            points += race(contestant, problem, truth, (setting,), 1, seconds)
            print(line(points[-1]))
    return points


def main(arguments: list[str] | None = None) -> list[Report]:
    """Measure and, unless quick or a selection, write the results; returns the points."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two short problems, one setting each, nothing written")
    parser.add_argument("--repeats", type=int, default=REPEATS, help="runs per point; slow ones get fewer")
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds after which a run is given up")
    parser.add_argument("--problems", nargs="+", choices=list(by_name()), help="these only")
    parser.add_argument("--contestants", nargs="+", help="those whose names begin with one of these")
    parser.add_argument("--output", type=Path, help="file for the results")
    options = parser.parse_args(arguments)
    with warnings.catch_warnings():
        # Libraries warn of steps that they then repair or report; what they report is recorded.
        warnings.simplefilter("ignore")
        if options.quick:
            return quick()
        field, versions = contestants()
        if options.contestants:
            field = [c for c in field if c.name.startswith(tuple(options.contestants))]
        problems = [by_name()[name] for name in options.problems] if options.problems else [*LOCAL, *MOBILE]
        whole = not (options.problems or options.contestants)
        path = options.output or (RESULTS if whole else None)
        results = measure(problems, field, versions, options.repeats, options.limit, path)
    return list(results["points"])


if __name__ == "__main__":
    main()
