"""The explorer's speed: from a slider's event to new traces in a browser, and from the command to the first picture.

    python benchmarks/explorer.py

It needs Playwright for Python and Chromium. Five periods of Table 1, 2,000 points, 300 moves of a slider.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time

import numpy as np
from playwright.sync_api import sync_playwright

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


def main() -> None:
    """Print the times."""
    begin = time.perf_counter()
    words = [sys.executable, "-m", "fingerspice", "explore", "--no-browser", "--json"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process, sync_playwright() as playwright:
        assert process.stdout is not None
        text = ""
        while not text.endswith("}\n"):
            text += process.stdout.readline()
        ready = time.perf_counter() - begin
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 1000})
        begin = time.perf_counter()
        page.goto(json.loads(text)["url"])
        page.wait_for_selector("body[data-answers]", timeout=120_000)
        first = time.perf_counter() - begin
        # The sweep over frequencies is done by then.
        page.wait_for_timeout(5000)
        page.evaluate(MOVES, 30)
        drawn, shown, told = page.evaluate(MOVES, 300)
        print(f"command to server {ready:.2f} s, page to first picture {first:.2f} s")
        for what, times in (("new traces drawn", drawn), ("next frame begun", shown), ("figures shown", told)):
            median, late = np.percentile(times, [50, 99])
            print(f"event to {what}: median {median:.1f} ms, 99th percentile {late:.1f} ms")
        browser.close()
        process.terminate()


if __name__ == "__main__":
    main()
