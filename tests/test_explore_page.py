"""The explorer's page in a real browser; skipped where Playwright or Chromium is missing."""

import shutil
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.explorer import static_page
from fingerspice.explorer.scene import EXAMPLES
from scenes import CIRCUITS

playwright = pytest.importorskip("playwright.sync_api", reason="needs Playwright for Python")
CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
SINE = fs.parse_netlist(EXAMPLES[0]["request"]["deck"])


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as started:
        yield started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])


class Page:
    """A page with its errors, and what it asked for."""

    def __init__(self, browser: Any, url: str) -> None:
        self.page = browser.new_context(accept_downloads=True).new_page()
        self.errors: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda e: self.errors.append(str(e)))
        self.page.on("request", lambda r: self.asked.append(r.url))
        self.page.goto(url)
        self.page.wait_for_selector("body[data-figures]", timeout=120_000)

    def answers(self) -> int:
        return int(self.page.get_attribute("body", "data-figures"))

    def after(self, change: Any) -> None:
        """Make a change, and wait for the answer to it."""
        before = self.answers()
        change()
        self.page.wait_for_selector(f'body:not([data-figures="{before}"])', timeout=60_000)
        self.page.wait_for_timeout(100)

    def typed(self, path: str, text: str) -> None:
        field = self.page.locator(f'input[type=text][data-path="{path}"]')
        field.fill(text)
        self.after(lambda: field.press("Enter"))

    def shown(self, signal: str) -> list[str]:
        """The figures of a signal as the page writes them."""
        return self.page.locator("#figures tr", has_text=signal).locator("td").all_inner_texts()[1:]  # type: ignore[no-any-return]

    def force(self) -> str:
        return self.shown("electroadhesive force")[1]

    def status(self) -> str:
        return self.page.inner_text("#status")  # type: ignore[no-any-return]

    def close(self) -> None:
        assert self.errors == []
        self.page.context.close()


def mean(circuit: fs.Circuit, **how: Any) -> str:
    """The mean force in the periodic state as the page writes it."""
    return f"{float(f'{1e3 * fs.simulate(circuit, rtol=1e-6, **how).f_el_mean_periodic:.5g}')} mN"


@pytest.fixture
def page(browser: Any, explorer: fs.Explorer) -> Iterator[Page]:
    opened = Page(browser, explorer.url)
    yield opened
    opened.close()


def test_the_page_shows_what_simulate_gives_and_asks_nobody_else(page: Page, explorer: fs.Explorer) -> None:
    assert page.force() == mean(SINE)
    page.typed("Xgap.d", "4.2u")
    assert page.force() == mean(SINE.replace({"Xgap.d": 4.2e-6}))
    assert page.page.locator("#plots canvas").count() == 4
    assert all(url.startswith((explorer.url, "data:")) for url in page.asked)
    field = page.page.locator('input[type=text][data-path="Xgap.d"]')
    field.fill("3,5u")
    field.press("Enter")
    assert page.status() == 'Xgap.d is "3,5u"; allowed: a number such as 3.5u, 0.2meg, 1e-6 or inf'
    page.typed("Xgap.d", "4um")
    assert page.force() == mean(SINE.replace({"Xgap.d": 4e-6}))


def test_nothing_on_the_page_shuts_anybody_out_and_what_is_saved_is_what_is_shown(page: Page, tmp_path: Path) -> None:
    for button, name in (("#csv", "a.csv"), ("#png", "a.png"), ("#deck", "a.cir")):
        with page.page.expect_download() as download:
            page.page.click(button)
        download.value.save_as(tmp_path / name)
    head, *rows = (tmp_path / "a.csv").read_text().splitlines()
    assert head == "t (s),u_source (V),u_gap (V),f_el (N),area (m^2),friction (1)"
    assert len(rows) == 2000
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert "Vdrive drive 0 SIN(" in (tmp_path / "a.cir").read_text()
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    found = axe.Axe().run(page.page).response
    assert len(found["passes"]) > 20
    assert [one["help"] for one in found["violations"] if one["impact"] in ("serious", "critical")] == []


