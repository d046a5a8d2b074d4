"""Pictures of error against time: for stacks also against evaluations, for networks with a panel for each scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

OURS = "fingerspice"
# Okabe and Ito's palette, and markers, so that no line is identified by colour alone.
LOOK = {
    "fingerspice": ("#000000", "o"),
    "fingerspice, every period": ("#999999", "o"),
    "numbalsoda": ("#D55E00", "s"),
    "diffrax": ("#0072B2", "D"),
    "scipy": ("#009E73", "^"),
    "CVODE": ("#CC79A7", "v"),
    "torchdiffeq": ("#E69F00", "P"),
    "ngspice": ("#56B4E9", "X"),
}
COSTS = {"us_per_period": "time per period / µs", "nfev_per_period": "evaluations per period"}
STYLE = {"font.size": 8, "axes.titlesize": 8.5, "axes.labelsize": 8, "xtick.labelsize": 7, "ytick.labelsize": 7}
Report = dict[str, Any]


def front(points: list[Report], cost: str) -> tuple[list[float], list[float]]:
    """Costs and errors of the points on the Pareto front: no other point has both less cost and less error."""
    best: list[tuple[float, float]] = []
    for p in sorted((p for p in points if p[cost] is not None), key=lambda p: p[cost]):
        if not best or p["error"] < best[-1][1]:
            best.append((p[cost], p["error"]))
    return [x for x, _ in best], [y for _, y in best]


def _panel(ax: Any, results: Report, name: str, cost: str) -> None:
    """Draw the front of each library on a problem; errors below the agreement of the references are raised to it."""
    points = [p for p in results["points"] if p["problem"] == name and p["status"] == "ok"]
    floor = results["problems"][name]["error_floor"]
    for library, (colour, marker) in reversed(LOOK.items()):
        x, y = front([p for p in points if p["library"] == library], cost)
        if x:
            wide = library == OURS
            ax.plot(
                x, [max(v, floor) for v in y], color=colour, marker=marker, markersize=4 if wide else 3.5,
                linewidth=1.8 if wide else 1.0, label=library, markeredgewidth=0.0, zorder=3 if wide else 2,
            )  # fmt: skip
    ax.set(xscale="log", yscale="log")
    ax.grid(True, which="major", color="0.88", linewidth=0.5)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def picture(results: Report, panels: list[list[tuple[str, str]]], path: Path) -> None:
    """Write rows of panels as PNG; each panel is given by a problem's name and a cost."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            len(panels), len(panels[0]), figsize=(7.6, 4.8), sharey=True, sharex="row", squeeze=False,
            layout="constrained",
        )  # fmt: skip
        for i, row in enumerate(panels):
            for ax, (name, cost) in zip(axes[i], row, strict=True):
                _panel(ax, results, name, cost)
                ax.set_xlabel(COSTS[cost])
                # Titles are repeated only in a row with other scenes than the first row.
                if i == 0 or [n for n, _ in row] != [n for n, _ in panels[0]]:
                    ax.set_title(results["problems"][name]["title"])
            axes[i][0].set_ylabel("largest error / peak")
        axes[0][0].set_ylim(1e-13, 1e-1)
        entries: dict[str, Any] = {}
        for ax in axes.ravel():
            entries |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
        shown = [library for library in LOOK if library in entries]
        figure.legend(
            [entries[library] for library in shown], shown, loc="outside upper center", ncols=(len(shown) + 1) // 2,
            frameon=False, columnspacing=1.2, handlelength=1.6,
        )  # fmt: skip
        figure.savefig(path, dpi=200)
        plt.close(figure)
