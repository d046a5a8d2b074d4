"""Fits of a contact find true values again, cover them with their intervals, and say what the data cannot tell."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from commands import Command
from scenes import CIRCUITS, cases, covers, deck, listed, refuses, shipped, warns

TRUE = {"alpha": 48.0, "m_exp": 0.45, "beta": 40.0, "n_exp": 1.6, "mu": 0.35, "c2": 4000.0}
FN = np.geomspace(0.1, 2.0, 10)
DEPTH = np.linspace(0.3, 1.2, 8)
EPS0 = 8.854e-12

Columns = dict[str, np.ndarray]


def resting(fn: np.ndarray) -> np.ndarray:
    """Eq. 5, mm^2."""
    return TRUE["alpha"] * fn ** TRUE["m_exp"]


def finger(rng: np.random.Generator | None = None, noise: float = 0.0) -> list[Columns]:
    """Measurements of a known finger, from Eqs. 1, 3, 5 and 6 without voltage."""

    def off(x: np.ndarray) -> np.ndarray:
        return x if rng is None else x * np.exp(noise * rng.standard_normal(x.size))

    friction = TRUE["mu"] * FN
    sliding = resting(FN) - TRUE["c2"] * friction**2 / resting(FN)
    return [
        {"fn": FN, "area": 1e-6 * off(resting(FN))},
        {"indentation": 1e-3 * DEPTH, "area": 1e-6 * off(TRUE["beta"] * DEPTH ** TRUE["n_exp"])},
        {"fn": FN, "area_sliding": 1e-6 * off(sliding), "f_t": off(friction)},
    ]


def adhesive_area(fn: float, u: float) -> float:
    """Eq. 4 with the gap of Table 1, solved for the area (mm^2) by bisection."""
    alpha, m, beta, n = (TRUE[name] for name in ("alpha", "m_exp", "beta", "n_exp"))
    # In N and mm: a work of 1 J/m^2 is 1e-3 N/mm.
    work = 1e-3 * 0.5 * EPS0 * u**2 / 3.5e-6

    def load(area: float) -> float:
        root = 2.0 * work * n**2 / (n - m) * beta ** (1.0 / n) * alpha ** (-1.0 / m)
        return (area / alpha) ** (1.0 / m) - math.sqrt(root * area ** (1.0 + 1.0 / m - 1.0 / n))

    low, high = alpha * fn**m, 100.0 * alpha * fn**m
    for _ in range(200):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if load(middle) < fn else (low, middle)
    return low


def under_voltage() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Loads (N), gap voltages (V) and areas (mm^2) of Eq. 4."""
    fn, u = (x.ravel() for x in np.meshgrid([0.25, 0.5, 1.0], [0.0, 60.0, 120.0, 200.0]))
    return fn, u, np.array([adhesive_area(*pair) for pair in zip(fn, u, strict=True)])


def test_true_values_are_found_again_from_four_relations(circuit: fs.Circuit) -> None:
    found = fs.fit_contact(circuit, finger())
    for name, value in TRUE.items():
        assert found.values[f"Xgap.{name}"] == pytest.approx(value, rel=1e-8)
        assert found.circuit.parameters[f"Xgap.{name}"].value == found.values[f"Xgap.{name}"]
    assert max(found.misfits) < 1e-9
    assert found.notes == ()
    again = circuit.replace(found.values)
    assert fs.simulate(again).f_el_mean == fs.simulate(found.circuit).f_el_mean
    # The line stands in a deck as it is.
    text = (CIRCUITS / "fingerpad.cir").read_text(encoding="utf-8").replace(".include fingerspice.lib", "")
    before, own, after = text.partition("mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000")
    assert own
    read = fs.parse_netlist(f"{before}{found.line}{after}")
    assert read["Xgap"].values["c2"] == pytest.approx(4000.0)


def test_areas_under_voltage_tell_beta_where_n_is_known(circuit: fs.Circuit) -> None:
    fn, u, area = under_voltage()
    assert area.max() > 1.04 * resting(fn).max()
    start = circuit.replace({"Xgap.n_exp": TRUE["n_exp"]})
    found = fs.fit_contact(start, {"fn": fn, "u_gap": u, "area": 1e-6 * area}, ["alpha", "m_exp", "beta"])
    for name in ("alpha", "m_exp", "beta"):
        assert found.values[f"Xgap.{name}"] == pytest.approx(TRUE[name], rel=1e-5)
    # Eq. 1 with these areas, where friction takes none of them.
    stress = 0.5 * EPS0 * u**2 / 3.5e-6**2
    force = 0.7 * (fn + stress * 1e-6 * area)
    held = {f"Xgap.{name}": TRUE[name] for name in ("alpha", "m_exp", "beta", "n_exp")} | {"Xgap.c2": 0.0}
    slid = fs.fit_contact(circuit.replace(held), {"fn": fn, "u_gap": u, "f_t": force})
    assert slid.values == {"Xgap.mu": pytest.approx(0.7, rel=1e-6)}


