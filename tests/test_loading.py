"""Loading a NetCDF file restores the run to the last bit; another file is refused in one sentence."""

from __future__ import annotations

import json
import pickle
import warnings
from pathlib import Path

import h5netcdf
import numpy as np
import pytest
import xarray

import fingerspice as fs
from fingerspice.results.datafiles import GROUP
from scenes import table1

AM = fs.AM(150.0, 5000.0, 50.0) + 3.0 * fs.Square(1.0, 50.0, duty=0.25)


def one(name: str) -> fs.Solution:
    """A run of each kind."""
    if name == "changed":
        return fs.simulate(table1().replace({"Xgap.d": 4e-6, "Vdrive": AM}), t_stop=0.02, charge_law="mobile")
    if name == "failed":
        return fs.simulate(table1().replace({"Xgap.d": 1e-8}), charge_law="mobile", throw=False)
    if name == "no charge":
        return fs.simulate(table1("SQUARE(200 100)"), charge=False, t_stop=0.02)
    return fs.simulate(fs.read_netlist(f"circuits/{name}.cir"))


RUNS = ["changed", "failed", "no charge", "two_fingers", "amplifier", "fingerpad_square"]


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize("jumps", ["right", "both"])
def test_a_file_is_the_run_again(name: str, jumps: str, tmp_path: Path) -> None:
    run = one(name)
    again = fs.load(run.to_netcdf(tmp_path / "run.nc", jumps=jumps))
    assert again.signals.keys() == run.signals.keys()
    for key, (x, unit, text) in run.signals.items():
        assert again.signals[key][0].tobytes() == x.tobytes(), key
        assert again.signals[key][1:] == (unit, text)
    assert again.summary() == run.summary()
    assert str(again) == str(run)
    assert (again.status, again.failure, again.error) == (run.status, run.failure, run.error)
    for key in ("f_el_mean", "f_el_mean_periodic", "u_gap_peak", "area_mean"):
        np.testing.assert_array_equal(getattr(again, key), getattr(run, key))
    assert again.circuit.overrides == run.circuit.overrides
    assert [e.values for e in again.circuit.elements] == [e.values for e in run.circuit.elements]
    assert [e.waveform for e in again.circuit.elements] == [e.waveform for e in run.circuit.elements]
    xarray.testing.assert_identical(
        again.to_xarray().drop_attrs(), xarray.open_dataset(run.to_netcdf(tmp_path / "x.nc")).load().drop_attrs()
    )
    assert again.plot().axes
    assert pickle.loads(pickle.dumps(again)).summary() == run.summary()


def test_a_loaded_circuit_runs_again_to_the_same_result(tmp_path: Path) -> None:
    run = one("changed")
    circuit = fs.load(run.to_netcdf(tmp_path / "run.nc")).circuit
    again = fs.simulate(circuit, t_stop=0.02, charge_law="mobile")
    assert again.u_gap is not None
    assert run.u_gap is not None
    assert again.u_gap.tobytes() == run.u_gap.tobytes()


def test_a_source_that_a_file_cannot_hold_leaves_a_circuit_without_elements(tmp_path: Path) -> None:
    run = fs.simulate(table1(), sources={"Vdrive": lambda t: 100.0 * np.sin(600.0 * t)}, t_stop=2e-3)
    with pytest.warns(fs.FingerspiceWarning, match="a source that was a function or samples is not kept"):
        again = fs.load(run.to_netcdf(tmp_path / "run.nc"))
    assert again.circuit.elements == ()
    assert "(changed: Vdrive = <lambda>)" in str(again)
    assert again.f_el_mean == run.f_el_mean


