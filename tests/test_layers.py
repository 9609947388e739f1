"""Who may import whom: the role layers of the package, read from the source by ast."""

import ast
import functools
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "jaxface"
MODULES = sorted(PACKAGE.rglob("*.py"))
STUBS = sorted(PACKAGE.rglob("*.pyi"))
Module = tuple[str, ...]

BASE = {"_types", "_numerics", "_machine"}
NUMERICAL = BASE | {
    "geometry", "imaging", "networks", "models", "render", "energies", "solvers",
}  # fmt: skip

# layer -> the layers it may import. Every layer may import itself, except stages (see below).
ALLOWED = {
    "_types": set(),
    "_numerics": {"_types"},
    "_machine": set(),
    "_compilation": {"_types"},
    "geometry": BASE,
    "imaging": BASE,
    "networks": BASE | {"geometry", "imaging"},
    "models": BASE | {"geometry", "imaging"},
    "render": BASE | {"geometry", "imaging"},
    "energies": BASE | {"geometry", "imaging", "networks", "models", "render"},
    "solvers": BASE,
    "stages": NUMERICAL | {"_compilation"},
    "training": NUMERICAL,
    "io": BASE | {"geometry", "imaging", "networks", "models", "assets"},
    "run": BASE | {"io", ""},
    "assets": set(),
    "pipeline": NUMERICAL | {"_compilation", "stages", "training", "io", "run", "assets", ""},
    "cli": {"pipeline", "io", "run", ""},
    "__main__": {"cli"},
    "": NUMERICAL | {"stages", "training", "io", "run", "pipeline"},
}

# third-party package -> the layers that may import it (any layer, for those not listed)
RESTRICTED = {
    "optimistix": {"solvers", "training"},
    "jaxopt": {"solvers", "training"},
    "optax": {"solvers", "training"},
    "lineax": {"solvers"},
    "typer": {"cli"},
    "rich": {"cli"},
    "dask": {"pipeline"},
    "distributed": {"pipeline"},
    "filelock": {"io"},
    "jinja2": {"io"},
    "platformdirs": {"io"},
    "OpenEXR": {"io"},
    "PIL": {"io"},
    "pygltflib": {"io"},
    "h5py": {"io"},
    "tifffile": {"io"},
    # peers: measured against in benchmarks and tests, never a dependency
    "torch": set(),
    "tensorflow": set(),
    "mitsuba": set(),
    "bpy": set(),
    "eos": set(),
    "cvxpy": set(),
    "piqp": set(),
    "highspy": set(),
    "clarabel": set(),
    "scs": set(),
    "trimesh": set(),
    "matplotlib": set(),
}

NO_MATHEMATICS = {"numpy", "scipy", "skimage", "jax.numpy", "jax.scipy"}

# functions that import what a string names -> the modules they come from
BY_STRING = {
    "import_module": {"importlib"},
    "__import__": {"builtins"},
    "run_module": {"runpy"},
    "resolve_name": {"pkgutil"},
    "load": {"lazy_loader"},
}
UNREADABLE = "<a computed name>"


