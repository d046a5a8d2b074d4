"""The explorer: its scenes equal `fs.simulate`, its server answers whom it may, and nothing makes it stumble."""

import base64
import contextlib
import http.client
import io
import json
import os
import re
import signal
import struct
import subprocess
import sys
import time
import urllib.parse
import urllib.request
import warnings
import wave
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fingerspice as fs
from commands import Command
from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.devices import DEVICES
from fingerspice.explorer import MOST_BYTES, Explorer, pages
from fingerspice.explorer.request import LONGEST_DECK, MOST_POINTS, POINTS, WAVEFORMS
from fingerspice.explorer.scene import EXAMPLES, as_deck, as_python, scene
from scenes import DECKS, cases, heard, listed, quietly, refuses

ROOT = Path(__file__).parents[1]
SINE = EXAMPLES[0]["request"]["deck"]
BY_NAME = {e["name"]: e["request"] for e in EXAMPLES}
OWN = (DECKS / "own.cir").read_text()


def packed(values: list[float]) -> str:
    return base64.b64encode(np.array(values, "<f8").tobytes()).decode()


TWO = packed([1.0, 2.0])


def recorded(recording: Any) -> dict[str, Any]:
    """A request whose source is a recording."""
    return {"deck": SINE, "source": "RECORDING(150)", "recording": recording}


def asked(explorer: Explorer, what: str, body: bytes | None, **headers: str) -> tuple[int, dict[str, Any]]:
    """Status and answer of one request below the token, whether refused or not, with all its parts."""
    return raw(explorer, "GET" if body is None else "POST", f"/{explorer.token}/{what}", body, **headers)


def raw(
    explorer: Explorer, method: str, path: str, body: bytes | None = None, **headers: str
) -> tuple[int, dict[str, Any]]:  # fmt: skip
    """Status and answer of one request; of a file of the page only its length."""
    connection = http.client.HTTPConnection("127.0.0.1", explorer.port, timeout=60)
    connection.request(method, path, body, {key.replace("_", "-"): value for key, value in headers.items()})
    answer = connection.getresponse()
    content, kind = answer.read(), str(answer.headers["Content-Type"])
    connection.close()
    if kind.startswith("application/octet-stream"):
        return answer.status, unframed(content)
    return answer.status, json.loads(content) if kind.startswith("application/json") else {"length": len(content)}


def unframed(content: bytes) -> dict[str, Any]:
    """The parts of an answer: two sizes, JSON, and the arrays whose places among all doubles the JSON has."""
    found: dict[str, Any] = {}
    while content:
        length, doubles = struct.unpack("<II", content[:8])
        end = 8 + length + 8 * doubles
        numbers = np.frombuffer(content[8 + length : end], "<f8")
        assert numbers.size == doubles

        def place(x: dict[str, Any], numbers: FloatArray = numbers) -> Any:
            return numbers[x["f64"][0] :][: x["f64"][1]] if "f64" in x else x

        found |= json.loads(content[8 : 8 + length], object_hook=place)
        content = content[end:]
    return found


