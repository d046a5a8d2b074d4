"""What is fitted: predictions, residuals, the least squares from one start, and profiles of the likelihood."""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.announcing import Bar
from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.statespace import build_stack, is_stack
from fingerspice.circuit.topology import driving_sources
from fingerspice.numerics.small import AT, STEP, derivative
from fingerspice.results.outcome import SolveError
from fingerspice.solve.simulation import simulate
from fingerspice.studies.batch.batch import batch
from fingerspice.studies.batch.form import in_lockstep_by
from fingerspice.studies.batch.task import REFUSED as BATCH_REFUSED
from fingerspice.studies.fitdata import IMPEDANCE, Data, Unknown, members_of
from fingerspice.studies.fitestimates import Profile
from fingerspice.studies.fitresult import Fitted
from fingerspice.studies.phasors import phasor
from fingerspice.studies.steady import steady_state

if TYPE_CHECKING:
    from xarray import Dataset

# Error of the runs whose derivatives a batch gives: ten times this, relative, which is far below any data's.
_SLOPES = 1e-6
# What a scene that cannot be run counts as, over the scale of the data.
REFUSED = 1e6
# Error of the least squares' last step, relative; and the largest number of evaluations, and of refused ones.
CLOSE, _MOST, _MOST_REFUSALS = 1e-8, 40, 6
#: A parameter is looked for up to this factor from its start, and a profile is followed so far, where no bounds are.
FARTHEST = 1e3


