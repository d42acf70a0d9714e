"""`polcap synth`: render RAW brackets with their truth, calibration photographs or a data set."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Option

from polcap import terminal
from polcap.cli import options
from polcap.cli.options import Json, choice
from polcap.errors import SettingError

if TYPE_CHECKING:
    from polcap.synth.render import Scene


def synth(
    folder: Annotated[Path, Argument(help="Folder to make; must be new or empty.")],
    scene: Annotated[Literal["bumps", "clusters", "vase", "ball"], choice("Kind of object.")] = "bumps",
    seed: Annotated[int, Option(min=0, help="Of shape, material, light and noise.")] = 0,
    assignments: Annotated[
        list[str] | None, Option("--set", metavar="K=V", help="Camera and shooting, such as width=768; repeatable.")
    ] = None,
    mesh: Annotated[Path | None, Option(metavar="FILE", help="A mesh as the object: PLY, OBJ, GLB, …")] = None,
    material: Annotated[
        Path | None, Option(metavar="FOLDER", help="Texture set of the object: albedo.jpg, roughness.jpg, …")
    ] = None,
    cast_shadow: Annotated[
        bool, Option("--cast-shadow", help="The object casts a shadow; a mesh always does.")
    ] = False,
    interreflection: Annotated[
        bool, Option("--interreflection", help="One bounce of light between parts of the mesh.")
    ] = False,
    law: Annotated[Literal["smooth", "rough"], choice("Interface through which diffuse light leaves.")] = "smooth",
    views: Annotated[
        int | None,
        Option(min=3, max=99, metavar="N", help="N captures from all sides, on a board; a mesh stands upright, y up."),
    ] = None,
    flat: Annotated[
        bool, Option("--flat", help="With --views: a flat sample with relief, for `polcap material`, instead.")
    ] = False,
    calibration: Annotated[bool, Option("--calibration", help="Photographs for `polcap calibrate` instead.")] = False,
    dataset: Annotated[
        int | None, Option(min=1, metavar="N", help="Make N samples of a data set instead (extra [train]); resumable.")
    ] = None,
    json: Json = False,
) -> None:
    """Render a capture of an object that does not exist, with its truth."""
    from polcap import config as settings

    output = folder
    if dataset is not None:
        corpus, output = options.training("dataset_files"), folder / "dataset.json"
        named = {"seed": seed, "mesh": str(mesh or ""), "material": str(material or ""), "law": law}
        recipe = settings.fill(corpus.DatasetRecipe, named, assignments or ())
        corpus.main(folder, dataset, recipe, terminal.print_progress)
    elif calibration:
        from polcap.synth import calibration_frames

        set_up = settings.fill(calibration_frames.CalibrationShoot, {"seed": seed}, assignments or ())
        calibration_frames.write(folder, set_up)
    elif flat and (views is None or mesh is not None or interreflection):
        raise SettingError(
            "--flat needs --views, and takes neither --mesh nor --interreflection; write --flat --views 9"
        )
    elif interreflection and mesh is None:
        raise SettingError("--interreflection needs a mesh; name one with --mesh")
    else:
        from msgspec.structs import replace

        from polcap.synth import scenes

        chosen = scenes.random_scene(seed, scene)
        chosen = chosen if mesh is None else scenes.with_model(chosen, mesh, seed)
        chosen = chosen if material is None else scenes.with_textures(chosen, material)
        changes: dict[str, Any] = {"law": law} if law == "rough" else {}
        changes |= {"cast_shadows": True} if cast_shadow else {}
        changes |= {"interreflection": True} if interreflection else {}
        _render(folder, replace(chosen, **changes), seed, assignments or (), views, flat)
    terminal.print_written([output], json)


def _render(folder: Path, scene: "Scene", seed: int, assignments: Sequence[str], views: int | None, flat: bool) -> None:
    """Render one capture of a scene, or `views` captures, from all sides or of a flat sample with its material.

    `assignments` set camera and shooting.
    """
    from polcap import config as settings
    from polcap.synth import all_around, flat_views, shooting

    if views is None:
        shoot = settings.fill(shooting.Shoot, {"seed": seed}, assignments)
        with terminal.progress(len(shoot.angles_deg) * shoot.exposures) as bar:
            shooting.write(folder, scene, shoot, bar.frame)
    elif flat:
        sample = settings.fill(flat_views.FlatShoot, {"seed": seed}, assignments)
        with terminal.progress(views * len(sample.angles_deg) * sample.exposures) as bar:
            flat_views.write(folder, scene, sample, views, bar.frame)
    else:
        around = settings.fill(all_around.AroundShoot, {"seed": seed}, assignments)
        with terminal.progress((views + around.laid) * len(around.angles_deg) * around.exposures) as bar:
            all_around.write(folder, scene, around, views, bar.frame)
