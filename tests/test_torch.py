"""`fs.torch.Simulator`: derivatives against differences and torchdiffeq, every way of torch to them, shapes, errors."""

import copy
import runpy
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from scenes import cases, listed, refuses, shipped, table1

torch = pytest.importorskip("torch", reason="torch is not installed: pip install '.[test]'")

# What torch itself does when its forward mode is first used.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

ROOT = Path(__file__).parents[1]
CIRCUITS = ROOT / "circuits"
T_STOP, TIMES = 0.012, (0.0013, 0.0071, 0.011)
# Values about which scenes vary, and shares of them: two scenes with three parameters each.
MIDDLE = {"Xgap.d": 3.5e-6, "Xgap.r": 1e6, "Vdrive.amplitude": 200.0}
SHARES = ((1.0, 1.1, 0.9), (1.2, 0.8, 1.0))


def by_shares(simulator: Any) -> Any:
    """The outputs as a function of shares of `MIDDLE`, shape (..., 3)."""
    return lambda shares: simulator({path: value * shares[..., i] for i, (path, value) in enumerate(MIDDLE.items())})


@pytest.fixture
def shares() -> Any:
    return torch.tensor(SHARES, dtype=torch.float64)


@pytest.fixture
def means() -> Any:
    outputs = ("f_el_mean", "area_mean")
    run = by_shares(fs.torch.Simulator(table1(), (), outputs, t_stop=T_STOP, rtol=1e-9))
    return lambda shares: run(shares)["f_el_mean"]


# Of runs one by one, which take long, one scene.
@pytest.mark.parametrize(
    ("outputs", "how"),
    [
        (("u_gap", "f_el_mean", "f_t"), {"t": TIMES, "t_stop": T_STOP}),
        # Values come from lockstep, and slopes from runs.
        (("area_mean", "f_el_mean"), {"t_stop": 0.02}),
    ],
    ids=["runs", "batch"],
)
@pytest.mark.parametrize("periodic", [False, True])
def test_gradcheck_backward_and_forward(shares, periodic, outputs, how):
    run = by_shares(fs.torch.Simulator(table1(), (), outputs, periodic=periodic, rtol=1e-9, **how))
    batched = "t" in how
    shares = shares[:1] if batched else shares
    checked = [name for name in outputs if name in ("f_el_mean", "u_gap")]
    sizes = {name: float(run(shares)[name].abs().max()) for name in checked}

    def relative(shares: Any) -> tuple[Any, ...]:
        found = run(shares)
        return tuple(found[name] / sizes[name] for name in checked)

    torch.autograd.gradcheck(
        relative, (shares.requires_grad_(),), eps=1e-4, atol=1e-6, rtol=1e-6,
        check_forward_ad=True, check_batched_grad=batched, check_batched_forward_grad=batched,
    )  # fmt: skip


def test_every_transform_of_torch_gives_the_same(means: Any, shares: Any) -> None:
    func = torch.func
    values = torch.stack([means(one) for one in shares])
    assert torch.equal(func.vmap(means)(shares), values)
    assert torch.equal(func.vmap(means, in_dims=1)(shares.T), values)
    assert torch.equal(func.vmap(func.vmap(means))(shares.expand(2, 2, 3)), values.expand(2, 2))
    by = torch.stack([torch.autograd.functional.jacobian(means, one) for one in shares])
    assert torch.equal(func.vmap(func.grad(means))(shares), by)
    assert torch.equal(func.vmap(func.jacfwd(means))(shares), by)
    assert torch.equal(func.jacrev(func.vmap(means))(shares)[[0, 1], [0, 1]], by)
    _, moved = func.jvp(means, (shares,), (torch.ones_like(shares),))
    torch.testing.assert_close(moved, by.sum(-1), rtol=1e-14, atol=0.0)


def test_vmap_over_some_of_the_values_only() -> None:
    simulator = fs.torch.Simulator(table1(), ("Xgap.r",), t_stop=T_STOP, rtol=1e-6)
    thickness = torch.tensor([3e-6, 3.5e-6, 4e-6], dtype=torch.float64)
    mapped = torch.func.vmap(lambda d: simulator({"Xgap.d": d, "Vdrive.amplitude": 150.0}))(thickness)
    assert torch.equal(mapped, simulator({"Xgap.d": thickness, "Vdrive.amplitude": 150.0}))


