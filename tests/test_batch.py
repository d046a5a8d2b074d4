"""`fs.batch`, against single runs and the independent reference, also for scenes that cannot run in lockstep."""

from typing import Any

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
import recording_errors
from batches import alike, check, population, singles, singly
from fingerspice.circuit.circuit import Circuit
from scenes import DECKS, cases, dispersive_deck, listed, refuses, shipped, table1, table1_deck

pytestmark = pytest.mark.filterwarnings("ignore:the gap voltage reaches")
OUTPUTS = ("f_el_mean", "f_el_mean_periodic", "f_t_rms", "u_gap_rms")
# A loop is compiled, in ten seconds, for every number of modes, tones, moments and powers of the area's polynomial, of
# which there are 8 at first, below an rtol of 5e-5 16, and below 5e-7 24. So most tests go without root mean squares,
# for which three moments are followed instead of one.
FEW = OUTPUTS[: cases(4, 2)]


def square() -> Circuit:
    return table1().replace({"Vdrive": fs.Square(200.0, 100.0)})


BOTH = pytest.mark.parametrize(("circuit", "outputs"), [(table1(), FEW), (square(), FEW)], ids=["sine", "square"])


@BOTH
def test_a_wide_population_meets_what_was_asked_and_states_its_error(circuit: Circuit, outputs: Any) -> None:
    parameters = population(60, seed=11)
    expected = singly(circuit, parameters, outputs, periods=5)
    for rtol in (1e-3, 1e-4, 4e-7, 1e-6)[: cases(4, 3)]:
        found = check(circuit, parameters, outputs, expected, rtol, periods=5, skin="follow")
        assert found.error.max() <= rtol
        assert np.all(found.status == 0)
        assert found.attrs["n_ordinary"] == 0


ONCE_WRONG = dict(listed("batches_once_wrong"))


@pytest.mark.parametrize("changes", ONCE_WRONG.values(), ids=ONCE_WRONG)
def test_a_scene_that_was_once_wrong_has_its_error_met(changes: dict[str, float]) -> None:
    load, circuit = {"Xgap.fn": [changes["Xgap.fn"]]}, table1().replace({**changes, "Xgap.fn": 0.5})
    check(circuit, load, ("f_el_mean",), singly(circuit, load, ("f_el_mean",), periods=0.5), 1e-6, periods=0.5)


# Below 5e-5 one loop serves all.
@pytest.mark.parametrize(("periods", "rtols"), [(0.5, (4e-5, 1e-6)), (5, (4e-5,)), (1, (1e-6,))])
@pytest.mark.parametrize("phase", [21.0, 90.0, 250.0])
def test_what_a_start_away_from_0_v_excites_is_in_the_error(phase: float, periods: float, rtols: Any) -> None:
    rng = np.random.default_rng(5)
    circuit, outputs = table1().replace({"Vdrive.phase_deg": phase}), OUTPUTS[2:]
    parameters = {
        "Xgap.r": 10.0 ** rng.uniform(4.0, 8.0, 30), "Xcoat.r": 10.0 ** rng.uniform(3.0, 7.0, 30),
        "Xgap.fn": rng.uniform(0.1, 2.0, 30), "Vdrive.frequency": np.full(30, 100.0),
    }  # fmt: skip
    expected = singly(circuit, parameters, outputs, periods=periods)
    for rtol in rtols:
        found = check(circuit, parameters, outputs, expected, rtol, slack=0.01 * rtol, periods=periods)
        assert np.count_nonzero(found.status == 0) >= 12


@BOTH
def test_the_mean_force_is_that_of_the_independent_reference(circuit: Circuit, outputs: Any) -> None:
    volts, f = np.array([80.0, 200.0, 290.0]), 400.0
    circuit = circuit.replace({"Vdrive.frequency": f, "Xskin.f": f})
    found = fs.batch(circuit, {"Vdrive.amplitude": volts}, periods=3, rtol=1e-7, outputs=outputs)
    expected = []
    for u in volts:
        jumping = isinstance(circuit["Vdrive"].waveform, fs.Square)
        segments = ref.square_segments(u, f, 3) if jumping else ref.sine_segments(u, f, 3 / f)
        run = ref.transient(segments, [3 / f], freq=f)
        expected.append(run.force_integral(3 / f) * f / 3)
    assert np.all(found.status == 0)
    np.testing.assert_allclose(found.f_el_mean, expected, rtol=1e-7)


