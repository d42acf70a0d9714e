"""In: a result folder of polcap. Out: its asset in Blender, seen through the camera that took the photographs.

File > Import > polcap result (maps.json). Needs nothing but Blender 4.2 or later. The object stands at
the origin; camera and flash stand where they stood; the photograph is the camera's backdrop. The
expected error of the normals is an AOV of the material, and a switch in the sidebar shows it instead.
"""

import json
import struct
from math import pi, radians
from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, StringProperty
from bpy_extras.io_utils import ImportHelper
from mathutils import Matrix, Vector

SENSOR_MM = 36.0  # any width does: the focal length is stated in its terms
WORST_DEG = 20.0  # expected error at which the confidence picture is red
TO_BLENDER = Matrix(((1, 0, 0), (0, 0, -1), (0, 1, 0)))  # y up as in glTF -> z up


class Result:
    """What a result folder tells."""

    def __init__(self, maps_json: Path) -> None:
        self.maps = maps_json.parent
        self.folder = self.maps.parent
        self.said: dict[str, Any] = json.loads(maps_json.read_text(encoding="utf-8"))
        exports = sorted(self.folder.glob("asset/blender/*.glb")) or sorted(self.folder.glob("asset/*.glb"))
        if not exports:
            raise ValueError(f"{self.folder / 'asset'} holds no .glb; run `polcap export` with --preset blender")
        self.glb = exports[0]

    @property
    def relative(self) -> bool:
        return bool(self.said["depth"]["unit"] != "m")

    @property
    def distance(self) -> float:
        """The object's median depth, in its unit: where the light of the photographs is 1."""
        return float(self.said["depth"]["median"])

    def pose(self) -> Matrix:
        """The camera's frame (x right, y up, z toward it) in Blender's; polcap turns assets of upright cameras."""
        with self.glb.open("rb") as file:
            _, _, _, length, _ = struct.unpack("<4sIIII", file.read(20))
            document = json.loads(file.read(length))
        extras = document["asset"]["extras"]
        turn = Matrix.Rotation(radians(extras.get("turned_deg", 0)), 4, "Z")
        return TO_BLENDER.to_4x4() @ Matrix.Translation(-Vector(extras["origin_in_camera"])) @ turn


class IMPORT_SCENE_OT_polcap(bpy.types.Operator, ImportHelper):  # type: ignore[misc]
    """Load a result of polcap: asset, camera, flash, photograph, confidence"""

    bl_idname = "import_scene.polcap"
    bl_label = "Import polcap result"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    filename_ext = ".json"
    filter_glob: StringProperty(default="maps.json", options={"HIDDEN"})  # type: ignore[valid-type]
    scene: BoolProperty(  # type: ignore[valid-type]
        name="Set up the scene",
        description="Make the photograph's camera the scene's, at its size, with the Standard view transform",
        default=True,
    )

    def execute(self, context: Any) -> set[str]:
        try:
            result = Result(Path(self.filepath))
            pose = result.pose()
        except (OSError, ValueError, KeyError, struct.error) as error:
            self.report({"ERROR"}, f"no result of polcap: {error}")
            return {"CANCELLED"}
        before = set(bpy.data.objects)
        bpy.ops.import_scene.gltf(filepath=str(result.glb))
        added = [one for one in bpy.data.objects if one not in before and one.type == "MESH"]
        camera = add_camera(context, result, pose)
        add_flash(context, result, pose.translation)
        for one in added:
            one["polcap_unit"] = result.said["depth"]["unit"]
            add_confidence(one.data.materials[0], result)
        if self.scene:
            set_up_scene(context, result, camera)
        if result.relative:
            self.report({"WARNING"}, "the scale is relative: no chart gave it; measure the object and scale all to it")
        if not result.said["camera"]["focal_known"]:
            self.report({"WARNING"}, "the focal length was assumed: depth may be bent")
        return {"FINISHED"}


def add_camera(context: Any, result: Result, pose: Matrix) -> Any:
    """The photograph's camera over the crop: focal length, shifted centre, backdrop."""
    said, (width, height) = result.said["camera"], result.said["size"]
    camera = bpy.data.cameras.new("polcap camera")
    camera.sensor_fit, camera.sensor_width = "HORIZONTAL", SENSOR_MM
    camera.lens = said["focal_px"] * SENSOR_MM / width
    camera.shift_x = ((width - 1) / 2 - said["center_px"][0]) / width
    camera.shift_y = (said["center_px"][1] - (height - 1) / 2) / width
    camera.clip_start, camera.clip_end = result.distance / 100, result.distance * 100
    photograph = result.maps / "photograph.png"
    if photograph.exists():
        backdrop = camera.background_images.new()
        backdrop.image = bpy.data.images.load(str(photograph))
        backdrop.display_depth, backdrop.alpha = "BACK", 1.0
        camera.show_background_images = True
    placed = bpy.data.objects.new("polcap camera", camera)
    placed.matrix_world = pose
    context.scene.collection.objects.link(placed)
    return placed


