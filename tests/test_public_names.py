"""Public names: a stub lists them, the package has them, and each is what the stub says it is."""

import ast
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import jaxface

PACKAGE = Path(jaxface.__file__).parent
STUBS = sorted(PACKAGE.rglob("*.pyi"))
FOUND = {found.name for found in pkgutil.walk_packages([str(PACKAGE)], "jaxface.")}
MODULES = sorted(FOUND - {"jaxface.__main__"})  # which runs as it is imported

every_stub = pytest.mark.parametrize("stub", STUBS, ids=lambda p: str(p.relative_to(PACKAGE)))


@pytest.fixture(scope="module", autouse=True)
def everything_is_imported() -> None:
    """Importing a module binds its name in its package, over a function of that name."""
    for name in MODULES:
        importlib.import_module(name)


def package(stub: Path):
    return importlib.import_module(".".join(("jaxface", *stub.parent.relative_to(PACKAGE).parts)))


def listed(stub: Path) -> dict[str, tuple[str, str]]:
    """What a stub imports: public name -> (module below the package, name there)."""
    return {
        alias.asname or alias.name: (node.module or "", alias.name)
        for node in ast.parse(stub.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom) and node.level == 1
        for alias in node.names
    }


def test_there_are_stubs() -> None:
    assert {"jaxface", "jaxface.energies", "jaxface.solvers"} <= {
        package(s).__name__ for s in STUBS
    }


@every_stub
def test_every_name_is_what_the_stub_says(stub: Path) -> None:
    here = package(stub)
    names = listed(stub)
    assert names
    for name, (below, original) in names.items():
        found = getattr(here, name)
        if not below:
            assert found is importlib.import_module(f"{here.__name__}.{original}"), name
        else:
            module = importlib.import_module(f"{here.__name__}.{below}")
            assert found is getattr(module, original), f"{name} is {found}"


@every_stub
def test_all_lists_every_name_once_and_nothing_else(stub: Path) -> None:
    here = package(stub)
    tree = ast.parse(stub.read_text(encoding="utf-8"))
    (written,) = (
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    )
    declared = {ast.unparse(node.target) for node in tree.body if isinstance(node, ast.AnnAssign)}
    assert len(written) == len(set(written))
    assert set(written) == set(listed(stub)) | declared
    assert sorted(here.__all__) == sorted(written)
    assert set(listed(stub)) <= set(dir(here))
    for name in declared:
        assert hasattr(here, name), name


@every_stub
def test_a_misspelt_name_is_an_attribute_error(stub: Path) -> None:
    with pytest.raises(AttributeError, match="gaus_newton"):
        _ = package(stub).gaus_newton


@every_stub
def test_a_stub_belongs_to_a_package_that_reads_it(stub: Path) -> None:
    source = stub.with_suffix(".py").read_text(encoding="utf-8")
    assert "attach_stub(__name__, __file__)" in source


@pytest.mark.parametrize("name", MODULES)
def test_all_of_a_module_exists(name: str) -> None:
    module = importlib.import_module(name)
    for public in getattr(module, "__all__", ()):
        assert hasattr(module, public), public


def test_importing_the_package_imports_next_to_nothing() -> None:
    """And starts no back end of JAX, which could no longer be configured then."""
    script = "import sys, jaxface; print(sorted({'jax', 'numpy', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
