"""`.meas` lines: against closed forms, against ngspice, and in every place where a run is shown."""

import json
import math
import pickle
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from ngspice_tools import call_ngspice
from scenes import deck, finger, listed, refuses, table1, warns

CIRCUITS = Path(__file__).parents[1] / "circuits"
W = 200.0 * math.pi


def measured(*lines: str, elements: tuple[str, ...] = (), tran: str = ".tran 0.1m 50m uic") -> dict[str, Any]:
    """The measures of a sine of 2 V and 100 Hz on an R of 1 kohm behind one of 3 kohm, and of other elements."""
    circuit = deck("V1 a 0 SIN(0 2 100)", "R1 a b 3k", "R2 b 0 1k", *elements, tran, *lines)
    return fs.simulate(circuit).measured


# V(b) is 0.5 sin(W t).
CLOSED = {
    "AVERAGE V(b) FROM=0 TO=5m": 0.5 * 2.0 / math.pi, "RMS V(b)": 0.5 / math.sqrt(2.0),
    "INTEGRAL V(b) FROM=1m TO=4m": 0.5 * (math.cos(W * 1e-3) - math.cos(W * 4e-3)) / W, "MAX V(b)": 0.5,
    "MIN V(b) TD=1m TO=3m": 0.5 * math.sin(W * 1e-3), "PP V(a,b)": 3.0, "MAX_AT V(b) TO=10m": 2.5e-3,
    "MIN_AT V(b) FROM=10m TO=20m": 17.5e-3, "FIND V(a) AT=1.3m": 2.0 * math.sin(W * 1.3e-3),
    "DERIVATIVE V(b) AT=1.3m": 0.5 * W * math.cos(W * 1.3e-3), "WHEN V(b)=0.2": math.asin(0.4) / W,
    "WHEN V(b)=0.2 CROSS=2": 5e-3 - math.asin(0.4) / W, "WHEN V(b)=0.2 RISE=3": 20e-3 + math.asin(0.4) / W,
    "WHEN V(b)=-0.2 FALL=1": 5e-3 + math.asin(0.4) / W, "WHEN V(b)=0.2 CROSS=LAST": 45e-3 - math.asin(0.4) / W,
    "WHEN V(b)=level RISE=1 TD=3m": 10e-3 + math.asin(0.4) / W, "WHEN V(b)='level*2' FALL=1": 5e-3 - math.asin(0.8) / W,
    "FIND V(a) WHEN V(b)={level} FALL=2": 0.8, "DERIV V(a) WHEN V(b)=0 FALL=1": -2.0 * W,
    "TRIG V(b) VAL=0.1 RISE=1 TARG V(b) VAL=0.4 RISE=2": 10e-3 + (math.asin(0.8) - math.asin(0.2)) / W,
    "TRIG AT=1m TARG V(b)=0 FALL=1": 4e-3, "TRIG V(a)=1 CROSS=1 TD=2m TARG AT=9m": 9e-3 - (5e-3 - math.asin(0.5) / W),
    "RMS {V(a)-4*V(b)}": 0.0, "AVG {V(b)^2+level}": 0.125 + 0.2, "MAX par('2*V(b)*V(b)')": 0.5, "PP I(R2)": 1e-3,
    "MAX I(V1)": 5e-4, "MIN I(I1)": -1e-3, "FIND I(I1) AT=2.5m": 1e-3,
    "PARAM='2*m0+level'": 2.0 * 0.5 * 2.0 / math.pi + 0.2, "PARAM m3*2": 1.0,
}  # fmt: skip


def test_measures_are_their_closed_forms() -> None:
    lines = [f".meas tran m{k} {form}" for k, form in enumerate(CLOSED)]
    found = measured(".param level=0.2", *lines, elements=("I1 0 c SIN(0 1m 100)", "R3 c 0 1k"))
    for k, (form, expected) in enumerate(CLOSED.items()):
        one = found[f"m{k}"]
        assert one.failed == "", form
        size = 1e-10 if "I(V1)" not in form and "I(I1)" not in form else 1e-6
        assert one.value == pytest.approx(expected, rel=size, abs=1e-12), form
    assert found["m19"].at == pytest.approx(10e-3 + math.asin(0.8) / W, rel=1e-12)


