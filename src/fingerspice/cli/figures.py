"""The command that draws the paper's figures."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from fingerspice.base.errors import InputError
from fingerspice.cli.answers import AsJson, Out
from fingerspice.cli.options import check_output
from fingerspice.cli.result_files import FOLDER
from fingerspice.cli.terminal import Answering, progress


def figures(
    out: Out = None,
    only: Annotated[list[int] | None, typer.Option(help="Only these of the paper's figures 2 to 5.")] = None,
    gallery: Annotated[
        bool,
        typer.Option("--gallery", help="The explorer's scenes instead, and the decks in the folder circuits."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Draw the paper's Figs. 2 to 5 from scratch, each as PNG with its data as CSV; or a gallery.

    Examples:

      fingerspice figures --out out --only 4 --only 5

      fingerspice figures --gallery
    """
    folder = out or FOLDER
    with Answering("figures", as_json) as answer:
        if gallery:
            if only:
                raise InputError("--only and --gallery are both given; allowed: one of them")
            _gallery(folder / "gallery", answer)
            return
        from fingerspice.studies.figures import FIGURES, make_figures

        for number in only or FIGURES:
            for kind in ("png", "csv"):
                check_output(folder / f"fig{number}.{kind}")
        with progress("drawing") as update:
            files = make_figures(folder, only=only, progress=update)
        answer.give(str, [partial(Path, file) for file in files])


def _gallery(folder: Path, answer: Answering) -> None:
    """Draw the scenes of the explorer and the decks of `circuits` below the current folder."""
    from fingerspice.explorer.gallery import decks, draw, scenes

    entries = [*decks(Path("circuits")), *scenes()]
    files = [folder / f"{one.name}.png" for one in entries]
    for file in files:
        check_output(file)
    with progress("drawing") as update:
        folder.mkdir(parents=True, exist_ok=True)
        for i, (one, file) in enumerate(zip(entries, files, strict=True)):
            draw(one, file)
            if update is not None:
                update((i + 1) / len(files))
    answer.give(str, [partial(Path, file) for file in files])
