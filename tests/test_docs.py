"""The documentation: its code runs, its links lead somewhere, its commands are the real ones."""

import ast
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(?<!`)\[[^\]]*\]\((?!https?://|mailto:|#)([^)#\s]+)[^)]*\)")

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))


def blocks(page: Path, language: str) -> list[str]:
    found = FENCE.findall(page.read_text(encoding="utf-8"))
    return [body for name, body in found if name == language]


@every_page
def test_links_lead_to_files(page: Path) -> None:
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    missing = [link for link in LINK.findall(text) if not (page.parent / link).exists()]
    assert not missing, missing


@every_page
def test_imported_names_exist(page: Path) -> None:
    for body in blocks(page, "python"):
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
