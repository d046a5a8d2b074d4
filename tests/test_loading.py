"""Loading a NetCDF file restores the run to the last bit; another file is refused in one sentence."""

import json
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import h5netcdf
import numpy as np
import pytest
import xarray
from scipy.io import wavfile

import fingerspice as fs
from fingerspice.results import runfile
from fingerspice.results.runfile import GROUP
from scenes import listed, quietly, refuses, shipped, table1, table1_deck, warns

AM = fs.AM(150.0, 5000.0, 50.0) + 3.0 * fs.Square(1.0, 50.0, duty=0.25)


@cache
def one(name: str) -> fs.Solution:
    """A run of each kind."""
    if name == "changed":
        return fs.simulate(table1().replace({"Xgap.d": 4e-6, "Vdrive": AM}), t_stop=0.02, charge_law="mobile")
    if name == "failed":
        return fs.simulate(table1().replace({"Xgap.d": 1e-8}), charge_law="mobile", throw=False)
    if name == "no charge":
        return fs.simulate(table1("SQUARE(200 100)"), charge=False, t_stop=0.02)
    if name == "short":
        return fs.simulate(table1(), t_stop=1e-3)
    return fs.simulate(shipped(name))


RUNS = ["changed", "failed", "no charge", "two_fingers", "amplifier", "fingerpad_square"]


@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
@pytest.mark.parametrize("name", RUNS)
def test_a_file_is_the_run_again(name: str, tmp_path: Path) -> None:
    run = one(name)
    for jumps in ("right", "both"):
        same(run, fs.load(run.to_netcdf(tmp_path / "run.nc", jumps=jumps)))
    again = fs.load(run.to_netcdf(tmp_path / "x.nc"))
    xarray.testing.assert_identical(
        again.to_xarray().drop_attrs(), xarray.open_dataset(tmp_path / "x.nc").load().drop_attrs()
    )
    assert again.plot().axes
    if name in ("changed", "two_fingers", "fingerpad_square"):
        same_spectra(run, again)
    if name == "changed":
        once_more = fs.simulate(again.circuit, t_stop=0.02, charge_law="mobile")
        assert once_more.u_gap.tobytes() == run.u_gap.tobytes()
    if name == "fingerpad_square":
        same_spectra(run, fs.load(again.to_netcdf(tmp_path / "again.nc")))


def same(run: fs.Solution, again: fs.Solution) -> None:
    """Signals, figures, status and circuit are those of the run, to the last bit."""
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
    assert pickle.loads(pickle.dumps(again)).summary() == run.summary()


RECORDING = 40.0 * np.random.default_rng(2).normal(size=400).cumsum() / 10.0
EDGES = fs.Function(lambda t: 100.0 * np.sign(np.sin(2.0 * np.pi * 100.0 * t)), (0.0, 5e-3), 0.01)
SOURCES: dict[str, fs.Waveform] = {
    "recording": fs.Samples(RECORDING, 8000.0, 1e-3),
    "recording and sine": fs.Samples(RECORDING, 8000.0) + 2.0 * fs.Sine(30.0, 300.0),
    "function": fs.Function(lambda t: 100.0 * np.sin(600.0 * t) * np.exp(-20.0 * t)),
    "function with edges": EDGES,
    "function and constant": fs.Function(lambda t: 90.0 * np.cos(500.0 * t) ** 3) * fs.DC(0.5),
    "long PWL": fs.PWL(np.arange(12_000) * 4e-6, 50.0 * np.sin(np.arange(12_000.0))),
    "burst": fs.Repeat(fs.Burst(fs.Sine(120.0, 1000.0), 5e-3, 1e-3), 0.01),
}


@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
@pytest.mark.parametrize("name", SOURCES)
def test_a_file_holds_any_source(name: str, tmp_path: Path) -> None:
    wave = SOURCES[name]
    run = fs.simulate(table1().replace({"Vdrive": wave}), t_stop=0.02, rtol=1e-6)
    again = fs.load(run.to_netcdf(tmp_path / "run.nc"))
    held = again.circuit["Vdrive"].waveform
    assert held.period == wave.period
    # Not at an edge, where a function may have any value.
    times = np.linspace(0.0, 0.02, 2001)[:-1] + 3e-7
    # A function is held to the error with which the run represented it.
    np.testing.assert_allclose(held(times), wave(times), rtol=0, atol=0.0 if "function" not in name else 1e-5)
    same_spectra(run, again)
    assert str(again) == str(run)
    assert pickle.loads(pickle.dumps(again)).circuit["Vdrive"].waveform(0.01) == held(0.01)
    # At an edge of a function there are two outputs or one, as its sides are known or not: compare in between.
    one, other = (fs.simulate(c, t_stop=0.02, t_eval=times, rtol=1e-6).u_gap for c in (run.circuit, again.circuit))
    assert np.abs(one - other).max() <= 2e-6 * np.abs(one).max()