def baked(page: str) -> Any:
    """The data of a page without a server."""
    found = re.search(r'<script type="text/plain" id="baked">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return unframed(base64.b64decode(found[1]))


def run_as_python(request: dict[str, Any], own: fs.Circuit | None = None) -> fs.Solution:
    names: dict[str, Any] = {}
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exec(as_python(request, own), names)
    solution = names["solution"]
    assert isinstance(solution, fs.Solution)
    return solution


def post(explorer: Explorer, request: Any, what: str = "scene") -> dict[str, Any]:
    status, answer = asked(explorer, what, json.dumps(request).encode())
    assert status == 200
    return answer


def refused(status: int, answer: dict[str, Any], expected: int, *words: str) -> None:
    assert status == expected
    assert answer["ok"] is False
    for word in words:
        assert word in answer["message"]


def test_the_values_of_a_scene_are_those_of_simulate(explorer: Explorer) -> None:
    request = {
        "deck": SINE, "overrides": {"Xgap.d": "4u", "xgap.fn": 0.7}, "source": "SQUARE(150 200)", "rtol": 1e-7,
        "charge_law": "mobile", "periods": 3, "last": 2,
    }  # fmt: skip
    answer = post(explorer, request)
    assert answer["ok"], answer["message"]
    t = answer["t"]
    assert t.size == POINTS
    np.testing.assert_allclose(t, np.linspace(5e-3, 15e-3, POINTS), rtol=1e-14)
    circuit = fs.parse_netlist(SINE).replace({"Xgap.d": 4e-6, "Xgap.fn": 0.7})
    how = {"charge_law": "mobile", "rtol": 1e-7, "t_stop": 15e-3, "t_eval": t, "charge": False}
    expected = quietly(fs.simulate, circuit, sources=fs.Square(150.0, 200.0), **how)
    signals = {trace["name"]: trace["values"] for trace in answer["traces"]}
    assert set(signals) == {"u_source", "u_gap", "f_el", "area", "friction"}
    for name, values in signals.items():
        np.testing.assert_array_equal(values, getattr(expected, name))
    assert answer["error"]["u_gap"] == expected.error.u_gap
    figures = {row["name"]: row for row in answer["figures"]}
    assert figures["f_el"]["mean_periodic"] == expected.f_el_mean_periodic
    (stack,) = answer["stacks"]
    assert (stack["gap"], [layer["d"] for layer in stack["layers"]]) == ("Xgap", [1e-6, 4e-6, 350e-6])
    for layer, column in zip(stack["layers"], expected.u_layer.T, strict=True):
        np.testing.assert_array_equal(layer["values"], column)
    (friction,) = answer["harmonics"]
    lines = expected.spectrum("f_t", highest=20 * 200.0)
    np.testing.assert_allclose(friction["frequency"], lines.frequency)
    np.testing.assert_allclose(friction["amplitude"], lines.amplitude)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda e: e["name"])
def test_every_example_shows_what_it_promises(example: Any) -> None:
    answer = scene(example["request"])
    if example["name"] == "fold":
        assert (answer["ok"], answer["status"]) == (False, "FOLD")
        assert "no solution" in answer["message"]
        assert 0.0 < answer["failed_at"] < 1e-3
        assert answer["sliders"]
        # It fails before the periods that are shown, so that all there is of it is shown instead.
        shown = scene({**example["request"], "last": 2})
        assert shown["status"] == "FOLD"
        assert shown["t"].size > POINTS // 2
        assert 0.99 * answer["failed_at"] < shown["t"][-1] <= answer["failed_at"]
        return
    assert answer["ok"], answer["message"]
    assert answer["warnings"] == []
    assert answer["unknown"] == []
    names = {trace["signal"] for trace in answer["traces"]}
    assert names == {"u_source", "u_gap", "f_el", "area", "friction"}
    assert all(trace["values"].shape == answer["t"].shape for trace in answer["traces"])
    assert answer["t"].size >= POINTS
    # No peak is missed between the points of the source's curve.
    shown, largest = np.abs(answer["traces"][0]["values"]).max(), answer["figures"][0]
    assert shown >= 0.98 * max(abs(largest["max"]), abs(largest["min"]))
    fingers = 2 if example["name"] == "two-fingers" else 1
    assert len([t for t in answer["traces"] if t["signal"] == "f_el"]) == len(answer["stacks"]) == fingers
    assert ".tran" in as_deck(example["request"])


@pytest.mark.parametrize("kind", WAVEFORMS)
def test_every_waveform_of_the_menu_runs_as_the_menu_writes_it(kind: str) -> None:
    numbers = " ".join(f"{a['value']:g}" for a in WAVEFORMS[kind]["arguments"])
    request = {"deck": SINE, "source": f"Vdrive={kind}({numbers})", "rtol": 1e-4, "periods": 2, "skin": "dispersive"}
    if kind == "RECORDING":
        request["recording"] = {"name": "a.wav", "rate": 1e3, "values": packed([0.0, 1.0, 0.0, -1.0, 0.0])}
    answer = scene(request)
    assert answer["ok"], answer["message"]
    peak = np.abs(answer["traces"][0]["values"]).max()
    assert peak == pytest.approx(150.0 if kind in ("CHIRP", "RECORDING") else 200.0, rel=4e-3)


