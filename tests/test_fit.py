"""Fits find true values again, with intervals that cover them, say what data cannot tell, and refuse bad data."""

import dataclasses
import json
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from analytic import impedance, table1_layers
from fingerspice.base.errors import InputError
from fingerspice.studies import fit as circuitfit
from fingerspice.studies.fit.fitting import Fitted, followed
from scenes import CIRCUITS, cases, covers, listed, refuses, shipped, table1, table1_deck, warns

TRUE = {"Xgap.d": 3.1e-6, "Xgap.r": 1.4e6, "Xgap.alpha": 48.0}
Data = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def quiet(circuit: fs.Circuit) -> fs.Circuit:
    return circuit.replace({"Vdrive.amplitude": 1.0})


def force_of(circuit: fs.Circuit, u: float, f: float) -> float:
    """Mean force (N) at a voltage and frequency, whose data the skin has."""
    at = {"Vdrive.amplitude": u, "Vdrive.frequency": f, "Xskin.f": f}
    return float(fs.steady_state(circuit, parameters=at, rtol=1e-9).f_el_mean)


def measured(circuit: fs.Circuit, amplitudes: list[float], frequencies: list[float]) -> Data:
    """Mean forces of a known finger without noise."""
    u, f = (x.ravel() for x in np.meshgrid(amplitudes, frequencies))
    finger = circuit.replace(dict(TRUE))
    force = [force_of(finger, *at) for at in zip(u, f, strict=True)]
    return {"Vdrive.amplitude": u, "source.frequency": f, "f_el_mean": np.array(force)}


def covered(found: fs.Fit) -> int:
    """How many intervals hold the true value."""
    return sum(e.low <= TRUE[path] <= e.high for path, e in found.estimates.items())


@pytest.fixture(scope="module")
def example(circuit: fs.Circuit) -> fs.Fit:
    return fs.fit(
        circuit, CIRCUITS / "measured.csv", ["Xgap.d", "Xgap.r"], skin="follow", starts=1, profiles=["xgap.d"]
    )


@pytest.fixture(scope="module")
def data(circuit: fs.Circuit) -> Data:
    return measured(circuit, [100.0, 200.0], [30.0, 100.0, 500.0])


def test_true_values_are_found_again(circuit, data):
    found = fs.fit(circuit, data, list(TRUE), skin="follow")
    for path, value in TRUE.items():
        assert found.estimates[path].value == pytest.approx(value, rel=1e-4)
        assert found.circuit.parameters[path].value == found.estimates[path].value
    assert np.abs(found.residual).max() < 1e-6 * np.abs(data["f_el_mean"]).max()
    assert found.notes == ()
    assert max(found.objectives) < 1e-8


@pytest.mark.parametrize(
    ("kind", "said"), [("given", "as given"), ("equal", "equal for all"), ("shares", "as equal shares of the values")]
)
def test_intervals_cover_the_truth_and_an_unknown_sigma_is_of_the_likelier_kind(circuit, kind, said):
    more = measured(circuit, [60.0, 120.0, 200.0], [30.0, 100.0, 500.0])
    force, rng, count, hits = more["f_el_mean"], np.random.default_rng(0), cases(30, 2), 0
    sigma = 0.02 * (np.full(force.size, force.mean()) if kind == "equal" else force)
    finger = circuit.replace({"Xgap.alpha": TRUE["Xgap.alpha"]})
    for number in range(count):
        noisy = {**more, "f_el_mean": force + sigma * rng.standard_normal(force.size)}
        if kind == "given":
            noisy["sigma"] = sigma
        found = fs.fit(finger, noisy, ["Xgap.d", "Xgap.r"], starts=1, rtol=1e-5, skin="follow")
        hits += covered(found)
        if number == 0:
            assert f"{said}\n" in str(found)
            np.testing.assert_allclose(found.sigma / sigma, found.sigma[0] / sigma[0], rtol=0.1)
    assert covers(hits, 2 * count)


