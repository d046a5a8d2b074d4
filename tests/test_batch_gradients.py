"""`fs.batch(gradients=...)`, against fourth-order differences of single runs at 1e-12, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.circuit.circuit import Circuit
from scenes import cases, table1

pytestmark = pytest.mark.filterwarnings("ignore:the gap voltage reaches")
CIRCUITS = Path(__file__).parents[1] / "circuits"
# Relative step of the differences: truncation about 1e-12 of the force, rounding 1e-15 over the step.
STEP = 3e-4
WEIGHTS = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
ALLOWED = 10.0
"""Error allowed to a derivative, for a change by all of the parameter and relative to the output, in `rtol`."""
MEANS = ("f_el_mean", "f_t_mean", "friction_mean")
THREE = {"Xgap.d": [2.5e-6, 3.5e-6, 5e-6], "Xgap.r": [3e5, 1e6, 4e6], "Vdrive.amplitude": [240.0, 150.0, 80.0]}
PATHS = ("Xgap.d", "Xgap.fn", "Xskin.d", "Xcoat.r", "Vdrive.amplitude")


def square(f: float = 100.0) -> Circuit:
    return table1().replace({"Vdrive": fs.Square(200.0, f)})


def over_periods(periods: float) -> Callable[[Circuit], Any]:
    """A run over a number of periods of its own source."""
    return lambda c: fs.simulate(c, t_stop=periods / c.parameters["Vdrive.frequency"].value, rtol=1e-12, charge=False)


def of_deck(circuit: Circuit) -> Any:
    return fs.simulate(circuit, rtol=1e-12, charge=False)


def periodic(circuit: Circuit) -> Any:
    return fs.steady_state(circuit, rtol=1e-12, charge=False)


def expected(scene: Circuit, path: str, run: Callable[[Circuit], Any], follow: bool = False) -> dict[str, float]:
    """Change of the means for a change of a parameter by all of itself, from four runs."""
    total: dict[str, float] = {}
    for k, weight in WEIGHTS.items():
        value = scene.parameters[path].value * (1.0 + k * STEP)
        found = run(scene.varied({path: value, **({"Xskin.f": value} if follow else {})}))
        for name in (*MEANS, "area_mean"):
            total[name] = total.get(name, 0.0) + weight * float(getattr(found, name)) / (12.0 * STEP)
    return total


def check(
    circuit: Circuit, parameters: dict[str, Any], paths: tuple[str, ...], rtol: float, run: Callable[[Circuit], Any],
    outputs: tuple[str, ...] = MEANS, status: int = 0, **how: Any,
) -> None:  # fmt: skip
    """Every derivative is within the error allowed, and within the error stated."""
    found = fs.batch(circuit, parameters, outputs=outputs, gradients=paths, rtol=rtol, **how)
    assert found.gradient_status.values.tolist() == [status] * found.sizes["scene"]
    for i in range(found.sizes["scene"]):
        scene = circuit.varied({path: float(found[path][i]) for path in parameters})
        if how.get("skin") == "follow":
            scene = scene.varied({"Xskin.f": scene.parameters["Vdrive.frequency"].value})
        for path in paths:
            right = expected(scene, path, run, follow=how.get("skin") == "follow" and path == "Vdrive.frequency")
            for name in outputs:
                one = float(found[f"d_{name}"].sel(parameter=path)[i]) * scene.parameters[path].value
                off = abs(one - right[name]) / float(found[name][i])
                assert off <= min(ALLOWED * rtol, max(float(found.gradient_error[i]), 1e-9)), (i, path, name, off)


@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
@pytest.mark.parametrize("circuit", [table1(), square()], ids=["sine", "square"])
def test_derivatives_in_lockstep_are_those_of_single_runs(circuit: Circuit, rtol: float) -> None:
    check(circuit, THREE, PATHS, rtol, over_periods(3), periods=3)


@pytest.mark.parametrize("circuit", [table1(), square()], ids=["sine", "square"])
def test_derivatives_of_the_periodic_state(circuit: Circuit) -> None:
    # The frequency of a square moves its jumps, and those of a period in proportion to it.
    check(circuit, THREE, ("Xgap.d", "Xcoat.r", "Vdrive.frequency"), 1e-5, periodic, periodic=True)


def test_a_dispersive_skin() -> None:
    circuit = fs.read_netlist(CIRCUITS / "fingerpad_dispersive.cir")
    check(circuit, {"Xgap.d": [3e-6, 4e-6]}, ("Xgap.d", "Xgap.r", "Xskin.d"), 1e-5, of_deck)


@pytest.mark.parametrize("how", [{"periods": 2.5}, {"periods": 2.5, "rtol": 1e-9}, {}], ids=["lockstep", "one", "deck"])
def test_the_frequency_moves_the_end_of_a_run_whose_length_is_in_periods(how: dict[str, Any]) -> None:
    run = over_periods(2.5) if "periods" in how else of_deck
    rtol, status = how.get("rtol", 1e-5), 0 if how == {"periods": 2.5} else 1
    more = {key: value for key, value in how.items() if key != "rtol"}
    check(table1(), THREE, ("Vdrive.frequency", "Xgap.d"), rtol, run, status=status, **more)


@pytest.mark.parametrize("rtol", [1e-5, 1e-9])
def test_a_skin_that_follows_the_frequency_is_moved_with_it(rtol: float) -> None:
    parameters = {"Vdrive.frequency": [80.0, 400.0]}
    status = 0 if rtol == 1e-5 else 1
    check(table1(), parameters, ("Vdrive.frequency", "Xgap.d"), rtol, over_periods(3),
          status=status, periods=3, skin="follow")  # fmt: skip


@pytest.mark.parametrize("deck", ["fingerspice.lib", "fingerspice_mobile.lib"])
@pytest.mark.parametrize("shape", ["sine", "square"])
def test_derivatives_of_scenes_one_by_one_at_a_fine_error(deck: str, shape: str) -> None:
    circuit = table1(library=deck)
    if shape == "square":
        circuit = circuit.replace({"Vdrive": fs.Square(150.0, 100.0)})
    outputs = (*MEANS, "area_mean")
    for run, how in ((of_deck, {}), (periodic, {"periodic": True})):
        check(circuit, {"Xgap.d": [3e-6, 4e-6]}, ("Xgap.d", "Xcoat.r"), 1e-10, run, outputs, status=1, **how)


def test_the_stated_error_of_a_wide_population_holds() -> None:
    rng, n = np.random.default_rng(7), cases(40, 20)
    parameters = {
        "Vdrive.frequency": 10.0 ** rng.uniform(np.log10(20.0), 4.0, n),
        "Vdrive.amplitude": rng.uniform(50.0, 300.0, n),
        "Xgap.r": 1e6 * 10.0 ** rng.uniform(-1.0, 1.0, n),
        "Xgap.fn": rng.uniform(0.1, 2.0, n),
        "Xgap.d": rng.uniform(2e-6, 6e-6, n),
    }
    paths = tuple(parameters)
    size = np.stack(list(parameters.values()), axis=1)
    right = fs.batch(table1(), parameters, gradients=paths, periods=3, skin="follow", rtol=1e-10)
    assert np.all(right.gradient_status == 1)
    for rtol in (1e-3, 1e-4, 1e-6):
        found = fs.batch(table1(), parameters, gradients=paths, periods=3, skin="follow", rtol=rtol)
        off = np.abs((found.d_f_el_mean - right.d_f_el_mean).values * size / right.f_el_mean.values[:, None]).max(
            axis=1
        )
        assert off.max() <= ALLOWED * rtol
        assert found.gradient_error.max() <= ALLOWED * rtol
        assert np.mean(off <= found.gradient_error.values) >= 0.9
        assert np.all(found.gradient_status == 0)


def test_means_are_the_same_bytes_with_gradients_and_all_the_same_for_any_threads_and_order() -> None:
    rng, n = np.random.default_rng(5), 700
    parameters = {"Xgap.d": rng.uniform(3e-6, 4e-6, n), "Xgap.r": 1e6 * 10.0 ** rng.uniform(-1.0, 1.0, n)}
    plain = fs.batch(table1(), parameters, periods=2, rtol=1e-5)

    def run(threads: int, order: np.ndarray) -> list[bytes]:
        some = {path: values[order] for path, values in parameters.items()}
        found = fs.batch(table1(), some, periods=2, rtol=1e-5, gradients=("Xgap.d", "Xgap.fn"), threads=threads)
        back = np.argsort(order)
        assert found.f_el_mean.values[back].tobytes() == plain.f_el_mean.values.tobytes()
        return [found[name].values[back].tobytes() for name in ("d_f_el_mean", "gradient_error", "gradient_status")]

    first = run(1, np.arange(n))
    assert run(2, np.arange(n)) == first
    assert run(3, rng.permutation(n)) == first


def test_a_scene_without_a_result_has_none_and_costs_the_others_nothing() -> None:
    good = fs.batch(table1(), {"Vdrive.amplitude": [200.0, 100.0]}, gradients=("Xgap.d", "Vdrive.amplitude"), periods=1)
    volts = {"Vdrive.amplitude": [200.0, 0.0, 100.0]}
    found = fs.batch(table1(), volts, gradients=("Xgap.d", "Vdrive.amplitude"), periods=1)
    assert found.status.values.tolist() == [0, 0, 0]
    assert found.gradient_status.values.tolist() == [0, 2, 0]
    assert np.all(np.isnan(found.d_f_el_mean[1]))
    assert "scene 1: gradients: sensitivities names Vdrive.amplitude, which is 0" in found.attrs["failures"][0]
    np.testing.assert_array_equal(found.d_f_el_mean[[0, 2]], good.d_f_el_mean)
    assert found.attrs["n_ordinary_gradients"] == 1
    refused = fs.batch(table1(), {"Xgap.c2": [1e-3, 1e6]}, gradients=("Xgap.d",), periods=1)
    assert refused.status.values.tolist() == refused.gradient_status.values.tolist() == [0, 2]
    # What has no outputs is not run again for its derivatives.
    assert len(refused.attrs["failures"]) == 1
    assert "gradients" not in refused.attrs["failures"][0]


def test_the_frequency_of_a_square_is_refused_where_it_moves_the_edges_of_a_run_of_fixed_length() -> None:
    found = fs.batch(square(), {"Xgap.d": [3e-6]}, gradients=("Vdrive.frequency",))
    assert found.status.values.tolist() == [0]
    assert found.gradient_status.values.tolist() == [2]
    assert "moves the edges of its source" in found.attrs["failures"][0]
    assert "changes the number of periods" in found.attrs["ordinary_gradients"]
    check(square(), THREE, ("Vdrive.frequency",), 1e-5, over_periods(3), periods=3)


def test_the_dataset_says_what_it_holds(tmp_path: Path) -> None:
    found = fs.batch(
        table1(), {"Xgap.d": [3e-6, 4e-6]}, gradients=("xgap.d", "source.amplitude"), periods=1,
        outputs=("f_el_mean", "f_el_rms"),
    )  # fmt: skip
    assert found.d_f_el_mean.dims == ("scene", "parameter")
    assert found.parameter.values.tolist() == ["Xgap.d", "Vdrive.amplitude"]
    assert found.parameter_unit.values.tolist() == ["m", "V"]
    assert found.d_f_el_mean.attrs["units"] == "N per parameter_unit"
    assert "d_f_el_rms" not in found
    found.to_netcdf(tmp_path / "batch.nc", engine="h5netcdf")


@pytest.mark.parametrize(
    ("gradients", "options", "message"),
    [
        (("Xgap.dd",), {}, "unknown parameter 'Xgap.dd'; nearest: 'Xgap.d'"),
        ("Xgap.d", {}, "a sequence of paths"),
        (("Xgap.d", "xgap.d"), {}, "every parameter once"),
        (("Xgap.tau",), {}, "Xgap.tau, which is 0"),
        (("Vdrive.phase_deg",), {}, "Vdrive.phase_deg, which is 0"),
        (("Xgap.d",), {"outputs": ("f_el_rms",)}, "outputs has no mean"),
        (("Xskin.f",), {"skin": "follow"}, "with which the skin's frequency changes"),
    ],
)
def test_bad_input_is_refused_in_one_sentence(gradients: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(fs.InputError, match=message):
        fs.batch(table1(), {"Xgap.r": [1e6]}, gradients=gradients, periods=1, **options)


def test_points_at_uneven_times_have_them() -> None:
    t = np.linspace(0.0, 0.05, 701)
    times = np.sort(np.append(t, t[:-1] + 0.3 * np.diff(t)))
    v = 150.0 * np.sin(2.0 * np.pi * 150.0 * times)
    circuit = table1().replace({"Vdrive": fs.PWL(times, v)})
    check(circuit, {"Xgap.d": [3e-6]}, ("Xgap.d", "Xgap.r"), 1e-5, of_deck, status=1)


def test_two_fingers_are_refused() -> None:
    two = fs.read_netlist(CIRCUITS / "two_fingers.cir")
    gap = two.by_device("GAP")[0].name
    with pytest.raises(fs.InputError, match="the circuit has 2 GAPs"):
        fs.batch(two, {f"{gap}.d": [3e-6]}, gradients=(f"{gap}.d",))


@pytest.mark.parametrize("periodic", [False, True])
def test_the_torch_module_has_them_for_many_scenes_and_for_each_alone(periodic: bool) -> None:
    torch = pytest.importorskip("torch")
    rng, rtol = np.random.default_rng(4), 1e-6
    values = {"Xgap.d": torch.tensor(rng.uniform(3e-6, 4e-6, 20)), "Xgap.r": torch.tensor(rng.uniform(5e5, 2e6, 20))}

    def slopes(rtol: float, some: slice) -> Any:
        given = {path: one[some].clone().requires_grad_() for path, one in values.items()}
        means = fs.torch.Simulator(table1(), (), periodic=periodic, t_stop=0.05, rtol=rtol)(given)
        means.sum().backward()
        return torch.stack([one.grad * one.detach() / means.detach() for one in given.values()])

    many = slopes(rtol, slice(None))
    assert torch.equal(many[:, 7:8], slopes(rtol, slice(7, 8)))
    assert float((many - slopes(1e-10, slice(None))).abs().max()) <= ALLOWED * rtol


@pytest.mark.parametrize("average", ["periodic", "run"])
def test_a_fit_by_batches_is_the_fit_by_single_runs(average: str) -> None:
    rng, fingers = np.random.default_rng(8), {"thumb": 3.2e-6, "index": 3.8e-6}
    rows = [(name, u, f) for name in fingers for u in (100.0, 200.0)[-cases(2, 1) :] for f in (100.0, 200.0, 1000.0)]
    columns = {
        "finger": [r[0] for r in rows],
        "Vdrive.amplitude": [r[1] for r in rows],
        "Vdrive.frequency": [r[2] for r in rows],
    }
    truth = {
        **{k: v for k, v in columns.items() if k != "finger"},
        "Xgap.d": [fingers[r[0]] for r in rows],
        "Xgap.r": 1.3e6,
    }
    force = fs.batch(table1(), truth, rtol=1e-8, periodic=average == "periodic", skin="follow").f_el_mean.values
    data = {**columns, "f_el_mean": force * (1.0 + 0.02 * rng.standard_normal(len(rows)))}

    def fitted(law: str | None) -> fs.Fit:
        # A charge law that is named is for `simulate`, and so for single runs.
        return fs.fit(
            table1(), data, ["Xgap.d", "Xgap.r"], groups={"finger": ["Xgap.d"]}, average=average, skin="follow",
            starts=1, charge_law=law, rtol=1e-6,
        )  # fmt: skip

    batches, singles = fitted(None), fitted("local")
    for name, one in singles.estimates.items():
        assert abs(batches.estimates[name].value - one.value) <= 1e-3 * one.error
        assert batches.estimates[name].error == pytest.approx(one.error, rel=1e-3)