def test_sliders_show_every_parameter_within_its_range_and_say_what_they_move() -> None:
    assert len(BY_NAME) == len(EXAMPLES) >= 12
    answer = scene({"deck": BY_NAME["ungrounded"]["deck"], "overrides": {"Xgap.d": "4u"}})
    sliders = {s["path"]: s for group in answer["sliders"] for s in group["sliders"]}
    circuit = fs.parse_netlist(BY_NAME["ungrounded"]["deck"])
    assert set(sliders) == set(circuit.parameters)
    assert sliders["Xgap.d"]["value"] == 4e-6
    assert sliders["Xgap.d"]["text"] == "4u"
    assert (sliders["Xgap.d"]["log"], sliders["Xgap.mu"]["log"]) == (True, False)
    for slider in sliders.values():
        assert slider["low"] < slider["high"], slider
        assert slider["value"] is None or slider["low"] <= slider["value"] <= slider["high"], slider
        assert not slider["log"] or slider["low"] > 0.0, slider
    unmoved = scene({"deck": BY_NAME["ungrounded"]["deck"]})
    ranges = {s["path"]: (s["low"], s["high"]) for group in unmoved["sliders"] for s in group["sliders"]}
    assert ranges == {path: (s["low"], s["high"]) for path, s in sliders.items()}
    for name, spec in DEVICES.items():
        assert spec.what, name
        assert all(p.meaning for p in spec.parameters), name
    assert (sliders["Xgap.d"]["meaning"], sliders["Cbody.value"]["meaning"]) == ("gap height", "capacitance")


def test_both_ends_of_every_slider_give_a_run_or_a_sentence() -> None:
    groups = scene({"deck": SINE})["sliders"]
    for slider in (s for group in groups for s in group["sliders"]):
        for end in ("low", "high"):
            answer = scene({"deck": SINE, "overrides": {slider["path"]: slider[end]}, "rtol": 1e-4, "periods": 1})
            assert answer["ok"] or len(answer["message"]) > 20, (slider["path"], end)
            assert answer["status"] != "FAULT"


def test_curves_have_more_points_where_the_source_oscillates_often_and_too_few_are_told() -> None:
    few, many, most = (scene({"deck": SINE, "periods": n, "rtol": 1e-4}) for n in (100, 200, 5))
    assert (few["t"].size, many["t"].size, most["t"].size) == (POINTS, 3200, POINTS)
    carrier = scene({"deck": SINE, "source": "AM(200 100k 50)", "periods": 1, "rtol": 1e-3, "skin": "dispersive"})
    assert carrier["t"].size == MOST_POINTS
    (said,) = [w for w in carrier["warnings"] if "points" in w]
    assert said.startswith("the curves have 12,000 points for 2,001 oscillations of the source, too few")
    assert not any("points" in w for one in (few, many, most) for w in one["warnings"])


def test_unknown_names_are_said_and_the_rest_is_shown() -> None:
    answer = scene({"deck": SINE, "overrides": {"Xgpa.d": 1e-6}, "areas": "frozen"})
    assert answer["ok"]
    assert answer["unknown"] == [
        "unknown name 'areas', which is left out; nearest: 'area'",
        "unknown parameter 'Xgpa.d', which is left out; nearest: 'Xgap.d'",
    ]


@pytest.mark.parametrize(("request_", "words"), [
    *(({"deck": SINE} | request, said) for request, said in listed("requests")),
    ([], "the request is list"),
    ({}, "deck is of type NoneType"),
    ({"deck": "x" * (LONGEST_DECK + 1)}, "characters long; allowed: at most"),
    ({"deck": "t\nV0 1 0 1\n" + "".join(f"R{i} 1 0 1\n" for i in range(200))}, "at most 200 on this page"),
    ({"deck": SINE, "overrides": {"Xgap.d": 10**400}}, "a number, or text such as 3.5u"),
    ({"deck": SINE.replace("SIN(0 200 100)", "WAVEFILE(/etc/hostname 1)")}, "no folder to look in"),
    (recorded(None), "which a link does not carry"),
], ids=lambda x: x if isinstance(x, str) else "")  # fmt: skip
def test_a_wrong_request_is_refused_in_a_sentence(request_: Any, words: str) -> None:
    answer = scene(request_)
    assert (answer["ok"], answer["status"]) == (False, "BAD_INPUT")
    assert words in answer["message"]
    assert "Traceback" not in answer["message"]


