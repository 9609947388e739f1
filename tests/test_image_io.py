"""Photos, PNG, EXR and landmark files: what is read, what is written, what is refused."""

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import ExifTags, Image, ImageCms

from jaxface.io.formats.exr import read_exr, srgb_encoded, write_exr
from jaxface.io.formats.image import Photo, read_image, write_png
from jaxface.io.formats.landmark_file import Landmarks, read_landmarks, write_landmarks

RNG = np.random.default_rng(0)
BYTES = RNG.integers(0, 256, (20, 24, 3), np.uint8)
WORDS = RNG.integers(0, 65536, (20, 24, 4)).astype(np.uint16)


def saved(folder: Path, name: str, image: Image.Image, **options) -> Photo:
    image.save(folder / name, **options)
    return read_image(folder / name)


def test_rgb_is_read_as_it_is(tmp_path):
    photo = saved(tmp_path, "a.png", Image.fromarray(BYTES))
    assert photo.pixels.dtype == np.float32 and photo.size == (24, 20)
    np.testing.assert_allclose(photo.pixels, BYTES / 255, atol=1e-6)
    assert photo.opacity is None and photo.focal_35mm is None


@pytest.mark.parametrize("name", ["a.tif", "a.webp", "a.bmp"])
def test_other_lossless_formats(tmp_path, name):
    options = {"lossless": True} if name.endswith("webp") else {}
    photo = saved(tmp_path, name, Image.fromarray(BYTES), **options)
    np.testing.assert_allclose(photo.pixels, BYTES / 255, atol=1e-6)


def test_grey_becomes_rgb(tmp_path):
    photo = saved(tmp_path, "a.png", Image.fromarray(BYTES[..., 0]))
    np.testing.assert_allclose(photo.pixels, np.repeat(BYTES[..., :1] / 255, 3, 2), atol=1e-6)


def test_palette_one_bit_and_cmyk(tmp_path):
    palette = Image.fromarray(BYTES).quantize(16)
    photo = saved(tmp_path, "p.png", palette)
    np.testing.assert_allclose(photo.pixels, np.asarray(palette.convert("RGB")) / 255, atol=1e-6)
    bits = Image.fromarray(BYTES[..., 0]).convert("1")
    assert set(np.unique(saved(tmp_path, "b.png", bits).pixels)) <= {0.0, 1.0}
    red = Image.new("CMYK", (20, 20), (0, 255, 255, 0))
    photo = saved(tmp_path, "c.jpg", red, quality=95)
    np.testing.assert_allclose(photo.pixels[10, 10], [1, 0, 0], atol=0.02)