def test_every_slider_of_the_first_scene_moves_the_figures(page: Page) -> None:
    sliders = page.page.locator("#sliders > fieldset > .slider input[type=range]")
    names = [sliders.nth(i).get_attribute("data-path") for i in range(sliders.count())]
    assert {"Vdrive.amplitude", "Vdrive.frequency", "Xgap.d", "Xgap.fn", "Xcoat.r", "Xskin.d"} <= set(names)
    for name in names:
        before = page.page.inner_text("#figures")
        slider = page.page.locator(f'input[type=range][data-path="{name}"]')
        slider.focus()
        page.after(lambda: page.page.keyboard.press("PageUp"))
        assert page.page.inner_text("#figures") != before, name


def test_a_link_restores_the_scene_elsewhere_and_says_what_it_does_not_know(page, browser, explorer):
    page.typed("Xgap.d", "4u")
    page.after(lambda: page.page.select_option("#kind", "SQUARE"))
    page.after(lambda: page.page.select_option("#charge_law", "mobile"))
    page.page.wait_for_timeout(500)
    figures = page.page.inner_text("#figures")
    other = Page(browser, f"{page.page.url}&bar=1&set.Xgpa.d=3u")
    assert other.page.inner_text("#figures") == figures
    assert other.page.input_value("#source") == "SQUARE(200 100 0.5)"
    said = other.page.inner_text("#warnings")
    assert 'unknown name "bar"' in said
    assert "unknown parameter 'Xgpa.d', which is left out; nearest: 'Xgap.d'" in said
    other.close()


def test_a_fold_shows_its_sentence_and_keeps_the_last_good_traces(page: Page) -> None:
    page.after(lambda: page.page.select_option("#charge_law", "mobile"))
    page.typed("Xgap.d", "30n")
    assert "no solution" in page.status()
    assert "source voltage, before" in page.page.inner_text("#plots")
    # So are the panels that belong to them.
    grey = """(parts) => parts.map((part) => getComputedStyle(document.querySelector(part)).filter)"""
    assert page.page.evaluate(grey, [".three", "#figures"]) == ["grayscale(1)"] * 2
    page.typed("Xgap.d", "4u")
    assert "before" not in page.page.inner_text("#plots")
    assert page.page.evaluate(grey, [".three", "#figures"]) == ["none"] * 2
    assert page.status().startswith("Table 1")
    # A scene that fails at once shows its run until then, and nothing of the scene before.
    page.page.wait_for_selector("#means canvas")
    page.after(lambda: page.page.select_option("#scene", "fold"))
    assert "no solution" in page.status()
    assert page.page.locator("#plots canvas").count() == 4
    assert "before" not in page.page.inner_text("#plots")
    parts = ("stack", "harmonics", "means", "figures", "facts")
    assert [part for part in parts if page.page.inner_text(f"#{part}")] == []
    page.after(lambda: page.page.select_option("#scene", "sine"))
    assert "load" in page.page.inner_text("#sliders")
    assert page.shown("gap voltage")


