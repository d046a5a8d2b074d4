"""Pictures show the data of the results, for every status of a run, and change no global state."""

from __future__ import annotations

import dataclasses
import io
import itertools
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

import fingerspice as fs
from fingerspice.plots import drawing, traces
from scenes import deck, listed, quietly, refuses, shipped, table1, warns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def labels(figure: Figure) -> list[str]:
    return [ax.get_ylabel() for ax in figure.axes if ax.axison]


def curve(ax: Axes, label: str) -> tuple[np.ndarray, np.ndarray]:
    line = next(line for line in ax.lines if line.get_label() == label)
    return np.asarray(line.get_xdata()), np.asarray(line.get_ydata())


def legend(ax: Axes) -> list[str]:
    found = ax.get_legend()
    return [] if found is None else [text.get_text() for text in found.get_texts()]


def small_print(figure: Figure) -> str:
    return " ".join(figure.get_supxlabel().split())


def with_source(value: fs.Waveform, **options: object) -> fs.Solution:
    """A run of Table 1 under `value`, whatever comes of it."""
    return quietly(fs.simulate, table1(), sources={"Vdrive": value}, throw=False, **options)


@pytest.fixture(scope="module")
def sine() -> fs.Solution:
    return fs.simulate(table1())


def test_a_run_is_shown_in_four_panels_with_units(sine: fs.Solution) -> None:
    figure = traces.plot_solution(sine)
    assert labels(figure) == ["Voltage [V]", "Force [N]", "Ridge area [mm²]", "Friction [N]"]
    assert figure.axes[3].get_xlabel() == "Time [ms]"
    t, u = curve(figure.axes[0], "gap")
    np.testing.assert_allclose(t, 1e3 * sine.t)
    np.testing.assert_array_equal(u, sine.u_gap)
    np.testing.assert_allclose(figure.axes[2].lines[0].get_ydata(), 1e6 * sine.area)
    # The mean is that of the last period.
    level = curve(figure.axes[1], "mean of the last period, 0.109 N")[1]
    np.testing.assert_allclose(level, sine.summary()["f_el_mean_periodic"])
    # The small print says how it was made.
    said = small_print(figure)
    assert said == (
        "Table 1 · Vdrive: Sine(200 V, 100 Hz) · local charge law · area: coupled · method exponential, rtol 1e-08 · "
        f"error estimate {sine.error.u_gap:.2g} V, {sine.error.f_el:.2g} N"
    )
    # The friction coefficient is the right scale of the friction panel.
    figure.canvas.draw()
    force, right = figure.axes[3].get_ylim(), figure.axes[3].child_axes[0].get_ylim()
    np.testing.assert_allclose(right, np.array(force) / 0.5)


def test_both_sides_of_a_jump_are_drawn() -> None:
    solution = fs.simulate(table1(), sources={"Vdrive": fs.Square(200.0, 100.0)}, t_stop=0.01, rtol=1e-6)
    t, u = curve(traces.plot_solution(solution).axes[0], "source")
    np.testing.assert_array_equal(u[np.isclose(t, 5.0)], [200.0, -200.0])


def test_without_a_gap_the_layers_voltages_are_shown_alone() -> None:
    circuit = deck(
        "V1 a 0 SIN(0 200 100)", "Xc$x$ a b area LAYER d=1u eps_r=3.9 r=0.2meg",
        "Xs b 0 area SKIN d=350u f=100", "Varea area 0 35", ".tran 10u 20m",
    )  # fmt: skip
    solution = fs.simulate(circuit)
    figure = traces.plot_solution(solution)
    assert labels(figure) == ["Voltage [V]"]
    assert legend(figure.axes[0]) == ["source", "layer Xc$x$", "layer Xs"]
    assert not any(t.get_parse_math() for t in figure.axes[0].get_legend().get_texts())
    np.testing.assert_array_equal(curve(figure.axes[0], "layer Xs")[1], solution.u_layer[:, 1])


