"""Named sets of parameters on the explorer's page, and what was changed before it was opened."""

import json
import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from commands import Command
from fingerspice.explorer import framed
from fingerspice.explorer.request import asked_by, read_source, text_of
from fingerspice.explorer.scene import EXAMPLES, applied, as_python, before, scene
from scenes import refuses
from test_explore import baked, run_as_python

DECKS = {example["name"]: example["request"]["deck"] for example in EXAMPLES}
SINE, FINGERS = DECKS["sine"], DECKS["two-fingers"]


def on_page(request: dict[str, Any], *entries: str) -> dict[str, Any]:
    """The request after the sets have been chosen in the page's menu one after the other, as the page joins them."""
    for entry in entries:
        found = applied({**request, "apply": entry})
        sets = [one for one in (request.get("sets", ""), found["set"]) if one]
        request = {
            **request, "overrides": {**request.get("overrides", {}), **found["overrides"]}, "sets": ",".join(sets),
            **({"source": found["source"]} if found["source"] else {}),
        }  # fmt: skip
    return request


def force(answer: dict[str, Any]) -> Any:
    assert answer["ok"], answer["message"]
    return next(trace["values"] for trace in answer["traces"] if trace["signal"] == "f_el")


@pytest.mark.parametrize("name", list(fs.parameters()))
def test_a_set_chosen_on_the_page_gives_what_it_gives_to_the_circuit(name: str) -> None:
    request = on_page({"deck": SINE, "rtol": 1e-5}, name)
    shown = scene(request)
    circuit = fs.parameters(name).apply(fs.parse_netlist(SINE))
    expected = fs.simulate(circuit, t_eval=shown["t"], t_stop=shown["t_stop"], rtol=1e-5, charge=False)
    np.testing.assert_array_equal(force(shown), expected.f_el)
    (told,) = shown["sets"]
    assert (told["name"], told["caveat"]) == (name, fs.parameters(name).not_claimed)
    assert told["assumed"] == list(fs.parameters(name).assumed)
    # The link has the values: without the set's name it is the same scene, of which nothing is said.
    bare = scene({**request, "sets": ""})
    np.testing.assert_array_equal(force(bare), force(shown))
    assert bare["sets"] == []


def test_the_copied_python_applies_the_sets_and_can_be_cited() -> None:
    request = on_page({"deck": SINE, "rtol": 1e-5}, "moist", "3M-insulating", "Fig4-5kHz")
    request["overrides"]["Xgap.mu"] = "0.6"
    text = as_python(request)
    assert text.count("fs.parameters(") == 3
    assert "circuit.replace({'Xgap.mu': 0.6})" in text
    solution = run_as_python(request)
    shown = scene(request)
    np.testing.assert_array_equal(force(shown), solution.f_el)
    assert [one["changed"] for one in shown["sets"]] == [["Xgap.mu"], [], []]
    assert any(
        "The set moist" in sentence and "changed since: Xgap.mu" in sentence for sentence in solution.cite().statements
    )


def test_a_set_goes_to_one_finger_of_two() -> None:
    request = on_page({"deck": FINGERS, "rtol": 1e-5}, "Xlight=dry")
    assert {path.partition(".")[0] for path in request["overrides"]} == {"Xlight"}
    (told,) = scene(request)["sets"]
    assert (told["name"], told["to"]) == ("dry", "Xlight")
    expected = fs.parameters("dry").apply(fs.parse_netlist(FINGERS), "Xlight")
    np.testing.assert_array_equal(
        scene(request)["figures"][3]["mean"],
        scene({"deck": FINGERS, "rtol": 1e-5, "overrides": before(expected)[0]["overrides"]})["figures"][3]["mean"],
    )
    assert run_as_python(request).circuit.sets.keys() == {"dry"}
    # One source of several gets a drive by its name.
    request = on_page({"deck": DECKS["tones"], "rtol": 1e-4}, "Vfast=Fig4-100Hz")
    assert request["source"] == "Vfast=SIN(0 200 100)"
    assert scene(request)["sets"][0]["name"] == "Fig4-100Hz"


def test_a_set_that_does_not_fit_is_refused_in_a_sentence() -> None:
    for entry, words in (
        ("moits", "unknown set 'moits'; nearest: 'moist'"), ("Xnone=moist", "lacks; allowed"),
        (None, "allowed: the name of a set"),
        ("Fig4-100Hz", "the circuit has Vdrive, Vfast; allowed: one of these names"),
    ):  # fmt: skip
        refuses(re.escape(words), applied, {"deck": DECKS["tones"], "apply": entry})


def test_a_set_in_a_link_that_means_nothing_is_said_and_the_rest_is_shown() -> None:
    shown = scene({"deck": SINE, "sets": "moits, dry", "rtol": 1e-4})
    assert shown["ok"]
    assert "set 'moits', which is left out: unknown set 'moits'; nearest: 'moist', 'light'" in shown["unknown"]
    # The values in which dry differs from the deck are not in the link.
    assert [(one["name"], one["changed"]) for one in shown["sets"]] == [("dry", ["Xgap.r", "Xgap.mu"])]
    # In another spelling it is the same set; one that does not fit is not said again by one that does.
    shown = scene({"deck": SINE, "sets": "Xnone=dry, DRY", "rtol": 1e-4})
    assert [(one["name"], one["to"]) for one in shown["sets"]] == [("dry", None)]


