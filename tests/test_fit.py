"""Fits find true values again, with intervals that cover them, say what data cannot tell, and refuse bad data."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from analytic import table1_layers
from commands import Command
from fingerspice.base.errors import InputError

CIRCUITS = Path(__file__).parents[1] / "circuits"
TRUE = {"Xgap.d": 3.1e-6, "Xgap.r": 1.4e6, "Xgap.alpha": 48.0}


@pytest.fixture(scope="module")
def circuit() -> fs.Circuit:
    return fs.read_netlist(CIRCUITS / "fingerpad.cir")


def measured(circuit: fs.Circuit, amplitudes: list[float], frequencies: list[float]) -> dict[str, np.ndarray]:
    """Mean forces of a known finger without noise."""
    u, f = (x.ravel() for x in np.meshgrid(amplitudes, frequencies))
    finger = circuit.replace({path: TRUE[path] for path in ("Xgap.d", "Xgap.r", "Xgap.alpha")})
    force = [
        fs.steady_state(
            finger, parameters={"Vdrive.amplitude": a, "Vdrive.frequency": b, "Xskin.f": b}, rtol=1e-9
        ).f_el_mean
        for a, b in zip(u, f, strict=True)
    ]
    return {"Vdrive.amplitude": u, "source.frequency": f, "f_el_mean": np.array(force)}


@pytest.fixture(scope="module")
def data(circuit: fs.Circuit) -> dict[str, np.ndarray]:
    return measured(circuit, [100.0, 200.0], [30.0, 100.0, 500.0])


def test_true_values_are_found_again(circuit: fs.Circuit, data: dict[str, np.ndarray]) -> None:
    found = fs.fit(circuit, data, list(TRUE), skin="follow")
    for path, value in TRUE.items():
        assert found.estimates[path].value == pytest.approx(value, rel=1e-4)
        assert found.circuit.parameters[path].value == found.estimates[path].value
    assert np.abs(found.residual).max() < 1e-6 * np.abs(data["f_el_mean"]).max()
    assert found.notes == ()
    assert max(found.objectives) < 1e-8


def test_intervals_cover_the_truth(circuit: fs.Circuit, data: dict[str, np.ndarray]) -> None:
    # 60 intervals of 95 %: fewer than 51 would have a probability of 0.3 % even if errors were independent.
    rng = np.random.default_rng(3)
    covered, paths = 0, ["Xgap.d", "Xgap.r"]
    finger = circuit.replace({"Xgap.alpha": TRUE["Xgap.alpha"]})
    for _ in range(30):
        sigma = 0.02 * data["f_el_mean"]
        noisy = {**data, "f_el_mean": data["f_el_mean"] + sigma * rng.standard_normal(sigma.size), "sigma": sigma}
        found = fs.fit(finger, noisy, paths, starts=1, rtol=1e-5, skin="follow")
        covered += sum(found.estimates[path].low <= TRUE[path] <= found.estimates[path].high for path in paths)
    assert 51 <= covered <= 60


def test_noise_may_take_a_signal_over_time_below_0(circuit: fs.Circuit) -> None:
    t = np.linspace(0.0, 0.02, 41)
    force = fs.simulate(circuit, t_eval=t, rtol=1e-9).f_el + 5e-3 * np.random.default_rng(2).standard_normal(t.size)
    assert force.min() < 0.0
    found = fs.fit(circuit, {"t": t, "f_el": force}, ["Xgap.d"])
    assert found.estimates["Xgap.d"].value == pytest.approx(circuit.parameters["Xgap.d"].value, rel=1e-2)


def test_a_signal_over_time(circuit: fs.Circuit) -> None:
    t = np.linspace(0.0, 0.02, 41)
    force = fs.simulate(circuit.replace({"Xgap.d": 3.1e-6, "Xgap.r": 1.4e6}), t_eval=t, rtol=1e-9).f_el
    found = fs.fit(circuit, {"t": t, "f_el": force}, ["Xgap.d", "Xgap.r"])
    assert found.estimates["Xgap.d"].value == pytest.approx(3.1e-6, rel=1e-5)
    assert found.estimates["Xgap.r"].value == pytest.approx(1.4e6, rel=1e-4)


def test_what_one_voltage_cannot_tell_is_said() -> None:
    # One frequency at one voltage has one mean force, from which no two parameters follow.
    circuit = fs.read_netlist(CIRCUITS / "fingerpad.cir")
    force = fs.steady_state(circuit).f_el_mean
    data = {"Vdrive.amplitude": [200.0] * 3, "f_el_mean": np.array([1.0, 1.01, 0.99]) * force}
    found = fs.fit(circuit, data, ["Xgap.d", "Xgap.alpha"], starts=1)
    assert len(found.notes) == 1
    assert "Xgap.d and Xgap.alpha are not told apart" in found.notes[0]
    assert "Measure at a second voltage as well" in found.notes[0]


def test_a_value_at_its_bound_is_named(circuit: fs.Circuit, data: dict[str, np.ndarray]) -> None:
    found = fs.fit(circuit, data, ["Xgap.d", "Xgap.r"], bounds={"Xgap.d": (3.45e-6, 4e-6)}, starts=1, skin="follow")
    assert found.estimates["Xgap.d"].at_bound
    assert any("at its bound" in note for note in found.notes)


def test_a_network_is_fitted_by_differences() -> None:
    circuit = fs.read_netlist(CIRCUITS / "amplifier.cir")
    path = next(path for path in circuit.parameters if path.endswith("gap.d"))
    gap = circuit.parameters[path].value
    source = next(p for p in circuit.parameters if p.endswith(".amplitude"))
    amplitudes = np.array([0.5, 1.0]) * circuit.parameters[source].value
    force = [fs.steady_state(circuit, parameters={path: 0.9 * gap, source: a}).f_el_mean for a in amplitudes]
    found = fs.fit(circuit, {source: amplitudes, "f_el_mean": force}, [path], rtol=1e-8)
    assert found.estimates[path].value == pytest.approx(0.9 * gap, rel=1e-5)


def test_the_command_reads_a_table_with_units(command: Command, tmp_path: Path) -> None:
    deck, table = CIRCUITS / "fingerpad.cir", CIRCUITS / "measured.csv"
    free = "Xgap.d,Xgap.r,Xgap.alpha"
    result = command("fit", str(table), str(deck), "--free", free, "--skin", "follow", "--out", str(tmp_path), "--json")
    assert result.code == 0
    rows = {row["path"]: row for row in json.loads(result.out)["parameters"]}
    for path, value in TRUE.items():
        assert rows[path]["low"] < value < rows[path]["high"]
    assert {"fingerpad_fit.csv", "fingerpad_fit.png"} <= {p.name for p in tmp_path.iterdir()}
    again = np.genfromtxt(tmp_path / "fingerpad_fit.csv", delimiter=",", names=True)
    assert again["f_el"] == pytest.approx(again["fitted"], rel=0.1)


@pytest.mark.parametrize(
    ("data", "parameters", "text"),
    [
        ({"f_el_mean": [1e-2, 2e-2]}, ["Xgap.dd"], "nearest: 'Xgap.d'"),
        ({"f_el_mean": [1e-2]}, ["Xgap.d", "Xgap.r"], "1 data cannot tell 2 parameters"),
        ({"f_el_mean": [1e-2, np.nan]}, ["Xgap.d"], "is nan in row 1"),
        ({"f_el_mean": [1e-2, 2e-2], "Vdrive.amplitude": [1.0, 2.0, 3.0]}, ["Xgap.d"], "allowed: as many"),
        ({"Vdrive.amplitude": [1.0, 2.0]}, ["Xgap.d"], "no measured column"),
        ({"f_el_mean": [1e-2], "Xgap.d": [3e-6]}, ["Xgap.d"], "is a condition of the data"),
        ({"f_el_mean": [1e-2], "sigma": [0.0]}, ["Xgap.d"], "smallest sigma is 0"),
        ({"f_el_mean": [1e-2, -2e-2]}, ["Xgap.d"], r"f_el_mean is -0\.02 N in row 1; allowed: 0 or more, as the el"),
        ({"friction_mean": [-0.5, 0.5]}, ["Xgap.d"], r"friction_mean is -0\.5 in row 0; allowed: 0 or more"),
        ({"t": [0.0, 0.5], "f_t": [1e-3, -2e-3]}, ["Xgap.d"], r"f_t is -0\.0005 N on average; allowed: 0 or more"),
        ({"frequency": [1.0, 2.0], "impedance": [1e6, 0.0]}, ["Xgap.r"], "is 0 ohm in row 1; allowed: magnitudes ab"),
        ({"t": [1.0, 0.5], "f_el": [0.0, 0.0]}, ["Xgap.d"], "rising times"),
        ([1.0, 2.0], ["Xgap.d"], "data is a list"),
        ({"f_el_mean": [1e-2]}, "Xgap.d", "a sequence of paths"),
        ({"f_el_mean": [1e-2]}, ["Xgap.tau"], "fitted in its logarithm"),
    ],
)
def test_bad_requests(circuit: fs.Circuit, data: object, parameters: object, text: str) -> None:
    with pytest.raises(InputError, match=text):
        fs.fit(circuit, data, parameters)  # type: ignore[arg-type]


def test_bad_tables(circuit: fs.Circuit, tmp_path: Path) -> None:
    table = tmp_path / "data.csv"
    table.write_text("Vdrive.amplitude (A),f_el_mean (mN)\n100,1\n200,4\n")
    with pytest.raises(InputError, match=r"the unit of column 'Vdrive.amplitude' is 'A'; allowed: V"):
        fs.fit(circuit, table, ["Xgap.d"])
    table.write_text("Vdrive.amplitude (V),f_el_mean (mN)\n100,1\n200,-4\n")
    with pytest.raises(InputError, match=r"data\.csv': f_el_mean is -0\.004 N in row 2; allowed: 0 or more") as told:
        fs.fit(circuit, table, ["Xgap.d"])
    assert "\n" not in str(told.value)
    table.write_text("frequency (Hz),impedance (kohm)\n100,-1\n200,4\n")
    with pytest.raises(InputError, match=r"impedance is -1000 ohm in row 1; allowed: magnitudes above 0"):
        fs.fit(circuit, table, ["Xgap.r"])
    table.write_text("100,1\n200,4\n")
    with pytest.raises(InputError, match="has no header"):
        fs.fit(circuit, table, ["Xgap.d"])
    table.write_text("time (ms),friction (mN)\n0,150\n1,160\n")
    with pytest.raises(InputError, match="the unit of column 'friction' is 'mN'; allowed: none"):
        fs.fit(circuit, table, ["Xgap.d"])
    with pytest.raises(InputError, match=r"a column 'voltage', which is no parameter.*conditions, such as X"):
        fs.fit(circuit, {"voltage": [100.0], "f_el_mean": [1e-2]}, ["Xgap.d"])
    with pytest.raises(InputError, match=r"bounds names Xgap\.r, which is not fitted"):
        fs.fit(circuit, {"f_el_mean": [1e-2]}, ["Xgap.d"], bounds={"Xgap.r": (1.0, 2.0)})


def test_a_profile_of_clear_data_is_the_interval_of_the_derivatives() -> None:
    circuit = fs.read_netlist(CIRCUITS / "fingerpad.cir")
    found = fs.fit(circuit, CIRCUITS / "measured.csv", ["Xgap.d", "Xgap.r"], skin="follow", profiles=["xgap.d"])
    assert list(found.profiles) == ["Xgap.d"]
    profile, estimate = found.profiles["Xgap.d"], found.estimates["Xgap.d"]
    assert profile.shape == "symmetric"
    reach = np.log(estimate.high / estimate.low)
    assert np.log(profile.low / estimate.low) == pytest.approx(0.0, abs=0.03 * reach)
    assert np.log(profile.high / estimate.high) == pytest.approx(0.0, abs=0.03 * reach)
    # At the ends of the interval the best fit is worse by the quantile of chi squared.
    assert profile.limit == pytest.approx(found.objective + 3.8415, rel=1e-4)
    for end in (profile.low, profile.high):
        held = circuit.replace({"Xgap.d": end})
        again = fs.fit(held, CIRCUITS / "measured.csv", ["Xgap.r"], skin="follow")
        assert again.objective == pytest.approx(profile.limit, abs=0.1)
    assert "profile of Xgap.d" in str(found)


def test_a_profile_says_where_the_data_set_no_end() -> None:
    circuit = fs.read_netlist(CIRCUITS / "fingerpad.cir")
    # Far above the corner of the gap's resistance and capacitance, a larger resistance changes nothing.
    frequency = np.array([5e3, 7e3, 1e4, 2e4])
    runs = [fs.steady_state(circuit.replace({"Vdrive.frequency": f}), rtol=1e-8).solution.f_el_mean for f in frequency]
    data = {"source.frequency": frequency, "f_el_mean": runs, "sigma": 0.02 * np.array(runs)}
    found = fs.fit(circuit, data, ["Xgap.r"], profiles=True)
    profile = found.profiles["Xgap.r"]
    assert profile.shape == "open above"
    assert profile.high == np.inf
    assert 0.0 < profile.low < 1e6
    bounded = fs.fit(circuit, data, ["Xgap.r"], bounds={"Xgap.r": (1e4, 1e7)}, profiles=True)
    assert bounded.profiles["Xgap.r"].high == 1e7


def test_profiles_of_what_is_not_fitted_are_refused() -> None:
    circuit = fs.read_netlist(CIRCUITS / "fingerpad.cir")
    with pytest.raises(
        fs.InputError, match=r"profiles names 'Xskin\.d', which is not fitted; allowed: True, or Xgap\.d"
    ):
        fs.fit(circuit, CIRCUITS / "measured.csv", ["Xgap.d"], profiles=["Xskin.d"])


def impedances(circuit: fs.Circuit, f: np.ndarray) -> np.ndarray:
    """What the source of Table 1's finger with other values sees, from the layers in series (Eq. 9)."""
    swept = fs.phasor(circuit, f)
    out = []
    for x, area in zip(f, swept.area, strict=True):
        coat, gap, skin = table1_layers(x)
        # Of the gap: 3.1 um instead of 3.5, and 1.4 Mohm instead of 1.
        changed = (coat, dataclasses.replace(gap, c=gap.c * 3.5 / 3.1, r_total=1.4e6), skin)
        w = 2j * np.pi * x
        out.append(sum(1.0 / (1.0 / y.r_total + area / y.r_area + w * y.c * area) for y in changed))
    return np.array(out)


