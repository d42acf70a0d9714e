"""In: a scene and how it is shot. Out: RAW brackets of it with the truth beside, or a data set: `polcap synth`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from polcap import terminal
from polcap.cli import extras
from polcap.cli.options import Json
from polcap.errors import SettingError


def synth(
    context: typer.Context,
    folder: Annotated[Path, typer.Argument(help="Folder to make; must be new or empty.")],
    scene: Annotated[
        Literal["bumps", "clusters", "vase"], typer.Option(case_sensitive=False, help="What stands there.")
    ] = "bumps",
    seed: Annotated[int, typer.Option(min=0, help="Draws shape, material, light and noise.")] = 0,
    assignments: Annotated[
        list[str] | None, typer.Option("--set", metavar="K=V", help="How it is shot, as width=768; repeatable.")
    ] = None,
    mesh: Annotated[Path | None, typer.Option(metavar="FILE", help="A mesh stands there: PLY, OBJ, GLB, …")] = None,
    material: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Texture set it wears: albedo.jpg, roughness.jpg, …")
    ] = None,
    cast_shadow: Annotated[
        bool, typer.Option("--cast-shadow", help="The object's shadow falls on chart and backdrop; a mesh's always.")
    ] = False,
    interreflection: Annotated[
        bool, typer.Option("--interreflection", help="Light goes once from part to part of the mesh.")
    ] = False,
    law: Annotated[
        Literal["smooth", "rough"],
        typer.Option(case_sensitive=False, help="Interface that light from inside the body leaves through."),
    ] = "smooth",
    calibration: Annotated[
        bool, typer.Option("--calibration", help="Make photographs for `polcap calibrate` instead.")
    ] = False,
    dataset: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Make N samples of a data set instead (extra [train]); goes on."),
    ] = None,
    json: Json = False,
) -> None:
    """Photograph an object that does not exist: RAW brackets, with the truth beside them."""
    from msgspec.structs import replace

    from polcap import config as settings
    from polcap.synth import scenes
    from polcap.synth import shooting as synthetic

    if dataset is not None:
        corpus = extras.training("dataset_files")
        named = {"seed": seed, "mesh": str(mesh or ""), "material": str(material or ""), "law": law}
        corpus.main(folder, dataset, settings.fill(corpus.DatasetRecipe, named, assignments or ()))
        _say_written(folder / "dataset.json", json)
        return
    if calibration:
        from polcap.synth import calibration_frames

        set_up = settings.fill(calibration_frames.CalibrationShoot, {"seed": seed}, assignments or ())
        calibration_frames.write(folder, set_up)
        _say_written(folder, json)
        return
    if interreflection and mesh is None:
        raise SettingError("--interreflection is traced between triangles; give the object with --mesh")
    shoot = settings.fill(synthetic.Shoot, {"seed": seed}, assignments or ())
    what = scenes.random_scene(seed, scene)
    if mesh is not None:
        what = scenes.with_model(what, mesh, seed)
    if material is not None:
        what = scenes.with_textures(what, material)
    if cast_shadow:
        what = replace(what, cast_shadows=True)
    if interreflection:
        what = replace(what, interreflection=True)
    if law == "rough":
        what = replace(what, law=law)
    with terminal.progress(len(shoot.angles_deg) * shoot.exposures) as bar:
        synthetic.write(folder, what, shoot, bar.frame)
    _say_written(folder, json)


def _say_written(made: Path, json: bool) -> None:
    terminal.say({"written": [str(made)]} if json else str(made))
