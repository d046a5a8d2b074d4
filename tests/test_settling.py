"""A settled run repeats its period: the result equals that of stepping every period, at any output, for both laws."""

from functools import cache

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from fingerspice.solve import stepping
from scenes import by_turns, deck, dispersive_deck, every_law, finger, table1, table1_deck

# A square's edges reach beyond the band of the dispersive skin's data.
pytestmark = pytest.mark.filterwarnings("ignore:of the source's energy")

SOURCES = {
    "sine": fs.Sine(200.0, 100.0),
    "offset": fs.Sine(120.0, 300.0, offset=60.0),
    "square": fs.Square(200.0, 1000.0),
    "pulse": fs.Pulse(-50.0, 200.0, delay=1e-3, rise=2e-5, fall=1e-5, width=3e-4, pulse_period=1e-3),
    "late": fs.Sine(200.0, 500.0, delay=3.3e-3),
    "two tones": fs.Sine(100.0, 200.0) + fs.Sine(80.0, 300.0),
}


def both(circuit: fs.Circuit, stop: float, law: str, rtol: float, t: np.ndarray | None = None):
    """The run that may repeat, and the one that steps every period."""
    times = np.linspace(0.0, stop, 4001) if t is None else t
    options = {"t_stop": stop, "t_eval": times, "rtol": rtol, "charge_law": law}
    return fs.simulate(circuit, **options), fs.simulate(circuit, method="exponential", **options)


def alike(run: fs.Solution, stepped: fs.Solution, grown: float) -> None:
    """Two runs are one to `rtol`, their charge and current to `grown` times that, and to the errors they state."""
    for name in ("u_gap", "f_el", "area", "i_source", "q_source"):
        a, b = getattr(run, name), getattr(stepped, name)
        # A current is a slope, and a charge adds up what every period is off.
        assert np.abs(a - b).max() <= (1.0 if name in ("u_gap", "f_el") else grown) * run.rtol * np.abs(b).max(), name
    assert np.abs(run.u_gap - stepped.u_gap).max() <= run.error.u_gap + stepped.error.u_gap
    assert np.abs(run.q_source - stepped.q_source).max() <= run.error.q_source + stepped.error.q_source


@pytest.mark.parametrize(("source", "law"), by_turns(SOURCES.values()))
@pytest.mark.parametrize("rtol", [1e-4, 1e-9])
def test_a_repeated_period_is_the_one_that_would_have_been_stepped(source: fs.Waveform, law: str, rtol: float) -> None:
    run, stepped = both(table1().replace({"Vdrive": source}), 60.4 * source.period, law, rtol)
    assert run.stats["repeated"] > 20
    assert stepped.stats["repeated"] == 0
    assert run.stats["steps"] < 0.7 * stepped.stats["steps"]
    alike(run, stepped, 10.0)


@pytest.mark.parametrize(
    ("source", "law"), by_turns(["SIN(0 200 5k)", "SIN(30 120 5k)", "PULSE(120 -120 100u 0 0 100u 200u)"])
)
@pytest.mark.parametrize("rtol", [1e-3, 1e-8])
def test_a_repeated_period_of_a_network_is_the_one_that_would_have_been_stepped(source, law, rtol) -> None:
    circuit = deck(f"Vdrive a 0 {source}", "Rout a b 47k", *finger("b", "0"), "Ccable b 0 150p", ".tran 1u 12.1m uic")
    run, stepped = both(circuit, 12.1e-3, law, rtol)
    assert run.stats["repeated"] > 20
    assert stepped.stats["repeated"] == 0
    alike(run, stepped, 300.0)


@every_law
def test_late_outputs_are_those_of_the_independent_reference(law: str) -> None:
    f, periods = 1000.0, 24
    run = fs.simulate(
        table1(f=f).replace({"Vdrive": fs.Sine(200.0, f)}),
        t_stop=periods / f, t_eval=np.linspace(19.0, 24.0, 301)[:-1] / f, rtol=1e-10, charge_law=law,
    )  # fmt: skip
    assert run.stats["repeated"] > 5
    exact = ref.transient(ref.sine_segments(200.0, f, periods / f), run.t, freq=f, law=law)
    gap = exact.u[:, 1]
    assert np.abs(run.u_gap - gap).max() <= 1e-10 * np.abs(gap).max()


