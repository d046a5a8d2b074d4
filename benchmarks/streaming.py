"""Streams of long recordings: time per sample, memory, and the time for writing a store.

Noise at 48 kHz in a WAV file of 16 bits drives Table 1's stack. `fs.stream` reads the file piece by piece and gives gap
voltage and force at every sample, in chunks of 10 s; each case runs in a process of its own, which reports its peak
memory. The same run is then written to a Zarr store by `fingerspice run --stream`, if the package zarr is installed.

Run: python benchmarks/streaming.py [--quick]. Minima of 3, compile time apart; writes results/streaming.json.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import wavfile

import fingerspice as fs
from recordings import CIRCUITS, RATE, noise, stack

HERE = Path(__file__).resolve().parent
BANDS, RTOLS, HOUR = (1_000.0, 8_000.0), (1e-4, 1e-6), 3600.0
Report = dict[str, Any]


def recording(path: Path, seconds: float, high: float) -> Path:
    """A WAV file with a minute of noise up to `high` (Hz), repeated."""
    minute = np.round(32767.0 / 200.0 * noise(int(min(seconds, 60.0) * RATE), high)).astype(np.int16)
    wavfile.write(path, int(RATE), np.resize(minute, int(seconds * RATE) + 1))
    return path


def case(path: str, seconds: float, rtol: float) -> Report:
    """Time of one stream, and the peak memory of this process."""
    warnings.simplefilter("ignore", fs.FingerspiceWarning)
    samples = fs.Samples.from_wav(path, 200.0, at_once=False)
    count, circuit = 0, stack("SKIN")
    # A first short stream loads the compiled code.
    next(fs.stream(circuit, sources=samples, t_stop=1.0, rtol=rtol, charge=False, start="uncharged")).f_el  # noqa: B018
    begin = time.perf_counter()
    stream = fs.stream(circuit, sources=samples, t_stop=seconds, rtol=rtol, charge=False, start="uncharged")
    for chunk in stream:
        assert chunk.u_gap is not None
        assert chunk.f_el is not None
        count += chunk.t.size
    took = time.perf_counter() - begin
    # VmHWM is the peak of this process alone, while `ru_maxrss` includes memory of the parent before the fork.
    own = Path("/proc/self/status")
    line = next((x for x in own.read_text().splitlines() if x.startswith("VmHWM")), "") if own.exists() else ""
    most = 1024 * int(line.split()[1]) if line else 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"samples": count, "ns_per_sample": 1e9 * took / count, "bytes": most}


def apart(path: Path, seconds: float, rtol: float) -> Report:
    """Run `case` in a process of its own."""
    command = [sys.executable, str(Path(__file__).resolve()), "--case", str(path), repr(seconds), repr(rtol)]
    found: Report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return found


def stored(path: Path, seconds: float, rtol: float) -> Report:
    """Run the command that writes a store: its total time (s), and the bytes written."""
    deck, folder = str(CIRCUITS / "fingerpad.cir"), path.parent / "out"
    begin = time.perf_counter()
    command = [sys.executable, "-m", "fingerspice", "run", deck, "--source", f"WAV({path} gain=200)", "--stream"]
    command += ["--stop", repr(seconds), "--rtol", repr(rtol), "--out", str(folder), "--overwrite"]
    subprocess.run(command, check=True, capture_output=True)
    took = time.perf_counter() - begin
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return {"seconds": seconds, "took": took, "times_real_time": seconds / took, "bytes": size}


def main(arguments: list[str] | None = None) -> list[Report]:
    """Measure, print and write; the points, one for each recording and tolerance."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--quick", action="store_true", help="short recordings, one run each, nothing written")
    parser.add_argument("--case", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.case:
        print(json.dumps(case(given.case[0], *map(float, given.case[1:]))))
        return []
    bands, lengths, repeats = (BANDS[:1], (2.0,), 1) if given.quick else (BANDS, (60.0, 600.0), 3)
    points: list[Report] = []
    with tempfile.TemporaryDirectory() as folder:
        for high in bands:
            for seconds in lengths:
                path = recording(Path(folder) / "noise.wav", seconds, high)
                for rtol in RTOLS:
                    found = min((apart(path, seconds, rtol) for _ in range(repeats)), key=lambda x: x["ns_per_sample"])
                    points.append({"band_Hz": high, "seconds": seconds, "rtol": rtol, **found})
                    hour = 1e-9 * found["ns_per_sample"] * HOUR * RATE
                    print(
                        f"to {high:g} Hz, {seconds:g} s at {rtol:g}: {found['ns_per_sample']:.1f} ns a sample, "
                        f"{hour:.1f} s an hour, {found['bytes'] / 1e6:.0f} MB"
                    )
        written = None
        if importlib.util.find_spec("zarr") is not None:
            written = min((stored(path, lengths[-1], 1e-4) for _ in range(repeats)), key=lambda x: x["took"])
            print(
                f"with a store of {written['bytes'] / 1e6:.0f} MB: {written['took']:.1f} s for {lengths[-1]:g} s, "
                f"{written['times_real_time']:.0f} times real time"
            )
    if not given.quick:
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=HERE, capture_output=True, text=True, check=False
        ).stdout.strip()
        machine = {
            "processor": platform.machine(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
            "commit": commit,
        }
        report = {"machine": machine, "points": points, "store": written}
        (HERE / "results" / "streaming.json").write_text(json.dumps(report, indent=1) + "\n")
    return points


if __name__ == "__main__":
    main()
