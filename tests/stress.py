"""Random scenes over twelve decades: each is right against an independent reference, or refused for a true reason.

Run: python tests/stress.py [--scenes 10000] [--seed 0] [--first 0]. A scene is made from seed and number alone.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import math
import signal
import sys
import time
import warnings
from functools import lru_cache

import numpy as np

import analytic as ref
import fingerspice as fs
from scenes import table1

RTOL = 1e-6
# Steps tried in a scene of two periods, at most: work is bounded.
MOST_STEPS = 50_000
# A run, and the reference's, may take so long, s.
LONGEST = 10


@dataclasses.dataclass(frozen=True)
class Scene:
    """A stack of three layers under a source, SI units."""

    source: str
    amplitude: float
    frequency: float
    law: str
    d: tuple[float, float, float]
    r: tuple[float, float, float]
    eps_r: tuple[float, float]
    f_n: float
    mu: float
    m: float
    n: float

    @property
    def circuit(self) -> fs.Circuit:
        """As a circuit."""
        return fs.parse_netlist(self.netlist)

    @property
    def netlist(self) -> str:
        """As a netlist."""
        r = [f" r={x!r}" if math.isfinite(x) else "" for x in self.r]
        gap = f"eps_r=1{r[1]} fn={self.f_n!r} mu={self.mu!r} alpha=54.4 m_exp={self.m!r} beta=32 n_exp={self.n!r}"
        return (
            f"a random scene\nVdrive drive 0 {self.source}({self._arguments})\n"
            f"Xcoat drive top area LAYER d={self.d[0]!r} eps_r={self.eps_r[0]!r}{r[0]}\n"
            f"Xgap top skin area GAP d={self.d[1]!r} {gap} c2=5000\n"
            f"Xskin skin 0 area LAYER d={self.d[2]!r} eps_r={self.eps_r[1]!r}{r[2]}\n"
            f".tran {0.05 / self.frequency!r} {2.0 / self.frequency!r} uic\n.end\n"
        )

    @property
    def _arguments(self) -> str:
        first = "0 " if self.source == "SIN" else ""
        return f"{first}{self.amplitude!r} {self.frequency!r}"

    @property
    def params(self) -> ref.Parameters:
        """Of the reference."""
        return dataclasses.replace(
            ref.TABLE1, mu0=self.mu, force_normal=self.f_n, d_a=self.d[1], r_a=self.r[1], m=self.m, n=self.n,
            alpha=54.4e-6, beta=32.0 * 1e-3 ** (2.0 - self.n),
        )  # fmt: skip

    @property
    def layers(self) -> tuple[ref.Layer, ...]:
        """Of the reference."""
        eps = (self.eps_r[0], 1.0, self.eps_r[1])
        return tuple(ref.Layer(ref.TABLE1.eps0 * e / d, r_total=r) for e, d, r in zip(eps, self.d, self.r, strict=True))

    def expected(self, t: np.ndarray) -> ref.Transient:
        """The reference's run."""
        if self.source == "SIN":
            segments = ref.sine_segments(self.amplitude, self.frequency, 2.0 / self.frequency)
        else:
            segments = ref.square_segments(self.amplitude, self.frequency, 2)
        return ref.transient(segments, t, law=self.law, params=self.params, layers=self.layers, tol=1e-11)

    @property
    def touches(self) -> bool:
        """Whether the unloaded contact exists: A0^2 > c2 mu^2 F^2."""
        p = self.params
        unloaded = float(ref.ridge_area_unloaded_mp(0.0, p))
        return unloaded**2 > p.c2 * p.mu0**2 * p.force_normal**2


def draw(seed: int, number: int) -> Scene:
    """A scene; resistances are left out one time in four."""
    rng = np.random.default_rng([seed, number])

    def decades(low: float, high: float) -> float:
        return float(10.0 ** rng.uniform(math.log10(low), math.log10(high)))

    r = [decades(1e-3, 1e15) if rng.random() < 0.75 else math.inf for _ in range(3)]
    m = float(rng.uniform(0.05, 0.95))
    # Then 1/m + 1/n > 1 too (Eqs. 5 and 6).
    n = float(rng.uniform(m + 0.02, 3.0))
    return Scene(
        str(rng.choice(["SIN", "SQUARE"])), decades(1e-9, 1e5), decades(1e-3, 1e6),
        str(rng.choice(["local", "mobile"])),
        (decades(1e-9, 1e-3), decades(1e-9, 1e-3), decades(1e-9, 1e-3)), (r[0], r[1], r[2]),
        (decades(1.0, 1e4), decades(1.0, 1e4)), decades(1e-5, 50.0), float(rng.uniform(0.01, 1.5)), m, n,
    )  # fmt: skip


