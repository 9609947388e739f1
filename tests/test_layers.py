"""Who may import whom: the role layers of the package, read from the source by ast."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "jaxface"
MODULES = sorted(PACKAGE.rglob("*.py"))

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


def dotted(path: Path) -> tuple[str, ...]:
    """Module path inside the package: ('geometry', 'camera'), () for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def layer(module: tuple[str, ...]) -> str:
    return module[0] if module else ""


def imports(source: str, package: tuple[str, ...]) -> list[tuple[str, int]]:
    """Every absolute dotted name imported, with its line; relative imports are resolved."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = ("jaxface", *package)[: len(package) + 2 - node.level]
                base = ".".join((*parents, *([node.module] if node.module else [])))
            found += [(f"{base}.{alias.name}", node.lineno) for alias in node.names]
    return found


def own(name: str) -> tuple[str, ...] | None:
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


def violations(module: tuple[str, ...], source: str, package: tuple[str, ...]) -> list[str]:
    here = layer(module)
    if here not in ALLOWED:
        return [f"{here!r} is no layer that the layer test knows"]
    wrong = []
    for name, line in imports(source, package):
        target = own(name)
        if target is None:
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


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_layers(path: Path) -> None:
    module = dotted(path)
    package = module if path.name == "__init__.py" else module[:-1]
    wrong = violations(module, path.read_text(encoding="utf-8"), package)
    assert not wrong, "\n".join(wrong)


def test_jaxopt_is_imported_lazily_in_one_place() -> None:
    """It warns on import and is no longer developed, so one function holds the import."""
    importers = []
    for path in MODULES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        package = dotted(path)
        if any(name.split(".")[0] == "jaxopt" for name, _ in imports(ast.unparse(tree), package)):
            importers.append(path.name)
            top = [n for n in tree.body if isinstance(n, ast.Import | ast.ImportFrom)]
            names = [name for name, _ in imports("\n".join(map(ast.unparse, top)), package)]
            assert not any(n.startswith("jaxopt") for n in names), f"{path} imports it eagerly"
    assert len(importers) <= 1, importers


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
    ],
)
def test_the_test_finds_violations(module, source, said) -> None:
    found = violations(module, source, module[:-1])
    assert found and said in found[0]


def test_allowed_imports_pass() -> None:
    source = "import jax\nimport equinox\nfrom jaxface._types import Array\nfrom . import camera"
    assert not violations(("geometry", "mesh"), source, ("geometry",))
    assert not violations(("solvers", "gn"), "import optimistix, lineax", ("solvers",))
