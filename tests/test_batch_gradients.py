"""`fs.batch(gradients=...)`, against fourth-order differences of single runs at 1e-12, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from batches import alike, population
from fingerspice.circuit.circuit import Circuit
from scenes import cases, refuses, shipped, table1

pytestmark = pytest.mark.filterwarnings("ignore:the gap voltage reaches")
# Relative step of the differences: truncation about 1e-12 of the force, rounding 1e-15 over the step.
STEP = 3e-4
WEIGHTS = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
ALLOWED = 10.0
"""Error allowed to a derivative, for a change by all of the parameter and relative to the output, in `rtol`."""
MEANS = ("f_el_mean", "f_t_mean", "friction_mean")
EVERY = (*MEANS, "area_mean")
THREE = {"Xgap.d": [2.5e-6, 3.5e-6, 5e-6], "Xgap.r": [3e5, 1e6, 4e6], "Vdrive.amplitude": [240.0, 150.0, 80.0]}
PATHS = ("Xgap.d", "Xgap.fn", "Xskin.d", "Xcoat.r", "Vdrive.amplitude")


def square(volts: float = 200.0, **how: Any) -> Circuit:
    return table1(**how).replace({"Vdrive": fs.Square(volts, 100.0)})


def expected(scene: Circuit, path: str, how: dict[str, Any]) -> dict[str, float]:
    """Change of the means for a change of a parameter by all of itself, from four runs."""
    total = dict.fromkeys(EVERY, 0.0)
    for k, weight in WEIGHTS.items():
        moved = {path: scene.parameters[path].value * (1.0 + k * STEP)}
        if how.get("skin") == "follow" and path == "Vdrive.frequency":
            moved["Xskin.f"] = moved[path]
        circuit = scene.varied(moved)
        if how.get("periodic"):
            found: Any = fs.steady_state(circuit, rtol=1e-12, charge=False)
        else:
            stop = how["periods"] / circuit.parameters["Vdrive.frequency"].value if "periods" in how else None
            found = fs.simulate(circuit, t_stop=stop, rtol=1e-12, charge=False)
        for name in EVERY:
            total[name] += weight * float(getattr(found, name)) / (12.0 * STEP)
    return total


TWO, CLOCK = {"Xgap.d": [3e-6, 4e-6]}, ("Vdrive.frequency", "Xgap.d")
OWN, FOLLOWED = ("Xgap.d", "Xcoat.r"), {"Vdrive.frequency": [80.0, 400.0]}
BY_TURNS, FOLLOW, PERIODIC = {"periods": 3}, {"periods": 3, "skin": "follow"}, {"periodic": True}
MOBILE = {"library": "fingerspice_mobile.lib"}
DISPERSIVE = shipped("fingerpad_dispersive")
# Status, circuit, parameters of its scenes, paths, `rtol`, and how they run.
CASES: dict[str, tuple[Any, ...]] = {
    "sine": (0, table1(), THREE, PATHS, (1e-4, 1e-6), BY_TURNS),
    "square": (0, square(), THREE, PATHS, (1e-4, 1e-6), BY_TURNS),
    # The frequency of a square moves its jumps, and those of a period in proportion to it.
    "square's frequency": (0, square(), THREE, CLOCK[:1], (1e-5,), BY_TURNS),
    "periodic": (0, table1(), THREE, (*OWN, "Vdrive.frequency"), (1e-5,), PERIODIC),
    "periodic square": (0, square(), THREE, (*OWN, "Vdrive.frequency"), (1e-5,), PERIODIC),
    "dispersive skin": (0, DISPERSIVE, TWO, ("Xgap.d", "Xgap.r", "Xskin.d"), (1e-5,), {}),
    # The frequency moves the end of a run whose length is in periods, and a skin that follows it.
    "frequency": (0, table1(), THREE, CLOCK, (1e-5,), {"periods": 2.5}),
    "frequency, alone": (1, table1(), THREE, CLOCK, (1e-9,), {"periods": 2.5}),
    "frequency, of the deck": (1, table1(), THREE, CLOCK, (1e-5,), {}),
    "followed": (0, table1(), FOLLOWED, CLOCK, (1e-5,), FOLLOW),
    "followed, alone": (1, table1(), FOLLOWED, CLOCK, (1e-9,), FOLLOW),
}  # fmt: skip
for kind in ("sine", "square"):
    for law in ({}, MOBILE):
        one = table1(**law) if kind == "sine" else square(150.0, **law)
        for how in ({}, PERIODIC):
            CASES[f"fine {kind} {law} {how}"] = (1, one, TWO, OWN, (1e-10,), {"outputs": EVERY, **how})


@pytest.mark.parametrize(("status", "circuit", "parameters", "paths", "rtols", "how"), CASES.values(), ids=CASES)
def test_derivatives_have_the_errors_allowed_and_stated(status, circuit, parameters, paths, rtols, how):
    how = {"outputs": MEANS, **how}
    n = len(next(iter(parameters.values())))
    scenes = [circuit.varied({path: values[i] for path, values in parameters.items()}) for i in range(n)]
    if how.get("skin") == "follow":
        scenes = [scene.varied({"Xskin.f": scene.parameters["Vdrive.frequency"].value}) for scene in scenes]
    right = [[expected(scene, path, how) for path in paths] for scene in scenes]
    for rtol in rtols:
        found = fs.batch(circuit, parameters, gradients=paths, rtol=rtol, **how)
        assert found.gradient_status.values.tolist() == [status] * n
        for i, scene in enumerate(scenes):
            for path, changes in zip(paths, right[i], strict=True):
                for name in how["outputs"]:
                    one = float(found[f"d_{name}"].sel(parameter=path)[i]) * scene.parameters[path].value
                    off = abs(one - changes[name]) / float(found[name][i])
                    assert off <= min(ALLOWED * rtol, max(float(found.gradient_error[i]), 1e-9)), (i, path, name, off)


def test_the_stated_error_of_a_wide_population_holds() -> None:
    parameters = population(cases(40, 20), seed=7)
    del parameters["Xcoat.r"]
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
    found = alike(table1(), parameters, periods=2, rtol=1e-5, gradients=("Xgap.d", "Xgap.fn"))
    assert found.f_el_mean.values.tobytes() == plain.f_el_mean.values.tobytes()


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


def test_two_fingers_are_refused() -> None:
    two = shipped("two_fingers")
    gap = two.by_device("GAP")[0].name
    refuses("the circuit has 2 GAPs", fs.batch, two, {f"{gap}.d": [3e-6]}, gradients=(f"{gap}.d",))


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
