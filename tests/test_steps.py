"""Steps of a deck, the operating point, and what else a deck asks of `fingerspice run`."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray

import analytic
import fingerspice as fs
from commands import Command
from ngspice_tools import call_ngspice, run_ngspice
from scenes import DECKS, listed, refuses, warns

DECK, TEMPERATURE = ((DECKS / f"{name}.cir").read_text() for name in ("steps", "temperature"))


def deck(*lines: str, tstep: str = "100u") -> fs.Circuit:
    return fs.parse_netlist(DECK.format(lines="\n".join(lines), tstep=tstep))


@pytest.mark.parametrize(("line", "values"), listed("forms_of_step"))
def test_forms_of_step(line: str, values: list[float]) -> None:
    (step,) = deck(f".step {line}").steps
    np.testing.assert_allclose(step.values, values, rtol=1e-12)


@pytest.mark.parametrize(("lines", "said"), listed("bad_steps"))
def test_bad_steps(lines: list[str], said: str) -> None:
    refuses(r"(?s).*" + said.replace("(", r"\(").replace("+", r"\+"), deck, *lines)


def test_steps_equal_single_runs() -> None:
    """Signals, figures and measures of nested steps, of a parameter and of a path, are those of runs one by one."""
    circuit = deck(".step param gap 3u 4u 0.5u", ".step Xskin.d list 200u 350u", ".meas tran most MAX F_EL(Xgap)")
    found, single = fs.run_steps(circuit, rtol=1e-7), deck(".meas tran most MAX F_EL(Xgap)")
    assert found.sizes == {"gap": 3, "Xskin.d": 2, "time": 501}
    assert found["Xskin.d"].attrs["units"] == "m"
    for i, gap in enumerate((3e-6, 3.5e-6, 4e-6)):
        for k, d in enumerate((200e-6, 350e-6)):
            one = fs.simulate(
                single.replace({"Xgap.d": gap, "Xgap.r": 2.0 * gap / 7e-6 * 1e6, "Xskin.d": d}), rtol=1e-7
            )
            np.testing.assert_allclose(found.u_gap[i, k], one.u_gap, rtol=0.0, atol=1e-9)
            assert found.f_el_mean[i, k].item() == pytest.approx(one.f_el_mean, rel=1e-9)
            assert found.most[i, k].item() == pytest.approx(one.measures["most"], rel=1e-9)


@pytest.mark.parametrize("line", [".step Xgap.d 3u 4u 10n", ".step param gap 3u 4u 10n"])
def test_figures_go_as_one_batch(line: str) -> None:
    """Without signals all steps go in lockstep, with the figures that single runs have."""
    circuit = deck(line)
    found = fs.run_steps(circuit, signals=(), rtol=1e-6)
    assert found.status.size == 101
    assert not found.status.any()
    changes = {"Xgap.d": 3.7e-6} | ({"Xgap.r": 2.0 * 3.7e-6 / 7e-6 * 1e6} if "param" in line else {})
    one = fs.simulate(deck().replace(changes), rtol=1e-9)
    assert found.f_el_mean[70].item() == pytest.approx(one.f_el_mean, rel=1e-6)
    assert found.u_gap_rms[70].item() == pytest.approx(one.u_gap_rms, rel=1e-6)


@pytest.mark.parametrize("signals", [(), None])
def test_a_bad_value_is_told_and_the_others_stand(signals: tuple[str, ...] | None) -> None:
    found = fs.run_steps(deck(".step Xgap.d list 3u -1u 4u -2u"), signals=signals, rtol=1e-5)
    assert [x > 1 for x in found.status.values.tolist()] == [False, True] * 2
    assert np.isfinite(found.f_el_mean.values).tolist() == [True, False] * 2
    first, second = found.attrs["failures"]
    assert "Xgap.d = -1e-06" in first
    assert "allowed: more than 0" in second


def test_changes_of_the_user_stay() -> None:
    """What `replace` has set keeps its value where a parameter of the deck is stepped."""
    circuit = deck(".step param gap list 3u 4u").replace({"Xgap.r": 5e5})
    found = fs.run_steps(circuit, rtol=1e-7)
    one = fs.simulate(deck().replace({"Xgap.r": 5e5, "Xgap.d": 4e-6}), rtol=1e-7)
    np.testing.assert_allclose(found.u_gap[1], one.u_gap, rtol=0.0, atol=1e-9)


def test_a_source_and_the_end_of_a_run_are_stepped() -> None:
    """A source's own name is its level, and a run that ends earlier has NaN after its end."""
    text = DECK.format(lines=".step V1 list 10 20", tstep="1m").replace("SIN(0 {V} 100)", "{V}")
    found = fs.run_steps(fs.parse_netlist(text))
    assert found.u_source.values[:, -1].tolist() == [10.0, 20.0]
    text = (
        DECK.format(lines=".step param end list 20m 40m", tstep="1m")
        .replace("50m", "{end}")
        .replace("V=200", "V=200 end=1")
    )
    found = fs.run_steps(fs.parse_netlist(text))
    assert np.isfinite(found.u_gap.values).sum(axis=1).tolist() == [21, 41]
    bad = fs.run_steps(
        fs.parse_netlist(DECK.format(lines=".step param h list 1m 2m", tstep="{h}").replace("V=200", "V=200 h=1u"))
    )
    assert "differ in time" in bad.attrs["failures"][0]


