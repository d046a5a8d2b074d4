"""The map of the mobile law's fold: its voltages, which are those at which runs reach the fold."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from conftest import Command
from fingerspice.studies import limits
from fingerspice.studies.limits import fold_voltage
from scenes import deck, table1, table1_deck


@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
@pytest.mark.parametrize("start", ["uncharged", "operating point", "given"])
def test_the_fold_is_that_of_a_run_which_starts_as_the_deck_s_does(start: str) -> None:
    # A cosine from its crest: from rest it jumps there, from its operating point it has been there for ever.
    tran = "10u 4m" if start == "operating point" else "10u 4m uic"
    ic = ".ic v(top)=12 v(skin)=-9" if start == "given" else ""
    circuit = table1("SIN(0 200 100 0 0 90)", tran=tran, extra=ic).replace({"Xgap.d": 3e-7})
    found = fold_voltage(circuit, 200.0, 4e-3)
    params = dataclasses.replace(ref.TABLE1, d_a=3e-7)
    how = {"uncharged": "uncharged", "operating point": "dc", "given": [-12.0, 21.0, -9.0]}[start]
    for x, folds in ((0.998, False), (1.002, True)):
        segments = ref.sine_segments(x * found, 100.0, 4e-3, phase=0.5 * math.pi)
        run = ref.transient(segments, [], law="mobile", freq=100.0, params=params, start=how, tol=1e-9)
        assert (run.fold is not None) == folds


@pytest.mark.filterwarnings("ignore:the fold of the mobile charge law is near")
def test_an_operating_point_past_the_fold_has_met_it_and_a_given_start_there_is_refused() -> None:
    # Across 10 nm the first of the voltages tried stands past the fold before it has begun.
    circuit = table1("SIN(0 200 100 0 0 90)", tran="10u 4m").replace({"Xgap.d": 1e-8})
    found = fold_voltage(circuit, 200.0, 4e-3)
    with pytest.raises(fs.InputError, match="past the fold of the mobile law"):
        fs.simulate(circuit.replace({"Vdrive.amplitude": 1.002 * found}), charge_law="mobile")
    assert fs.simulate(circuit.replace({"Vdrive.amplitude": 0.998 * found}), charge_law="mobile").success
    with pytest.raises(fs.InputError, match="past the fold of the mobile law"):
        fold_voltage(dataclasses.replace(circuit, initial={"top": 5.0}), 200.0, 4e-3)


@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
def test_a_map_holds_the_deck_s_own_point_and_the_scaling_of_a_voltage() -> None:
    circuit = table1(tran="10u 10m uic").replace({"Xgap.d": 3e-7})
    found = fs.fold_limits(circuit, points=3, span=2.0)
    for x, status in ((0.998, fs.Status.SUCCESS), (1.002, fs.Status.FOLD)):
        louder = circuit.replace({"Vdrive": fs.Sine(found.voltage * x, 100.0)})
        assert fs.simulate(louder, charge_law="mobile", rtol=1e-5, throw=False).status is status
    assert [s.name for s in found.sweeps] == ["load", "gap", "frequency"]
    for sweep in found.sweeps:
        assert sweep.values[1] == pytest.approx(sweep.own)
        assert sweep.voltages[1] == found.voltage
    assert found.peak == 200.0
    # A wider gap takes more voltage to close.
    assert np.all(np.diff(found.sweeps[1].voltages) > 0.0)
    # What the source reaches now, and where the fold is looked for first, does not matter to where it is.
    quiet = fold_voltage(circuit.replace({"Vdrive": fs.Sine(20.0, 100.0)}), 20.0, 0.01, 20.0 * found.voltage)
    assert quiet == pytest.approx(found.voltage, rel=2e-3)
    assert "under the mobile law this deck folds at" in str(found)


def test_the_fold_at_the_deck_s_own_point_is_looked_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    # A second search of the same point met a run that took too many steps: a coat of 1 um, a gap of 100 nm at 100 Hz.
    tried: list[tuple[float, ...]] = []

    def fold_voltage(circuit: fs.Circuit, *_: object) -> float:
        tried.append(tuple(circuit.parameters[path].value for path in ("Xgap.fn", "Xgap.d", "Vdrive.frequency")))
        return 104.7

    monkeypatch.setattr(limits, "fold_voltage", fold_voltage)
    assert fs.fold_limits(table1(gap={"d": "100n"}), points=5, span=1.01).voltage == 104.7
    assert len(set(tried)) == len(tried) == 1 + 3 * 4


@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
def test_where_exponential_steps_give_up_near_the_fold_implicit_ones_look_for_it() -> None:
    circuit = table1(gap={"d": "100n"}).replace({"Vdrive.frequency": 10.0})
    found = fold_voltage(circuit, 200.0, 0.3, 900.0)
    for x, status in ((0.998, fs.Status.SUCCESS), (1.002, fs.Status.FOLD)):
        run = fs.simulate(
            circuit.replace({"Vdrive.amplitude": x * found}), charge_law="mobile", t_stop=0.3, rtol=1e-5, throw=False
        )
        assert run.status is status


def test_a_map_needs_a_gap_and_a_source_and_an_end() -> None:
    two = deck("V1 a 0 SIN(0 1 100)", "C1 a 0 1n", ".tran 1u 1m uic")
    for circuit, points, said in (
        (two, 9, "needs one GAP.*this circuit has none"),
        (table1(), 1, "points is 1; allowed: 3 to 1000"),
        (table1().replace({"Vdrive": fs.DC(0.0)}), 9, "needs a V element with a voltage"),
    ):
        with pytest.raises(fs.InputError, match=said):
            fs.fold_limits(circuit, points=points)


def test_the_command_writes_a_table_a_picture_and_json(command: Command) -> None:
    Path("pad.cir").write_text(table1_deck(tran="10u 5m uic", gap={"d": "300n"}))
    result = command("limits", "pad.cir", "--points", "3", "--span", "2", "--out", "maps", "--json")
    assert result.code == 0
    report = json.loads(result.out)
    assert report["sweeps"][0]["unit"] == "N"
    assert math.isfinite(report["voltage"])
    assert Path("maps/pad_limits.png").read_bytes().startswith(b"\x89PNG")
    rows = Path("maps/pad_limits.csv").read_text().splitlines()
    assert rows[0] == "parameter,value [SI],unit,fold [V]"
    assert len(rows) == 1 + 9