def test_a_power_law_has_the_intervals_of_linear_regression(circuit: fs.Circuit) -> None:
    # log A = log alpha + m log F is linear: textbook intervals with Student's t of n - 2 degrees of freedom.
    from scipy.stats import t

    data = finger(np.random.default_rng(1), 0.05)[0]
    found = fs.fit_contact(circuit, data)
    x = np.log(FN)
    design = np.column_stack([np.ones(x.size), x])
    best, square, *_ = np.linalg.lstsq(design, np.log(1e6 * data["area"]), rcond=None)
    error = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * square[0] / (x.size - 2))
    alpha, m = found.estimates["Xgap.alpha"], found.estimates["Xgap.m_exp"]
    assert alpha.value == pytest.approx(math.exp(best[0]), rel=1e-6)
    assert m.value == pytest.approx(best[1], rel=1e-6)
    assert alpha.error / alpha.value == pytest.approx(error[0], rel=1e-3)
    assert m.error == pytest.approx(error[1], rel=1e-3)
    assert math.log(alpha.high / alpha.value) == pytest.approx(t.ppf(0.975, x.size - 2) * error[0], rel=1e-3)


def test_intervals_cover_the_truth_though_every_relation_has_its_own_noise(circuit: fs.Circuit) -> None:
    rng, hits, count = np.random.default_rng(4), 0, cases(40, 2)
    for _ in range(count):
        parts = finger(rng, 0.03)
        parts[1]["area"] = parts[1]["area"] * np.exp(0.1 * rng.standard_normal(DEPTH.size))
        found = fs.fit_contact(circuit, parts)
        hits += sum(e.low <= TRUE[path.rpartition(".")[2]] <= e.high for path, e in found.estimates.items())
    assert covers(hits, 6 * count)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"fn": [0.5] * 4, "area": [35e-6, 36e-6, 34e-6, 35.5e-6]},
         "Xgap.alpha and Xgap.m_exp are not told apart .* Measure the area at a second load"),
        ({"fn": [0.5, 1.0], "area": [35e-6, 50e-6]}, "hardly more values .2. than parameters, which leaves no measure"),
        ({"fn": FN, "area": 1e-6 * resting(FN), "area_sliding": 0.8e-6 * resting(FN)},
         "c2 holds for the circuit's mu = 0.3: .* Measure the friction force"),
        ({"fn": FN, "area": 1e-6 * resting(FN) * (1.0 + 0.1 * (-1.0) ** np.arange(FN.size)), "sigma": 1e-8},
         "residuals of the ridge area at rest are .* times as large as sigma"),
    ],
)  # fmt: skip
def test_what_the_data_cannot_tell_is_said(circuit: fs.Circuit, data: Columns, said: str) -> None:
    notes = fs.fit_contact(circuit, data).notes
    assert any(re.search(said, note) for note in notes), notes


# Values of which nothing is known may be unusual.
@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
def test_areas_under_voltage_alone_do_not_tell_beta_from_n(circuit: fs.Circuit) -> None:
    fn, u, area = under_voltage()
    for seed in range(cases(20, 1)):
        noisy = 1e-6 * area * np.exp(0.02 * np.random.default_rng(seed).standard_normal(area.size))
        notes = " ".join(fs.fit_contact(circuit, {"fn": fn, "u_gap": u, "area": noisy}).notes)
        assert "Xgap.beta" in notes
        assert "Measure the area against the indentation as well, or fix one of them" in notes


def test_a_wrong_unit_is_warned_about(circuit: fs.Circuit) -> None:
    rough = np.exp(0.5 * np.random.default_rng(0).standard_normal(FN.size))
    for area, said in (
        (resting(FN), "Xgap alpha is 4.8e.07 mm.2/N.m, outside .*the usual range"),
        (1e-6 * resting(FN) * rough, "the ridge area at rest misses the data by .* % rms"),
    ):
        warns(said, fs.fit_contact, circuit, {"fn": FN, "area": area})
    with (
        pytest.warns(fs.FingerspiceWarning, match="the data's largest fn is 2 kN, .*it is in newton, not millinewton"),
        pytest.raises(fs.InputError, match="fitted values do not go with the circuit's others: Xgap has no contact"),
    ):
        fs.fit_contact(circuit, {"fn": 1e3 * FN, "area": 1e-6 * resting(FN)})


