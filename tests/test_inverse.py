"""The inverse drive: its source voltage produces the wanted force, and impossible requests get a clear message."""

import json
import math
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

import analytic as ref
import fingerspice as fs
from commands import Command
from scenes import cases, dispersive_deck, listed, refuses, shipped, table1, warns

KINDS = {
    "stack": table1(), "dispersive": fs.parse_netlist(dispersive_deck()),
    **{deck: shipped(deck) for deck in ("amplifier", "ungrounded_user")},
}  # fmt: skip
pytestmark = pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")


def profile(seed: int, duration: float = 0.03, rate: float = 48e3, band: float = 150.0) -> fs.Samples:
    """A friction of some random tones up to `band` (Hz), from 0.16 to 0.22 N."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * rate) + 1) / rate
    tones = sum(
        rng.normal() * np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) for f in rng.uniform(10.0, band, 5)
    )
    low, high = np.sort(rng.uniform(0.16, 0.22, 2))
    return fs.Samples(low + (high - low) * (tones - tones.min()) / np.ptp(tones), rate)


# Of 50 random profiles for each kind of circuit, those with the largest miss, and one in a circuit without a ground.
HARDEST = [
    (1013, "stack", None, "local"), (1013, "stack", None, "mobile"), (1028, "stack", 2000.0, "local"),
    (1013, "dispersive", None, "local"), (1028, "dispersive", 2000.0, "local"), (1010, "amplifier", None, "local"),
    (1005, "amplifier", 2000.0, "local"), (3, "ungrounded_user", None, "local"), (1028, "stack", 2000.0, "mobile"),
][: cases(9, 8)]  # fmt: skip


@pytest.mark.parametrize(("seed", "kind", "carrier", "law"), HARDEST)
def test_the_hardest_of_fifty_profiles_are_made(seed: int, kind: str, carrier: float | None, law: str) -> None:
    wanted = profile(seed, 0.001 * (5 if carrier and kind == "amplifier" else cases(10, 5)))
    found = fs.inverse_drive(KINDS[kind], friction=wanted, carrier=carrier, charge_law=law)
    assert found.worst_share < 1e-4
    assert found.at_limit == 0.0
    assert found.lead == (0.0 if kind in ("stack", "dispersive") else 2e-3)
    if carrier is None:
        assert found.times[0] == pytest.approx(found.lead)


def test_a_drive_of_a_thousand_volts_is_warned_about() -> None:
    wanted = np.full(100, 0.2)
    # A gap that leaks takes a small share of the source's voltage.
    leaky = table1(gap={"r": 5e4})
    warns(r"the drive reaches \d{4,} V; limit=", fs.inverse_drive, leaky, force=wanted, rate=48e3)
    with warnings.catch_warnings():
        warnings.simplefilter("error", fs.FingerspiceWarning)
        fs.inverse_drive(leaky, force=wanted, rate=48e3, limit=300.0)
        fs.inverse_drive(table1(), force=wanted, rate=48e3)


def test_the_independent_transient_makes_the_wanted_force() -> None:
    """Forward by tests/analytic.py, which shares nothing with the package: a force that rises and falls."""
    rate, n = 20e3, 41
    wanted = 0.15 + 0.1 * np.sin(2 * np.pi * 250.0 * np.arange(n) / rate)
    found = fs.inverse_drive(table1(), force=wanted, rate=rate)
    t = (np.arange(n) / rate).tolist()
    points = list(zip(t, found.drive.values.tolist(), strict=True))
    force = np.asarray(ref.transient(ref.pwl_segments(points), t, freq=100.0).force)
    np.testing.assert_allclose(force, wanted, atol=1e-4 * wanted.max())


def test_a_limit_and_a_slew_rate_hold_the_drive_and_the_cost_is_said() -> None:
    wanted = profile(1, 0.01)
    free = fs.inverse_drive(table1(), friction=wanted)
    limit = 0.9 * free.peak
    held = fs.inverse_drive(table1(), friction=wanted, limit=limit)
    assert held.peak == pytest.approx(limit)
    assert 0.0 < held.at_limit < 1.0
    assert held.worst > 100.0 * free.worst
    assert held.rms <= held.worst
    assert "cost" in str(held)
    # Where the drive is below its limit the friction is the wanted one again.
    away = np.abs(held.drive.values) < 0.999 * limit
    assert np.abs(held.friction - held.wanted_friction)[away].max() < 1e-4 * 0.22
    for circuit in (table1(), KINDS["amplifier"]):
        slow = fs.inverse_drive(circuit, friction=wanted, slew=2e4)
        assert np.abs(np.diff(slow.drive.values)).max() <= 2e4 / 48e3 * (1.0 + 1e-9)
        assert slow.at_limit > 0.0


def test_no_other_drive_within_the_limit_does_much_better() -> None:
    """A search over all samples of a small case, started at the clipped drive."""
    rate, n = 2000.0, 10
    wanted = 0.25 + 0.15 * np.sin(2 * np.pi * 200.0 * np.arange(n) / rate)
    free = fs.inverse_drive(table1(), force=wanted, rate=rate)
    limit = 0.9 * free.peak
    held = fs.inverse_drive(table1(), force=wanted, rate=rate, limit=limit)
    t = np.arange(n) / rate

    def cost(values: np.ndarray) -> float:
        drive = fs.Samples(values, rate)
        run = fs.simulate(table1(), sources=drive, t_stop=t[-1], t_eval=t, rtol=1e-8, start="uncharged", charge=False)
        return 1e4 * float(np.mean((run.f_el - wanted) ** 2))

    start = held.drive.values.copy()
    best = minimize(cost, start, bounds=[(-limit, limit)] * n, method="L-BFGS-B", options={"maxiter": 60})
    assert math.sqrt(cost(start) / 1e4) == pytest.approx(held.rms, rel=1e-3)
    # The best drive found by search.
    assert held.rms <= 1.05 * math.sqrt(best.fun / 1e4)


BAD = [
    *listed("drives"),
    ({"force": [0.2, 0.1], "rate": None}, "force is an array without a rate"),
    ({"force": fs.Sine(0.1, 60.0)}, "duration="),
    ({"force": [0.1] * 100, "carrier": 100.0}, "too fast for a rate of 1000 Hz"),
    *(({"circuit": shipped(deck), "force": [0.1, 0.1]}, said) for deck, said in (
        ("two_fingers", "one finger"), ("current_drive", "one V"), ("fingerpad_dispersive", "one V"))),
    ({"circuit": table1(gap={"tau": 1e-3}), "force": [0.1, 0.1]}, "tau"),
    ({"circuit": table1(gap={"mu": 0}), "friction": [0.1, 0.1]}, "mu=0"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "said"), BAD, ids=lambda x: x if isinstance(x, str) else "")
def test_what_cannot_be_is_refused(given: dict[str, object], said: str) -> None:
    with pytest.raises(fs.InputError, match=re.escape(said)) as caught:
        fs.inverse_drive(**{"circuit": table1(), "rate": 1e3, **given})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_what_is_written_is_read_back_and_the_picture_shows_wanted_and_reached(tmp_path: Path) -> None:
    found = fs.inverse_drive(table1(), friction=profile(2, 0.005), limit=150.0)
    found.to_wav(tmp_path / "a.wav")
    read = fs.Samples.from_wav(tmp_path / "a.wav", 1.0)
    assert read.rate == 48e3
    np.testing.assert_allclose(found.peak * read.values, found.drive.values, atol=1e-9 * found.peak)
    found.to_csv(tmp_path / "a.csv")
    again = fs.PWL.from_table(tmp_path / "a.csv")
    np.testing.assert_array_equal(again.values, found.drive.values)
    refuses("gain", found.to_wav, tmp_path / "b.wav", gain=1.0)
    top, middle, bottom = found.plot().axes
    assert [x.get_label() for x in top.get_lines()] == ["wanted", "reached"]
    assert (top.get_ylabel(), bottom.get_ylabel()) == ("Friction [mN]", "Drive [V]")
    assert middle.get_ylabel().startswith("Miss [")
    assert bottom.get_xlabel() == "Time [ms]"


ROWS = "time (ms), friction (mN)\n" + "".join(f"{0.1 * i:.1f}, {170 + i % 7}\n" for i in range(60))


def test_design_writes_drive_prediction_and_picture(command: Command) -> None:
    Path("wanted.csv").write_text(ROWS)
    result = command("design", "wanted.csv", "pad.cir", "--out", "got", "--rate", "10k", "--json")
    answer = json.loads(result.out)
    assert result.code == 0, result.err
    assert answer["kind"] == "friction"
    assert answer["worst_share"] < 1e-4
    assert {Path(x).name for x in answer["files"]} == {
        "pad_drive.wav", "pad_drive.csv", "pad_friction.csv", "pad_design.png"
    }  # fmt: skip
    head = Path("got/pad_friction.csv").read_text().splitlines()[0]
    assert head == "time (s),wanted force (N),force (N),wanted friction (N),friction (N)"
    drive = f"WAV(got/pad_drive.wav gain={answer['peak']!r})"
    assert command("run", "pad.cir", "--source", drive, "--stop", "5m", "--no-plot", "--out", "again").code == 0


@pytest.mark.parametrize(("rows", "words", "said"), listed("wanted"))
def test_bad_tables_are_refused_in_one_sentence(command: Command, rows: str, words: list[str], said: str) -> None:
    Path("wanted.csv").write_text(rows)
    result = command("design", "wanted.csv", "pad.cir", *words).refused(said)
    assert len(result.err.strip().splitlines()) == 1


@pytest.mark.parametrize("plot", [[], ["--no-plot"]])
def test_design_replaces_the_files_it_wrote_and_no_others(command: Command, plot: list[str]) -> None:
    Path("wanted.csv").write_text(ROWS)
    words = ("design", "wanted.csv", "pad.cir", "--rate", "10k", *plot)
    assert command(*words).code == 0
    command(*words).ok()
    if not plot:
        other = command(*words, "--set", "Xgap.d=4u").refused()
        assert "pad_drive.wav holds a result of the deck as it is, and this one is with Xgap.d=4u" in other.err
    Path("out/pad_drive.wav").write_bytes(b"mine")
    Path("out/pad_drive.csv").write_text("mine")
    if plot:
        assert "pad_drive.wav is there already, and nothing says which circuit it is of" in command(*words).err