@pytest.mark.parametrize(("source", "law"), by_turns(SOURCES.values()))
def test_outputs_that_lie_alike_in_every_period_are_those_at_any_times(source: fs.Waveform, law: str) -> None:
    alike = np.arange(6.3, 60.0, 0.025) * source.period
    some = np.sort(np.append(alike, np.random.default_rng(5).uniform(7.0, 60.0, 3000) * source.period))
    stop = 60.0 * source.period
    runs = [fs.simulate(table1(), sources=source, t_eval=t, t_stop=stop, charge_law=law) for t in (alike, some)]
    for name in ("u_gap", "f_el", "q_source"):
        a, b = getattr(runs[0], name), getattr(runs[1], name)[np.isin(some, alike)]
        # A pulse's flank moves by 2e-12 of its height in the rounding of a time.
        assert np.abs(a - b).max() <= 4e-12 * np.abs(b).max(), name


@every_law
def test_both_sides_of_every_jump_are_right_in_repeated_periods(law: str) -> None:
    f = 700.0
    deck = table1().replace({"Vdrive": fs.Square(200.0, f)})
    run = fs.simulate(deck, t_stop=100.5 / f, rtol=1e-6, charge_law=law)
    assert run.stats["repeated"] > 50
    twice = np.flatnonzero(np.diff(run.t) == 0.0)
    assert twice.size >= 200
    # The gap's share of a jump goes with the inverse of its capacitance.
    elastance = 1.0 / run.record.net.c
    k = float(elastance[run.record.net.gap[0]] / elastance.sum())
    jump = run.u_gap[twice + 1] - run.u_gap[twice]
    # Under `local` the gap takes its share of the 400 V at once; `mobile` adds what the area moves.
    assert np.all(np.sign(jump) == np.sign(run.u_source[twice + 1]))
    if law == "local":
        assert np.abs(np.abs(jump) - 400.0 * k).max() <= 1e-12 * 400.0


@every_law
@pytest.mark.parametrize("leak", ["1e10", "1e13", "none"])
def test_a_state_that_creeps_is_not_taken_for_settled(leak: str, law: str) -> None:
    # The coating's charge follows an offset over seconds to hours: 200 periods of it move the mean.
    source = fs.Sine(100.0, 1000.0, offset=80.0)
    r = float("inf") if leak == "none" else float(leak)
    run, stepped = both(table1().replace({"Vdrive": source, "Xcoat.r": r}), 0.2, law, 1e-7)
    peak = np.abs(stepped.u_gap).max()
    assert np.abs(run.u_gap - stepped.u_gap).max() <= 1e-7 * peak


@every_law
def test_a_run_goes_on_from_the_end_of_a_repeated_one(law: str) -> None:
    source = SOURCES["square"]
    circuit = table1().replace({"Vdrive": source})
    first = fs.simulate(circuit, t_stop=0.0503, rtol=1e-8, charge_law=law)
    assert first.stats["repeated"] > 20
    rest = fs.simulate(circuit, t_stop=0.0603, rtol=1e-8, charge_law=law, start=first)
    whole = fs.simulate(circuit, t_stop=0.0603, rtol=1e-8, charge_law=law, method="exponential")
    assert rest.t[-1] == whole.t[-1]
    assert rest.u_gap[-1] == pytest.approx(whole.u_gap[-1], abs=1e-8 * 200.0)
    assert rest.q_source[-1] == pytest.approx(whole.q_source[-1], abs=1e-7 * np.abs(whole.q_source).max())


@pytest.mark.parametrize(("source", "stop"), [(fs.Chirp(200.0, 50.0, 500.0, 0.1), 0.1), (fs.Sine(200.0, 100.0), 0.05)])
def test_a_source_without_a_period_and_a_short_run_are_stepped(source: fs.Waveform, stop: float) -> None:
    assert fs.simulate(table1(), sources=source, t_stop=stop, rtol=1e-4).stats["repeated"] == 0


