"""Exported decks: ngspice 39 runs them without other files, and its voltages agree with this package's."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.netlist.files import LIBRARIES, library_text
from ngspice_tools import CIRCUITS, call_ngspice, run_ngspice
from scenes import deck, table1

LAWS = ["local", "mobile"]
SHIPPED = ["fingerpad", "fingerpad_5khz", "fingerpad_square", "fingerpad_square_5khz"]

NESTED = """\
A finger as a subcircuit, and a source in another
.param f0=100 skin=350u
.subckt finger in out area gap=9u
Xgap in inner area GAP d={gap} eps_r=1 r=1meg fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000
Xskin inner out area SKIN d={skin} f={f0}
.ends
.subckt drive out
Vac out mid SIN(0 {2*75} {f0})
Vdc mid 0 {10*5}
.ends
Xdrive plate drive
Xcoat plate top area LAYER d=1u eps_r=3.9 r={0.2*1meg}
Xf top 0 area finger gap={7u/2}
.tran 10u 30m uic
"""


def deviation(circuit: fs.Circuit, law: str | None = None) -> float:
    """Largest difference of the gap voltage over its peak, at ngspice's own times."""
    p, n = (name.replace(".", "_") for name in circuit.by_device("GAP")[0].node_names[:2])
    theirs = run_ngspice(fs.export_netlist(circuit, charge_law=law), signals=[f"v({p})-v({n})"], timeout=20.0)
    t, first = np.unique(np.minimum(theirs["time"], circuit.tran.stop), return_index=True)  # type: ignore[union-attr]
    # An ideal edge takes 1 ns there.
    edges = np.concatenate(
        [
            e.waveform.breakpoints(0.0, t[-1])
            for e in circuit.by_device("V")
            if e.waveform is not None and not isinstance(e.waveform, fs.Sine)
        ]
        + [np.zeros(1)]
    )
    away = np.abs(t[:, None] - edges[None, :]).min(axis=1) > 3e-9
    assert away.sum() > 900
    ours = fs.simulate(circuit, charge_law=law, t_eval=t[away], rtol=1e-9).u_gap
    assert ours is not None
    return float(np.abs(ours - theirs[f"v({p})-v({n})"][first][away]).max() / np.abs(ours).max())


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_deck_runs_in_ngspice_as_exported(name: str, law: str) -> None:
    # 1000 steps a period: about 1e-6 on sines; an edge of 1 ns in place of an ideal one costs more.
    assert deviation(fs.read_netlist(CIRCUITS / f"{name}.cir"), law) <= (5e-5 if "square" in name else 5e-6)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    "source",
    [
        "SQUARE(200 100)",
        "SQUARE(150 100 0.2)",
        "PULSE(0 100 1m 0 0 3m 8m)",
        "PULSE(20 100 1m 1m 1m 3m)",
        "PWL(0 0 1m 100 1m -100 4m 50)",
        "PWL(0 0 1m 100 4m -50)",
        "PWL(0 0 1m 100 4m -50 5m 0 r=0)",
        "EXP(0 100 1m 1m 10m 2m)",
        "SIN(50 100 100 5m 20 30)",
        "DC 100",
    ],
)
def test_every_source_runs_in_ngspice_as_exported(source: str, law: str) -> None:
    # Constant stretches are the hard part: ngspice's usual options stop there, or never end.
    assert deviation(table1(source, tran="10u 30m uic"), law) <= 5e-5


@pytest.mark.filterwarnings("ignore:Vdrive. the recording ends")
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("start", [0.0, -1.1e-3, 2.3e-3])
def test_a_recording_is_exported_as_its_own_points(start: float, law: str) -> None:
    values = 100.0 * np.sin(np.arange(200) * 0.7) * np.sin(np.arange(200) * 0.031)
    circuit = table1(tran="10u 30.02m uic").replace({"Vdrive": fs.Samples(values, 4000.0, start)})
    text = re.search(r"^Vdrive .*?PWL\((.*?)\)", fs.export_netlist(circuit).replace("\n+", ""), re.MULTILINE)
    assert text is not None
    t, v = np.array(text[1].split(), float).reshape(-1, 2).T
    # To the first point after the end.
    at = start + np.arange(200) / 4000.0
    inside = (at > 1e-12) & (at < 0.03002 + 1.0 / 4000.0)
    np.testing.assert_array_equal(t[-inside.sum() :], at[inside])
    np.testing.assert_array_equal(v[-inside.sum() :], values[inside])
    assert deviation(circuit, law) <= 5e-5


@pytest.mark.parametrize("name", ["click", "burst", "am_bump"])
def test_decks_of_the_gallery_run_in_ngspice_as_exported(name: str) -> None:
    circuit = fs.read_netlist(CIRCUITS / f"{name}.cir")
    if name != "click":
        circuit = dataclasses.replace(circuit, tran=fs.read_netlist(CIRCUITS / "fingerpad_5khz.cir").tran)
    assert deviation(circuit) <= 5e-5


@pytest.mark.parametrize("law", LAWS)
def test_a_start_from_the_operating_point_is_the_same_there(law: str) -> None:
    assert deviation(table1("PULSE(20 100 1m 1u 1u 5m 20m)", tran="10u 30m"), law) <= 5e-5