def test_a_start_and_measures_follow_a_stepped_parameter() -> None:
    body = "t\n.param x=1\nV1 b 0 0\nR1 a b 1k\nC1 a 0 1u\n.ic v(a)={x}\n.tran 10u 2m uic\n.step param x list 1 2\n"
    found = fs.run_steps(fs.parse_netlist(f"{body}.meas tran later FIND V(a) AT={{x/1k}}\n.end\n"))
    np.testing.assert_allclose(found.later, [math.exp(-1.0), 2.0 * math.exp(-2.0)], rtol=1e-7)


def test_refused_requests() -> None:
    refuses(r"no \.step line", fs.run_steps, deck())
    refuses("allowed: figures such as", fs.run_steps, deck(".step gap list 1u 2u"), outputs=("f_el_men",))
    with pytest.raises(fs.InputError, match="u_gap is the name of a step or measure"):
        fs.run_steps(deck(".step gap list 1u 2u", ".meas tran u_gap MAX V(top)"))
    refuses("fewer outputs or signals", fs.run_steps, deck(".step gap 1u 2u 0.1n", tstep="10n"))
    refuses("no step has a result; the first: gap = -1", fs.run_steps, deck(".step gap list -1 -2"))
    refuses("no DC operating", fs.operating_points, fs.parse_netlist("t\nV1 a 0 1\nC1 a b 1n\nC2 b 0 1n\n.end\n"))
    warns(r"\.step has no effect in one run", fs.simulate, deck(".step gap list 1u 2u"), rtol=1e-4)


def test_operating_points_against_their_equations() -> None:
    """Resistances in series, that of the skin over the area, which follows the gap voltage."""
    found = fs.operating_points(deck(".dc V1 0 100 25 Xgap.d 3u 4u 1u"))
    assert found.sizes == {"V1": 5, "Xgap.d": 2}
    for i, volts in enumerate((0.0, 25.0, 50.0, 75.0, 100.0)):
        for k, d in enumerate((3e-6, 4e-6)):
            params = replace(analytic.TABLE1, d_a=d)
            layers = analytic.table1_layers(100.0, params)
            expected = analytic.dc_operating_point(volts, layers, params)
            at = found.isel({"V1": i, "Xgap.d": k})
            np.testing.assert_allclose(
                [at["u_layer:Xcoat"], at["u_gap"], at["u_layer:Xskin"]], expected, rtol=1e-9, atol=1e-12
            )
            assert at.area.item() == pytest.approx(float(analytic.area(expected[1], params)), rel=1e-9)


