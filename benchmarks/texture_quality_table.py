"""The results of texture_quality.py: merged by name, as JSON and as Markdown."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

COLUMNS = (
    "Gram, random",
    "Gram, VGG-19",
    "power (octaves)",
    "log2 power 2-4",
    "log2 power 4-8",
    "log2 power 8-16",
    "patches",
    "colour (dE)",
    "seconds",
)


def write_results(
    path: Path, group: str, name: str, values: Mapping[str, float], facts: Mapping[str, Any]
) -> None:
    """Add or replace one row, and write the table beside the JSON."""
    stored: dict[str, Any] = {"schema": 1, "benchmark": "texture_quality", "rows": {}}
    if path.is_file():
        stored = json.loads(path.read_text("utf-8"))
    rounded = {key: float(f"{value:.4g}") for key, value in values.items()}
    stored["provenance"] = dict(facts)
    stored["rows"].setdefault(group, {})[name] = rounded
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(stored, indent=1) + "\n", "utf-8")
    path.with_suffix(".md").write_text(markdown(stored), "utf-8")


def markdown(stored: Mapping[str, Any]) -> str:
    """A table for each group of rows; smaller is better in every column."""
    parts = ["# texture_quality\n"]
    for group, rows in stored["rows"].items():
        used = [name for name in COLUMNS if any(name in row for row in rows.values())]
        lines = [[group, *used], ["---", *["---:"] * len(used)]]
        for name, row in rows.items():
            lines.append([name, *(f"{row[k]:.3g}" if k in row else "" for k in used)])
        parts.append("\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n")
    p = stored["provenance"]
    packages = ", ".join(f"{name} {number}" for name, number in p["versions"].items())
    parts.append(
        f"{p['date']}, commit {p['commit']}, {p['side']} texels a side, "
        f"{p['iterations']} iterations, {p['processor']}, {p['cores']} cores, load {p['load']}, "
        f"{packages}\n"
    )
    return "\n".join(parts)