def test_a_jump_is_crossed_at_its_time_and_a_square_has_exact_means() -> None:
    elements = ("V2 c 0 SQUARE(1 100 0.3)", "R3 c 0 1k")
    found = measured(
        ".meas tran up WHEN V(c)=0.5 RISE=2", ".meas tran down WHEN V(c)=0 FALL=3", ".meas tran mean AVG V(c) TO=10m",
        ".meas tran fast WHEN V(c)=V(b) CROSS=LAST", elements=elements,
    )  # fmt: skip
    assert found["up"].value == pytest.approx(20e-3, rel=1e-12)
    assert found["down"].value == pytest.approx(23e-3, rel=1e-12)
    assert found["mean"].value == pytest.approx(0.3 - 0.7, rel=1e-10)
    assert found["fast"].value == pytest.approx(43e-3, rel=1e-12)


def of_ngspice(text: str) -> dict[str, float]:
    """The measures that ngspice prints of a deck."""
    with tempfile.TemporaryDirectory(prefix="ngspice-") as folder:
        for name in ("fingerspice.lib", "fingerspice_mobile.lib"):
            (Path(folder) / name).write_text((CIRCUITS / name).read_text())
        (Path(folder) / "deck.cir").write_text(text)
        said = call_ngspice(Path(folder), "deck.cir", timeout=300.0).stdout
    return {m[1]: float(m[2]) for m in re.finditer(r"^(\w+)\s+=\s+([-+.\deE]+)", said, re.MULTILINE)}


#: Forms that both simulators take, each with the size to which its error is relative.
FORMS = dict(listed("measures_of_ngspice"))
TOP = ("Vdrive drive 0 SIN(0 200 100)", *finger("drive", "foot", f=100.0), "Rfoot foot 0 10k")
PULSED = ("Vdrive drive 0 PULSE(0 150 1m 0.5m 0.5m 3m 10m)", *TOP[1:])
SLOW = (
    "Vdrive drive 0 EXP(-100 180 1m 2m 9m 3m)",
    "Rs drive top 200k",
    "Cs top skin 1n",
    "Rl skin 0 300k",
    "Cl skin 0 2n",
)


