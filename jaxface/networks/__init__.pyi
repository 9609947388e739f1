from .convolution.conv3x3 import conv3x3, conv3x3_relu
from .landmarks.face_detector import FaceDetector, read_face_detector
from .landmarks.face_mesh import LandmarkNet, read_landmark_net
from .texture_features.network import (
    STYLE_LAYERS,
    FeatureNetwork,
    features,
    prepare_kernels,
)
from .texture_features.random_weights import random_network

__all__ = [
    "FaceDetector",
    "FeatureNetwork",
    "LandmarkNet",
    "STYLE_LAYERS",
    "conv3x3",
    "conv3x3_relu",
    "features",
    "prepare_kernels",
    "random_network",
    "read_face_detector",
    "read_landmark_net",
]