def test_a_run_that_stopped_shows_where_and_why() -> None:
    solution = with_source(fs.Function(lambda t: 1e4 * t if t < 0.0123 else math.nan), t_stop=0.02)
    assert not solution.success
    figure = traces.plot_solution(solution)
    assert [t.get_text().strip() for t in figure.axes[0].texts] == ["stopped"]
    for ax in figure.axes:
        assert any(np.allclose(line.get_xdata(), 12.3) for line in ax.lines)
        assert ax.get_xlim()[1] > 12.3
    assert "NaN" in small_print(figure)


def test_a_run_that_stopped_at_once_still_makes_a_picture(sine: fs.Solution, tmp_path: Path) -> None:
    for rows in (0, 1, 2):
        some = {name: getattr(sine.record, name)[:rows] for name in ("t", "left", "rows")}
        record, state = dataclasses.replace(sine.record, **some), dataclasses.replace(sine.state, t=sine.t[rows])
        stopped = {"status": fs.Status.SOURCE_NOT_FINITE, "record": record, "state": state}
        solution = dataclasses.replace(sine, t=sine.t[:rows].copy(), **stopped)
        assert solution.u_gap.size == rows
        figure = traces.plot_solution(solution)
        assert "stopped" in figure.axes[0].texts[0].get_text()
        assert drawing.save(figure, tmp_path / "x.png", dpi=20.0).stat().st_size > 0


def test_lines_are_within_their_frames(tmp_path: Path) -> None:
    for amplitude in (0.01, 0.5, 10.0, 50.0, 200.0):
        run = fs.simulate(table1(f"SIN(0 {amplitude} 100)"), t_stop=0.02, rtol=1e-4)
        (ax,) = traces.plot_solution(run, "f_t").axes
        bottom, top = ax.get_ylim()
        assert bottom == 0.0
        assert float(np.max(ax.lines[0].get_ydata())) < 0.97 * top
    # A fixed area is drawn flat, and no voltage is no force.
    low, high = traces.plot_solution(fs.simulate(table1(), area="frozen", t_stop=0.01)).axes[2].get_ylim()
    assert low < 34.0 < 36.0 < high
    figure = traces.plot_solution(with_source(fs.DC(0.0), t_stop=0.01))
    assert figure.axes[1].get_ylim() == pytest.approx((0.0, figure.axes[1].get_ylim()[1]))
    drawing.save(figure, tmp_path / "x.png", dpi=20.0)


def test_a_sweep_shows_gain_phase_force_and_area() -> None:
    circuit = table1()
    result = warns("the sweep goes down to 1 Hz", fs.phasor, circuit, np.geomspace(1.0, 1e4, 21))
    figure = traces.plot_phasor((result,), circuit)
    assert len(labels(figure)) == 4
    assert all(ax.get_xscale() == "log" for ax in figure.axes)
    drawn = abs(result.gain), np.degrees(np.angle(result.gain)), result.f_el_mean, 1e6 * result.area
    for ax, values in zip(figure.axes, drawn, strict=True):
        np.testing.assert_allclose(ax.lines[0].get_ydata(), values)
    assert "outside the skin data" in small_print(figure)
    # Within the skin data nothing is shaded.
    figure = traces.plot_phasor((fs.phasor(circuit, np.geomspace(10.0, 1e5, 9)),), circuit)
    assert "outside" not in small_print(figure)
    assert not any(ax.patches for ax in figure.axes)


def test_a_single_frequency_and_a_source_without_fundamental_are_drawn_too(tmp_path: Path) -> None:
    circuit = table1().replace({"Vdrive": fs.DC(100.0)})
    figure = traces.plot_phasor((fs.phasor(circuit, 100.0, area="frozen"),), circuit)
    assert figure.axes[2].texts[0].get_text() == "the source has no fundamental"
    drawing.save(figure, tmp_path / "x.png", dpi=20.0)


