"""The mean force of many fingers by other packages: one right-hand side, and each package's own way over scenes.

Every contestant integrates the leaked voltages v of coating and gap, and the integral of u_gap^2 A, from rest over
whole periods. All take 1/A as a polynomial in the gap voltage, whose making is not timed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange


class Scenes(NamedTuple):
    """Rows of scenes under a sine: a column for each scene.

    Attributes
    ----------
    share, leak, leak_area : ndarray, shape (3, n)
        Share of every layer in a jump of the source, leak 1/(R c) over 1/A (m^2/s) and leak of a material (1/s).
    amplitude, omega : ndarray, shape (n,)
        V and rad/s.
    areas : ndarray, shape (d + 1, n)
        Polynomial of 1/A (1/m^2) in 2 |u_gap| / amplitude - 1, highest power first.
    stress : ndarray, shape (n,)
        Stress at 1 V, Pa.
    """

    share: np.ndarray
    leak: np.ndarray
    leak_area: np.ndarray
    amplitude: np.ndarray
    omega: np.ndarray
    areas: np.ndarray
    stress: np.ndarray

    def first(self, n: int) -> Scenes:
        """The first n scenes."""
        return Scenes(*(np.ascontiguousarray(x[..., :n]) for x in self))


def scenes_of(stacks: list[Any], degree: int) -> Scenes:
    """Rows of stacks of three layers, gap second, under one sine each."""
    rows: list[list[Any]] = [[] for _ in Scenes._fields]
    at = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    for stack in stacks:
        wave = stack.waveform
        areas = 1.0 / stack.contact.area(0.5 * (at + 1.0) * wave.amplitude)
        chebyshev = np.polynomial.Chebyshev.fit(at, areas, degree, domain=[-1.0, 1.0])
        powers = chebyshev.convert(kind=np.polynomial.Polynomial).coef[::-1]
        cells = (stack.k, stack.g_total / stack.c, stack.g_area / stack.c)
        given = (*cells, wave.amplitude, 2.0 * np.pi * wave.frequency, powers, float(stack.contact.stress(1.0)))
        for row, value in zip(rows, given, strict=True):
            row.append(value)
    return Scenes(*(np.ascontiguousarray(np.array(row).T) for row in rows))


def rates(sine: Any, y: Any, s: Any) -> tuple[Any, Any, Any]:
    """Time derivatives of v_coating, v_gap and the integral of u_gap^2 A at sin(omega t), of arrays or numbers."""
    source = s.amplitude * sine
    coating, gap = s.share[0] * source + y[0], s.share[1] * source + y[1]
    skin = s.share[2] * source - y[0] - y[1]
    at = 2.0 * abs(gap) / s.amplitude - 1.0
    inverse = s.areas[0]
    for power in range(1, s.areas.shape[0]):
        inverse = inverse * at + s.areas[power]
    i0 = (s.leak[0] * inverse + s.leak_area[0]) * coating
    i1 = (s.leak[1] * inverse + s.leak_area[1]) * gap
    total = i0 + i1 + (s.leak[2] * inverse + s.leak_area[2]) * skin
    return s.share[0] * total - i0, s.share[1] * total - i1, gap * gap / inverse


def _classical(y: Any, s: Any, h: Any, sines: Any) -> tuple[Any, ...]:
    """One step of the classical Runge-Kutta method; `sines` at its start, middle and end."""
    k1 = rates(sines[0], y, s)
    k2 = rates(sines[1], tuple(a + 0.5 * h * b for a, b in zip(y, k1, strict=True)), s)
    k3 = rates(sines[1], tuple(a + 0.5 * h * b for a, b in zip(y, k2, strict=True)), s)
    k4 = rates(sines[2], tuple(a + h * b for a, b in zip(y, k3, strict=True)), s)
    stages = zip(y, k1, k2, k3, k4, strict=True)
    return tuple(a + h / 6.0 * (b + 2.0 * (c + d) + e) for a, b, c, d, e in stages)


def _sines(steps: int, periods: int) -> np.ndarray:
    """sin(omega t) at start, middle and end of every step; all scenes have the same phase."""
    t = np.arange(steps * periods)[:, None] + np.array([0.0, 0.5, 1.0])
    return np.sin(2.0 * np.pi * t / steps)


Run = Callable[[], np.ndarray]


def jax_rk4(scenes: Scenes, periods: int, steps: int) -> Run:
    """The method over all scenes in one compiled loop of JAX; XLA fuses a step's operations."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    given = Scenes(*map(jnp.asarray, scenes))
    sines = jnp.asarray(_sines(steps, periods))

    @jax.jit
    def solve(s: Scenes) -> Any:
        h = 2.0 * math.pi / s.omega / steps
        y = (jnp.zeros_like(s.omega),) * 3
        y, _ = jax.lax.scan(lambda y, row: (_classical(y, s, h, tuple(row)), None), y, sines)
        return s.stress * y[2] / (h * steps * periods)

    return lambda: np.asarray(solve(given).block_until_ready())


