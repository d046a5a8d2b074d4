"""The result of a run: its output rows, its arrays and copies of it, its figures, and its files."""

import copy
import csv
import dataclasses
import errno
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray

import analytic as ref
import fingerspice as fs
from commands import tree
from fingerspice.base.files import write_aside
from fingerspice.results.record import SIGNALS
from scenes import deck, refuses, shipped, table1

SQUARE = "SQUARE(200 100)"
T_STOP, STEP = 0.03, 1e-4


@pytest.fixture(scope="module")
def square() -> fs.Solution:
    """Three periods of an ideal square, 100 points each: jumps at every 5 ms."""
    return fs.simulate(table1(SQUARE, tran="100u 30m uic"), rtol=1e-9)


def load(path: Path) -> xarray.Dataset:
    with xarray.open_dataset(path) as dataset:
        return dataset.load()


def rows(path: Path) -> tuple[list[str], np.ndarray]:
    with path.open(newline="") as stream:
        head, *body = csv.reader(stream)
    return head, np.array(body, float)


def test_times_are_the_output_grid_with_two_rows_at_each_jump_after_the_start(square: fs.Solution) -> None:
    jumps = np.array([0.005, 0.01, 0.015, 0.02, 0.025, 0.03])
    grid = STEP * np.arange(301)
    np.testing.assert_allclose(square.t, np.sort(np.concatenate([grid, jumps])), rtol=1e-12)
    twice = np.flatnonzero(np.diff(square.t) == 0.0)
    np.testing.assert_allclose(square.t[twice], jumps, rtol=1e-12)
    before = np.array([200.0, -200.0] * 3)
    np.testing.assert_array_equal(square.u_source[twice], before)
    np.testing.assert_array_equal(square.u_source[twice + 1], -before)
    # A jump of U splits over the layers at once, in the ratio of 1/c.
    split = (square.u_layer[twice + 1] - square.u_layer[twice]) / (-2.0 * before[:, None])
    elastance = np.array([1.0 / layer.c for layer in ref.table1_layers(100.0)])
    np.testing.assert_allclose(split, np.broadcast_to(elastance / elastance.sum(), split.shape), rtol=1e-12)
    assert square.t[0] == 0.0
    assert square.u_source[0] == 200.0


def test_tstart_leaves_out_what_comes_before_it(square: fs.Solution) -> None:
    late = fs.simulate(table1(SQUARE, tran="100u 30m 12m uic"), rtol=1e-9)
    assert late.t[0] == 0.012
    keep = square.t >= 0.012 - 1e-9
    np.testing.assert_allclose(late.t, square.t[keep], rtol=1e-12)
    np.testing.assert_allclose(late.u_gap, square.u_gap[keep], rtol=0, atol=1e-6)  # type: ignore[index]


def test_with_t_eval_times_are_exactly_those_and_right_hand_at_jumps() -> None:
    asked = np.array([0.0, 1.23456e-3, 0.005, 0.0149999, 0.015, 0.021])
    solution = fs.simulate(table1(SQUARE), t_eval=asked, t_stop=T_STOP)
    np.testing.assert_array_equal(solution.t, asked)
    np.testing.assert_array_equal(solution.u_source, [200.0, 200.0, -200.0, 200.0, -200.0, 200.0])
    assert solution.u_layer.shape == (6, 3)


def under(source: fs.Waveform, stop: float, step: float, **more: Any) -> fs.Solution:
    circuit = table1(tran=f"{step!r} {stop!r} uic")
    return fs.simulate(circuit, sources={"Vdrive": source}, rtol=1e-5, charge=False, **more)


def test_corners_of_edges_that_take_time_are_no_jumps() -> None:
    # Of the source of 1 MHz there were 3,751 rows with 1,870 repeated times.
    for low, edge, period, stop in (
        *((-200.0, edge, 10e-3, stop) for edge in (1e-6, 1e-9, 1e-11) for stop in (5e-2, 5.0)),
        (0.0, 1e-8, 1e-6, 1e-4),
    ):
        solution = under(fs.Pulse(low, 200.0, 0.0, edge, edge, 0.5 * period - edge, period), stop, stop / 10)
        assert solution.t.size == 11
        assert np.all(np.diff(solution.t) > 0.0)


