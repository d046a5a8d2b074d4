"""Every benchmark is run, so that it keeps working."""

import contextlib
import dataclasses
import importlib
import json
import shutil
import timeit
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.circuit.statespace import build_stack

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"


@pytest.fixture(autouse=True)
def _benchmarks_are_found(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))


def quick(name, **instead):
    """What a benchmark finds in its quick run, which writes nothing, with other values instead of some of its own."""
    before = {path: path.stat().st_mtime_ns for path in (FOLDER / "results").iterdir()}
    benchmark = importlib.import_module(name)
    with pytest.MonkeyPatch.context() as patch:
        # What the first run does, the next would do again.
        patch.setattr(benchmark, "median_seconds", lambda action, _: timeit.timeit(action, number=1), raising=False)
        for what, value in instead.items():
            patch.setattr(benchmark, what, value)
        found = benchmark.main(["--quick"])
    assert {path: path.stat().st_mtime_ns for path in (FOLDER / "results").iterdir()} == before
    return found


def test_run_times():
    results = quick("run_times")
    assert {row["deck"] for row in results["as_shipped"]} == {p.stem for p in FOLDER.parent.glob("circuits/*.cir")}
    assert all(row["error_over_peak"] <= row["rtol"] for row in results["as_shipped"])


def test_the_baseline_compares_with_itself():
    baseline = importlib.import_module("baseline")
    line = baseline.line
    # One of 600 pieces would take most of the time.
    results = quick("baseline", line=lambda pieces: line(pieces // 10))
    assert all(scene["status"] == "SUCCESS" and scene["calls"] > 0 for scene in results["scenes"].values())
    for row in results["times"]:
        assert all(row[method]["stated_error_over_peak"] <= 1e-6 for method in ("exponential", "auto"))
    # A scene is the same to the byte when it runs again; one whose figures moved is told.
    moved = json.loads(json.dumps(results))
    name = next(iter(moved["scenes"]))
    moved["scenes"][name]["digest"] = "another"
    told = baseline.compare(results, moved)
    assert [text.split(":")[0] for text in told if "digest" in text] == [name]


@pytest.fixture
def work_precision():
    return importlib.import_module("work_precision")


def test_every_contestant_is_as_right_as_its_setting_promises():
    points = quick("work_precision")
    assert {p["library"] for p in points} >= {"fingerspice", "scipy"}
    for point in points:
        assert point["status"] == "ok", point
        # Ours bounds the error of the result. The others bound each step's: what adds up was measured, 1.4e-8 to 2.3e-5
        # at 1e-6; ngspice's error follows its step.
        allowed = {"fingerspice": 1e-6, "ngspice": 2e-4}.get(point["library"], 5e-5)
        # On a stiff network DOP853's steps are as long as is stable, which leaves an error in what it interpolates.
        stiff = point["contestant"] == "scipy DOP853" and point["problem"].startswith("two_fingers")
        assert point["error"] <= (5e-4 if stiff else allowed), point


def test_results_are_kept_only_with_all_contestants(work_precision, monkeypatch, capsys):
    monkeypatch.setattr(work_precision, "contestants", lambda: ([], {"fingerspice": "0.1.0", "numbalsoda": "absent"}))
    with pytest.raises(SystemExit):
        work_precision.main([])
    assert "numbalsoda not installed" in capsys.readouterr().err


def test_the_peers_area_series_and_rates_are_the_packages_model(work_precision):
    problems = importlib.import_module("problems")
    right_hand_side = importlib.import_module("right_hand_side")
    for problem in (problems.by_name()["square_100Hz"], problems.by_name()["square_100Hz_mobile"]):
        stack = build_stack(problem.circuit())
        u_gap, f_el = right_hand_side.compiled(problem).observe(np.linspace(-200.0, 200.0, 41), np.zeros((41, 2)))
        np.testing.assert_allclose(f_el, stack.contact.stress(u_gap) * stack.contact.area(u_gap), rtol=2e-14)


def test_networks_are_solved_alike_by_three_formulations(work_precision):
    """Collocation from the paper's equations, the peers' rates, and the package from the netlist; both laws."""
    reference = importlib.import_module("reference")
    every = importlib.import_module("network_problems").every()
    for name in ("amplifier_square_100Hz_mobile", "two_fingers_sine_5kHz"):
        problem = dataclasses.replace(every[name], periods=1)
        truth = reference.reference(problem, second=False)
        u_gap, f_el, _ = reference._peers_way(problem, truth.zeros, truth.signs)
        assert max(truth.errors(u_gap, f_el)) <= 1e-11
        ours = fs.simulate(
            problem.circuit(), t_stop=problem.period, t_eval=problem.t_eval(1), rtol=1e-10, charge_law=problem.law
        )
        assert max(truth.errors(ours.u_gap, ours.f_el)) <= 1e-10


def test_the_pages_have_what_the_report_makes_of_the_results(tmp_path):
    results, docs = shutil.copytree(FOLDER / "results", tmp_path / "results"), FOLDER.parent / "docs"
    page, waits = (Path(shutil.copy(docs / name, tmp_path)) for name in ("speed.md", "proof.md"))
    given = ["--results", str(results / "work_precision.json"), "--page", str(page), "--waits", str(waits)]
    importlib.import_module("report").main(given)
    for written in (page, waits):
        assert written.read_text(encoding="utf-8") == (docs / written.name).read_text(encoding="utf-8")
    for picture in ("work_precision.png", "work_precision_networks.png"):
        assert (results / picture).stat().st_size > 0


def test_throughput_compares_the_same_response():
    results = quick("throughput")
    assert results["samples"]["difference_over_peak"] <= 1e-12, "the filter beside ours solves the same system"
    assert all(row["stated_error"] <= row["rtol"] for row in results["tolerances"])


def test_hard_cases_are_judged():
    results = quick("hard_cases")
    assert len(results["cases"]) == 3
    for case in results["cases"].values():
        assert case["tools"]["fingerspice"]["verdict"] == "right", case
    # A pulse that nobody declares falls between the steps of a solver that knows nothing of it.
    assert results["cases"]["undeclared"]["tools"]["scipy DOP853"]["verdict"] == "wrong silently"
    assert results["cases"]["parallel"]["tools"]["scipy DOP853"]["verdict"] == "n/a"
    assert "| the same, undeclared | ✓ | **wrong** |" in importlib.import_module("hard_cases").page(results)


def test_a_hard_case_is_right_only_with_the_right_answer_or_the_true_reason():
    judge = importlib.import_module("hard_cases").judge
    scenes = {scene.name: scene for scene in importlib.import_module("hard_scenes").SCENES}
    truth = (np.array([1.0, -2.0]), np.array([0.5, 1.0]))

    def verdict(name, found, tool="scipy DOP853"):
        return judge(scenes[name], tool, found, None if scenes[name].refusal else truth)["verdict"]

    def answer(scale):
        return "done", ((truth[0] * scale, truth[1] * scale), 0.1)

    assert verdict("stiff_coat", answer(1.0 + 9e-6)) == "right"
    assert verdict("stiff_coat", answer(1.0 + 2e-5)) == "wrong silently"
    assert verdict("stiff_coat", answer(1.0 + 2e-5), "ngspice") == "right"
    assert verdict("stiff_coat", answer(np.nan)) == "wrong silently"
    assert verdict("stiff_coat", ("failed", "step size too small")) == "failed with message"
    assert verdict("stiff_coat", ("hung", None)) == "hung"
    assert verdict("nan", answer(1.0)) == "wrong silently"
    assert verdict("nan", ("failed", "step size too small")) == "failed with message"
    assert verdict("nan", ("failed", "the source gave NaN at 3 ms")) == "right"


def test_batch_gradients_meet_their_errors():
    for row in quick("batch_gradients", REFERENCES=8)["rows"]:
        assert row["largest_error"] <= 10.0 * row["rtol"]
        assert row["largest_stated_error"] <= 10.0 * row["rtol"]
        assert row["n_ordinary"] == 0


def test_batches_meet_their_errors():
    checked = [row for row in quick("batch", REFERENCES=8)["rows"] if "largest_error" in row]
    assert {row["scenes"] for row in checked} == {"sine, narrow", "sine, wide"}
    assert {"fs.batch", "numba RK4, set-up not counted"} <= {row["who"] for row in checked}
    assert all(row["largest_error"] <= row["rtol"] for row in checked)
    rows = quick("batch_errors")["rows"]
    assert [row["periods"] for row in rows] == [0.5, 1, 5]
    assert all(row["off_over_asked"] <= 1.0 for row in rows)


@pytest.mark.usefixtures("forked_workers")
def test_sweeps_have_the_same_bytes_after_a_kill():
    results = quick("sweeps")
    assert {row["who"].split(",")[0] for row in results["rows"]} == {"memory", "store", "Sobol indices"}
    assert results["killed"]["same_bytes"]


def test_streaming_takes_every_sample(capsys):
    points = quick("streaming")
    assert [point["rtol"] for point in points] == [1e-4, 1e-6]
    assert all(point["samples"] == 2 * 48_000 + 1 for point in points)
    assert "times real time" in capsys.readouterr().out


def test_the_coverage_of_fits():
    results = quick("fit_coverage")
    assert set(results["coverage"]) == {"given", "equal", "shares", "contact"}
    assert results["named"]["gap and alpha at one voltage and frequency"] == results["named"]["of"]
    assert results["named"]["gap and resistance at several"] == 0


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Chromium")
def test_the_explorers_figures_are_measured_and_the_page_has_those_of_the_file():
    pytest.importorskip("playwright.sync_api", reason="needs Playwright for Python")
    explorer = importlib.import_module("explorer")
    # One server for all three measurements.
    with explorer.serving() as served:
        results = quick("explorer", serving=lambda: contextlib.nullcontext(served))
    assert all(0.0 < median <= late for median, late in results["event_ms"].values())
    assert list(results["memory_MB"]) == ["1", "10", "50", "100"]
    assert explorer.table(json.loads(explorer.RESULTS.read_text())) in explorer.PAGE.read_text()
