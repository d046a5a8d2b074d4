"""Scenes for `fs.batch`, and what single runs and stated errors make of their figures."""

from collections.abc import Iterator
from typing import Any

import numpy as np

import fingerspice as fs


def population(n: int, seed: int) -> dict[str, np.ndarray]:
    """Fingers and drives that differ widely."""
    rng = np.random.default_rng(seed)
    return {
        "Vdrive.frequency": 10.0 ** rng.uniform(np.log10(20.0), 4.0, n),
        "Vdrive.amplitude": rng.uniform(50.0, 300.0, n),
        "Xgap.r": 1e6 * 10.0 ** rng.uniform(-1.0, 1.0, n),
        "Xcoat.r": 2e5 * 10.0 ** rng.uniform(-1.0, 1.0, n),
        "Xgap.fn": rng.uniform(0.1, 2.0, n),
        "Xgap.d": rng.uniform(2e-6, 6e-6, n),
    }


def singles(circuit: fs.Circuit, parameters: dict[str, Any], **how: Any) -> Iterator[fs.Solution]:
    """Runs of single scenes at a tolerance far below any of the tests; a SKIN follows the frequency where that varies.

    `periods` are of each scene's own source, of 100 Hz where its frequency does not vary; `points` are those of gap
    voltages in a period. All else goes to `simulate`.
    """
    periods, points = how.pop("periods", None), how.pop("points", None)
    for values in zip(*parameters.values(), strict=True):
        changes = {path: float(value) for path, value in zip(parameters, values, strict=True)}
        f = changes.get("Vdrive.frequency", 100.0)
        followed = {"Xskin.f": f} if "Vdrive.frequency" in changes else {}
        if periods is not None:
            how["t_stop"] = periods / f
        if points is not None:
            how["t_eval"] = np.arange(int(points * periods)) / (points * f)
        yield fs.simulate(circuit.varied({**followed, **changes}), rtol=1e-11, charge=False, **how)


def singly(circuit: fs.Circuit, parameters: dict[str, Any], outputs: tuple[str, ...], **how: Any) -> np.ndarray:
    """The outputs of single runs, shape (n_output, n_scene)."""
    summaries = [run.summary() for run in singles(circuit, parameters, **how)]
    return np.array([[summary[name] for summary in summaries] for name in outputs])


def check(
    circuit: fs.Circuit, parameters: dict[str, Any], outputs: tuple[str, ...], expected: np.ndarray, rtol: float,
    slack: float = 0.0, **how: Any,
) -> Any:  # fmt: skip
    """A batch; its errors are at most `rtol`, and 19 of 20 at most `slack` above the stated ones."""
    found = fs.batch(circuit, parameters, outputs=outputs, rtol=rtol, **how)
    off = np.max(np.abs(np.array([found[name].values for name in outputs]) / expected - 1.0), axis=0)
    assert off.max() <= rtol
    assert np.mean(off <= found.error.values + slack) >= 0.95
    return found


def alike(circuit: fs.Circuit, parameters: dict[str, Any], **how: Any) -> Any:
    """A batch, of which neither threads nor the order of the scenes change a byte."""
    first = fs.batch(circuit, parameters, threads=1, **how)
    straight = np.arange(first.sizes["scene"])
    for threads, order in ((3, straight), (2, np.random.default_rng(0).permutation(straight))):
        some = {path: values[order] for path, values in parameters.items()}
        other = fs.batch(circuit, some, threads=threads, **how)
        for name in (name for name in first.data_vars if "scene" in first[name].dims):
            assert other[name].values[np.argsort(order)].tobytes() == first[name].values.tobytes(), name
    return first
