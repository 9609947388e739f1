"""Unwrapping a photo to a texture of 512 to 4096 px, beside eos's `extract_texture`.

Both take the bundled model's mean face, subdivided once, seen from the front in a 1024 px photo.
eos (P. Huber et al., VISAPP 2016) copies the nearest 8-bit colour under an orthographic camera,
with a per-triangle visibility test; ours interpolates, divides out the shading and weighs, under a
perspective camera. So ours does more work per texel; the share of texels covered is listed.
eos-py is an optional peer: without it in the environment only our times are taken.

    python benchmarks/unwrap.py
"""

import jax.numpy as jnp
import numpy as np
from harness import Benchmark, Measurement, timed

from jaxface.geometry.camera import Camera
from jaxface.geometry.uv import uv_layout
from jaxface.io.face_models import load_model
from jaxface.models.subdivide import subdivide
from jaxface.render._rasterize import rasterize
from jaxface.render.shading import ambient_light
from jaxface.stages._unwrap import unwrap
from jaxface.stages.texture.low_frequency import low_frequency_albedo

SIZE = 1024
DISTANCE = 700.0
RESOLUTIONS = (512, 1024, 2048, 4096)


def scene():
    """Model, posed vertices (mm), camera, and a photo of noise (its content costs nothing)."""
    model = subdivide(load_model("makehuman"), 1)
    centre = (model.mean.min(axis=0) + model.mean.max(axis=0)) / 2
    vertices = model.mean - centre + jnp.array([0.0, 0.0, -DISTANCE])
    extent = float(jnp.max(jnp.ptp(model.mean[:, :2], axis=0)))
    focal = 0.9 * SIZE * DISTANCE / extent
    camera = Camera(jnp.float32(focal), jnp.full(2, SIZE / 2, jnp.float32))
    photo = np.random.default_rng(0).random((SIZE, SIZE, 3)).astype(np.float32)
    return model, vertices, camera, jnp.asarray(photo)


def time_eos(bench: Benchmark, model, vertices, camera: Camera, photo, resolution: int) -> None:
    """eos on the same mesh, the same scale in the photo; does nothing where it is absent."""
    try:
        import eos
    except ImportError:
        return
    middle = np.asarray(vertices) + [0, 0, DISTANCE]
    faces = np.asarray(model.faces).tolist()
    mesh = eos.core.Mesh(
        [p.astype(np.float32) for p in middle],
        faces,
        texcoords=[np.array([u, 1 - v], np.float32) for u, v in np.asarray(model.uv)],
        tti=np.asarray(model.uv_faces).tolist(),
    )
    scale = float(camera.focal) / DISTANCE
    some = middle[:: len(middle) // 100].astype(np.float32)
    pose = eos.fitting.estimate_orthographic_projection_linear(
        [(p[:2] * [1, -1] * scale + SIZE / 2).astype(np.float32) for p in some],
        [np.append(p, 1.0).astype(np.float32) for p in some],
        True,
        SIZE,
    )
    parameters = eos.fitting.RenderingParameters(pose, SIZE, SIZE)
    image = np.concatenate([np.asarray(photo) * 255, np.full((SIZE, SIZE, 1), 255)], axis=-1)
    image = np.ascontiguousarray(image, np.uint8)
    times = []
    for _ in range(3):
        seconds, texture = timed(eos.render.extract_texture, mesh, parameters, image, resolution)
        times.append(seconds)
    bench.record(
        Measurement(
            f"unwrap {resolution} px",
            best=min(times),
            median=sorted(times)[1],
            repeats=3,
            program="eos",
            values={"covered": float(np.mean(np.asarray(texture)[..., 3] > 0))},
        )
    )


def main() -> None:
    """Time the layout, the unwrap and the preview at each resolution."""
    bench = Benchmark("unwrap")
    model, vertices, camera, photo = scene()
    light = ambient_light(1.0)
    mask = rasterize(camera.project(vertices), model.faces, SIZE, SIZE).mask
    for resolution in RESOLUTIONS:
        seconds, layout = timed(uv_layout, model.uv, model.uv_faces, resolution)
        once = Measurement(f"layout {resolution} px (once a model)", best=seconds, repeats=1)
        bench.record(once)
        result = bench.time(
            f"unwrap {resolution} px",
            unwrap,
            *(photo, mask, vertices, model.faces, camera, light, layout),
            values=lambda r: {"covered": float(jnp.mean(r.visible))},
        )
        bench.time(
            f"low frequencies {resolution} px",
            low_frequency_albedo,
            *(result.albedo, result.weight, model.albedo_mean, model.faces, layout),
        )
        time_eos(bench, model, vertices, camera, photo, resolution)
    bench.finish()


if __name__ == "__main__":
    main()
