"""A circuit as a module of PyTorch: values from the package's own runs, derivatives from differences of runs.

This package is loaded only where it is asked for, and needs torch.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, positive_number, real_numbers
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import own_path, require_circuit
from fingerspice.results.outcome import SolveError
from fingerspice.results.solution import DERIVED, MEANS, Solution
from fingerspice.solve.derivatives import check_signals
from fingerspice.solve.simulation import rtol_given, simulate
from fingerspice.studies.batch.batch import LEAST_RTOL, REFUSED, batch
from fingerspice.studies.batch.lockstep import lockstep_form, why_alone
from fingerspice.studies.steady import steady_state
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import refuse, require

try:
    import torch
    from torch import Tensor
except ImportError:
    missing = "fingerspice.torch needs torch, which is not installed; pip install 'fingerspice[torch]'"
    raise InputError(missing) from None

__all__ = ["Drive", "Simulator"]


class Runs(torch.nn.Module):
    """A module that runs a circuit; what is asked of it, as of `Simulator`, is checked."""

    def __init__(
        self, circuit: Circuit, outputs: str | Sequence[str], t: ArrayLike | None, t_stop: float | None,
        periodic: bool, rtol: float,
    ) -> None:  # fmt: skip
        super().__init__()
        require_circuit(circuit)
        gaps = len(circuit.by_device("GAP"))
        refuse(gaps != 1, f"the circuit has {gaps} GAPs; allowed: one")
        self.circuit, self.periodic, self.alone = circuit, bool(periodic), isinstance(outputs, str)
        # Names out of `DERIVED` and `MEANS`.
        self.outputs = (outputs,) if isinstance(outputs, str) else tuple(outputs)
        for name in self.outputs:
            refuse(name not in MEANS + DERIVED, f"unknown output {name!r}; allowed: {', '.join(MEANS + DERIVED)}")
        check_signals(circuit, self.outputs)
        require(bool(self.outputs), "outputs", "empty", "one or more names")
        require(len(set(self.outputs)) == len(self.outputs), "outputs", repr(self.outputs), "every name once")
        signals = [name for name in self.outputs if name in DERIVED]
        # Times of the signals, s; none where there are only means
        self.t = np.zeros(0) if t is None else real_numbers("t", t, "numbers in s")
        if signals and (self.t.ndim != 1 or not self.t.size):
            raise InputError(f"{signals[0]} is asked for, and t is {t!r}; allowed: a row of times in s")
        if not signals and t is not None:
            raise InputError(f"t is given, and no signal is asked for; allowed: outputs such as {', '.join(DERIVED)}")
        # End of every run, s; none where only the periodic state is asked for
        deck = None if circuit.tran is None else circuit.tran.stop
        self.t_stop = deck if t_stop is None else positive_number("t_stop", t_stop, "s")
        endless = self.t_stop is None and (signals or not periodic)
        refuse(endless, "no t_stop: the deck has no .tran line and none was given; give t_stop in s")
        self.rtol = rtol_given(rtol, LEAST_RTOL)
        # How many numbers each output has
        self.sizes = [1 if name in MEANS else self.t.size for name in self.outputs]

    def values(self, paths: Sequence[str], given: FloatArray, wanted: Sequence[str] = ()) -> FloatArray:
        """The outputs one after the other, shape (n_scene, sum of `sizes`), at values `given` (n_scene, n_path).

        With `wanted`, their derivatives by these parameters, shape (n_scene, sum of `sizes`, n_wanted).
        """
        # Where derivatives are not to be had in lockstep, a batch would also run every scene for its outputs.
        why = why_alone(lockstep_form(self.circuit, paths), self.outputs, self.rtol) if wanted else ""
        if not self.t.size and not why:
            # The means, or their derivatives, of all scenes at once.
            found = batch(
                self.circuit, dict(zip(paths, given.T, strict=True)), outputs=self.outputs, rtol=self.rtol,
                periodic=self.periodic, t_stop=None if self.periodic else self.t_stop, gradients=wanted,
            )  # fmt: skip
            bad = np.flatnonzero(found["gradient_status" if wanted else "status"].to_numpy() >= REFUSED)
            if bad.size:
                raise InputError(f"{bad.size} of {len(given)} scenes cannot be run; {found.attrs['failures'][0]}")
            return np.stack([found[f"d_{name}" if wanted else name].to_numpy() for name in self.outputs], axis=1)
        rows = []
        for i, row in enumerate(given):
            with named("scene", i):
                circuit = self.circuit.varied(dict(zip(paths, row.tolist(), strict=True)))
                runs: dict[str, Any] = {}
                if self.t.size or not self.periodic:
                    start = "periodic" if self.periodic else "deck"
                    runs = dict.fromkeys(self.outputs, self.run(circuit, start=start, sensitivities=wanted))
                if of_period := [name for name in self.outputs if self.periodic and name in MEANS]:
                    state = steady_state(circuit, rtol=self.rtol, points=4, charge=False, sensitivities=wanted)
                    runs |= dict.fromkeys(of_period, state)
                by = [np.hstack([getattr(run.sensitivities[x], name) for name, run in runs.items()]) for x in wanted]
                own = np.hstack([getattr(run, name) for name, run in runs.items()])
                rows.append(np.stack(by, axis=-1) if wanted else own)
        return np.array(rows)

    def by_name(self, found: Tensor) -> dict[str, Tensor]:
        """The outputs in a tensor (..., sum of `sizes`) by their names."""
        parts = zip(self.outputs, found.split(self.sizes, dim=-1), strict=True)
        return {name: part.squeeze(-1) if name in MEANS else part for name, part in parts}

    def given_back(self, found: Tensor) -> Tensor | dict[str, Tensor]:
        """What a call gives: the outputs by their names, or the one that was asked for alone."""
        return self.by_name(found)[self.outputs[0]] if self.alone else self.by_name(found)

    def run(self, circuit: Circuit, **how: Any) -> Solution:
        """A run of a circuit, with outputs at the times `t`, or at its end where there are only means."""
        t = self.t if self.t.size else np.array([self.t_stop])
        return simulate(circuit, t_stop=self.t_stop, t_eval=t, rtol=self.rtol, charge=False, **how)


@contextmanager
def named(what: str, number: int) -> Iterator[None]:
    """Names the scene or drive in an error, and leaves out warnings about values that an optimiser has chosen."""
    try:
        with warnings.catch_warnings(action="ignore", category=FingerspiceWarning):
            yield
    except (InputError, SolveError) as error:
        raise InputError(f"{what} {number}: {error}") from error


def tensor_of(path: str, one: Tensor | ArrayLike) -> Tensor:
    """A value in double precision on the processor."""
    if not isinstance(one, Tensor):
        one = torch.from_numpy(real_numbers(path, one, "a tensor or array of numbers").copy())
    require(not one.is_complex() and one.dtype != torch.bool, path, f"a tensor of {one.dtype}", "real numbers")
    return one.to("cpu", torch.float64)


class Drive(Runs):
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
    outputs, t, t_stop
        As for `Simulator`.
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
        self, circuit: Circuit, samples: Tensor | ArrayLike, rate: float, outputs: str | Sequence[str] = "f_el_mean", *,
        t: ArrayLike | None = None, t_stop: float | None = None, source: str | None = None, rtol: float = 1e-8,
    ) -> None:  # fmt: skip
        super().__init__(circuit, outputs, t, t_stop, False, rtol)
        known = {element.name.lower(): element.name for element in circuit.elements if element.waveform is not None}
        allowed = f"one of {', '.join(known.values())}"
        require(source is not None or len(known) == 1, "source", "missing", allowed)
        key = next(iter(known)) if source is None else source.lower()
        require(key in known, "source", repr(source), allowed)
        self._source, self._rate = known[key], positive_number("rate", rate, "Hz")
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
            As of `Simulator.forward`; (...) is the shape of the drives.

        Raises
        ------
        InputError
            If a drive cannot be run; the message names it.
        """
        given = self.samples if samples is None else tensor_of("samples", samples)
        require(given.ndim > 0, "samples", "one number", "a row of two or more")
        return self.given_back(_DriveRun.apply(self, given))