@pytest.mark.parametrize("phase", [0.0, 70.0])
def test_the_phasor_lies_on_the_transient_where_the_area_is_fixed(phase: float) -> None:
    axes = fs.compare(table1(f"SIN(0 200 100 0 0 {phase})", gap={"a_fix": 35})).plot().axes
    for ax, name, scale in ((axes[0], "gap", 200.0), (axes[1], "electroadhesive force", 0.2)):
        np.testing.assert_allclose(curve(ax, name)[1], curve(ax, f"{name}, phasor")[1], atol=1e-6 * scale)


def test_the_comparison_shows_its_table_which_has_room_for_the_names_of_several_fingers() -> None:
    comparison = fs.compare(table1())
    table = comparison.plot().axes[2].tables[0].get_celld()
    assert table[1, 0].get_text().get_text() == "Gap voltage at the fundamental [V]"
    assert table[3, 3].get_text().get_text() == f"{comparison.coupled.f_el_mean:.5g}"
    figure = fs.compare(shipped("two_fingers"), rtol=1e-5).plot()
    figure.canvas.draw()
    cells = figure.axes[2].tables[0].get_celld()
    for row in range(1, 9):
        texts = [cells[row, column].get_text().get_window_extent() for column in range(6)]
        assert all(left.x1 < right.x0 for left, right in itertools.pairwise(texts))


def test_a_picture_has_150_dots_an_inch_or_more_and_a_folder_that_can_be_written(sine, tmp_path):
    figure = traces.plot_solution(sine)
    with Image.open(drawing.save(figure, tmp_path / "new" / "run.png")) as image:
        assert image.format == "PNG"
        assert image.width >= 150 * figure.get_size_inches()[0]
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["run.png"]
    refuses("cannot write", drawing.save, figure, tmp_path / "new" / "run.png" / "run.png")


def test_thinning_keeps_every_extreme_and_both_ends() -> None:
    t = np.linspace(0.0, 1.0, 123_457)
    x = np.sin(2e4 * t)
    x[77_777] = 9.0
    thin_t, thin_x = drawing.thin(t, x)
    assert thin_t.size < 5 * drawing.MAX_BINS
    assert np.all(np.diff(thin_t) > 0.0)
    assert (thin_t[0], thin_t[-1]) == (0.0, 1.0)
    assert thin_x.max() == 9.0
    assert thin_x.min() == x.min()


def test_what_a_deck_names_is_drawn_without_formulas_floods_or_warnings(tmp_path: Path) -> None:
    name = "n$x^$漢\x1b[31m" + "y" * 200
    lines = (f"V1 {name} 0 SIN(0 10 100)", f"R1 {name} out$ 1k", "C1 out$ 0 1n", ".tran 100u 20m uic")
    title = "$\\frac{$ 漢字 😀 \x1b[31m" + "x" * 100_000
    # Warnings are errors here: matplotlib has one for each picture that the font lacks, and for what finds no room.
    circuit = fs.parse_netlist("\n".join((title, *lines)))
    figure = fs.simulate(circuit).plot()
    drawing.save(figure, tmp_path / "odd.png", dpi=20.0)
    shown = legend(figure.axes[0])
    assert any(text.startswith("n$x^$□\\x1b[31myyy") for text in shown)
    assert max(map(len, shown)) <= drawing.LONGEST_LABEL
    assert "$\\frac{$ □□ 😀 \\x1b[31mxxx" in small_print(figure)


# Signals, windows, several runs, long runs


def test_signals_that_are_asked_for_share_a_panel_with_their_like(sine: fs.Solution) -> None:
    figure = sine.plot(["u_layer", "f_el", "v:skin", "q_source"])
    assert labels(figure) == ["Voltage [V]", "Force [N]", "Charge [nC]"]
    assert legend(figure.axes[0]) == ["layer Xcoat", "layer Xgap", "layer Xskin", "skin"]
    np.testing.assert_array_equal(curve(figure.axes[0], "skin")[1], sine.node_voltages["skin"])
    assert labels(sine.plot("friction")) == ["Friction coefficient"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        *listed("pictures"),
        *(
            ({"window": window}, r"window is .* s; allowed: ascending, with two outputs")
            for window in ((0.02, 0.01), (1.0, 2.0), (0.01, 0.010001))
        ),
    ],
)
def test_what_a_picture_refuses(sine: fs.Solution, options: dict[str, Any], said: str) -> None:
    refuses(said, sine.plot, **options)


