"""Raw files: written and read back, by ngspice too; those of ngspice and LTspice; and runs compared with them."""

import json
import os
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from ngspice_tools import call_ngspice
from scenes import refuses, table1

VARIABLES = {"time": "time", "V(top)": "voltage", "I(R1)": "device_current"}


def ltspice(flags: str = "real forward", runs: int = 1, **head: str) -> bytes:
    """A raw file as LTspice writes it: a header in UTF-16, times in double and all else in single precision."""
    t = np.tile([0.0, -1e-3, 2e-3, 3e-3], runs)
    n = t.size
    double = "double" in flags
    row = np.dtype([("t", "<f8"), ("v", "<f8" if double else "<f4"), ("i", "<f8" if double else "<f4")])
    rows = np.zeros(n, row)
    rows["t"], rows["v"], rows["i"] = t, np.arange(n), -0.5 * np.arange(n)
    about = {"Title": "* C:\\draft.asc", "Date": "Mon", "Plotname": "Transient Analysis", "Flags": flags,
             "No. Variables": "3", "No. Points": f"{n:12d}", "Offset": "0.0", **head}  # fmt: skip
    lines = [*(f"{key}: {value}" for key, value in about.items()), "Variables:"]
    lines += [f"\t{k}\t{name}\t{kind}" for k, (name, kind) in enumerate(VARIABLES.items())]
    return ("\n".join([*lines, "Binary:"]) + "\n").encode("utf-16-le") + rows.tobytes()


def test_a_run_is_read_back_to_the_bit_and_ngspice_loads_it(tmp_path: Path) -> None:
    run = fs.simulate(table1())
    assert run.to_raw(tmp_path / "run.raw") == tmp_path / "run.raw"
    raw = fs.read_raw(tmp_path / "run.raw")
    np.testing.assert_array_equal(raw.vectors["time"], run.t)
    np.testing.assert_array_equal(raw.vectors["v(top)"], run.node_voltages["top"])
    np.testing.assert_array_equal(raw.vectors["@xgap[f_el]"], run.f_el)
    np.testing.assert_array_equal(raw.vectors["i(vdrive)"], -np.asarray(run.i_source))
    assert (raw.kinds["time"], raw.kinds["v(top)"], raw.kinds["@xgap[area]"]) == ("time", "voltage", "notype")
    loads = "load\n.control\nload run.raw\nprint v(top)[100] @xgap[f_el][100] length(time)\nquit 0\n.endc\n.end\n"
    (tmp_path / "load.cir").write_text(loads)
    said = call_ngspice(tmp_path, "load.cir", timeout=60.0).stdout
    assert f"v(top)[100] = {run.node_voltages['top'][100]:.6e}" in said
    assert f"@xgap[f_el][100] = {run.f_el[100]:.6e}" in said
    loaded = fs.read_raw(run.to_raw(tmp_path / "again.raw"))
    assert "fingerspice" not in str(loaded)
    assert "10001 points" in str(loaded).replace(",", "") or "points, 1 runs" in str(loaded)


def test_save_chooses_the_columns_of_tables_and_raw_files(tmp_path: Path) -> None:
    first = ".save all V(top) @xgap[f_el] v(top, skin)\n.print tran i(Vdrive) V(area)\n.print ac v(top)"
    lines = f"{first}\n.probe par('v(top)*2') V(nix)"
    with pytest.warns(fs.FingerspiceWarning, match=r"no node 'nix'.*; it is left out of the files"):
        circuit = fs.parse_netlist(table1().text.replace(".end", f"{lines}\n.end"))
    run = fs.simulate(circuit, rtol=1e-4)
    head, *rows = run.to_csv(tmp_path / "run.csv").read_text().splitlines()
    assert head == ("t [s],V(top) [V],@xgap[f_el] [N],\"v(top, skin) [V]\",i(Vdrive) [A],V(area) [mm^2],'v(top)*2' [1]")
    values = np.loadtxt(rows, delimiter=",")
    expected = [run.t, run.node_voltages["top"], run.f_el, run.u_gap, -np.asarray(run.i_source), 1e6 * run.area]
    np.testing.assert_allclose(values[:, :6], np.column_stack(expected), rtol=1e-12, atol=1e-12)
    raw = fs.read_raw(run.to_raw(tmp_path / "run.raw"))
    assert list(raw.vectors) == ["time", "v(top)", "@xgap[f_el]", "v(top,skin)", "i(vdrive)", "v(area)", "'v(top)*2'"]
    np.testing.assert_array_equal(raw.vectors["'v(top)*2'"], 2.0 * run.node_voltages["top"])