# The methods have the names and signatures that torch calls.
class _DriveRun(torch.autograd.Function):
    """The outputs of drives of shape (..., n): a tensor of shape (..., number of outputs)."""

    @staticmethod
    def forward(ctx: Any, drive: Drive, samples: Tensor) -> Tensor:
        ctx.drive, ctx.runs, ctx.shape = drive, [], samples.shape
        for i, row in enumerate(samples.detach().numpy().reshape(-1, samples.shape[-1])):
            with named("drive", i):
                ctx.runs.append(drive.run(drive.circuit, sources={drive._source: Samples(row, drive._rate)}))
        rows = [np.hstack([getattr(run, name) for name in drive.outputs]) for run in ctx.runs]
        return torch.from_numpy(np.stack(rows)).reshape(*samples.shape[:-1], -1)

    @staticmethod
    def _backward(ctx: Any, by_output: Tensor) -> tuple[None, Tensor]:
        """Derivatives by the samples, from one way back through every run."""
        rows = []
        for run, row in zip(ctx.runs, by_output.reshape(len(ctx.runs), -1), strict=True):
            rows.append(run.sample_gradient(**{k: x.numpy() for k, x in ctx.drive.by_name(row).items()}).values)
        return None, torch.from_numpy(np.stack(rows)).reshape(ctx.shape)

    # Not a decorator: without torch, types are not known.
    backward: Any = staticmethod(torch.autograd.function.once_differentiable(_backward))