@pytest.mark.parametrize("with_phase", [True, False])
def test_an_impedance_against_frequency(tmp_path: Path, with_phase: bool) -> None:
    quiet = fs.read_netlist(CIRCUITS / "fingerpad.cir").replace({"Vdrive.amplitude": 1.0})
    f = np.geomspace(20.0, 2e4, 12)
    finger = quiet.replace({"Xgap.d": 3.1e-6, "Xgap.r": 1.4e6})
    z = impedances(finger, f)
    data = {"frequency": f, "impedance": np.abs(z), "impedance_phase": np.degrees(np.angle(z))}
    if not with_phase:
        del data["impedance_phase"]
    found = fs.fit(quiet, data, ["Xgap.d", "Xgap.r"], skin="follow")
    assert found.estimates["Xgap.d"].value == pytest.approx(3.1e-6, rel=1e-6)
    assert found.estimates["Xgap.r"].value == pytest.approx(1.4e6, rel=1e-6)
    assert found.freedom == (24 if with_phase else 12) - 2
    np.testing.assert_allclose(found.predicted, np.abs(z), rtol=1e-6)
    assert "values of impedance" in str(found)
    found.plot()
    # From a table in kilohm.
    head = "frequency (kHz),impedance (kohm)" + (",impedance_phase (deg)" if with_phase else "")
    rows = [f"{x / 1e3:.12g},{abs(y) / 1e3:.12g}" for x, y in zip(f, z, strict=True)]
    if with_phase:
        rows = [f"{row},{np.degrees(np.angle(y)):.12g}" for row, y in zip(rows, z, strict=True)]
    (tmp_path / "z.csv").write_text("\n".join([head, *rows]))
    again = fs.fit(quiet, tmp_path / "z.csv", ["Xgap.d", "Xgap.r"], skin="follow")
    assert again.estimates["Xgap.d"].value == pytest.approx(3.1e-6, rel=1e-6)