def test_a_signal_over_time_which_noise_may_take_below_0(circuit):
    t, true = np.linspace(0.0, 0.02, 41), {"Xgap.d": 3.1e-6, "Xgap.r": 1.4e6}
    force = fs.simulate(circuit.replace(true), t_eval=t, rtol=1e-9).f_el
    found = fs.fit(circuit, {"t": t, "f_el": force}, list(true)).estimates
    for (path, value), rel in zip(true.items(), (1e-5, 1e-4), strict=True):
        assert found[path].value == pytest.approx(value, rel=rel)
    noisy = fs.simulate(circuit, t_eval=t, rtol=1e-9).f_el + 5e-3 * np.random.default_rng(2).standard_normal(t.size)
    assert noisy.min() < 0.0
    found = fs.fit(circuit, {"t": t, "f_el": noisy}, ["Xgap.d"]).estimates
    assert found["Xgap.d"].value == pytest.approx(circuit.parameters["Xgap.d"].value, rel=1e-2)


def test_the_source_may_be_fitted_by_its_short_name():
    circuit, t = table1(), np.linspace(0.0, 0.02, 41)
    force = fs.simulate(circuit.replace({"Vdrive.amplitude": 170.0}), t_eval=t, rtol=1e-9).f_el
    found = fs.fit(circuit, {"t": t, "f_el": force}, ["source.amplitude"], bounds={"SOURCE.amplitude": (150.0, 250.0)})
    assert found.estimates["Vdrive.amplitude"].value == pytest.approx(170.0, rel=1e-6)


def test_what_one_voltage_cannot_tell_is_said(circuit):
    # One frequency at one voltage has one mean force, from which no two parameters follow.
    rng = np.random.default_rng(1)
    for _ in range(cases(3, 1)):
        true = circuit.replace({path: value * np.exp(0.2 * rng.standard_normal()) for path, value in TRUE.items()})
        force = fs.steady_state(true, rtol=1e-8).f_el_mean * (1.0 + 0.02 * rng.standard_normal(6))
        start = true.replace({path: circuit.parameters[path].value for path in ("Xgap.d", "Xgap.alpha")})
        data = {"Vdrive.amplitude": [200.0] * 6, "f_el_mean": force}
        (note,) = fs.fit(start, data, ["Xgap.d", "Xgap.alpha"], starts=1, rtol=1e-5).notes
        assert "Xgap.d and Xgap.alpha are not told apart" in note
        assert "Measure at a second voltage as well" in note


def test_a_network_is_fitted_by_differences_and_its_skin_follows_the_source():
    circuit = shipped("amplifier")
    ends = "gap.d", "skin.f", ".amplitude", ".frequency"
    path, skin, amplitude, frequency = (next(p for p in circuit.parameters if p.endswith(end)) for end in ends)
    gap = 0.9 * circuit.parameters[path].value
    data = {amplitude: np.array([0.5, 1.0]) * circuit.parameters[amplitude].value, frequency: np.array([50.0, 200.0])}
    at = [{path: gap, skin: f, amplitude: u, frequency: f} for u, f in zip(*data.values(), strict=True)]
    data["f_el_mean"] = np.array([fs.steady_state(circuit, parameters=one).f_el_mean for one in at])
    found = fs.fit(circuit, data, [path], skin="follow", starts=1, rtol=1e-8)
    assert found.estimates[path].value == pytest.approx(gap, rel=1e-5)


def test_circuits_that_have_no_such_mean_are_refused(circuit):
    two = shipped("two_fingers")
    for other, said in (
        (two, "the circuit has 2 GAPs; allowed: one"),
        (dataclasses.replace(circuit, tran=None), "the deck has no .tran, and average is 'run'; allowed"),
    ):
        refuses(said, fs.fit, other, ONE, [f"{other.by_device('GAP')[0].name}.d"], average="run")
    with pytest.raises(InputError, match="none of the starts can be run: the source has no fundamental: "):
        fs.fit(shipped("am_carrier"), {"Xgap.d": [3e-6], "impedance": [1e5]}, ["Xcoat.d"], starts=1)


