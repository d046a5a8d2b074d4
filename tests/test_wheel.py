"""The wheel with compiled code, in an environment of its own where nothing can be written: nothing is compiled."""

import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
V2 = {"NUMBA_CPU_NAME": "x86-64-v2", "NUMBA_CPU_FEATURES": ""}
# It compiles everything for one level, five minutes on two cores.
pytestmark = [
    pytest.mark.skipif("CI" not in os.environ, reason="it takes minutes; CI=true runs it"),
    pytest.mark.skipif(platform.machine() != "x86_64", reason="levels of x86-64"),
]
# numba's own events count what is compiled.
COUNTED = """
import json, sys, tempfile, warnings
import numba.core.event as event
import numpy as np
def refuse(*_, **__):
    raise PermissionError(13, "Permission denied")
tempfile.TemporaryFile = refuse
compiled = []
class Listener(event.Listener):
    def on_start(self, happened):
        compiled.append(str(happened.data["dispatcher"].py_func))
    def on_end(self, happened):
        pass
event.register("numba:compile", Listener())
import fingerspice as fs
warnings.simplefilter("ignore")
circuits = sys.argv[1]
pad, net = (fs.read_netlist(f"{circuits}/{name}.cir") for name in ("fingerpad", "ungrounded_user"))
noise = fs.Samples(100.0 * np.random.default_rng(1).standard_normal(480), 48e3)
"""
STACK = COUNTED + "found = fs.simulate(pad, rtol=1e-9).f_el\n"
EVERY = """
for circuit in (pad, net):
    str(fs.simulate(circuit, t_stop=2e-3))
    str(fs.simulate(circuit, t_stop=2e-3, sources=noise))
    str(fs.simulate(circuit, t_stop=2e-3, method="radau"))
    str(fs.steady_state(circuit, sensitivities=("Xgap.d",)))
many = {"Xgap.d": np.linspace(3e-6, 4e-6, 40)}
fs.batch(pad, many, outputs=("f_el_mean", "f_t_rms"), periods=5)
fs.batch(pad, many, periodic=True, gradients=("Xgap.d",))
fs.batch(pad.replace({"Vdrive": noise}), many, t_stop=2e-3)
fs.inverse_drive(pad, duration=5e-3, force=lambda t: 0.02 + 0.01 * np.sin(300.0 * t))
fs.simulate(pad, t_stop=2e-3, sources=noise).sample_gradient(f_el_mean=1.0)
from fingerspice.explorer.scene import EXAMPLES, scene
scene(EXAMPLES[0]["request"])
"""
TOLD = "print(json.dumps({'compiled': compiled, 'found': list(map(float, found))}))"


def installed(folder: Path) -> Path:
    """A folder where the wheel is installed: all code for x86-64-v3, and a stack's for x86-64-v2."""
    kept = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "objects"), "NUMBA_CPU_FEATURES": ""}
    fingerspice = [sys.executable, "-m", "fingerspice"]
    stack = ["run", str(ROOT / "circuits" / "fingerpad.cir"), "--out", str(folder), "--no-plot"]
    for level, arguments in (("x86-64-v3", ["warm"]), ("x86-64-v2", stack)):
        subprocess.run([*fingerspice, *arguments], check=True, env={**kept, "NUMBA_CPU_NAME": level})
    run_pip("wheel", "--no-deps", "--wheel-dir", str(folder), str(ROOT), OBJECTS=str(folder / "objects"))
    (wheel,) = folder.glob("*.whl")
    assert wheel.stat().st_size < 12e6
    version = "cp{}{}".format(*sys.version_info[:2])
    assert f"-{version}-{version}-linux_x86_64" in wheel.name
    run_pip("install", "--no-deps", "--no-compile", "--target", str(folder / "site"), str(wheel))
    return folder / "site"


def run_pip(*arguments: str, **more: str) -> None:
    command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *arguments]
    subprocess.run(command, check=True, env={**os.environ, **more})


def environment(site: Path, more: Mapping[str, str] = {}) -> dict[str, str]:
    """No HOME, and no folder that could be written."""
    kept = {k: v for k, v in os.environ.items() if k not in ("HOME", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    return {**kept, "PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1", **more}


def counted(site: Path, code: str, more: Mapping[str, str] = {}) -> dict[str, Any]:
    command = [sys.executable, "-c", code + TOLD, str(ROOT / "circuits")]
    done = subprocess.run(command, check=True, env=environment(site, more), capture_output=True, text=True)
    assert "fingerspice: note: compiling" not in done.stderr
    assert not [file for file in site.rglob("__pycache__") if list(file.glob("*.nbc"))]
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def test_from_the_wheel_nothing_is_compiled(tmp_path: Path) -> None:
    """One test, as of several workers each would make the wheel: every kind of run, the command, and another level."""
    site = installed(tmp_path)
    assert counted(site, STACK + EVERY)["compiled"] == []
    run = ["run", str(ROOT / "circuits" / "fingerpad.cir"), "--out", str(tmp_path)]
    code = f"import sys; sys.argv[1:] = {run!r}\nfrom fingerspice.__main__ import main\nmain()\n"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, check=True, env=environment(site), capture_output=True, text=True)
    assert "compiling" not in done.stderr
    assert (tmp_path / "fingerpad.png").stat().st_size > 10_000
    # A processor without AVX2 has the same figures to the stated error.
    wide, narrow = counted(site, STACK), counted(site, STACK, V2)
    assert narrow["compiled"] == wide["compiled"] == []
    largest = max(map(abs, wide["found"]))
    assert narrow["found"] == pytest.approx(wide["found"], rel=0.0, abs=2e-9 * largest)
