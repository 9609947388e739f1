"""Open an exported GLB in Blender, check what arrived, and render it to look at.

Blender is a test-time tool only, from the `bench` extra (``pip install bpy``, Python 3.11):

    python tools/check_in_blender.py OUT/mesh.glb look.png --weight jawOpen=0.7 --view 25

Exits with status 1 if the mesh, its UVs, its texture or (with ``--morphs``) its shape keys are
not what was asked for.
"""

import argparse
import json
import math
import sys
from pathlib import Path

import numpy as np


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("glb", type=Path)
    parser.add_argument("image", type=Path, nargs="?", help="PNG to render to")
    parser.add_argument("--weight", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--view", type=float, default=20.0, help="degrees round the head")
    parser.add_argument("--morphs", type=int, help="number of shape keys that must be there")
    parser.add_argument("--untextured", action="store_true", help="do not require a texture")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--photo-camera", action="store_true", help="render by the GLB's camera")
    return parser.parse_args(arguments)


def inspect(bpy, mesh_object) -> dict:
    """What Blender has of the mesh, as plain values."""
    mesh = mesh_object.data
    keys = mesh.shape_keys.key_blocks if mesh.shape_keys else []
    images = [
        node.image
        for material in mesh.materials
        for node in material.node_tree.nodes
        if node.type == "TEX_IMAGE" and node.image
    ]
    corners = np.array([corner for corner in mesh_object.bound_box])
    return {
        "blender": bpy.app.version_string,
        "vertices": len(mesh.vertices),
        "polygons": len(mesh.polygons),
        "uv_layers": [layer.name for layer in mesh.uv_layers],
        "shape_keys": [key.name for key in keys[1:]],
        "textures": [[image.name, *image.size, image.colorspace_settings.name] for image in images],
        "size_m": (corners.max(axis=0) - corners.min(axis=0)).round(4).tolist(),
        "rotation": [round(v, 4) for v in mesh_object.matrix_world.to_quaternion()],
        "location_m": [round(v, 4) for v in mesh_object.matrix_world.translation],
        "cameras": sum(thing.type == "CAMERA" for thing in bpy.data.objects),
    }


def problems(found: dict, options: argparse.Namespace) -> list[str]:
    wrong = []
    if not found["uv_layers"]:
        wrong.append("no UV layer")
    if not options.untextured and not found["textures"]:
        wrong.append("no texture on the material")
    if options.morphs is not None and len(found["shape_keys"]) != options.morphs:
        wrong.append(f"{len(found['shape_keys'])} shape keys instead of {options.morphs}")
    if not 0.1 < max(found["size_m"]) < 0.6:
        wrong.append(f"size {found['size_m']} m is not that of a head in metres")
    return wrong


def render(bpy, mesh_object, options: argparse.Namespace) -> None:
    """A studio view of the head on the CPU: camera in front of the face, one soft key light."""
    from mathutils import Matrix, Vector

    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = options.samples
    scene.cycles.use_denoising = False
    scene.render.resolution_x = scene.render.resolution_y = options.size
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = str(options.image.resolve())

    # Blender turns glTF's +y up into its own +z; a face looks along -y.
    placed = [mesh_object.matrix_world @ Vector(corner) for corner in mesh_object.bound_box]
    middle = sum(placed, Vector()) / len(placed)
    turn = mesh_object.matrix_world.to_3x3() @ Matrix.Rotation(math.radians(options.view), 3, "Z")
    toward = (turn @ Vector((0.0, -1.0, 0.0))).normalized()

    def aim(thing, position):
        thing.location = position
        thing.rotation_euler = (middle - position).to_track_quat("-Z", "Y").to_euler()

    if options.photo_camera:
        scene.camera = next(thing for thing in bpy.data.objects if thing.type == "CAMERA")
    else:
        scene.camera = bpy.data.objects.new("view", bpy.data.cameras.new("view"))
        scene.collection.objects.link(scene.camera)
        scene.camera.data.lens = 85.0
        aim(scene.camera, middle + 0.95 * toward)
    light = bpy.data.objects.new("key", bpy.data.lights.new("key", type="AREA"))
    scene.collection.objects.link(light)
    light.data.energy, light.data.size = 12.0, 0.6
    side = toward.cross(Vector((0, 0, 1)))
    aim(light, middle + 0.8 * toward + 0.5 * Vector((0, 0, 1)) - 0.5 * side)
    world = bpy.data.worlds.new("grey")
    scene.world = world
    background = world.node_tree and world.node_tree.nodes.get("Background")
    if background:
        background.inputs[0].default_value = (0.5, 0.5, 0.5, 1.0)
        background.inputs[1].default_value = 0.5
    bpy.ops.render.render(write_still=True)


def main() -> int:
    options = parse()
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(options.glb.resolve()))
    mesh_object = next(thing for thing in bpy.data.objects if thing.type == "MESH")
    found = inspect(bpy, mesh_object)
    print(json.dumps(found, indent=2))
    wrong = problems(found, options)
    for setting in options.weight:
        name, value = setting.split("=")
        if name in found["shape_keys"]:
            mesh_object.data.shape_keys.key_blocks[name].value = float(value)
        else:
            wrong.append(f"no shape key {name!r}")
    if options.image:
        render(bpy, mesh_object, options)
    for problem in wrong:
        print("WRONG:", problem, file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
