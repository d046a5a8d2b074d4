"""The request of a batch (`Task`), its results (`Answers`), and scenes that run by themselves."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.results.outcome import ErrorEstimate, SolveError
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import RTOL_RANGE, simulate
from fingerspice.studies.steady import SteadyState, steady_state

# Smallest and largest number of scenes in a job, of which there are 8 or more between these limits; the number if gap
# voltages are wanted, so that these stay in the processor's cache; the limits under a recording, whose scenes take
# long; and the number on a graphics card, which is slow to start.
JOBS, CHUNKS, TRACED, RECORDED, ON_CARD = 8, (512, 4096), 256, (32, 128), 262_144
# Relative distance from a whole number within which a number of half periods counts as whole.
WHOLE = 1e-9
LOCKSTEP, ONE_BY_ONE, REFUSED, FAILED = 0, 1, 2, 3
STATUS_NAMES = ("lockstep", "one_by_one", "refused", "failed")


@dataclass(frozen=True)
class Task:
    """A checked request; its attributes are arguments of `batch`, with exactly one of `t_stop` and `periods` given."""

    circuit: Circuit
    outputs: tuple[str, ...]
    rtol: float
    t_stop: float | None
    periods: float | None
    periodic: bool
    points: int
    device: str = "cpu"

    @property
    def traced(self) -> bool:
        """Whether gap voltages are wanted."""
        return "u_gap" in self.outputs

    def on_card(self, recorded: bool) -> bool:
        """Whether lockstep is done on a graphics card; recordings, and gap voltages, stay on the processor."""
        return self.device == "cuda" and not recorded and not self.traced

    def count(self, frequency: FloatArray) -> FloatArray:
        """Number of periods in runs with sources of these frequencies (Hz)."""
        if self.t_stop is not None:
            return np.asarray(frequency * self.t_stop)
        return np.full(frequency.shape, self.periods)


def jobs_of(
    task: Task, count: FloatArray, chosen: BoolArray, recorded: bool = False
) -> list[tuple[int, NDArray[np.int64]]]:
    """Jobs of the `chosen` scenes whose runs last for whole numbers of half periods: that number, and the scenes.

    `count` (n,) is the number of periods in every run. Under a recording (`recorded`) half a period is a sample.
    """
    halves = np.round(2.0 * count)
    good = chosen & (halves >= 1.0) & (np.abs(2.0 * count - halves) <= WHOLE * halves)
    if any(name.endswith("_periodic") for name in task.outputs):
        good &= halves >= 2.0
    jobs = []
    for size in np.unique(halves[good]).astype(int).tolist():
        members = np.flatnonzero(good & (halves == size))
        chunk = int(np.clip(members.size // JOBS, *(RECORDED if recorded else CHUNKS)))
        chunk = TRACED if task.traced and not recorded else ON_CARD if task.on_card(recorded) else chunk
        jobs += [(size, members[i : i + chunk]) for i in range(0, members.size, chunk)]
    return jobs


@dataclass
class Answers:
    """Outputs of some scenes, their stated errors, and their status."""

    # (n,): Outputs; NaN for a scene without a result, but for gap voltages, which are filled last (`fill`)
    values: dict[str, FloatArray]
    error: FloatArray  # (n,): Stated relative error
    status: NDArray[np.int8]  # (n,): Index into `STATUS_NAMES`
    done: BoolArray  # (n,): Whether results have been entered
    messages: dict[int, str]  # Messages of the scenes without a result

    @classmethod
    def empty(cls, task: Task, n: int, width: int) -> Answers:
        """Answers of n scenes, none of them done, with room for `width` gap voltages each."""
        values = {name: np.empty((n, width)) if name == "u_gap" else np.full(n, np.nan) for name in task.outputs}
        return cls(values, np.full(n, np.nan), np.full(n, ONE_BY_ONE, np.int8), np.zeros(n, bool), {})

    def fill(self) -> None:
        """Gap voltages of the scenes without a result so far: NaN."""
        if "u_gap" in self.values:
            self.values["u_gap"][~self.done] = np.nan

    def put_single(self, i: int, values: Mapping[str, FloatArray], error: float, status: int) -> None:
        """Enter the result of one scene; several gaps have one column each."""
        for name, value in values.items():
            if value.ndim == 1 and self.values[name].ndim == 1:
                self.values[name] = np.full((self.error.size, value.size), np.nan)
            if value.ndim == 1:
                self.values[name][i, : value.size] = value
            else:
                self.values[name][i] = value
        self.error[i], self.status[i], self.done[i] = error, status, True


# A run's rtol is relative to peaks, and a batch's to the output itself: the first attempt assumes that an output is at
# least this fraction of its peak.
OVER_PEAK = 0.1


class Single(NamedTuple):
    """The outputs of one scene or their derivatives, the stated error, status, and the message if there are none."""

    values: Mapping[str, FloatArray]
    error: float
    status: int
    message: str


def each_alone(
    task: Task, scenes: Mapping[str, FloatArray], frequency: FloatArray, which: NDArray[np.int64],
    pool: ThreadPoolExecutor, run: Callable[[Circuit, float, float], Single], allowed: float,
) -> Iterator[tuple[int, Single]]:  # fmt: skip
    """What `run` finds of the scenes `which`, with an rtol that leads to an error that is `allowed`.

    It takes the circuit, the frequency of its periods (Hz) and an rtol. A refusal or failure is an answer, not raised.
    """

    def one(i: int) -> Single:
        try:
            circuit = task.circuit.varied({path: float(array[i]) for path, array in scenes.items()})
            rtol = max(OVER_PEAK * task.rtol, RTOL_RANGE[0])
            found = run(circuit, float(frequency[i]), rtol)
            if found.error > allowed and rtol > RTOL_RANGE[0]:
                # The mean is smaller than assumed, relative to the peak: repeat with the rtol that the error asks for.
                closer = max(0.5 * rtol * allowed / found.error, RTOL_RANGE[0])
                found = run(circuit, float(frequency[i]), closer)
            return found
        except InputError as error:
            return Single({}, math.nan, REFUSED, str(error))
        except SolveError as error:
            return Single({}, math.nan, FAILED, str(error))

    # Warnings about unusual values are not repeated for every scene. Filters apply to all threads, so set them here.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = list(pool.map(one, which.tolist()))
    yield from zip(which.tolist(), found, strict=True)


def run_single(task: Task, circuit: Circuit, frequency: float, rtol: float) -> Single:
    """The outputs of one scene."""
    ran: Solution | SteadyState
    if task.periodic:
        ran = steady_state(circuit, rtol=rtol, points=task.points, charge=False)
        trace = ran.solution if task.traced else None
    else:
        stop = task.t_stop if task.t_stop is not None else (task.periods or 1.0) / frequency
        t = None
        if task.traced:
            t = np.arange(math.ceil(stop * frequency * task.points - 1e-9)) / (frequency * task.points)
        ran = trace = simulate(circuit, t_stop=stop, t_eval=t, rtol=rtol, charge=False)
    values = {}
    for name in task.outputs:
        if name == "u_gap":
            assert trace is not None
            u = np.asarray(trace.u_gap)
            values[name] = u[:-1] if task.periodic else u
            continue
        signal = next(s for s in SIGNALS_OF_BATCH if name.startswith(f"{s}_"))
        value = ran._figures.value(signal, name[len(signal) + 1 :])
        values[name] = np.asarray(math.nan if value is None else value, float)
    return Single(values, error_of(ran), ONE_BY_ONE, "")


#: Signals whose figures a batch has.
SIGNALS_OF_BATCH = ("f_el", "f_t", "friction", "u_gap", "area")


def error_of(ran: Solution | SteadyState) -> float:
    """Stated error of the gap voltage relative to its peak, or of the force relative to its mean, if that is larger."""
    error: ErrorEstimate = ran.error
    pairs = (error.u_gap, ran.u_gap_peak), (error.f_el, ran.f_el_mean)
    sizes = [float(np.min(size)) if size is not None else 0.0 for _, size in pairs]
    return max((off / size for (off, _), size in zip(pairs, sizes, strict=True) if size > 0.0), default=0.0)