# The last is the first by another way to the derivatives in torchdiffeq.
REFERENCES = (("local", "square", False), ("mobile", "sine", False), ("local", "square", True))


@pytest.mark.parametrize(("law", "source", "adjoint"), REFERENCES[: cases(3, 2)])
def test_the_same_model_in_torchdiffeq_agrees(law: str, source: str, adjoint: bool) -> None:
    pytest.importorskip("torchdiffeq", reason="torchdiffeq is not installed: pip install '.[test]'")
    import torch_reference

    paths = ("Xgap.d", "Xgap.r", "Xgap.alpha", "Xgap.m_exp", "Xcoat.d", "Xskin.f", "Vdrive.amplitude")
    word = {"sine": "SIN(0 200 100)", "square": "SQUARE(200 100)"}[source]
    circuit = table1(word, library="fingerspice.lib" if law == "local" else "fingerspice_mobile.lib")
    # One edge of the square lies between the times.
    stop = 0.0062 if source == "square" else 0.0021
    t = torch.linspace(0.0, stop, 31, dtype=torch.float64)
    simulator = fs.torch.Simulator(circuit, paths, ("u_gap", "f_el_mean"), t=t, t_stop=stop, rtol=1e-9)
    ours = simulator()
    values = {
        path: torch.tensor(one.value, dtype=torch.float64, requires_grad=path in paths)
        for path, one in circuit.parameters.items()
    }
    finger = torch_reference.Finger(values, getattr(torch_reference, source), law)
    jumps = torch_reference.edges(stop, values) if source == "square" else None
    u, force = finger.run(t, adjoint=adjoint, jumps=jumps)
    torch.testing.assert_close(u, ours["u_gap"], rtol=0.0, atol=2e-7 * 200.0)
    assert float(force.detach()) == pytest.approx(float(ours["f_el_mean"].detach()), rel=2e-7)

    def slopes(u: Any, force: Any, by: Any) -> Any:
        return torch.stack(torch.autograd.grad(force + 1e-3 * u[14] - 2e-3 * u[30], by))

    scale = torch.stack([values[path].detach() for path in paths])
    theirs = slopes(u, force, [values[path] for path in paths]) * scale
    mine = slopes(ours["u_gap"], ours["f_el_mean"], list(simulator.parameters())) * scale
    torch.testing.assert_close(mine, theirs, rtol=0.0, atol=1e-6 * float(theirs.abs().max()))


def test_shapes_and_names() -> None:
    given = {"source.amplitude": [[100.0], [200.0]], "xgap.d": [3e-6, 3.5e-6, 4e-6]}
    simulator = fs.torch.Simulator(table1(), given, ("f_el", "f_el_mean"), t=TIMES, t_stop=T_STOP, rtol=1e-4)
    assert [name for name, _ in simulator.named_parameters()] == ["Vdrive_amplitude", "Xgap_d"]
    assert all(one.dtype == torch.float64 for one in simulator.parameters())
    assert str(simulator) == "Simulator(Vdrive.amplitude, Xgap.d -> f_el, f_el_mean)"
    found = simulator()
    assert list(found) == ["f_el", "f_el_mean"]
    assert (found["f_el"].shape, found["f_el_mean"].shape) == ((2, 3, 3), (2, 3))
    found["f_el_mean"].sum().backward()
    assert simulator.Vdrive_amplitude.grad.shape == (2, 1)
    assert simulator.Xgap_d.grad.shape == (3,)
    one = fs.torch.Simulator(table1(), ("Xgap.d",), "f_el", t=TIMES, t_stop=T_STOP, rtol=1e-4)
    assert one().shape == (3,)
    np.testing.assert_allclose(one().detach(), found["f_el"][1, 1].detach(), rtol=1e-3)
    other = copy.deepcopy(one)
    other.load_state_dict({"Xgap_d": torch.tensor(3e-6, dtype=torch.float64)})
    assert torch.equal(other(), one({"Xgap.d": 3e-6}))
    assert one({"Xgap.d": torch.tensor(3e-6, dtype=torch.float32)}).dtype == torch.float64


