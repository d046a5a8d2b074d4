"""The command that draws the paper's figures."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from fingerspice.cli.arguments import AsJson, Out
from fingerspice.cli.options import check_output
from fingerspice.cli.result_files import FOLDER
from fingerspice.cli.terminal import Answering, progress


def figures(
    out: Out = None,
    only: Annotated[list[int] | None, typer.Option(help="Only these of the paper's figures 2 to 5.")] = None,
    as_json: AsJson = False,
) -> None:
    """Draw the paper's Figs. 2 to 5 from scratch, each as PNG with its data as CSV.

    Example:

      fingerspice figures --out out --only 4 --only 5
    """
    from fingerspice.studies.figures import FIGURES, make_figures

    folder = out or FOLDER
    with Answering("figures", as_json) as answer:
        for number in only or FIGURES:
            for kind in ("png", "csv"):
                check_output(folder / f"fig{number}.{kind}")
        with progress("drawing") as update:
            files = make_figures(folder, only=only, progress=update)
        answer.give(str, [partial(Path, file) for file in files])
