"""Another texture for a mesh that is on disk already."""

import os
from pathlib import Path
from typing import Any

import pygltflib as gltf

from jaxface.io.atomic import atomic_path


def retexture_glb(path: str | os.PathLike[str], texture: bytes) -> None:
    """Replace the picture of a GLB's first texture; everything else stays as it is.

    Args:
        path: a GLB with its picture inside, as ``write_glb`` makes it.
        texture: a PNG or JPEG file's content.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a GLB or has no picture inside.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no file {path}")
    try:
        document: Any = gltf.GLTF2.load_binary(str(path))
        blob = document.binary_blob()
    except Exception as error:  # the reader raises whatever its parsing meets
        raise ValueError(f"{path} is not a readable GLB: {error}") from error
    if blob is None or not document.images or document.images[0].bufferView is None:
        raise ValueError(f"{path} has no picture inside that could be replaced")
    picture = document.images[0].bufferView
    kind = "image/png" if texture.startswith(b"\x89PNG") else "image/jpeg"
    document.images[0].mimeType = kind
    content = bytearray()
    for index, view in enumerate(document.bufferViews):
        start = view.byteOffset or 0
        part = texture if index == picture else blob[start : start + view.byteLength]
        content += b"\0" * (-len(content) % 4)
        view.byteOffset, view.byteLength = len(content), len(part)
        content += part
    content += b"\0" * (-len(content) % 4)
    document.buffers[0].byteLength = len(content)
    document.set_binary_blob(bytes(content))
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"".join(document.save_to_bytes()))


def retexture_obj(path: str | os.PathLike[str], texture: str) -> None:
    """Let the material file beside an OBJ name another picture.

    Raises:
        FileNotFoundError: there is no material file.
    """
    material = Path(path).with_suffix(".mtl")
    lines = material.read_text(encoding="utf-8").splitlines()
    changed = [f"map_Kd {texture}" if line.startswith("map_Kd ") else line for line in lines]
    with atomic_path(material) as temporary:
        temporary.write_text("\n".join(changed) + "\n", encoding="utf-8")