def test_dispersive_skins_count_by_their_slabs() -> None:
    finger = "Xc# d t# a# LAYER d=1u eps_r=4\nXg# t# s# a# GAP\nXs# s# 0 a# SKIN d=350u f=5k\n"
    fingers = "".join(finger.replace("#", str(i)) for i in range(25))
    deck = f"t\nV1 d 0 SIN(0 200 5k)\n{fingers}.tran 1u 1m uic\n.end\n"
    assert scene({"deck": deck, "rtol": 1e-3, "periods": 1})["ok"]
    assert "dispersive skin counted as its" in scene({"deck": deck, "skin": "dispersive"})["message"]


def test_a_run_that_takes_too_long_is_stopped_with_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fingerspice.explorer.scene.LONGEST_RUN", -1.0)
    assert "the run was stopped after" in scene({"deck": SINE})["message"]


def test_a_circuit_of_the_users_stands_for_its_text_with_its_files_and_changes(tmp_path: Path) -> None:
    (tmp_path / "own.cir").write_text(OWN)
    (tmp_path / "drive.csv").write_text("t,u\n0,0\n1m,100\n5m,100\n6m,0\n")
    own = fs.read_netlist(tmp_path / "own.cir").replace({"Xgap.d": 5e-6})
    assert "no folder to look in" in scene({"deck": OWN})["message"]
    answer = scene({"deck": own.text, "overrides": {"Xgap.r": "2meg"}}, own)
    assert answer["ok"], answer["message"]
    expected = fs.simulate(own.replace({"Xgap.r": 2e6}), t_eval=answer["t"], rtol=1e-6, charge=False)
    np.testing.assert_array_equal(answer["traces"][1]["values"], expected.u_gap)
    assert f"fs.read_netlist({str(tmp_path / 'own.cir')!r})" in as_python({"deck": own.text}, own)


@pytest.mark.parametrize("asks", [
    {"overrides": {"Xgap.d": "4u", "Xgap.r": "inf"}, "source": "AM(200 5k 50)", "periods": 1, "skin": "follow"},
    {"skin": "dispersive", "charge_law": "mobile", "area": "frozen", "last": 1},
    {"source": "BURST(200 5k 10 10m)", "periods": 1, "rtol": 1e-4},
])  # fmt: skip
def test_the_python_of_a_scene_gives_its_traces(asks: dict[str, Any]) -> None:
    request = {"deck": SINE, **asks}
    solution, answer = run_as_python(request), scene(request)
    np.testing.assert_array_equal(solution.t, answer["t"])
    for trace in answer["traces"]:
        np.testing.assert_allclose(getattr(solution, trace["name"]), trace["values"], rtol=1e-12, atol=1e-15)


def test_the_deck_of_a_scene_gives_its_traces() -> None:
    request = {"deck": SINE, "overrides": {"Xgap.d": "4u"}, "source": "SIN(0 150 200)", "skin": "follow"}
    # The deck holds ngspice's subcircuits of the devices.
    circuit, said = heard(fs.parse_netlist, as_deck(request))
    assert all(text.endswith("not read") for text in said)
    answer = scene(request)
    solution = fs.simulate(circuit, t_eval=answer["t"], rtol=1e-6)
    np.testing.assert_allclose(solution.f_el, answer["traces"][2]["values"], atol=1e-6)


def test_a_recording_is_the_source_that_its_file_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    values = np.round(20_000 * np.sin(np.arange(400) / 7.0)).astype("<i2")
    with wave.open("a.wav", "wb") as file:
        file.setparams((1, 2, 8000, 400, "NONE", ""))
        file.writeframes(values.tobytes())
    (tmp_path / "a.csv").write_text("t,u\n0,0\n1e-3,100\n4e-3,-50\n")
    deck = BY_NAME["click"]["deck"]
    recording = {"name": "a.wav", "rate": 8000, "values": packed(list(values / 2.0**15))}
    table = {"name": "a.csv", "times": packed([0.0, 1e-3, 4e-3]), "values": packed([0.0, 100.0, -50.0])}
    for gain, data, stop in ((150.0, recording, 0.05), (2.0, table, 4e-3)):
        request = {"deck": deck, "source": f"RECORDING({gain})", "recording": data}
        answer = scene(request)
        assert answer["ok"], answer["message"]
        assert answer["t_stop"] == pytest.approx(stop)
        np.testing.assert_allclose(run_as_python(request).f_el, answer["traces"][2]["values"], atol=1e-7)


