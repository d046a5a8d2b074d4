"""Named sets of parameters: their files, what they make of a circuit, and what is cited for a run."""

import dataclasses
import itertools
import json
import pickle
import re
import warnings
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
import sets_page
from commands import Command
from fingerspice.circuit.devices import DEVICES
from fingerspice.explorer.scene import EXAMPLES
from fingerspice.sets import DATA, ELEMENTS, KINDS, WAVEFORMS, keys_in, references, tables
from scenes import listed, refuses, shipped

ROOT = Path(__file__).parents[1]
CIRCUITS = ROOT / "circuits"
NAMES = list(fs.parameters())
PAD = CIRCUITS / "fingerpad.cir"
each_set = pytest.mark.parametrize("name", NAMES)


@pytest.fixture
def pad() -> fs.Circuit:
    return fs.read_netlist(PAD)


def mean_force(circuit: fs.Circuit) -> float:
    return float(fs.steady_state(circuit, rtol=1e-6).f_el_mean)  # type: ignore[arg-type]


def with_set(name: str, circuit: fs.Circuit) -> fs.Circuit:
    return fs.parameters(name).apply(circuit)


def values(circuit: fs.Circuit) -> dict[str, float]:
    return {path: parameter.value for path, parameter in circuit.parameters.items()}


# The files.


def test_there_are_sets_of_every_kind_and_every_file_is_one() -> None:
    assert len(NAMES) >= 9
    assert {one.kind for one in fs.parameters().values()} == set(KINDS)
    assert {file.stem for file in DATA.glob("*.toml")} == {*NAMES, "references"}
    assert {"Forsbach2021", "dry", "normal", "moist", "3M", "thick-glass", "Tanvas-like"} <= set(NAMES)
    assert len({name.lower() for name in NAMES}) == len(NAMES)


@each_set
def test_a_file_has_the_keys_of_the_schema_and_no_others(name: str) -> None:
    table = tables()[name]
    must, may = {"name", "title", "kind", "claims", "not_claimed", "values"}, {"includes", "waveform"}
    assert must <= set(table) <= must | may
    assert all(isinstance(table[key], str) and len(table[key]) > 0 for key in must - {"values"})
    assert re.fullmatch(r"[A-Za-z0-9][\w-]*", name)
    assert set(table.get("includes", ())) <= set(NAMES)
    # A value that is included and equal would be written twice.
    included = {path: one for other in table.get("includes", ()) for path, one in fs.parameters(other).values.items()}
    for value in table["values"]:
        path = f"{value['element']}.{value['parameter']}"
        assert path not in included or value["value"] != included[path].value
    # A set may include sets of its own kind, and a scene those of all kinds.
    kinds = {fs.parameters(other).kind for other in table.get("includes", ())}
    assert table["kind"] == "scene" or kinds <= {table["kind"]}


@each_set
def test_every_value_is_inside_its_range_in_the_unit_of_the_netlist(name: str) -> None:
    one = fs.parameters(name)
    for path, value in one.values.items():
        assert path == f"{value.element}.{value.parameter}"
        assert value.low <= value.value <= value.high
        if value.element == "source":
            assert one.waveform is not None
            assert WAVEFORMS[one.waveform].units[value.parameter] == value.unit
            continue
        # The last device has the parameter only where it is optional: a dispersive skin has no f.
        found = [DEVICES[d] for d in ELEMENTS[value.element]]
        specs = [spec for device in found for spec in device.parameters if spec.name == value.parameter]
        assert len(specs) == len(found) or (value.optional and specs)
        for spec in specs:
            assert spec.unit == value.unit
            assert all(spec.accepts(x) for x in (value.low, value.value, value.high) if x or spec.may_be_zero)
            assert spec.unusual(name, value.value) is None
    assert (one.waveform is not None) is any(v.element == "source" for v in one.values.values())


@each_set
def test_every_source_and_range_is_named_and_every_reference_exists(name: str) -> None:
    one = fs.parameters(name)
    for value in one.values.values():
        assert value.assumed or keys_in(value.source), f"{value.path}: neither a reference nor 'assumed'"
        assert value.range
    texts = [one.claims, one.not_claimed, *(t for v in one.values.values() for t in (v.source, v.range))]
    assert {key for text in texts for key in keys_in(text)} == {r.key for r in one.references}
    assert one.references or all(value.assumed for value in one.values.values())