def test_a_run_does_not_start_from_a_file(tmp_path: Path) -> None:
    again = fs.load(fs.simulate(table1(), t_stop=1e-3).to_netcdf(tmp_path / "run.nc"))
    with pytest.raises(fs.InputError, match="read from a file, which a run cannot go on from; allowed: one just made"):
        fs.simulate(table1(), start=again, t_stop=1e-3)


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    run = fs.simulate(table1(), t_stop=1e-3)
    for name, make in (
        ("none.nc", None),
        ("text.nc", lambda p: p.write_text("t [s],u_gap [V]\n")),
        ("empty.nc", lambda p: p.write_bytes(b"")),
        ("other.nc", lambda p: run.to_xarray().to_netcdf(p, engine="h5netcdf")),
        ("half.nc", lambda p: p.write_bytes(run.to_netcdf(tmp_path / "x").read_bytes()[:5000])),
    ):
        if make is not None:
            make(tmp_path / name)
        with pytest.raises(fs.InputError, match=r"\.nc .*; allowed: a (NetCDF )?file that to_netcdf or the command"):
            fs.load(tmp_path / name)


@pytest.mark.parametrize(
    "overrides",
    [
        {"Vdrive": "__import__('os').system('true')"},
        {"Vdrive": "Sine(amplitude=().__class__, frequency=1)"},
        {"Vdrive": "(" * 5000},
        {"Vdrive": "Sum(parts=" * 50 + ")" * 50},
        {"Nothing.d": "1"},
        {"Vdrive": "Sine(1, 2, 3, 4, 5, 6, 7, 8)"},
    ],
)
def test_a_file_is_data_whoever_wrote_it(overrides: dict[str, str], tmp_path: Path) -> None:
    path = fs.simulate(table1(), t_stop=1e-3).to_netcdf(tmp_path / "run.nc")
    with h5netcdf.File(path, "a") as file:
        run = json.loads(file.groups[GROUP].attrs["run"])
        file.groups[GROUP].attrs["run"] = json.dumps({**run, "overrides": overrides})
    with pytest.warns(fs.FingerspiceWarning, match="cannot be made again"):
        assert fs.load(path).circuit.elements == ()


@pytest.mark.parametrize("key", ["plan", "state", "contacts", "error", "summary", "status", "sources"])
def test_a_file_with_a_part_of_another_kind_is_refused(key: str, tmp_path: Path) -> None:
    path = fs.simulate(table1(), t_stop=1e-3).to_netcdf(tmp_path / "run.nc")
    with h5netcdf.File(path, "a") as file:
        run = json.loads(file.groups[GROUP].attrs["run"])
        file.groups[GROUP].attrs["run"] = json.dumps({**run, key: 7})
    with pytest.raises(fs.InputError, match="cannot be read as a run"):
        fs.load(path)


def test_several_fingers_are_a_dimension() -> None:
    run = one("two_fingers")
    data = run.to_xarray()
    assert list(data.gap.values) == ["Xfirm.Xgap", "Xlight.Xgap"]
    for key in ("u_gap", "f_el", "f_t", "friction", "area", "sigma_el"):
        assert data[key].dims == ("time", "gap")
        np.testing.assert_array_equal(data[key].values, getattr(run, key))
    assert not [name for name in map(str, data) if ":" in name]
    light = data.f_el.sel(gap="Xlight.Xgap")
    np.testing.assert_array_equal(light, run.by_name("f_el")["f_el:Xlight.Xgap"])


def test_a_dataframe_has_one_row_a_time() -> None:
    run = one("fingerpad_square")
    frame = run.to_dataframe()
    assert frame.index.name == "time"
    assert frame.index.is_unique
    assert list(frame.columns) == list(run.signals)
    assert len(frame) == run.to_xarray().sizes["time"]
    assert len(run.to_dataframe(jumps="both")) == run.t.size
    two = one("two_fingers").to_dataframe()
    assert {"f_el:Xfirm.Xgap", "f_el:Xlight.Xgap"} <= set(two.columns)
    with warnings.catch_warnings(), pytest.raises(fs.InputError, match="jumps is 'left'"):
        run.to_dataframe(jumps="left")
