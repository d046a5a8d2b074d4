"""First and later results of a fresh installation: seconds, and how many functions are compiled.

Run: python benchmarks/first_use.py out/dist/fingerspice-*.whl. It installs the wheel into an environment of its own
and prints for each the first process and the best of five more.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

CIRCUITS = Path(__file__).resolve().parent.parent / "circuits"
READ = (
    "import fingerspice as fs; "
    f"pad, net = (fs.read_netlist('{CIRCUITS}/' + x + '.cir') for x in ('fingerpad', 'ungrounded_user'))\n"
)
NOISE = "import numpy as np; x = fs.Samples(100 * np.random.default_rng(1).standard_normal(480), 48e3)\n"
MANY = "import numpy as np; many = {'Xgap.d': np.linspace(3e-6, 4e-6, 64)}\n"
RUN = ["-m", "fingerspice", "run", str(CIRCUITS / "fingerpad.cir"), "--overwrite"]
#: What is timed, as arguments of Python.
TIMED = {
    "import numba, matplotlib.pyplot": ["-c", "import numba, matplotlib.pyplot"],
    "import fingerspice": ["-c", "import fingerspice"],
    "fingerspice run, with picture": RUN,
    "fingerspice run, without": [*RUN, "--no-plot"],
    "a network": ["-c", f"{READ}fs.simulate(net)"],
    "a recording": ["-c", f"{READ}{NOISE}fs.simulate(pad, sources=x, t_stop=0.01)"],
    "a batch": ["-c", f"{READ}{MANY}fs.batch(pad, many, periods=5)"],
    "a periodic state": ["-c", f"{READ}fs.steady_state(pad)"],
    "the explorer's first picture": ["-c", "from fingerspice.explorer.scene import *; scene(EXAMPLES[0]['request'])"],
}
# What compiles is announced by a line on stderr.
ANNOUNCED = "fingerspice: note: compiling"


def main() -> None:
    """Time everything in an environment of its own, or in the one named."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("wheel", type=Path)
    arguments.add_argument("--python", help="of an environment where it is installed already")
    given = arguments.parse_args()
    print(f"{given.wheel.name}: {given.wheel.stat().st_size / 1e6:.1f} MB")
    with tempfile.TemporaryDirectory() as folder:
        python = given.python or str(Path(folder, "Scripts" if sys.platform == "win32" else "bin", "python"))
        if given.python is None:
            venv.create(folder, with_pip=True)
            subprocess.run([python, "-m", "pip", "install", "--quiet", str(given.wheel)], check=True)
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "PYTHON", "HOME", "XDG"))}
        kept["MPLCONFIGDIR"] = folder
        for name, command in TIMED.items():
            times, said = [], ""
            for _ in range(6):
                begin = time.perf_counter()
                done = subprocess.run(
                    [python, *command], env=kept, cwd=folder, capture_output=True, text=True, check=True
                )
                times.append(time.perf_counter() - begin)
                said += done.stderr
            print(f"{name:32} {times[0]:6.2f} {min(times[1:]):6.2f} s  {said.count(ANNOUNCED)} waits for the compiler")


if __name__ == "__main__":
    main()
