"""`polcap synth`: render RAW brackets with their truth, calibration photographs or a data set."""

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
        Literal["bumps", "clusters", "vase"], typer.Option(case_sensitive=False, help="Kind of object.")
    ] = "bumps",
    seed: Annotated[int, typer.Option(min=0, help="Of shape, material, light and noise.")] = 0,
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="K=V", help="Camera and shooting, such as width=768; repeatable."),
    ] = None,
    mesh: Annotated[Path | None, typer.Option(metavar="FILE", help="A mesh as the object: PLY, OBJ, GLB, …")] = None,
    material: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Texture set of the object: albedo.jpg, roughness.jpg, …")
    ] = None,
    cast_shadow: Annotated[
        bool, typer.Option("--cast-shadow", help="The object casts a shadow; a mesh always does.")
    ] = False,
    interreflection: Annotated[
        bool, typer.Option("--interreflection", help="One bounce of light between parts of the mesh.")
    ] = False,
    law: Annotated[
        Literal["smooth", "rough"],
        typer.Option(case_sensitive=False, help="Interface through which diffuse light leaves."),
    ] = "smooth",
    calibration: Annotated[
        bool, typer.Option("--calibration", help="Make photographs for `polcap calibrate` instead.")
    ] = False,
    dataset: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Make N samples of a data set instead (extra [train]); resumable."),
    ] = None,
    json: Json = False,
) -> None:
    """Render a capture of an object that does not exist, with its truth."""
    from msgspec.structs import replace

    from polcap import config as settings
    from polcap.synth import scenes
    from polcap.synth import shooting as synthetic

    if dataset is not None:
        corpus = extras.training("dataset_files")
        named = {"seed": seed, "mesh": str(mesh or ""), "material": str(material or ""), "law": law}
        corpus.main(folder, dataset, settings.fill(corpus.DatasetRecipe, named, assignments or ()))
        _print_written(folder / "dataset.json", json)
        return
    if calibration:
        from polcap.synth import calibration_frames

        set_up = settings.fill(calibration_frames.CalibrationShoot, {"seed": seed}, assignments or ())
        calibration_frames.write(folder, set_up)
        _print_written(folder, json)
        return
    if interreflection and mesh is None:
        raise SettingError("--interreflection needs a mesh; name one with --mesh")
    shoot = settings.fill(synthetic.Shoot, {"seed": seed}, assignments or ())
    chosen = scenes.random_scene(seed, scene)
    if mesh is not None:
        chosen = scenes.with_model(chosen, mesh, seed)
    if material is not None:
        chosen = scenes.with_textures(chosen, material)
    if cast_shadow:
        chosen = replace(chosen, cast_shadows=True)
    if interreflection:
        chosen = replace(chosen, interreflection=True)
    if law == "rough":
        chosen = replace(chosen, law=law)
    with terminal.progress(len(shoot.angles_deg) * shoot.exposures) as bar:
        synthetic.write(folder, chosen, shoot, bar.frame)
    _print_written(folder, json)


def _print_written(made: Path, json: bool) -> None:
    terminal.print_data({"written": [str(made)]} if json else str(made))