def test_operating_point_equals_ngspice(tmp_path: Path) -> None:
    text = DECK.format(lines=".op", tstep="100u").replace("SIN(0 {V} 100)", "120").replace(".tran 100u 50m uic\n", "")
    circuit = fs.parse_netlist(text)
    found = fs.operating_points(circuit)
    control = ".control\nop\nprint v(top) v(skin) v(area)\nquit 0\n.endc\n.end"
    (tmp_path / "op.cir").write_text(fs.export_netlist(circuit).rpartition(".end")[0] + control)
    said = call_ngspice(tmp_path, "op.cir").stdout
    theirs = {line.split(" = ")[0]: float(line.split(" = ")[1]) for line in said.splitlines() if line.startswith("v(")}
    assert found["v:top"].item() == pytest.approx(theirs["v(top)"], rel=1e-5)
    assert found["v:skin"].item() == pytest.approx(theirs["v(skin)"], rel=1e-5)
    assert 1e6 * found["area"].item() == pytest.approx(theirs["v(area)"], rel=1e-5)


def test_steps_side_by_side_in_ngspice() -> None:
    """The export has all runs, and ngspice finds what they are here."""
    circuit = deck(".step param gap list 3u 4u", ".step V list 100 200", tstep="50u")
    circuit = fs.parse_netlist(circuit.text.replace("50m", "10m"))
    names = [f"v(top_{k})-v(skin_{k})" for k in range(1, 5)]
    theirs = run_ngspice(fs.export_netlist(circuit), names, max_step=1e-6)
    found = fs.run_steps(circuit, signals=("u_gap",)).u_gap
    for name, ours in zip(names, found.values.reshape(4, -1), strict=True):
        other = np.interp(found.time, theirs["time"], theirs[name])
        assert np.abs(ours - other)[1:].max() <= 1e-6 * np.abs(ours).max()
    refuses("501 steps; allowed in an export: 200", fs.export_netlist, deck(".step gap 1u 6u 10n"))


def test_run_writes_steps_and_analyses(command: Command) -> None:
    """The command writes a family of curves, and what `.op`, `.dc` and `.ac` ask for; a bad step is a warning."""
    lines = (".step gap list 3u -1u 4u", ".op", ".dc V1 0 200 50", ".ac dec 5 10 10k", ".meas tran most MAX F_EL(Xgap)")
    Path("steps.cir").write_text(DECK.format(lines="\n".join(lines), tstep="100u"))
    done = command("run", "steps.cir", "--json").ok()
    answer = json.loads(done.out)
    assert [one["status"] for one in answer["steps"]] == ["one_by_one", "refused", "one_by_one"]
    assert answer["steps"][2]["figures"]["most"] > 0.1
    assert "gap = -1e-06" in done.err
    assert len(answer["dc"]) == 15
    assert answer["op"] is None
    assert [one["status"] for one in answer["sweeps"]] == ["one_by_one", "refused", "one_by_one"]
    swept = fs.phasor(deck().replace({"Xgap.d": 4e-6, "Xgap.r": 8e6 / 7.0}), answer["sweeps"][2]["frequency"])
    assert answer["sweeps"][2]["u_gap"] == pytest.approx(np.abs(swept.u_gap).tolist(), rel=1e-12)
    assert answer["sweeps"][1]["u_gap"] == [None] * 16
    assert len([text for text in answer["warnings"] if text.startswith("gap = -1e-06: ")]) == 1
    names = sorted(path.name for path in Path("out").iterdir() if path.name[0] != ".")
    others = [f"steps_{kind}" for kind in ("ac.csv", "ac.nc", "ac.png", "dc.csv", "dc.png")]
    assert names == ["steps.nc", "steps.png", *others]
    with xarray.open_dataset("out/steps_ac.nc", engine="h5netcdf") as kept:
        assert kept.f_el_mean.dims == ("gap", "frequency")
    with xarray.open_dataset("out/steps.nc", engine="h5netcdf") as kept:
        assert math.isnan(kept.most[1])
        assert kept.u_gap.dims == ("gap", "time")
    command("run", "steps.cir", "--csv", "--no-plot").ok()
    assert command("run", "steps.cir", "--csv", "--no-plot").code == 0
    assert Path("out/steps.csv").read_text().splitlines()[0] == (
        "gap,u_gap_rms [V],f_el_mean [N],f_t_mean [N],most,status"
    )
    assert command("run", "steps.cir", "--raw", "--overwrite").code == 0
    raw = fs.read_raw("out/steps.raw")
    assert list(raw.vectors)[:4] == ["time", "gap", "u_source", "@xgap[u_gap]"]
    assert [float(raw.vectors["gap"][run][0]) for run in raw.steps] == [3e-6, -1e-6, 4e-6]
    one = fs.simulate(deck().replace({"Xgap.d": 4e-6, "Xgap.r": 8e6 / 7.0}))
    np.testing.assert_allclose(raw.vectors["@xgap[u_gap]"][raw.steps[2]], one.u_gap, rtol=0.0, atol=1e-6)
    command("run", "steps.cir", "--feel").refused("--feel goes with one run")
    assert ".step has no effect in one run" in command("plan", "steps.cir").err