def test_every_reference_is_used_has_a_title_and_a_place_to_find_it() -> None:
    used = {r.key for one in fs.parameters().values() for r in one.references}
    assert set(references()) == used | {"fingerspice", "SciPy", "torchdiffeq"}
    for key, one in references().items():
        assert one.kind in ("article", "inproceedings", "misc")
        assert one.title
        assert one.authors
        assert not one.doi or re.fullmatch(r"10\.\d{4,}/\S+", one.doi)
        assert one.doi or one.url or one.where or key == "fingerspice"
        assert one.year or one.kind == "misc"


def test_program_and_paper_are_those_of_the_citation_file() -> None:
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    own, paper = references()["fingerspice"], references()["Forsbach2021"]
    start, end = paper.where["pages"].split("-")
    figures = {"year": paper.year, "volume": paper.where["volume"], "start": start, "end": end}
    names = (author.split(", ") for author in paper.authors)
    for said in (
        *(f'\ntitle: "{own.title}"\n', f'name: "{own.authors[0].strip("{}")}"', f"\nversion: {fs.__version__}\n"),
        *(f'title: "{paper.title}"', f"doi: {paper.doi}"),
        *(f"\n    {key}: {value}\n" for key, value in figures.items()),
        *(f"family-names: {family}\n        given-names: {given}" for family, given in names),
    ):
        assert said in text


# What they make of a circuit.


def test_forsbach2021_is_table_1_of_the_shipped_deck_run_for_run(pad: fs.Circuit) -> None:
    one = fs.parameters("Forsbach2021")
    assert not one.assumed
    other = pad.replace({"Xcoat.d": 5e-6, "Xcoat.r": 1e9, "Xgap.d": 9e-6, "Xgap.alpha": 30, "Xskin.d": 1e-4})
    other = other.replace({"Xgap.r": 3e6, "Xgap.mu": 0.1, "Xgap.fn": 0.3, "Xgap.c2": 100, "Xcoat.eps_r": 2})
    made = one.apply(other)
    assert values(made) == values(pad)
    expected, found = fs.simulate(pad), fs.simulate(made)
    for key in ("u_gap", "area", "f_el", "f_t"):
        np.testing.assert_array_equal(getattr(found, key), getattr(expected, key))


FIGURES = {"Fig4-100Hz": "", "Fig4-5kHz": "_5khz", "Fig5-100Hz": "_square", "Fig5-5kHz": "_square_5khz"}


@pytest.mark.parametrize("name", FIGURES)
def test_the_drives_of_the_figures_are_those_of_the_shipped_decks(name: str) -> None:
    wanted = fs.read_netlist(CIRCUITS / f"fingerpad{FIGURES[name]}.cir")
    # From another drive, so that every value is the set's.
    made = with_set(name, with_set("TeslaTouch", wanted))
    assert values(made)["Xskin.f"] == values(wanted)["Xskin.f"]
    # The decks' squares have edges of 1 ns, for ngspice; the times lie between them.
    t = (np.arange(997) + 0.37) * 1.9e-5
    a, b = (c["Vdrive"].waveform.value(t) for c in (made, wanted))  # type: ignore[union-attr]
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)


@each_set
def test_every_set_makes_a_circuit_that_runs_without_any_warning(name: str, pad: fs.Circuit) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = with_set(name, pad)
        fs.plan(made)
        if name.startswith("Fig5"):
            # A square wave goes beyond what the skin's data at one frequency can say, of which a run warns.
            return
        assert fs.simulate(made, t_stop=2e-3, rtol=1e-5).success


def test_a_finger_does_not_depend_on_the_finger_before(pad: fs.Circuit) -> None:
    fingers = [name for name in NAMES if fs.parameters(name).kind == "finger"]
    for first, second in itertools.permutations(fingers, 2):
        made = with_set(second, with_set(first, pad))
        assert made.elements == with_set(second, pad).elements
        assert list(made.sets) == [second]