def test_shares_that_fit_to_the_last_bit_are_the_likelier_errors(circuit, data, monkeypatch):
    calls: list[Fitted] = []

    def exact(*given: Any) -> Fitted:
        calls.append(followed(*given))
        return calls[-1]._replace(objective=0.0 if len(calls) > 1 else 1e-20)

    monkeypatch.setattr(circuitfit, "followed", exact)
    assert fs.fit(circuit, data, ["Xgap.d"], starts=1, rtol=1e-4, skin="follow").objective == 0.0


ONE = {"f_el_mean": [1e-2]}


def by(**groups: object) -> dict[str, object]:
    return {"groups": groups}


@pytest.mark.parametrize(
    ("data", "options", "text"),
    [
    *listed("fits"),
    ({"frequency": [1e3], "impedance": [1j], "impedance_phase": [1.0]}, {},
         "impedance is complex, and impedance_phase is given"),
    ({"frequency": [1e3, 2e3], "impedance": np.ma.array([1j, 2j], mask=[True, False])}, {},
         "'impedance' is .*MaskedArray with masked values; allowed: numbers"),
    ({"impedance": [1.0], "sigma": [1j]}, {}, "'sigma' is .*of complex numbers; allowed: numbers"),
],
)  # fmt: skip
def test_bad_requests_are_refused_in_one_line(circuit, tmp_path, data, options, text):
    if isinstance(data, str):
        (tmp_path / "data.csv").write_text(data)
        data = tmp_path / "data.csv"
    with pytest.raises(InputError, match=text) as told:
        fs.fit(circuit, data, **{"parameters": ["Xgap.d"], **options})  # type: ignore[arg-type]
    assert "\n" not in str(told.value)


def test_a_profile_of_clear_data_is_the_interval_of_the_derivatives(circuit, example):
    assert list(example.profiles) == ["Xgap.d"]
    profile, estimate = example.profiles["Xgap.d"], example.estimates["Xgap.d"]
    assert profile.shape == "symmetric"
    reach = np.log(estimate.high / estimate.low)
    # At the ends of the interval the best fit is worse by the quantile of chi squared.
    assert profile.limit == pytest.approx(example.objective + 3.8415, rel=1e-4)
    for end, known in ((profile.low, estimate.low), (profile.high, estimate.high)):
        assert np.log(end / known) == pytest.approx(0.0, abs=0.03 * reach)
        held = circuit.replace({"Xgap.d": end})
        again = fs.fit(held, CIRCUITS / "measured.csv", ["Xgap.r"], skin="follow", starts=1)
        assert again.objective == pytest.approx(profile.limit, abs=0.1)
    assert "profile of Xgap.d" in str(example)


def test_a_profile_says_where_the_data_set_no_end(circuit):
    # Far above the corner of the gap's resistance and capacitance, a larger resistance changes nothing.
    frequency = np.array([5e3, 7e3, 1e4, 2e4])
    runs = [fs.steady_state(circuit.replace({"Vdrive.frequency": f}), rtol=1e-8).solution.f_el_mean for f in frequency]
    data = {"source.frequency": frequency, "f_el_mean": runs, "sigma": 0.02 * np.array(runs)}
    found = fs.fit(circuit, data, ["Xgap.r"], starts=1, profiles=True)
    profile = found.profiles["Xgap.r"]
    assert profile.shape == "open above"
    assert profile.high == np.inf
    assert 0.0 < profile.low < 1e6
    bounded = fs.fit(circuit, data, ["Xgap.r"], starts=1, bounds={"Xgap.r": (1e4, 1e7)}, profiles=True)
    assert bounded.profiles["Xgap.r"].high == 1e7


