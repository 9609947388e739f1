"""Cheap work on a photo, for tests of many processes; the workers import it too."""

import hashlib
import os
from pathlib import Path

from jaxface.io.atomic import atomic_path


class Stamps:
    """Writes a photo's digest, and keeps a list of the processes that did so."""

    def is_done(self, out: Path) -> bool:
        return (out / "report.json").is_file()

    def __call__(self, photo: Path, out: Path, on_step) -> None:
        content = photo.read_bytes()
        if content.startswith(b"broken"):
            raise RuntimeError(f"{photo.name} is broken")
        out.mkdir(parents=True, exist_ok=True)
        with open(out / "by.txt", "a", encoding="utf-8") as file:
            file.write(f"{os.getpid()}\n")
        with atomic_path(out / "report.json") as temporary:
            temporary.write_text(hashlib.sha256(content).hexdigest(), encoding="utf-8")


def photos(folder: Path, count: int = 7) -> list[Path]:
    """Files that pass for photos."""
    folder.mkdir(parents=True)
    made = [folder / f"photo {index}.png" for index in range(count)]
    for index, photo in enumerate(made):
        photo.write_bytes(f"pixels {index}".encode())
    return made


def written(out: Path) -> dict[str, str]:
    """The digests that lie under ``out``, by photo."""
    return {p.parent.name: p.read_text(encoding="utf-8") for p in out.glob("*/report.json")}


def processes(out: Path) -> list[str]:
    """The process that did each photo, once for each time that one was done."""
    return [line for p in out.glob("*/by.txt") for line in p.read_text().splitlines()]
