"""Tables and pictures of the measured times, from the files in results/ alone.

Run: python benchmarks/report.py [--results FILE] [--page FILE] [--waits FILE]. From work_precision.json come
results/work_precision.md (every contestant), the pictures results/work_precision.png and work_precision_networks.png,
and the tables between the `speed` markers of docs/speed.md; those between its `recordings` markers from
recordings.json; from run_times.json, baseline.json and recordings.json in the same folder comes the table between the
markers of docs/proof.md.
"""

from __future__ import annotations

import argparse
import json
import textwrap
from pathlib import Path
from typing import Any

from work_pictures import COSTS, OURS, picture

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "work_precision.json"
WAITS, PAGE = (HERE.parent / "docs" / name for name in ("proof.md", "speed.md"))
BEGIN, END = "<!-- {}:begin -->", "<!-- {}:end -->"
TARGETS = (1e-3, 1e-6, 1e-10)
NGSPICE_TARGET = 1e-4
STEPPED = "fingerspice, every period"
Report = dict[str, Any]


def good(results: Report, problem: str, **wanted: str) -> list[Report]:
    """Points of a problem that gave a solution, filtered by the keys `wanted`, such as a library or contestant."""
    return [
        p for p in results["points"]
        if p["problem"] == problem and p["status"] == "ok" and all(p[k] == v for k, v in wanted.items())
    ]  # fmt: skip


def cheapest(points: list[Report], error: float) -> Report | None:
    """The fastest point among the points whose error is at most `error`."""
    met = [p for p in points if p["error"] <= error]
    return min(met, key=lambda p: p["us_per_period"]) if met else None


def number(value: float) -> str:
    """A number as text: with two digits below 10, and rounded to an integer above."""
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.2g}" if value < 10.0 else f"{value:.0f}"


def cell(points: list[Report], targets: tuple[float, ...]) -> str:
    """Times of the fastest settings that meet each error, us per period."""
    found = [cheapest(points, target) for target in targets]
    return " / ".join("-" if p is None else number(p["us_per_period"]) for p in found)


def libraries(results: Report) -> list[str]:
    """Libraries in the results, fingerspice first."""
    return list(dict.fromkeys(p["library"] for p in results["points"]))


def problems(results: Report, law: str, kind: str) -> list[str]:
    """Names of the problems of a charge law and kind (stack or network)."""
    found = results["problems"].items()
    return [name for name, p in found if (p["charge_law"], p["kind"]) == (law, kind)]


def lead(results: Report, problem: str) -> str:
    """Ratio of the best peer's time to ours, at each error."""
    ours = good(results, problem, library=OURS)
    theirs = [p for p in good(results, problem) if not p["library"].startswith(OURS)]
    ratios = []
    for target in TARGETS:
        a, b = cheapest(ours, target), cheapest(theirs, target)
        ratios.append("-" if a is None or b is None else number(b["us_per_period"] / a["us_per_period"]))
    return " / ".join(ratios)


def worst(results: Report, ours: str, targets: tuple[float, ...], **wanted: str) -> str:
    """Ratio of a peer's time to ours at each error, the smallest over the four scenes of Table 1."""
    scenes = problems(results, "local", "stack")[:4]
    least = []
    for target in targets:
        pairs = [
            (cheapest(good(results, n, library=ours), target), cheapest(good(results, n, **wanted), target))
            for n in scenes
        ]
        ratios = [b["us_per_period"] / a["us_per_period"] for a, b in pairs if a is not None and b is not None]
        least.append(number(min(ratios)) if len(ratios) == len(scenes) else "-")
    return " / ".join(least)