def impedances(quiet: fs.Circuit, f: np.ndarray) -> np.ndarray:
    """What the source of Table 1's finger with other values sees, from the layers in series (Eq. 9)."""
    circuit = quiet.replace({"Xgap.d": 3.1e-6, "Xgap.r": 1.4e6})
    out = []
    for x, area in zip(f, fs.phasor(circuit, f).area, strict=True):
        coat, gap, skin = table1_layers(x)
        # Of the gap: 3.1 um instead of 3.5, and 1.4 Mohm instead of 1.
        out.append(impedance(x, area, (coat, dataclasses.replace(gap, c=gap.c * 3.5 / 3.1, r_total=1.4e6), skin)))
    return np.array(out)


def test_an_impedance_against_frequency(quiet, tmp_path):
    f = np.geomspace(20.0, 2e4, 4)
    z = impedances(quiet, f)
    # From a table in kilohm, as magnitudes alone, and as complex numbers.
    table = np.column_stack([1e-3 * f, 1e-3 * np.abs(z), np.angle(z, deg=True)])
    head = "frequency (kHz),impedance (kohm),impedance_phase (deg)"
    np.savetxt(tmp_path / "z.csv", table, "%.12g", ",", header=head, comments="")
    sizes = {"frequency": f, "impedance": np.abs(z)}
    for given, count in ((tmp_path / "z.csv", 8), (sizes, 4), ({"frequency": f, "impedance": z.tolist()}, 8)):
        found = fs.fit(quiet, given, ["Xgap.d", "Xgap.r"], skin="follow")
        assert found.estimates["Xgap.d"].value == pytest.approx(3.1e-6, rel=1e-6)
        assert found.estimates["Xgap.r"].value == pytest.approx(1.4e6, rel=1e-6)
        assert found.freedom == count - 2
        np.testing.assert_allclose(found.predicted, np.abs(z), rtol=1e-6)
    assert "values of impedance" in str(found)
    found.plot()


def test_intervals_from_noisy_impedances_cover_the_truth(quiet):
    f, rng, count, hits = np.geomspace(20.0, 2e4, 6), np.random.default_rng(5), cases(25, 2), 0
    z = impedances(quiet, f)
    for _ in range(count):
        noisy = z * (1.0 + 0.02 * (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)))
        data = {"frequency": f, "impedance": np.abs(noisy), "impedance_phase": np.degrees(np.angle(noisy))}
        hits += covered(fs.fit(quiet, data, ["Xgap.d", "Xgap.r"], skin="follow"))
    assert covers(hits, 2 * count)


def grouped(circuit: fs.Circuit, gaps: dict[str, float], leak: float) -> dict[str, list[object]]:
    """Mean forces of several fingers on one coating, without noise."""
    rows = [
        (label, u, f, force_of(circuit.replace({"Xgap.d": d, "Xcoat.r": leak}), u, f))
        for label, d in gaps.items()
        for u, f in ((100.0, 30.0), (200.0, 30.0), (200.0, 1000.0))
    ]
    names = ("finger", "Vdrive.amplitude", "source.frequency", "f_el_mean")
    return dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))


GAPS = {"left": 3.1e-6, "right": 3.9e-6}


