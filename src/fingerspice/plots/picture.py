"""The class of this package's figures, which notebooks and windows show; and pictures of sweeps and of fits."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogFormatter

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.pages import in_notebook
from fingerspice.plots import drawing
from fingerspice.results.record import signal_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from xarray import DataArray, Dataset

_DPI, _SHARPER = 200, 2  # Dots per inch of a notebook's picture, and the factor by which the notebook scales it down


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
            problem = f"no window can be opened here (matplotlib's backend is {backend})"
            raise InputError(f"{problem}; allowed: savefig('picture.png')")
        # These are the steps of pyplot: matplotlib has no public function that opens a window for a given figure.
        manager = canvas.new_manager(self, max(pyplot.get_fignums(), default=0) + 1)
        Gcf._set_new_active_manager(manager)
        pyplot.show()


#: Pictures of a notebook's running cell that it has not shown: those of a loop, or before a semicolon.
_waiting: list[Picture] = []


def _show_waiting() -> None:
    for picture in tuple(_waiting):
        picture.show()


_WIDE = 20.0  # Ratio of the largest to the smallest abscissa from which on the axis is logarithmic


def plot_sweep(found: Dataset, output: str, indices: Dataset | None = None) -> Picture:
    """An output of `sweep` along its grid of one dimension, with the band from 5 to 95 %, or its histogram.

    With the indices of `sobol` a panel for each parameter shows it at three quantiles, and the last one the indices.
    """
    one = found[output]
    dims = [str(dim) for dim in one.dims if dim != "scene"]
    if len(dims) > 1:
        raise InputError(f"{output} has the dimensions {', '.join(dims)}; allowed in a picture: one beside scene")
    values = one.transpose(*dims, ...).values
    factor, unit = drawing.engineering(drawing.peak_of(np.nan_to_num(values)), one.attrs.get("units", ""), 0.05)
    label = f"{output} [{unit}]" if unit else output
    if dims:
        figure = _along(found[dims[0]], factor * values, label, indices, factor, output)
    else:
        rows = 1 if indices is None else 2
        figure, axes = drawing.new_figure(rows, height=2.4 * rows)
        axes[0].hist(factor * np.ravel(values), bins=40, color=drawing.CYCLE[0])
        drawing.dress(axes[0], "scenes", label)
        if indices is not None:
            _shares(axes[1], indices, output, None)
    if "scene" in one.dims:
        drawing.caption(figure, f"{found.sizes['scene']:,} scenes, seed {found.attrs.get('seed', 0)}")
    return figure


def _along(
    grid: DataArray, values: FloatArray, label: str, indices: Dataset | None, factor: float, output: str
) -> Picture:
    """Band and median along the grid: one panel, or one for each parameter and one for its shares."""
    unit, named = grid.attrs.get("units", ""), grid.dtype.kind in "OUT"
    x = np.asarray(np.arange(grid.size) if named else grid.values, float)
    bands = 1 if indices is None else indices.parameter.size
    rows, columns = (1, 1) if indices is None else ((bands + 2) // 2, 2)
    figure, axes = drawing.new_figure(rows, columns, height=2.4 * rows, sharex=True)
    # Values of each place: one, or many, of which the middle nine tenths are shown.
    low, middle, high = (values,) * 3 if values.ndim == 1 else np.nanquantile(values, [0.05, 0.5, 0.95], axis=-1)
    for j, ax in enumerate(axes[:bands]):
        if values.ndim > 1:
            ax.fill_between(x, low, high, color="0.85", linewidth=0.0, label="5 to 95 % of all")
        if values.ndim == 1 or indices is None:
            name = "median of all" if values.ndim > 1 else None
            ax.plot(x, middle, color=drawing.CYCLE[0], linewidth=1.3, label=name)
        if indices is not None:
            _alone(ax, x, factor * indices[f"{output}_alone"].values[:, j], indices, j)
        drawing.dress(ax, label if j % columns == 0 else "", ylim=(min(0.0, float(np.nanmin(values))), None))
    told = axes[0].get_legend_handles_labels()
    if len(told[0]) > 1:
        figure.legend(*told, loc="outside upper center", ncols=len(told[0]), fontsize=drawing.FONT, frameon=False)
    if indices is not None:
        _shares(axes[bands], indices, output, x)
    for ax in axes[bands + 1 :]:
        ax.remove()
    for ax in axes[: bands + 1][-columns:]:
        drawing.dress(ax, xlabel=f"{grid.name} [{unit}]" if unit else str(grid.name))
        ax.tick_params(labelbottom=True)
    for ax in figure.axes:
        if named:
            # Names of sets of parameters instead of numbers, with a mark at each: nothing lies between them.
            ax.set_xticks(range(x.size), [str(name) for name in grid.values], rotation=20.0 if x.size > 4 else 0.0)
            ax.set_xlim(-0.3, x.size - 0.7)
            for line in ax.lines:
                line.set(marker="o", markersize=4.0)
            continue
        if x.min() > 0.0 and x.max() > _WIDE * x.min():
            ax.set_xscale("log")
        ax.set_xlim(x.min(), x.max() if x.size > 1 else None)
    return figure


def _alone(ax: Axes, x: FloatArray, values: FloatArray, indices: Dataset, j: int) -> None:
    """Curves (n_x, n_quantile) where parameter `j` takes the quantiles of its distribution."""
    at, unit = indices["at"].values[j], str(indices["unit"].values[j])
    factor, unit = drawing.engineering(float(np.abs(at).max()), unit)
    unit = "times" if unit.strip() == "1" else unit
    told = f"{indices.parameter.values[j]}: {', '.join(f'{factor * one:.3g}' for one in at)} {unit}"
    ax.set_title(drawing.drawable(told, 60), fontsize=drawing.FONT, loc="left", parse_math=False)
    for k, colour in enumerate((drawing.BLUE, drawing.BLACK, drawing.VERMILION)):
        name = f"its {100 * float(indices['quantile'][k]):g} % quantile"
        ax.plot(x, values[:, k], linestyle=drawing.DASHES[k], color=colour, linewidth=1.3, label=name)


def _shares(ax: Axes, indices: Dataset, output: str, x: FloatArray | None) -> None:
    """Total index of every parameter with its interval, along the grid or as bars."""
    total, low, high = (indices[f"{output}_total{kind}"].values for kind in ("", "_low", "_high"))
    for j, name in enumerate(map(str, indices.parameter.values)):
        color = drawing.CYCLE[j % len(drawing.CYCLE)]
        if x is not None:
            ax.fill_between(x, low[:, j], high[:, j], color=color, alpha=0.2, linewidth=0.0)
            ax.plot(x, total[:, j], color=color, linewidth=1.3, label=name)
        else:
            off = [[max(total[j] - low[j], 0.0)], [max(high[j] - total[j], 0.0)]]
            ax.bar([name], [total[j]], yerr=off, color=color, capsize=2.0)
    drawing.dress(ax, "share of variance", ylim=(0.0, max(1.05, float(np.max(high)))))
    if x is not None:
        drawing.legend_within(ax, 44)


_MOST_LINES, _MOST_PANELS, _MOST_MARKS = 60, 4, 12  # Of a picture of steps; marks at the values themselves


def plot_steps(found: Dataset) -> Picture:
    """Signals of `run_steps` over time, of `phasor_steps` over frequency, or of `operating_points` over what is first.

    A step makes the colour, a second one dashes, as far as there are dashes.
    """
    axis = next((str(dim) for dim in found.dims if dim not in found["status"].dims), "")
    names = [str(name) for name, one in found.data_vars.items() if not axis or axis in one.dims]
    wanted = ("u_gap", "f_el", "f_t", "area") if any(name.startswith("u_gap") for name in names) else ("v",)
    names = [x for key in wanted for x in names if x.partition(":")[0].removesuffix("_mean") == key][:_MOST_PANELS]
    x, *steps = [*([axis] if axis else []), *(str(dim) for dim in found.dims if dim != axis)]
    figure, axes = drawing.new_figure(len(names), height=1.0 + 1.4 * len(names), sharex=True)
    colour, *dashed = steps or [""]
    scale = found[colour].values if colour else np.zeros(1)
    norm = (LogNorm if scale.min() > 0.0 and scale.max() > 5.0 * scale.min() else Normalize)(scale.min(), scale.max())
    # Without its brightest yellow, which is pale on white.
    palette = ListedColormap(colormaps["viridis"](np.linspace(0.0, 0.92, 256)))
    wave = found.stack(line=steps) if steps else found.expand_dims("line")
    lines = np.unique(np.linspace(0, wave.line.size - 1, _MOST_LINES).astype(int))
    at = found[x].values
    # A logarithmic axis needs no prefix.
    largest, unit_x = 1.0 if axis == "frequency" else drawing.peak_of(at), found[x].attrs.get("units", "")
    factor_x, unit_x = drawing.engineering(largest, unit_x, 2.0 if axis == "time" else 1.0)
    for ax, name in zip(axes, names, strict=True):
        values = wave[name].transpose("line", x).values
        signal = signal_of(name.removesuffix("_mean"))
        factor, unit = drawing.engineering(drawing.peak_of(np.nan_to_num(values)), signal.unit, signal.least)
        for k in lines:
            place = wave[colour].values[k] if colour else 0.0
            dash = int(np.searchsorted(found[dashed[0]].values, wave[dashed[0]].values[k])) if dashed else 0
            style = drawing.DASHES[dash % len(drawing.DASHES)]
            ax.plot(factor_x * at, factor * values[k], color=palette(norm(place)), linewidth=1.0, linestyle=style)
        gap = f" {name.partition(':')[2]}" if ":" in name else ""
        drawing.dress(ax, f"{signal.axis}{gap} [{unit}]")
        drawing.flat(ax, factor * values[np.isfinite(values)])
    drawing.dress(axes[-1], xlabel=f"{axis.capitalize() or x} [{unit_x}]" if unit_x else x)
    if axis == "frequency":
        axes[-1].set_xscale("log")
    if colour:
        unit = found[colour].attrs.get("units", "")
        shown = EngFormatter(unit.replace("1", "")) if "^" not in unit else None
        bar = figure.colorbar(ScalarMappable(norm, palette), ax=axes, format=shown)
        bar.outline.set_visible(False)
        bar.set_label(colour, fontsize=drawing.FONT, parse_math=False)
        bar.ax.minorticks_off()
        if scale.size <= _MOST_MARKS:
            bar.set_ticks(scale.tolist())
        bar.ax.tick_params(labelsize=drawing.FONT - 0.5)
    told = f"{lines.size:,} of {wave.line.size:,} runs" if lines.size < wave.line.size else f"{wave.line.size:,} runs"
    told += "".join(f"; dashes by {name}" for name in dashed[:1])
    drawing.caption(figure, f"{found.attrs['title']} · {told}")
    figure.align_ylabels(axes)
    return figure


_ROOM = 90  # Letters of a legend across the page; beside other panels one curve needs none
#: A panel of measured and fitted values: to which curve each row belongs, by name; columns (n,) of the abscissa, the
#: measured and fitted values and the standard deviations; what the abscissa is, the quantity, and its unit.
Drawn = tuple[Sequence[str], Sequence[FloatArray], str, str, str]


def plot_panels(panels: Sequence[Drawn]) -> Picture:
    """Data with error bars and the fit of several quantities side by side, each with its residuals below."""
    count = len(panels)
    figure, axes = drawing.new_figure(2, count, height=4.2, sharex="col", height_ratios=(2.4, 1.0))
    for top, bottom, (names, columns, x_label, quantity, unit) in zip(axes[:count], axes[count:], panels, strict=True):
        factor, shown = drawing.engineering(drawing.peak_of(columns[1]), unit, 0.05) if unit else (1.0, "")
        bottom.axhline(0.0, color=drawing.GREY, linewidth=0.8)
        order, curves = np.argsort(columns[0], kind="stable"), list(dict.fromkeys(names))
        for number, name in enumerate(curves):
            rows, color = order[np.array(names)[order] == name], drawing.CYCLE[number % len(drawing.CYCLE)]
            x, measured, fitted, sigma = (values[rows] for values in columns)
            style: dict[str, Any] = {"fmt": "o", "markersize": 3.5, "color": color, "elinewidth": 0.8, "capsize": 2.0}
            top.errorbar(x, factor * measured, factor * sigma, label=name, **style)
            top.plot(x, factor * fitted, color=color, linewidth=1.3)
            bottom.plot(x, (measured - fitted) / sigma, "o", markersize=3.5, color=color)
        x = columns[0]
        if x.min() > 0.0 and x.max() > _WIDE * x.min():
            bottom.set_xscale("log")
            # Plain numbers: 20, 50, 100, and no powers of ten.
            bottom.xaxis.set_major_formatter(LogFormatter())
            bottom.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(2.0, 0.5)))
        drawing.dress(top, f"{quantity} [{shown}]" if shown else quantity)
        if len(curves) > 1 or count == 1:
            drawing.legend_within(top, _ROOM // count)
        drawing.dress(bottom, "residual / sigma" if top is axes[0] else "", x_label)
    drawing.caption(figure, "dots: measured, with one standard deviation; lines: fitted")
    return figure