def diffrax_tsit5(scenes: Scenes, periods: int, rtol: float) -> Run:
    """Tsit5 with its own choice of steps for every scene, by `jax.vmap`."""
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    given = Scenes(*map(jnp.asarray, scenes))

    def rhs(t: Any, y: Any, s: Scenes) -> Any:
        return jnp.stack(rates(jnp.sin(s.omega * t), y, s))

    def one(s: Scenes) -> Any:
        stop = 2.0 * math.pi / s.omega * periods
        control = diffrax.PIDController(rtol=rtol, atol=rtol * jnp.array([1.0, 1.0, 1e-6]) * s.amplitude)
        run = diffrax.diffeqsolve(
            diffrax.ODETerm(rhs), diffrax.Tsit5(), 0.0, stop, stop / periods / 30.0, jnp.zeros(3), s,
            stepsize_controller=control, saveat=diffrax.SaveAt(t1=True), max_steps=100_000, throw=False,
        )  # fmt: skip
        return s.stress * run.ys[-1, 2] / stop

    solve = jax.jit(jax.vmap(one, in_axes=(Scenes(*(-1,) * len(Scenes._fields)),)))
    return lambda: np.asarray(solve(given).block_until_ready())


def torch_rk4(scenes: Scenes, periods: int, steps: int) -> Run:
    """The method over all scenes with torch's operations on arrays, one after the other."""
    import torch

    torch.set_num_threads(1)
    given = Scenes(*map(torch.as_tensor, scenes))
    sines = _sines(steps, periods).tolist()

    def solve() -> np.ndarray:
        with torch.no_grad():
            h = 2.0 * math.pi / given.omega / steps
            y: tuple[Any, ...] = (torch.zeros_like(given.omega),) * 3
            for row in sines:
                y = _classical(y, given, h, tuple(row))
            return np.asarray((given.stress * y[2] / (h * steps * periods)).numpy())

    return solve


@njit(nogil=True, parallel=True, fastmath=True)
def _loop(s: Scenes, sines: np.ndarray, steps: int) -> np.ndarray:
    """The method scene by scene, on all threads that numba may use."""
    out = np.empty(s.omega.size)
    for i in prange(s.omega.size):
        h = 2.0 * math.pi / s.omega[i] / steps
        y0 = y1 = y2 = 0.0
        for n in range(sines.shape[0]):
            k0 = k1 = k2 = t0 = t1 = t2 = 0.0
            for stage in range(4):
                late = 0.0 if stage == 0 else 0.5 if stage < 3 else 1.0
                weight = 1.0 if stage % 3 == 0 else 2.0
                source = s.amplitude[i] * sines[n, (stage + 1) // 2]
                v0, v1 = y0 + late * h * k0, y1 + late * h * k1
                gap = s.share[1, i] * source + v1
                at = 2.0 * abs(gap) / s.amplitude[i] - 1.0
                inverse = s.areas[0, i]
                for power in range(1, s.areas.shape[0]):
                    inverse = inverse * at + s.areas[power, i]
                i0 = (s.leak[0, i] * inverse + s.leak_area[0, i]) * (s.share[0, i] * source + v0)
                i1 = (s.leak[1, i] * inverse + s.leak_area[1, i]) * gap
                total = i0 + i1
                total += (s.leak[2, i] * inverse + s.leak_area[2, i]) * (s.share[2, i] * source - v0 - v1)
                k0, k1, k2 = s.share[0, i] * total - i0, s.share[1, i] * total - i1, gap * gap / inverse
                t0, t1, t2 = t0 + weight * k0, t1 + weight * k1, t2 + weight * k2
            y0, y1, y2 = y0 + h / 6.0 * t0, y1 + h / 6.0 * t1, y2 + h / 6.0 * t2
        out[i] = s.stress[i] * y2 / (h * sines.shape[0])
    return out


def numba_rk4(scenes: Scenes, periods: int, steps: int) -> Run:
    """The method in a compiled loop over scenes."""
    sines = _sines(steps, periods)
    return lambda: np.asarray(_loop(scenes, sines, steps))


#: For each contestant: how many scenes it is timed with, its settings from coarse to fine, and its maker.
CONTESTANTS: dict[str, tuple[int, list[float], Callable[[Scenes, int, Any], Run]]] = {
    "numba RK4": (4096, [16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024], numba_rk4),
    "JAX RK4": (4096, [16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024], jax_rk4),
    "diffrax Tsit5, vmap": (1024, [1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9], diffrax_tsit5),
    "torch RK4": (4096, [16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024], torch_rk4),
}


def cheapest(name: str, scenes: Scenes, periods: int, expected: np.ndarray, error: float) -> tuple[float, float] | None:
    """The coarsest setting with which the first scenes' means have at most this error, and that error; None if none."""
    _, settings, make = CONTESTANTS[name]
    few = scenes.first(expected.size)
    for setting in settings:
        off = float(np.max(np.abs(make(few, periods, setting)() / expected - 1.0)))
        if off <= error:
            return setting, off
    return None