def add_flash(context: Any, result: Result, at: Vector) -> None:
    """A point light at the camera under which a white surface at the object's distance has radiance 1."""
    flash = bpy.data.lights.new("polcap flash", "POINT")
    flash.energy = 4 * pi**2 * result.distance**2  # W; Cycles: radiance of white = P / (4 pi^2 d^2)
    flash.shadow_soft_size = 0.0
    placed = bpy.data.objects.new("polcap flash", flash)
    placed.location = at
    context.scene.collection.objects.link(placed)


def add_confidence(material: Any, result: Result) -> None:
    """The expected error of the normals [degrees]: as an AOV, and as an emission to switch to."""
    file = result.maps / "confidence.exr"
    if not file.exists():
        return
    tree = material.node_tree
    picture = tree.nodes.new("ShaderNodeTexImage")
    picture.name = picture.label = "expected normal error, degrees"
    picture.image = bpy.data.images.load(str(file))
    picture.image.colorspace_settings.is_data = True
    aov = tree.nodes.new("ShaderNodeOutputAOV")
    aov.aov_name = "confidence"
    ramp = tree.nodes.new("ShaderNodeMapRange")
    ramp.inputs["From Max"].default_value = WORST_DEG
    colors = tree.nodes.new("ShaderNodeValToRGB")
    colors.color_ramp.elements[0].color = (0.02, 0.1, 0.6, 1)
    colors.color_ramp.elements.new(0.5).color = (0.9, 0.7, 0.05, 1)
    colors.color_ramp.elements[-1].color = (0.8, 0.02, 0.02, 1)
    glow = tree.nodes.new("ShaderNodeEmission")
    glow.name = "confidence"
    for k, node in enumerate((picture, ramp, colors, glow, aov)):
        node.location = (-700 + 250 * k, 700)
    tree.links.new(picture.outputs["Color"], ramp.inputs["Value"])
    tree.links.new(picture.outputs["Color"], aov.inputs["Value"])
    tree.links.new(ramp.outputs["Result"], colors.inputs["Fac"])
    tree.links.new(colors.outputs["Color"], glow.inputs["Color"])


def set_up_scene(context: Any, result: Result, camera: Any) -> None:
    scene = context.scene
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = result.said["size"]
    scene.render.resolution_percentage = 100
    scene.view_settings.view_transform = "Standard"
    if "confidence" not in context.view_layer.aovs:
        aov = context.view_layer.aovs.add()
        aov.name, aov.type = "confidence", "VALUE"


class MATERIAL_OT_polcap_confidence(bpy.types.Operator):  # type: ignore[misc]
    """Show the expected error of the normals (blue 0, red 20 degrees), or the material again"""

    bl_idname = "material.polcap_confidence"
    bl_label = "Confidence on / off"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: Any) -> bool:
        return switchable(context.object) is not None

    def execute(self, context: Any) -> set[str]:
        tree: Any = switchable(context.object)
        output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
        shown = output.inputs["Surface"].links[0].from_node
        other = tree.nodes["confidence"]
        if shown == other:
            other = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
        tree.links.new(other.outputs[0], output.inputs["Surface"])
        return {"FINISHED"}


def switchable(one: Any) -> Any | None:
    """The node tree of an object that came from polcap with its confidence."""
    if one is None or one.type != "MESH" or not one.data.materials:
        return None
    tree = one.data.materials[0].node_tree
    return tree if tree is not None and "confidence" in tree.nodes else None


class VIEW3D_PT_polcap(bpy.types.Panel):  # type: ignore[misc]
    """What the chosen object says of itself"""

    bl_label = "polcap"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "polcap"

    def draw(self, context: Any) -> None:
        one = context.object
        if one is None or "polcap_unit" not in one:
            self.layout.label(text="Choose an object of polcap")
            return
        relative = one["polcap_unit"] != "m"
        self.layout.label(
            text="Scale: relative" if relative else "Scale: metres", icon="ERROR" if relative else "CHECKMARK"
        )
        self.layout.operator(MATERIAL_OT_polcap_confidence.bl_idname)


CLASSES = (IMPORT_SCENE_OT_polcap, MATERIAL_OT_polcap_confidence, VIEW3D_PT_polcap)


def in_menu(self: Any, context: Any) -> None:
    self.layout.operator(IMPORT_SCENE_OT_polcap.bl_idname, text="polcap result (maps.json)")


def register() -> None:
    for one in CLASSES:
        bpy.utils.register_class(one)
    bpy.types.TOPBAR_MT_file_import.append(in_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(in_menu)
    for one in reversed(CLASSES):
        bpy.utils.unregister_class(one)