LOW_PASS = """low pass of a stepped resistance
.param r=1k n=2
V1 in 0 AC 1
R1 in out {r}
C1 out 0 1u
.ac dec {n} 10 1k
.step param r list 1k 4k
.step C1 1u 2u 1u
.meas ac corner WHEN VM(out)=0.5 FALL=1
.end
"""


def test_a_sweep_at_each_step_equals_its_closed_form(command: Command) -> None:
    """Of a low pass, with the frequency at which half of the voltage is left."""
    found = fs.phasor_steps(fs.parse_netlist(LOW_PASS))
    assert (found.sizes, found.frequency.attrs) == ({"r": 2, "C1.value": 2, "frequency": 5}, {"units": "Hz"})
    r, c, f = np.ix_([1e3, 4e3], [1e-6, 2e-6], 10.0 ** np.arange(1.0, 3.1, 0.5))
    expected = 1.0 / (1.0 + 2j * math.pi * f * r * c)
    np.testing.assert_allclose(found["v:out"], np.abs(expected), rtol=1e-12)
    np.testing.assert_allclose(found["phase_deg:out"], np.degrees(np.angle(expected)), rtol=1e-12)
    np.testing.assert_allclose(found.corner, (math.sqrt(3.0) / (2.0 * math.pi * r * c))[..., 0], rtol=1e-9)
    Path("low.cir").write_text(LOW_PASS)
    done = command("run", "low.cir", "--json")
    row = json.loads(done.out)["sweeps"][3]
    assert row["values"] == {"r": 4e3, "C1.value": 2e-6}
    assert row["figures"] == {"corner": pytest.approx(math.sqrt(3.0) / (2.0 * math.pi * 8e-3), rel=1e-9)}
    assert row["v:out"] == pytest.approx(np.abs(expected[1, 1]).tolist(), rel=1e-12)
    head, *rows = Path("out/low_ac.csv").read_text().splitlines()
    assert head.startswith("r,C1.value [F],frequency [Hz],v:in [V],")
    assert (len(rows), rows[19].split(",")[:3]) == (20, ["4000.0", "2e-06", "1000.0"])
    Path("low.cir").write_text(LOW_PASS.replace("list 1k 4k", "1k 50k 1k\n.op"))
    said = command("run", "low.cir").ok().out
    assert all(words in said for words in ("corner", "... 60 more rows"))
    assert len(Path("out/low_dc.csv").read_text().splitlines()) == 101
    for lack, line in ((".ac", ".ac dec {n} 10 1k"), (".step", ".step param r list 1k 4k\n.step C1 1u 2u 1u")):
        with pytest.raises(fs.InputError, match=rf"no \{lack} line; allowed: both"):
            fs.phasor_steps(fs.parse_netlist(LOW_PASS.replace(line, "")))
    with pytest.raises(fs.InputError, match="impedance is the name of a step or measure"):
        fs.phasor_steps(fs.parse_netlist(LOW_PASS.replace("corner", "impedance")))
    grown = fs.phasor_steps(fs.parse_netlist(LOW_PASS.replace("r list 1k 4k", "n list 1 2")))
    assert "differ in frequency; allowed: a TSTEP, TSTART and .ac that stay" in grown.attrs["failures"][0]


