"""The documentation: its code runs, its links lead somewhere, its commands are the real ones."""

import ast
import functools
import importlib
import json
import pkgutil
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
FENCE = re.compile(r"^```([^\n`]*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
PYTHON = ("python", "{ .python .no-run }")
LINK = re.compile(r"(?<!`)\[[^\]]*\]\((?!https?://|mailto:|#)([^)#\s]+)[^)]*\)")

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))


def blocks(page: Path, language: str) -> list[str]:
    found = FENCE.findall(page.read_text(encoding="utf-8"))
    return [body for name, body in found if name == language]


def text_of(page: Path) -> str:
    """All that a reader sees but the outputs of a notebook."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".md":
        return text
    return "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])


def code_of(page: Path) -> list[str]:
    """Python of a page or notebook."""
    if page.suffix == ".md":
        return [body for language in PYTHON for body in blocks(page, language)]
    cells = json.loads(page.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


@functools.cache
def exists(path: str) -> bool:
    """Whether a dotted path leads to a module or an attribute of one."""
    parts = path.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for name in parts[length:]:
            fields = getattr(found, "__dataclass_fields__", {})
            if not hasattr(found, name):
                return name in fields
            found = getattr(found, name)
        return True
    return False


@functools.cache
def rooms() -> frozenset[str]:
    """Names of the packages that lie directly in jaxface."""
    import jaxface

    return frozenset(m.name for m in pkgutil.iter_modules(jaxface.__path__) if m.ispkg)


# `jaxface.energies.gram`, and in prose `energies.gram` or `pipeline/fitting/partial.py`.
DOTTED = re.compile(r"\bjaxface(?:\.[A-Za-z_]\w*)+")
QUOTED = re.compile(r"`+([^`\n]+)`+")
PATH = re.compile(r"(?:jaxface/)?(\w+(?:/\w+)+)(?:\.py|/)?")
OURS = re.compile(r"\.(?:md|ya?ml|git|toml|png|obj|html|org|com)$")


def named_paths(text: str, packages: frozenset[str]) -> set[str]:
    """Dotted paths of jaxface that a text names."""
    found = {name for name in DOTTED.findall(text) if not OURS.search(name)}
    for quoted in QUOTED.findall(FENCE.sub("", text)):
        file = PATH.fullmatch(quoted)
        dotted = file[1].replace("/", ".") if file else re.split(r"[(\[ ]", quoted)[0]
        if "NAME" in dotted:  # of something new
            continue
        if dotted.split(".")[0] in packages and re.fullmatch(r"\w+(\.[A-Za-z_]\w*)+", dotted):
            found.add(f"jaxface.{dotted}")
    return found


@every_page
def test_links_lead_to_files(page: Path) -> None:
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    missing = [link for link in LINK.findall(text) if not (page.parent / link).exists()]
    assert not missing, missing


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=lambda p: str(p.relative_to(ROOT)))
def test_paths_that_are_named_exist(page: Path) -> None:
    missing = [p for p in sorted(named_paths(text_of(page), rooms())) if not exists(p)]
    assert not missing, missing


def test_paths_that_do_not_exist_are_found() -> None:
    text = (
        "`stages.mirror` and `jaxface.energies.gram`, `solvers/_minimise.py`, `pipeline.fit(photo)`"
        " but jaxface.nowhere.fit, `models.conv3x3`, `pipeline/completing.py`; no `args.user`"
    )
    named = named_paths(text, rooms())
    assert {p for p in named if exists(p)} == {
        "jaxface.energies.gram", "jaxface.solvers._minimise", "jaxface.pipeline.fit",
    }  # fmt: skip
    assert {p for p in named if not exists(p)} == {
        "jaxface.stages.mirror", "jaxface.nowhere.fit", "jaxface.models.conv3x3",
        "jaxface.pipeline.completing",
    }  # fmt: skip
    assert exists("jaxface.stages.FitOptions.size") and not exists("jaxface.stages.FitOptions.nil")


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=lambda p: str(p.relative_to(ROOT)))
def test_imported_names_exist(page: Path) -> None:
    for body in code_of(page):
        for node in ast.walk(ast.parse(body)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jaxface"):
                module = importlib.import_module(node.module or "")
                missing = [a.name for a in node.names if not hasattr(module, a.name)]
                assert not missing, f"{node.module} has no {missing}"
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                if node.value.id == "jaxface":
                    assert hasattr(importlib.import_module("jaxface"), node.attr), node.attr


def test_the_readme_gives_the_commands_that_are_run() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for command in ("python -m pytest", "-c constraints.txt -e ."):
        assert command in readme and command in script


@pytest.mark.slow
def test_the_tutorial_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """Every block in order, in one namespace, as a reader would type them."""
    names: dict = {}
    for number, body in enumerate(blocks(ROOT / "docs" / "tutorial.md", "python")):
        exec(compile(body, f"tutorial.md, block {number + 1}", "exec"), names)
    before, after = re.findall(r"asymmetry ([\d.]+)", capsys.readouterr().out)
    assert float(after) < 0.5 * float(before)