@pytest.mark.parametrize("law", LAWS)
def test_the_other_reading_of_eq_7_is_exported(law: str) -> None:
    circuit = table1(extra=".options work=total")
    assert deviation(circuit, law) <= 5e-6
    text = fs.export_netlist(circuit)
    ratio = float(re.search(r"^Xgap .*wk=(\S+)", text.replace("\n+", ""), re.MULTILINE)[1])  # type: ignore[index]
    assert ratio != 1.0


def test_subcircuits_are_flat_and_parameters_are_folded_in() -> None:
    circuit = fs.parse_netlist(NESTED)
    text = fs.export_netlist(circuit)
    own = text[: text.index("fingerspice.lib")]
    assert "{" not in own
    assert ".param" not in own
    assert ".subckt" not in own
    assert re.search(r"^VXdrive_Vac plate Xdrive_mid SIN\(0\.0 150\.0 100\.0 ", own, re.MULTILINE)
    assert re.search(r"^Xf_Xgap top Xf_inner area GAP d=3\.5e-06 ", own, re.MULTILINE)
    assert deviation(circuit) <= 5e-6


def test_a_changed_circuit_is_exported_as_changed() -> None:
    circuit = table1(tran="10u 20m uic").replace(
        {"Xgap.d": 5e-6, "Vdrive": fs.Chirp(100.0, 50.0, 400.0, 0.02), "Xcoat.r": float("inf")}
    )
    text = fs.export_netlist(circuit)
    assert "* Changed from the deck: Xgap.d = 5e-06, Vdrive = Chirp(" in text
    assert re.search(r"^Xgap .* d=5e-06 ", text, re.MULTILINE)
    assert re.search(r"^Xcoat .* r=1e30$", text, re.MULTILINE)
    assert deviation(circuit) <= 5e-5


def test_a_deck_without_gap_runs_in_ngspice_as_exported() -> None:
    circuit = deck(
        "V1 a 0 SIN(0 10 100)",
        "X1 a b area LAYER d=1u eps_r=2 r=1meg",
        "X2 b 0 area SLAB d=2u eps_r=3 rho=1e9",
        "Varea area 0 35",
        ".tran 10u 20m uic",
    )
    theirs = run_ngspice(fs.export_netlist(circuit), signals=["v(b)"], timeout=20.0)
    t, first = np.unique(np.minimum(theirs["time"], 0.02), return_index=True)
    ours = fs.simulate(circuit, t_eval=t).node_voltages["b"]
    assert np.abs(ours - theirs["v(b)"][first])[t > 0.0].max() <= 5e-6 * np.abs(ours).max()


@pytest.mark.parametrize("law", LAWS)
def test_the_exported_deck_needs_no_other_file(law: str, tmp_path: Path) -> None:
    circuit = table1(tran="100u 10m uic")
    text = fs.export_netlist(circuit, charge_law=law)
    assert not re.search(r"^\s*\.(include|inc|lib)\b", text, re.MULTILINE | re.IGNORECASE)
    assert library_text(law).strip() in text
    assert library_text("local") != library_text("mobile")
    (tmp_path / "alone.cir").write_text(text)
    done = call_ngspice(tmp_path, "-r", "out.raw", "alone.cir", timeout=20.0)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "out.raw").stat().st_size > 1000


def test_the_charge_law_is_the_decks_own_unless_told() -> None:
    mobile = table1(library="fingerspice_mobile.lib")
    assert library_text("mobile").strip() in fs.export_netlist(mobile)
    assert library_text("local").strip() in fs.export_netlist(mobile, charge_law="local")
    assert library_text("local").strip() in fs.export_netlist(table1())
    with pytest.raises(fs.InputError, match=r"charge_law is 'moble'; allowed: 'local' or 'mobile'"):
        fs.export_netlist(mobile, charge_law="moble")


def test_the_packages_libraries_are_those_beside_the_decks() -> None:
    for law, name in LIBRARIES.items():
        assert library_text(law) == (CIRCUITS / name).read_text()


def test_analyses_and_start_values_go_along() -> None:
    circuit = table1(tran="10u 20m 5m 2u", extra=".ac dec 10 1 100k\n.ic v(top)=3 v(skin)=1")
    text = fs.export_netlist(circuit)
    assert ".tran 1e-05 0.02 0.005 2e-06\n" in text
    assert ".ac dec 10 1.0 100000.0\n" in text
    assert ".ic v(top)=3.0\n" in text
    assert ".ic v(skin)=1.0\n" in text
    assert re.search(r"^\.nodeset v\(area\)=34\.97", text, re.MULTILINE)


def test_points_of_a_source_need_a_tran_line_and_a_bound() -> None:
    lines = [line for line in table1("SQUARE(200 100)").text.splitlines() if not line.startswith(".tran")]
    with pytest.raises(fs.InputError, match=r"Vdrive: exporting this source as PWL needs a \.tran line"):
        fs.export_netlist(fs.parse_netlist("\n".join(lines)))
    endless = table1("SQUARE(200 100meg)", f=100e3, tran="1u 1 uic")
    with pytest.raises(fs.InputError, match=r"Vdrive: the source would take \d+ PWL points; allowed: at most 2000000"):
        fs.export_netlist(endless)


def test_names_that_would_become_one_are_refused() -> None:
    text = NESTED.replace("plate", "Xf_inner")
    with pytest.raises(fs.InputError, match=r"Xf\.inner and Xf_inner would be one name in the export"):
        fs.export_netlist(fs.parse_netlist(text))