def ratios(results: Report, ours: str) -> str:
    """The ratios of `worst` for every peer, in words."""
    parts = []
    for library in libraries(results):
        if library.startswith(OURS):
            continue
        if library == "ngspice":
            parts.append(f"ngspice {worst(results, ours, (NGSPICE_TARGET,), library=library)} (1e-4)")
            continue
        parts.append(f"{library} {worst(results, ours, TARGETS, library=library)}")
        if library == "scipy":
            parts.append(f"its LSODA by `solve_ivp` {worst(results, ours, TARGETS, contestant='scipy LSODA')}")
    return ", ".join(parts)


def short_table(results: Report, law: str, kind: str) -> list[str]:
    """Best times of each library on each problem of a charge law and kind; empty if there is no such problem."""
    names = problems(results, law, kind)
    if not names:
        return []
    rows = [["µs per period", *(results["problems"][n]["title"] for n in names)]]
    for library in libraries(results):
        targets = (NGSPICE_TARGET,) if library == "ngspice" else TARGETS
        cells = [cell(good(results, n, library=library), targets) for n in names]
        if any(good(results, n, library=library) for n in names):
            label = "**fingerspice**" if library == OURS else library + (" (1e-4)" if library == "ngspice" else "")
            rows.append([label, *cells])
    rows.append(["best peer over ours, times", *(lead(results, n) for n in names)])
    return markdown(rows)


