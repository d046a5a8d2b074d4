"""What may import what, and what no source file does: read from the source, not from running it."""

from __future__ import annotations

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from fingerspice.base.compiled import SHARED_FOLDERS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "fingerspice"
FILES = sorted(PACKAGE.rglob("*.py"))
MAX_LINES = 450

# From the bottom up: a part imports its own files and the parts above it in this list, nothing below.
ORDER = (
    *("base", "numerics", "physics", "engine", "waveforms", "circuit", "netlist"),
    *("results", "solve", "plots", "studies", "cli", "__main__"),
)
# Beside each other, not one on the other.
STRANGERS = (
    ("circuit", "engine"),
    ("netlist", "engine"),
    ("plots", "solve"),
    ("physics.phasor", "circuit.statespace"),
    ("physics.phasor", "engine"),
)
# Methods and commands that lend a hand upwards, inside a function, so that nothing is loaded before it is used.
LENT = {
    ("results", "plots"),
    ("circuit", "results"),
    ("circuit", "netlist"),
}
THIRD_PARTY = {
    "numerics": {"numpy", "numba"},
    "physics": {"numpy", "numba"},
    "engine": {"numpy", "numba"},
    "circuit": {"numpy"},
    "netlist": {"numpy"},
    "base": {"numba", "numpy", "rich"},
    "base.errors": set(),
    "base.units": set(),
    "base.files": set(),
}


def name_of(path: Path) -> str:
    """Dotted name inside the package; the package itself is ``""``."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {name_of(path) for path in FILES}


def part_of(name: str) -> str:
    return name.partition(".")[0]


def guarded(tree: ast.Module) -> set[ast.AST]:
    """Nodes under ``if TYPE_CHECKING``: never run."""
    out: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            out |= {n for statement in node.body for n in ast.walk(statement)}
    return out


def imports(path: Path, top_only: bool = False) -> set[str]:
    """Modules a file imports when it runs (with `top_only`: when it is loaded), absolute names."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    skipped = guarded(tree)
    found: set[str] = set()
    for node in tree.body if top_only else ast.walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            assert node.module is not None
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            submodules = {x for x in inner if x.removeprefix("fingerspice.") in NAMES}
            found |= submodules or {node.module}
    return found


def own(path: Path, top_only: bool = False) -> set[str]:
    """The package's own modules that a file imports, names inside the package."""
    mine = {x for x in imports(path, top_only) if x.startswith("fingerspice.")}
    return {x.removeprefix("fingerspice.") for x in mine}


each_file = pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))


def test_every_part_of_the_package_has_a_place_in_the_order() -> None:
    assert {part_of(n) for n in NAMES if n} <= set(ORDER)


@each_file
def test_imports_go_downward_only(path: Path) -> None:
    part = part_of(name_of(path))
    if part == "":
        assert own(path, top_only=True) == set(), "the package loads its parts on first use"
        return
    for other in own(path):
        if part_of(other) == part or ((part, part_of(other)) in LENT and other not in own(path, top_only=True)):
            continue
        assert ORDER.index(part_of(other)) < ORDER.index(part), f"{part} imports {other}"


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
    tree = ast.parse(path.read_text(encoding="utf-8"))
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
    tree = ast.parse(path.read_text(encoding="utf-8"))
    origin = {
        alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fingerspice")
        for alias in node.names
    }
    shared = tuple(f"fingerspice.{part}" for part in (*SHARED_FOLDERS, "base.compiled"))
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
    tree = ast.parse(path.read_text(encoding="utf-8"))
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
    assert not [n.lineno for n in calls if n.func.id == "print"]


@each_file
def test_source_files_stay_short(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) < MAX_LINES


def test_the_reference_is_independent_of_the_package() -> None:
    path = ROOT / "tests" / "analytic.py"
    assert not [x for x in imports(path) if x.partition(".")[0] == "fingerspice"]
    assert "import_module" not in path.read_text(encoding="utf-8")


def test_importing_the_package_loads_nothing_heavy() -> None:
    heavy = ("numba", "matplotlib", "xarray", "torch", "torchdiffeq", "scipy", "pandas", "h5netcdf", "typer", "rich")
    code = f"import sys, fingerspice; print([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_found_where_the_package_says() -> None:
    import fingerspice

    for name in fingerspice.__all__:
        assert getattr(fingerspice, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        _ = fingerspice.simulat
