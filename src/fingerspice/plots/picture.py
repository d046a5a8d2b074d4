"""The class of this package's figures, which appear in notebooks and can be shown in a window."""

from __future__ import annotations

import io
import sys
from typing import Any

from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fingerspice.base.errors import InputError
from fingerspice.base.pages import in_notebook

#: Resolution (dots per inch) of the picture in a notebook, and the factor by which the notebook scales it down.
_DPI, _SHARPER = 200, 2


class Picture(Figure):
    """A matplotlib figure, saved with ``savefig`` and shown with `show`; a notebook shows it at the cell's end."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        # With this canvas it can be saved without a display.
        FigureCanvasAgg(self)
        if in_notebook():
            _waiting.append(self)
            sys.modules["IPython"].get_ipython().events.register("post_execute", _show_waiting)

    def _repr_png_(self) -> tuple[bytes, dict[str, Any]]:
        content = io.BytesIO()
        self.savefig(content, format="png", dpi=_DPI)
        width, height = (int(_DPI * x / _SHARPER) for x in self.get_size_inches())
        return content.getvalue(), {"width": width, "height": height}

    def _content(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """What a notebook shows, by its type, and its size."""
        png, size = self._repr_png_()
        return {"image/png": png}, {"image/png": size}

    def _ipython_display_(self) -> None:
        # It goes before the way in which ``%matplotlib inline`` shows figures.
        if not in_notebook():
            raise NotImplementedError
        self.show()

    def show(self, warn: bool = True) -> None:
        """Show the picture: in a notebook under the cell; from a script in a window, until the window is closed.

        Raises
        ------
        InputError
            If there is no notebook and no window can be opened.
        """
        if in_notebook():
            if self in _waiting:
                _waiting.remove(self)
            content, sizes = self._content()
            # IPython is not a dependency: take it from `sys.modules`, as a notebook has imported it.
            display = sys.modules["IPython"].display.display
            display({"text/plain": repr(self), **content}, metadata=sizes, raw=True)
            return
        import matplotlib
        from matplotlib import pyplot
        from matplotlib._pylab_helpers import Gcf
        from matplotlib.backends.registry import backend_registry

        backend = matplotlib.get_backend()
        registry: Any = backend_registry
        canvas = registry.load_backend_module(backend).FigureCanvas
        # Of a backend that opens windows, the manager has one of these methods of its own.
        own, plain = canvas.manager_class, FigureManagerBase
        if all(getattr(own, x).__func__ is getattr(plain, x).__func__ for x in ("pyplot_show", "start_main_loop")):
            raise InputError(
                f"no window can be opened here (matplotlib's backend is {backend}); allowed: savefig('picture.png')"
            )
        # These are the steps of pyplot: matplotlib has no public function that opens a window for a given figure.
        manager = canvas.new_manager(self, max(pyplot.get_fignums(), default=0) + 1)
        Gcf._set_new_active_manager(manager)
        pyplot.show()


#: Pictures of a notebook's running cell that it has not shown: those of a loop, or before a semicolon.
_waiting: list[Picture] = []


def _show_waiting() -> None:
    for picture in tuple(_waiting):
        picture.show()