def test_transparency_is_kept_and_laid_over_grey(tmp_path):
    alpha = np.full((20, 24, 1), 255, np.uint8)
    alpha[:, :10] = 0
    photo = saved(tmp_path, "a.png", Image.fromarray(np.concatenate([BYTES, alpha], axis=2)))
    np.testing.assert_allclose(photo.pixels[:, :10], 0.5)
    np.testing.assert_allclose(photo.pixels[:, 10:], BYTES[:, 10:] / 255, atol=1e-6)
    assert photo.opacity is not None
    np.testing.assert_allclose(photo.opacity, alpha[..., 0] / 255)
    solid = np.full_like(alpha, 255)
    photo = saved(tmp_path, "b.png", Image.fromarray(np.concatenate([BYTES, solid], axis=2)))
    assert photo.opacity is None


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["a.jpg", "a.tif", "a16.png", "a16.tif"])
def test_exif_orientation_is_applied(tmp_path, orientation, name):
    upright = np.zeros((32, 48, 3), np.uint8)
    upright[:16, :16] = 255  # white at the top left
    upright[:16, 32:, 0] = 255  # red at the top right
    # How each orientation stores the picture that is to be shown upright.
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: np.rot90(upright),
        7: upright[::-1, ::-1].transpose(1, 0, 2),
        8: np.rot90(upright, -1),
    }[orientation]
    stored = np.ascontiguousarray(stored)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    if name == "a16.tif":
        tags = [(274, "H", 1, orientation, True)]
        tifffile.imwrite(
            tmp_path / name, stored.astype(np.uint16) * 257, photometric="rgb", extratags=tags
        )
    elif name == "a16.png":
        write_png(tmp_path / name, stored.astype(np.uint16) * 257)
        add_png_chunk(tmp_path / name, b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0"))
    else:
        Image.fromarray(stored).save(tmp_path / name, exif=exif, quality=95)
    photo = read_image(tmp_path / name)
    assert photo.size == (48, 32)
    np.testing.assert_allclose(photo.pixels[4, 4], [1, 1, 1], atol=0.05)
    np.testing.assert_allclose(photo.pixels[4, 44], [1, 0, 0], atol=0.05)
    np.testing.assert_allclose(photo.pixels[28, 4], [0, 0, 0], atol=0.05)


def add_png_chunk(path: Path, name: bytes, data: bytes) -> None:
    content = path.read_bytes()
    chunk = struct.pack(">I", len(data)) + name + data
    chunk += struct.pack(">I", zlib.crc32(name + data))
    path.write_bytes(content[:33] + chunk + content[33:])  # after the header


def test_focal_length_is_read(tmp_path):
    for told, expected in ((50, 50.0), (0, None)):
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = told
        photo = saved(tmp_path, "a.jpg", Image.fromarray(BYTES), exif=exif)
        assert photo.focal_35mm == expected


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_keep_their_precision(tmp_path, channels, suffix):
    words = WORDS[..., :channels].copy()
    if channels == 4:
        words[..., 3] = 65535
    path = tmp_path / f"a{suffix}"
    if suffix == ".png":
        write_png(path, words)
    else:
        photometric = "rgb" if channels >= 3 else "minisblack"
        extra = {"extrasamples": ["unassalpha"]} if channels == 4 else {}
        data = words if channels > 1 else words[..., 0]
        tifffile.imwrite(path, data, photometric=photometric, **extra)
    photo = read_image(path)
    expected = np.repeat(words, 3, 2) if channels == 1 else words[..., :3]
    np.testing.assert_allclose(photo.pixels, expected / 65535, atol=1e-6)


def test_linear_float_files_are_encoded(tmp_path):
    light = np.linspace(0, 1.5, 20 * 24 * 3).reshape(20, 24, 3).astype(np.float32)
    write_exr(tmp_path / "a.exr", light, half=False)
    photo = read_image(tmp_path / "a.exr")
    np.testing.assert_allclose(photo.pixels, srgb_encoded(light), atol=1e-6)
    np.testing.assert_allclose(photo.pixels.max(), 1, atol=1e-6)
    np.testing.assert_allclose(srgb_encoded(np.array([0.21404114])), 0.5, atol=1e-6)
    tifffile.imwrite(tmp_path / "a.tif", light, photometric="rgb")
    np.testing.assert_allclose(read_image(tmp_path / "a.tif").pixels, photo.pixels, atol=1e-6)


def test_a_colour_profile_is_converted_to_srgb(tmp_path):
    srgb = ImageCms.createProfile("sRGB")
    plain = ImageCms.ImageCmsProfile(srgb).tobytes()
    photo = saved(tmp_path, "a.png", Image.fromarray(BYTES), icc_profile=plain)
    np.testing.assert_allclose(photo.pixels, BYTES / 255, atol=1e-6)
    swapped = swap_red_and_blue(plain)
    photo = saved(tmp_path, "b.png", Image.fromarray(BYTES), icc_profile=swapped)
    np.testing.assert_allclose(photo.pixels, BYTES[..., ::-1] / 255, atol=0.02)
    assert "converted to sRGB" in photo.source
    photo = saved(tmp_path, "c.png", Image.fromarray(BYTES), icc_profile=b"nonsense")
    np.testing.assert_allclose(photo.pixels, BYTES / 255, atol=1e-6)


def swap_red_and_blue(profile: bytes) -> bytes:
    # A valid profile of another name whose red and blue primaries have changed places.
    profile = profile.replace(b"rXYZ", b"tmp_").replace(b"bXYZ", b"rXYZ").replace(b"tmp_", b"bXYZ")
    wide = "sRGB".encode("utf-16-be")
    return profile.replace(wide, "tRGB".encode("utf-16-be")).replace(b"sRGB", b"tRGB")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "a16.png", "a.exr"])
@pytest.mark.parametrize("kept", [0.3, 0.7])
def test_truncated_files_are_named(tmp_path, name, kept):
    path = tmp_path / name
    if name == "a16.png":
        write_png(path, WORDS)
    elif name == "a.exr":
        write_exr(path, RNG.random((64, 64, 3)))
    else:
        Image.fromarray(np.tile(BYTES, (4, 4, 1))).save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * kept)])
    with pytest.raises(ValueError, match=path.name):
        read_image(path)