@pytest.mark.parametrize(
    ("source", "jumps"),
    [
        (fs.Square(200.0, 100.0), np.arange(1, 11) * 5e-3),
        (fs.Sawtooth(200.0, 100.0), np.arange(1, 6) * 1e-2),
        (fs.PWL((0.0, 0.01, 0.01, 0.05), (0.0, 1.0, 1.0 + 1e-9, 2.0)), [0.01]),
        (fs.Sine(200.0, 100.0) + fs.PWL((0.0, 0.02, 0.02, 0.05), (0.0, 0.0, 1e-6, 1e-6)), [0.02]),
        (fs.PWL((0.0, 0.02, 0.02, 0.02 + 1e-9, 0.05), (0.0, 0.0, 5.0, 200.0, 200.0)), [0.02]),
    ],
    ids=["square", "sawtooth", "a billionth", "below a sine", "before a steep edge"],
)
def test_a_jump_has_two_rows_with_both_values(source: fs.Waveform, jumps: Any) -> None:
    solution = under(source, 0.05, 1e-3)
    at = np.flatnonzero(np.diff(solution.t) == 0.0)
    np.testing.assert_allclose(solution.t[at], jumps, rtol=1e-15)
    np.testing.assert_array_equal(solution.u_source[at], source.value(solution.t[at], "left"))
    np.testing.assert_array_equal(solution.u_source[at + 1], source.value(solution.t[at]))


def test_rows_at_jumps_can_be_left_out() -> None:
    both, none = (under(fs.Square(200.0, 100.0), 0.05, 1e-3, jumps=jumps) for jumps in ("both", "none"))
    np.testing.assert_allclose(none.t, np.arange(51) * 1e-3, rtol=1e-14)
    right = np.append(np.diff(both.t) > 0.0, True)
    np.testing.assert_array_equal(none.u_gap, both.u_gap[right])  # type: ignore[index]


def test_a_jump_of_one_source_is_not_hidden_by_that_of_another() -> None:
    circuit = deck(
        "V1 a 0 PWL(0 0 1m 0 1m 2 5m 2)", "I1 0 b PWL(0 0 1m 0 1m -2 5m -2)", "R1 a b 1k", "C1 b 0 1u",
        ".tran 1m 5m uic",
    )  # fmt: skip
    assert np.count_nonzero(np.diff(fs.simulate(circuit).t) == 0.0) == 1


def test_arrays_are_read_only_and_the_result_is_frozen(square: fs.Solution) -> None:
    arrays = [*(value for value, _, _ in square.signals.values()), fs.Samples([1.0, 2.0], 1.0).values]
    for array in (square.t, square.u_layer, *arrays, *square.node_voltages.values()):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        square.rtol = 1.0  # type: ignore[misc]


@pytest.mark.parametrize("name", ["fingerpad", "two_fingers"])
def test_a_copys_arrays_are_read_only_and_the_same(name: str) -> None:
    solution = fs.simulate(shipped(name), t_stop=2e-3)
    samples = fs.Samples(np.arange(3.0), 1e3)
    # Before its signals are made, and after.
    for made in (False, True):
        for how in (copy.deepcopy, lambda whole: pickle.loads(pickle.dumps(whole)), copy.copy):
            copied = how(solution)
            arrays = {key: values for key, (values, _, _) in copied.signals.items()}
            record = {key: x for key, x in vars(copied.record).items() if isinstance(x, np.ndarray) and key[0] != "_"}
            for key, values in {**arrays, **record, "t": copied.t, "samples": how(samples).values}.items():
                assert not values.flags.writeable, key
            for key, (values, _, _) in solution.signals.items() if made else ():
                np.testing.assert_array_equal(arrays[key], values)


@pytest.mark.parametrize("area", ["coupled", "frozen"])
def test_the_times_asked_for_stay_the_callers_own(area: str) -> None:
    t = np.arange(49) / 48e3
    source = fs.Samples(np.sin(np.arange(49.0)), 48e3)
    solution = fs.simulate(table1(), sources=source, t_stop=1e-3, t_eval=t, area=area, charge=False)
    t += 1.0
    np.testing.assert_array_equal(solution.t, np.arange(49) / 48e3)
    np.testing.assert_array_equal(solution.u_source, np.sin(np.arange(49.0)))