def dotted(path: Path) -> Module:
    """Module path inside the package: ('geometry', 'camera'), () for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def package_of(path: Path) -> Module:
    return dotted(path) if path.stem == "__init__" else dotted(path)[:-1]


def layer(module: Module) -> str:
    return module[0] if module else ""


def imports(source: str, package: Module) -> list[tuple[str, int]]:
    """Every absolute dotted name imported, with its line; relative imports are resolved.

    What is imported by a string counts too (``importlib.import_module("x")``); where the string
    is not written out, the name is `UNREADABLE`.
    """
    tree = ast.parse(source)
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = ("jaxface", *package)[: len(package) + 2 - node.level]
                base = ".".join((*parents, *([node.module] if node.module else [])))
            found += [(f"{base}.{alias.name}", node.lineno) for alias in node.names]
    return found + [*string_imports(tree)]


def string_imports(tree: ast.Module) -> Iterator[tuple[str, int]]:
    modules, functions = {"builtins": "builtins"}, {"__import__"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {alias.asname or alias.name: alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            functions |= {
                alias.asname or alias.name
                for alias in node.names
                if node.module in BY_STRING.get(alias.name, ())
            }
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        match node.func:
            case ast.Name(name):
                imports_it = name in functions or name in ("exec", "eval")
            case ast.Attribute(ast.Name(module), name):
                imports_it = modules.get(module) in BY_STRING.get(name, ())
            case _:
                imports_it = False
        if imports_it:
            given = [
                *node.args[:1],
                *(k.value for k in node.keywords if k.arg in ("name", "mod_name")),
            ]
            constant = given[0].value if given and isinstance(given[0], ast.Constant) else None
            text = constant if isinstance(constant, str) else ""
            readable = all(part.isidentifier() for part in text.split("."))
            yield (text if readable else UNREADABLE), node.lineno


def own(name: str) -> Module | None:
    """The module of ours that an imported name lives in; None for a foreign one.

    ``from jaxface import x`` counts as the subpackage x where there is one, else as the package.
    """
    first, *rest = name.split(".")
    if first != "jaxface":
        return None
    while rest:
        target = PACKAGE.joinpath(*rest)
        if target.is_dir() or target.with_suffix(".py").is_file():
            return tuple(rest)
        rest.pop()
    return ()


def violations(module: Module, source: str, package: Module) -> list[str]:
    here = layer(module)
    if here not in ALLOWED:
        return [f"{here!r} is no layer that the layer test knows"]
    wrong = []
    for name, line in imports(source, package):
        target = own(name)
        if name == UNREADABLE:
            wrong.append(f"line {line}: imports {name}; write the name out, for this test to read")
        elif target is None:
            root = name.split(".")[0]
            if here not in RESTRICTED.get(root, {here}):
                wrong.append(f"line {line}: {here or 'the package'} imports {root}")
            if here == "cli" and any(name == n or name.startswith(n + ".") for n in NO_MATHEMATICS):
                wrong.append(f"line {line}: cli does mathematics with {name}")
        elif here == "stages" and layer(target) == "stages":
            if len(module) > 1 and module[1:2] != target[1:2]:  # stages/__init__ may re-export
                wrong.append(f"line {line}: a stage imports another stage ({name})")
        elif layer(target) != here and layer(target) not in ALLOWED[here]:
            wrong.append(f"line {line}: {here or 'the package'} imports {name}")
    return wrong


@pytest.mark.parametrize("path", MODULES + STUBS, ids=lambda p: str(p.relative_to(ROOT)))
def test_layers(path: Path) -> None:
    wrong = violations(dotted(path), path.read_text(encoding="utf-8"), package_of(path))
    assert not wrong, "\n".join(wrong)


def importers(name: str, sources: Mapping[str, str]) -> dict[str, bool]:
    """The files that import a package, and whether they do so as soon as they are imported."""
    found = {}
    for file, source in sources.items():
        names = [(n.split(".")[0], line) for n, line in imports(source, ())]
        lines = {line for n, line in names if n == name}
        if lines:
            lazy = [
                range(node.lineno, (node.end_lineno or node.lineno) + 1)
                for node in ast.walk(ast.parse(source))
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            ]
            found[file] = not all(any(line in body for body in lazy) for line in lines)
    return found


def test_jaxopt_is_imported_lazily_in_one_place() -> None:
    """It warns on import and is no longer developed, so one function holds the import."""
    sources = {str(p.relative_to(ROOT)): p.read_text(encoding="utf-8") for p in MODULES}
    found = importers("jaxopt", sources)
    assert len(found) == 1, f"jaxopt is imported in {sorted(found)}; in one place it should be"
    assert not any(found.values()), f"{found} imports it eagerly"


@functools.cache
def edges() -> dict[Module, set[Module]]:
    """Which module of ours imports which; in a function or a stub counts too."""
    found = defaultdict(set)
    for path in MODULES + STUBS:
        for name, _ in imports(path.read_text(encoding="utf-8"), package_of(path)):
            target = own(name)
            if target is not None and target != dotted(path):
                found[dotted(path)].add(target)
    return found


def between_rooms(
    graph: Mapping[Module, Iterable[Module]], folder: Module
) -> dict[Module, set[Module]]:
    """The graph of what lies directly in a folder; the folder's own names are no part of it."""
    depth = len(folder) + 1
    found = defaultdict(set)
    for module, targets in graph.items():
        for target in targets:
            if len(module) >= depth <= len(target) and module[: depth - 1] == folder:
                if target[: depth - 1] == folder and target[:depth] != module[:depth]:
                    found[module[:depth]].add(target[:depth])
    return found


def cycle(graph: Mapping[Module, Iterable[Module]]) -> list[Module]:
    """One cycle, from a module to itself, or an empty list."""
    done: set[Module] = set()

    def search(path: list[Module]) -> list[Module]:
        for target in sorted(graph.get(path[-1], ())):
            if target in path:
                return [*path[path.index(target) :], target]
            if target not in done and (found := search([*path, target])):
                return found
        done.add(path[-1])
        return []

    return next((found for start in sorted(graph) if (found := search([start]))), [])


def test_no_module_imports_itself_by_way_of_others() -> None:
    graph = {m: {t for t in targets if t} for m, targets in edges().items() if m}
    assert len(graph) > 100
    assert not cycle(graph)