def test_a_deck_without_tran(command: Command) -> None:
    text = DECK.format(lines=".op\n.dc V1 0 200 50", tstep="1u").replace("SIN(0 {V} 100)", "120")
    Path("op.cir").write_text(text.replace(".tran 1u 50m uic\n", ""))
    op = json.loads(command("run", "op.cir", "--no-plot", "--charge-law", "mobile", "--json").ok().out)["op"]
    assert op["u_gap"] == pytest.approx(analytic.dc_operating_point(120.0, analytic.table1_layers(100.0))[1], rel=1e-9)
    assert op["fold_margin"] > 1.01  # of the local law 1
    done = command("run", "op.cir").ok()
    assert "operating point" in done.out
    assert Path("out/op_dc.png").is_file()


def test_an_elements_name_alone_is_its_one_value() -> None:
    """Of an R its resistance, of a controlled source its gain."""
    body = "gains\nV1 a 0 1\nR1 a b 1k\nR2 b 0 1k\nE1 c 0 b 0 2\nR3 c 0 1k\n"
    found = fs.operating_points(fs.parse_netlist(f"{body}.dc E1 1 3 1 R2 1k 3k 2k\n.end\n"))
    assert found["E1.gain"].values.tolist() == [1.0, 2.0, 3.0]
    expected = np.outer([1.0, 2.0, 3.0], [0.5, 0.75])
    np.testing.assert_allclose(found["v:c"], expected, rtol=1e-12)


def test_a_swept_current_adds_to_a_source_before_its_jump() -> None:
    body = "jump\n.param r=1k\nV1 a 0 PWL(0 3 0 9)\nR1 a b {r}\nI1 0 b 0\n.step param r list 1k 2k\n"
    found = fs.operating_points(fs.parse_netlist(f"{body}.dc I1 0 2m 1m\n.end\n"))
    assert (found["v:b"].dims, found.I1.attrs["units"]) == (("I1", "r"), "A")
    np.testing.assert_allclose(found["v:b"], 3.0 + np.outer([0.0, 1e-3, 2e-3], [1e3, 2e3]), rtol=1e-12)


def test_values_follow_the_temperature_as_in_ngspice(tmp_path: Path) -> None:
    circuit = fs.parse_netlist(TEMPERATURE)
    warm = 1.0 + 2e-3 * 50.0 - 5e-6 * 50.0**2
    expected = {"R1": 1e3 * warm, "R2": 2e3 * (1.05 + 0.025), "R3": 3e3 * (warm - 0.05), "R4": 1250.0, "C1": 1.05e-6}
    for name, value in expected.items():
        assert circuit[name].values["value"] == pytest.approx(value, rel=1e-14), name
    found = fs.operating_points(circuit)
    control = ".control\nop\nprint v(b) v(c)\nquit 0\n.endc\n.end\n"
    (tmp_path / "op.cir").write_text(TEMPERATURE.replace(".end\n", control))
    said = call_ngspice(tmp_path, "op.cir").stdout
    for node in "bc":
        theirs = next(line for line in said.splitlines() if line.startswith(f"v({node}) = "))
        assert found[f"v:{node}"].item() == pytest.approx(float(theirs.partition(" = ")[2]), rel=1e-6)
    for options in ("TEMP = 77°C", "temp=102 tnom=52"):
        again = fs.parse_netlist(TEMPERATURE.replace(".temp 77", f".options {options}"))
        assert again["R1"].values["value"] == pytest.approx(1e3 * warm, rel=1e-14)


@pytest.mark.parametrize(("before", "after", "said"), listed("bad_temperatures"))
def test_bad_temperatures_and_models(before: str, after: str, said: str) -> None:
    refuses(said, fs.parse_netlist, TEMPERATURE.replace(before, after))