def test_pinned_traces_stay_with_the_difference_and_all_are_seen_at_once(page: Page) -> None:
    page.page.click("#pin")
    page.typed("Xgap.d", "4u")
    assert "gap voltage, pinned" in page.page.inner_text("#plots")
    lines = page.page.locator("#plots .panel").first.locator(".u-series:not(:first-child) .u-marker")
    shape = "(marker) => { const s = getComputedStyle(marker); return [s.borderTopStyle, s.height]; }"
    # A sample of each line: a square of dashes would look like one of lines.
    assert [marker.evaluate(shape) for marker in lines.all()] == [["solid", "2px"]] * 2 + [["dashed", "2px"]] * 2
    a, b = (fs.simulate(SINE.replace({"Xgap.d": d}), rtol=1e-6).f_el_mean for d in (3.5e-6, 4e-6))
    assert page.shown("electroadhesive force")[-1] == f"{100 * (b / a - 1):.2f} %"
    # All traces and the first sliders are seen at once.
    seen = """(selectors) => selectors.every((one) => {
      const box = document.querySelector(one).getBoundingClientRect();
      return box.top >= 0 && box.bottom <= innerHeight && box.left >= 0 && box.right <= innerWidth;
    })"""
    sliders = [f'input[data-path="{path}"]' for path in ("Vdrive.amplitude", "Xgap.d", "Xgap.fn", "Xcoat.d", "Xskin.d")]
    for width, height in ((1280, 800), (1920, 1080)):
        page.page.set_viewport_size({"width": width, "height": height})
        page.page.wait_for_timeout(300)
        assert page.page.evaluate(seen, ["#drop", "#kind", "#plots", *sliders])
        # With pinned traces the table has most columns.
        assert page.page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_the_mean_force_says_of_which_sine_it_is_and_the_waveforms_text_follows_the_scene(page: Page) -> None:
    page.page.wait_for_selector("#means canvas")
    assert page.page.inner_text("#means h2") == "mean force of a sine of 200 V against its frequency"
    page.after(lambda: page.page.select_option("#kind", "SQUARE"))
    said = "mean force of a sine of 254.6 V, the source's fundamental, against its frequency"
    page.page.wait_for_function("(said) => document.querySelector('#means h2')?.textContent === said", arg=said)
    assert 4.0 / np.pi * 200.0 == pytest.approx(254.6, abs=0.05)
    # Another scene has nothing of the one before.
    page.after(lambda: page.page.select_option("#scene", "chirp"))
    assert "254.6 V" not in page.page.inner_text("#means")
    page.after(lambda: page.page.select_option("#scene", "sine"))
    source = page.page.locator("#source")
    assert source.get_attribute("placeholder") == "SIN(0 200 100)"
    page.typed("Vdrive.amplitude", "150")
    assert source.get_attribute("placeholder") == "SIN(0 150 100)"
    source.fill("SQUARE(120 50)")
    page.after(lambda: source.press("Enter"))
    assert page.page.input_value("#kind") == "SQUARE"
    # The field has the focus still, and is not being typed in.
    page.after(lambda: page.page.evaluate("document.querySelector('#reset').click()"))
    assert (page.page.input_value("#source"), page.page.input_value("#kind")) == ("", "")
    assert source.get_attribute("placeholder") == "SIN(0 200 100)"
    source.type("SQ")
    page.after(lambda: page.page.evaluate("document.querySelector('#area').dispatchEvent(new Event('change'))"))
    assert page.page.input_value("#source") == "SQ"


def test_sets_of_the_menu_have_caveats_and_the_link_has_their_values(page: Page, browser: Any) -> None:
    for name in ("moist", "Fig4-5kHz"):
        page.after(lambda name=name: page.page.select_option("#apply", name))
    moist = fs.parameters("moist")
    expected = mean(fs.parameters("Fig4-5kHz").apply(moist.apply(SINE)), t_stop=1e-3)
    assert page.force() == expected
    assert moist.not_claimed in page.page.inner_text("#sets")
    assert "Assumed, not published: gap.r, gap.mu." in page.page.inner_text("#sets")
    assert page.page.input_value("#source") == "SIN(0 200 5k)"
    page.page.wait_for_timeout(500)
    other = Page(browser, page.page.url)
    assert other.force() == expected
    assert other.page.inner_text("#sets") == page.page.inner_text("#sets")
    other.close()
    page.typed("Xgap.r", "0.3meg")
    assert "Changed since: Xgap.r." in page.page.inner_text("#sets")
    page.after(lambda: page.page.click("#reset"))
    assert page.page.inner_text("#sets") == ""
    assert page.page.input_value("#source") == ""