def test_json_has_figures_of_what_is_saved_and_a_loaded_run_has_tables(
    tmp_path: Path, command: Callable[..., Any]
) -> None:
    """Over whole periods of a sine: its amplitude, its mean of 0, and its amplitude over the root of 2."""
    body = "V1 a 0 SIN(0.5 2 1k)\nR1 a b 1k\nR2 b 0 1k\nXgap a 0 area GAP a_fix=35\n.tran 10u 5m uic\n"
    save = ".save V(b) I(R1) V(area)\n.probe {2*V(a,b)} @Xgap[a_real]\n"
    (tmp_path / "saved.cir").write_text(f"saved\n{body}{save}.end\n")
    words = "run", str(tmp_path / "saved.cir"), "--no-plot", "--out", str(tmp_path), "--json"
    rows = json.loads(command(*words).out)["saved"]
    units = {"V(b)": "V", "I(R1)": "A", "V(area)": "mm^2", "{2*V(a,b)}": "1", "@Xgap[a_real]": "m^2"}
    assert {row["vector"]: row["unit"] for row in rows} == units
    for row, scale in zip(rows, (1.0, 1e-3, None, 2.0), strict=False):
        expected = [scale * x for x in (-0.75, 1.25, 0.25, np.hypot(0.25, np.sqrt(0.5)))] if scale else [35.0] * 4
        assert [row[key] for key in ("min", "max", "mean", "rms")] == pytest.approx(expected, rel=1e-7), row
    # Without a p_sat there is no real area.
    assert rows[-1]["max"] is None
    table = fs.load(tmp_path / "saved.nc").to_csv(tmp_path / "again.csv").read_text()
    assert table.startswith("t [s],u_source [V],")
    (tmp_path / "plain.cir").write_text(f"plain\n{body}.end\n")
    assert json.loads(command(*words[:1], str(tmp_path / "plain.cir"), *words[2:]).out)["saved"] == []


def test_ngspices_files_are_read_binary_and_ascii_and_compared(tmp_path: Path, command: Callable[..., Any]) -> None:
    circuit = table1(tran="10u 20m 0 1u uic")
    (tmp_path / "deck.cir").write_text(fs.export_netlist(circuit))
    for name, ascii_file in (("binary.raw", "0"), ("text.raw", "1")):
        subprocess.run(
            ["ngspice", "-b", "-r", name, "deck.cir"], cwd=tmp_path, capture_output=True, check=False, timeout=120,
            env=os.environ | {"SPICE_ASCIIRAWFILE": ascii_file},
        )  # fmt: skip
    binary, text = (fs.read_raw(tmp_path / name) for name in ("binary.raw", "text.raw"))
    assert binary.plotname == "Transient Analysis"
    for name, values in binary.vectors.items():
        np.testing.assert_allclose(text.vectors[name], values, rtol=1e-14, atol=1e-300)
    compared = fs.compare_raw(circuit, tmp_path / "binary.raw")
    assert {"v(drive)", "v(top)", "v(skin)", "v(area)", "i(vdrive)"} <= set(compared.vectors)
    assert max(compared.differences.values()) < 1e-4
    ours, theirs = compared.vectors["v(area)"]
    np.testing.assert_allclose(ours, 1e6 * compared.solution.area, rtol=0)
    assert compared.differences["v(area)"] == pytest.approx(np.abs(ours - theirs).max() / ours.max())
    labels = [ax.get_ylabel() for ax in compared.plot().axes]
    assert "v(area) [mm²]" in labels
    (tmp_path / "pad.cir").write_text(circuit.text)
    words = "compare", str(tmp_path / "pad.cir"), "--with", str(tmp_path / "binary.raw"), "--out", str(tmp_path / "o")
    done = command(*words, "--json")
    assert json.loads(done.out)["vectors"]["v(top)"] < 1e-5
    assert (tmp_path / "o" / "pad_compare.png").stat().st_size > 10_000
    assert command("run", str(tmp_path / "pad.cir"), "--raw", "--no-plot", "--out", str(tmp_path / "o")).code == 0
    assert fs.read_raw(tmp_path / "o" / "pad.raw").vectors["v(top)"].size > 2000


@pytest.mark.parametrize("flags", ["real forward", "real forward double", "real forward stepped"])
def test_ltspices_files_are_read(tmp_path: Path, flags: str) -> None:
    runs = 3 if "stepped" in flags else 1
    # Some programs put the mark of UTF-16 before it.
    (tmp_path / "lt.raw").write_bytes((b"\xff\xfe" if "double" in flags else b"") + ltspice(flags, runs))
    raw = fs.read_raw(tmp_path / "lt.raw")
    # A time with a minus is that of a point beside which others were left out.
    np.testing.assert_array_equal(raw.vectors["time"][:4], [0.0, 1e-3, 2e-3, 3e-3])
    np.testing.assert_array_equal(raw.vectors["v(top)"], np.arange(4.0 * runs))
    np.testing.assert_array_equal(raw.vectors["i(r1)"], -0.5 * np.arange(4.0 * runs))
    assert [one.stop - one.start for one in raw.steps] == [4] * runs


