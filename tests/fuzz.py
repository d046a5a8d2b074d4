"""Fuzzing of all readers of text: every input is accepted, or refused in one sentence, without other effects.

`python tests/fuzz.py --inputs 1000000 --seed 0`; the line of a failure gives the command that repeats it alone.
"""

import argparse
import gc
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import fingerspice as fs
import fuzz_inputs as make
from deck_edits import evaluate
from fingerspice.base.errors import FingerspiceWarning, InputError, Where
from fingerspice.netlist.deck import LONGEST_TITLE
from fingerspice.netlist.netlist import source_from_text, sweep_from_text
from fingerspice.netlist.reader import MAX_WARNINGS
from fingerspice.studies.fit.materialfit import fit_material, read_table

#: One input may take so long, s, and so much memory, MiB; and the whole run so much more than its first quarter, MiB.
SECONDS, ROOM, MEMORY = 10, 1024, 100
LONGEST_MESSAGE = 1500


class Defect(BaseException):
    """What an input must not bring about; no handler for ordinary exceptions may swallow it."""


class Watch:
    """Says what the interpreter is asked to do while an input is read: a hook for audit events, active on demand."""

    _HARMLESS = frozenset({"sys._getframe", "builtins.id"})

    def __init__(self) -> None:
        self.folder: str | None = None
        self.seen: list[str] = []
        sys.addaudithook(self._hook)

    @contextmanager
    def over(self, folder: Path, anywhere: bool = False) -> Iterator[None]:
        """Watch a block, in which files may be read in a folder only, or anywhere; else `Defect` is raised."""
        self.seen, self.folder = [], "" if anywhere else str(folder.resolve()) + os.sep
        try:
            yield
        finally:
            self.folder = None
            if self.seen:
                raise Defect(self.seen[0])

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.folder is None or event in self._HARMLESS:
            return
        if event == "open" and self._may_open(*arguments):
            return
        if event in ("os.listdir", "os.scandir") and self._inside(arguments[0]):
            return
        self.seen.append(f"{event} {str(arguments)[:200]}")

    def _inside(self, path: Any) -> bool:
        return (os.path.realpath(path) + os.sep).startswith(self.folder or "")

    def _may_open(self, path: Any, mode: str | None, flags: int) -> bool:
        return not flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT) and self._inside(path)


WATCH = Watch()


@dataclass
class Bench:
    """What the targets share: a folder with a deck and its files, and a circuit for the options of a command."""

    folder: Path
    circuit: fs.Circuit = field(init=False)

    def __post_init__(self) -> None:
        self.folder = self.folder / "deck"
        (self.folder / "sub").mkdir(parents=True)
        files = {
            "part.lib": "Rpart drive 0 1k\n.param part=1\n",
            "loop.lib": ".include loop.lib\n",
            "ping.lib": ".include pong.lib\n",
            "pong.lib": ".include ping.lib\n",
            "sub/inner.lib": ".include ../part.lib\n",
            "../outside.lib": "Routside drive 0 1k\n",
        }
        for name, text in files.items():
            (self.folder / name).write_text(text)
        (self.folder / "link.lib").symlink_to(self.folder.parent / "outside.lib")
        os.mkfifo(self.folder / "pipe.lib")
        self.circuit = fs.read_netlist(make.CIRCUITS / "fingerpad.cir")


def _shown_well(circuit: fs.Circuit) -> fs.Circuit:
    """The circuit, if what is shown of it drives no terminal and floods none."""
    title = circuit.title
    if not title.isprintable() or len(title) > LONGEST_TITLE or len(circuit.warnings) > MAX_WARNINGS + 1:
        raise Defect(f"not fit to be shown: {title[:300]!r}, {len(circuit.warnings)} warnings")
    return circuit


def _read_text(rng: random.Random, bench: Bench) -> object:
    text = make.netlist(rng)
    with WATCH.over(bench.folder):
        return _shown_well(fs.parse_netlist(text, bench.folder / "deck.cir"))


def _read_file(rng: random.Random, bench: Bench) -> object:
    data = make.deck_file(rng)
    (bench.folder / "deck.cir").write_bytes(data)
    if b"mutated.lib" in data:
        (bench.folder / "mutated.lib").write_bytes(make.deck_file(rng))
    with WATCH.over(bench.folder):
        return _shown_well(fs.read_netlist(bench.folder / "deck.cir"))


def _evaluate(rng: random.Random, bench: Bench) -> object:
    text, names = make.expression(rng), {"a": 2.0, "w": -1.5, "p0": 1e-6, "Top": 1e300}
    with WATCH.over(bench.folder):
        value = evaluate(text, names, Where("deck.cir", 1))
    if not abs(value) < float("inf"):
        raise Defect(f"the value is {value}")
    return value


def _read_option(rng: random.Random, bench: Bench) -> object:
    text = make.source_text(rng)
    name = rng.choice(
        ["Xgap.d", "Xcoat.r", "Vdrive.amplitude", "Xskin.f", "Xgap.tau", "Xgpa.d", "Xgap.fn", "Xgap.n_exp"]
    )
    # The command line is the user's own: unlike a netlist, its sources may name files anywhere.
    with WATCH.over(bench.folder, anywhere=True):
        kind = rng.random()
        if kind < 0.7:
            return bench.circuit.replace({"Vdrive": source_from_text(text, bench.circuit)})
        if kind < 0.85:
            return sweep_from_text(text)
        return bench.circuit.replace({name: text})