def test_values_of_the_call_go_before_those_of_the_module_and_need_no_derivative() -> None:
    simulator = fs.torch.Simulator(table1("SQUARE(200 100)"), ("Xgap.d",), t_stop=T_STOP, rtol=1e-6)
    # The frequency of a square has no derivative; here it is only a condition.
    frequency = torch.tensor([100.0, 200.0], dtype=torch.float64)
    simulator({"Vdrive.frequency": frequency}).sum().backward()
    assert simulator.Xgap_d.grad is not None
    d = torch.tensor(3e-6, dtype=torch.float64, requires_grad=True)
    before = simulator.Xgap_d.grad.clone()
    simulator({"Xgap.d": d}).backward()
    assert torch.equal(simulator.Xgap_d.grad, before)
    assert d.grad is not None


def test_one_tensor_for_two_parameters_adds_their_derivatives() -> None:
    simulator = fs.torch.Simulator(table1(), (), t_stop=T_STOP, rtol=1e-9)
    f = torch.tensor(130.0, dtype=torch.float64, requires_grad=True)
    (both,) = torch.autograd.grad(simulator({"Vdrive.frequency": f, "Xskin.f": f}), f)
    parts = [torch.autograd.grad(simulator({"Vdrive.frequency": f + 0.0 * f.detach(), "Xskin.f": f.detach()}), f)[0],
             torch.autograd.grad(simulator({"Vdrive.frequency": f.detach(), "Xskin.f": f}), f)[0]]  # fmt: skip
    torch.testing.assert_close(both, parts[0] + parts[1], rtol=1e-12, atol=0.0)
    assert all(float(part) != 0.0 for part in parts)


def test_logarithms() -> None:
    plain = fs.torch.Simulator(table1(), ("Xgap.d",), t_stop=T_STOP, rtol=1e-8)
    log = fs.torch.Simulator(table1(), ("Xgap.d",), t_stop=T_STOP, rtol=1e-8, logarithms=True)
    assert float(log.value("xgap.d").detach()) == pytest.approx(3.5e-6, rel=1e-14)
    for one in (plain, log):
        one().backward()
    assert float(log.Xgap_d.grad) == pytest.approx(float(plain.Xgap_d.grad) * 3.5e-6, rel=1e-9)


def test_a_batch_of_means_goes_in_lockstep(monkeypatch: pytest.MonkeyPatch) -> None:
    def alone(*_: Any, **__: Any) -> None:
        raise AssertionError("a scene was run by itself")

    monkeypatch.setattr("fingerspice.torch.simulate", alone)
    simulator = fs.torch.Simulator(table1(), {"Xgap.d": np.linspace(3e-6, 4e-6, 1000)}, rtol=1e-4)
    assert simulator().shape == (1000,)


def test_no_warning_about_values_that_an_optimiser_chooses() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fs.torch.Simulator(table1(), {"Xgap.d": 0.1}, "u_gap", t=TIMES, t_stop=T_STOP)()


@pytest.mark.parametrize(("arguments", "how", "text"), listed("simulators"))
def test_refused_when_it_is_made(arguments: tuple[Any, ...], how: dict[str, Any], text: str) -> None:
    refuses(text, fs.torch.Simulator, table1(), *arguments, **how)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        *listed("scenes_of_simulators"),
        ({"Xgap.d": 3e-6 + 1j}, "Xgap.d is .*; allowed: a tensor or array of numbers"),
        ({"Xgap.d": torch.tensor(1j)}, "Xgap.d is a tensor of torch.complex64; allowed: real numbers"),
    ],
)
def test_refused_when_it_is_called(values: dict[str, Any], text: str) -> None:
    refuses(text, fs.torch.Simulator(table1(), (), t_stop=T_STOP), values)