DISPERSIVE = fs.parse_netlist(dispersive_deck())
FAST = {
    "sine": fs.Sine(200.0, 5000.0),
    "offset": fs.Sine(120.0, 7000.0, offset=60.0),
    "square": fs.Square(200.0, 5000.0),
    "two tones": fs.Sine(100.0, 4000.0) + fs.Sine(80.0, 6000.0),
}


@pytest.mark.parametrize(("source", "law"), by_turns(FAST.values()))
@pytest.mark.parametrize("rtol", [1e-4, 1e-8])
def test_a_skin_that_remembers_for_many_periods_settles(source: fs.Waveform, law: str, rtol: float) -> None:
    # Its slowest branch remembers for 7 ms, 28 to 48 periods.
    run, stepped = both(DISPERSIVE.replace({"Vdrive": source}), 0.40023, law, rtol)
    assert run.stats["repeated"] > 0.25 * 0.40023 / source.period
    alike(run, stepped, 30.0)


@pytest.mark.parametrize("circuit", ["stack", "dispersive", "network"])
@pytest.mark.parametrize("source", ["sine", "square"])
@pytest.mark.parametrize("rtol", [1e-4, 1e-8])
def test_the_charge_of_a_hundred_thousand_periods_is_that_of_one(circuit: str, source: str, rtol: float) -> None:
    # Both half periods of these sources deliver the same charge, one the negative of the other: none adds up, but for
    # errors, which are stated.
    finger = {
        "stack": table1(), "dispersive": DISPERSIVE,
        "network": fs.parse_netlist(table1_deck("SIN(0 200 5k)", extra="Rbeside drive 0 1meg")),
    }[circuit].replace({"Vdrive": FAST[source]})  # fmt: skip
    period, late = FAST[source].period, []
    for count in (2_000, 100_000):
        t = (count - 1 + np.linspace(0.05, 0.95, 19)) * period
        run = fs.simulate(finger, t_stop=count * period, t_eval=t, rtol=rtol)
        assert run.stats["repeated"] > count - 1_500
        assert run.error.u_gap <= rtol * np.abs(run.u_gap).max()
        late.append(run)
    apart = np.abs(late[1].q_source - late[0].q_source).max()
    assert apart <= late[0].error.q_source + late[1].error.q_source
    # A period has a share of the error asked for.
    assert late[1].error.q_source <= 0.05 * 100_000 * rtol * np.abs(late[1].q_source).max()


CREEPING_T = np.linspace(0.0, 0.06, 4001)[:-1]


@cache
def creeping(law: str) -> ref.Transient:
    """Table 1 with 10 Mohm of coating under 120 V at 1 kHz and 60 V of offset."""
    coat, *others = ref.table1_layers(100.0)
    layers = (ref.Layer(coat.c, r_total=1e7), *others)
    return ref.transient(
        ref.sine_segments(120.0, 1000.0, 0.06, offset=60.0), CREEPING_T, law=law, layers=layers, tol=1e-12
    )


@every_law
@pytest.mark.parametrize("beside", ["", "Rbeside drive 0 1meg"], ids=["stack", "network"])
def test_what_a_repeated_period_is_off_is_in_every_stated_error(law, beside, monkeypatch):
    # Taken for settled while it still moves hundreds of times more than a step may be off, and the coating's charge
    # takes its time: what is left to move is then all the error there is.
    monkeypatch.setattr(stepping, "_SHARE", 1e2)
    circuit = fs.parse_netlist(table1_deck("SIN(60 120 1000)", coat={"r": "10meg"}, extra=beside))
    t, exact, w = CREEPING_T, creeping(law), 2.0 * np.pi * 1000.0
    run = fs.simulate(circuit, t_stop=0.06, t_eval=t, rtol=1e-4, charge_law=law)
    assert run.stats["repeated"] > 20
    through = (60.0 * t + 120.0 / w * (1.0 - np.cos(w * t))) / 1e6 if beside else 0.0 * t
    for ours, theirs, stated in (
        (run.u_gap, exact.u_gap, run.error.u_gap),
        (run.f_el, exact.force, run.error.f_el),
        (run.q_source, exact.q + through, run.error.q_source),
    ):
        off = np.abs(ours - theirs).max()
        assert off <= stated <= 1e-4 * np.abs(theirs).max()
