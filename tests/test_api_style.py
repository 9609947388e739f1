"""The style of the public surface: docstrings, annotations, sizes, names, no leftovers."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MODULES = sorted((ROOT / "jaxface").rglob("*.py"))
MAX_LINES = 350
VAGUE = {"utils", "util", "helpers", "helper", "common", "misc", "tools", "stuff"}
LEFTOVERS = re.compile(r"\b(TODO|FIXME|XXX|HACK|NotImplementedError)\b")
MACHINE_PATHS = re.compile(r"""(?<![\w.~/])(/(home|root|work|Users|opt|tmp|mnt)/|[A-Z]:\\\\)""")

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef

every_module = pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))


def exported(tree: ast.Module) -> set[str] | None:
    """The names in ``__all__``, or None where the module has none."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(
            isinstance(target, ast.Name) and target.id == "__all__" for target in node.targets
        ):
            return set(ast.literal_eval(node.value))
    return None


def public(tree: ast.Module) -> Iterator[tuple[str, Definition]]:
    """Public functions, classes and methods defined in a module, with their qualified names."""
    names = exported(tree)
    for node in tree.body:
        if not isinstance(node, Definition):
            continue
        if node.name not in names if names is not None else node.name.startswith("_"):
            continue
        yield node.name, node
        if isinstance(node, ast.ClassDef):
            for member in node.body:
                if isinstance(member, Definition) and not member.name.startswith("_"):
                    yield f"{node.name}.{member.name}", member


def is_overload(node: Definition) -> bool:
    return any("overload" in ast.unparse(decorator) for decorator in node.decorator_list)


def unannotated(node: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    arguments = node.args
    named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    named += [a for a in (arguments.vararg, arguments.kwarg) if a is not None]
    missing = [a.arg for a in named if a.annotation is None and a.arg not in ("self", "cls")]
    return missing + (["return"] if node.returns is None else [])


@every_module
def test_docstrings(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    missing = [
        name
        for name, node in public(tree)
        if not ast.get_docstring(node)
        and not is_overload(node)
        and not any("setter" in ast.unparse(d) for d in node.decorator_list)
    ]
    if tree.body and not ast.get_docstring(tree):
        missing.append("the module itself")
    assert not missing, f"no docstring: {missing}"


@every_module
def test_annotations(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    missing = {
        name: unannotated(node)
        for name, node in public(tree)
        if not isinstance(node, ast.ClassDef) and unannotated(node)
    }
    assert not missing, f"not annotated: {missing}"


@every_module
def test_size_and_name(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").count("\n")
    assert lines <= MAX_LINES, f"{lines} lines: is it doing two things?"
    parts = {part.strip("_") for part in path.relative_to(ROOT).with_suffix("").parts}
    assert not parts & VAGUE, "the name says nothing; take the noun of its one idea"


@every_module
def test_no_leftovers(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    for pattern in (LEFTOVERS, MACHINE_PATHS):
        found = [line for line in text.splitlines() if pattern.search(line)]
        assert not found, found
    asserts = [node.lineno for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Assert)]
    assert not asserts, f"assert vanishes under python -O; raise an error (lines {asserts})"


@every_module
def test_errors_are_not_swallowed(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    bare = [n.lineno for n in ast.walk(tree) if isinstance(n, ast.ExceptHandler) and not n.type]
    assert not bare, f"bare except on lines {bare}"


def test_all_names_exist() -> None:
    for path in MODULES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        bound = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        bound |= {node.name for node in tree.body if isinstance(node, Definition)}
        bound |= {
            alias.asname or alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.Import | ast.ImportFrom)
            for alias in node.names
        }
        missing = (exported(tree) or set()) - bound
        assert not missing, f"{path}: __all__ names {missing}, which it does not define"


def test_the_test_finds_faults() -> None:
    source = "def f(x):\n    return x\n\n\nclass _Hidden:\n    def g(self, y): ...\n"
    names = dict(public(ast.parse(source)))
    assert list(names) == ["f"]
    node = names["f"]
    assert isinstance(node, ast.FunctionDef) and unannotated(node) == ["x", "return"]
    assert LEFTOVERS.search("x = 1  # TODO: more") and MACHINE_PATHS.search('open("/home/me/x")')
    assert not MACHINE_PATHS.search("a/home/b") and not MACHINE_PATHS.search("https://x.org/work")
