"""`fs.batch` on a graphics card: its kernel in numba's simulator and compiled for a card, and what is refused."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.engine.lockstep import card
from fingerspice.engine.lockstep.card import thread_kernel
from scenes import cases, refuses

ROOT = Path(__file__).resolve().parents[1]
Simulated = dict[str, dict[str, Any]]

CODE = """
import json, sys
import numpy as np
import fingerspice as fs
answers = []
for deck, request in json.loads(sys.argv[1]):
    circuit = fs.read_netlist(deck)
    if "drive" in request:
        circuit = circuit.replace({"Vdrive": request.pop("drive")})
    scenes = {path: np.array(values) for path, values in request.pop("scenes").items()}
    cpu, found = fs.batch(circuit, scenes, **request), fs.batch(circuit, scenes, device="cuda", **request)
    names = request.get("outputs", ["f_el_mean"])
    answers.append({
        "device": found.attrs["device"], "status": found.status.values.tolist(), "error": found.error.values.tolist(),
        "cpu": [cpu[name].values.tolist() for name in names], "card": [found[name].values.tolist() for name in names],
    })
print(json.dumps(answers))
"""
GAPS = {"Xgap.d": [3e-6, 3.5e-6, 4e-6], "Xgap.r": [3e5, 1e6, 3e6]}
# The thickness of the skin decides which scene settles last, by which the scenes are ordered.
VALUES = {"Vdrive.amplitude": [120.0, 180.0, 240.0], "Xskin.d": [4.2e-4, 3.5e-4, 3e-4]}
REQUESTS: dict[str, tuple[str, dict[str, Any]]] = {
    "run": ("fingerpad", {"scenes": GAPS, "periods": 2, "outputs": ["f_el_mean", "f_t_rms", "f_el_mean_periodic"]}),
    "periodic": ("fingerpad", {"scenes": GAPS, "periodic": True, "rtol": 1e-6}),
    "square": ("fingerpad", {"scenes": GAPS, "periods": 2, "drive": "SQUARE(150 100)"}),
    # As in tests/test_batch.py, for which the processor's code is compiled already.
    "AM": ("am_carrier", {"scenes": GAPS, "t_stop": 0.01, "rtol": 1e-6, "outputs": ["f_el_mean", "f_t_rms"]}),
    "voltages": ("fingerpad", {"scenes": {"Xgap.d": [3e-6, 4e-6]}, "periods": 1, "outputs": ["u_gap"]}),
    **{path: ("fingerpad", {"scenes": {path: values}, "periods": 3, "rtol": 1e-5}) for path, values in VALUES.items()},
    **{
        f"{path} turned": ("fingerpad", {"scenes": {path: values[::-1]}, "periods": 3, "rtol": 1e-5})
        for path, values in VALUES.items()
    },
}


@pytest.fixture(scope="module")
def simulated() -> Simulated:
    """Results on the processor and in the simulator, which reads its variable when numba is imported."""
    asked = [(str(ROOT / "circuits" / f"{deck}.cir"), request) for deck, request in REQUESTS.values()]
    done = subprocess.run(
        [sys.executable, "-c", CODE, json.dumps(asked)], capture_output=True, text=True,
        env=os.environ | {"NUMBA_ENABLE_CUDASIM": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return dict(zip(REQUESTS, json.loads(done.stdout), strict=True))


@pytest.mark.parametrize("name", ["run", "periodic", "square", "AM"])
def test_the_kernel_gives_what_the_processor_gives(simulated: Simulated, name: str) -> None:
    found = simulated[name]
    assert found["device"] == "cuda"
    assert found["status"] == [0, 0, 0]
    # Both evaluate the same polynomials of degree 8 to 24 in powers, whose rounding their sums see.
    np.testing.assert_allclose(found["card"], found["cpu"], rtol=1e-10)


@pytest.mark.parametrize("path", VALUES)
def test_the_order_of_scenes_does_not_matter_and_errors_are_of_single_runs(simulated: Simulated, path: str) -> None:
    one, other = simulated[path], simulated[f"{path} turned"]
    assert one["card"][0] == other["card"][0][::-1]
    circuit = fs.read_netlist(ROOT / "circuits" / "fingerpad.cir")
    stop = 3.0 / circuit["Vdrive"].waveform.frequency  # type: ignore[union-attr]
    for value, got, stated in zip(VALUES[path], one["card"][0], one["error"], strict=True):
        exact = fs.simulate(circuit.replace({path: value}), t_stop=stop, rtol=1e-11).f_el_mean
        assert abs(got / float(np.asarray(exact)) - 1.0) <= stated <= 1e-5


def test_gap_voltages_stay_on_the_processor(simulated: Simulated) -> None:
    found = simulated["voltages"]
    assert found["device"] == "cpu"
    assert found["card"] == found["cpu"]


def test_what_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    circuit = fs.read_netlist(ROOT / "circuits" / "fingerpad.cir")
    scenes = {"Xgap.d": [3e-6]}
    refuses(r"device is 'gpu'; allowed: 'cpu' or 'cuda'", fs.batch, circuit, scenes, device="gpu")
    monkeypatch.setattr(card, "find_spec", lambda name: None)
    card.card_compiler.cache_clear()
    with pytest.raises(fs.InputError, match=r"no compiler for graphics cards is installed; .*fingerspice\[gpu\]"):
        fs.batch(circuit, scenes, device="cuda")
    monkeypatch.setattr(card, "card_compiler", lambda: type("Cuda", (), {"is_available": staticmethod(lambda: False)}))
    refuses("no card was found", fs.batch, circuit, scenes, device="cuda")


@pytest.mark.parametrize(("modes", "pieces"), [(2, 20), (8, 0), (2, 0)][: cases(3, 1)])
def test_the_kernel_compiles_for_a_card(modes: int, pieces: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("numba_cuda", reason="numba-cuda is installed on Linux only")
    card.card_compiler.cache_clear()
    cuda = card.card_compiler()
    # What a function is compiled for would be asked of the card.
    asked = type("Card", (), {"compute_capability": (9, 0)})
    monkeypatch.setattr(sys.modules["numba.cuda.dispatcher"], "get_current_device", lambda: asked)
    kinds = cuda.types
    whole, real, ints = kinds.int64, kinds.float64, kinds.int64[::1]
    row, table = real[::1], real[:, ::1]
    given = (table, ints, whole, ints, row, row, table, row, table, table, whole, whole, whole, kinds.boolean)
    kernel = thread_kernel((modes, 1 if pieces else 2, 2, 9, 1), 3 * (modes + 1) + 8, pieces)
    text, result = cuda.compile(kernel, kinds.void(*given, real, real, real[:, :, ::1]), cc=(9, 0), output="ptx",
                                device=False, abi="numba")  # fmt: skip
    assert result == kinds.void
    assert ".target sm_90" in text
    # Fused multiply-add in double precision.
    assert "fma.rn.f64" in text
