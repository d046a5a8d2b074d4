"""The class of this package's figures, which appear in notebooks and can be shown in a window."""

from __future__ import annotations

import io
import sys
from typing import Any

from matplotlib.backend_bases import FigureManagerBase
from matplotlib.figure import Figure

from fingerspice.base.errors import InputError
from fingerspice.base.pages import in_notebook

#: Resolution (dots per inch) of the picture in a notebook, and the factor by which the notebook scales it down.
_DPI, _SHARPER = 200, 2


class Picture(Figure):
    """A matplotlib figure, saved with ``savefig`` and shown with `show`."""

    def _repr_png_(self) -> tuple[bytes, dict[str, Any]]:
        content = io.BytesIO()
        self.savefig(content, format="png", dpi=_DPI)
        width, height = (int(_DPI * x / _SHARPER) for x in self.get_size_inches())
        return content.getvalue(), {"width": width, "height": height}

    def show(self, warn: bool = True) -> None:
        """Show the picture: in a notebook under the cell; from a script in a window, until the window is closed.

        Raises
        ------
        InputError
            If there is no notebook and no window can be opened.
        """
        if in_notebook():
            # IPython is not a dependency: take it from `sys.modules`, as a notebook has imported it.
            sys.modules["IPython"].display.display(self)
            return
        import matplotlib
        from matplotlib import pyplot
        from matplotlib._pylab_helpers import Gcf
        from matplotlib.backends.registry import backend_registry

        backend = matplotlib.get_backend()
        registry: Any = backend_registry
        canvas = registry.load_backend_module(backend).FigureCanvas
        if not _opens(canvas.manager_class):
            raise InputError(
                f"no window can be opened here (matplotlib's backend is {backend}); allowed: savefig('picture.png')"
            )
        # These are the steps of pyplot: matplotlib has no public function that opens a window for a given figure.
        manager = canvas.new_manager(self, max(pyplot.get_fignums(), default=0) + 1)
        Gcf._set_new_active_manager(manager)
        pyplot.show()


def _opens(manager: Any) -> bool:
    """Whether a backend's manager opens windows."""
    own = ("pyplot_show", "start_main_loop")
    return any(getattr(manager, name).__func__ is not getattr(FigureManagerBase, name).__func__ for name in own)