def test_several_plots_and_complex_vectors_are_read(tmp_path: Path) -> None:
    head = "Title: t\nDate: d\nPlotname: AC Analysis\nFlags: complex\nNo. Variables: 2\nNo. Points: 2\n"
    head += "Variables:\n\t0\tfrequency\tfrequency\n\t1\tv(a)\tvoltage\nBinary:\n"
    z = np.array([[10.0, 1.0 + 2.0j], [100.0, 3.0 - 4.0j]], "<c16")
    rows = ["".join(f"{k}\t{f.real},0\n\t{v.real},{v.imag}\n" for k, (f, v) in enumerate(x)) for x in (z, z.conj())]
    words = head.replace("Binary", "Values")
    (tmp_path / "text.raw").write_text(f"{words}{rows[0]}\n{words}{rows[1]}")
    for code in ("utf-16-le", "utf-8"):
        (tmp_path / "two.raw").write_bytes(b"".join(head.encode(code) + x.tobytes() for x in (z, z.conj())))
        for name, plot in ((name, plot) for name in ("two.raw", "text.raw") for plot in (0, 1)):
            found = fs.read_raw(tmp_path / name, plot=plot)
            np.testing.assert_array_equal(found.vectors["v(a)"], z[:, 1].conj() if plot else z[:, 1])
    refuses("has 2 plots; allowed: plot up to 1", fs.read_raw, tmp_path / "two.raw", plot=2)
    refuses("is AC Analysis, no run in time", fs.compare_raw, table1(), tmp_path / "two.raw")


WRONG: dict[str, tuple[bytes, str]] = {
    "cut short": (ltspice()[:-9], "is cut short: 4 points of 3 variables are 64 bytes, and 55 are there"),
    "no end of header": (ltspice()[:200], "ends within the header of a plot"),
    "a table": (b"t,v\n0,1\n", "is no raw file: it begins with 't,v'"),
    "points": (ltspice(**{"No. Points": "many"}), "has 'no. points' 'many'; allowed: a whole number"),
    "fast access": (ltspice("real fastaccess"), "has fast access"),
    "text cut short": (
        b"Title: t\nFlags: real\nNo. Variables: 1\nNo. Points: 2\nVariables:\n\t0\ttime\ttime\nValues:\n 0\t1.0\n",
        "is cut short: 2 of 4 values",
    ),
    "other circuit": (
        ltspice().replace("V(top)".encode("utf-16-le"), "V(tip)".encode("utf-16-le")), "has the vectors time, v"
    ),
}  # fmt: skip


@pytest.mark.parametrize(("content", "said"), WRONG.values(), ids=WRONG)
def test_wrong_files_are_refused_in_one_sentence(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "wrong.raw").write_bytes(content)
    refuses(said, fs.compare_raw, table1(), tmp_path / "wrong.raw")
    refuses("does not exist", fs.read_raw, tmp_path / "none.raw")


def test_a_run_with_jumps_equals_its_own_raw_file(tmp_path: Path) -> None:
    circuit = table1("PULSE(0 100 1m 0 0 1m 4m)", tran="50u 8m uic")
    run = fs.simulate(circuit)
    assert np.any(np.diff(run.t) == 0.0)
    compared = fs.compare_raw(circuit, run.to_raw(tmp_path / "jumps.raw"))
    assert {"v(drive)", "v(top)", "v(area)", "i(vdrive)"} <= set(compared.vectors)
    assert max(compared.differences.values()) < 1e-7
    # Of several runs the first is compared.
    several = {name: np.append(x, 2.0 * x) for name, x in compared.raw.vectors.items()}
    again = fs.compare_raw(circuit, replace(compared.raw, vectors=several))
    assert again.differences == compared.differences
    v = compared.vectors["v(top)"][0]
    assert "8 ms" in str(replace(compared, vectors={"v(top)": (v, v + 1e3 * (compared.solution.t == 8e-3))}))


@pytest.mark.parametrize(("plot", "said"), [(-1, "plot"), ("a", "plot"), (1, "has 1 plots; allowed: plot up to 0")])
def test_wrong_plots_and_empty_files_are_refused(tmp_path: Path, plot: Any, said: str) -> None:
    (tmp_path / "lt.raw").write_bytes(ltspice())
    refuses(said, fs.read_raw, tmp_path / "lt.raw", plot)
    (tmp_path / "empty.raw").write_bytes(b"")
    refuses("is empty", fs.read_raw, tmp_path / "empty.raw")
