"""Formulas as MathML and the notebooks as pages: no scripts, no network, no copies to keep."""

import html
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent

FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>',
    re.DOTALL,
)
# A notebook's own, which would need a script.
DOLLARS = re.compile(r"(?<![\\\w$])\$([^$\n<>]+)\$(?![\w$])")
PAGE_LINK = re.compile(r'href="\.\./docs/([\w/]+)\.md')


@event_priority(100)  # before the plugin that turns notebooks into pages
def on_files(files, config):
    """Notebooks lie beside the folder of pages."""
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        name = f"notebooks/{path.name}"
        files.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def on_page_content(content: str, page, **_) -> str:
    """Replace what the arithmatex extension has marked."""

    def mathml(match: re.Match[str]) -> str:
        tag, opening, tex = match.groups()
        display = "block" if opening == "[" else "inline"
        return f'<{tag} class="formula">{convert(html.unescape(tex), display=display)}</{tag}>'

    if page.file.src_uri.endswith(".ipynb"):
        content = PAGE_LINK.sub(r'href="../\1.html', content)
        return re.sub(
            r'(<div class="jp-RenderedHTMLCommon jp-RenderedMarkdown.*?</div>)',
            lambda cell: DOLLARS.sub(
                lambda m: convert(html.unescape(m[1]), display="inline"), cell[1]
            ),
            content,
            flags=re.DOTALL,
        )
    return FORMULA.sub(mathml, content)