def test_the_mean_force_against_frequency_is_that_of_large_signal(explorer: Explorer) -> None:
    found = post(explorer, {"deck": SINE, "frequencies": [100, 1000]}, "means")
    (expected,) = fs.large_signal(fs.parse_netlist(SINE), [100, 1000], rtol=1e-5)
    np.testing.assert_allclose(found["force"], expected.f_el_mean)
    for wrong in ({}, {"frequencies": []}, {"frequencies": ["x"]}, {"frequencies": [1.0] * 17}):
        assert "at most 16 numbers" in post(explorer, {"deck": SINE, **wrong}, "means")["message"]
    refused(200, post(explorer, [], "means"), 200, "at most 16 numbers")
    fold = {"deck": SINE, "charge_law": "mobile", "overrides": {"Xgap.d": "10n"}, "frequencies": [100]}
    refused(200, post(explorer, fold, "means"), 200, "the mobile charge law")


def test_the_page_and_its_files_come_with_headers_that_shut_it_in(explorer: Explorer) -> None:
    for name in ("", *pages()):
        with urllib.request.urlopen(explorer.url + name) as answer:
            policy = answer.headers["Content-Security-Policy"]
            assert "default-src 'none'" in policy
            assert "unsafe" not in policy
            assert answer.headers["X-Content-Type-Options"] == "nosniff"
            assert answer.headers["Referrer-Policy"] == "no-referrer"
            assert answer.read() == pages()[name or "index.html"]
    assert sum(map(len, pages().values())) < 300_000
    text = b"".join(content for name, content in pages().items() if not name.startswith("uplot")).decode()
    assert "http:" not in text.replace("http://www.w3.org/2000/svg", "")
    assert "https:" not in text
    assert "MIT License" in (ROOT / "LICENSES" / "uPlot-MIT.txt").read_text()
    assert "uplot.js" in (ROOT / "NOTICE").read_text()


def test_another_page_may_frame_the_explorer_only_where_a_notebook_asked_for_it(explorer: Explorer) -> None:
    framed = Explorer(framed=True)
    frame = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Dest": "iframe", "Sec_Fetch_Mode": "navigate"}
    assert asked(framed, "", None, **frame)[0] == 200
    assert asked(explorer, "", None, **frame)[0] == 403
    # A frame is all: no data, no script, no page in a window, nothing without the token.
    for what, headers in (
        ("start", frame), ("../", frame), ("app.js", frame | {"Sec_Fetch_Dest": "script"}),
        ("", frame | {"Sec_Fetch_Dest": "document"}),
    ):  # fmt: skip
        assert asked(framed, what, None, **headers)[0] == 403
    assert raw(framed, "POST", "/x/", b"{}", **frame)[0] == 403
    for one, allowed in ((explorer, "'none'"), (framed, "http://127.0.0.1:* http://localhost:* ")):
        with urllib.request.urlopen(one.url) as answer:
            ancestors = answer.headers["Content-Security-Policy"].partition("frame-ancestors ")[2]
            assert ancestors.startswith(allowed)
            assert "https://" not in ancestors.replace("https://127.0.0.1:*", "").replace("https://localhost:*", "")
    assert explorer._repr_html_() is None
    assert f'<iframe src="{framed.url}"' in str(framed._repr_html_())
    framed.stop()
    framed.stop()