def markdown(rows: list[list[str]]) -> list[str]:
    """A Markdown table from rows of cells; the first row is the head."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return [lines[0], "|" + "---|" * len(rows[0]), *lines[1:]]


def long_table(results: Report, problem: str) -> list[str]:
    """Table of every contestant on a problem: time, and its ratio to ours, at each error; and the failures."""
    targets = (TARGETS[0], NGSPICE_TARGET, *TARGETS[1:])
    ours = good(results, problem, library=OURS)
    rows = [["contestant", *(f"{t:.0e}: µs (times ours)" for t in targets), "did not run"]]
    for name in dict.fromkeys(p["contestant"] for p in results["points"] if p["problem"] == problem):
        cells = []
        for target in targets:
            a, b = cheapest(ours, target), cheapest(good(results, problem, contestant=name), target)
            ratio = "" if a is None or b is None else f" ({number(b['us_per_period'] / a['us_per_period'])})"
            cells.append("-" if b is None else number(b["us_per_period"]) + ratio)
        mine = [p for p in results["points"] if p["problem"] == problem and p["contestant"] == name]
        failed = [f"{p['setting']:.0e}: {p['status']}" for p in mine if p["status"] != "ok"]
        rows.append([name, *cells, "; ".join(failed[:2])])
    return markdown(rows)


def conditions(results: Report) -> str:
    """Machine and versions in one sentence."""
    present = {k: v for k, v in results["versions"].items() if v != "absent"}
    # Some version texts already contain the name of the package.
    versions = [f"{k} {v}" if v[0].isdigit() else v for k, v in present.items()]
    absent = [k for k, v in results["versions"].items() if v == "absent"]
    text = f"{results['machine']}; {', '.join(versions)}"
    return text + (f"; absent: {', '.join(absent)}" if absent else "")


def waits(folder: Path) -> str:
    """The table of waiting times, from the results in a folder."""
    run, base, recorded = (
        json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        for name in ("run_times", "baseline", "recordings")
    )
    calls = {what: 1e3 * seconds for what, seconds in base["calls"].items()}

    def call(deck: str) -> str:
        ways = ("the same", "another parameter", "another source")
        return " / ".join(number(calls[f"{deck}: {way}"]) for way in ways) + " ms"

    def period(circuit: str, method: str) -> str:
        found = {row["source"]: row[method]["us_per_period"] for row in base["times"] if row["circuit"] == circuit}
        return " / ".join(number(us) for us in found.values()) + " µs"

    def sample(skin: str) -> str:
        at = {p["contestant"]: p for p in recorded["points"] if p["skin"] == skin and p["band_Hz"] == 1000.0}
        return " / ".join(number(at[f"fingerspice {rtol:g}"]["ns_per_sample"]) for rtol in (1e-4, 1e-6)) + " ns"

    def sample_around(deck: str) -> str:
        found = [p for p in recorded["networks"] if p["deck"] == deck and p["band_Hz"] == 1000.0]
        return " / ".join(number(p["ns_per_sample"]) for p in found if p["method"] == "auto") + " ns"

    sources = ", ".join(row["source"] for row in base["times"] if row["circuit"] == "fingerpad")
    rows = [
        ["what you wait for", "time"],
        ["`import fingerspice`", f"{max(0.0, run['import_s']):.2f} s"],
        [
            "`fingerspice run` of Table 1, without / with picture",
            f"{run['run_no_plot_s']:.1f} / {run['run_s']:.1f} s",
        ],
        ["`fs.simulate`, five periods: the same circuit again / another parameter / another source", call("fingerpad")],
        ["the same with the dispersive skin", call("fingerpad_dispersive")],
        ["the same behind an amplifier and a cable", call("amplifier")],
        [f"a period, outputs included, of 100: {sources}", period("fingerpad", "auto")],
        ["the same behind an amplifier and a cable", period("amplifier", "auto")],
        ["the same with two fingers and a floating body", period("two_fingers", "auto")],
        ["a sample of a recording of up to 1 kHz at 48 kHz, at 1e-4 / 1e-6", sample("SKIN")],
        ["the same with the dispersive skin", sample("SKIN_DISPERSIVE")],
        ["the same behind an amplifier and a cable", sample_around("amplifier")],
        ["the same with a floating body", sample_around("ungrounded_user")],
    ]  # fmt: skip
    text = (
        f"Medians of 7 at an error of 1e-6 of the peak, after the first use, on {base['machine']}, commit "
        f"{base['revision']} (`benchmarks/run_times.py`, `baseline.py`, `recordings.py`)."
    )
    return "\n".join([*markdown(rows), "", *wrapped(text)])


def page_text(results: Report) -> str:
    """The text between the markers of the page on speed."""
    aims = " / ".join(f"{t:.0e}".replace("e-0", "e-") for t in TARGETS)
    spread = max(p["reference_agreement"] for p in results["problems"].values())
    text = (
        f"Wall time per simulated period (chirp: per ms), µs, for an error of {aims} of the peak in gap voltage and "
        "force, 100 outputs a period included. Of each library the best method and setting, found by comparing with "
        "the reference, on a compiled right-hand side, split at the source's jumps, and told the gap voltage's zeros "
        "where that helps; fingerspice finds these itself, estimates its error and meets the one asked for. It repeats "
        "a period that no longer changes the state (200 periods at 100 Hz, 500 at 5 kHz); *every period* steps them "
        f"all, as its peers do. Two independent references agree to {spread:.0e}. Medians of {results['repeats']} "
        f"({once(results)}) by `python benchmarks/work_precision.py` on {results['machine']}; versions, every "
        "method, what failed, and the law `mobile`: [`work_precision.md`](../benchmarks/results/work_precision.md)."
    )
    ratio = (
        f"Times our time, the worst of the four scenes of Table 1, at {aims}: {ratios(results, OURS)}; with every "
        f"period stepped {ratios(results, STEPPED)}."
    )
    return "\n".join(
        [
            *wrapped(text),
            "",
            *short_table(results, "local", "stack"),
            "",
            *wrapped(ratio),
            "",
            "![Error against time and against evaluations](../benchmarks/results/work_precision.png)",
            *network_text(results),
        ]
    )


def network_text(results: Report) -> list[str]:
    """The part of the page on speed about networks; empty if none was measured."""
    table = short_table(results, "local", "network")
    if not table:
        return []
    text = (
        "Networks, in the same units: the shipped decks `amplifier`, `ungrounded_user` and `two_fingers` at 200 V, 100 "
        "periods. The peers integrate a right-hand side that was written by hand for these three circuits and divides "
        "the current in closed form; fingerspice is given the netlist. Where the last row is below 1 a peer is faster. "
        "Each finger's error is over its own peak. Behind the floating body one mode is hundreds of times faster than "
        "the source, which explicit methods pay for."
    )
    picture_line = "![Error against time of networks](../benchmarks/results/work_precision_networks.png)"
    return ["", *wrapped(text), "", *table, "", picture_line]


def once(results: Report) -> str:
    """Number of points that were timed only once, and the reason, in words."""
    solved = [p for p in results["points"] if p["status"] == "ok"]
    single = sum(p["repeats"] == 1 for p in solved)
    return (
        f"long runs: of 3; {single} of {len(solved)} points, over {results['far']:.0f} times the best time at their "
        "error, were timed once"
    )


def wrapped(text: str) -> list[str]:
    """Lines of a paragraph."""
    return textwrap.wrap(text, 118, break_long_words=False, break_on_hyphens=False)


def details(results: Report) -> str:
    """All results as Markdown."""
    lines = ["# Work and precision", "", f"{conditions(results)}. Made by `benchmarks/report.py`.", ""]
    aims = " / ".join(f"{t:.0e}" for t in TARGETS)
    for kind in ("stack", "network"):
        for law in ("local", "mobile"):
            table = short_table(results, law, kind)
            head = f"{kind.capitalize()}s, law `{law}`, the best of each library, µs per period at an error of {aims}:"
            lines += [head, "", *table, ""] if table else []
    for name, problem in results["problems"].items():
        law = "" if problem["charge_law"] == "local" else ", law `mobile`"
        lines += [
            f"## {problem['title']}{law}", "",
            f"{problem['periods']} periods of {problem['period_s']:g} s; {problem['reference']} agree to "
            f"{problem['reference_agreement']:.1e} of the peak ({problem['peak_u_gap_V']:.4g} V).", "",
            *long_table(results, name), "",
        ]  # fmt: skip
    compile_s: dict[str, float] = {}
    for p in results["points"]:
        compile_s[p["contestant"]] = max(compile_s.get(p["contestant"], 0.0), p["compile_s"] or 0.0)
    slow = [f"{name} {seconds:.1f} s" for name, seconds in compile_s.items() if seconds >= 0.1]
    lines += ["## Compilation", "", "Longest first call beyond a second one: " + ", ".join(slow) + ".", ""]
    return "\n".join(lines)


def recordings_text(recorded: Report) -> str:
    """The tables of recordings on the page on speed."""
    skins, bands = ("SKIN", "SKIN_DISPERSIVE"), (1_000.0, 8_000.0, 20_000.0)

    def cell(found: Report, unit: str = "sample") -> str:
        error = found["error"]
        small = "unstable" if error is None or not error < 1.0 else f"{error:.0e}".replace("e-0", "e-")
        return f"{number(found[f'ns_per_{unit}'])} ({small})"

    def rows(names: list[str], every: list[Report], same: tuple[str, ...]) -> list[list[str]]:
        kinds = list(dict.fromkeys(tuple(p[key] for key in same) for p in every))
        return [
            [
                name,
                *(cell(p) for kind in kinds for p in every if p["row"] == name and tuple(p[k] for k in same) == kind),
            ]
            for name in names
        ]

    order = {(skin, band): i for i, (skin, band) in enumerate((s, b) for s in skins for b in bands)}
    points = [
        {**p, "row": p["contestant"].replace("0.0001", "1e-4").replace("e-0", "e-")}
        for p in recorded["points"]
        if "0.001" not in p["contestant"]
    ]
    points.sort(key=lambda p: order[p["skin"], p["band_Hz"]])
    names = sorted(dict.fromkeys(p["row"] for p in points), key=lambda name: ("fingerspice" not in name, "," in name))
    head = ["", *(f"{'dispersive, ' if s != 'SKIN' and b == bands[0] else ''}to {b / 1e3:g} kHz" for s, b in order)]
    around = [
        {**p, "row": {1e-4: "1e-4", 1e-6: "1e-6"}[p["rtol"]] + (f", `{p['method']}`" if p["method"] != "auto" else "")}
        for p in recorded["networks"]
    ]
    decks = list(dict.fromkeys(p["deck"] for p in around))
    uneven = [
        " to ".join(number(ns) for ns in (min(found), max(found)))
        for found in (
            [p["ns_per_point"] for p in recorded["uneven"] if (p["skin"], p["method"]) == how]
            for how in ((skin, method) for skin in skins for method in ("auto", "exponential"))
        )
    ]
    lengths = ", ".join(f"{p['seconds']:g}" for p in recorded["lengths"])
    took = ", ".join(number(p["ns_per_sample"]) for p in recorded["lengths"])
    return "\n".join([
        *wrapped(
            f"Nanoseconds a sample, on commit {recorded['machine']['commit']}, {recorded['seconds']:g} s, by `python "
            "benchmarks/recordings.py` ([`recordings.json`](../benchmarks/results/recordings.json))."
        ),
        "", *markdown([head, *rows(names, points, ("skin", "band_Hz"))]), "",
        *wrapped('Networks with one finger, beside the engine that steps every circuit (`method="exponential"`):'), "",
        *markdown([
            ["", *(f"`{deck}`, to {b / 1e3:g} kHz" for deck in decks for b in bands[:2])],
            *rows(list(dict.fromkeys(p["row"] for p in around)), around, ("deck", "band_Hz")),
        ]), "",
        *wrapped(
            f"A PWL whose points lie up to a third of a sample beside these takes {uneven[0]} ns a point at 1e-4 and "
            f"1e-6, where the ordinary steps take {uneven[1]}; with the dispersive skin {uneven[2]} and {uneven[3]}. "
            f"Recordings up to 8 kHz of {lengths} s take {took} ns a sample at 1e-6. Where the area is given, a sample "
            f"takes {recorded['area_given']['ratio']:.1f} times that of scipy's `lfilter`."
        ),
    ])  # fmt: skip


def put_into(text: str, path: Path, name: str = "speed") -> None:
    """Put the text between the markers of a page.

    Raises
    ------
    ValueError
        If the page has no markers.
    """
    page = path.read_text(encoding="utf-8")
    before, begin, rest = page.partition(BEGIN.format(name))
    _, end, after = rest.partition(END.format(name))
    if not begin or not end:
        raise ValueError(f"{path} has no lines {BEGIN.format(name)} and {END.format(name)}")
    path.write_text(f"{before}{begin}\n{text}\n{end}{after}", encoding="utf-8")


def main(arguments: list[str] | None = None) -> None:
    """Write tables and picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument("--waits", type=Path, default=WAITS)
    options = parser.parse_args(arguments)
    results = json.loads(options.results.read_text(encoding="utf-8"))
    if "far" not in results:
        parser.error(f"{options.results} is of an earlier program; allowed: what work_precision.py writes now")
    options.results.with_suffix(".md").write_text(details(results), encoding="utf-8")
    stacks = problems(results, "local", "stack")[:4]
    picture(results, [[(n, cost) for n in stacks] for cost in COSTS], options.results.with_suffix(".png"))
    networks = [(name, "us_per_period") for name in problems(results, "local", "network")]
    if networks:
        # The upper row has the sines, the lower row the squares.
        path = options.results.with_name(f"{options.results.stem}_networks.png")
        picture(results, [networks[::2], networks[1::2]], path)
    put_into(page_text(results), options.page)
    recorded = json.loads((options.results.parent / "recordings.json").read_text(encoding="utf-8"))
    put_into(recordings_text(recorded), options.page, "recordings")
    put_into(waits(options.results.parent), options.waits)


if __name__ == "__main__":
    main()
