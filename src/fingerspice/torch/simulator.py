"""A circuit as a module of PyTorch: values from the package's own runs, derivatives from differences of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from fingerspice.base.errors import InputError
from fingerspice.circuit.arguments import require_circuit
from fingerspice.circuit.circuit import Circuit
from fingerspice.studies.batch.task import own_path
from fingerspice.torch.scenes import Scenes, request, tensor_of


class Simulator(torch.nn.Module):
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
        self,
        circuit: Circuit,
        parameters: Sequence[str] | Mapping[str, ArrayLike] = (),
        outputs: str | Sequence[str] = "f_el_mean",
        *,
        t: ArrayLike | None = None,
        t_stop: float | None = None,
        periodic: bool = False,
        logarithms: bool = False,
        rtol: float = 1e-8,
    ) -> None:
        super().__init__()
        require_circuit(circuit)
        gaps = circuit.by_device("GAP")
        if len(gaps) != 1:
            raise InputError(f"the circuit has {len(gaps)} GAPs; allowed: one")
        self.circuit, self.logarithms = circuit, logarithms
        self._scenes = request(circuit, outputs, t, t_stop, periodic, rtol)
        self.paths: dict[str, str] = {}
        for path, value in _initial(circuit, parameters).items():
            if logarithms and not bool((value > 0.0).all()):
                raise InputError(f"{path} is {value.min():g}, and logarithms are asked for; allowed: more than 0")
            self.paths[path] = path.replace(".", "_")
            self.register_parameter(self.paths[path], torch.nn.Parameter(value.log() if logarithms else value))

    def extra_repr(self) -> str:
        """The module's parameters and outputs, for its text."""
        return f"{', '.join(self.paths)} -> {', '.join(self._scenes.outputs)}"

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
        given = {}
        for path, one in ({} if values is None else values).items():
            given[own_path(self.circuit, path)] = tensor_of(path, one)
        own = {path: tensor_of(path, self.value(path)) for path in self.paths if path not in given}
        every = {**own, **given}
        if not every:
            raise InputError("there are no values; allowed: parameters of the module, or values for its call")
        try:
            shaped = torch.broadcast_tensors(*every.values())
        except RuntimeError:
            shapes = ", ".join(f"{tuple(one.shape)} ({path})" for path, one in every.items())
            raise InputError(f"the values have shapes {shapes}; allowed: shapes that broadcast") from None
        found: Tensor = _Run.apply(self._scenes, tuple(every), (), *shaped)
        return self._scenes.given_back(found)


def _initial(circuit: Circuit, parameters: Sequence[str] | Mapping[str, ArrayLike]) -> dict[str, Tensor]:
    """The values to start from, by path in the circuit's own spelling."""
    if isinstance(parameters, str):
        raise InputError(f"parameters is {parameters!r}; allowed: a sequence of paths such as ('Xgap.d',)")
    found: dict[str, Tensor] = {}
    for path in parameters:
        name = own_path(circuit, path)
        if name in found:
            raise InputError(f"{name} is given twice; allowed: once")
        one = parameters[path] if isinstance(parameters, Mapping) else circuit.parameters[name].value
        found[name] = tensor_of(path, one).detach().clone()
    return found


# The methods have the names and signatures that torch calls.
class _Run(torch.autograd.Function):
    """The outputs of scenes at values of one shape (...): a tensor of shape (..., number of outputs).

    With `wanted`, their derivatives by these parameters: of shape (..., number of outputs, number of parameters).
    """

    generate_vmap_rule = False

    @staticmethod
    def forward(scenes: Scenes, paths: tuple[str, ...], wanted: tuple[str, ...], *values: Tensor) -> Tensor:
        rows = torch.stack([one.flatten() for one in values], dim=1).numpy(force=True)
        found = scenes.values(paths, rows, wanted)
        return torch.from_numpy(found).reshape(*values[0].shape, *found.shape[1:])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.scenes, ctx.paths, ctx.wanted, *values = inputs
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
    def vmap(info: Any, dims: tuple[Any, ...], scenes: Scenes, paths: Any, wanted: Any, *values: Tensor) -> Any:
        # Tensors of one shape, with the mapped dimension first in all of them.
        each = [
            one.movedim(dim, 0) if dim is not None else one.expand(info.batch_size, *one.shape)
            for one, dim in zip(values, dims[3:], strict=True)
        ]
        return _Run.apply(scenes, paths, wanted, *each), 0


def _slopes(ctx: Any, wanted: tuple[str, ...]) -> Tensor:
    """Derivatives of a run's outputs by the parameters `wanted`."""
    if ctx.wanted:
        raise InputError("second derivatives of a run are asked for; allowed: first derivatives")
    found: Tensor = _Run.apply(ctx.scenes, ctx.paths, wanted, *ctx.saved_tensors)
    return found