def test_every_signal_has_its_unit_and_is_that_of_its_name(square: fs.Solution) -> None:
    units = {name: unit for name, (_, unit, _) in square.signals.items()}
    assert units == {
        **dict.fromkeys(("u_source", "u_layer:Xcoat", "u_layer:Xgap", "u_layer:Xskin", "u_gap"), "V"),
        "area": "m^2", "sigma_el": "Pa", "f_el": "N", "f_t": "N", "friction": "1", "q_source": "C", "i_source": "A",
        "fold_margin": "1", **dict.fromkeys(("v:drive", "v:top", "v:skin"), "V"),
    }  # fmt: skip
    assert square.layers == ("Xcoat", "Xgap", "Xskin")
    np.testing.assert_array_equal(square.signals["u_layer:Xgap"][0], square.u_gap)
    for key in SIGNALS:
        if key == "a_real":
            assert square.a_real is None
        elif key not in ("u_layer", "v"):
            assert square.by_name(key)[key] is getattr(square, key)
    np.testing.assert_array_equal(square.f_t, 0.3 * (0.5 + square.f_el))
    np.testing.assert_array_equal(square.friction, square.f_t / 0.5)


def test_figures_of_the_source_of_a_square_are_by_hand(square: fs.Solution) -> None:
    s = square.summary()
    assert s["u_source_rms"] == pytest.approx(200.0, rel=1e-12)
    assert s["u_source_mean_periodic"] == pytest.approx(0.0, abs=1e-9)
    assert s["u_source_amplitude"] == pytest.approx(200.0 * 4.0 / np.pi, rel=1e-3)


def test_a_circuit_without_gap_has_figures_of_its_layers(tmp_path: Path) -> None:
    layers = "X1 a b area LAYER d=1u eps_r=2 r=1meg", "X2 b 0 area LAYER d=2u eps_r=3 r=1meg"
    solution = fs.simulate(deck("V1 a 0 SIN(0 10 100)", *layers, "Varea area 0 35", ".tran 100u 20m uic"))
    s = solution.summary()
    assert (s["t_stop"], s["status"]) == (0.02, "SUCCESS")
    top = solution.u_layer[:, 0].max()
    assert top <= s["u_layer:X1_max"] <= top * (1.0 + 5e-4)
    assert not [key for key in s if key.startswith(("f_el", "u_gap", "friction"))]
    assert load(solution.to_netcdf(tmp_path / "a.nc")).identical(solution.to_xarray())
    assert "f_el" not in solution.to_xarray()


def test_netcdf_holds_what_to_xarray_gives(square: fs.Solution, tmp_path: Path) -> None:
    unique = np.unique(square.t)
    for jumps, times in (("both", square.t), ("right", unique)):
        dataset = square.to_xarray(jumps=jumps)
        xarray.testing.assert_identical(load(square.to_netcdf(tmp_path / "run.nc", jumps=jumps)), dataset)
        assert dataset.sizes == {"time": times.size, "layer": 3, "node": 3}
        np.testing.assert_array_equal(dataset.time, times)
    at = dataset.sel(time=0.005, method="nearest")
    assert float(at.u_source) == -200.0
    assert float(at.u_layer.sum()) == pytest.approx(-200.0, rel=1e-12)
    assert dataset.u_gap.attrs == {"units": "V", "long_name": "gap voltage"}
    assert dataset.area.attrs["units"] == "m^2"
    assert dataset.time.attrs["units"] == "s"
    np.testing.assert_array_equal(dataset.u_layer.sel(layer="Xgap"), dataset.u_gap)
    np.testing.assert_allclose(dataset.v.sel(node="drive"), dataset.u_source, rtol=1e-12)


def test_another_word_for_jumps_is_refused(square: fs.Solution, tmp_path: Path) -> None:
    refuses(r"jumps is 'right'; allowed: 'both' or 'none'", fs.simulate, table1(), jumps="right")
    for call in (square.to_xarray, square.to_dataframe, lambda **k: square.to_netcdf(tmp_path / "x.nc", **k)):
        refuses(r"jumps is 'left'; allowed: 'right' or 'both'", call, jumps="left")
    assert list(tmp_path.iterdir()) == []


def test_csv_reads_back_every_bit_and_names_its_units(square: fs.Solution, tmp_path: Path) -> None:
    head, table = rows(square.to_csv(tmp_path / "run.csv"))
    assert head[0] == "t [s]"
    assert head[1:] == [f"{name} [{unit}]" for name, (_, unit, _) in square.signals.items()]
    np.testing.assert_array_equal(table[:, 0], square.t)
    for i, (value, _, _) in enumerate(square.signals.values()):
        np.testing.assert_array_equal(table[:, 1 + i], value)