def test_traces_follow_a_slider_while_it_moves_and_the_last_place_is_shown(page: Page) -> None:
    counts = page.page.evaluate("""async () => {
      const slider = document.querySelector('input[type=range][data-path="Xgap.d"]');
      const answers = () => Number(document.body.dataset.answers);
      const before = answers();
      for (let i = 0; i < 60; i += 1) {
        slider.value = 400 + i;
        slider.dispatchEvent(new Event("input", { bubbles: true }));
        await new Promise((done) => setTimeout(done, 4));
      }
      const during = answers() - before;
      await new Promise((done) => setTimeout(done, 1500));
      return [during, answers() - before];
    }""")
    # Answers come while it moves, and there are fewer requests than events.
    assert 2 <= counts[0] <= counts[1] < 60
    shown = page.page.input_value('input[type=text][data-path="Xgap.d"]')
    assert page.force() == mean(SINE.replace({"Xgap.d": shown}))


def test_a_recording_is_taken_and_a_wrong_file_refused(page: Page, tmp_path: Path) -> None:
    page.after(lambda: page.page.set_input_files("#file", CIRCUITS / "texture.wav"))
    assert page.page.input_value("#source") == "RECORDING(150)"
    wave = fs.Samples.from_wav(CIRCUITS / "texture.wav", 150.0)
    assert page.shown("source voltage")[3] == f"{float(f'{wave.values.max():.5g}'):g} V"
    page.after(lambda: page.page.select_option("#scene", "square"))
    dropped = """(bytes) => {
      const data = new DataTransfer();
      data.items.add(new File([Uint8Array.from(bytes)], "texture.wav"));
      document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
    }"""
    page.after(lambda: page.page.evaluate(dropped, list((CIRCUITS / "texture.wav").read_bytes())))
    assert page.shown("source voltage")[3] == f"{float(f'{wave.values.max():.5g}'):g} V"
    (tmp_path / "wrong.csv").write_text("t,u\n0,1\n1,x\n")
    page.page.set_input_files("#file", tmp_path / "wrong.csv")
    page.page.wait_for_selector("#status.failed")
    assert page.status() == "wrong.csv, row 3: allowed: two numbers, time in s and voltage in V"


def test_the_static_page_shows_its_scenes_from_the_disk(browser: Any, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(static_page())
    opened = Page(browser, (tmp_path / "page.html").as_uri())
    assert opened.force() == mean(SINE)
    opened.after(lambda: opened.page.select_option("#scene", "two-fingers"))
    assert opened.status().startswith("Two fingers")
    assert opened.page.locator("#sliders input[type=range]").first.is_disabled()
    assert all(url.startswith(("file:", "data:")) for url in opened.asked)
    opened.close()


class Notebook(BaseHTTPRequestHandler):
    """A page that holds what a notebook's cell shows, and an explorer that no notebook asked for."""

    body = b""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", str(len(self.body)))
        self.end_headers()
        self.wfile.write(self.body)

    def log_message(self, format: str, *args: Any) -> None:
        pass


def test_a_page_of_this_computer_shows_the_explorer_in_a_frame_where_a_notebook_asked_for_it(browser: Any) -> None:
    framed, alone = fs.Explorer(SINE, framed=True), fs.Explorer(SINE)
    Notebook.body = f"{framed._repr_html_()}<iframe src='{alone.url}' id='refused'></iframe>".encode()
    page = browser.new_context().new_page()
    answer = page.goto(alone.url.replace(alone.token, ""))
    assert (answer.status, "token" in page.inner_text("body")) == (403, True)
    server = ThreadingHTTPServer(("127.0.0.1", 0), Notebook)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        for host in ("localhost", "127.0.0.1"):
            page.goto(f"http://{host}:{server.server_port}/")
            shown, refused = page.frame_locator("iframe[title]"), page.frame_locator("#refused")
            shown.locator("body[data-answers]").wait_for(timeout=60_000, state="attached")
            assert shown.locator("input[data-path='Xgap.d']").count() > 0
            assert refused.locator("input[data-path]").count() == 0
        page.goto(f"http://elsewhere.localhost:{server.server_port}/")
        page.wait_for_timeout(2000)
        assert page.frame_locator("iframe[title]").locator("input[data-path]").count() == 0
    finally:
        for running in (framed, alone):
            running.stop()
        server.shutdown()
        server.server_close()
