"""Short runs of every kind, of which each compiles what it needs and finds what the others have compiled."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from functools import partial
from itertools import product
from multiprocessing import get_context
from typing import Any

import numpy as np

import fingerspice as fs
from fingerspice.explorer.scene import EXAMPLES, scene

_T = 1e-3  # Length of the runs, s
_SCENES = {"Xgap.d": np.linspace(3.4e-6, 3.6e-6, 8)}
_RTOLS = 1e-4, 1e-6  # Lockstep has loops of its own for each.
_DERIVED: dict[str, Any] = {"sensitivities": ("Xgap.d",)}
_ENDS: tuple[dict[str, Any], ...] = ({"t_stop": _T}, {"periodic": True})
_WANTED: tuple[dict[str, Any], ...] = (
    {"outputs": ("f_el_mean",)}, {"outputs": ("f_t_rms",)}, {"outputs": ("u_gap",)}, {"gradients": ("Xgap.d",)},
)  # fmt: skip


def works() -> dict[str, Callable[[], object]]:
    """What is run, by name; first what takes the compiler longest."""
    scenes = {one["name"]: one["request"] for one in EXAMPLES}
    noise = fs.Samples(100.0 * np.random.default_rng(1).standard_normal(480), 48e3)
    few = fs.PWL((0.0, 2e-4, 8e-4), (0.0, 100.0, 50.0))
    first, then = dict[str, Callable[[], object]](), dict[str, Callable[[], object]]()
    for law in ("fingerspice", "fingerspice_mobile"):
        decks = {
            name: scenes[name]["deck"].replace("fingerspice.lib", f"{law}.lib") for name in ("ungrounded", "sine-5k")
        }
        # A skin for any source has more modes, for which recordings have loops of their own.
        any_source = fs.parse_netlist(re.sub("SKIN .*", "SKIN_DISPERSIVE d=350u", decks["sine-5k"]))
        first[f"{law}, recording of any skin"] = partial(_recorded, any_source.replace({"Vdrive": noise}))
        for name, deck in decks.items():
            circuit = fs.parse_netlist(deck)
            recorded, kind, run = circuit.replace({"Vdrive": noise}), f"{law}, {name}", partial(_run, circuit)
            first |= {kind: run, f"{kind}, recording": partial(_recorded, recorded)}
            first[f"{kind}, implicit"] = partial(run, method="radau")
            then[f"{kind}, periodic"] = partial(fs.steady_state, circuit, **_DERIVED)
            then |= {f"{kind}, {how}": partial(run, **how) for how in ({"sources": few}, {"area": "frozen"}, _DERIVED)}
        # The last of them is a stack; networks are in no batch's lockstep.
        for i, (rtol, wanted, end) in enumerate(product(_RTOLS, _WANTED, _ENDS)):
            batch = partial(fs.batch, parameters=_SCENES, rtol=rtol, **wanted, **end)
            first[f"{kind}, batch of recordings {i}"] = partial(batch, recorded)
            first[f"{kind}, batch {i}"] = partial(batch, circuit)
        drive = partial(fs.inverse_drive, circuit, duration=5e-3)
        then[f"{law}, drive"] = partial(drive, force=lambda t: 0.02 + 0.01 * np.sin(300.0 * t))
    closing = scenes["sine"]["deck"].replace("fn=0.5", "law=pullin u0=1u p_ref=10k fn=0.5")
    then["gap that closes"] = partial(_run, fs.parse_netlist(closing))
    return first | then | {f"scene {name}": partial(scene, request) for name, request in scenes.items()}


def _run(circuit: fs.Circuit, **how: Any) -> None:
    str(fs.simulate(circuit, t_stop=_T, **how))


def _recorded(circuit: fs.Circuit) -> None:
    # Fewer samples would not go in lanes, which have loops of their own for loose tolerances.
    for rtol in (1e-5, 1e-8):
        solution = fs.simulate(circuit, t_stop=10.0 * _T, rtol=rtol)
        str(solution)
    for part in fs.stream(circuit, t_stop=10.0 * _T, chunk=5.0 * _T):
        str(part)
    solution.sample_gradient(f_el_mean=1.0)


def _work(name: str) -> None:
    """Do one of the works, without a word about what is compiled."""
    logging.getLogger("fingerspice").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    # Not everything goes with everything: there is no period of a recording.
    with suppress(fs.FingerspiceError):
        works()[name]()


def warm_up(update: Callable[[float], None]) -> None:
    """Do all works in two processes, and tell the share done."""
    names = list(works())
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for i, done in enumerate(as_completed([pool.submit(_work, name) for name in names]), 1):
            done.result()
            update(i / len(names))
