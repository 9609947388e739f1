"""Turn the formulas of a page into MathML, so that the pages need no scripts and no network."""

import html
import re

from latex2mathml.converter import convert

FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>',
    re.DOTALL,
)


def on_page_content(content: str, **_) -> str:
    """Replace what the arithmatex extension has marked."""

    def mathml(match: re.Match[str]) -> str:
        tag, opening, tex = match.groups()
        display = "block" if opening == "[" else "inline"
        return f'<{tag} class="formula">{convert(html.unescape(tex), display=display)}</{tag}>'

    return FORMULA.sub(mathml, content)