def _read_table(rng: random.Random, bench: Bench) -> object:
    path = bench.folder / "table.csv"
    path.write_bytes(make.table(rng))
    with WATCH.over(bench.folder):
        table = read_table(path)
        # Most tables of random numbers are no material's.
        with suppress(fs.InputError):
            fit_material(path, poles=1)
        return table


Target = Callable[[random.Random, Bench], object]
#: Target and how many of twenty inputs it gets.
TARGETS: dict[str, tuple[Target, int]] = {
    "netlist": (_read_text, 6),
    "file": (_read_file, 2),
    "expression": (_evaluate, 7),
    "option": (_read_option, 4),
    "table": (_read_table, 1),
}


@dataclass
class Report:
    """What came of a run: inputs by target and outcome, and the defects with the way to repeat them."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    defects: list[str] = field(default_factory=list)
    seconds: float = 0.0
    memory: float = 0.0

    def text(self) -> str:
        """A line for each target, and one for the whole."""
        outcomes = ("taken", "refused", "defect")
        lines = [
            "  ".join([f"{name:12s}", *(f"{self.counts[name, outcome]:9,} {outcome}" for outcome in outcomes)])
            for name in TARGETS
        ]
        total = sum(self.counts.values())
        rate = total / self.seconds if self.seconds else 0.0
        whole = f"{total:,} inputs in {self.seconds:.0f} s, {rate:,.0f} a second, {self.memory:.0f} MiB more memory"
        return "\n".join([*lines, whole])


def judge(error: InputError) -> None:
    """Raise `Defect` for a refusal that is not one clear sentence."""
    said = str(error)
    clear = error.message.strip() and said.isprintable() and len(said) <= LONGEST_MESSAGE
    if not clear or "Traceback" in said:
        raise Defect(f"no clear sentence: {said[:300]!r}")


def judge_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """Refuse a warning of ours that is not one line of text, as `judge` does."""
    if not str(message).isprintable() or len(str(message)) > LONGEST_MESSAGE:
        raise Defect(f"no clear warning: {str(message)[:300]!r}")


@contextmanager
def little_room() -> Iterator[None]:
    """A block that may take `ROOM` MiB more memory than there is now, and is refused what goes beyond."""
    limits = resource.getrlimit(resource.RLIMIT_AS)
    if sys.platform == "linux":
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + ROOM * 2**20, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)


def once(target: Target, seed: str, bench: Bench) -> str:
    """Read one input; `taken` or `refused`.

    Any other outcome is a `Defect`, a warning of numpy's included, and one that takes too long.
    """

    def late(signum: int, frame: FrameType | None) -> None:
        raise Defect(f"no answer after {SECONDS} s")

    rng = random.Random(seed)
    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        target(rng, bench)
    except InputError as error:
        judge(error)
        return "refused"
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        said = f"{type(error).__name__}: {error}"
        raise Defect(f"{said[:200]!r} in {Path(place.filename).name}:{place.lineno}") from error
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    return "taken"


def run(
    inputs: int,
    seed: str = "0",
    targets: dict[str, tuple[Target, int]] = TARGETS,
    first: int = 0,
    say: Callable[[str], object] = str,
) -> Report:
    """Read so many inputs, the target of each and what it holds made from the seed and its number alone.

    `first` is the number of the first input, and `say` is told of every defect at once.
    """
    report = Report()
    wheel = [name for name, (_, share) in targets.items() for _ in range(share)]
    # Files in memory, where there are such, are written ten times faster.
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    folder = Path(tempfile.mkdtemp(prefix="fuzz-", dir=memory))
    try:
        bench = Bench(folder)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("always", FingerspiceWarning)
            warnings.showwarning = judge_warning
            _warm_up()
            start, early = time.perf_counter(), _taken()
            for number in range(first, first + inputs):
                name = wheel[number % len(wheel)]
                try:
                    with little_room():
                        outcome = once(targets[name][0], f"{seed}/{number}", bench)
                except Defect as defect:
                    outcome = "defect"
                    report.defects.append(f"--seed {seed} --first {number} --inputs 1: {name}: {defect}")
                    say(report.defects[-1])
                report.counts[name, outcome] += 1
                if number - first == inputs // 4:
                    early = _taken()
            report.seconds = time.perf_counter() - start
            report.memory = _taken() - early
    finally:
        shutil.rmtree(folder)
    if report.memory > MEMORY:
        report.defects.append(f"--seed {seed} --inputs {inputs}: {report.memory:.0f} MiB more memory than at the start")
        say(report.defects[-1])
    return report


@cache
def _warm_up() -> None:
    """Load, once in a process, what is loaded on first use: reading a file is an event."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        table = Path(folder) / "table.csv"
        table.write_text("".join(f"{10.0**k:g},{1000 / k:g},{9999 / k:g}\n" for k in range(1, 6)))
        fit_material(table, poles=1)
    for path in sorted(make.CIRCUITS.glob("*.cir")):
        fs.read_netlist(path)
    gc.collect()


def _taken() -> float:
    """Memory in use, or where that is not known the largest so far, MiB."""
    gc.collect()
    if sys.platform == "linux":
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> int:
    """Run from the command line; 1 where there is a defect."""
    parser = argparse.ArgumentParser(description="Fuzz everything that reads text.")
    parser.add_argument("--inputs", type=int, default=20_000, help="how many inputs")
    parser.add_argument("--seed", default="0", help="what they are made from")
    parser.add_argument("--first", type=int, default=0, help="number of the first, to repeat one")
    given = parser.parse_args()
    report = run(given.inputs, given.seed, first=given.first, say=lambda line: print(line, flush=True))
    print(report.text())
    return 1 if report.defects else 0


if __name__ == "__main__":
    sys.exit(main())
