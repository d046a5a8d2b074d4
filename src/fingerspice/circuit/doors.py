"""Methods of a circuit that show it: each calls an upper part, which is loaded only then."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fingerspice.base.pages import Shown


class Doors(Shown):
    """What a circuit shows of itself."""

    def draw(self, path: str | Path | None = None) -> Any:
        """Draw the schematic: a notebook shows it as SVG, and from a script ``draw().show()`` opens a window.

        Layers stand as a resistor beside a capacitor, or as a capacitor alone where they do not leak; nodes are rows,
        and the lowest one is ground.

        Parameters
        ----------
        path : str or Path, optional
            File to write, whose end says its kind: ``.svg`` or ``.png``.

        Returns
        -------
        Schematic
            A matplotlib figure.

        Raises
        ------
        InputError
            If the path has another end or cannot be written, or the circuit has too many elements for a picture.
        """
        from fingerspice.plots.schematic import draw_circuit

        return draw_circuit(self, path)  # type: ignore[arg-type]

    def explore(self) -> Any:
        """Show the circuit on a local page, in a notebook below the cell (docs/explore.md).

        Returns
        -------
        Explorer
            The running page.
        """
        from fingerspice.explorer.server import explore

        return explore(self)  # type: ignore[arg-type]