class Simulator(Runs):
    """A circuit whose parameters are those of a module, and whose runs have exact derivatives by them.

    Every parameter is a `torch.nn.Parameter` in double precision, in the netlist's unit, whose name is the path with
    ``_`` for its dots: ``Xgap.d`` is `Xgap_d`. Tensors of several values are many scenes; their shapes are broadcast.

    Parameters
    ----------
    circuit : Circuit
        One with one GAP.
    parameters : sequence of str, or mapping of str to array_like
        Paths, as in `Circuit.replace`, of the circuit and its waveform; a mapping gives the values to start from, which
        are otherwise the circuit's. ``source.`` stands for the only source.
    outputs : str or sequence of str
        Means ``f_el_mean``, ``f_t_mean``, ``friction_mean`` and ``area_mean``, and signals at the times `t`: ``u_gap``,
        ``area``, ``f_el``, ``f_t`` and ``friction``.
    t : array_like, optional
        Times of the signals, s, ascending.
    t_stop : float, optional
        End of every run, s; the deck's TSTOP by default.
    periodic : bool
        Take the periodic state: means are those of a period.
    logarithms : bool
        Let the module's parameters be the natural logarithms of the values, so that one step length suits all of them.
    rtol : float
        Error of every run, as in `simulate`, and of means relative to themselves, as in `batch`.

    Raises
    ------
    InputError
        If the circuit is another one, or a path, output or time is unknown or missing.
    """

    def __init__(
        self, circuit: Circuit, parameters: Sequence[str] | Mapping[str, ArrayLike] = (),
        outputs: str | Sequence[str] = "f_el_mean", *, t: ArrayLike | None = None, t_stop: float | None = None,
        periodic: bool = False, logarithms: bool = False, rtol: float = 1e-8,
    ) -> None:  # fmt: skip
        super().__init__(circuit, outputs, t, t_stop, periodic, rtol)
        self.logarithms, self.paths = logarithms, dict[str, str]()
        single = isinstance(parameters, str)
        require(not single, "parameters", repr(parameters), "a sequence of paths such as ('Xgap.d',)")
        for given in parameters:
            path = own_path(circuit, given)
            require(path not in self.paths, path, "given twice", "once")
            one = parameters[given] if isinstance(parameters, Mapping) else circuit.parameters[path].value
            value = tensor_of(given, one).detach().clone()
            good = not logarithms or bool((value > 0.0).all())
            require(good, path, f"{value.min():g}, and logarithms are asked for", "more than 0")
            self.paths[path] = path.replace(".", "_")
            self.register_parameter(self.paths[path], torch.nn.Parameter(value.log() if logarithms else value))

    def extra_repr(self) -> str:
        """The module's parameters and outputs, for its text."""
        return f"{', '.join(self.paths)} -> {', '.join(self.outputs)}"

    def value(self, path: str) -> Tensor:
        """Value of one of the module's parameters in the netlist's unit.

        Raises
        ------
        InputError
            If it is no parameter of the module.
        """
        name = own_path(self.circuit, path)
        if name not in self.paths:
            raise InputError(f"{name} is no parameter of this module; allowed: {', '.join(self.paths) or 'none'}")
        held: Tensor = getattr(self, self.paths[name])
        return held.exp() if self.logarithms else held

    def forward(self, values: Mapping[str, Tensor | ArrayLike] | None = None) -> Tensor | dict[str, Tensor]:
        """Run all scenes.

        Parameters
        ----------
        values : mapping of str to tensor or array_like, optional
            Path to values in the netlist's unit; instead of the module's own parameters, or besides them.

        Returns
        -------
        tensor, or dict of str to tensor
            Of the shape that the values' shapes give together, and of one more dimension, the times, for signals. A
            dict by name if several outputs were asked for.

        Raises
        ------
        InputError
            If a path is unknown, a value is out of range, shapes do not fit, or a scene cannot be run.
        """
        given = {own_path(self.circuit, path): tensor_of(path, one) for path, one in (values or {}).items()}
        every = {path: tensor_of(path, self.value(path)) for path in self.paths if path not in given} | given
        refuse(not every, "there are no values; allowed: parameters of the module, or values for its call")
        try:
            shaped = torch.broadcast_tensors(*every.values())
        except RuntimeError:
            shapes = ", ".join(f"{tuple(one.shape)} ({path})" for path, one in every.items())
            raise InputError(f"the values have shapes {shapes}; allowed: shapes that broadcast") from None
        return self.given_back(_Run.apply(self, tuple(every), (), *shaped))