@pytest.mark.parametrize("elements", [TOP, PULSED, SLOW], ids=["sine", "pulse", "rc"])
def test_ngspice_measures_the_same(elements: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NGSPICE_MEAS_PRECISION", "12")
    lines = [f".meas tran m{k} {form}" for k, form in enumerate(FORMS)]
    text = "\n".join(["measures", ".include fingerspice.lib", *elements, ".tran 10u 20m uic", *lines, ".end", ""])
    theirs = of_ngspice(text.replace("20m uic", "20m 0 0.5u uic"))
    ours = fs.simulate(fs.parse_netlist(text), rtol=1e-9).measured
    shared = 0
    for k, (form, size) in enumerate(FORMS.items()):
        one, other = ours[f"m{k}"], theirs.get(f"m{k}")
        # Where nothing crosses, neither has a value.
        assert math.isnan(one.value) == (other is None), form
        if other is not None:
            shared += 1
            assert one.value == pytest.approx(other, abs=2e-6 * size), form
    assert shared >= 10


def test_devices_signals_are_measured_as_the_figures_of_the_run() -> None:
    circuit = table1(gap={"p_sat": 300e3})
    lines = [
        ".meas tran f AVG F_EL(Xgap)", ".meas tran t MAX @Xgap[f_t]", ".meas tran u RMS u_gap(xgap)",
        ".meas tran a MIN AREA(Xgap)", ".meas tran r AVG A_REAL(Xgap)", ".meas tran c AVG FRICTION(Xgap)",
        ".meas tran s MAX @xgap[sigma_el]", ".meas tran l RMS U(Xcoat)",
    ]  # fmt: skip
    run = fs.simulate(fs.parse_netlist(circuit.text.replace(".tran", "\n".join([*lines, ".tran"]))))
    s = run.summary()
    expected = {"f": s["f_el_mean"], "t": s["f_t_max"], "u": s["u_gap_rms"], "a": s["area_min"], "r": s["a_real_mean"],
                "c": s["friction_mean"], "s": float(run.sigma_el.max())}  # fmt: skip
    for name, value in expected.items():
        assert run.measures[name] == pytest.approx(value, rel=1e-6), name
    coat = run.by_name("u_layer")["u_layer:Xcoat"]
    assert run.measures["l"] == pytest.approx(np.sqrt(np.mean(coat[:-1] ** 2)), rel=1e-4)


def test_most_periods_of_a_long_run_are_counted_though_few_are_integrated() -> None:
    circuit = table1()
    text = circuit.text.replace(
        ".tran 10u 50m", ".meas tran n WHEN V(top)=0 RISE=150\n.meas tran m AVG F_EL(Xgap)\n.tran 10u 2"
    )
    run = fs.simulate(fs.parse_netlist(text))
    assert run.stats["repeated"] > 100
    period = fs.steady_state(circuit).solution
    first = fs.simulate(fs.parse_netlist(text.replace("RISE=150", "RISE=4").replace("10u 2", "10u 60m"))).measures["n"]
    assert run.measures["n"] == pytest.approx(first + 1.46, abs=1e-9)
    assert run.measures["m"] == pytest.approx(run.f_el_mean, rel=1e-9)
    assert run.measures["m"] == pytest.approx(period.f_el_mean, rel=1e-2)


def test_measures_are_printed_and_in_json_files_and_loaded_runs(tmp_path: Path, command: Any) -> None:
    text = table1().text.replace(".tran", ".meas tran top MAX V(top)\n.meas tran none WHEN V(top)=1e4\n.tran")
    (tmp_path / "pad.cir").write_text(text)
    run = fs.simulate(fs.read_netlist(tmp_path / "pad.cir"))
    done = command("run", str(tmp_path / "pad.cir"), "--json", "--no-plot", "--out", str(tmp_path))
    rows = json.loads(done.out)["measures"]
    assert [row["name"] for row in rows] == ["top", "none"]
    assert rows[0]["value"] == run.measures["top"]
    assert (rows[1]["value"], rows[0]["failed"]) == (None, "")
    assert "V(top) has 0 of 10000 where CROSS=1 is asked for; it runs from" in rows[1]["failed"]
    assert "has 0 of 10000" in command("run", str(tmp_path / "pad.cir"), "--no-plot", "--out", str(tmp_path)).out
    loaded = fs.load(tmp_path / "pad.nc")
    assert loaded.measures["top"] == run.measures["top"]
    assert loaded.measured["none"].failed == run.measured["none"].failed
    assert json.loads(run.to_xarray().attrs["measures"])["top"] == run.measures["top"]


@pytest.mark.parametrize(("line", "said"), listed("wrong_measures"))
def test_wrong_measures_are_refused_with_their_place(line: str, said: str) -> None:
    refuses(rf"<netlist>:\d+:\d+: .*{said}", measured, ".meas tran m0 MAX V(b)", f".meas {line}")


@pytest.mark.parametrize(("line", "said"), listed("measures_without_a_value"))
def test_a_measure_without_a_value_says_why_and_the_others_stand(line: str, said: str) -> None:
    found = measured(
        ".meas tran m0 MAX V(b)", f".meas tran m1 {line}", ".meas tran m2 PP V(b)", ".meas noise m3 MAX V(b)"
    )
    assert math.isnan(found["m1"].value)
    assert said in found["m1"].failed
    assert found["m2"].value == pytest.approx(1.0, rel=1e-12)
    assert found["m3"].failed == "a measure of NOISE is not made here"


# An RC of 1 ms under 2 V: V(out) is 2 / (1 + i x) with x = f/F, and V(in, out) is 2 i x / (1 + i x).
F = 1000.0 / (2.0 * math.pi)
SWEPT = {
    "FIND V(out) AT={F}": 1.0, "FIND VI(out) AT={F}": -1.0, "FIND VM(out) AT={F}": math.sqrt(2.0),
    "FIND VDB(out) AT={F}": 10.0 * math.log10(2.0), "FIND VP(out) AT={F}": -0.25 * math.pi,
    "WHEN VDB(out)=0": F * math.sqrt(3.0), "FIND VR(out) WHEN VM(out)=1 FALL=1": 0.5,
    "MAX VM(out)": 2.0 / math.hypot(1.0, 1.0 / F), "MIN_AT VM(out)": 1e4, "MAX {-VI(out)}": 1.0, "MAX_AT {-VI(out)}": F,
    "PP VM(out)": 2.0 / math.hypot(1.0, 1.0 / F) - 2.0 / math.hypot(1.0, 1e4 / F),
    "INTEG VM(out) FROM=10 TO=1k": 2.0 * F * (math.asinh(1e3 / F) - math.asinh(10.0 / F)),
    "RMS VM(out) FROM=10 TO=1k": math.sqrt(4.0 * F * (math.atan(1e3 / F) - math.atan(10.0 / F)) / 990.0),
    "DERIV VM(out) AT={F}": -1.0 / (math.sqrt(2.0) * F),
    "TRIG VDB(out) VAL=5 FALL=1 TARG VDB(out) VAL=0 FALL=1":
        F * (math.sqrt(3.0) - math.sqrt(4.0 / 10.0**0.5 - 1.0)), "PARAM='m2*m2'": 2.0,
}  # fmt: skip


def test_measures_of_a_sweep_are_their_closed_forms_and_those_of_ngspice(command: Any) -> None:
    lines = [f".meas ac m{k} {form.replace('{F}', repr(F))}" for k, form in enumerate(SWEPT)]
    circuit = deck("V1 in 0 AC 2", "R1 in out 1k", "C1 out 0 1u", ".ac dec 20 1 10k", *lines)
    found = fs.phasor(circuit, 10.0 ** np.linspace(0.0, 4.0, 81))
    for k, (form, expected) in enumerate(SWEPT.items()):
        assert found.measures[f"m{k}"] == pytest.approx(expected, rel=1e-10), form
    # ngspice has no DERIV, and no expressions in place of vectors.
    text = re.sub(r"(?m)^\.meas ac \w+ (DERIV|.*\{).*\n", "", circuit.text.replace("dec 20", "dec 2000"))
    theirs = of_ngspice(text)
    for k, (form, expected) in enumerate(SWEPT.items()):
        if f"m{k}" in theirs:
            assert theirs[f"m{k}"] == pytest.approx(expected, rel=2e-5), form
    assert len(theirs) >= 12
    Path("rc.cir").write_text(circuit.text)
    for words in (("run", "rc.cir"), ("ac", "rc.cir")):
        shown = command(*words, "--no-plot").out
        assert "measure" in shown
        assert "159.2 Hz" in shown
        (sweep,) = json.loads(command(*words, "--no-plot", "--json").out)["sweeps"]
        assert sweep["measures"][5]["value"] == pytest.approx(F * math.sqrt(3.0), rel=1e-10)
        np.testing.assert_allclose(sweep["frequency"], found.frequency, rtol=1e-12)


def test_measures_of_a_finger_in_a_sweep() -> None:
    lines = "top WHEN u_gap(Xgap)=140", "f FIND F_EL(Xgap) AT=230", "no MAX friction(Xgap)", "late FIND V(top) AT=1g"
    text = "".join(f".meas ac {line}\n" for line in lines)
    circuit = fs.parse_netlist(table1().text.replace(".tran", f"{text}.tran"))
    found = fs.phasor(circuit, np.geomspace(10.0, 1e4, 31))
    at = fs.phasor(circuit, [found.measures["top"], 230.0])
    assert abs(at.u_gap[0]) == pytest.approx(140.0, rel=1e-9)
    assert found.measures["f"] == pytest.approx(at.f_el_mean[1], rel=1e-9)
    assert "no part of a sweep" in found.measured["no"].failed
    assert found.measured["late"].failed.startswith("1e+09 Hz is outside")
    v_top = at.v_nodes[:, at.nodes.index("top")] - at.v_nodes[:, at.nodes.index("skin")]
    np.testing.assert_allclose(v_top, at.u_gap, rtol=1e-12)


def test_harmonics_are_those_of_the_closed_form_and_of_ngspice() -> None:
    circuit = deck("V1 a 0 SQUARE(2 100)", "R1 a 0 1k", "V2 b 0 SIN(0.5 1 100 40m 0 30)", "R2 b 0 1k",
                   ".four 100 V(a) {V(b)*V(b)} I(R1)", ".tran 0.1m 50m uic")  # fmt: skip
    found = fs.simulate(circuit).fourier
    odd = np.arange(1, 10, 2)
    square = found["V(a)"]
    np.testing.assert_allclose(square.magnitude[odd], 8.0 / np.pi / odd, rtol=1e-10)
    np.testing.assert_allclose(square.magnitude[::2], 0.0, atol=1e-10)
    np.testing.assert_allclose(square.phase_deg[odd], 0.0, atol=1e-8)
    assert square.thd == pytest.approx(100.0 * math.sqrt((1.0 / odd[1:] ** 2).sum()), rel=1e-10)
    np.testing.assert_allclose(found["I(R1)"].magnitude, 1e-3 * square.magnitude, atol=1e-14)
    # (0.5 + sin)^2 = 0.75 + sin - cos(2 ...)/2, with the phase of 30 degrees.
    power = found["{V(b)*V(b)}"]
    np.testing.assert_allclose(power.magnitude[:3], [0.75, 1.0, 0.5], rtol=1e-10)
    np.testing.assert_allclose(power.phase_deg[1:3], [30.0, -30.0], rtol=1e-9)
    text = "\n".join(
        ["t", ".include fingerspice.lib", *TOP, ".four 100 V(top) V(skin)", ".tran 10u 50m uic", ".end", ""]
    )
    ours = fs.simulate(fs.parse_netlist(text)).fourier
    with tempfile.TemporaryDirectory(prefix="ngspice-") as folder:
        (Path(folder) / "fingerspice.lib").write_text((CIRCUITS / "fingerspice.lib").read_text())
        (Path(folder) / "deck.cir").write_text(text.replace("50m uic", "50m 0 1u uic"))
        said = call_ngspice(Path(folder), "deck.cir", timeout=300.0).stdout
    theirs = re.findall(r"^ (\d) +\S+ +(\S+) +(\S+)", said, re.MULTILINE)
    assert len(theirs) == 20
    for name, rows in (("V(top)", theirs[:10]), ("V(skin)", theirs[10:])):
        for k, (_, magnitude, phase) in enumerate(rows):
            assert ours[name].magnitude[k] == pytest.approx(float(magnitude), abs=2e-6 * ours[name].magnitude[1])
            if k % 2:
                assert ours[name].phase_deg[k] == pytest.approx(float(phase), abs=0.01)


def test_harmonics_are_shown_and_refused_where_there_are_none(tmp_path: Path, command: Any) -> None:
    (tmp_path / "pad.cir").write_text(table1().text.replace(".tran", ".four 100 F_EL(Xgap)\n.four 5 V(top)\n.tran"))
    words = "run", str(tmp_path / "pad.cir"), "--no-plot", "--out", str(tmp_path)
    said = command(*words).out
    assert "F_EL(Xgap): total harmonic distortion" in said
    assert "V(top): the run holds no whole period of 5 Hz" in said
    (row,) = json.loads(command(*words, "--overwrite", "--json").out)["fourier"]
    assert (row["vector"], row["frequency"], len(row["magnitude"])) == ("F_EL(Xgap)", 100.0, 10)
    for line, told in ((".four 0 V(a)", "fundamental of 0 Hz"), (".four 100", ".four ends where a vector is missing"),
                       (".four 100 V(x)", r".four V\(x\): the circuit has no node 'x'")):  # fmt: skip
        refuses(told, measured, line)


def test_a_deck_that_bounds_its_steps_keeps_its_method() -> None:
    run = fs.simulate(deck(*TOP, ".tran 0.1m 20m 0 1u uic"))
    assert run.method == "exponential"
    free = fs.simulate(deck(*TOP, ".tran 0.1m 20m uic"))
    assert np.abs(run.u_gap - free.u_gap).max() <= run.error.u_gap + free.error.u_gap


def test_other_spellings_of_both_simulators_are_read() -> None:
    circuit = deck(
        ".param vth = 50", "Vdrive drive 0 SIN(0 200 100)", ".subckt pad a b area",
        *finger("a", "b", f=100.0), ".ends", "X1 drive 0 area1 pad", "X2 drive 0 area2 pad", ".tran 0.1m 20m uic",
        ".MEASURE TRAN a trig v(drive) val = 100 rise = 1 targ v(X1.top) val=50 rise=1",
        ".meas tran b MAX V( X1.top , X1.skin )", ".meas tran c when v(x1.top)=vth rise=LAST",
        ".meas tran d find v(drive) when v(x1.top) = {vth/2} fall=1",
        ".meas tran e avg F_EL(X2.Xgap) from = 10m to=20m",
        ".meas tran f max abs(v(drive))-1", ".meas tran g AVG V(drive)*V(drive)", ".meas tran h rms V(area1)",
        ".meas tran i max '2*V(drive)' TO=4m", ".meas tran j param = 'i/2'",
    )  # fmt: skip
    run = fs.simulate(circuit)
    found = run.measures
    assert [name for name, one in run.measured.items() if one.failed] == []
    assert found["b"] == pytest.approx(run.summary()["u_gap:X1.Xgap_max"], rel=1e-7)
    assert found["e"] == pytest.approx(run.summary()["f_el:X2.Xgap_mean_periodic"], rel=1e-9)
    assert (found["f"], found["g"]) == (pytest.approx(199.0, rel=1e-9), pytest.approx(2e4, rel=1e-9))
    assert found["h"] == pytest.approx(1e6 * run.summary()["area:X1.Xgap_rms"], rel=1e-9)
    assert (found["i"], found["j"]) == (pytest.approx(400.0, rel=1e-9), pytest.approx(200.0, rel=1e-9))


def test_a_run_that_stopped_is_measured_up_to_there_and_no_further() -> None:
    circuit = table1("SIN(0 1500 100)", tran="50u 20m uic", coat={"r": "200meg"})
    lines = [".meas tran a MAX V(drive)", ".meas tran b AVG V(top) FROM=0 TO=10m", ".meas tran c FIND V(drive) AT=15m"]
    text = circuit.text.replace(".tran", "\n".join([*lines, ".four 100 V(top)", ".tran"]))
    run = warns("air breaks down", fs.simulate, fs.parse_netlist(text), charge_law="mobile", throw=False)
    assert run.status is fs.Status.FOLD
    stopped = float(run.t[-1])
    assert stopped < 5e-3
    assert run.measures["a"] == pytest.approx(np.abs(run.u_source).max(), rel=1e-12)
    assert f"is not within the run from 0 to {stopped:g} s" in run.measured["b"].failed
    assert "0.015 s is outside the run" in run.measured["c"].failed
    assert run.fourier["V(top)"] == "the run holds no whole period of 100 Hz"


def test_measures_of_others_that_failed_and_of_signals_that_are_not_there_say_so() -> None:
    found = measured(
        ".meas tran m0 WHEN V(b)=9", ".meas tran m1 PARAM='max(1, m0)'", ".meas tran m2 PARAM='m1+1'",
        ".meas tran m3 PARAM='2*2'",
    )  # fmt: skip
    assert [found[name].failed for name in ("m1", "m2")] == ["m0 has no value", "m1 has no value"]
    assert found["m3"].value == 4.0
    text = table1().text.replace(".tran", ".meas tran a MAX A_REAL(Xgap)\n.tran")
    run = fs.simulate(fs.parse_netlist(text))
    assert run.measured["a"].failed == "Xgap has no a_real; allowed: of a GAP with p_sat"


def test_circuits_with_measures_travel_and_files_keep_harmonics_and_currents(tmp_path: Path) -> None:
    lines = [".meas tran a MAX {V(top)*2}", ".meas tran b PARAM='a/2'", ".meas tran c WHEN V(top)=V(drive) CROSS=2"]
    text = table1().text.replace(".tran", "\n".join([*lines, ".four 100 V(top)", ".four 5 V(top,skin)", ".tran"]))
    circuit = fs.parse_netlist(text)
    run = fs.simulate(circuit)
    again = fs.simulate(pickle.loads(pickle.dumps(circuit)))
    assert again.measures == run.measures
    assert [one.failed for one in run.measured.values()] == ["", "", ""]
    loaded = fs.load(run.to_netcdf(tmp_path / "run.nc"))
    np.testing.assert_array_equal(loaded.fourier["V(top)"].magnitude, run.fourier["V(top)"].magnitude)
    assert loaded.fourier["V(top,skin)"] == run.fourier["V(top,skin)"]
    raws = [fs.read_raw(one.to_raw(tmp_path / f"{k}.raw")) for k, one in enumerate((run, loaded))]
    assert set(raws[0].vectors) == set(raws[1].vectors)
    for name, values in raws[0].vectors.items():
        np.testing.assert_array_equal(raws[1].vectors[name], values)
    assert "* The deck's .meas and .four lines are left out." in fs.export_netlist(circuit)


def test_measures_take_the_functions_of_the_deck() -> None:
    lines = ".func db(x) {20*log10(x)*k}", ".param k=2", "V1 a 0 SIN(0 10 100)", "R1 a b 1k", "C1 b 0 1u"
    asked = ".meas tran top MAX V(b)", ".meas tran level PARAM='db(top)'", ".meas tran more MAX {db(abs(V(b))+1)}"
    run = fs.simulate(deck(*lines, *asked, ".tran 10u 20m"))
    top, level, more = (run.measures[name] for name in ("top", "level", "more"))
    assert level == pytest.approx(40.0 * np.log10(top), rel=1e-12)
    assert more == pytest.approx(40.0 * np.log10(top + 1.0), rel=1e-9)