def test_a_solution_opens_the_page_as_it_was_run(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    circuit = fs.parse_netlist(SINE).replace({"Xgap.d": 5e-6})
    solution = fs.simulate(circuit, charge_law="mobile", area="frozen", rtol=1e-5, t_stop=0.03)
    alone = circuit.explore()
    assert alone.circuit is circuit
    alone.stop()
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(alone.url)
    running = solution.explore()
    try:
        assert opened == [alone.url, running.url]
        start = asked(running, "start", None)[1]
        assert start["own"]["request"] == {
            "deck": SINE, "charge_law": "mobile", "area": "frozen", "rtol": 1e-5, "periods": 3.0,
            "overrides": {"Xgap.d": "5u"},
        }  # fmt: skip
        shown = post(running, start["own"]["request"])
        force = next(trace for trace in shown["traces"] if trace["signal"] == "f_el")
        np.testing.assert_allclose(force["values"].max(), solution.f_el.max(), rtol=1e-3)
    finally:
        running.stop()


def test_whoever_lacks_the_token_is_refused(explorer: Explorer) -> None:
    assert explorer._server.server_address[0] == "127.0.0.1"
    assert explorer.url.startswith(f"http://127.0.0.1:{explorer.port}/")
    assert len(explorer.token) >= 32
    body = json.dumps({"deck": SINE}).encode()
    for path in ("/", "/scene", "/start", f"/{explorer.token[:-1]}x/scene", f"/x/{explorer.token}/scene", "/ä/"):
        refused(*raw(explorer, "GET", urllib.parse.quote(path)), 403, "token")
        refused(*raw(explorer, "POST", urllib.parse.quote(path), body), 403, "token")


def test_another_host_or_page_is_refused(explorer: Explorer) -> None:
    body = json.dumps({"deck": SINE}).encode()
    for word, headers in (
        ("host", {"Host": "evil.example"}), ("host", {"Host": f"127.0.0.1:{explorer.port + 1}"}),
        ("another page", {"Origin": "http://evil.example"}), ("another page", {"Origin": "null"}),
        ("another page", {"Sec_Fetch_Site": "cross-site"}),
    ):  # fmt: skip
        refused(*asked(explorer, "scene", body, **headers), 403, word)
    status, answer = asked(explorer, "scene", body, Origin=f"http://localhost:{explorer.port}")
    assert (status, answer["ok"]) == (200, True)


def test_bodies_that_are_too_large_or_no_json_are_refused(explorer: Explorer) -> None:
    refused(*asked(explorer, "scene", b" " * (MOST_BYTES + 1)), 413, "bytes; allowed: at most")
    for body in (b"", b"{", b"\xff\xfe", b"[" * 100_000, b'{"deck": 1e'):
        refused(*asked(explorer, "scene", body), 400, "not JSON")
    refused(*asked(explorer, "scene", b"{}", Transfer_Encoding="chunked"), 411, "no length")
    refused(*asked(explorer, "nothing", b"{}"), 404, "allowed: scene")
    for path in ("../server.py", "%2e%2e/server.py"):
        refused(*asked(explorer, path, None), 404)
    assert "the request is list" in post(explorer, [])["message"]
    refuses("cannot be used", Explorer, port=explorer.port)
    refuses("allowed: 0 to 65535", Explorer, port=70_000)


_WORDS = st.sampled_from(
    ["SIN(0 200 100)", "local", "frozen", "follow", "x", "", "inf", "nan", "3.5u", "\x00", "é", "Vdrive=AM(1 2 3)"]
)
_ANY = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | _WORDS | st.text(max_size=12),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)
_PATHS = st.sampled_from([*fs.parse_netlist(SINE).parameters, "Vdrive", "Xgap", "x.y", ""])
_REQUESTS = st.fixed_dictionaries(
    {"deck": st.just(SINE)},
    optional={
        "overrides": st.dictionaries(_PATHS, st.floats(-1e3, 1e9) | _WORDS, max_size=3) | _ANY,
        "source": st.sampled_from([f"{kind}(1 2 3 4)" for kind in WAVEFORMS] + ["SIN(0 1e3 1e3)", "DC 5"]) | _ANY,
        "charge_law": st.sampled_from(["local", "mobile"]) | _ANY, "area": st.sampled_from(["mean", 3e-5]) | _ANY,
        "skin": st.sampled_from(["follow", "dispersive"]) | _ANY, "rtol": st.sampled_from([1e-3, 1e-6]) | _ANY,
        "periods": st.floats(0.1, 10) | _ANY, "last": st.floats(0.1, 10) | _ANY, "other": _ANY, "recording": _ANY,
    },
)  # fmt: skip