def test_a_complex_impedance_counts_as_a_whole() -> None:
    quiet = fs.read_netlist(CIRCUITS / "fingerpad.cir").replace({"Vdrive.amplitude": 1.0})
    f = np.geomspace(20.0, 2e4, 6)
    z = impedances(quiet.replace({"Xgap.d": 3.1e-6, "Xgap.r": 1.4e6}), f)
    for given in (z, z.tolist()):
        found = fs.fit(quiet, {"frequency": f, "impedance": given}, ["Xgap.d", "Xgap.r"], skin="follow")
        assert found.estimates["Xgap.r"].value == pytest.approx(1.4e6, rel=1e-6)
        assert found.freedom == 2 * f.size - 2
    for data, said in (
        ({"impedance": z, "impedance_phase": np.angle(z)}, "impedance is complex, and impedance_phase is given"),
        (
            {"impedance": np.ma.array(z, mask=f > 1e3)},
            "'impedance' is .*MaskedArray with masked values; allowed: numbers",
        ),
        ({"impedance": np.abs(z), "sigma": 1j * np.abs(z)}, "'sigma' is .*of complex numbers; allowed: numbers"),
    ):
        with pytest.raises(InputError, match=said):
            fs.fit(quiet, {"frequency": f, **data}, ["Xgap.d"])