def test_report_page_picture_and_profile_go_with_the_intervals(circuit: fs.Circuit) -> None:
    found = fs.fit_contact(circuit, finger(np.random.default_rng(2), 0.02), profiles=["alpha"])
    profile, estimate = found.profiles["Xgap.alpha"], found.estimates["Xgap.alpha"]
    assert profile.shape == "symmetric"
    assert (profile.low, profile.high) == pytest.approx((estimate.low, estimate.high), rel=1e-3)
    report, page = found.report(), str(found)
    assert "# data points      = 38" in report
    assert all(f"    Xgap.{name}:" in report and f"\nXgap.{name} " in page for name in TRUE)
    assert "ridge area while sliding: 10 values, residual" in page
    labels = [axis.get_ylabel() for axis in found.plot().axes[:2]]
    assert labels == ["ridge area at rest [mm²]", "ridge area by indentation [mm²]"]


def test_the_command_reads_the_tables_of_the_examples(command: Command, tmp_path: Path) -> None:
    contact, indentation, pad = (str(CIRCUITS / name) for name in ("contact.csv", "indentation.csv", "fingerpad.cir"))
    answer = command("fit-contact", contact, indentation, pad, "--out", str(tmp_path), "--json").ok().json
    rows = {row["path"]: row for row in answer["parameters"]}
    assert answer["gap"] == "Xgap"
    assert {one["kind"]: one["count"] for one in answer["relations"]} == {
        "area": 8, "area_sliding": 8, "f_t": 8, "indentation": 7
    }  # fmt: skip
    for name, value in TRUE.items():
        assert rows[f"Xgap.{name}"]["low"] < value < rows[f"Xgap.{name}"]["high"]
    assert {"fingerpad_contact.csv", "fingerpad_contact.png"} <= {p.name for p in tmp_path.iterdir()}
    lines = (tmp_path / "fingerpad_contact.csv").read_text().splitlines()
    assert lines[0] == "relation,fn,u_gap,indentation,measured,fitted,sigma"
    assert len(lines) == 32
    options = ("--free", "mu", "--no-plot", "--json", "--overwrite", "--out", str(tmp_path))
    some = command("fit-contact", contact, pad, *options)
    assert [row["path"] for row in json.loads(some.out)["parameters"]] == ["Xgap.mu"]


AREAS = {"fn": [1.0, 2.0], "area": [3e-5, 4e-5]}


@pytest.mark.parametrize(("data", "options", "said"), listed("contact_fits"))
def test_bad_requests(circuit: fs.Circuit, tmp_path: Path, data: object, options: dict[str, object], said: str) -> None:
    if isinstance(data, str):
        (tmp_path / "a.csv").write_text(data)
        data = tmp_path / "a.csv"
    refuses(said, fs.fit_contact, circuit, data, **options)


def test_circuits_without_one_contact_are_refused(circuit: fs.Circuit) -> None:
    two, data = shipped("two_fingers"), {"fn": FN, "area": 1e-6 * resting(FN)}
    for other, said in (
        (two, "several GAPs; allowed: finger= one of"),
        (circuit.replace({"Xgap.a_fix": 30.0}), r"Xgap.a_fix is 30 mm\^2; allowed: 0"),
        (deck("V1 a 0 1", "R1 a b 1k", "C1 b 0 1u", ".tran 1u 1m"), "this circuit has no GAP"),
    ):
        refuses(said, fs.fit_contact, other, data)
    other_gap, name = (gap.name for gap in two.by_device("GAP"))
    with pytest.raises(fs.InputError, match=f"parameters is '{other_gap.lower()}.alpha'; allowed: alpha, "):
        fs.fit_contact(two, data, [f"{other_gap}.alpha"], finger=name)
    assert fs.fit_contact(two, data, finger=name).values[f"{name}.alpha"] == pytest.approx(48.0, rel=1e-6)


def test_tables_are_read_in_their_units(circuit: fs.Circuit, tmp_path: Path) -> None:
    table = tmp_path / "a.csv"
    table.write_text("fn (mN),area (mm^2),area_sigma (mm^2)\n100,20,1\n1000,40,2\n2000,50,2\n")
    found = fs.fit_contact(circuit, table)
    assert found.relations[0].fn == pytest.approx([0.1, 1.0, 2.0])
    assert found.relations[0].sigma == pytest.approx([1e-6, 2e-6, 2e-6])
    # The prefix of a unit of area is squared with it.
    table.write_text("fn (N),area (um^2)\n0.1,2e7\n1,4e7\n2,5e7\n")
    assert fs.fit_contact(circuit, table).relations[0].values == pytest.approx([2e-5, 4e-5, 5e-5])


def test_the_warning_about_a_start_outside_its_bounds_names_the_callers_line(circuit: fs.Circuit) -> None:
    with pytest.warns(fs.FingerspiceWarning, match=r"Xgap\.mu is 0\.3, outside .* it starts at 0\.32") as told:
        fs.fit_contact(circuit, {"fn": FN, "f_t": TRUE["mu"] * FN}, ["mu"], bounds={"mu": (0.32, 0.4)})
    assert told[0].filename == __file__