def test_a_window_is_what_is_shown(sine: fs.Solution) -> None:
    figure = sine.plot("f_el", window=(0.012, 0.021))
    assert figure.axes[0].get_xlim() == pytest.approx((12.0, 21.0))
    t, _ = curve(figure.axes[0], "electroadhesive force")
    # A neighbour on either side leads the line out.
    assert 11.98 < t[0] < 12.0 < 21.0 < t[-1] < 21.02


def test_other_runs_lie_over_it_called_by_what_sets_them_apart(sine: fs.Solution) -> None:
    thick = fs.simulate(table1().replace({"Xgap.d": 5e-6}))
    assert "Table 1 (changed: Xgap.d = 5 um)" in small_print(thick.plot())
    figure = sine.plot("f_el", others=thick)
    names = ["electroadhesive force, the deck as it is", "electroadhesive force, Xgap.d = 5 um"]
    assert legend(figure.axes[0]) == names
    np.testing.assert_array_equal(curve(figure.axes[0], names[1])[1], thick.f_el)
    first, second = figure.axes[0].lines[:2]
    assert first.get_color() != second.get_color()
    assert first.get_linestyle() != second.get_linestyle()
    assert first.get_linewidth() > second.get_linewidth()
    named = sine.plot("f_el", others={"thick": thick})
    assert legend(named.axes[0])[1] == "electroadhesive force, thick"
    # What drives both alike is drawn once.
    assert legend(sine.plot(others=[thick]).axes[0])[0] == "source"


def test_each_finger_keeps_its_colour_in_every_panel_and_has_a_legend_in_each() -> None:
    run = fs.simulate(shipped("two_fingers"))
    figure = run.plot()
    colors: dict[str, set[object]] = {gap: set() for gap in run.gaps}
    for ax in figure.axes:
        assert len([text for text in legend(ax) if "Xgap" in text]) == 2
        for line in ax.lines:
            for gap, seen in colors.items():
                if str(line.get_label()).endswith(gap):
                    seen.add(line.get_color())
    firm, light = colors.values()
    assert len(firm) == len(light) == 1
    assert firm != light
    # Their voltages all but coincide.
    first, second = (line for line in figure.axes[0].lines if "Xgap" in str(line.get_label()))
    assert first.get_linestyle() == "-" != second.get_linestyle()
    assert first.get_linewidth() > second.get_linewidth()


def test_a_long_run_is_an_envelope_beside_its_last_oscillations() -> None:
    run = fs.simulate(table1("SIN(0 200 5k)", f=5000.0, tran="5u 50m uic"))
    figure = run.plot()
    left, right = figure.axes[:8:2], figure.axes[1:8:2]
    assert left[3].get_xlabel() == "Time [ms]: envelope of 250 oscillations"
    assert right[3].get_xlabel() == "Time [ms]: the last 4"
    assert right[3].get_xlim()[1] - right[3].get_xlim()[0] == pytest.approx(0.8, abs=0.06)
    upper = curve(left[1], "electroadhesive force")[1]
    # Each part of the envelope reaches the force's peak, which the last periods have all of.
    np.testing.assert_allclose(upper[100:-1], run.f_el[5000:].max(), rtol=1e-6)
    assert len(upper) <= 250
    assert figure.axes[0].lines[0].get_xdata().size < 1000
    # A window of a few is drawn as lines.
    assert len(labels(run.plot(window=(0.0, 0.002)))) == 4