def test_the_scene_that_cannot_be_run_is_named() -> None:
    simulator = fs.torch.Simulator(table1(), {"Xgap.mu": [0.3, 50.0]}, "u_gap", t=TIMES, t_stop=T_STOP)
    refuses(r"scene 1: .*no contact", simulator)
    zero = fs.torch.Simulator(table1(), ("Vdrive.offset",), t_stop=T_STOP)
    refuses(r"scene 0: .*Vdrive.offset, which is 0; allowed", zero().backward)


def test_second_derivatives_are_refused(means: Any, shares: Any) -> None:
    refuses("second derivatives", torch.func.hessian(means), shares[0])
    shares.requires_grad_()
    (first,) = torch.autograd.grad(means(shares).sum(), shares, create_graph=True)
    refuses("second derivatives", first.sum().backward)


def test_what_is_no_finger_is_refused() -> None:
    refuses("the circuit has 2 GAPs", fs.torch.Simulator, shipped("two_fingers"))
    refuses("the circuit is a str", fs.torch.Simulator, "fingerpad.cir")


def test_it_is_loaded_on_request_only_and_says_where_torch_is_missing() -> None:
    code = """
import sys
import fingerspice as fs
assert "torch" not in sys.modules and "torch" not in dir(fs)
sys.modules["torch"] = None
try:
    fs.torch
except fs.InputError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "fingerspice.torch needs torch, which is not installed; pip install 'fingerspice[torch]'\n"


def test_the_example_learns_a_drive() -> None:
    script = runpy.run_path(str(CIRCUITS / "learned_drive.py"))
    module = script["simulator"]()
    deviations = script["learn"](module, 20)
    assert deviations[-1] < 0.66 * deviations[0]
    # Where 150 steps lead.
    found = [getattr(module, f"V{k}_amplitude").item() for k in (1, 3, 5, 7)]
    assert found == pytest.approx([169.4, 47.8, 24.8, 15.1], rel=0.1)


def samples_of(rows: int = 1) -> torch.Tensor:
    t = np.arange(200) / 20_000.0
    phases = np.arange(rows)[:, None]
    return torch.from_numpy(80.0 + 60.0 * np.sin(2.0 * np.pi * 300.0 * t + phases)).squeeze(0)


def test_gradcheck_by_every_sample_of_a_drive() -> None:
    t = np.linspace(1e-3, 9e-3, 5)
    drive = fs.torch.Drive(table1(), samples_of(), 20e3, ("f_t", "friction_mean"), t=t, t_stop=9.9e-3, rtol=1e-10)
    chosen = torch.tensor([0, 17, 100, 198])

    def run(few: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = drive(drive.samples.detach().index_copy(0, chosen, few))
        return found["f_t"], found["friction_mean"]

    few = drive.samples.detach()[chosen].requires_grad_()
    assert torch.autograd.gradcheck(run, (few,), eps=1e-3, atol=1e-9, rtol=1e-6)


def test_several_drives_are_runs_of_their_own() -> None:
    volts = samples_of(3)
    drive = fs.torch.Drive(table1(), volts, 20e3, t_stop=9e-3)
    force = drive()
    assert force.shape == (3,)
    force.sum().backward()
    for i, row in enumerate(volts.numpy()):
        run = fs.simulate(table1(), sources=fs.Samples(row, 20e3), t_stop=9e-3, t_eval=[9e-3], charge=False)
        assert force[i].item() == run.f_el_mean
        np.testing.assert_array_equal(drive.samples.grad[i], run.sample_gradient(f_el_mean=1.0).values)


def test_a_drive_that_cannot_be_run_is_named() -> None:
    drive = fs.torch.Drive(table1(), samples_of(2), 20e3, t_stop=9e-3)
    bad = samples_of(2)
    bad[1, 3] = np.nan
    refuses("drive 1: sample number 3 is nan", drive, bad)
    refuses("source is 'Vother'; allowed: one of Vdrive", fs.torch.Drive, table1(), samples_of(), 20e3, source="Vother")
    refuses("unknown output 'force'", fs.torch.Drive, table1(), samples_of(), 20e3, "force")