def test_intervals_from_noisy_impedances_cover_the_truth() -> None:
    quiet = fs.read_netlist(CIRCUITS / "fingerpad.cir").replace({"Vdrive.amplitude": 1.0})
    f, rng, covered = np.geomspace(20.0, 2e4, 10), np.random.default_rng(5), 0
    z = impedances(quiet.replace({"Xgap.d": 3.1e-6, "Xgap.r": 1.4e6}), f)
    for _ in range(25):
        noisy = z * (1.0 + 0.02 * (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)))
        data = {"frequency": f, "impedance": np.abs(noisy), "impedance_phase": np.degrees(np.angle(noisy))}
        found = fs.fit(quiet, data, ["Xgap.d", "Xgap.r"], skin="follow")
        for path, value in (("Xgap.d", 3.1e-6), ("Xgap.r", 1.4e6)):
            covered += found.estimates[path].low <= value <= found.estimates[path].high
    # 50 intervals of 95 %: fewer than 42 would have a probability of 0.3 %.
    assert 42 <= covered <= 50


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"frequency": [1e3, 2e3], "impedance": [1e5, -1e5]}, "magnitudes above 0"),
        ({"frequency": [1e3, 2e3], "f_el_mean": [0.1, 0.2], "impedance_phase": [-30.0, -40.0]}, "beside impedance"),
    ],
)
def test_bad_impedances_are_refused(data: dict[str, list[float]], said: str) -> None:
    circuit = fs.read_netlist(CIRCUITS / "fingerpad.cir")
    with pytest.raises(fs.InputError, match=said):
        fs.fit(circuit, data, ["Xgap.d"])