class Problem(Protocol):
    """What least squares need: residuals over their scale with derivatives by logarithms, and bounds of the values."""

    @property
    def bounds(self) -> FloatArray:
        """Smallest and largest values, shape (n_parameter, 2)."""

    def residuals(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals, shape (n,), and their derivatives, shape (n, n_parameter)."""


@dataclass(frozen=True)
class Task:
    """What is fitted."""

    circuit: Circuit  # With the values to start from
    data: Data
    unknowns: tuple[Unknown, ...]
    bounds: FloatArray  # (n_parameter, 2): Smallest and largest values
    average: str
    skin: str
    rtol: float
    charge_law: str | None
    # target, scale (n,): What is to be predicted, and that by which residuals are divided: the data's values, and,
    # where the phase of an impedance is given, the phases (deg) after them
    target: FloatArray
    scale: FloatArray
    watch: Callable[[], None] = lambda: None  # Called before every evaluation

    @property
    def initial(self) -> FloatArray:
        """Values to start from."""
        return np.array([self.circuit.parameters[one.path].value for one in self.unknowns])

    @cached_property
    def members(self) -> NDArray[np.bool_]:
        """Whether each unknown belongs to each measurement, shape (n_parameter, n)."""
        return members_of(self.unknowns, self.data.groups, self.data.values.size)

    def scene(self, values: FloatArray, row: int) -> Circuit:
        """The circuit of one measurement."""
        changes = {path: float(x[row]) for path, x in self.data.conditions.items()}
        changes |= {self.unknowns[k].path: float(values[k]) for k in np.flatnonzero(self.members[:, row])}
        changed = self.circuit.varied(changes)
        if self.skin == "follow":
            fundamental = build_stack(changed).waveform.fundamental if is_stack(changed) else None
            skins = {f"{e.name}.f": fundamental.frequency for e in changed.by_device("SKIN") if fundamental is not None}
            changed = changed.varied(skins)
        return changed

    def predict(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predicted data (n,), and their derivatives by the logarithms of the parameters (n, n_parameter)."""
        data, how = self.data, {"rtol": self.rtol, "charge_law": self.charge_law, "charge": False}
        if data.t is not None:
            paths = tuple(one.path for one in self.unknowns)
            run = simulate(self.scene(values, 0), t_eval=data.t, sensitivities=paths, **how)  # type: ignore[arg-type]
            slopes = [getattr(run.sensitivities[path], data.signal) for path in paths]
            return np.asarray(getattr(run, data.signal)), np.array(slopes).T * values
        if data.signal == IMPEDANCE:
            moved = values * (1.0 + np.multiply.outer(STEP * np.array(AT), np.eye(values.size)))
            by = derivative([np.array([self._impedance(one) for one in each]) for each in moved], STEP)
            return self._impedance(values), by.T
        if self._in_lockstep:
            return self._in_batches(values)
        name, found, by = data.name, np.empty(data.values.size), np.zeros((data.values.size, values.size))
        for row in range(data.values.size):
            circuit = self.scene(values, row)
            felt = np.flatnonzero(self.members[:, row])
            paths = tuple(self.unknowns[k].path for k in felt)
            if self.average == "periodic":
                one = steady_state(circuit, sensitivities=paths, points=4, **how)  # type: ignore[arg-type]
            else:
                one = simulate(circuit, sensitivities=paths, t_eval=[0.0], t_stop=_end(circuit), **how)  # type: ignore[arg-type,assignment]
            found[row] = getattr(one, name)
            for k, path in zip(felt, paths, strict=True):
                by[row, k] = getattr(one.sensitivities[path], name) * values[k]
        return found, by

    @cached_property
    def _in_lockstep(self) -> bool:
        """Whether a batch predicts all measurements, and has their derivatives, in lockstep."""
        paths = {*self.data.conditions, *(one.path for one in self.unknowns)}
        skins = {f"{e.name}.f" for e in self.circuit.by_device("SKIN")}
        if self.charge_law is not None or (self.skin == "follow" and paths & skins):
            return False
        alone = self.skin == "own" or len(driving_sources(self.circuit)) == 1
        return alone and in_lockstep_by(self.circuit, paths, (self.data.name,), max(self.rtol, _SLOPES))

    def _in_batches(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `_predicted`, all measurements at once, and their derivatives with an error that suits least squares."""
        name, table = self.data.name, dict(self.data.conditions)
        paths = tuple(dict.fromkeys(one.path for one in self.unknowns))
        owns = {path: [k for k, one in enumerate(self.unknowns) if one.path == path] for path in paths}
        for path, own in owns.items():
            table[path] = values[own] @ self.members[own]
        periodic = self.average == "periodic"
        stop = None if periodic else _end(self.circuit)

        def run(rtol: float, gradients: tuple[str, ...]) -> Dataset:
            found = batch(
                self.circuit, table, outputs=(name,), rtol=rtol, t_stop=stop, periodic=periodic, skin=self.skin,
                gradients=gradients,
            )  # fmt: skip
            if np.any(found["gradient_status" if gradients else "status"].to_numpy() >= BATCH_REFUSED):
                raise InputError(found.attrs["failures"][0])
            return found

        slopes = run(max(self.rtol, _SLOPES), paths)[f"d_{name}"].to_numpy()
        by = np.zeros((self.data.values.size, values.size))
        for i, own in enumerate(owns.values()):
            by[:, own] = self.members[own].T * slopes[:, i, None] * values[own]
        return run(self.rtol, ())[name].to_numpy(), by

    def _impedance(self, values: FloatArray) -> FloatArray:
        """Magnitudes (ohm), and phases (deg) where they are given, at the area that the deck's amplitude causes."""
        how = "swept" if self.skin == "follow" else "own"
        runs = [phasor(self.scene(values, row), skin=how).impedance for row in range(self.data.values.size)]
        z = np.array([one[0] for one in runs if one is not None])
        return np.abs(z) if self.data.phase is None else np.concatenate([np.abs(z), np.degrees(np.angle(z))])

    def residuals(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals over their scale, and their derivatives; large ones where a scene cannot be run."""
        self.watch()
        try:
            with warnings.catch_warnings():
                # Of values that no user has written.
                warnings.simplefilter("ignore", FingerspiceWarning)
                found, by = self.predict(values)
        except (InputError, SolveError):
            return np.full(self.scale.size, REFUSED), np.zeros((self.scale.size, values.size))
        off = found - self.target
        if self.data.phase is not None:
            n = self.data.values.size
            off[n:] = np.remainder(off[n:] + 180.0, 360.0) - 180.0
        return off / self.scale, by / self.scale[:, None]


def _end(circuit: Circuit) -> float:
    if circuit.tran is None:
        raise InputError("the deck has no .tran, and average is 'run'; allowed: a deck with .tran, or 'periodic'")
    return circuit.tran.stop


@contextmanager
def evaluations_shown() -> Iterator[Callable[[], None]]:
    """A progress bar of a fit, which appears after one second; the function counts the evaluations."""
    bar, begun, count = Bar("fitting", endless=True), time.perf_counter(), itertools.count(1)

    def watch() -> None:
        number = next(count)
        if time.perf_counter() - begun > 1.0:
            bar.show(note=f"evaluation {number}")

    try:
        yield watch
    finally:
        bar.stop()


def followed(task: Problem, begin: FloatArray, close: float = CLOSE) -> Fitted:
    """Where least squares lead from a start; `close` is the relative error of the last step."""
    from scipy.optimize import least_squares

    known: dict[bytes, tuple[FloatArray, FloatArray]] = {}
    refusals = 0

    def at(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        nonlocal refusals
        key = x.tobytes()
        if key not in known:
            last = next(iter(known.values()), None)
            known.clear()
            # At the edge of what can be run, all further steps are refused without a run, so that the search ends.
            if last is None or refusals < _MOST_REFUSALS:
                known[key] = task.residuals(unit * np.exp(x))
            else:
                known[key] = np.full_like(last[0], REFUSED), np.zeros_like(last[1])
            refusals += bool(np.all(known[key][0] == REFUSED))
        return known[key]

    # The first step is at most as long as the place it starts from: by a factor of e, not by that of the unit.
    begin = np.clip(begin, *task.bounds.T)
    x0 = np.full(begin.size, begin.size**-0.5)
    unit = begin / np.exp(x0)
    with np.errstate(divide="ignore"):
        box = np.log(task.bounds / unit[:, None]).T
    x0 = np.clip(x0, *box)
    found = least_squares(
        lambda x: at(x)[0], x0, lambda x: at(x)[1], bounds=box, xtol=close, ftol=close**1.5, gtol=1e-12, max_nfev=_MOST
    )
    values, closed = unit * np.exp(found.x), found.status > 0 and refusals < _MOST_REFUSALS
    residual, by = at(found.x) if refusals < _MOST_REFUSALS else task.residuals(values)
    return Fitted(values, residual, by, float(residual @ residual), int(found.nfev), bool(closed))


# Growth of the distance from the value, in its logarithm; and the error of an interval's end over that distance.
_GROWTH, _CLOSE = 1.6, 0.01
# Error of the other parameters on the way.
_ROUGHLY = 1e-4
# Ratio of the interval's two parts, in the logarithm, from which on it is called skewed.
_SKEWED = 1.2


@dataclass(frozen=True)
class _Held:
    """A problem of which one value is held."""

    whole: Problem
    place: int
    value: float

    @property
    def bounds(self) -> FloatArray:
        return np.delete(self.whole.bounds, self.place, axis=0)

    def residuals(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        residual, by = self.whole.residuals(np.insert(values, self.place, self.value))
        return residual, np.delete(by, self.place, axis=1)


def limit_of(objective: float, freedom: int, *, given: bool) -> float:
    """The objective at the ends of a 95 % interval; `given` says whether sigma was, or is estimated.

    It exceeds the least objective by the 95 % quantile of chi squared with one degree of freedom, or, where sigma is
    estimated, of F (Bates and Watts, Nonlinear regression analysis, 1988, section 6.1).
    """
    from scipy.stats import chi2, f

    if given:
        return objective + float(chi2.ppf(0.95, 1))
    return objective * (1.0 + float(f.ppf(0.95, 1, freedom)) / freedom) if freedom > 0 else math.inf


def profile_of(task: Problem, paths: Sequence[str], best: Fitted, path: str, error: float, limit: float) -> Profile:
    """The profile of one of the parameters `paths`; its interval holds all values with objectives up to `limit`.

    `error` is the standard error of its logarithm at the best fit.
    """
    place = paths.index(path)
    here = math.log(best.values[place])
    box = task.bounds[place]
    known = {here: best.objective}
    low, high = (_last(task, best, place, sign, error, limit, box, known) for sign in (-1.0, 1.0))
    at = sorted(known)
    reach = [here - math.log(low) if low > 0.0 else math.inf, math.log(high) - here]
    open_below, open_above = (known_end is None for known_end in (_crossed(known, limit, here, s) for s in (-1, 1)))
    if open_below or open_above:
        shape = "open" if open_below and open_above else "open below" if open_below else "open above"
    else:
        shape = "skewed" if max(reach) > _SKEWED * min(reach) else "symmetric"
    return Profile(path, np.exp(at), np.array([known[x] for x in at]), limit, low, high, shape)


def _crossed(known: dict[float, float], limit: float, here: float, sign: int) -> float | None:
    """The nearest known place on one side of the best fit at which the objective is beyond the limit."""
    beyond = [x for x, value in known.items() if sign * (x - here) > 0.0 and value > limit]
    return min(beyond, key=lambda x: abs(x - here)) if beyond else None


def _last(
    task: Problem, best: Fitted, place: int, sign: float, error: float, limit: float, box: FloatArray,
    known: dict[float, float],
) -> float:  # fmt: skip
    """The end of the interval on one side, with all objectives on the way put into `known` (by the logarithm)."""
    from scipy.optimize import brentq

    here = math.log(best.values[place])
    with np.errstate(divide="ignore"):
        wall = float(np.log(box[0 if sign < 0.0 else 1]))
    farthest = min(math.log(FARTHEST), abs(wall - here))
    look = _held(task, best, place, known)
    near, far = 0.0, min(max(1.5 * error, 1e-6), 0.5, farthest)
    while look(here + sign * far) <= limit:
        if far >= farthest:
            return float(box[0 if sign < 0.0 else 1])
        near, far = far, min(_GROWTH * far, farthest)

    def beyond(x: float) -> float:
        # About linear in x, as the objective is about a parabola.
        return math.sqrt(max(look(here + sign * x) - best.objective, 0.0)) - math.sqrt(limit - best.objective)

    end = brentq(beyond, near, far, xtol=_CLOSE * far, rtol=1e-6)
    return math.exp(here + sign * end)


def _held(task: Problem, best: Fitted, place: int, known: dict[float, float]) -> Callable[[float], float]:
    """The least objective with the parameter held, as a function of its logarithm."""
    latest = {"begin": np.delete(best.values, place)}

    def look(x: float) -> float:
        if x not in known:
            held = _Held(task, place, math.exp(x))
            if best.values.size > 1:
                # From where the last value was fitted, which lies on the way.
                found = followed(held, latest["begin"], _ROUGHLY)
                known[x], latest["begin"] = found.objective, found.values
            else:
                residual, _ = held.residuals(np.empty(0))
                known[x] = float(residual @ residual)
        return known[x]

    return look