@pytest.mark.parametrize(
    "folder",
    sorted({package_of(path) for path in MODULES}),
    ids=lambda folder: ".".join(("jaxface", *folder)),
)
def test_rooms_of_a_folder_have_an_order(folder) -> None:
    """The package itself is such a folder: its layers."""
    found = cycle(between_rooms(edges(), folder))
    assert not found, " -> ".join(".".join(module) for module in found)


def test_the_package_itself_is_imported_for_facts_alone() -> None:
    """A name of ``jaxface.__init__`` lies in a module that has an order; the lazy one has none."""
    wrong = []
    for path in MODULES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                if node.value.id == "jaxface" and not node.attr.startswith("__"):
                    wrong.append(f"{path}:{node.lineno}: jaxface.{node.attr}")
        wrong += [
            f"{path}:{line}: {name}"
            for name, line in imports(path.read_text(encoding="utf-8"), package_of(path))
            if own(name) == () and name not in ("jaxface", "jaxface.__version__")
        ]
    assert not wrong


@pytest.mark.parametrize(
    ("module", "source", "said"),
    [
        (("energies", "prior"), "import optimistix as optx", "imports optimistix"),
        (("energies", "prior"), "from jaxface.solvers import minimise", "imports jaxface.solvers"),
        (("geometry", "uv"), "def f():\n    from ..imaging import colour", "imaging"),
        (("imaging", "uv"), "from jaxface import geometry", "geometry"),
        (("solvers", "gn"), "from jaxface.models.linear import LinearBasis", "models"),
        (("stages", "fit"), "from . import unwrap", "another stage"),
        (("render", "a"), "from jaxface.io import image", "io"),
        (("cli",), "import jax.numpy as jnp", "mathematics"),
        (("misc",), "", "no layer"),
        (("io", "a"), "import importlib\nimportlib.import_module('jaxopt.x')", "imports jaxopt"),
        (("io", "a"), "from importlib import import_module as f\nf('typer')", "imports typer"),
        (("io", "a"), "def f():\n    return __import__('optax')", "imports optax"),
        (("io", "a"), "import importlib as i\ni.import_module(name='torch')", "imports torch"),
        (("io", "a"), "import lazy_loader\nlazy_loader.load('trimesh')", "imports trimesh"),
        (("io", "a"), "import builtins\nbuiltins.__import__('jaxopt')", "imports jaxopt"),
        (("energies", "a"), "import runpy\nrunpy.run_module('jaxface.io')", "jaxface.io"),
        (("io", "a"), "from importlib import import_module\nimport_module(NAME)", "computed"),
        (("io", "a"), "import importlib\nimportlib.import_module('.x', 'y')", "computed"),
        (("io", "a"), "exec('import jaxopt')", "computed"),
    ],
)
def test_the_test_finds_violations(module, source, said) -> None:
    found = violations(module, source, module[:-1])
    assert found and said in found[0]


def test_allowed_imports_pass() -> None:
    source = "import jax\nimport equinox\nfrom jaxface._types import Array\nfrom . import camera"
    assert not violations(("geometry", "mesh"), source, ("geometry",))
    assert not violations(("solvers", "gn"), "import optimistix, lineax", ("solvers",))
    source = "import importlib\ndef f():\n    return importlib.import_module('jaxopt')"
    assert not violations(("solvers", "gn"), source, ("solvers",))
    assert not violations(("io", "a"), "import numpy\nnumpy.load('x')\nload('x')", ("io",))


def test_importers_are_found_however_they_write_it() -> None:
    string = "import importlib\n{}importlib.import_module('jaxopt')"
    sources = {
        "none": "import jax\nname = 'jaxopt'",
        "eager": "import jaxopt",
        "class": "class A:\n    from jaxopt import LBFGS",
        "string": string.format(""),
        "lazy": "def f():\n    from jaxopt.loss import x",
        "lazy string": string.format("def f():\n    return "),
    }
    found = importers("jaxopt", sources)
    assert found == {
        "eager": True, "class": True, "string": True, "lazy": False, "lazy string": False,
    }  # fmt: skip


def test_cycles_are_found() -> None:
    a, b, c = ("x", "a"), ("x", "b"), ("y", "c")
    assert not cycle({a: {b, c}, b: {c}})
    assert cycle({a: {b}, b: {c}, c: {a}}) == [a, b, c, a]
    graph = {a: {c}, c: {b}}
    assert not cycle(graph)
    assert cycle(between_rooms(graph, ())) == [("x",), ("y",), ("x",)]
    inside = {("x", "p", "a"): {("x", "q", "b")}, ("x", "q", "c"): {("x", "p", "d"), ("y",)}}
    assert not cycle(between_rooms(inside, ())) and cycle(between_rooms(inside, ("x",)))
    assert not cycle(between_rooms(inside, ("y",)))
