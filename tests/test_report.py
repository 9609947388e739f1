"""The report: strict JSON, a page that stands alone, a plot that keeps to its frame."""

import json
import re
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxface.io.atomic import atomic_path
from jaxface.io.pictures.chart import HEIGHT, WIDTH, convergence_svg
from jaxface.io.pictures.report import format_number, plain, write_report
from jaxface.run.environment import environment

LEVELS = [
    {"name": "coarse", "terms": {"photo <&>": [1.0, 0.3, 0.1], "prior": [0.0, 1e-4, 2e-4]}},
    {"name": "fine", "terms": {"photo <&>": [0.2, float("nan"), 0.05], "prior": [1e-4] * 3}},
]


class Page(HTMLParser):
    """Collects the addresses a page refers to, and checks that its elements nest."""

    VOID = {"meta", "img", "br", "line", "polyline"}

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    Image.fromarray(np.full((8, 12, 3), 90, np.uint8)).save(tmp_path / "overlay.png")
    Image.fromarray(np.zeros((4, 2000, 4), np.uint8)).save(tmp_path / "wide.png")
    data = {
        "title": "A <face>",
        "figures": [{"label": "error", "value": jnp.float32(0.5), "unit": "px"}],
        "images": [
            {"title": "Overlay", "file": "overlay.png"},
            {"title": "Wide", "file": "wide.png"},
            {"title": "Absent", "file": "absent.png"},
        ],
        "energies": LEVELS,
        "timings": [{"name": "fit", "seconds": 1.5, "compile_seconds": None}],
        "tables": [{"title": "Pose", "rows": [["yaw", np.float64(-12.5)], ["pitch", None]]}],
        "licences": [{"name": "model", "licence": "CC0"}],
        "files": [{"file": "overlay.png", "what": "contact sheet"}],
        "warnings": ["two faces"],
        "covariance": np.array([[1.0, np.inf]]),
        "environment": environment(),
    }
    write_report(tmp_path, data)
    return tmp_path


def test_json_is_strict_and_complete(folder: Path) -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    text = (folder / "report.json").read_text("utf-8")
    content = json.loads(text, parse_constant=refuse)
    assert content["schema"] == 1 and content["covariance"] == [[1.0, None]]
    assert content["energies"][1]["terms"]["photo <&>"] == [0.2, None, 0.05]
    assert content["environment"]["versions"]["jax"]


def test_page_stands_alone(folder: Path) -> None:
    text = (folder / "report.html").read_text("utf-8")
    page = Page(text)
    assert page.open == []
    local = [link for link in page.links if not link.startswith("data:image/")]
    assert all((folder / link).is_file() for link in local), local
    assert sum(link.startswith("data:image/") for link in page.links) == 2
    assert "<script" not in text and "http" not in text
    assert "A &lt;face&gt;" in text and "A <face>" not in text
    assert "nan" not in re.sub(r"base64,[^\"]*", "", text).lower()
    assert "−12.5" in text and "two faces" in text


def test_an_empty_report_is_a_report(tmp_path: Path) -> None:
    html, _ = write_report(tmp_path / "new", {})
    assert Page(html.read_text("utf-8")).open == []
    assert sorted(p.name for p in html.parent.iterdir()) == ["report.html", "report.json"]


def test_an_entry_without_its_keys_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'timings' needs \['seconds'\]"):
        write_report(tmp_path, {"timings": [{"name": "fit"}]})
    assert not list(tmp_path.iterdir())


def test_plain_refuses_what_has_no_form() -> None:
    assert plain((Path("a/b.png"), {1: np.bool_(True)}, np.int32(3))) == ["b.png", {"1": True}, 3]
    with pytest.raises(TypeError, match="object"):
        plain(object())
    assert format_number([1.0, None, 123456.0]) == "1  –  1.235e+05"


def test_chart_stays_in_its_frame_and_skips_what_is_not_finite() -> None:
    svg = ElementTree.fromstring(convergence_svg(LEVELS))
    dots = svg.findall("circle")
    assert len(dots) == 5 + 5  # one value is NaN, one zero
    assert all(0 < float(d.attrib["cx"]) < WIDTH for d in dots)
    assert all(0 < float(d.attrib["cy"]) < HEIGHT for d in dots)
    heights = [float(d.attrib["cy"]) for d in dots if "photo" in (d[0].text or "")]
    assert heights[:3] == sorted(heights[:3])
    names = [t.text for t in svg.findall("text") if "name" in t.attrib["class"]]
    assert names == ["photo <&>", "prior"]
    assert convergence_svg([]) == "" == convergence_svg([{"terms": {"a": [0.0, np.nan]}}])
    assert convergence_svg([{"terms": {"a": [1.0]}}])


def test_atomic_path_replaces_or_leaves(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "file.txt"
    with atomic_path(target) as path:
        assert path.suffix == ".txt" and path != target
        path.write_text("first")
    with pytest.raises(RuntimeError, match="half-way"), atomic_path(target) as path:
        path.write_text("second")
        raise RuntimeError("half-way")
    assert target.read_text() == "first"
    assert list(target.parent.iterdir()) == [target]


def test_environment_names_no_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("platform.node", "socket.gethostname", "socket.getfqdn", "getpass.getuser"):
        monkeypatch.setattr(name, lambda *_: "secret")
    monkeypatch.setenv("USER", "secret")
    found = environment(["jax"])
    assert "secret" not in json.dumps(found)
    assert set(found["versions"]) == {"python", "jax"} and found["cores"] >= 1
    assert "node" not in found and "hostname" not in found