def grouped(circuit: fs.Circuit, gaps: dict[str, float], leak: float) -> dict[str, list[object]]:
    """Mean forces of several fingers on one coating, without noise."""
    rows: list[tuple[str, float, float, float]] = []
    for label, d in gaps.items():
        one = circuit.replace({"Xgap.d": d, "Xcoat.r": leak})
        for u, f in ((100.0, 30.0), (200.0, 30.0), (200.0, 1000.0)):
            at = {"Vdrive.amplitude": u, "Vdrive.frequency": f, "Xskin.f": f}
            rows.append((label, u, f, fs.steady_state(one, parameters=at, rtol=1e-9).f_el_mean))
    names = ("finger", "Vdrive.amplitude", "source.frequency", "f_el_mean")
    return dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))


GAPS = {"left": 3.1e-6, "right": 3.9e-6}


def test_each_group_has_its_own_parameters_and_all_share_the_others(circuit: fs.Circuit) -> None:
    data = grouped(circuit, GAPS, 4e5)
    found = fs.fit(circuit, data, ["Xgap.d", "xcoat.r"], groups={"finger": ["xgap.d"]}, skin="follow")
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
    one = fs.fit(circuit, {k: x for k, x in data.items() if k != "finger"}, ["Xgap.d", "Xcoat.r"], skin="follow")
    assert one.objective > 1e4 * found.objective


def test_a_profile_of_one_groups_parameter_leaves_the_others_free(circuit: fs.Circuit) -> None:
    data = grouped(circuit, GAPS, 4e5)
    force = np.array(data["f_el_mean"], float)
    data["sigma"] = list(0.02 * force)
    found = fs.fit(
        circuit, data, ["Xgap.d", "Xcoat.r"], groups={"finger": ["Xgap.d"]}, skin="follow", starts=1, rtol=1e-5,
        profiles=["Xgap.d[left]"],
    )  # fmt: skip
    profile, estimate = found.profiles["Xgap.d[left]"], found.estimates["Xgap.d[left]"]
    assert profile.low == pytest.approx(estimate.low, rel=2e-3)
    assert profile.high == pytest.approx(estimate.high, rel=2e-3)


def test_groups_of_impedances_are_fitted_by_differences(circuit: fs.Circuit) -> None:
    quiet, f = circuit.replace({"Vdrive.amplitude": 1.0}), np.geomspace(20.0, 2e4, 5)
    z = [fs.phasor(quiet.replace({"Xgap.d": d}), f, skin="swept").impedance for d in GAPS.values()]
    data = {"frequency": np.tile(f, 2), "impedance": np.abs(np.concatenate(z)), "finger": np.repeat([1.0, 2.0], 5)}
    found = fs.fit(quiet, data, ["Xgap.d"], groups={"finger": ["Xgap.d"]}, skin="follow")
    assert found.estimates["Xgap.d[1]"].value == pytest.approx(3.1e-6, rel=1e-6)
    assert found.estimates["Xgap.d[2]"].value == pytest.approx(3.9e-6, rel=1e-6)


def test_the_command_fits_the_fingers_of_the_example(command: Command, tmp_path: Path) -> None:
    result = command(
        "fit", str(CIRCUITS / "fingers.csv"), str(CIRCUITS / "fingerpad.cir"), "--free", "Xgap.d,Xcoat.r", "--groups",
        "finger:Xgap.d", "--skin", "follow", "--out", str(tmp_path), "--json",
    )  # fmt: skip
    assert result.code == 0
    answer = json.loads(result.out)
    assert answer["groups"] == ["left", "right", "thumb"]
    rows = {row["path"]: row for row in answer["parameters"]}
    true = {"Xgap.d[left]": 3.1e-6, "Xgap.d[right]": 3.6e-6, "Xgap.d[thumb]": 4.2e-6, "Xcoat.r": 4e5}
    assert {path: row["low"] < true[path] < row["high"] for path, row in rows.items()} == dict.fromkeys(true, True)
    lines = (tmp_path / "fingerpad_fit.csv").read_text().splitlines()
    assert lines[0].startswith("finger,Vdrive.amplitude")
    assert lines[1].startswith("left,100.0,20.0,")