def test_a_moist_gap_takes_less_voltage_and_a_dry_one_more_as_the_page_says(pad: fs.Circuit) -> None:
    fingers = {name: with_set(name, pad) for name in ("dry", "normal", "moist")}
    force = {name: mean_force(made) for name, made in fingers.items()}
    gain = {name: np.abs(fs.phasor(made, [100.0, 1e4], area="frozen").gain) for name, made in fingers.items()}
    assert force["moist"] < 0.1 * force["normal"]
    assert force["dry"] > 1.5 * force["normal"]
    for i in range(2):
        assert gain["moist"][i] < gain["normal"][i] < gain["dry"][i]
    # The capacitances of Eq. 15 are the same: what is left is the leak, which matters less at high frequencies.
    ratio = gain["dry"] / gain["normal"]
    assert 1.0 < ratio[1] < 1.01 < 1.2 < ratio[0]
    page = " ".join(sets_page.PAGE.read_text(encoding="utf-8").split())
    assert f"is {force['dry']:.2g} N for `dry`, {force['normal']:.2g} N for `normal`" in page
    assert f"and {force['moist']:.2g} N for `moist`" in page


def test_eq_14_holds_for_the_gap_resistances_of_the_fingers(pad: fs.Circuit) -> None:
    # At a constant voltage only resistances count. SKIN at 10 Hz has rho = 10^(-0.023 + 0.0795 - 0.2133 + 4.9229).
    rho = 10 ** (-0.023 + 0.0795 - 0.2133 + 4.9229)
    for name in ("dry", "normal", "moist"):
        made = with_set(name, pad).replace({"Xskin.f": 10.0, "Vdrive": fs.DC(10.0)})
        run = fs.simulate(made, start="dc", area="frozen", t_stop=1e-3)
        r = fs.parameters(name).values["gap.r"].value
        skin = rho * 350e-6 / run.area[0]  # type: ignore[index]
        np.testing.assert_allclose(run.u_gap, 10.0 * r / (2e5 + r + skin), rtol=1e-6)  # type: ignore[arg-type]


def test_friction_without_voltage_is_the_coefficient_of_the_finger(pad: fs.Circuit) -> None:
    for name, mu in (("dry", 0.2), ("normal", 0.3), ("moist", 0.7)):
        run = fs.simulate(with_set(name, pad), sources=0.0, t_stop=1e-3)
        np.testing.assert_allclose(run.friction, mu, rtol=1e-12)  # type: ignore[arg-type]


def test_a_thick_glass_takes_nearly_all_of_the_voltage(pad: fs.Circuit) -> None:
    circuits = (with_set(name, pad) for name in ("3M-insulating", "thick-glass"))
    a, b = (abs(fs.phasor(c, [1e4], area="frozen").gain[0]) for c in circuits)
    # Capacitances in series: the gap's 3.5 um against 0.7 mm of glass with eps_r 7.
    assert b == pytest.approx(3.5 / (3.5 + 700.0 / 7.0), rel=0.05)
    assert a > 20.0 * b


def test_two_fingers_may_differ() -> None:
    both = fs.parameters("moist").apply(shipped("two_fingers"))
    assert [both[name].values["r"] for name in ("Xfirm.Xgap", "Xlight.Xgap")] == [1e5, 1e5]
    made = fs.parameters("dry").apply(both, to="xlight")
    assert [made[name].values["r"] for name in ("Xfirm.Xgap", "Xlight.Xgap")] == [1e5, 7e6]
    assert set(made.sets["moist"]) == {path for path in both.sets["moist"] if path.startswith("Xfirm.")}
    assert set(made.sets["dry"]) == {path for path in both.sets["moist"] if path.startswith("Xlight.")}


def test_a_dispersive_skin_has_no_f_and_takes_its_thickness() -> None:
    circuit = fs.parse_netlist(PAD.read_text().replace("SKIN  d=350u f=100", "SKIN_DISPERSIVE d=350u"))
    made = fs.parameters("Fig4-100Hz").apply(fs.parameters("thin-skin").apply(circuit))
    assert made["Xskin"].values == {"d": 200e-6}
    assert made["Vdrive"].waveform == fs.parameters("Fig4-100Hz").apply(circuit)["Vdrive"].waveform


# Names, tables and bad input.


