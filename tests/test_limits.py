"""The map of the mobile law's fold: where it lies, and that it is the fold that runs meet."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from conftest import Command
from fingerspice.limits import fold_voltage
from scenes import table1


@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
def test_the_fold_voltage_parts_runs_that_fold_from_runs_that_do_not() -> None:
    circuit = table1().replace({"Xgap.d": 3e-7})
    found = fold_voltage(circuit, 200.0, 0.05, 200.0)
    below, above = (
        fs.simulate(
            circuit.replace({"Vdrive": fs.Sine(found * x, 100.0)}), charge_law="mobile", rtol=1e-5, t_stop=0.05,
            throw=False,
        )
        for x in (0.998, 1.002)
    )  # fmt: skip
    assert below.success
    assert above.status is fs.Status.FOLD
    # Where it is looked for first does not matter.
    assert fold_voltage(circuit, 200.0, 0.05, 20.0 * found) == pytest.approx(found, rel=2e-3)


def test_a_map_holds_the_deck_s_own_point_and_the_scaling_of_a_voltage() -> None:
    circuit = table1().replace({"Xgap.d": 3e-7})
    limits = fs.fold_limits(circuit, points=3, span=2.0)
    assert [s.name for s in limits.sweeps] == ["load", "gap", "frequency"]
    for sweep in limits.sweeps:
        assert sweep.values[1] == pytest.approx(sweep.own)
        assert sweep.voltages[1] == pytest.approx(limits.voltage, rel=2e-3)
    assert limits.peak == 200.0
    # A wider gap takes more voltage to close.
    assert np.all(np.diff(limits.sweeps[1].voltages) > 0.0)
    # What the source reaches now does not matter to where the fold is.
    louder = fs.fold_limits(circuit.replace({"Vdrive": fs.Sine(20.0, 100.0)}), points=3, span=2.0)
    assert louder.voltage == pytest.approx(limits.voltage, rel=2e-3)


def test_a_map_needs_a_gap_and_a_source_and_an_end() -> None:
    two = "x\nV1 a 0 SIN(0 1 100)\nC1 a 0 1n\n.tran 1u 1m uic\n.end\n"
    with pytest.raises(fs.InputError, match=r"needs one GAP.*this circuit has none"):
        fs.fold_limits(fs.parse_netlist(two))
    with pytest.raises(fs.InputError, match=r"points.*3 or more"):
        fs.fold_limits(table1(), points=1)
    with pytest.raises(fs.InputError, match=r"needs a V element with a voltage"):
        fs.fold_limits(table1().replace({"Vdrive": fs.DC(0.0)}))


def test_the_command_writes_a_table_a_picture_and_json(command: Command) -> None:
    result = command("limits", "pad.cir", "--set", "Xgap.d=300n", "--points", "3", "--span", "2", "--out", "maps")
    assert result.code == 0
    assert "under the mobile law this deck folds at" in result.out
    assert Path("maps/pad_limits.png").read_bytes().startswith(b"\x89PNG")
    rows = Path("maps/pad_limits.csv").read_text().splitlines()
    assert rows[0] == "parameter,value [SI],unit,fold [V]"
    assert len(rows) == 1 + 9
    words = ["limits", "pad.cir", "--set", "Xgap.d=300n", "--points", "3", "--span", "2", "--no-plot", "--json"]
    report = json.loads(command(*words).out)
    assert report["sweeps"][0]["unit"] == "N"
    assert math.isfinite(report["voltage"])
