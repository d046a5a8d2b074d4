"""The map of the mobile law's fold, and the map of the friction that a screen can produce."""

import cmath
import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from commands import Command
from fingerspice.studies import limits
from fingerspice.studies.limits import fold_voltage
from scenes import CIRCUITS, cases, deck, refuses, shipped, table1, table1_deck


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
        refuses(said, fs.fold_limits, circuit, points=points)


def test_the_command_writes_a_table_a_picture_and_json(command: Command) -> None:
    Path("pad.cir").write_text(table1_deck(tran="10u 5m uic", gap={"d": "300n"}))
    report = command("limits", "pad.cir", "--points", "3", "--span", "2", "--out", "maps", "--json").ok().json
    assert report["sweeps"][0]["unit"] == "N"
    assert math.isfinite(report["voltage"])
    assert Path("maps/pad_limits.png").read_bytes().startswith(b"\x89PNG")
    rows = Path("maps/pad_limits.csv").read_text().splitlines()
    assert rows[0] == "parameter,value [SI],unit,fold [V]"
    assert len(rows) == 1 + 9


pytestmark = pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")


def test_the_largest_mean_is_that_of_the_limit_held_and_a_larger_amplitude_is_not_reached() -> None:
    found = fs.capability(table1(), 150.0, frequency=[60.0], means=5)
    run = fs.simulate(table1(), sources=fs.DC(150.0), t_stop=0.05, start="uncharged")
    assert found.smallest_mean == 0.15
    assert found.largest_mean == pytest.approx(0.3 * (0.5 + float(run.f_el[-1])), rel=2e-3)
    mean, largest = float(found.mean[3]), float(found.amplitude[3, 0])
    assert 1.01 * largest < mean - found.smallest_mean
    for factor, held in ((0.998, False), (1.01, True)):
        wanted = fs.Sum((fs.DC(mean), fs.Sine(factor * largest, 60.0)))
        drive = fs.inverse_drive(table1(), friction=wanted, duration=0.05, rate=8000.0, limit=150.0)
        assert (drive.at_limit > 0.0) is held


def test_more_voltage_makes_more() -> None:
    low, high = (fs.capability(table1(), v, frequency=[20.0, 200.0], means=5) for v in (100.0, 200.0))
    assert np.all(high.largest > 2.0 * low.largest)
    assert high.largest_mean > low.largest_mean
    with_carrier = fs.capability(table1(), 150.0, frequency=[50.0], means=3, carrier=2000.0)
    assert 0.0 < with_carrier.largest[0] <= 0.5 * (with_carrier.largest_mean - 0.15) * 1.001


def voltage_by_search(circuit: fs.Circuit, mean: float, amplitude: float, f: float, carrier: float) -> float:
    """Largest voltage of the periodic modulated carrier whose friction is mean + amplitude sin(2 pi f t), N.

    It is searched for directly, without the inverse drive: the envelope is a short Fourier series, whose coefficients
    are varied until the mean friction of each of the carrier's periods is the wanted one.
    """
    order, per = 3, round(carrier / f)
    t = np.arange(32 * per + 1) / (32.0 * carrier)
    # Means over a period of the carrier flatten the sine a little.
    flat = np.sin(np.pi / per) / (np.pi / per)
    wanted = mean + amplitude * flat * np.sin(2.0 * np.pi * (np.arange(per) + 0.5) / per)

    def source(x: np.ndarray) -> fs.Waveform:
        pairs = [complex(*x[i : i + 2]) for i in range(1, x.size, 2)]
        tones = (fs.Sine(abs(z), k * f, phase_deg=math.degrees(cmath.phase(z))) for k, z in enumerate(pairs, 1))
        return fs.Sum((fs.DC(float(x[0])), *tones)) * fs.Sine(1.0, carrier)

    def misses(x: np.ndarray) -> np.ndarray:
        run = fs.simulate(circuit, sources=source(x), start="periodic", t_stop=1.0 / f, t_eval=t, rtol=1e-5)
        pieces = np.asarray(run.f_t)[:-1].reshape(per, 32)
        # The first point of each period is also the last one of the period before: the trapezoidal rule.
        ends = np.asarray(run.f_t)[::32]
        means = pieces.mean(1) + 0.5 * np.diff(ends) / 32.0
        return (means - wanted) / amplitude

    x = np.append([110.0, 20.0], np.zeros(2 * order - 1))
    for _ in range(8):
        now = misses(x)
        if np.abs(now).max() < 1e-3:
            break
        slopes = np.stack([misses(x + step) - now for step in 0.1 * np.eye(x.size)], axis=1) / 0.1
        x = x - np.linalg.lstsq(slopes, now, rcond=None)[0]
    assert np.abs(misses(x)).max() < 1e-3
    fine = np.linspace(0.0, 1.0 / f, 400 * per + 1)
    return float(np.abs(source(x).value(fine)).max())


