"""Allowed imports between modules, and limits of every source file, checked on the source text without running it."""

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from fingerspice.base.compiled import SHARED_FOLDERS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "fingerspice"
FILES = sorted(PACKAGE.rglob("*.py"))
MAX_LINES = 600
# Lines of all files together and of each package, and the number of files: as many as there are. They are only ever
# lowered; what moves from one package to another takes its lines along. Contact laws raised them
# by 1,243 where 1,200 were given, and their roots without scipy by 17; SPICE's directives and devices by 2,799 where
# 2,500 were; and compiled code that comes with wheels by 180 of 250.
ALL_LINES = 38_552
ALL_FILES = 134
PACKAGE_LINES = {
    "base": 1_097, "circuit": 2_805, "cli": 1_724, "engine": 7_183, "explorer": 1_167, "netlist": 2_723,
    "numerics": 1_170, "physics": 819, "plots": 1_304, "results": 3_345, "sets": 361, "solve": 5_472,
    "studies": 6_608, "torch": 375, "waveforms": 2_239,
}  # fmt: skip

# Functions outside compiled code: lines of the body without its docstring, and parameters without `self`.
MAX_BODY, MAX_PARAMETERS = 60, 8
# Compiled functions, whose loops cannot be divided freely: a call passes every array that the callee uses.
MAX_COMPILED_BODY, MAX_COMPILED_PARAMETERS = 100, 12
# Each parameter is an option of the command line or a keyword that users may leave out.
MANY_PARAMETERS = {
    "cli.app.run",
    "studies.inverse.inverse_drive",
    "solve.simulation.simulate",
    "solve.simulation.plan",
    "studies.batch.batch.batch",
    "studies.fit.fit",
    "studies.sweep.sweep",
    "studies.steady.steady_state",
    "solve.streaming.stream",
    "torch.Simulator.__init__",
}
# Functions over the limits, with their lines and parameters: no other may be, and these may only shrink.
LARGER = {
    "engine.lockstep.card.thread_kernel.kernel": (28, 17),
}

# From the bottom up: a part imports its own files and the parts above it in this list, nothing below.
ORDER = (
    *("base", "numerics", "physics", "engine", "waveforms", "circuit", "netlist", "sets"),
    *("results", "solve", "plots", "studies", "torch", "explorer", "cli", "__main__"),
)
# Beside each other, not one on the other.
STRANGERS = (
    ("circuit", "engine"), ("netlist", "engine"), ("plots", "solve"), ("physics.phasor", "circuit.statespace"),
    ("physics.phasor", "engine"),
)  # fmt: skip
# Methods that call a part above their own, and load it only when they are called.
LENT = {
    "circuit.circuit.Circuit._replaced": "netlist.netlist",
    "circuit.circuit.Circuit.draw": "plots.schematic",
    "circuit.circuit.Circuit.explore": "explorer",
    "results.solution.Solution.plot": "plots.traces",
    "results.solution.Solution.explore": "explorer",
    "results.solution.Solution.sample_gradient": "solve.derivatives",
    "results.spectrum.Spectrum.plot": "plots.traces",
    "results.spectrum.PhasorSolution.plot": "plots.traces",
    "results.spectrum.PhasorSolution.plot_impedance": "plots.traces",
}
THIRD_PARTY = {
    "numerics": {"numpy", "numba"}, "physics": {"numpy", "numba"}, "engine": {"numpy", "numba"}, "circuit": {"numpy"},
    "circuit.laws": {"numpy", "scipy"}, "physics.laws": {"numpy", "scipy"},
    "netlist": {"numpy"}, "sets": set(), "base": {"numba", "llvmlite", "numpy", "rich"}, "base.errors": set(),
    "base.units": set(), "base.files": set(),
}  # fmt: skip


