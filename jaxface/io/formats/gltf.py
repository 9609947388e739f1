"""Binary glTF 2.0: a textured head with named expression morphs and its pose.

glTF is right-handed with +y up and +z forward, as this package is, but in metres and with the UV
origin at the top-left corner; both are converted here and nowhere else.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib as gltf

from jaxface._types import Float, Int
from jaxface.geometry.camera import Pose
from jaxface.io.atomic import atomic_path
from jaxface.io.formats.mesh_checks import check_indices, check_table

_METRES = 1e-3
_FINEST_MORPH = 1e-6  # m: a morph moves a vertex at least a micrometre or not at all
_MAGIC = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}


@dataclass(frozen=True)
class GlbCamera:
    """The camera a photo was fitted with, for the viewer's own camera."""

    focal: float
    """pixels"""
    height: int
    """pixels"""
    width: int
    """pixels"""


def write_glb(
    path: str | Path,
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "f 3"],
    *,
    uv: Float[np.ndarray, "m 2"] | None = None,
    uv_faces: Int[np.ndarray, "f 3"] | None = None,
    normals: Float[np.ndarray, "n 3"] | None = None,
    texture: bytes | None = None,
    colours: Float[np.ndarray, "n 3"] | None = None,
    morphs: Mapping[str, Float[np.ndarray, "n 3"]] | None = None,
    weights: Mapping[str, float] | None = None,
    pose: Pose | None = None,
    camera: GlbCamera | None = None,
    roughness: float = 0.6,
    name: str = "face",
    licence: str = "",
    extras: Mapping[str, Any] | None = None,
) -> None:
    """Write one mesh as ``.glb``; whole or not at all.

    Vertices are duplicated along UV seams, for glTF has one UV a vertex. Morph targets are sparse
    where that is smaller. The positions of all targets together are what makes the file big: 52
    expressions of 18,000 vertices take about 4 MB.

    Args:
        path: the ``.glb``.
        vertices: mm, in the model's frame.
        faces: triangles, counter-clockwise from outside.
        uv: texture coordinates, origin bottom-left.
        uv_faces: the triangles' corners in ``uv``; those of ``faces`` by default.
        normals: one a vertex; area-weighted ones by default.
        texture: a whole PNG or JPEG file, sRGB, for the base colour.
        colours: albedo per vertex, linear RGB in [0, 1]; multiplies the texture, if both.
        morphs: name -> displacement (mm) at weight one, e.g. of each expression.
        weights: name -> weight at which the morph stands when the file is opened; else 0.
        pose: becomes the node's rotation and translation.
        camera: adds a camera at the origin, which sees the posed head as the photo did, up to
            a shifted principal point, which glTF cannot express.
        roughness: of the material, 0 to 1.
        name: of the mesh and node.
        licence: one line; becomes the asset's copyright.
        extras: JSON-able values to keep with the node.

    Raises:
        ValueError: shapes disagree, an index is out of range, a value is not finite, a weight
            names no morph, or the texture is neither PNG nor JPEG.
    """
    vertices = check_table("vertices", vertices, 3)
    count = len(vertices)
    faces = check_indices("faces", faces, count, (3,))
    if not len(faces):
        raise ValueError("faces is empty; needed at least one triangle")
    if uv is not None:
        uv = check_table("uv", uv, 2)
        uv_faces = check_indices(
            "uv_faces", faces if uv_faces is None else uv_faces, len(uv), (3,), like=faces
        )
    if normals is None:
        normals = vertex_normals(vertices, faces)
    normals = check_table("normals", normals, 3, count)
    displacements = {key: check_table(key, d, 3, count) for key, d in (morphs or {}).items()}
    weights = dict(weights or {})
    unknown = [key for key in weights if key not in displacements]
    if unknown:
        raise ValueError(
            f"weights name {unknown}, which are no morphs; those are {list(morphs or {})}"
        )
    source, corner_uv, triangles = _split_seams(count, faces, uv, uv_faces)

    pack = _Packer(licence)
    # UVs are written even without a texture, for editors to paint by.
    attributes = gltf.Attributes(
        POSITION=pack.floats(vertices[source] * _METRES, bounds=True),
        NORMAL=pack.floats(_unit(normals[source])),
    )
    if corner_uv is not None:
        attributes.TEXCOORD_0 = pack.floats(corner_uv * [1.0, -1.0] + [0.0, 1.0])
    if colours is not None:
        albedo = check_table("colours", colours, 3, count)
        attributes.COLOR_0 = pack.floats(np.clip(albedo[source], 0, 1))
    targets = [
        gltf.Attributes(POSITION=pack.displacements(delta[source] * _METRES))
        for delta in displacements.values()
    ]
    primitive = gltf.Primitive(
        attributes=attributes,
        indices=pack.indices(triangles),
        material=pack.material(texture if uv is not None else None, roughness),
    )
    mesh = gltf.Mesh(primitives=[primitive], name=name)
    if targets:
        primitive.targets = targets
        mesh.weights = [float(weights.get(key, 0.0)) for key in displacements]
        mesh.extras = {"targetNames": list(displacements)}
    node = gltf.Node(mesh=0, name=name, extras=dict(extras or {}))
    if pose is not None:
        node.rotation = _quaternion(np.asarray(pose.rotation, np.float64))
        node.translation = [float(t) * _METRES for t in np.asarray(pose.translation)]
    document = pack.document
    document.meshes, document.nodes = [mesh], [node]
    document.scenes, document.scene = [gltf.Scene(nodes=[0])], 0
    if camera is not None:
        _add_camera(document, camera)
    data = b"".join(pack.finish())
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def vertex_normals(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "n 3"]:
    """Unit normals, each the sum of the area-weighted normals of the triangles around it."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    flat = np.cross(b - a, c - a)
    total = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(flat[:, axis], 3), minlength=len(vertices))
            for axis in range(3)
        ],
        axis=1,
    )
    return _unit(total)


class _Packer:
    """Collects accessors and their bytes in one buffer."""

    def __init__(self, licence: str) -> None:
        self.document = gltf.GLTF2(
            asset=gltf.Asset(version="2.0", generator="jaxface", copyright=licence or None)
        )
        self.blob = bytearray()

    def view(self, data: bytes, target: int | None = None) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        self.document.bufferViews.append(
            gltf.BufferView(
                buffer=0, byteOffset=len(self.blob), byteLength=len(data), target=target
            )
        )
        self.blob += data
        return len(self.document.bufferViews) - 1

    def accessor(self, **fields: Any) -> int:
        self.document.accessors.append(gltf.Accessor(**fields))
        return len(self.document.accessors) - 1

    def floats(self, values: np.ndarray, bounds: bool = False) -> int:
        values = np.ascontiguousarray(values, "<f4")
        return self.accessor(
            bufferView=self.view(values.tobytes(), gltf.ARRAY_BUFFER),
            componentType=gltf.FLOAT,
            count=len(values),
            type=f"VEC{values.shape[1]}",
            **(_bounds(values) if bounds else {}),
        )

    def displacements(self, values: np.ndarray) -> int:
        """A morph target's positions: sparse unless most vertices move."""
        values = np.ascontiguousarray(values, "<f4")
        moved = np.flatnonzero(np.abs(values).max(axis=1) >= _FINEST_MORPH)
        wide = len(values) > 65535
        if len(moved) * (12 + (4 if wide else 2)) >= values.nbytes:
            return self.floats(values, bounds=True)
        # A sparse accessor needs at least one entry; a morph without effect keeps vertex 0 still.
        moved = moved if len(moved) else np.array([0])
        kept = np.zeros_like(values)
        kept[moved] = values[moved]
        indices = moved.astype("<u4" if wide else "<u2")
        sparse = gltf.Sparse(
            count=len(moved),
            indices=gltf.AccessorSparseIndices(
                bufferView=self.view(indices.tobytes()),
                componentType=gltf.UNSIGNED_INT if wide else gltf.UNSIGNED_SHORT,
            ),
            values=gltf.AccessorSparseValues(bufferView=self.view(kept[moved].tobytes())),
        )
        return self.accessor(
            componentType=gltf.FLOAT,
            count=len(values),
            type=gltf.VEC3,
            sparse=sparse,
            byteOffset=None,
            **_bounds(kept),
        )

    def indices(self, triangles: np.ndarray) -> int:
        wide = triangles.max(initial=0) >= 65535  # 65535 itself restarts a primitive
        values = triangles.astype("<u4" if wide else "<u2")
        return self.accessor(
            bufferView=self.view(values.tobytes(), gltf.ELEMENT_ARRAY_BUFFER),
            componentType=gltf.UNSIGNED_INT if wide else gltf.UNSIGNED_SHORT,
            count=values.size,
            type=gltf.SCALAR,
        )

    def material(self, texture: bytes | None, roughness: float) -> int:
        surface = gltf.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=float(roughness))
        if texture is not None:
            kind = next((mime for magic, mime in _MAGIC.items() if texture.startswith(magic)), None)
            if kind is None:
                raise ValueError(f"texture begins with {texture[:8]!r}; needed a PNG or JPEG file")
            self.document.images = [gltf.Image(bufferView=self.view(texture), mimeType=kind)]
            self.document.samplers = [
                gltf.Sampler(
                    magFilter=gltf.LINEAR,
                    minFilter=gltf.LINEAR_MIPMAP_LINEAR,
                    wrapS=gltf.CLAMP_TO_EDGE,
                    wrapT=gltf.CLAMP_TO_EDGE,
                )
            ]
            self.document.textures = [gltf.Texture(sampler=0, source=0)]
            surface.baseColorTexture = gltf.TextureInfo(index=0)
        self.document.materials = [gltf.Material(name="skin", pbrMetallicRoughness=surface)]
        return 0

    def finish(self) -> list[bytes]:
        self.blob += b"\0" * (-len(self.blob) % 4)
        self.document.buffers = [gltf.Buffer(byteLength=len(self.blob))]
        self.document.set_binary_blob(bytes(self.blob))
        return self.document.save_to_bytes()