def test_each_group_has_its_own_parameters_and_all_share_the_others(circuit):
    data = grouped(circuit, GAPS, 4e5)
    options: dict[str, Any] = {"groups": {"finger": ["xgap.d"]}, "skin": "follow", "starts": 1}
    found = fs.fit(circuit, data, ["Xgap.d", "xcoat.r"], **options)
    assert list(found.estimates) == ["Xgap.d[left]", "Xgap.d[right]", "Xcoat.r"]
    assert found.freedom == 3
    for label, d in GAPS.items():
        assert found.estimates[f"Xgap.d[{label}]"].value == pytest.approx(d, rel=1e-5)
        assert found.circuits[label].parameters["Xgap.d"].value == pytest.approx(d, rel=1e-5)
        assert found.circuits[label].parameters["Xcoat.r"].value == pytest.approx(4e5, rel=1e-4)
    assert found.circuit.parameters["Xgap.d"].value == pytest.approx(np.sqrt(3.1e-6 * 3.9e-6), rel=1e-5)
    assert "groups by finger: left, right" in str(found)
    # Two curves (left and right) for each voltage or frequency.
    labels = found.plot().axes[0].get_legend_handles_labels()[1]
    assert sum("finger = left" in text for text in labels) == sum("finger = right" in text for text in labels) > 0
    # One gap for both cannot describe them.
    same = {name: x for name, x in data.items() if name != "finger"}
    one = fs.fit(circuit, same, ["Xgap.d", "Xcoat.r"], skin="follow", starts=1)
    assert one.objective > 1e4 * found.objective
    # A profile of one group's parameter leaves the others free.
    data["sigma"] = (0.02 * np.array(data["f_el_mean"], float)).tolist()
    found = fs.fit(circuit, data, ["Xgap.d", "Xcoat.r"], **options, rtol=1e-5, profiles=["Xgap.d[left]"])
    profile, estimate = found.profiles["Xgap.d[left]"], found.estimates["Xgap.d[left]"]
    assert (profile.low, profile.high) == pytest.approx((estimate.low, estimate.high), rel=2e-3)


def test_groups_of_impedances_are_fitted_by_differences(quiet):
    f = np.geomspace(20.0, 2e4, 2)
    z = [fs.phasor(quiet.replace({"Xgap.d": d}), f, skin="swept").impedance for d in GAPS.values()]
    data = {"frequency": np.tile(f, 2), "impedance": np.abs(np.concatenate(z)), "finger": np.repeat([1.0, 2.0], f.size)}
    # An AC of the deck is not the amplitude of the meter.
    for circuit in (quiet, fs.parse_netlist(table1_deck("SIN(0 1 100) AC 500"))):
        found = fs.fit(circuit, data, ["Xgap.d"], groups={"finger": ["Xgap.d"]}, skin="follow")
        assert found.estimates["Xgap.d[1]"].value == pytest.approx(3.1e-6, rel=1e-6)
        assert found.estimates["Xgap.d[2]"].value == pytest.approx(3.9e-6, rel=1e-6)


def test_the_command_fits_the_tables_of_the_examples(command):
    grouped = {"Xgap.d[left]": 3.1e-6, "Xgap.d[right]": 3.6e-6, "Xgap.d[thumb]": 4.2e-6, "Xcoat.r": 4e5}
    for table, words, true, groups in (
        ("measured.csv", ("Xgap.d,Xgap.r,Xgap.alpha",), TRUE, []),
        ("fingers.csv", ("Xgap.d,Xcoat.r", "--groups", "finger:Xgap.d"), grouped, ["left", "right", "thumb"]),
    ):
        places = str(CIRCUITS / table), str(CIRCUITS / "fingerpad.cir")
        out = table.partition(".")[0]
        answer = command("fit", *places, "--free", *words, "--skin", "follow", "--out", out, "--json").ok().json
        assert answer["groups"] == groups
        rows = {row["path"]: row["low"] < true[row["path"]] < row["high"] for row in answer["parameters"]}
        assert rows == dict.fromkeys(true, True)
        assert {"fingerpad_fit.csv", "fingerpad_fit.png"} <= {p.name for p in Path(out).iterdir()}
    lines = Path("fingers/fingerpad_fit.csv").read_text().splitlines()
    assert lines[0].startswith("finger,Vdrive.amplitude")
    assert lines[1].startswith("left,100.0,20.0,")
    again = np.genfromtxt("measured/fingerpad_fit.csv", delimiter=",", names=True)
    assert again["f_el"] == pytest.approx(again["fitted"], rel=0.1)