class SlowError(Exception):
    """A run took longer than it may."""


def _late(*_: object) -> None:
    raise SlowError


class WrongError(AssertionError):
    """A scene was neither right nor refused for a true reason."""


@lru_cache(1)
def compiled() -> None:
    """First use compiles, which is no work of a scene."""
    folding = table1().replace({"Xgap.d": 1e-8})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fs.FingerspiceWarning)
        for law in ("local", "mobile"):
            for method in ("auto", "dop853"):
                fs.simulate(folding, t_stop=1e-3, charge_law=law, method=method, rtol=1e-3, throw=False)


def judge(scene: Scene) -> str:
    """How a scene ended: "right", or why it was refused or could not be judged; raises `WrongError`."""
    compiled()
    signal.signal(signal.SIGALRM, _late)
    signal.alarm(LONGEST)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", fs.FingerspiceWarning)
        try:
            solution = fs.simulate(scene.circuit, charge_law=scene.law, rtol=RTOL, throw=False)
        except fs.InputError as error:
            if "contact" in str(error) and not scene.touches:
                return "refused: no contact"
            raise WrongError(f"refused, though it is legal: {error}") from None
        except SlowError:
            raise WrongError(f"no answer within {LONGEST} s") from None
        finally:
            signal.alarm(0)
    tried = solution.stats.get("steps", 0) + solution.stats.get("rejected", 0)
    if tried > MOST_STEPS:
        raise WrongError(f"{tried} steps")
    with np.errstate(all="ignore"):
        signal.alarm(LONGEST)
        try:
            expected = scene.expected(solution.t)
        except (RuntimeError, ValueError, ZeroDivisionError, np.linalg.LinAlgError, SlowError):
            return f"not judged: the reference gave up, ours says {solution.status.name}"
        finally:
            signal.alarm(0)
    period = 1.0 / scene.frequency
    peak = float(np.nanmax(np.abs(expected.u_gap), initial=0.0))
    if solution.status is fs.Status.ERROR_NOT_MET:
        # The gap takes so little that rounding of the source is more than what was asked for.
        if RTOL * peak <= 1e-12 * scene.amplitude:
            return "refused: rounding"
        raise WrongError(f"error not met: {solution.message}")
    if solution.status is fs.Status.FOLD:
        assert solution.failure is not None
        if expected.fold is None:
            raise WrongError(f"no fold in the reference: {solution.message}")
        if solution.failure.t is None or abs(solution.failure.t - expected.fold.t) > 1e-5 * period:
            raise WrongError(f"fold at {expected.fold.t!r}, not {solution.failure.t!r}")
        return "refused: fold"
    if not solution.success:
        raise WrongError(solution.message)
    if expected.fold is not None:
        raise WrongError(f"the reference folds at {expected.fold.t!r} s, ours goes on")
    # At a jump a run has both one-sided values, the reference one.
    turns = 2.0 * scene.frequency * solution.t
    between = np.abs(turns - np.rint(turns)) > 1e-6
    off = float(np.abs(solution.u_gap - expected.u_gap)[between].max())
    if off > RTOL * peak + 1e-11 * scene.amplitude:
        raise WrongError(f"off by {off / peak:.3g} of the peak {peak:.3g} V, stated {solution.error.u_gap / peak:.3g}")
    return "right"


def main() -> None:
    """Judge scenes, tell the wrong ones, count all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    counts: collections.Counter[str] = collections.Counter()
    slowest = (0.0, 0)
    for number in range(options.first, options.first + options.scenes):
        scene = draw(options.seed, number)
        begin = time.perf_counter()
        try:
            counts[judge(scene)] += 1
        except Exception as error:
            counts["WRONG"] += 1
            print(f"scene {number}: {type(error).__name__}: {error}\n  {scene}", flush=True)
        slowest = max(slowest, (time.perf_counter() - begin, number))
    for name, count in counts.most_common():
        print(f"{count:7d} {name}")
    print(f"slowest: scene {slowest[1]} with its reference, {slowest[0]:.2g} s")
    sys.exit(1 if counts["WRONG"] else 0)


if __name__ == "__main__":
    main()
