"""The command `sets`, which lists the named sets of parameters, or shows one."""

from __future__ import annotations

from typing import Annotated

import typer

from fingerspice.cli.arguments import AsJson
from fingerspice.cli.terminal import Answering


def sets(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="A set; without it all are listed.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the named sets of parameters, or show the values of one with their ranges and sources.

    Examples:

      fingerspice sets

      fingerspice sets moist
    """
    from fingerspice.sets.parameters import parameters

    with Answering("sets", as_json) as answer:
        found = parameters() if name is None else parameters(name)
        shown = parameters().values() if name is None else [parameters(name)]
        answer.update(parameter_sets=[one.to_dict() for one in shown])
        answer.give(lambda: str(found))