@pytest.mark.parametrize(("given", "said"), listed("sets"))
def test_an_unknown_set_or_one_of_another_kind_is_refused_with_what_is_allowed(given: tuple, said: str) -> None:
    refuses(re.escape(said), fs.parameters, *given)


BARE = "t\nV1 a 0 SIN(0 10 100)\nXgap a 0 area GAP\n.tran 1m 20m uic\n"
FILMS = "t\nV1 a 0 SIN(0 9 1k)\nXa a b s LAYER d=1u eps_r=2\nXb b c s LAYER d=1u eps_r=3\nXgap c 0 s GAP\n.tran 1u 2m\n"
PUSHED = "t\nI1 0 a SIN(0 1u 100)\nXgap a 0 area GAP r=1meg\n.tran 1m 20m uic\n"
DRIVEN = "t\nV1 a b SIN(0 9 100)\nV2 b 0 SIN(0 9 50)\nXgap a 0 area GAP r=1meg\n.tran 1m 20m uic\n"


@pytest.mark.parametrize(
    ("deck", "name", "to", "said"),
    [
        (BARE, "moist", None, "the set 'moist' has values for a SKIN or SKIN_DISPERSIVE, which the circuit lacks"),
        (BARE, "3M", None, "a LAYER, which the circuit lacks; allowed: a circuit with a LAYER"),
        (BARE, "light", "Xgpa", "a GAP, which 'Xgpa' of the circuit lacks; allowed: its Xgap"),
        (FILMS, "3M", None, "values for one LAYER, and the circuit has Xa, Xb; allowed: one of these names (to='Xa'"),
        (PUSHED, "TeslaTouch", None, "a driving V source, which the circuit lacks"),
        (DRIVEN, "TeslaTouch", None, "values for one driving V source, and the circuit has V1, V2"),
    ],
)
def test_a_circuit_without_a_place_for_the_set_is_refused(deck: str, name: str, to: str | None, said: str) -> None:
    circuit = fs.parse_netlist(deck)
    refuses(re.escape(said), fs.parameters(name).apply, circuit, to)
    refuses("the circuit is a str; allowed: a Circuit", with_set, name, deck)


def test_the_layer_or_source_may_be_named() -> None:
    films = fs.parameters("3M").apply(fs.parse_netlist(FILMS), to="xB")
    assert (films["Xa"].values["eps_r"], films["Xb"].values["eps_r"]) == (2.0, 3.9)
    driven = fs.parameters("TeslaTouch").apply(fs.parse_netlist(DRIVEN), to="V2")
    assert [driven[name].waveform.frequency for name in ("V1", "V2")] == [100.0, 80.0]  # type: ignore[union-attr]


def test_a_set_and_the_list_of_sets_are_shown_as_text_and_as_tables() -> None:
    listed = fs.parameters()
    assert len(listed) == len(NAMES)
    assert listed["moist"] is fs.parameters("moist")
    for name in NAMES:
        assert re.search(rf"^{re.escape(name)} +{listed[name].kind} ", str(listed), re.MULTILINE)
    assert listed._repr_html_().count("<tr>") == len(NAMES) + 1
    moist = fs.parameters("moist")
    assert re.search(r"^gap\.r +100 kohm +10 kohm to 1 Mohm +assumed$", str(moist), re.MULTILINE)
    assert re.search(r"^gap\.eps_r +1 +this value +Forsbach2021$", str(moist), re.MULTILINE)
    assert f"does not claim: {moist.not_claimed}" in str(moist)
    assert moist._repr_html_().count("<tr>") == len(moist.values) + 1
    with pytest.raises(TypeError):
        moist.values["gap.r"] = moist.values["gap.d"]  # type: ignore[index]
    assert "coating.r" in str(fs.parameters("thick-glass"))


# What is remembered and cited.


def test_a_circuit_without_a_set_cites_the_paper_and_the_program(pad: fs.Circuit) -> None:
    cited = fs.simulate(pad).cite()
    assert [r.key for r in cited.references] == ["Forsbach2021", "fingerspice"]
    assert "No set of parameters was applied." in str(cited)
    assert f"note = {{version {fs.__version__}}}" in cited.bibtex
    assert "cite their sources, which the program does not know" in str(cited)


