"""Sweeps over grids and populations, and Sobol indices, against functions whose indices are known."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy import stats

import fingerspice as fs
from commands import Command
from fingerspice.studies.sweep import populations
from scenes import CIRCUITS, listed, shipped


@pytest.fixture(scope="module")
def circuit() -> fs.Circuit:
    return shipped("fingerpad")


HOW = {"periodic": True, "outputs": ("f_el_mean_periodic",), "rtol": 1e-4}


def test_a_grid_has_a_dimension_for_each_array(circuit: fs.Circuit) -> None:
    gaps, loads = [3e-6, 3.5e-6, 4e-6], [0.3, 0.5]
    found = fs.sweep(circuit, {"xgap.D": gaps, "Xgap.fn": loads}, **HOW)
    assert found.f_el_mean_periodic.dims == ("Xgap.d", "Xgap.fn")
    for i, d in enumerate(gaps):
        for j, load in enumerate(loads):
            mean = fs.steady_state(circuit.replace({"Xgap.d": d, "Xgap.fn": load}), rtol=1e-6).solution.f_el_mean
            assert float(found.f_el_mean_periodic[i, j]) == pytest.approx(mean, rel=2e-4)


def test_a_population_is_the_same_at_every_place_and_for_every_seed(circuit: fs.Circuit) -> None:
    law = stats.lognorm(0.1, scale=3.5e-6)
    asked: dict[str, Any] = {"source.frequency": [100.0, 1000.0], "Xgap.d": law}
    found, again, other = (fs.sweep(circuit, asked, n=64, seed=seed, **HOW) for seed in (3, 3, 4))
    xr.testing.assert_identical(found, again)
    assert not np.array_equal(found["Xgap.d"], other["Xgap.d"])
    assert found.f_el_mean_periodic.dims == ("Vdrive.frequency", "scene")
    # Sobol points: one in each of 64 equal parts of the distribution.
    np.testing.assert_array_equal(np.sort(np.floor(64.0 * law.cdf(found["Xgap.d"].values))), np.arange(64))
    alone = fs.sweep(circuit.replace({"Vdrive.frequency": 1000.0}), {"Xgap.d": law}, n=64, seed=3, **HOW)
    np.testing.assert_array_equal(alone.f_el_mean_periodic, found.f_el_mean_periodic[1])


def test_indices_are_those_of_the_ishigami_function(circuit: fs.Circuit, monkeypatch: pytest.MonkeyPatch) -> None:
    def function(x: np.ndarray) -> np.ndarray:
        return np.asarray(np.sin(x[0]) + 7.0 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0]))

    def ishigami(_circuit: fs.Circuit, scenes: Any, **_options: Any) -> xr.Dataset:
        value = function(np.array([scenes[path] for path in ("Xgap.d", "Xgap.r", "Xskin.d")]))
        status = np.zeros(value.size, np.int8)
        return xr.Dataset({"f_el_mean": ("scene", value), "status": ("scene", status)}, attrs={"failures": []})

    monkeypatch.setattr(populations, "batch", ishigami)
    law = stats.uniform(-np.pi, 2.0 * np.pi)
    found = fs.sobol(circuit, dict.fromkeys(("Xgap.d", "Xgap.r", "Xskin.d"), law), n=4096)
    # Ishigami and Homma 1990, a = 7, b = 0.1.
    first, total = [0.3139, 0.4424, 0.0], [0.5576, 0.4424, 0.2437]
    np.testing.assert_allclose(found.f_el_mean_first, first, atol=0.02)
    np.testing.assert_allclose(found.f_el_mean_total, total, atol=0.02)
    for kind, exact in (("first", first), ("total", total)):
        assert np.all(found[f"f_el_mean_{kind}_low"] <= np.array(exact) + 0.01)
        assert np.all(found[f"f_el_mean_{kind}_high"] >= np.array(exact) - 0.01)
    theirs = stats.sobol_indices(func=function, n=4096, dists=[law] * 3, rng=0)
    np.testing.assert_allclose(found.f_el_mean_first, theirs.first_order, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.f_el_mean_total, theirs.total_order, rtol=0, atol=1e-12)
    assert np.all(found.f_el_mean_first_low <= found.f_el_mean_first)
    assert np.all(found.f_el_mean_first_high >= found.f_el_mean_first)
    assert float(found.f_el_mean_mean) == pytest.approx(3.5, abs=0.05)
    rows = populations.ranking(found, "f_el_mean")
    assert [row["parameter"] for row in rows] == ["Xgap.d", "Xgap.r", "Xskin.d"]
    assert all(row["low"] <= row["total"] <= row["high"] for row in rows)


def test_one_parameter_alone_has_the_whole_variance(circuit: fs.Circuit) -> None:
    found = fs.sobol(circuit, {"Xgap.d": stats.lognorm(0.1, scale=3.5e-6)}, n=64, skin="follow", **HOW)
    for kind in ("first", "total"):
        np.testing.assert_allclose(found[f"f_el_mean_periodic_{kind}"], [1.0], atol=0.05)


def test_what_matters_to_the_force_is_named_at_every_place(circuit: fs.Circuit) -> None:
    asked = {
        "source.frequency": [100.0, 5000.0], "Xgap.d": stats.lognorm(0.1, scale=3.5e-6),
        "Xcoat.r": stats.lognorm(1e-3, scale=2e5),
    }  # fmt: skip
    found = fs.sobol(circuit, asked, n=64, skin="follow", **HOW)
    assert found.f_el_mean_periodic_total.dims == ("Vdrive.frequency", "parameter")
    # A resistance that hardly varies hardly matters.
    assert np.all(found.f_el_mean_periodic_total.sel(parameter="Xgap.d") > 0.95)
    assert np.all(found.f_el_mean_periodic_total.sel(parameter="Xcoat.r") < 0.05)
    rows = populations.ranking(found, "f_el_mean_periodic")
    assert [(row["place"]["Vdrive.frequency"], row["parameter"]) for row in rows] == [
        (100.0, "Xgap.d"), (100.0, "Xcoat.r"), (5000.0, "Xgap.d"), (5000.0, "Xcoat.r")
    ]  # fmt: skip
    # One parameter at a quantile and the other at its median is a scene like any other.
    place = {
        "Vdrive.frequency": 5000.0,
        "Xgap.d": float(found["at"].sel(parameter="Xgap.d", quantile=0.95)),
        "Xcoat.r": 2e5,
    }
    alone = fs.batch(circuit, place, skin="follow", **HOW).f_el_mean_periodic
    assert float(found.f_el_mean_periodic_alone.sel(parameter="Xgap.d", quantile=0.95)[1]) == float(alone[0])


def test_several_paths_are_scaled_together(circuit: fs.Circuit) -> None:
    both = fs.sweep(circuit, {"Xgap.alpha, xgap.beta": [0.8, 1.2], "Xgap.fn": 0.3}, **HOW)
    assert both.f_el_mean_periodic.dims == ("Xgap.alpha,Xgap.beta",)
    for i, factor in enumerate((0.8, 1.2)):
        scaled = {path: factor * circuit.parameters[path].value for path in ("Xgap.alpha", "Xgap.beta")}
        mean = fs.steady_state(circuit.replace({**scaled, "Xgap.fn": 0.3}), rtol=1e-6).solution.f_el_mean
        assert float(both.f_el_mean_periodic[i]) == pytest.approx(mean, rel=2e-4)
    with pytest.raises(fs.InputError, match=r"Xgap\.alpha is given twice"):
        fs.sweep(circuit, {"Xgap.alpha, Xgap.beta": [0.8], "Xgap.alpha": 54.4}, **HOW)


def test_the_shipped_sweep_of_fig_3_says_what_matters_where(tmp_path: Path, command: Command) -> None:
    done = command("sweep", str(CIRCUITS / "fig3.toml"), "--out", str(tmp_path), "--json")
    assert done.code == 0, done.err
    shares: dict[float, dict[str, float]] = {}
    for row in json.loads(done.out)["shares"]:
        shares.setdefault(row["place"]["Vdrive.frequency"], {})[row["parameter"]] = row["total"]
    slow, fast = shares[10.0], shares[10000.0]
    # Section 4 of the paper: the gap's thickness matters at all frequencies, its resistance at low ones, and the area
    # more than the skin's thickness.
    assert all(max(one, key=one.__getitem__) == "Xgap.d" for one in shares.values())
    assert slow["Xgap.r"] > 0.25
    assert fast["Xgap.r"] < 0.01
    assert all(one["Xgap.alpha,Xgap.beta"] > 3.0 * one["Xskin.d"] for one in shares.values())
    with xr.open_dataset(tmp_path / "fig3.nc", engine="h5netcdf") as kept:
        assert kept.f_el_mean_periodic.dims == ("Vdrive.frequency", "scene")


@pytest.mark.parametrize(
    ("parameters", "how", "said"),
    [
        ({"Xgap.dd": [1e-6]}, {}, "Xgap.d"),
        ({"Xgap.d": stats.norm(1e-6, 1e-6)}, {}, "in scene"),
        ({"Xgap.d": stats.lognorm(0.1, scale=3e-6)}, {"n": 1000}, "a power of two"),
        ({"Xgap.d": "narrow"}, {}, "frozen distribution"),
        ({"Xgap.d": [[1e-6]]}, {}, "numbers in one row"),
        ({}, {}, "a mapping"),
    ],
)
def test_bad_sweeps_are_refused_in_one_sentence(
    circuit: fs.Circuit, parameters: Any, how: dict[str, Any], said: str
) -> None:
    with pytest.raises(fs.InputError, match=said) as told:
        fs.sweep(circuit, parameters, **how)
    assert "\n" not in str(told.value)
    if not any(hasattr(value, "ppf") for value in parameters.values()):
        with pytest.raises(fs.InputError):
            fs.sobol(circuit, parameters, **how)


SMALL = """deck = "fingerpad.cir"
n = 32
outputs = ["f_el_mean_periodic"]
periodic = true
indices = true
[parameters]
"Xgap.d" = { lognormal = [3.5e-6, 0.1] }
"Xskin.d" = { uniform = [3e-4, 4e-4] }
"""


def described(folder: Path, text: str) -> str:
    """The file of a sweep beside its deck."""
    for name in ("fingerpad.cir", "fingerspice.lib"):
        (folder / name).write_bytes((CIRCUITS / name).read_bytes())
    (folder / "fingers.toml").write_text(text)
    return str(folder / "fingers.toml")


def test_the_command_writes_scenes_indices_and_a_picture(tmp_path: Path, command: Command) -> None:
    file = described(tmp_path, SMALL)
    done = command("sweep", file, "--out", str(tmp_path / "o"), "--json")
    answer = json.loads(done.out)
    assert done.code == 0, done.err
    assert (answer["scenes"], answer["failed"], answer["n"]) == (32, 0, 32)
    assert answer["figures"][0]["p5"] < answer["figures"][0]["median"] < answer["figures"][0]["p95"]
    assert answer["shares"][0]["parameter"] == "Xgap.d"
    with xr.open_dataset(tmp_path / "o" / "fingers.nc", engine="h5netcdf") as kept:
        assert kept.f_el_mean_periodic.shape == (32,)
        assert kept.f_el_mean_periodic_total.shape == (2,)
    assert (tmp_path / "o" / "fingers.png").stat().st_size > 10_000
    # Of the same deck: replaced without a question.
    assert command("sweep", file, "--out", str(tmp_path / "o"), "--no-plot").code == 0


@pytest.mark.parametrize(
    ("change", "said"),
    listed("sweep_files"),
)
def test_bad_files_are_refused_in_one_sentence(
    tmp_path: Path, command: Command, change: tuple[str, str], said: str
) -> None:
    done = command("sweep", described(tmp_path, SMALL.replace(*change)), "--out", str(tmp_path / "o"))
    assert done.code == 2
    assert said in done.err
    assert "Traceback" not in done.err
    assert not (tmp_path / "o").exists()