@BOTH
def test_gap_voltages_are_those_of_single_runs(circuit: Circuit, outputs: Any) -> None:
    parameters = population(6, seed=2)
    found = fs.batch(
        circuit, parameters, outputs=("u_gap", outputs[-1]), periods=2, points=50, skin="follow", rtol=1e-4
    )
    assert found.u_gap.dims == ("scene", "turn")
    for u, run in zip(found.u_gap, singles(circuit, parameters, periods=2, points=50), strict=True):
        np.testing.assert_allclose(u, run.u_gap, rtol=0.0, atol=1e-4 * np.abs(run.u_gap).max())


def test_half_the_steps_are_an_even_number_for_any_number_of_gap_voltages() -> None:
    # Otherwise the error that they show is hundreds of times too large.
    for points in (44, 50):
        found = fs.batch(table1(), {"Xgap.d": [3e-6]}, outputs=("u_gap",), periods=1, points=points, rtol=1e-3)
        assert found.error[0] < 6e-4


@BOTH
def test_the_periodic_state_is_that_of_steady_state(circuit: Circuit, outputs: Any) -> None:
    parameters = population(8, seed=3)
    found = fs.batch(circuit, parameters, outputs=outputs, periodic=True, skin="follow", rtol=1e-5)
    assert np.count_nonzero(found.status == 0) >= 5
    for i in range(8):
        changes = {path: float(values[i]) for path, values in parameters.items()}
        one = circuit.varied({"Xskin.f": changes["Vdrive.frequency"], **changes})
        state = fs.steady_state(one, rtol=1e-10, charge=False)
        assert found.f_el_mean[i] == pytest.approx(state.f_el_mean, rel=1e-5)


COAT, SLAB = "area LAYER d=1u eps_r=3.9 r=0.2meg", "area SLAB d=5u eps_r=3 rho=1e8"
TIGHT, SKIN = "area LAYER d=1u eps_r=3.9 r=inf", "0 area SKIN d=350u f=100"
RMS, TURNED, FINE = ("f_el_mean", "u_gap_rms"), ("f_el_mean", "u_gap"), (1e-6, 4e-7)[cases(0, 1)]
# Voltages at times are hardly to be had in lockstep at 4e-7; they show which way round the gap is.
LAYERS = {
    "gap turned": (f"Xcoat drive a {COAT}\nXgap b a area GAP r=1meg\nXskin b {SKIN}", TURNED, 1e-6),
    "two, gap turned": (f"Xslab drive a {SLAB}\nXgap 0 a area GAP r=1meg", RMS, FINE),
    "four, equal rates": (
        f"X1 drive a {TIGHT}\nX2 a b {TIGHT}\nXgap b c area GAP r=1meg\nXskin c {SKIN}", RMS, FINE,
    ),
}  # fmt: skip


@pytest.mark.parametrize(("layers", "outputs", "rtol"), LAYERS.values(), ids=LAYERS)
def test_stacks_of_other_layers(layers: str, outputs: tuple[str, ...], rtol: float) -> None:
    start = "stack\n.include fingerspice.lib\nVdrive drive 0 SIN(0 150 100 0 0 40)"
    circuit = fs.parse_netlist(f"{start}\n{layers}\n.tran 10u 25m uic\n.end\n")
    found = fs.batch(circuit, {"Xgap.d": [3e-6, 4e-6]}, outputs=outputs, rtol=rtol)
    assert found.attrs["n_ordinary"] == 0
    for i, run in enumerate(singles(circuit, {"Xgap.d": [3e-6, 4e-6]}, periods=2.5, points=200)):
        np.testing.assert_allclose(found.f_el_mean[i], run.f_el_mean, rtol=rtol)
        if "u_gap" in outputs:
            np.testing.assert_allclose(found.u_gap[i], run.u_gap, rtol=0.0, atol=rtol * np.abs(run.u_gap).max())
        else:
            np.testing.assert_allclose(found.u_gap_rms[i], run.u_gap_rms, rtol=rtol)