def test_files_say_what_it_takes_to_repeat_the_run(tmp_path: Path) -> None:
    circuit = table1(library="fingerspice_mobile.lib").replace({"Xgap.d": 4e-6, "Vdrive": fs.Sine(150.0, 100.0)})
    solution = fs.simulate(circuit, t_stop=2e-3, rtol=1e-7, method="radau", area="coupled")
    attrs = load(solution.to_netcdf(tmp_path / "run.nc")).attrs
    assert attrs == solution.provenance()
    assert attrs["program"] == f"fingerspice {fs.__version__}"
    assert attrs["deck"] == circuit.text
    overrides = json.loads(attrs["overrides"])
    assert float(overrides["Xgap.d"]) == 4e-6
    assert "150" in overrides["Vdrive"]
    expected = {"charge_law": "mobile", "area": "coupled", "method": "radau", "rtol": "1e-07", "status": "SUCCESS"}
    assert {key: attrs[key] for key in expected} == expected
    assert float(attrs["error_u_gap_V"]) == solution.error.u_gap > 0.0
    assert float(attrs["error_f_el_N"]) == solution.error.f_el > 0.0
    # The text read again, with the overrides named, is the same scene.
    again = fs.parse_netlist(attrs["deck"]).replace({"Xgap.d": float(overrides["Xgap.d"])})
    assert dict(again["Xgap"].values) == dict(circuit["Xgap"].values)


@pytest.mark.filterwarnings("ignore:Vdrive. the recording ends")
def test_a_deck_of_more_than_64_kib_is_kept_whole(tmp_path: Path) -> None:
    # HDF5 has a limit of 64 KiB for an attribute written the compact way.
    points = " ".join(f"{i}u {100.0 * np.sin(i / 300.0):.9f}" for i in range(6000))
    circuit = table1(f"PWL({points})", tran="100u 2m uic")
    assert len(circuit.text) > 65536
    solution = fs.simulate(circuit, rtol=1e-5)
    assert load(solution.to_netcdf(tmp_path / "run.nc")).attrs["deck"] == circuit.text


def test_a_failed_run_keeps_what_came_before_it(tmp_path: Path) -> None:
    circuit = table1().replace({"Xgap.d": 10e-9})
    with pytest.raises(fs.SolveError) as caught:
        fs.simulate(circuit, charge_law="mobile")
    partial = fs.simulate(circuit, charge_law="mobile", throw=False)
    assert not partial.success
    assert partial.status is fs.Status.FOLD
    assert partial.message == str(caught.value)
    np.testing.assert_array_equal(caught.value.solution.t, partial.t)
    assert 0 < partial.t.size < 100
    assert all(value.shape[0] == partial.t.size for value, _, _ in partial.signals.values())
    assert all(np.isfinite(value).all() for value, _, _ in partial.signals.values())
    dataset = load(partial.to_netcdf(tmp_path / "run.nc"))
    assert dataset.attrs["status"] == "FOLD"
    assert dataset.attrs["message"] == partial.message
    assert rows(partial.to_csv(tmp_path / "run.csv"))[1].shape[0] == partial.t.size
    assert partial.summary()["status"] == "FOLD"
    assert [s.name for s in fs.Status if "success" in s.value] == ["SUCCESS"]


def test_a_file_is_whole_or_as_it_was_when_the_disk_is_full_or_writing_is_interrupted(square, tmp_path, monkeypatch):
    def broken_off(path: Path, write_to: Any) -> Path:
        def half(target: Path) -> None:
            target.write_text("half of a file")
            raise error

        return write_aside(path, half)

    monkeypatch.setattr("fingerspice.base.files.write_aside", broken_off)
    for error, told, said in (  # noqa: B007
        (OSError(errno.ENOSPC, "No space left on device"), fs.InputError, r"write .*run\.dat: No space left on device"),
        (KeyboardInterrupt(), KeyboardInterrupt, None),
    ):
        for there in ({}, {"run.dat": b"before"}):
            for name, content in there.items():
                (tmp_path / name).write_bytes(content)
            for write in (square.to_csv, square.to_netcdf):
                with pytest.raises(told, match=said):
                    write(tmp_path / "run.dat")
                assert tree(tmp_path) == there
        (tmp_path / "run.dat").unlink()


def test_states_status_and_elements_show_themselves_in_one_short_line(square: fs.Solution) -> None:
    assert repr(square.status) == "Status.SUCCESS"
    assert repr(square.state) == "<State at t = 0.03 s, 3 numbers, local law>"
    gap = repr(table1()["Xgap"])
    assert gap.startswith("<GAP Xgap top skin area d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3 ")
    assert repr(table1()["Vdrive"]) == "<V Vdrive drive 0 Sine(200 V, 100 Hz)>"