def test_what_was_changed_before_is_in_the_link_so_that_another_explorer_shows_the_same() -> None:
    circuit = fs.parse_netlist(SINE)
    for name in ("moist", "3M-insulating", "Fig5-5kHz"):
        circuit = fs.parameters(name).apply(circuit)
    circuit = circuit.replace({"Xgap.fn": 0.1 + 0.2, "Vdrive.amplitude": 100.0})
    asked, unsaid = before(circuit)
    assert unsaid == []
    assert (asked["source"], asked["sets"]) == ("Vdrive=SQUARE(100 5k 0.5)", "moist,3M-insulating,Fig5-5kHz")
    request = {"deck": SINE, "rtol": 1e-5, **asked}
    here, elsewhere = scene(request, circuit), scene(request)
    np.testing.assert_array_equal(force(here), force(elsewhere))
    expected = fs.simulate(circuit, t_eval=here["t"], t_stop=here["t_stop"], rtol=1e-5, charge=False)
    np.testing.assert_array_equal(force(here), expected.f_el)
    np.testing.assert_array_equal(run_as_python(request, circuit).f_el, expected.f_el)
    # No link can carry a function.
    circuit = fs.parse_netlist(SINE).replace({"Vdrive": lambda t: 100.0 * math.sin(600.0 * t)})
    assert before(circuit) == ({}, ["Vdrive"])


def test_a_waveform_is_read_from_its_own_text() -> None:
    for waveform in (
        *(fs.Sine(1.5, 60.0), fs.Sine(200.0, 1e3, offset=-3.0), fs.Square(200.0, 5e3, 0.3), fs.DC(-5.0)),
        *(fs.AM(150.0, 1e4, 100.0, 0.5), fs.Triangle(1 / 3, 70.0), fs.Sawtooth(20.0, 1e3)),
    ):
        text = text_of(waveform)
        assert text is not None
        assert read_source(text, fs.parse_netlist(SINE))[1] == waveform
    assert text_of(fs.Sine(1.0, 60.0) + fs.Sine(1.0, 70.0)) is None


@pytest.mark.parametrize("area", [3.0000001e-5, "mean"])
def test_a_run_with_a_fixed_area_opens_as_it_was_run(area: float | str) -> None:
    solution = fs.simulate(fs.parse_netlist(SINE), area=area, rtol=1e-6)
    asked = asked_by(solution)
    assert asked["area"] == area
    # The address has texts, as everything in it.
    for given in (asked["area"], str(asked["area"])):
        shown = scene({"deck": SINE, **asked, "area": given})
        assert shown["area"] == solution.area_mode
        expected = fs.simulate(fs.parse_netlist(SINE), area=area, rtol=1e-6, t_eval=shown["t"], charge=False)
        np.testing.assert_array_equal(force(shown), expected.f_el)


def test_arrays_are_behind_the_json_and_numbers_that_are_not_finite_are_null() -> None:
    x, y = np.array([1.0, math.inf]), np.arange(3.0)[::-1]
    content = framed({"a": [x, {"b": math.nan}], "c": y, "d": x, "e": 0.5})
    length, count = struct.unpack("<II", content[:8])
    assert length % 8 == 0
    assert json.loads(content[8 : 8 + length]) == {
        "a": [{"f64": [0, 2]}, {"b": None}], "c": {"f64": [2, 3]}, "d": {"f64": [0, 2]}, "e": 0.5,
    }  # fmt: skip
    np.testing.assert_array_equal(np.frombuffer(content[8 + length :], "<f8"), [1.0, math.inf, 2.0, 1.0, 0.0])
    assert count == 5


def test_the_command_takes_sets_as_run_does_and_refuses_others(command: Command, tmp_path: Path) -> None:
    (tmp_path / "pad.cir").write_text(SINE)
    sets = ("--finger", "moist", "--coating", "Xcoat=3M", "--drive", "Fig4-5kHz", "--set", "Xgap.mu=0.5")
    result = command("explore", "pad.cir", *sets, "--set", "light", "--static", "page.html", "--json")
    assert result.code == 0, result.out
    assert json.loads(result.out)["sets"] == ["light", "moist", "3M", "Fig4-5kHz"]
    request = baked((tmp_path / "page.html").read_text())["start"]["own"]["request"]
    assert (request["source"], request["sets"]) == ("Vdrive=SIN(0 200 5k)", "light,moist,3M,Fig4-5kHz")
    values = {path: request["overrides"][path] for path in ("Xgap.r", "Xgap.mu", "Xgap.fn", "Xskin.f")}
    assert values == {"Xgap.r": "100k", "Xgap.mu": "0.5", "Xgap.fn": "0.2", "Xskin.f": "5k"}
    for wrong, said in (
        ("--finger moist", "--finger 'moist' is given without a deck"),
        ("pad.cir --finger 3M", "the set '3M' is a coating, not a finger"),
        ("pad.cir --set moits", "unknown set 'moits'; nearest: 'moist', 'light'; or PATH=VALUE"),
    ):
        result = command("explore", *wrong.split(), "--no-browser", "--json").refused()
        assert said in json.loads(result.out)["message"]