DISPERSIVE = "Xskin skin 0 area SKIN_DISPERSIVE d=350u"
STACK = (DECKS / "several_tones.cir").read_text()
SOURCES = {
    "three sines": ("V1 a 0 SIN(0 150 100)\nV2 b a SIN(0 40 300 0 0 60)\nV3 b in SIN(0 30 500 0 0 -20)", "25m"),
    "AM": ("Vdrive in 0 SIN(0 200 2k)", "50m"),
    "sine": ("Vdrive in 0 SIN(0 200 100)", "30m"),
    "square": ("Vdrive in 0 PULSE(-200 200 0 0 0 5m 10m)", "30m"),
}


@pytest.mark.parametrize("periods", [9.0, 12.5])
def test_gap_voltages_of_a_settled_run_are_those_of_its_last_period(periods: float) -> None:
    # A slow skin, of which some scenes settle within few periods and others within many, in one block.
    rng = np.random.default_rng(2)
    parameters = {"Xgap.d": 3.5e-6 * rng.lognormal(0.0, 0.1, 24), "Xgap.r": rng.uniform(2e5, 5e6, 24)}
    how: dict[str, Any] = {"outputs": ("u_gap", "u_gap_rms")[: cases(2, 1)], "periods": periods, "points": 64}
    found = fs.batch(table1(), parameters, **how)
    alone = fs.batch(table1(), {path: x[5:6] for path, x in parameters.items()}, **how)
    np.testing.assert_array_equal(found.u_gap[5], alone.u_gap[0])
    runs = singles(table1(), parameters, periods=periods, points=64)
    off = [abs(u - run.u_gap).max() / abs(run.u_gap).max() for u, run in zip(found.u_gap.values, runs, strict=True)]
    assert max(off) <= 1e-4
    assert np.mean(off <= found.error.values) >= 0.95


@pytest.mark.parametrize(
    ("source", "skin"),
    [("three sines", ""), ("AM", ""), ("square", DISPERSIVE), ("sine", DISPERSIVE), ("AM", DISPERSIVE)][: cases(5, 3)],
)
def test_tones_and_the_dispersive_skin(source: str, skin: str) -> None:
    text, stop = SOURCES[source]
    text = STACK.format(source=text, skin=skin or "Xskin skin 0 area SKIN d=350u f=500", stop=stop)
    circuit = fs.parse_netlist(text)
    if source == "AM":
        circuit = circuit.replace({"Vdrive": fs.AM(200.0, 2e3, 50.0, depth=0.7, phase_deg=30.0)})
    rng = np.random.default_rng(8)
    parameters: dict[str, Any] = {
        "Xgap.d": rng.uniform(2.5e-6, 5e-6, 20), "Xgap.r": 1e6 * 10.0 ** rng.uniform(-1.0, 1.0, 20),
        "Xskin.d": rng.uniform(2e-4, 5e-4, 20),
    }  # fmt: skip
    if source == "AM":
        parameters |= {"Vdrive.depth": rng.uniform(0.0, 1.0, 20), "Vdrive.phase_deg": rng.uniform(-90.0, 200.0, 20)}
    if source == "three sines":
        parameters |= {"V2.amplitude": rng.uniform(0.0, 80.0, 20), "V3.phase_deg": rng.uniform(-180.0, 180.0, 20)}
    outputs = FEW if skin else OUTPUTS
    expected = singly(circuit, parameters, outputs)
    for rtol in ((1e-6, 1e-4, 4e-7) if source == "AM" else (4e-7, 1e-4, 1e-6))[: cases(3, 1)]:
        found = check(circuit, parameters, outputs, expected, rtol)
        assert np.all(found.status == 0)


def test_neither_threads_nor_the_order_of_scenes_change_a_byte() -> None:
    parameters = population(300, seed=5)
    # One of them goes by itself, one is refused.
    parameters["Vdrive.amplitude"][7] = 3000.0
    parameters["Xgap.c2"] = np.where(np.arange(300) == 100, 1e9, 5000.0)
    alike(table1(), parameters, periods=3, rtol=1e-5, outputs=FEW)


# A finger that forgets its start within a period of 100 Hz, and one whose layers leak for about 200 of them.
SETTLING: dict[str, list[float]] = {"Xgap.r": [3e5, 1e9], "Xcoat.r": [2e5, 1e9]}