def name_of(path: Path) -> str:
    """Dotted name inside the package; the package itself is ``""``."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {name_of(path) for path in FILES}


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def part_of(name: str) -> str:
    return name.partition(".")[0]


def named(tree: ast.Module, name: str) -> dict[ast.AST, str]:
    """Every node inside a function, with the dotted name of the outermost function around it."""
    inside: dict[ast.AST, str] = {}

    def visit(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef):
                visit(child, f"{prefix}.{child.name}")
            elif isinstance(child, ast.FunctionDef):
                inside.update(dict.fromkeys(ast.walk(child), f"{prefix}.{child.name}"))
            else:
                visit(child, prefix)

    visit(tree, name)
    return inside


def modules(node: ast.AST) -> set[str]:
    """Modules that an import statement names, absolute names; none for another statement."""
    if isinstance(node, ast.Import):
        return {alias.name for alias in node.names}
    if isinstance(node, ast.ImportFrom):
        assert node.level == 0, f"line {node.lineno} imports relatively"
        assert node.module is not None
        inner = {f"{node.module}.{alias.name}" for alias in node.names}
        return {x for x in inner if x.removeprefix("fingerspice.") in NAMES} or {node.module}
    return set()


def imports(path: Path, top_only: bool = False) -> set[str]:
    """Modules that a file imports, for type checking too; with `top_only` only when it is loaded."""
    tree = tree_of(path)
    return {x for node in (tree.body if top_only else ast.walk(tree)) for x in modules(node)}


def own(path: Path, top_only: bool = False) -> set[str]:
    """The package's own modules that a file imports, names inside the package."""
    mine = {x for x in imports(path, top_only) if x.startswith("fingerspice.")}
    return {x.removeprefix("fingerspice.") for x in mine}


each_file = pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))


def test_every_part_of_the_package_has_a_place_in_the_order() -> None:
    assert {part_of(n) for n in NAMES if n} <= set(ORDER)


@each_file
def test_imports_go_downward_only_also_those_for_type_checking(path: Path) -> None:
    name = name_of(path)
    part = part_of(name)
    if part == "":
        assert own(path, top_only=True) == set(), "the package loads its parts on first use"
        return
    tree = tree_of(path)
    function = named(tree, name)
    for node in ast.walk(tree):
        for other in {x.removeprefix("fingerspice.") for x in modules(node) if x.startswith("fingerspice.")}:
            if part_of(other) == part or LENT.get(function.get(node, "")) == other:
                continue
            assert ORDER.index(part_of(other)) < ORDER.index(part), f"line {node.lineno}: {part} imports {other}"  # type: ignore[attr-defined]


def test_every_function_that_calls_a_part_above_its_own_exists() -> None:
    found = set()
    for path in FILES:
        inside = named(tree_of(path), name_of(path))
        found |= {(function, module) for node, function in inside.items() for module in modules(node)}
    assert {(function, f"fingerspice.{other}") for function, other in LENT.items()} <= found


def test_no_two_files_import_each_other_even_round_about() -> None:
    graph = {name_of(p): own(p, top_only=True) for p in FILES}
    assert len(list(TopologicalSorter(graph).static_order())) >= len(graph)


@pytest.mark.parametrize(("a", "b"), STRANGERS)
def test_strangers_never_import_each_other(a: str, b: str) -> None:
    for one, other in ((a, b), (b, a)):
        files = [p for p in FILES if name_of(p) == one or name_of(p).startswith(f"{one}.")]
        assert files
        for path in files:
            assert not [x for x in own(path) if x == other or x.startswith(f"{other}.")], f"{one} imports {other}"


@each_file
def test_the_lower_parts_need_few_packages(path: Path) -> None:
    name = name_of(path)
    allowed = THIRD_PARTY.get(name, THIRD_PARTY.get(part_of(name)))
    if allowed is None:
        return
    roots = {x.partition(".")[0] for x in imports(path)} - {"fingerspice"} - set(sys.stdlib_module_names)
    assert roots <= allowed


@each_file
def test_nothing_evaluates_text_or_unpickles(path: Path) -> None:
    tree = tree_of(path)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = node.func.id if isinstance(node.func, ast.Name) else ""
            assert called not in ("eval", "exec", "compile", "__import__"), f"line {node.lineno}"
            assert not [k for k in node.keywords if k.arg == "allow_pickle"], f"line {node.lineno}"
        if isinstance(node, ast.Name):
            assert node.id not in ("eval", "exec"), f"line {node.lineno}"
    forbidden = {"pickle", "marshal", "shelve", "dill", "joblib"}
    assert not forbidden & {x.partition(".")[0] for x in imports(path)}


@each_file
def test_compiled_code_calls_other_files_in_the_shared_folders_only(path: Path) -> None:
    # The key of the compiled code's cache holds the state of these folders: see compiled.py.
    if name_of(path).partition(".")[0] in SHARED_FOLDERS:
        return
    tree = tree_of(path)
    origin = {
        alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fingerspice")
        for alias in node.names
    }
    # Names of array types stand in signatures only.
    shared = tuple(f"fingerspice.{part}" for part in (*SHARED_FOLDERS, "base.compiled", "base.arrays"))
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        if any(isinstance(d, ast.Name) and d.id.startswith("jit") for d in function.decorator_list):
            called = {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}
            assert all(origin[name].startswith(shared) for name in called & set(origin)), function.name