def test_what_is_no_photo_is_refused(tmp_path):
    (tmp_path / "text.jpg").write_text("not an image at all")
    with pytest.raises(ValueError, match=r"text\.jpg is not a readable image"):
        read_image(tmp_path / "text.jpg")
    (tmp_path / "empty.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"empty\.png"):
        read_image(tmp_path / "empty.png")
    with pytest.raises(FileNotFoundError, match="absent"):
        read_image(tmp_path / "absent.png")
    Image.fromarray(BYTES[:8]).save(tmp_path / "tiny.png")
    with pytest.raises(ValueError, match="24x8 px; at least 16x16"):
        read_image(tmp_path / "tiny.png")
    holes = np.full((20, 20, 3), np.nan, np.float32)
    tifffile.imwrite(tmp_path / "nan.tif", holes, photometric="rgb")
    with pytest.raises(ValueError, match=r"nan\.tif holds NaN"):
        read_image(tmp_path / "nan.tif")


def test_png_of_every_kind_comes_back(tmp_path):
    path = tmp_path / "a.png"
    for channels in (1, 2, 3, 4):
        write_png(path, (WORDS[..., :channels] // 256).astype(np.uint8))
        back = np.asarray(Image.open(path)).reshape(20, 24, channels)
        np.testing.assert_array_equal(back, WORDS[..., :channels] // 256)
    write_png(path, np.array([[-1.0, 0.5], [1.0, 7.0]]))
    np.testing.assert_array_equal(np.asarray(Image.open(path)), [[0, 128], [255, 255]])


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((3, 3, 5)), "shape"),
        (np.zeros((0, 3, 3)), "shape"),
        (np.full((3, 3), np.nan), "NaN"),
        (np.zeros((3, 3), np.int64), "int64"),
    ],
)
def test_png_refuses(tmp_path, image, message):
    with pytest.raises(ValueError, match=message):
        write_png(tmp_path / "a.png", image)
    assert not list(tmp_path.iterdir())


@given(arrays(np.float32, (3, 4, 3), elements=st.floats(-60000, 60000, width=16)))
def test_exr_comes_back(tmp_path_factory, image):
    path = tmp_path_factory.mktemp("exr") / "a.exr"
    for half in (True, False):
        write_exr(path, image, half=half)
        np.testing.assert_array_equal(read_exr(path), image)


def test_exr_channels(tmp_path):
    path = tmp_path / "a.exr"
    image = RNG.random((5, 6, 4)).astype(np.float16)
    write_exr(path, image)
    np.testing.assert_array_equal(read_exr(path), image)
    write_exr(path, image, channels=["Z", "B", "R", "AO"])
    np.testing.assert_array_equal(read_exr(path), image[..., [2, 1, 3, 0]])
    write_exr(path, image[..., 0])
    np.testing.assert_array_equal(read_exr(path), image[..., :1])


@pytest.mark.parametrize(
    ("image", "half", "message"),
    [
        (np.full((2, 2, 3), 1e5), True, "beyond 65504"),
        (np.full((2, 2, 3), np.nan), False, "not finite"),
        (np.zeros((2, 2, 2)), True, "2 channels"),
        (np.zeros(5), True, "shape"),
    ],
)
def test_exr_refuses(tmp_path, image, half, message):
    with pytest.raises(ValueError, match=message):
        write_exr(tmp_path / "a.exr", image, half=half)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".json", ".pts", ".txt"])
@pytest.mark.parametrize(("scheme", "count"), [("ibug68", 68), ("mediapipe468", 468)])
def test_landmarks_come_back(tmp_path, suffix, scheme, count):
    points = RNG.random((count, 3)) * 500
    path = tmp_path / f"face{suffix}"
    write_landmarks(path, Landmarks(points, scheme, (640, 480)))
    back = read_landmarks(path)
    assert back.scheme == scheme
    dimensions = 3 if suffix == ".json" else 2
    np.testing.assert_allclose(back.points, points[:, :dimensions], atol=1e-4)
    assert back.image_size == ((640, 480) if suffix == ".json" else None)


def test_pixel_centres_of_other_formats_are_shifted(tmp_path):
    rows = "\n".join("10 20" for _ in range(68))
    (tmp_path / "a.txt").write_text(rows)
    np.testing.assert_allclose(read_landmarks(tmp_path / "a.txt").points[0], [10.5, 20.5])
    (tmp_path / "a.pts").write_text(f"version: 1\nn_points:  68\n{{\n{rows}\n}}")
    np.testing.assert_allclose(read_landmarks(tmp_path / "a.pts").points[0], [9.5, 19.5])


GOOD = {"schema": "jaxface-landmarks/1", "scheme": "ibug68", "points": [[1.0, 2.0]] * 68}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": [[1, 2]] * 67}, r"\(67, 2\)"),
        ({"points": [[1, 2]] * 67 + [[1]]}, "no table of numbers"),
        ({"points": [[1, 2]] * 67 + [[float("nan"), 1]]}, r"points \[67\] are not finite"),
        ({"points": [["a", "b"]] * 68}, "no table of numbers"),
        ({"points": None}, "shape"),
        ({"scheme": "aflw21"}, "aflw21"),
        ({"schema": "other/2"}, "other/2"),
        ({"image_size": [0, 5]}, "image_size"),
    ],
)
def test_bad_json_says_what_is_wrong(tmp_path, change, message):
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(GOOD | change))
    with pytest.raises(ValueError, match=message) as caught:
        read_landmarks(path)
    assert "bad.json" in str(caught.value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", "{", "not JSON"),
        ("a.json", "[]", "schema"),
        ("a.pts", "1 2\n3 4", "not a .pts file"),
        ("a.txt", "1 2\n3 4", "2 points; 68"),
        ("a.txt", "1 2\nx y", "line 2"),
        ("a.txt", "1 nan\n" * 68, "not finite"),
        ("a.csv", "1 2", "suffix"),
    ],
)
def test_bad_files_say_what_is_wrong(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        read_landmarks(tmp_path / name)


def test_absent_and_binary_landmark_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="absent"):
        read_landmarks(tmp_path / "absent.json")
    (tmp_path / "a.txt").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(ValueError, match="not a text file"):
        read_landmarks(tmp_path / "a.txt")
    with pytest.raises(ValueError, match="suffix"):
        write_landmarks(tmp_path / "a.csv", Landmarks(np.zeros((68, 2)), "ibug68", None))