@BOTH
def test_a_run_that_has_settled_ends_and_one_that_has_not_goes_on(circuit: Circuit, outputs: Any) -> None:
    found = {n: fs.batch(circuit, SETTLING, outputs=outputs, periods=n, rtol=4e-7) for n in (20, 60, 60.5)}
    # The last period is the very same one in a run of 20 and of 60 periods. An odd number of half periods begins with
    # one of them.
    quick, slow = (np.array([found[n].f_el_mean_periodic.values[i] for n in (20, 60, 60.5)]) for i in (0, 1))
    assert quick[0] == quick[1]
    assert quick[2] == pytest.approx(quick[1], rel=1e-6)
    assert abs(slow[1] / slow[0] - 1.0) > 1e-6
    for n, batch in found.items():
        for name, expected in zip(outputs, singly(circuit, SETTLING, outputs, periods=n), strict=True):
            assert np.all(np.abs(batch[name] / expected - 1.0) <= batch.error)
        assert batch.error.max() <= 4e-7


@BOTH
def test_no_scene_s_bytes_depend_on_when_those_beside_it_settle(circuit: Circuit, outputs: Any) -> None:
    mixed = {path: np.array(values * 20) for path, values in SETTLING.items()}
    how: dict[str, Any] = {"outputs": outputs, "periods": 12, "rtol": 1e-5}
    together = fs.batch(circuit, mixed, **how).f_el_mean.values
    for i in range(2):
        alone = fs.batch(circuit, {path: [values[i]] for path, values in SETTLING.items()}, **how)
        assert np.all(together[i::2] == alone.f_el_mean.values[0])


def test_one_bad_scene_costs_the_others_nothing() -> None:
    c2 = np.full(40, 5000.0)
    good = fs.batch(table1(), {"Xgap.c2": c2}, periods=2)
    c2[17] = 1e9
    found = fs.batch(table1(), {"Xgap.c2": c2}, periods=2)
    assert found.status[17] == 2
    assert np.isnan(found.f_el_mean[17])
    assert np.isnan(found.error[17])
    assert found.attrs["n_ordinary"] == 1
    assert len(found.attrs["failures"]) == 1
    assert found.attrs["failures"][0].startswith("scene 17: ")
    assert "Xgap has no contact" in found.attrs["failures"][0]
    others = np.arange(40) != 17
    np.testing.assert_array_equal(found.f_el_mean.values[others], good.f_el_mean.values[others])


def test_a_scene_past_its_fold_fails_by_itself() -> None:
    mobile = table1(library="fingerspice_mobile.lib")
    found = fs.batch(mobile, {"Xgap.fn": [0.5, 1e-4]}, periods=1)
    assert found.status.values.tolist() == [1, 3]
    assert "fold" in found.attrs["failures"][0]
    run = fs.simulate(mobile, t_stop=0.01, rtol=1e-9)
    assert found.f_el_mean[0] == pytest.approx(run.f_el_mean, rel=1e-4)


@pytest.mark.parametrize(("changes", "parameters", "outputs", "why"), listed("one_by_one"))
def test_what_lockstep_cannot_do_goes_one_by_one(changes, parameters, outputs, why):
    circuit = table1(**changes)
    found = fs.batch(circuit, parameters, outputs=outputs, rtol=1e-6)
    assert found.attrs["n_ordinary"] == 1
    assert why in found.attrs["ordinary"]
    assert found.status.values.tolist() == [1]
    single = fs.simulate(circuit.varied({k: v[0] for k, v in parameters.items()}), rtol=1e-9).summary()
    for name in outputs:
        assert found[name][0] == pytest.approx(single[name], rel=1e-6)


def test_figures_of_several_gaps_have_a_column_each() -> None:
    circuit = shipped("two_fingers")
    gap = circuit.by_device("GAP")[0].name
    parameters = {f"{gap}.d": [3e-6, 4e-6]}
    found = fs.batch(circuit, parameters, rtol=1e-3)
    assert found.f_el_mean.dims == ("scene", "gap")
    assert found.f_el_mean.shape == (2, 2)
    circuit = circuit.varied({"Vdrive": fs.Sine(200.0, 100.0)})
    found = fs.batch(circuit, parameters, outputs=("u_gap",), periods=1, points=20)
    assert found.u_gap.dims == ("scene", "turn", "gap")
    for u, run in zip(found.u_gap, singles(circuit, parameters, periods=1, points=20), strict=True):
        np.testing.assert_allclose(u, run.u_gap, rtol=0.0, atol=1e-4 * np.abs(run.u_gap).max())
    refused = fs.batch(circuit, {f"{gap}.c2": [1e6]}, periods=1)
    assert refused.status.values.tolist() == [2]
    assert refused.f_el_mean.shape == (1, 2)