@pytest.mark.parametrize(
    ("groups", "said"),
    [
        ({"hand": ["Xgap.d"]}, "no column 'hand', which groups names; they have"),
        ({"finger": ["Xgap.r"]}, r"groups names 'Xgap.r', which is not fitted; allowed: Xgap\.d"),
        ({"finger": "Xgap.d"}, "allowed: a mapping of a column"),
        ({"finger": ["Xgap.d"], "hand": ["Xgap.d"]}, "allowed: a mapping of a column"),
        ({"Xgap.fn": ["Xgap.d"]}, "the column 'Xgap.fn', which is a parameter"),
        (["Xgap.d"], "allowed: a mapping of a column"),
    ],
)
def test_bad_groups_are_refused(circuit: fs.Circuit, tmp_path: Path, groups: object, said: str) -> None:
    data = {"finger": ["a", "b"], "f_el_mean": [0.1, 0.2]}
    with pytest.raises(InputError, match=said):
        fs.fit(circuit, data, ["Xgap.d"], groups=groups)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="have times and groups"):
        fs.fit(circuit, {"t": [0.0, 1e-3], "f_el": [0.1, 0.2], "g": [1, 2]}, ["Xgap.d"], groups={"g": ["Xgap.d"]})
    (tmp_path / "a.csv").write_text("finger,f_el_mean (N)\na,0.1\nb,0.2\n")
    with pytest.raises(InputError, match="has no column 'hand' in its header; it has finger, f_el_mean"):
        fs.fit(circuit, tmp_path / "a.csv", ["Xgap.d"], groups={"hand": ["Xgap.d"]})
    with pytest.raises(InputError, match="no rows of numbers; allowed: numbers, and names in the column that groups"):
        fs.fit(circuit, tmp_path / "a.csv", ["Xgap.d"])
    (tmp_path / "b.csv").write_text("finger,f_el_mean (N)\na,0.1\nb,0.2 oops\n")
    with pytest.raises(InputError, match="line 3"):
        fs.fit(circuit, tmp_path / "b.csv", ["Xgap.d"], groups={"finger": ["Xgap.d"]})


def test_residuals_beyond_the_given_sigma_are_named(circuit: fs.Circuit, data: dict[str, np.ndarray]) -> None:
    wrong = data["f_el_mean"] * (1.0 + 0.1 * (-1.0) ** np.arange(data["f_el_mean"].size))
    found = fs.fit(circuit, {**data, "f_el_mean": wrong, "sigma": 0.01 * wrong}, ["Xgap.d"], starts=1, skin="follow")
    assert any("times as large as sigma" in note and "so are the intervals" in note for note in found.notes)


@pytest.mark.parametrize(("kind", "said"), [("equal", "equal for all"), ("shares", "as equal shares of the values")])
def test_an_unknown_sigma_is_equal_or_a_share_whichever_is_likelier(circuit: fs.Circuit, kind: str, said: str) -> None:
    data = measured(circuit, [60.0, 120.0, 200.0], [30.0, 100.0, 500.0])
    force, rng = data["f_el_mean"], np.random.default_rng(0)
    sigma = 0.02 * (force if kind == "shares" else np.full(force.size, force.mean()))
    finger = circuit.replace({"Xgap.alpha": TRUE["Xgap.alpha"]})
    covered = 0
    for number in range(12):
        noisy = {**data, "f_el_mean": force + sigma * rng.standard_normal(force.size)}
        found = fs.fit(finger, noisy, ["Xgap.d", "Xgap.r"], starts=1, rtol=1e-5, skin="follow")
        covered += sum(
            found.estimates[path].low <= TRUE[path] <= found.estimates[path].high for path in found.estimates
        )
        if number == 0:
            assert f"sigma estimated from the residuals, {said}" in str(found)
            like = found.sigma / (force if kind == "shares" else np.ones(force.size))
            np.testing.assert_allclose(like, like[0], rtol=0.1)
    # 24 intervals of 95 %: fewer than 19 would have a probability of 0.1 %.
    assert covered >= 19


def test_gap_and_area_are_one_product_at_one_voltage(circuit: fs.Circuit) -> None:
    rng = np.random.default_rng(1)
    for _ in range(3):
        true = circuit.replace({path: value * np.exp(0.2 * rng.standard_normal()) for path, value in TRUE.items()})
        force = fs.steady_state(true, rtol=1e-8).f_el_mean * (1.0 + 0.02 * rng.standard_normal(6))
        start = true.replace({path: circuit.parameters[path].value for path in ("Xgap.d", "Xgap.alpha")})
        data = {"Vdrive.amplitude": [200.0] * 6, "f_el_mean": force}
        notes = fs.fit(start, data, ["Xgap.d", "Xgap.alpha"], starts=1, rtol=1e-5).notes
        assert any("Xgap.d and Xgap.alpha are not told apart" in note and "second voltage" in note for note in notes)


