"""The waveform of a drive as a module's parameter: its gradient by every sample comes from one way back."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from fingerspice.base.arrays import FloatArray, positive_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.arguments import require_circuit
from fingerspice.circuit.circuit import Circuit
from fingerspice.results.outcome import SolveError
from fingerspice.results.sensitivity import MEANS
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import simulate
from fingerspice.torch.scenes import Scenes, request, tensor_of
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import require


@dataclass(frozen=True)
class _Driven:
    """Runs of a circuit under other recordings of one source."""

    scenes: Scenes
    source: str
    rate: float

    def runs(self, given: FloatArray) -> list[Solution]:
        """A run for each row of samples, shape (n_scene, n)."""
        one, found = self.scenes, []
        times = one.t if one.t.size else np.array([one.t_stop])
        for i, row in enumerate(given):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", FingerspiceWarning)
                    sources = {self.source: Samples(row, self.rate)}
                    how = {"t_stop": one.t_stop, "t_eval": times, "rtol": one.rtol, "charge": False}
                    found.append(simulate(one.circuit, sources=sources, **how))  # type: ignore[arg-type]
            except (InputError, SolveError) as error:
                raise InputError(f"drive {i}: {error}") from error
        return found


class Drive(torch.nn.Module):
    """A circuit under a recording whose samples are the module's parameter `samples`, V.

    The gradient by all samples costs a few runs, however many samples there are (`Solution.sample_gradient`).

    Parameters
    ----------
    circuit : Circuit
        One with one GAP.
    samples : array_like, shape (..., n)
        V; several rows are several drives.
    rate : float
        Samples per second; the first one is at 0 s.
    outputs : str or sequence of str
        As for `Simulator`.
    t : array_like, optional
        Times of the signals, s, ascending.
    t_stop : float, optional
        End of every run, s; the deck's TSTOP by default.
    source : str, optional
        The source that is replaced; needed where there are several.
    rtol : float
        Error of every run, as in `simulate`.

    Raises
    ------
    InputError
        If the circuit is another one, or a source, output or time is unknown or missing.
    """

    def __init__(
        self,
        circuit: Circuit,
        samples: Tensor | ArrayLike,
        rate: float,
        outputs: str | Sequence[str] = "f_el_mean",
        *,
        t: ArrayLike | None = None,
        t_stop: float | None = None,
        source: str | None = None,
        rtol: float = 1e-8,
    ) -> None:
        super().__init__()
        require_circuit(circuit)
        names = [element.name for element in circuit.elements if element.waveform is not None]
        known = {name.lower(): name for name in names}
        if source is None:
            require(len(names) == 1, "source", "missing", f"one of {', '.join(names)}")
            source = names[0]
        require(source.lower() in known, "source", repr(source), f"one of {', '.join(names)}")
        self._alone = isinstance(outputs, str)
        wanted = (outputs,) if isinstance(outputs, str) else tuple(outputs)
        self._driven = _Driven(
            request(circuit, wanted, t, t_stop, False, rtol), known[source.lower()], positive_number("rate", rate, "Hz")
        )
        self.samples = torch.nn.Parameter(tensor_of("samples", samples).detach().clone())

    def forward(self, samples: Tensor | ArrayLike | None = None) -> Tensor | dict[str, Tensor]:
        """Run all drives.

        Parameters
        ----------
        samples : tensor or array_like, shape (..., n), optional
            Instead of the module's own, V.

        Returns
        -------
        tensor, or dict of str to tensor
            Of the shape (...) of the drives, and of one more dimension, the times, for signals. A dict by name if
            several outputs were asked for.

        Raises
        ------
        InputError
            If a drive cannot be run; the message names it.
        """
        given = self.samples if samples is None else tensor_of("samples", samples)
        require(given.ndim > 0, "samples", "one number", "a row of two or more")
        scenes = self._driven.scenes
        found: Tensor = _Run.apply(self._driven, given)
        parts = dict(zip(scenes.outputs, found.split(scenes.sizes, dim=-1), strict=True))
        parts = {name: part.squeeze(-1) if name in MEANS else part for name, part in parts.items()}
        return parts[scenes.outputs[0]] if self._alone else parts


def _backward(ctx: Any, by_output: Tensor) -> tuple[None, Tensor]:
    """Derivatives by the samples, from one way back through every run."""
    scenes, out = ctx.driven.scenes, np.zeros((len(ctx.runs), ctx.shape[-1]))
    edges = np.cumsum([0, *scenes.sizes])
    for i, (run, row) in enumerate(zip(ctx.runs, by_output.reshape(len(ctx.runs), -1).numpy(), strict=True)):
        parts = zip(scenes.outputs, edges, edges[1:], strict=False)
        weights = {name: row[a] if name in MEANS else row[a:b] for name, a, b in parts}
        out[i] = run.sample_gradient(**weights).values
    return None, torch.from_numpy(out).reshape(ctx.shape)


# The methods have the names and signatures that torch calls.
class _Run(torch.autograd.Function):
    """The outputs of drives of shape (..., n): a tensor of shape (..., number of outputs)."""

    @staticmethod
    def forward(ctx: Any, driven: _Driven, samples: Tensor) -> Tensor:
        runs = driven.runs(samples.detach().numpy().reshape(-1, samples.shape[-1]))
        ctx.driven, ctx.runs, ctx.shape = driven, runs, samples.shape
        rows = [np.concatenate([np.ravel(getattr(run, name)) for name in driven.scenes.outputs]) for run in runs]
        return torch.from_numpy(np.stack(rows)).reshape(*samples.shape[:-1], -1)

    # Not a decorator: without torch, types are not known.
    backward: Any = staticmethod(torch.autograd.function.once_differentiable(_backward))