# The methods have the names and signatures that torch calls.
class _Run(torch.autograd.Function):
    """The outputs of scenes at values of one shape (...), or derivatives by `wanted`, as of `Runs.values`."""

    @staticmethod
    def forward(module: Runs, paths: tuple[str, ...], wanted: tuple[str, ...], *values: Tensor) -> Tensor:
        rows = torch.stack([one.flatten() for one in values], dim=1).numpy(force=True)
        found = module.values(paths, rows, wanted)
        return torch.from_numpy(found).reshape(*values[0].shape, *found.shape[1:])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.module, ctx.paths, ctx.wanted, *values = inputs
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*values)
        ctx.save_for_forward(*values)

    @staticmethod
    def backward(ctx: Any, by_output: Tensor | None) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[3:]
        wanted = tuple(path for path, need in zip(ctx.paths, needed, strict=True) if need)
        if by_output is None or not wanted:
            return (None,) * (3 + len(needed))
        each = iter((by_output.unsqueeze(-1) * _slopes(ctx, wanted)).sum(-2).unbind(-1))
        return (None, None, None, *(next(each) if need else None for need in needed))

    @staticmethod
    def jvp(ctx: Any, *moves: Tensor | None) -> Tensor | None:
        moved = [(path, one) for path, one in zip(ctx.paths, moves[3:], strict=True) if one is not None]
        if not moved:
            return None
        slopes = _slopes(ctx, tuple(path for path, _ in moved))
        return (slopes * torch.stack([one for _, one in moved], dim=-1).unsqueeze(-2)).sum(-1)

    @staticmethod
    def vmap(info: Any, dims: tuple[Any, ...], module: Runs, paths: Any, wanted: Any, *values: Tensor) -> Any:
        # Tensors of one shape, with the mapped dimension first in all of them.
        each = [
            one.movedim(dim, 0) if dim is not None else one.expand(info.batch_size, *one.shape)
            for one, dim in zip(values, dims[3:], strict=True)
        ]
        return _Run.apply(module, paths, wanted, *each), 0


def _slopes(ctx: Any, wanted: tuple[str, ...]) -> Tensor:
    """Derivatives of a run's outputs by the parameters `wanted`."""
    refuse(ctx.wanted, "second derivatives of a run are asked for; allowed: first derivatives")
    return _Run.apply(ctx.module, ctx.paths, wanted, *ctx.saved_tensors)