def test_a_run_cites_the_sets_that_made_its_circuit_and_says_what_was_changed_since(pad: fs.Circuit) -> None:
    made = with_set("3M", with_set("moist", pad))
    cited = fs.simulate(made).cite()
    keys = [r.key for r in cited.references]
    assert keys[:2] == ["Forsbach2021", "fingerspice"]
    assert set(keys) == {"Forsbach2021", "fingerspice", "AliAbbasi2024", "Adams2013", "Hess2020"}
    text = str(cited)
    assert "The set moist (Moist finger: sweat in the gap conducts) gave Xgap.d, " in text
    assert "Xskin.d; assumed, not published: Xgap.r, Xgap.mu." in text
    title = "3M coating of a capacitive touchscreen, with its leak"
    assert f"The set 3M ({title}) gave Xcoat.d, Xcoat.eps_r, Xcoat.r." in text
    changed = fs.simulate(made, parameters={"Xgap.r": 2e5, "xcoat.D": 2e-6}).cite()
    assert "assumed, not published: Xgap.mu; changed since: Xgap.r." in str(changed)
    assert "gave Xcoat.eps_r, Xcoat.r; changed since: Xcoat.d." in str(changed)
    back = made.replace({"Xgap.r": 2e5}).replace({"Xgap.r": "100k"})
    assert str(fs.simulate(back).cite()) == text


def test_a_set_all_of_whose_values_were_changed_is_not_cited(pad: fs.Circuit) -> None:
    made = with_set("TeslaTouch", pad)
    driven = fs.simulate(made, sources=fs.Sine(100.0, 200.0), parameters={"Xskin.f": 200.0}).cite()
    assert "All values of the set TeslaTouch were changed since it was applied." in str(driven)
    assert "Bau2010" not in driven.bibtex
    assert "Bau2010" in fs.simulate(made).cite().bibtex


def test_the_heading_of_a_run_names_the_set_and_only_other_changes_one_by_one(pad: fs.Circuit) -> None:
    made = with_set("Fig4-5kHz", with_set("moist", pad))
    run = fs.simulate(made.replace({"Xgap.d": 4e-6}), t_stop=1e-3)
    lines = str(run).splitlines()
    assert lines[0] == f"{pad.title} (changed: set moist, set Fig4-5kHz, Xgap.d = 4 um)"
    assert lines[1] == "Vdrive: Sine(200 V, 5 kHz)"


@pytest.mark.parametrize("name", ["moist", "Fig5-100Hz", "Tanvas-like"])
def test_a_stored_run_and_a_copied_circuit_still_know_their_sets(name: str, pad: fs.Circuit, tmp_path: Path) -> None:
    made = with_set(name, pad).replace({"Xgap.d": 4e-6})
    run = fs.simulate(made, t_stop=1e-3, rtol=1e-5)
    loaded = fs.load(run.to_netcdf(tmp_path / "x.nc"))
    assert loaded.circuit.sets == made.sets
    assert str(loaded.cite()) == str(run.cite())
    assert pickle.loads(pickle.dumps(made)).sets == dataclasses.replace(made, title="x").sets == made.sets


def test_a_stored_run_with_a_function_or_an_included_file_still_cites(pad: fs.Circuit, tmp_path: Path) -> None:
    run = fs.simulate(with_set("moist", pad), sources=lambda t: 100.0 * t, t_stop=1e-3, rtol=1e-4)
    loaded = fs.load(run.to_netcdf(tmp_path / "x.nc"))
    assert "AliAbbasi2024" in loaded.cite().bibtex
    assert "assumed, not published: Xgap.r, Xgap.mu." in str(loaded.cite())
    (tmp_path / "coat.inc").write_text("Xcoat drive top area LAYER d=1u eps_r=3.9 r=0.2meg\n")
    (tmp_path / "main.cir").write_text(re.sub("(?m)^Xcoat.*$", ".include coat.inc", pad.text))
    run = fs.simulate(with_set("TeslaTouch", fs.read_netlist(tmp_path / "main.cir")), t_stop=1e-3, rtol=1e-4)
    assert "Bau2010" in fs.load(run.to_netcdf(tmp_path / "y.nc")).cite().bibtex


