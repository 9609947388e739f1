"""Rasterising heads: against a plain scatter-min of fragments, Embree, and the hardware's floor.

    python benchmarks/rasterize.py

Each line draws the same mesh to the same pixels. ``scatter-min`` is the textbook way in an array
language: every triangle gets a window of pixels as large as the mesh's largest bounding box
(left out beyond 64), all fragments are made at once, scattered by depth, then by index.
``embree`` (with the ``embreex`` and ``trimesh`` packages installed) casts one ray a pixel through
a tree that is built anew for each pose, as a fit needs it.

``floor`` is the time to touch the data once at the measured speed of a copy and of a scatter:
corners of every triangle read, every covered fragment scattered twice, the image written.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from harness import Benchmark, Measurement, timed

from jaxface.geometry.camera import Camera, Pose
from jaxface.geometry.mesh import vertex_normals
from jaxface.io.face_models.model_file import load_bundled
from jaxface.models.subdivide import subdivide
from jaxface.render._rasterize import Fragments, barycentrics, rasterize
from jaxface.render.coverage import inverse_depth_at, pixel_block
from jaxface.render.image import render
from jaxface.render.shading import ambient_light


def ellipsoid(rows=230, columns=231):
    """A closed bumpy surface of the size of a head (mm) with 105,798 triangles by default."""
    polar = np.linspace(0, np.pi, rows + 1)[1:-1]
    around = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    t, p = np.meshgrid(polar, around, indexing="ij")
    radius = 80 * (1 + 0.03 * np.sin(9 * p) * np.sin(7 * t))
    radius += 12 * np.exp(-((t - 1.7) ** 2 + (p - np.pi / 2) ** 2) / 0.02)
    ring = np.stack([np.sin(t) * np.cos(p), 1.08 * np.cos(t), np.sin(t) * np.sin(p)], axis=-1)
    poles = np.array([[0, 86.4, 0], [0, -86.4, 0]])
    vertices = np.concatenate([(radius[..., None] * ring).reshape(-1, 3), poles])
    index = np.arange(t.size).reshape(t.shape)
    following = np.roll(index, -1, axis=1)
    a, b, c, d = index[:-1], following[:-1], index[1:], following[1:]
    top, bottom = np.full(columns, t.size), np.full(columns, t.size + 1)
    faces = [
        np.stack([a, b, c], -1).reshape(-1, 3),
        np.stack([b, d, c], -1).reshape(-1, 3),
        np.stack([top, following[0], index[0]], -1),
        np.stack([bottom, index[-1], following[-1]], -1),
    ]
    return vertices.astype(np.float32), np.concatenate(faces).astype(np.int32)


def framed(vertices, size, fill=0.55):
    """Pose and camera that show a mesh large: its extent over the image's area is ``fill``."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centre, extent = (low + high) / 2, high - low
    distance = 600.0
    pose = Pose(jnp.array([0.05, 0.3, 0.0]), jnp.asarray([0.0, 0.0, -distance]))
    focal = size * distance * np.sqrt(fill / (extent[0] * extent[1]) * 1.6)
    return vertices - centre, pose, Camera(jnp.asarray(focal), jnp.array([size / 2, size / 2]))


@partial(jax.jit, static_argnames=("size", "window"))
def scatter_min(screen, faces, size, window):
    """The baseline: a window of (rows, columns) fragments for every triangle."""
    x, y, z = (tuple(screen[faces[:, i], k] for i in range(3)) for k in range(3))
    left, top, columns, rows = pixel_block(x, y, jnp.minimum(*z[:2]) > 0, size, size)
    place = jnp.arange(window[0] * window[1], dtype=jnp.int32)[:, None]
    c, r = place % window[1], place // window[1]
    cx, cy = (left + c) + 0.5, (top + r) + 0.5
    sides = []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        sides.append((x[i] - cx) * (y[j] - cy) - (y[i] - cy) * (x[j] - cx))
    inside = ((sides[0] >= 0) & (sides[1] >= 0) & (sides[2] >= 0)) | (
        (sides[0] <= 0) & (sides[1] <= 0) & (sides[2] <= 0)
    )
    inside = inside & (c < columns) & (r < rows)
    at = jnp.where(inside, (top + r) * size + left + c, size * size)
    d = 1.0 / inverse_depth_at(x, y, tuple(1.0 / v for v in z), cx, cy)
    depth = jnp.full(size * size, jnp.inf).at[at].min(d, mode="drop")
    won = inside & (d == depth.at[at].get(mode="fill", fill_value=-1.0))
    owner = jnp.broadcast_to(jnp.arange(len(faces), dtype=jnp.int32), at.shape)
    index = jnp.full(size * size, len(faces), jnp.int32)
    index = index.at[jnp.where(won, at, size * size)].min(owner, mode="drop").reshape(size, size)
    triangle = jnp.where(index == len(faces), -1, index)
    return Fragments(triangle, barycentrics(screen, faces, triangle), depth.reshape(size, size))


