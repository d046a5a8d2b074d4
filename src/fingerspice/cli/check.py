"""The command `check`, which verifies the checksums of a store."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fingerspice.cli.answers import AsJson
from fingerspice.cli.terminal import Answering


def check(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="Folder that run --stream or sweep --store wrote.")],
    as_json: AsJson = False,
) -> None:
    """Verify that every chunk of a store is as it was written.

    Example:

      fingerspice check out/long.zarr
    """
    from fingerspice.results.datafiles import check_store

    with Answering("check", as_json) as answer:
        chunks = check_store(store)
        answer.update(chunks=chunks)
        said = f"{store}: {sum(chunks.values()):,} chunks of {len(chunks)} arrays are as they were written"
        answer.give(lambda: said)