def test_a_run_of_scipys_method_cites_scipy_and_works_that_only_give_a_range_are_not_cited(pad: fs.Circuit) -> None:
    made = with_set("Forsbach2021", pad)
    cited = fs.simulate(made, method="scipy:LSODA", t_stop=1e-4, rtol=1e-4).cite()
    assert [r.key for r in cited.references] == ["Forsbach2021", "fingerspice", "Hess2020", "SciPy"]
    assert cited.references[-1].doi == "10.1038/s41592-019-0686-2"
    assert "The method scipy:LSODA" in str(cited)
    assert "Balasubramanian2025" in {r.key for r in fs.parameters("Forsbach2021").references}


def test_the_bibtex_has_one_entry_for_every_reference_and_closes_its_braces() -> None:
    for one in references().values():
        entry = one.bibtex()
        assert entry.startswith(f"@{one.kind}{{{one.key},\n")
        assert entry.count("{") == entry.count("}")
        assert one.text().endswith(".")
    assert "pages = {39--49}" in references()["Forsbach2021"].bibtex()
    assert "Heß, Markus" in references()["Hess2020"].bibtex()


# The command line, the explorer and the page.


def applied(command: Command, *words: str, deck: str = "pad.cir") -> tuple[list[str], dict[str, str]]:
    """The sets and overrides in the answer of `plan`, or of `run` where the options belong to it."""
    if set(words) & {"--finger", "--coating", "--drive"}:
        result = command("run", deck, *words, "--json", "--no-plot", "--stop", "0.5m", "--overwrite")
    else:
        result = command("plan", deck, *words, "--json")
    assert result.code == 0, result.err
    found = json.loads(result.out)
    return found["sets"], found["overrides"]


def test_the_options_apply_sets_and_later_ones_have_the_last_word(command: Command) -> None:
    sets, changed = applied(command, "--finger", "Moist", "--coating", "3m-insulating", "--drive", "Fig4-5kHz")
    assert sets == ["moist", "3M-insulating", "Fig4-5kHz"]
    assert (changed["Xgap.r"], changed["Xcoat.r"]) == ("100000.0", "inf")
    assert changed["Vdrive"].startswith("Sine(amplitude=200.0, frequency=5000.0")
    sets, changed = applied(
        command, "--finger", "dry", "--set", "Forsbach2021", "--set", "Xgap.r=2meg", "--set", "light"
    )
    assert sets == ["Forsbach2021", "light", "dry"]
    assert [changed[f"Xgap.{key}"] for key in ("r", "mu", "fn")] == ["2meg", "0.2", "0.2"]
    assert applied(command)[0] == applied(command, "--set", "Xgap.d=3u")[0] == []


def test_the_sets_are_listed_and_shown(command: Command) -> None:
    listed = command("sets")
    assert listed.out.strip() == str(fs.parameters())
    assert command("sets", "MOIST").out.strip() == str(fs.parameters("moist"))
    rows = json.loads(command("sets", "--json").out)["parameter_sets"]
    assert [row["name"] for row in rows] == NAMES
    (glass,) = json.loads(command("sets", "thick-glass", "--json").out)["parameter_sets"]
    leak = next(value for value in glass["values"] if value["parameter"] == "r")
    assert (leak["value"], leak["unit"], leak["low"], leak["assumed"]) == (None, "ohm", 1e9, True)
    refused = command("sets", "moits")
    assert (refused.code, refused.err) == (2, "fingerspice: unknown set 'moits'; nearest: 'moist', 'light'\n")


@pytest.mark.parametrize(("example", "name"), [("wet", "moist"), ("dry", "dry")])
def test_the_fingers_of_the_explorer_are_those_of_the_sets(example: str, name: str) -> None:
    decks = {one["name"]: one["request"]["deck"] for one in EXAMPLES}
    assert values(fs.parse_netlist(decks[example])) == values(with_set(name, fs.parse_netlist(decks["sine"])))


def test_the_page_has_the_tables_of_the_sets() -> None:
    page = sets_page.PAGE.read_text(encoding="utf-8")
    assert page == sets_page.filled(page), "run: python tests/sets_page.py"
