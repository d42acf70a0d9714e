"""Runs inside Blender's Python: `python inside.py JOB.json`. In: files and what to do. Out: arrays in JOB.npz.

A job is {"files": [...], "bake": [width, height] or null, "camera": {...} or null, "lights": [[x, y, z], ...], "lamp":
"SUN" or "POINT"}; lights are directions to suns, or positions of points, in the frame of the asset (y up). A camera's
"axes", right, up and backward, are those of the asset if not given. Arrays are named NUMBER/WHAT.
"""

import json
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector

TO_BLENDER = Matrix(((1, 0, 0), (0, 0, -1), (0, 1, 0)))


def load(file: str) -> Any:
    """The one mesh of a file, in an empty scene that renders what is there, linear."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    importers = {".glb": bpy.ops.import_scene.gltf, ".obj": bpy.ops.wm.obj_import, ".usdc": bpy.ops.wm.usd_import}
    importers[Path(file).suffix](filepath=file)
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    (mesh,) = (one for one in bpy.data.objects if one.type == "MESH")
    bpy.context.view_layer.objects.active = mesh
    mesh.select_set(True)
    return mesh


def corners(mesh: Any) -> np.ndarray:
    """Its vertices in the world, y up again."""
    back = TO_BLENDER.transposed()
    return np.array([back @ (mesh.matrix_world @ vertex.co) for vertex in mesh.data.vertices])


def bake(mesh: Any, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """What the material's inputs are at every texel, as Blender evaluates them; row 0 on top."""
    tree = mesh.data.materials[0].node_tree
    surface = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    target = tree.nodes.new("ShaderNodeTexImage")
    glow = tree.nodes.new("ShaderNodeEmission")
    tree.links.new(glow.outputs[0], output.inputs["Surface"])
    index = surface.inputs["IOR"].default_value
    level = tree.nodes.new("ShaderNodeMath")
    level.operation = "MULTIPLY"
    level.inputs[1].default_value = 2 * ((index - 1) / (index + 1)) ** 2  # level 0.5 is the index's own F0
    follow(tree, surface.inputs["Specular IOR Level"], level.inputs[0])
    reflectance = tree.nodes.new("ShaderNodeVectorMath")
    reflectance.operation = "MULTIPLY"
    follow(tree, surface.inputs["Specular Tint"], reflectance.inputs[0])
    tree.links.new(level.outputs[0], reflectance.inputs[1])
    found = {}
    for name in ("Base Color", "Roughness", "F0"):
        for link in glow.inputs["Color"].links:
            tree.links.remove(link)
        if name == "F0":
            tree.links.new(reflectance.outputs[0], glow.inputs["Color"])
        else:
            follow(tree, surface.inputs[name], glow.inputs["Color"])
        found[name] = baked(tree, target, size, "EMIT")
    tree.links.new(surface.outputs[0], output.inputs["Surface"])
    back = np.array(TO_BLENDER.transposed() @ mesh.matrix_world.to_3x3())
    found["normal"] = (2 * baked(tree, target, size, "NORMAL") - 1) @ back.T
    return found


def follow(tree: Any, source: Any, target: Any) -> None:
    """Give a socket what another one gets."""
    if source.is_linked:
        tree.links.new(source.links[0].from_socket, target)
        return
    value = source.default_value
    if isinstance(value, float):
        target.default_value = value if isinstance(target.default_value, float) else [value] * len(target.default_value)
    else:
        target.default_value = list(value)[: len(target.default_value)]


def baked(tree: Any, target: Any, size: tuple[int, int], kind: str) -> np.ndarray:
    target.image = bpy.data.images.new("baked", *size, float_buffer=True, is_data=True)
    tree.nodes.active = target
    bpy.ops.object.bake(type=kind, margin=0, normal_space="OBJECT")
    return np.array(target.image.pixels[:]).reshape(size[1], size[0], 4)[::-1, :, :3]


def render(camera: dict[str, Any], lights: list[list[float]], kind: str, samples: int) -> list[np.ndarray]:
    """Linear pictures (H, W, 3) through a photograph's camera, one per light; a white sheet facing a sun has 1."""
    scene, (width, height) = bpy.context.scene, camera["size"]
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.sensor_width, lens.lens = "HORIZONTAL", 36.0, camera["focal"] * 36.0 / width
    lens.shift_x = ((width - 1) / 2 - camera["center"][0]) / width
    lens.shift_y = (camera["center"][1] - (height - 1) / 2) / width
    lens.clip_start = 0.01
    placed = bpy.data.objects.new("camera", lens)
    turn = TO_BLENDER @ Matrix(camera.get("axes") or ((1, 0, 0), (0, 1, 0), (0, 0, 1))).transposed()
    placed.matrix_world = Matrix.Translation(TO_BLENDER @ Vector(camera["position"])) @ turn.to_4x4()
    light = bpy.data.lights.new("light", kind)
    light.energy, light.use_shadow = np.pi, False
    if kind == "SUN":
        light.angle = 0.0
    else:
        light.shadow_soft_size = 0.0
    lamp = bpy.data.objects.new("light", light)
    for one in (placed, lamp):
        scene.collection.objects.link(one)
    scene.camera, scene.cycles.samples, scene.cycles.max_bounces = placed, samples, 0
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 1.0
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.film_transparent = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    pictures = []
    for place in lights:
        lamp.location = TO_BLENDER @ Vector(place)
        lamp.rotation_euler = lamp.location.to_track_quat("Z", "Y").to_euler()
        scene.render.filepath = str(Path(sys.argv[1]).with_suffix(".exr"))
        bpy.ops.render.render(write_still=True)
        picture = bpy.data.images.load(scene.render.filepath)
        pictures.append(np.array(picture.pixels[:]).reshape(height, width, 4)[::-1, :, :3])
        bpy.data.images.remove(picture)
    return pictures


def main() -> None:
    job = json.loads(Path(sys.argv[1]).read_text())
    found: dict[str, np.ndarray] = {}
    for number, file in enumerate(job["files"]):
        mesh = load(file)
        found[f"{number}/vertices"] = corners(mesh)
        if job["bake"]:
            found |= {f"{number}/{name}": value for name, value in bake(mesh, tuple(job["bake"])).items()}
        pictures = render(job["camera"], job["lights"], job["lamp"], job["samples"]) if job["lights"] else []
        for k, picture in enumerate(pictures):
            found[f"{number}/light {k}"] = picture
    np.savez(Path(sys.argv[1]).with_suffix(".npz"), **found)  # type: ignore[arg-type]  # NumPy: `allow_pickle` stands among the names


main()
