"""Recordings in lockstep: against single runs, in wide populations, for any threads, order and bad scenes."""

from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

import fingerspice as fs
from batches import alike, check, singly
from fingerspice.base.errors import InputError
from scenes import cases, dispersive_deck, table1, table1_deck

RATE, COUNT = 48_000.0, 961
T_STOP = (COUNT - 1) / RATE
OUTPUTS = ("f_el_mean", "f_t_rms", "u_gap_rms")


def noise(highest: float, peak: float = 150.0, seed: int = 1) -> np.ndarray:
    band = butter(4, [50.0, highest], "band", fs=RATE, output="sos")
    x = sosfilt(band, np.random.default_rng(seed).standard_normal(COUNT))
    x[0] = 0.0
    return peak * x / np.abs(x).max()


def recorded(highest: float = 1000.0, circuit: fs.Circuit | None = None, **how: Any) -> fs.Circuit:
    return (circuit or table1()).replace({"Vdrive": fs.Samples(noise(highest, **how), RATE)})


def people(n: int, seed: int = 2) -> dict[str, np.ndarray]:
    """Fingers whose resistances vary over two decades."""
    r = np.random.default_rng(seed)
    return {
        "Xgap.d": r.uniform(2e-6, 6e-6, n),
        "Xgap.r": 1e6 * 10.0 ** r.uniform(-1.0, 1.0, n),
        "Xcoat.r": 2e5 * 10.0 ** r.uniform(-1.0, 1.0, n),
        "Xgap.fn": r.uniform(0.2, 2.0, n),
    }


def check_all(
    circuit: fs.Circuit, scenes: dict[str, np.ndarray], rtols: tuple[float, ...], outputs: tuple[str, ...] = OUTPUTS,
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
    check_all(recorded(highest), people(cases(40, 20)), rtols, OUTPUTS[: cases(3, 1)], in_lockstep=0.9)


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
    found = alike(recorded(), scenes, outputs=OUTPUTS[: cases(3, 1)], t_stop=T_STOP)
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
    with pytest.raises(InputError, match="0 sources have a period"):
        fs.batch(recorded(), scenes, periods=2.0)