def test_residuals_beyond_the_given_sigma_are_named(circuit, data):
    wrong = data["f_el_mean"] * (1.0 + 0.1 * (-1.0) ** np.arange(data["f_el_mean"].size))
    found = fs.fit(circuit, {**data, "f_el_mean": wrong, "sigma": 0.01 * wrong}, ["Xgap.d"], starts=1, skin="follow")
    assert any("times as large as sigma" in note and "so are the intervals" in note for note in found.notes)


def test_the_example_finds_its_finger_and_predicts_another_force(capsys, tmp_path):
    program = runpy.run_path(str(CIRCUITS / "fit_finger.py"))
    found = program["fitted"]()
    program["main"].__globals__["fitted"] = lambda: found
    program["main"](tmp_path)
    said = capsys.readouterr().out
    assert (tmp_path / "fit_finger.png").stat().st_size > 10_000
    assert covered(found) == len(TRUE)
    middle, low, high = program["predicted"](found)
    assert low < force_of(shipped("fingerpad").replace(dict(TRUE)), 180.0, 300.0) < high
    assert f"force at 180 V and 300 Hz: {1e3 * middle:.4g} mN" in said
    # The force is known better than the area, as the errors of gap and area are correlated.
    area, least, most = program["area_at_rest"](found)
    assert least < TRUE["Xgap.alpha"] * 0.5**0.52 < most
    assert (high - low) / middle < 0.3 * (most - least) / area


def test_a_report_has_the_layout_of_lmfit(example):
    lines, one = example.report().splitlines(), example.estimates["Xgap.d"]
    heads = [line for line in lines if line.startswith("[[")]
    assert heads == ["[[Fit Statistics]]", "[[Variables]]", "[[Correlations]] (unreported correlations are < 0.100)"]
    pairs = (line.strip().lstrip("# ").split(" = ") for line in lines[1:9])
    numbers = {name.strip(): float(value) for name, value in pairs if name.strip() != "fitting method"}
    assert (numbers["data points"], numbers["variables"]) == (15, 2)
    chi = numbers["chi-square"]
    assert chi == pytest.approx(float(np.sum((example.residual / example.sigma) ** 2)), rel=1e-6)
    assert numbers["reduced chi-square"] == pytest.approx(chi / 13)
    assert numbers["Akaike info crit"] == pytest.approx(15 * np.log(chi / 15) + 4)
    assert numbers["Bayesian info crit"] == pytest.approx(15 * np.log(chi / 15) + 2 * np.log(15))
    share = f"({100 * one.error / one.value:.2f}%)"
    assert f"    Xgap.d:  {one.value:.8g} +/- {one.error:.8g} {share} (init = 3.5e-06)" in lines
    assert lines[-1] == f"    C(Xgap.d, Xgap.r) = {example.correlation[0, 1]:+.4f}"


def test_a_skin_held_at_one_frequency_is_told_and_biases_the_fit(circuit, data, command):
    said = r"Xskin takes its data at f = 100 Hz, the source's fundamental is 30 to 500 Hz; with skin 'follow'"
    finger = circuit.replace({path: TRUE[path] for path in ("Xgap.r", "Xgap.alpha")})
    held = warns(said, fs.fit, finger, data, ["Xgap.d"], starts=1)
    followed = fs.fit(finger, data, ["Xgap.d"], starts=1, skin="follow")
    assert followed.estimates["Xgap.d"].value == pytest.approx(TRUE["Xgap.d"], rel=1e-5)
    assert abs(held.estimates["Xgap.d"].value / TRUE["Xgap.d"] - 1.0) > 0.01
    for path, at in (("Vdrive.frequency", [30.0, 500.0]), ("Xskin.f", [100.0, 200.0])):
        for study in (fs.batch, fs.sweep):
            with pytest.warns(fs.FingerspiceWarning, match="Xskin takes its data at f = .*the source's fundamental is"):
                study(circuit, {path: at}, periodic=True)
    Path("sweep.toml").write_text(
        'deck = "pad.cir"\nperiodic = true\n[parameters]\n"source.frequency" = { values = [30, 500] }\n'
    )
    result = command("sweep", "sweep.toml", "--json", "--no-plot")
    assert any(text.startswith("Xskin takes its data at f =") for text in json.loads(result.out)["warnings"])