def test_the_example_finds_its_finger_and_predicts_another_force(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    spec = importlib.util.spec_from_file_location("fit_finger", CIRCUITS / "fit_finger.py")
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    example.main(tmp_path)
    said = capsys.readouterr().out
    assert (tmp_path / "fit_finger.png").stat().st_size > 10_000
    found = example.fitted()
    for path, value in TRUE.items():
        assert found.estimates[path].low < value < found.estimates[path].high
    true = fs.read_netlist(CIRCUITS / "fingerpad.cir").replace(dict(TRUE))
    at = {"Vdrive.amplitude": 180.0, "Vdrive.frequency": 300.0, "Xskin.f": 300.0}
    middle, low, high = example.predicted(found)
    assert low < fs.steady_state(true, parameters=at).f_el_mean < high
    assert f"force at 180 V and 300 Hz: {1e3 * middle:.4g} mN" in said
    # The force is known better than the area, as the errors of gap and area are correlated.
    area, least, most = example.area_at_rest(found)
    assert least < TRUE["Xgap.alpha"] * 0.5**0.52 < most
    assert (high - low) / middle < 0.3 * (most - least) / area


def test_a_report_has_the_layout_of_lmfit(circuit: fs.Circuit) -> None:
    found = fs.fit(circuit, CIRCUITS / "measured.csv", ["Xgap.d", "Xgap.r"], skin="follow", starts=1)
    lines = found.report().splitlines()
    heads = [line for line in lines if line.startswith("[[")]
    assert heads == ["[[Fit Statistics]]", "[[Variables]]", "[[Correlations]] (unreported correlations are < 0.100)"]
    statistics = dict(line.strip().lstrip("# ").split(" = ") for line in lines[1:9])
    numbers = {name.strip(): value for name, value in statistics.items()}
    assert (numbers["data points"], numbers["variables"]) == ("15", "2")
    chi = float(numbers["chi-square"])
    assert chi == pytest.approx(float(np.sum((found.residual / found.sigma) ** 2)), rel=1e-6)
    assert float(numbers["reduced chi-square"]) == pytest.approx(chi / 13)
    assert float(numbers["Akaike info crit"]) == pytest.approx(15 * np.log(chi / 15) + 4)
    assert float(numbers["Bayesian info crit"]) == pytest.approx(15 * np.log(chi / 15) + 2 * np.log(15))
    one = found.estimates["Xgap.d"]
    share = f"({100 * one.error / one.value:.2f}%)"
    assert f"    Xgap.d:  {one.value:.8g} +/- {one.error:.8g} {share} (init = 3.5e-06)" in lines
    assert lines[-1] == f"    C(Xgap.d, Xgap.r) = {found.correlation[0, 1]:+.4f}"


def test_a_skin_held_at_one_frequency_is_told_and_biases_the_fit(
    circuit: fs.Circuit, data: dict[str, np.ndarray], command: Command
) -> None:
    said = r"Xskin takes its data at f = 100 Hz, the source's fundamental is 30 to 500 Hz; with skin 'follow'"
    finger = circuit.replace({path: TRUE[path] for path in ("Xgap.r", "Xgap.alpha")})
    with pytest.warns(fs.FingerspiceWarning, match=said):
        held = fs.fit(finger, data, ["Xgap.d"], starts=1)
    followed = fs.fit(finger, data, ["Xgap.d"], starts=1, skin="follow")
    assert followed.estimates["Xgap.d"].value == pytest.approx(TRUE["Xgap.d"], rel=1e-5)
    assert abs(held.estimates["Xgap.d"].value / TRUE["Xgap.d"] - 1.0) > 0.01
    for path, at in (("Vdrive.frequency", [30.0, 500.0]), ("Xskin.f", [100.0, 200.0])):
        with pytest.warns(fs.FingerspiceWarning, match="Xskin takes its data at f = .*the source's fundamental is"):
            fs.batch(circuit, {path: at}, periodic=True)
        with pytest.warns(fs.FingerspiceWarning, match="Xskin takes its data at f = .*the source's fundamental is"):
            fs.sweep(circuit, {path: at}, periodic=True)
    Path("sweep.toml").write_text(
        'deck = "pad.cir"\nperiodic = true\n[parameters]\n"source.frequency" = { values = [30, 500] }\n'
    )
    result = command("sweep", "sweep.toml", "--json", "--no-plot")
    assert any(text.startswith("Xskin takes its data at f =") for text in json.loads(result.out)["warnings"])


def test_a_skin_that_suits_every_source_is_not_told(
    circuit: fs.Circuit, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    both = {"Vdrive.frequency": [30.0, 500.0], "Xskin.f": [30.0, 500.0]}
    fs.batch(circuit, both, periodic=True)
    fs.batch(circuit, {"Vdrive.frequency": [30.0, 500.0]}, periodic=True, skin="follow")
    fs.batch(circuit, {"Vdrive.amplitude": [30.0, 500.0]}, periodic=True)
    fs.sweep(circuit, {"Vdrive.frequency,Xskin.f": [0.3, 5.0]}, periodic=True, store=tmp_path / "sweep.zarr")
    assert not [one for one in recwarn if "takes its data" in str(one.message)]


def test_a_stored_sweep_tells_once_of_a_skin_held_at_one_frequency(circuit: fs.Circuit, tmp_path: Path) -> None:
    with pytest.warns(fs.FingerspiceWarning, match="the source's fundamental is 100 to 400 Hz") as told:
        fs.sweep(circuit, {"Vdrive.frequency": [100.0, 200.0, 400.0]}, periodic=True, store=tmp_path / "sweep.zarr")
    assert len([one for one in told if "takes its data" in str(one.message)]) == 1


@pytest.mark.parametrize(
    ("column", "factor", "said"),
    [
        ("f_el_mean", 1e3, "largest f_el_mean is .*newton, not millinewton; was .*m"),
        ("Vdrive.amplitude", 1e-3, r"largest Vdrive\.amplitude is 200 mV, .*volt, not kilovolt; was 200 meant"),
        ("source.frequency", 1e-9, "Vdrive frequency is 500 nHz, outside"),
    ],
)
def test_data_in_another_unit_are_told_and_end_in_a_bounded_number_of_evaluations(
    circuit: fs.Circuit, data: dict[str, np.ndarray], column: str, factor: float, said: str
) -> None:
    with pytest.warns(fs.FingerspiceWarning, match=said):
        found = fs.fit(circuit, {**data, column: factor * data[column]}, ["Xgap.d"], starts=1, rtol=1e-4, skin="follow")
    assert found.evaluations <= 40
    assert 1e-3 <= found.estimates["Xgap.d"].value / 3.5e-6 <= 1e3


def test_the_axes_of_a_fits_picture_have_names_and_units(circuit: fs.Circuit, data: dict[str, np.ndarray]) -> None:
    finger = circuit.replace(dict(TRUE))
    top, bottom = fs.fit(finger, data, ["Xgap.d"], starts=1, rtol=1e-4, skin="follow").plot().axes
    assert (top.get_ylabel(), bottom.get_xlabel()) == ("mean electroadhesive force [N]", "frequency of Vdrive [Hz]")
    assert top.get_legend_handles_labels()[1] == ["amplitude of Vdrive = 100 V", "amplitude of Vdrive = 200 V"]
    loads = {"Xgap.fn": [0.3, 0.5], "f_t_mean": [0.1, 0.17]}
    _, bottom = fs.fit(finger, loads, ["Xgap.d"], starts=1, rtol=1e-4).plot().axes
    assert bottom.get_xlabel() == "load of Xgap [N]"


def test_a_start_outside_its_bounds_moves_into_them(circuit: fs.Circuit, data: dict[str, np.ndarray]) -> None:
    finger = circuit.replace({path: TRUE[path] for path in ("Xgap.r", "Xgap.alpha")})
    said = r"Xgap\.d is 3\.5e-06, outside its bounds 2e-06 to 3\.3e-06: it starts at 3\.3e-06"
    with pytest.warns(fs.FingerspiceWarning, match=said):
        found = fs.fit(finger, data, ["Xgap.d"], bounds={"Xgap.d": (2e-6, 3.3e-6)}, starts=1, skin="follow")
    assert found.estimates["Xgap.d"].value == pytest.approx(TRUE["Xgap.d"], rel=1e-5)
    assert found.estimates["Xgap.d"].initial == 3.3e-6
    for pair in ((3e-6, 3e-6), (4e-6, 3e-6), (-1.0, 1.0), (np.nan, 1.0), (1.0,)):
        with pytest.raises(InputError, match="allowed: two values with 0 <= low < high"):
            fs.fit(finger, data, ["Xgap.d"], bounds={"Xgap.d": pair})  # type: ignore[dict-item]


def test_sigma_in_percent_is_a_share_of_every_value(
    circuit: fs.Circuit, data: dict[str, np.ndarray], tmp_path: Path
) -> None:
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


def test_what_is_named_twice_is_refused(circuit: fs.Circuit, tmp_path: Path) -> None:
    good = {"f_el_mean": [1e-2, 2e-2]}
    with pytest.raises(InputError, match=r"Xgap\.d is named twice; allowed: once"):
        fs.fit(circuit, good, ["Xgap.d", "xgap.D"])
    with pytest.raises(InputError, match=r"two columns of Vdrive\.amplitude; allowed: one"):
        fs.fit(circuit, {**good, "Vdrive.amplitude": 1.0, "source.amplitude": 2.0}, ["Xgap.d"])
    with pytest.raises(InputError, match="alpha is named twice"):
        fs.fit_contact(circuit, {"fn": [0.1, 0.2], "area": [1e-5, 2e-5]}, ["alpha", "Xgap.alpha"])
    (tmp_path / "a.csv").write_text("f_el_mean (N),Xgap.fn (N),Xgap.fn (N)\n0.01,0.5,0.6\n0.02,0.5,0.6\n")
    with pytest.raises(InputError, match=r"two columns 'Xgap\.fn'; allowed: one"):
        fs.fit(circuit, tmp_path / "a.csv", ["Xgap.d"])


def test_a_column_of_one_value_is_no_column_for_all(circuit: fs.Circuit) -> None:
    with pytest.raises(
        InputError, match=r"'Vdrive.amplitude' has the shape \(1,\), others have 2 rows; allowed: as ma"
    ):
        fs.fit(circuit, {"f_el_mean": [1e-2, 2e-2], "Vdrive.amplitude": [100.0]}, ["Xgap.d"])