def test_the_skin_follows_the_source_only_on_request() -> None:
    frequency = [50.0, 1000.0]
    own = fs.batch(table1(), {"source.frequency": frequency}, periods=5)
    follow = fs.batch(table1(), {"Vdrive.frequency": frequency}, periods=5, skin="follow")
    same = fs.batch(table1(), {"vdrive.frequency": frequency, "Xskin.f": frequency}, periods=5)
    assert "own Xskin.f, whatever" in own.attrs["skin"]
    assert "follow" in follow.attrs["skin"]
    np.testing.assert_array_equal(follow.f_el_mean, same.f_el_mean)
    assert np.all(np.abs(own.f_el_mean / follow.f_el_mean - 1.0) > 1e-3)


def test_runs_of_the_deck_s_length_may_have_different_numbers_of_periods() -> None:
    frequency = np.array([100.0, 200.0, 250.0, 30.0, 33.3])
    found = fs.batch(table1(), {"Vdrive.frequency": frequency}, rtol=1e-5)
    # 50 ms hold one and a half periods of 30 Hz, but no whole number of halves of 33.3 Hz.
    assert found.status.values.tolist() == [0, 0, 0, 0, 1]
    for i, f in enumerate(frequency):
        run = fs.simulate(table1().replace({"Vdrive.frequency": f}), rtol=1e-9)
        assert found.f_el_mean[i] == pytest.approx(run.f_el_mean, rel=1e-5)


def test_the_dataset_says_what_it_holds(tmp_path: Any) -> None:
    found = fs.batch(table1(), {"Xgap.d": [3e-6, 4e-6], "Vdrive.amplitude": 150.0}, periods=1)
    assert found.f_el_mean.attrs["units"] == "N"
    assert found["Xgap.d"].attrs["units"] == "m"
    assert found["Vdrive.amplitude"].values.tolist() == [150.0, 150.0]
    assert found.status.attrs["flag_meanings"] == "lockstep one_by_one refused failed"
    found.to_netcdf(tmp_path / "batch.nc", engine="h5netcdf")
    zero = fs.batch(table1(), {"Vdrive.amplitude": [0.0, 100.0]}, periods=1)
    assert zero.f_el_mean.values[0] == 0.0
    assert np.all(zero.error < 1e-4)