def test_a_skin_that_suits_every_source_is_not_told(circuit, tmp_path, recwarn):
    both = {"Vdrive.frequency": [30.0, 500.0], "Xskin.f": [30.0, 500.0]}
    fs.batch(circuit, both, periodic=True)
    fs.batch(circuit, {"Vdrive.frequency": [30.0, 500.0]}, periodic=True, skin="follow")
    fs.batch(circuit, {"Vdrive.amplitude": [30.0, 500.0]}, periodic=True)
    fs.sweep(circuit, {"Vdrive.frequency,Xskin.f": [0.3, 5.0]}, periodic=True, store=tmp_path / "sweep.zarr")
    assert not [one for one in recwarn if "takes its data" in str(one.message)]
    # A stored sweep of a skin held at one frequency tells once of it.
    with pytest.warns(fs.FingerspiceWarning, match="the source's fundamental is 100 to 400 Hz") as told:
        fs.sweep(circuit, {"Vdrive.frequency": [100.0, 200.0, 400.0]}, periodic=True, store=tmp_path / "held.zarr")
    assert len([one for one in told if "takes its data" in str(one.message)]) == 1


@pytest.mark.parametrize(("column", "factor", "row", "said"), listed("data_in_another_unit"))
def test_data_in_another_unit_are_told_and_end_in_a_bounded_number_of_evaluations(
    circuit, data, column, factor, row, said
):
    # Of one value: many of these evaluations are far from any finger, and slow.
    some = {key: (factor if key == column else 1.0) * x[[row]] for key, x in data.items()}
    found = warns(said, fs.fit, circuit, some, ["Xgap.d"], starts=1, rtol=1e-4, skin="follow")
    assert found.evaluations <= 40
    assert "sigma unknown, as there are no more values than parameters" in str(found)
    assert 1e-3 <= found.estimates["Xgap.d"].value / 3.5e-6 <= 1e3


def test_the_axes_of_a_fits_picture_have_names_and_units(circuit, example):
    top, bottom = example.plot().axes
    assert (top.get_ylabel(), bottom.get_xlabel()) == ("mean electroadhesive force [N]", "frequency of Vdrive [Hz]")
    assert top.get_legend_handles_labels()[1] == [f"amplitude of Vdrive = {u} V" for u in (100, 150, 200)]
    loads = {"Xgap.fn": [0.3, 0.5], "f_t_mean": [0.1, 0.17]}
    _, bottom = fs.fit(circuit, loads, ["Xgap.d"], starts=1, rtol=1e-4).plot().axes
    assert bottom.get_xlabel() == "load of Xgap [N]"


def test_a_start_outside_its_bounds_moves_into_them_and_a_value_at_one_is_named(circuit, data):
    finger = circuit.replace({path: TRUE[path] for path in ("Xgap.r", "Xgap.alpha")})
    said = r"Xgap\.d is 3\.5e-06, outside its bounds 2e-06 to 3\.3e-06: it starts at 3\.3e-06"
    found = warns(said, fs.fit, finger, data, ["Xgap.d"], bounds={"Xgap.d": (2e-6, 3.3e-6)}, starts=1, skin="follow")
    assert found.estimates["Xgap.d"].value == pytest.approx(TRUE["Xgap.d"], rel=1e-5)
    assert found.estimates["Xgap.d"].initial == 3.3e-6
    found = fs.fit(circuit, data, ["Xgap.d", "Xgap.r"], bounds={"Xgap.d": (3.45e-6, 4e-6)}, starts=1, skin="follow")
    assert found.estimates["Xgap.d"].at_bound
    assert any("at its bound" in note for note in found.notes)