def same_spectra(run: fs.Solution, again: fs.Solution) -> None:
    """Each signal has the same lines, or the same density, and feels the same."""
    assert run.signals.keys() == again.signals.keys()
    for signal in [one for one in run.signals if one[:2] not in ("q_", "i_")]:
        own, read = run.spectrum(signal), again.spectrum(signal)
        np.testing.assert_array_equal(read.frequency, own.frequency)
        # Near a fold the margin goes as a root, which no polynomial follows well.
        size = np.abs(run.signals[signal][0]).max() * (10.0 if signal.startswith("fold_margin") else 1.0)
        for a, b in ((read.amplitude, own.amplitude), (read.density, own.density)):
            assert (a is None) == (b is None)
            if a is not None and b is not None:
                np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * (size if own.density is None else size**2))
        assert read.mean == pytest.approx(own.mean, rel=0, abs=1e-9 * size)
    for gap in run.gaps:
        signal = "f_t" if len(run.gaps) == 1 else f"f_t:{gap}"
        assert str(fs.feel(again, signal)) == str(fs.feel(run, signal))


def test_a_file_holds_what_a_deck_includes_and_plays(tmp_path: Path) -> None:
    data = np.round(2.0**15 * np.sin(np.arange(800.0)) * 0.5).astype("<i2")
    wavfile.write(tmp_path / "a.wav", 8000, data)
    (tmp_path / "gap.inc").write_text("Xgap top skin area GAP d=4u\n")
    (tmp_path / "table.txt").write_text("0 0 1m 100 2m 0")
    for source in ("WAVEFILE(a.wav 150)", "PWL FILE=table.txt"):
        deck = table1_deck(source, tran="50u 20m uic").splitlines()
        (tmp_path / "pad.cir").write_text(
            "\n".join([".include gap.inc" if line.startswith("Xgap") else line for line in deck])
        )
        circuit = fs.read_netlist(tmp_path / "pad.cir")
        run = quietly(fs.simulate, circuit, rtol=1e-5, area="frozen")
        again = fs.load(run.to_netcdf(tmp_path / "run.nc")).circuit
        assert [(e.name, e.nodes, e.values, repr(e.waveform)) for e in again.elements] == [
            (e.name, e.nodes, e.values, repr(e.waveform)) for e in circuit.elements
        ]
        assert (again.tran, again.text, again.charge_law) == (circuit.tran, circuit.text, circuit.charge_law)


def test_a_source_too_long_for_a_file_leaves_a_circuit_without_elements(tmp_path, monkeypatch):
    monkeypatch.setattr(runfile, "MOST_NUMBERS", 399)
    run = fs.simulate(table1("DC 0"), sources=fs.Samples(RECORDING, 8000.0), t_stop=2e-3, area="frozen")
    said = "its sources have 400 numbers, and a file keeps at most 399.; its elements are left out"
    again = warns(said, fs.load, run.to_netcdf(tmp_path / "run.nc"))
    assert again.circuit.elements == ()
    assert "(changed: Vdrive = " in str(again)
    assert again.f_el_mean == run.f_el_mean


def test_a_run_does_not_start_from_a_file(tmp_path: Path) -> None:
    again = fs.load(one("short").to_netcdf(tmp_path / "run.nc"))
    with pytest.raises(fs.InputError, match="read from a file, which a run cannot go on from; allowed: one just made"):
        fs.simulate(table1(), start=again, t_stop=1e-3)


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    run = one("short")
    for name, make in (
        ("none.nc", None),
        ("text.nc", lambda p: p.write_text("t [s],u_gap [V]\n")),
        ("empty.nc", lambda p: p.write_bytes(b"")),
        ("other.nc", lambda p: run.to_xarray().to_netcdf(p, engine="h5netcdf")),
        ("half.nc", lambda p: p.write_bytes(run.to_netcdf(tmp_path / "x").read_bytes()[:5000])),
    ):
        if make is not None:
            make(tmp_path / name)
        refuses(r"\.nc .*; allowed: a (NetCDF )?file that to_netcdf or the command", fs.load, tmp_path / name)


def changed(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """The file of a short run in which somebody has changed what the run says of itself."""
    one("short").to_netcdf(path)
    with h5netcdf.File(path, "a") as file:
        run = json.loads(file.groups[GROUP].attrs["run"])
        change(run)
        file.groups[GROUP].attrs["run"] = json.dumps(run)
    return path


@pytest.mark.parametrize("part", listed("run_files"))
def test_a_file_is_data_whoever_wrote_it(part: dict[str, object], tmp_path: Path) -> None:
    path = changed(tmp_path / "run.nc", lambda run: run["circuit"]["elements"][0].update(part))
    with pytest.warns(fs.FingerspiceWarning, match="cannot be made again"):
        assert fs.load(path).circuit.elements == ()


def test_a_file_of_an_earlier_version_has_no_elements(tmp_path: Path) -> None:
    path = changed(tmp_path / "run.nc", lambda run: (run.pop("circuit"), run.pop("between")))
    with pytest.warns(fs.FingerspiceWarning, match=r"from its file \(an earlier version wrote it\); its elements"):
        assert fs.load(path).circuit.elements == ()


@pytest.mark.parametrize("key", ["plan", "state", "contacts", "error", "summary", "status", "sources"])
def test_a_file_with_a_part_of_another_kind_is_refused(key: str, tmp_path: Path) -> None:
    path = changed(tmp_path / "run.nc", lambda run: run.update({key: 7}))
    refuses("cannot be read as a run", fs.load, path)


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
    assert {"f_el:Xfirm.Xgap", "f_el:Xlight.Xgap"} <= set(one("two_fingers").to_dataframe().columns)
    refuses("jumps is 'left'", run.to_dataframe, jumps="left")