@each_file
def test_nothing_prints_but_the_command_line(path: Path) -> None:
    if name_of(path) == "cli.terminal":
        return
    tree = tree_of(path)
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
    assert not [n.lineno for n in calls if n.func.id == "print"]


@each_file
def test_source_files_stay_short(path: Path) -> None:
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= MAX_LINES


def functions(path: Path) -> Iterator[tuple[str, bool, int, int]]:
    """Every function: its dotted name, whether it is compiled, lines of its body, parameters."""

    def visit(node: ast.AST, prefix: str) -> Iterator[tuple[str, bool, int, int]]:
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, (ast.FunctionDef, ast.ClassDef)):
                yield from visit(child, prefix)
                continue
            name = f"{prefix}.{child.name}"
            yield from visit(child, name)
            if isinstance(child, ast.FunctionDef):
                first = child.body[1] if ast.get_docstring(child) is not None and len(child.body) > 1 else child.body[0]
                a = child.args
                given = len(a.posonlyargs) + len(a.args) + len(a.kwonlyargs) + bool(a.vararg) + bool(a.kwarg)
                given -= bool(a.args) and a.args[0].arg in ("self", "cls")
                compiled = any(isinstance(d, ast.Name) and d.id.startswith("jit") for d in child.decorator_list)
                assert child.end_lineno is not None
                yield name, compiled, child.end_lineno - first.lineno + 1, given

    yield from visit(tree_of(path), name_of(path))


def test_the_whole_grows_no_more() -> None:
    files = [*FILES, *PACKAGE.rglob("*.pyi")]
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    assert len(lines) <= ALL_FILES
    every = sum(lines.values())
    assert every <= ALL_LINES, f"{every} lines in all; allowed: {ALL_LINES}, as something else becomes shorter"
    for package, allowed in PACKAGE_LINES.items():
        own = sum(n for path, n in lines.items() if path.relative_to(PACKAGE).parts[0] == package)
        assert 0 < own <= allowed, f"{package} has {own} lines; allowed: {allowed}"


@pytest.mark.parametrize("folder", ["benchmarks", "docs", "tests"])
def test_what_others_import_from_the_package_exists(folder: str) -> None:
    found = {x for path in (ROOT / folder).rglob("*.py") for x in imports(path) if x.startswith("fingerspice.")}
    assert found <= {f"fingerspice.{name}" for name in NAMES}
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fingerspice."):
                whole = importlib.import_module(str(node.module))
                for name in (alias.name for alias in node.names if f"{node.module}.{alias.name}" not in found):
                    assert hasattr(whole, name), f"{path}: {node.module} has no {name}"


@each_file
def test_functions_stay_small(path: Path) -> None:
    for name, compiled, body, given in functions(path):
        most = (MAX_COMPILED_BODY, MAX_COMPILED_PARAMETERS) if compiled else (MAX_BODY, MAX_PARAMETERS)
        small = body <= most[0] and (given <= most[1] or name in MANY_PARAMETERS)
        if name in LARGER:
            known = LARGER[name]
            assert not small, f"{name} is within the limits: take it from LARGER"
            assert body <= known[0], f"{name} has {body} lines, {known[0]} so far"
            assert given <= known[1], f"{name} has {given} parameters, {known[1]} so far"
        else:
            assert small, f"{name} has {body} lines and {given} parameters; allowed: {most[0]} and {most[1]}"


def test_every_exception_from_the_limits_is_of_something_that_exists() -> None:
    every = {name for path in FILES for name, *_ in functions(path)}
    assert set(LARGER) | MANY_PARAMETERS <= every


def test_the_reference_is_independent_of_the_package() -> None:
    path = ROOT / "tests" / "analytic.py"
    assert not [x for x in imports(path) if x.partition(".")[0] == "fingerspice"]
    assert "import_module" not in path.read_text(encoding="utf-8")


def test_importing_the_package_loads_nothing_heavy() -> None:
    heavy = ("numba", "matplotlib", "xarray", "torch", "torchdiffeq", "scipy", "pandas", "h5netcdf", "typer", "rich")
    code = f"import sys, fingerspice; print([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_sources_are_made_without_the_compiler() -> None:
    code = (
        "import sys, fingerspice as fs; fs.Chirp(9, 20, 2e4, 1); fs.PWL([0, 1], [0, 1]); print('numba' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "False"


def test_every_public_name_is_found_where_the_package_says() -> None:
    import fingerspice

    for name in fingerspice.__all__:
        assert getattr(fingerspice, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        _ = fingerspice.simulat
