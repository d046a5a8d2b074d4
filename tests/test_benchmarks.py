"""Every benchmark is run, so that none rots."""

from __future__ import annotations

import importlib.util
from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"


def test_run_times_runs_and_writes_nothing_when_quick(capsys):
    written = FOLDER / "results" / "run_times.json"
    before = written.stat().st_mtime_ns
    spec = importlib.util.spec_from_file_location("run_times", FOLDER / "run_times.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    results = module.main(["--quick"])
    assert {row["deck"] for row in results["ten_periods"]} == {p.stem for p in FOLDER.parent.glob("circuits/*.cir")}
    assert all(row["error_over_peak"] <= row["rtol"] for row in results["ten_periods"])
    assert written.stat().st_mtime_ns == before