def _bounds(values: np.ndarray) -> dict[str, list[float]]:
    return {
        "min": [float(v) for v in values.min(axis=0)],
        "max": [float(v) for v in values.max(axis=0)],
    }


def _split_seams(
    count: int, faces: np.ndarray, uv: np.ndarray | None, uv_faces: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """One output vertex for each pair (vertex, uv): its vertex, its uv, and the triangles."""
    if uv is None or uv_faces is None:
        return np.arange(count), None, faces
    keys = faces.ravel().astype(np.int64) * len(uv) + uv_faces.ravel()
    pairs, index = np.unique(keys, return_inverse=True)
    return pairs // len(uv), uv[pairs % len(uv)], index.reshape(faces.shape)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Rows scaled to length one; a zero row becomes +z, for glTF knows no missing normal."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])


def _quaternion(rotation: np.ndarray) -> list[float]:
    """(x, y, z, w) of an axis-angle vector (radians)."""
    angle = float(np.linalg.norm(rotation))
    # sin(a/2)/a tends to 1/2; np.sinc(x) is sin(pi x)/(pi x).
    xyz = rotation * (0.5 * np.sinc(angle / (2 * np.pi)))
    return [float(v) for v in (*xyz, np.cos(angle / 2))]


def _add_camera(document: gltf.GLTF2, camera: GlbCamera) -> None:
    lens = gltf.Perspective(
        yfov=float(2 * np.arctan(camera.height / (2 * camera.focal))),
        aspectRatio=camera.width / camera.height,
        znear=0.01,
        zfar=100.0,
    )
    document.cameras = [gltf.Camera(type="perspective", perspective=lens)]
    document.nodes.append(gltf.Node(camera=0, name="photo camera"))
    document.scenes = [gltf.Scene(nodes=[0, 1])]