@pytest.mark.parametrize("f", [125.0, 250.0][: cases(2, 1)])
def test_behind_an_amplifier_it_is_what_a_direct_search_over_carriers_finds(f: float) -> None:
    circuit = shipped("amplifier")
    found = fs.capability(circuit, 150.0, carrier=2000.0, frequency=[f], means=5)
    mean, amplitude = float(found.mean[3]), float(found.amplitude[3, 0])
    assert amplitude < 0.9 * (mean - found.smallest_mean)
    assert voltage_by_search(circuit, mean, amplitude, f, 2000.0) == pytest.approx(150.0, rel=5e-3)


@pytest.mark.parametrize(("deck", "carrier"), [("amplifier", None), ("ungrounded_user", 2000.0)])
def test_in_a_network_an_amplitude_is_reached_and_a_larger_one_is_not(deck: str, carrier: float | None) -> None:
    circuit = fs.read_netlist(CIRCUITS / f"{deck}.cir")
    found = fs.capability(circuit, 150.0, carrier=carrier, frequency=[100.0], means=5)
    mean, largest = float(found.mean[3]), float(found.amplitude[3, 0])
    assert 0.0 < largest < 0.95 * (mean - found.smallest_mean)
    rate = 8000.0 if carrier is None else 32.0 * carrier
    given: dict[str, Any] = {"duration": 0.05, "rate": rate, "carrier": carrier}
    for factor in (0.98, 1.02):
        drive = fs.inverse_drive(circuit, friction=fs.DC(mean) + fs.Sine(factor * largest, 100.0), **given)
        assert (drive.peak > 150.0) is (factor > 1.0)
        assert drive.peak == pytest.approx(150.0, rel=1e-2)
    # The largest constant friction, held by the limit from the end of the rise on.
    steady = fs.DC(found.largest_mean)
    held, free = (fs.inverse_drive(circuit, friction=steady, limit=limit, **given) for limit in (150.0, None))
    assert held.worst < 1e-3 * found.largest_mean
    assert free.peak == pytest.approx(150.0, rel=2e-3)


def test_it_is_refused_in_one_sentence() -> None:
    current, two = (fs.read_netlist(CIRCUITS / f"{deck}.cir") for deck in ("current_drive", "two_fingers"))
    for circuit, limit, frequency, said in (
        (current, 150.0, 100.0, "is that of one V source; this circuit has Idrive"),
        (two, 150.0, 100.0, "one finger"),
        (table1(), -1.0, 100.0, "limit is -1 V"),
        (table1(), 100.0, 500.0, "a quarter of the carrier"),
    ):
        refuses(said, fs.capability, circuit, limit, carrier=1000.0, frequency=[frequency])


def test_the_page_names_no_drive_and_the_picture_is_a_map_and_a_curve() -> None:
    found = fs.capability(table1(), 150.0, frequency=[20.0, 60.0, 200.0], means=5)
    # The deck's own drive has no part in it.
    assert str(found).splitlines()[1].startswith("up to 150 V without a carrier the friction's mean is from")
    left, right = found.plot().axes[:2]
    assert (left.get_xlabel(), left.get_ylabel()) == ("Modulation frequency [Hz]", "Mean friction [mN]")
    assert right.get_ylabel() == "Largest amplitude, best mean [mN]"
    assert right.get_lines()[0].get_xdata().size == 3
    # A single frequency has a picture too.
    left, right = fs.capability(table1(), 150.0, frequency=[60.0], means=4).plot().axes[:2]
    low, high = left.get_xlim()
    assert low < 60.0 < high
    assert right.get_lines()[0].get_xdata().tolist() == [60.0]


def test_the_command_writes_table_and_picture(command: Command) -> None:
    result = command("limits", "pad.cir", "--capability", "--limit", "120", "--out", "maps", "--json")
    answer = json.loads(result.out)
    assert result.code == 0, result.err
    assert answer["capability"]["limit"] == 120.0
    assert Path("maps/pad_capability.png").read_bytes().startswith(b"\x89PNG")
    head = Path("maps/pad_capability.csv").read_text().splitlines()[0]
    assert head == "frequency (Hz),mean friction (N),largest amplitude (N)"
    assert command("limits", "pad.cir", "--limit", "120").code == 2