@settings(max_examples=cases(150, 40), deadline=None, suppress_health_check=list(HealthCheck))
@given(request=_REQUESTS | _ANY)
def test_no_request_gives_a_fault_a_hang_or_a_file(request: Any, explorer: Explorer) -> None:
    begin = time.monotonic()
    status, answer = asked(explorer, "scene", json.dumps(request).encode())
    assert status == 200
    assert answer["status"] != "FAULT", answer["message"]
    assert answer["ok"] or answer["message"]
    assert time.monotonic() - begin < 60.0


@contextlib.contextmanager
def serving(folder: Path, *words: str) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    """The command in a process of its own, and the answer that it prints."""
    command = [sys.executable, "-m", "fingerspice", "explore", *words, "--no-browser", "--json"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            said = ""
            while not said.endswith("}\n"):
                line = process.stdout.readline()
                assert line, "the command ended"
                said += line
            yield process, json.loads(said)
        finally:
            process.kill()


# An event that a handler sets would be waited for by itself, where the second signal comes during the first.
PAUSES = ((0.0,), 5 * (2e-5,), 5 * (0.0,), 5 * (1e-4,))


@pytest.mark.parametrize("pauses", PAUSES[: cases(4, 2)], ids=str)
def test_the_command_serves_until_interrupted_and_leaves_no_file(tmp_path: Path, pauses: tuple[float, ...]) -> None:
    (tmp_path / "pad.cir").write_text(SINE)
    with serving(tmp_path, "pad.cir") as (process, said):
        assert (said["command"], said["success"], said["title"]) == ("explore", True, "Table 1, sine of 100 Hz")
        with urllib.request.urlopen(said["url"] + "start") as answer:
            assert json.load(answer)["own"]["request"]["deck"] == SINE
        for pause in pauses:
            process.send_signal(signal.SIGINT)
            time.sleep(pause)
        out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (0, "", "")
    assert os.listdir(tmp_path) == ["pad.cir"]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux's /proc")
def test_the_memory_of_the_command_stays_as_it_is_while_a_slider_moves(tmp_path: Path) -> None:
    with serving(tmp_path) as (process, said):
        _, _, host, token, _ = said["url"].split("/")
        connection = http.client.HTTPConnection(host)

        def memory_after(start: int, stop: int) -> float:
            """Resident memory, MB."""
            for i in range(start, stop):
                request = {"deck": SINE, "overrides": {"Xgap.d": 3e-6 + 1e-10 * i}, "last": 2}
                connection.request("POST", f"/{token}/scene", json.dumps(request))
                assert connection.getresponse().read()
            status = Path(f"/proc/{process.pid}/status").read_text()
            return int(status.partition("VmRSS:")[2].split()[0]) / 1024.0

        # An answer holds 0.1 MB of arrays, and its run 0.5 MB.
        count = cases(200, 40)
        assert -memory_after(0, count) + memory_after(count, cases(800, 160)) < 60.0
        connection.close()


def test_the_static_page_needs_no_other_file_and_holds_the_run(command: Command, tmp_path: Path) -> None:
    (tmp_path / "pad.cir").write_text(SINE.replace("Table 1,", "</script>"))
    result = command("explore", "pad.cir", "--static", "page.html", "--json")
    answer = json.loads(result.out)
    assert (result.code, answer["files"], answer["url"]) == (0, ["page.html"], None)
    page = (tmp_path / "page.html").read_text()
    assert not re.search(r'(src|href)="(?!data:)', page)
    data = baked(page)
    assert data["start"]["own"]["title"] == "</script> sine of 100 Hz"
    np.testing.assert_array_equal(
        data["scenes"]["own"]["traces"][1]["values"], scene({"deck": SINE, "last": 2})["traces"][1]["values"]
    )
    assert command("explore", "pad.cir", "--static", "pad.cir").code == 2
    result = command("explore", "none.cir", "--no-browser", "--json")
    assert (result.code, json.loads(result.out)["status"]) == (2, "BAD_INPUT")