@pytest.mark.parametrize(("parameters", "options", "message"), listed("batches"))
def test_bad_input_is_refused_in_one_sentence(parameters: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(fs.InputError, match=message) as caught:
        fs.batch(table1(), parameters, **options)
    assert "\n" not in str(caught.value)


# Recordings in lockstep ----------------------------------------------------------------------------------------


RATE, COUNT = 48_000.0, 961
T_STOP = (COUNT - 1) / RATE
RECORDED = ("f_el_mean", "f_t_rms", "u_gap_rms")


def noise(highest: float, peak: float = 150.0, seed: int = 1) -> np.ndarray:
    values = peak * recording_errors.noise(seed, COUNT, RATE, 50.0, highest)
    values[0] = 0.0
    return values


def recorded(highest: float = 1000.0, circuit: fs.Circuit | None = None, **how: Any) -> fs.Circuit:
    return (circuit or table1()).replace({"Vdrive": fs.Samples(noise(highest, **how), RATE)})


def people(n: int, seed: int = 2) -> dict[str, np.ndarray]:
    """A population's fingers alone."""
    return {path: values for path, values in population(n, seed).items() if not path.startswith("Vdrive")}


def check_all(
    circuit: fs.Circuit, scenes: dict[str, np.ndarray], rtols: tuple[float, ...], outputs: tuple[str, ...] = RECORDED,
    in_lockstep: float = 0.0, rounding: float = 1e-9,
) -> None:  # fmt: skip
    """Scenes go in lockstep, with the errors asked for and, 19 of 20, within those stated."""
    true = singly(circuit, scenes, outputs, t_stop=T_STOP, t_eval=[T_STOP])
    for rtol in rtols:
        found = check(circuit, scenes, outputs, true, rtol, slack=rounding, t_stop=T_STOP)
        assert (found.status == 0).mean() > in_lockstep


@pytest.mark.parametrize(("highest", "rtols"), [(1000.0, (1e-4, 1e-6)), (8000.0, (1e-3, 1e-5))])
def test_stated_errors_cover_wide_populations(highest: float, rtols: tuple[float, ...]) -> None:
    # Root mean squares, for which another loop is compiled, are below, with a dispersive skin.
    check_all(recorded(highest), people(cases(40, 20)), rtols, RECORDED[: cases(3, 1)], in_lockstep=0.9)


@pytest.mark.parametrize("seed", [2, 4, 5][: cases(3, 1)])
def test_stated_errors_cover_fingers_that_differ_little(seed: int) -> None:
    # Their errors go up and down together, so that an estimate that is small by chance is so for all of them.
    r = np.random.default_rng(1)
    scenes = {"Xgap.d": r.uniform(3e-6, 4e-6, 24), "Xgap.r": 1e6 * 10.0 ** r.uniform(-0.5, 0.5, 24)}
    check_all(recorded(8000.0, seed=seed), scenes, (1e-6,), ("f_el_mean",))


def test_a_dispersive_skin_states_its_error() -> None:
    circuit = recorded(8000.0, fs.parse_netlist(dispersive_deck()))
    check_all(circuit, people(cases(16, 6)), (1e-3,), in_lockstep=1.0 - 1e-9, rounding=0.0)


def test_threads_order_and_a_scene_without_contact_change_no_byte_of_the_others() -> None:
    scenes = people(70)
    scenes["Xgap.fn"][7] = 60.0
    found = alike(recorded(), scenes, outputs=RECORDED[: cases(3, 1)], t_stop=T_STOP)
    assert np.flatnonzero(found.status >= 2).tolist() == [7]


def test_a_turned_source_points_on_a_grid_and_a_constant_after_the_last_sample() -> None:
    scenes = people(16)
    volts = noise(1000.0)
    forward = fs.batch(recorded(), scenes, t_stop=T_STOP)["f_el_mean"]
    turned = fs.parse_netlist(table1_deck().replace("Vdrive drive 0", "Vdrive 0 drive"))
    turned = turned.replace({"Vdrive": fs.Samples(-volts, RATE)})
    # The layers stand in another order, and sums are rounded differently.
    np.testing.assert_allclose(fs.batch(turned, scenes, t_stop=T_STOP)["f_el_mean"], forward, rtol=1e-13)
    points = table1().replace({"Vdrive": fs.PWL(np.arange(COUNT) / RATE, volts)})
    found = fs.batch(points, scenes, t_stop=T_STOP)
    assert (found["status"] == 0).all()
    np.testing.assert_allclose(found["f_el_mean"], forward, rtol=1e-12)
    # Half of the run is after the recording.
    longer = fs.batch(recorded(), scenes, t_stop=2.0 * T_STOP, rtol=1e-6)
    run = fs.simulate(recorded().replace({p: float(v[3]) for p, v in scenes.items()}), t_stop=2.0 * T_STOP, rtol=1e-9)
    assert longer["f_el_mean"][3] == pytest.approx(run.f_el_mean, rel=1e-6)


def test_derivatives_are_those_of_single_runs() -> None:
    circuit = recorded()
    found = fs.batch(circuit, {"Xgap.d": [3e-6, 4e-6]}, t_stop=T_STOP, gradients=("Xgap.d",))
    assert found.attrs["ordinary_gradients"] == "the source is a recording"
    run = fs.simulate(circuit.replace({"Xgap.d": 4e-6}), t_stop=T_STOP, sensitivities=("Xgap.d",), charge=False)
    slope = run.sensitivities["Xgap.d"].f_el_mean
    assert found["d_f_el_mean"][1, 0] == pytest.approx(slope, rel=1e-3)


def test_what_lockstep_does_not_take_is_said() -> None:
    scenes = people(3)
    late = table1().replace({"Vdrive": fs.Samples(noise(1000.0), RATE, 1e-3)})
    found = fs.batch(late, scenes, t_stop=T_STOP)
    assert found.attrs["n_ordinary"] == 3
    assert found.attrs["ordinary"] == "the recording does not start at 0 s"
    found = fs.batch(recorded(), scenes, t_stop=T_STOP + 0.3 / RATE)
    assert "does not end after half periods or at a sample" in found.attrs["ordinary"]
    refuses("0 sources have a period", fs.batch, recorded(), scenes, periods=2.0)