def test_sigma_in_percent_is_a_share_of_every_value(circuit, data, tmp_path):
    columns = [data["Vdrive.amplitude"], data["source.frequency"], 1e3 * data["f_el_mean"]]
    rows = [",".join(f"{x:.9g}" for x in row) for row in zip(*columns, strict=True)]
    head = "Vdrive.amplitude (V),frequency (Hz),f_el_mean (mN)"
    (tmp_path / "a.csv").write_text("\n".join([f"sigma (%),{head}", *(f"3,{row}" for row in rows)]))
    found = fs.fit(circuit, tmp_path / "a.csv", ["Xgap.d"], starts=1, rtol=1e-4, skin="follow")
    np.testing.assert_allclose(found.data.sigma, 0.03 * data["f_el_mean"], rtol=1e-6)
    # Of a friction coefficient in %, sigma in % is of the same unit.
    (tmp_path / "b.csv").write_text("Vdrive.amplitude (V),friction_mean (%),sigma (%)\n100,31,0.5\n200,36,0.5\n")
    found = fs.fit(circuit, tmp_path / "b.csv", ["Xgap.d"], starts=1, rtol=1e-4)
    np.testing.assert_allclose(found.data.sigma, 0.005)


def test_laws_are_compared_by_akaikes_criterion_or_said_not_to_be_told_apart() -> None:
    """Areas of a contact law with noise: the criterion is that of the residuals, by hand."""
    u = np.array([20.0, 60.0, 100.0, 140.0, 180.0, 220.0, 260.0])
    true = table1(f=100.0).replace({"Xgap.law": "linear", "Xgap.slope": 60.0})
    means = fs.batch(true, {"Vdrive.amplitude": u}, outputs=["area_mean"], periodic=True).area_mean.to_numpy()
    noise = np.array([0.3, -0.5, 0.2, 0.6, -0.4, -0.1, 0.2]) * 1e-8
    laws = {"dmt": ["Xgap.alpha"], "linear": ["Xgap.slope"], "jkr": ["Xgap.alpha"]}
    data = {"Vdrive.amplitude": u, "area_mean": means + noise, "sigma": 4e-9}
    found = fs.compare_laws(table1(f=100.0), data, laws, starts=1)
    assert (found.best, found.told_apart) == ("linear", True)
    assert found.fits["linear"].estimates["Xgap.slope"].value == pytest.approx(60.0, rel=1e-3)
    for name, one in found.fits.items():
        chi2 = float((((means + noise) - one.predicted) ** 2).sum() / 4e-9**2)
        assert found.aic[name] == pytest.approx(chi2 + 2.0 + 4.0 / 5.0, rel=1e-9)
    assert sum(found.weights.values()) == pytest.approx(1.0)
    assert "linear explains these data best of these laws." in str(found)
    # At small voltages, and with errors as large as what the voltage does, no law is told from the others.
    low = {"Vdrive.amplitude": u / 10.0, "area_mean": means[0] * (1.0 + noise * 2e6)}
    close = fs.compare_laws(table1(f=100.0), low, {"dmt": ["Xgap.alpha"], "linear": ["Xgap.slope"]}, starts=1)
    assert not close.told_apart
    assert "but they do not tell it from" in str(close)
    assert close.to_dict()["best"] == close.best


@pytest.mark.parametrize(("laws", "count", "said"), listed("comparisons_of_laws"))
def test_wrong_comparisons_of_laws_are_refused(laws: dict[str, list[str]], count: int, said: str) -> None:
    data = {"Vdrive.amplitude": np.linspace(20.0, 100.0, count), "area_mean": np.linspace(35.0, 35.2, count) * 1e-6}
    refuses(said, fs.compare_laws, table1(), data, laws)