def test_an_envelope_is_smooth_where_oscillations_are_longer_than_most_and_falls_between_bursts() -> None:
    def picture(source: fs.Waveform, stop: float, step: float) -> Axes:
        run = with_source(source, t_stop=stop, t_eval=np.arange(0.0, stop, step), rtol=1e-4)
        return run.plot("u_source").axes[0]

    chirp = picture(fs.Chirp(150.0, 20.0, 2000.0, 0.3), 0.3, 2e-5)
    # Every part of it reaches the amplitude on both sides, the first ones, too.
    assert curve(chirp, "source")[1].min() > 0.97 * 150.0
    assert np.max(chirp.lines[0].get_ydata()) < -0.97 * 150.0
    burst = fs.Repeat(fs.Burst(fs.Sine(200.0, 5000.0), 2e-3), 10e-3)
    t, upper = curve(picture(burst, 0.05, 5e-6), "source")
    assert upper[(t % 10.0 > 3.0) & (t % 10.0 < 9.0)].max() < 1e-9
    assert upper[(t % 10.0 > 0.5) & (t % 10.0 < 1.5)].min() > 199.0


def test_a_picture_shows_itself_in_a_notebook_and_without_a_window_says_what_to_do(sine: fs.Solution) -> None:
    content, size = sine.plot()._repr_png_()
    with Image.open(io.BytesIO(content)) as image:
        assert image.width == 2 * size["width"] == 1400
    refuses(r"no window can be opened here .*; allowed: savefig", sine.plot().show)


WINDOW = """
import sys, types
from fingerspice.plots import drawing, traces
from fingerspice.studies import figures
assert not any(name.startswith("matplotlib") for name in sys.modules)
figure, _ = drawing.new_figure(1)
assert "matplotlib.pyplot" not in sys.modules
import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backend_bases import FigureManagerBase
shown = []
class Manager(FigureManagerBase):
    def show(self):
        shown.append(self.canvas.figure)
    @classmethod
    def start_main_loop(cls):
        shown.append("until closed")
class Canvas(FigureCanvasAgg):
    manager_class = Manager
    required_interactive_framework = "headless"
window = types.ModuleType("window")
window.FigureCanvas, window.FigureManager = Canvas, Manager
sys.modules["window"] = window
matplotlib.use("module://window")
figure.show()
assert shown == [figure, "until closed"], shown
figure.savefig(sys.argv[1])
"""


def test_a_picture_needs_no_pyplot_until_it_opens_a_window_from_a_script(tmp_path: Path) -> None:
    code = [sys.executable, "-W", "error", "-c", WINDOW, str(tmp_path / "x.png")]
    subprocess.run(code, check=True, timeout=60, env={**os.environ, "DISPLAY": ":none"})
    assert (tmp_path / "x.png").stat().st_size > 0


def test_a_click_in_a_long_run_is_enlarged_beside_it() -> None:
    click = fs.PWL((0.0, 0.5, 0.5005, 0.5015, 0.5025, 0.503), (0.0, 0.0, 200.0, -200.0, 200.0, 0.0))
    solution = with_source(click, t_stop=2.0, t_eval=np.arange(0.0, 2.0, 1e-4), rtol=1e-5)
    whole, part = traces.plot_solution(solution, "u_source").axes
    assert (whole.get_xlabel(), part.get_xlabel()) == ("Time [s]: the whole run", "Time [s]: enlarged")
    start, stop = part.get_xlim()
    assert 0.49 < start < 0.5005
    assert 0.5025 < stop < 0.51
    assert part.lines[0].get_ydata().max() == pytest.approx(200.0)  # type: ignore[union-attr]


def test_of_many_oscillations_the_last_ones_that_are_not_small_are_enlarged() -> None:
    # The envelope of 50 Hz is zero where the run ends, and widest 10 ms before.
    t = np.arange(0.0, 0.055, 1e-5)
    solution = with_source(fs.AM(200, 5000, 50), t_stop=0.055, t_eval=t, rtol=1e-5)
    whole, part = traces.plot_solution(solution, "u_source").axes
    assert "envelope of 27" in whole.get_xlabel()
    assert part.get_xlabel() == "Time [ms]: enlarged"
    x = np.concatenate([line.get_ydata() for line in part.lines])  # type: ignore[misc]
    assert 0.6 * 200.0 < np.abs(x).max() < 0.8 * 200.0
    assert part.get_xlim()[1] < 50.0
