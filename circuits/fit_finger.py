"""Fits gap, its resistance and ridge area of a finger to measured forces, and predicts another force with its error.

The forces of measured.csv are synthetic: Table 1's finger with a gap of 3.1 um, 1.4 megohm, alpha = 48, and 2 % noise.
Gap and area are each known to a few per cent, while their errors are correlated: thicker gap and larger area together
hardly change a force. A prediction has to take values from the joint distribution, and is far more certain than the
parameters are: python circuits/fit_finger.py [FOLDER FOR THE PICTURE]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import fingerspice as fs

HERE = Path(__file__).resolve().parent
FREE = ["Xgap.d", "Xgap.r", "Xgap.alpha"]
# The force that is predicted: at a voltage and a frequency between those that were measured.
VOLTAGE, FREQUENCY, DRAWS = 180.0, 300.0, 200


def fitted() -> fs.Fit:
    """The fit, with the profile likelihood of the gap."""
    circuit = fs.read_netlist(HERE / "fingerpad.cir")
    return fs.fit(circuit, HERE / "measured.csv", FREE, skin="follow", profiles=["Xgap.d"])


def area_at_rest(found: fs.Fit) -> tuple[float, float, float]:
    """Ridge area (mm^2) under the deck's load, alpha fn^m (Eq. 5), with the ends of its 95 % interval."""
    alpha, gap = found.estimates["Xgap.alpha"], found.circuit["Xgap"].values
    value, low, high = (x * gap["fn"] ** gap["m_exp"] for x in (alpha.value, alpha.low, alpha.high))
    return value, low, high


def predicted(found: fs.Fit) -> tuple[float, float, float]:
    """Mean force (N) at the voltage and frequency above: median, and the ends of its 95 % interval."""
    every = [found.estimates[path] for path in FREE]
    error = np.array([one.error / one.value for one in every])
    # The errors of the logarithms are normal and correlated.
    spread = found.correlation * np.outer(error, error)
    logs = np.random.default_rng(1).multivariate_normal(np.log([one.value for one in every]), spread, DRAWS)
    drawn = {path: np.exp(logs[:, k]) for k, path in enumerate(FREE)}
    at = {"Vdrive.amplitude": np.full(DRAWS, VOLTAGE), "Vdrive.frequency": np.full(DRAWS, FREQUENCY)}
    force = fs.batch(found.circuit, drawn | at, outputs=("f_el_mean",), periodic=True, skin="follow", rtol=1e-5)
    low, middle, high = np.percentile(force["f_el_mean"], [2.5, 50.0, 97.5]).tolist()
    return middle, low, high


def main(folder: Path) -> None:
    found = fitted()
    print(found)
    area, low, high = area_at_rest(found)
    print(f"\nridge area at rest: {area:.4g} mm^2, 95 % interval {low:.4g} to {high:.4g}")
    force, low, high = predicted(found)
    print(f"force at {VOLTAGE:g} V and {FREQUENCY:g} Hz: {1e3 * force:.4g} mN, 95 % interval "
          f"{1e3 * low:.4g} to {1e3 * high:.4g}")  # fmt: skip
    found.plot().savefig(folder / "fit_finger.png", dpi=160)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
