"""The explorer's figures: a slider's event to new traces in a browser, the command to the first picture, and memory.

Run: python benchmarks/explorer.py [--quick]. It needs Playwright for Python and Chromium. Five periods of Table 1,
2,000 points, 300 moves of a slider. Writes results/explorer.json and the table between the markers of docs/explore.md.
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright

from baseline import revision
from fingerspice.explorer import pages
from fingerspice.explorer.scene import EXAMPLES

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "explorer.json"
PAGE = HERE.parent / "docs" / "explore.md"
BEGIN, END = "<!-- figures:begin -->", "<!-- figures:end -->"
REQUESTS = 10_000
COLD = 5

#: Moves the slider of the gap's height; times until the traces are drawn, until the frame after them, and until the
#: figures are there, too.
MOVES = """async (count) => {
  const slider = document.querySelector('input[type=range][data-path="Xgap.d"]');
  const changed = (name) => new Promise((done) => new MutationObserver((_, observer) => {
    observer.disconnect();
    done(performance.now());
  }).observe(document.body, { attributes: true, attributeFilter: [name] }));
  const drawn = [], shown = [], told = [];
  for (let i = 0; i < count; i += 1) {
    slider.value = 300 + (i % 300);
    const figures = changed("data-figures");
    const traces = changed("data-answers").then((now) => {
      drawn.push(now - begin);
      return new Promise((done) => requestAnimationFrame(() => done(performance.now())));
    });
    const begin = performance.now();
    slider.dispatchEvent(new Event("input", { bubbles: true }));
    shown.push((await traces) - begin);
    told.push((await figures) - begin);
    await new Promise((done) => setTimeout(done, 10));
  }
  return [drawn, shown, told];
}"""


@contextlib.contextmanager
def serving() -> Iterator[tuple[str, int, float]]:
    """The command, running: the page's link, the process, and the time until its link was printed, s."""
    begin = time.perf_counter()
    words = [sys.executable, "-m", "fingerspice", "explore", "--no-browser", "--json"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        said = ""
        while not said.endswith("}\n"):
            said += process.stdout.readline()
        yield json.loads(said)["url"], process.pid, time.perf_counter() - begin
        process.terminate()


def first_pictures(browser: Any, count: int) -> list[float]:
    """Times from the command to the first traces, s, the browser being open and the compiler's cache warm."""
    found = []
    for _ in range(count):
        with serving() as (url, _, ready):
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            begin = time.perf_counter()
            page.goto(url)
            page.wait_for_selector("body[data-answers]", timeout=120_000)
            found.append(ready + time.perf_counter() - begin)
            page.close()
    return found


def moved(browser: Any, count: int) -> dict[str, list[float]]:
    """Times from an event to what follows from it, ms, by what it is."""
    with serving() as (url, _, _):
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(url)
        page.wait_for_selector("body[data-figures]", timeout=120_000)
        if count > 10:
            # The sweep over frequencies is done by then.
            page.wait_for_timeout(5000)
            page.evaluate(MOVES, 30)
        times = page.evaluate(MOVES, count)
        page.close()
    return dict(zip(("traces drawn", "next frame begun", "figures shown"), times, strict=True))


def memory(count: int) -> dict[str, float]:
    """Resident memory, MB, after some of the requests that a moving slider makes, by their number."""
    found: dict[str, float] = {}
    with serving() as (url, process, _):
        _, _, host, token, _ = url.split("/")
        with contextlib.closing(http.client.HTTPConnection(host)) as connection:
            for i in range(count + 1):
                request = {"deck": EXAMPLES[0]["request"]["deck"], "overrides": {"Xgap.d": 3e-6 + 1e-10 * i}, "last": 2}
                connection.request("POST", f"/{token}/scene", json.dumps(request))
                connection.getresponse().read()
                if i in (count // 100, count // 10, count // 2, count):
                    status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
                    found[str(i)] = int(status.partition("VmRSS:")[2].split()[0]) / 1024.0
    return found


def table(results: dict[str, Any]) -> str:
    """The results as Markdown."""
    rows = ["| figure | median | 99th percentile |", "|---|---|---|"]
    for what, (median, late) in results["event_ms"].items():
        rows.append(f"| from a slider's event to {what} | {median:.1f} ms | {late:.1f} ms |")
    rows.append(
        f"| from the command to the first picture, of {COLD} | {np.median(results['first_picture_s']):.1f} s | |"
    )
    by_count = ", ".join(f"{size:.0f} MB after {int(n):,}" for n, size in results["memory_MB"].items())
    return "\n".join(
        [
            *rows, "",
            f"Memory over the requests of a moving slider: {by_count}. The page's files have "
            f"{results['files_bytes'] / 1000:.0f} kB.",
            f"Measured by `benchmarks/explorer.py` on {results['machine']}, {results['browser']}, commit "
            f"{results['revision']}.",
        ]
    )  # fmt: skip


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Measure, print and, unless quick, write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few moves and requests, nothing written")
    quick = parser.parse_args(arguments).quick
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        version = f"Chromium {browser.version}"
        if not quick:
            first_pictures(browser, 1)
        cold = first_pictures(browser, 1 if quick else COLD)
        times = moved(browser, 10 if quick else 300)
        browser.close()
    results = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "browser": version,
        "revision": revision(),
        "event_ms": {what: list(np.percentile(of, [50, 99])) for what, of in times.items()},
        "first_picture_s": cold,
        "memory_MB": memory(100 if quick else REQUESTS),
        "files_bytes": sum(map(len, pages().values())),
    }
    print(table(results))
    if not quick:
        RESULTS.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
        before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
        PAGE.write_text(f"{before}{BEGIN}\n{table(results)}\n{END}{rest.partition(END)[2]}", encoding="utf-8")
    return results


if __name__ == "__main__":
    main()