def embree(vertices, faces, pose, camera, size):
    """One ray a pixel by Embree, the tree built anew; ids alone. None if it is not installed."""
    try:
        import embreex  # noqa: F401
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError:
        return None
    placed = np.asarray(pose(jnp.asarray(vertices)))
    x, y = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    x0, y0 = np.asarray(camera.principal)
    focal = float(camera.focal)
    rays = np.stack([(x - x0) / focal, (y0 - y) / focal, -np.ones_like(x)], -1).reshape(-1, 3)
    origins = np.zeros_like(rays)

    def cast():
        mesh = trimesh.Trimesh(placed, faces, process=False)
        return RayMeshIntersector(mesh).intersects_first(origins, rays).reshape(size, size)

    return cast


def floor(screen, faces, fragments):
    """Seconds to touch the data once; the speeds are measured on a copy and on a scatter."""
    pixels = fragments.triangle.size
    big = jnp.zeros(1 << 23, jnp.float32)
    where = jnp.asarray(np.random.default_rng(0).integers(0, pixels, 1 << 19), jnp.int32)
    copy = jax.jit(lambda v: v + 1.0)
    scatter = jax.jit(lambda v, i: jnp.zeros(pixels).at[i].min(v[: i.size]))
    bytes_per_second = 2 * big.nbytes / min(timed(copy, big)[0] for _ in range(8))
    per_fragment = min(timed(scatter, big, where)[0] for _ in range(8)) / where.size
    corner = np.asarray(screen)[np.asarray(faces), :2]
    u, v = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = float(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum()) / 2
    touched = len(faces) * (3 * 4 + 9 * 4) + pixels * (1 + 3 + 1) * 4
    return touched / bytes_per_second + 2 * area * per_fragment, area


def agreement(got, reference):
    """Share of pixels with the same triangle."""
    return float(np.mean(np.asarray(got) == np.asarray(reference)))


def compare(bench, name, vertices, faces, size):
    """All ways to draw one mesh."""
    vertices, pose, camera = framed(vertices, size)
    faces_j = jnp.asarray(faces)
    screen = camera.project(pose(jnp.asarray(vertices)))
    draw = jax.jit(lambda s: rasterize(s, faces_j, size, size))
    fragments = bench.time(f"{name}: rasterize", draw, screen)
    bound, area = floor(screen, faces, fragments)
    covered = float(fragments.mask.mean())
    bench.record(
        Measurement(f"{name}: rasterize", bound, bound, program="floor",
                    values={"covered": covered, "fragments": area})
    )  # fmt: skip
    culled = jax.jit(lambda s: rasterize(s, faces_j, size, size, cull=True))
    bench.time(f"{name}: rasterize, culled", culled, screen)
    x, y = (tuple(screen[faces_j[:, i], k] for i in range(3)) for k in range(2))
    *_, columns, rows = pixel_block(x, y, jnp.ones(len(faces), bool), size, size)
    window = int(rows.max()), int(columns.max())
    if window[0] * window[1] <= 64:
        bench.time(
            f"{name}: rasterize", scatter_min, screen, faces_j, size, window,
            program="scatter-min",
            values=lambda f: {
                "same triangle": agreement(f.triangle, fragments.triangle),
                "window": window[0] * window[1],
            },
        )  # fmt: skip
    cast = embree(vertices, faces, pose, camera, size)
    if cast is not None:
        bench.time(
            f"{name}: rasterize", cast, program="embree",
            values=lambda ids: {"same triangle": agreement(ids, fragments.triangle)},
        )  # fmt: skip
    return vertices, pose, camera


def main():
    bench = Benchmark("rasterize", packages=("jax", "jaxlib", "numpy", "trimesh", "embreex"))
    compare(bench, "ellipsoid 106k, 512 px", *ellipsoid(), 512)
    model = load_bundled()
    for levels in (0, 1, 2):
        finer = subdivide(model, levels)
        vertices, faces = np.asarray(finer.mean), np.asarray(finer.faces)
        name = f"head {round(len(faces) / 1000)}k"
        placed = compare(bench, f"{name}, 512 px", vertices, faces, 512)
    compare(bench, f"{name}, 1024 px", vertices, faces, 1024)

    vertices, pose, camera = placed
    vertices, faces = jnp.asarray(vertices), jnp.asarray(faces)
    albedo, light = jnp.full_like(vertices, 0.6), ambient_light(0.8)

    @jax.jit
    def picture(vertices):
        return render(vertices, albedo, faces, pose, camera, light, 512, 512).color

    bench.time(f"{name}, 512 px: render", picture, vertices)
    bench.time(
        f"{name}, 512 px: render, gradient to vertices",
        jax.jit(jax.grad(lambda v: jnp.sum(picture(v) ** 2))),
        vertices,
    )
    bench.time(f"{name}: vertex normals", jax.jit(lambda v: vertex_normals(v, faces)), vertices)
    screens = jnp.stack([camera.project(pose(vertices + k)) for k in range(4)])
    many = jax.jit(jax.vmap(lambda s: rasterize(s, faces, 512, 512)))
    bench.time(f"{name}, 512 px: rasterize, batch of 4", many, screens)
    bench.finish()


if __name__ == "__main__":
    main()
