"""In: a command line. Out: one call into polcap, its answer on stdout, an exit code.

stdout carries data only; progress and messages go to stderr. Exit codes: 0 done, 2 the input or a
setting is at fault, 3 the asset was written but a gate failed, 4 hardware, 130 interrupted (run again
to go on), 1 a bug. Heavy imports happen inside the commands, so that `--help` answers at once.
"""

import functools
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from polcap import __version__, terminal
from polcap.errors import GateError, InputError, SettingError

if TYPE_CHECKING:
    from polcap.images import Capture, ChartRequest

app = typer.Typer(
    help="Photographs through a turned polarizer, under a flash: in. A relightable 3-D asset: out.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,  # plain help: half the start-up time
    pretty_exceptions_enable=False,
)
Device = Literal["cpu", "cuda", "auto"]
Result = Annotated[Path, typer.Argument(help="Result folder of `polcap process`.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]


def main() -> None:
    """The `polcap` command."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # else the order of its sums follows the number of threads
    arguments = sys.argv[1:]
    if "--debug" in arguments:  # wherever it stands
        arguments = ["--debug", *(argument for argument in arguments if argument != "--debug")]
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]  # names of files are bytes
    app(arguments)


@app.callback()
def front(
    context: typer.Context,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of a failure.")] = False,
    version: Annotated[bool, typer.Option("--version", help="Print the version and end.")] = False,
) -> None:
    context.obj = debug
    if version:
        print(__version__)
        raise typer.Exit


@app.command()
@terminal.reported
def process(
    context: typer.Context,
    capture: Annotated[Path, typer.Argument(help="Folder with the photographs.")],
    out: Annotated[Path | None, typer.Option(help="Result folder; by default CAPTURE/polcap.")] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file of settings, a section per stage.")] = None,
    assignments: Annotated[
        list[str] | None, typer.Option("--set", metavar="K=V", help="A setting, as hdr.clip=0.95; repeatable.")
    ] = None,
    until: Annotated[str | None, typer.Option(metavar="STAGE", help="Stop after this stage.")] = None,
    force: Annotated[
        str | None, typer.Option(metavar="STAGE", help="Compute this stage and all after it again.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what was understood, and stop.")] = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Stay: process again whenever the folder has changed; Ctrl-C ends.")
    ] = False,
    json: Json = False,
    device: Annotated[Device, typer.Option(help="Where the network runs; cuda never falls back.")] = "cpu",
    threads: Annotated[int, typer.Option(min=0, help="Threads to use; 0 is all.")] = 0,
    memory: Annotated[float, typer.Option(min=0, help="Most memory to take, GB; 0 is no limit.")] = 0,
    angles: Annotated[
        str | None, typer.Option(metavar="DEG,…", help="Angles of the shots in order, as 0,45,90.")
    ] = None,
    chart: Annotated[
        str | None,
        typer.Option(metavar="X0,Y0,…|FILE", help="Chart corners in RAW px, dark skin first, clockwise; or a profile."),
    ] = None,
    no_chart: Annotated[bool, typer.Option("--no-chart", help="Use the camera's own colours.")] = False,
    mask: Annotated[Path | None, typer.Option(metavar="PNG", help="White where the object is.")] = None,
    estimator: Annotated[
        Literal["network", "analytic"] | None, typer.Option(help="By default the network where one is shipped.")
    ] = None,
    model: Annotated[Path | None, typer.Option(metavar="ONNX", help="Another model than the shipped one.")] = None,
) -> None:
    """Turn a capture into maps and a 3-D asset."""
    from polcap import unchanged

    target = out or capture / "polcap"
    request = None if until or force or dry_run or watch else _request(context.params, capture, target)
    if (finished := unchanged.find(target, request)) is not None:
        terminal.tell(finished.table)
        with terminal.progress(len(finished.stages)) as bar:
            for name in finished.stages:
                bar.stage(name, 0.0, True)
        _tell_result(finished.report, target, json)
        return
    _use_threads(threads)
    from polcap import config as settings
    from polcap import pipeline
    from polcap.formats import capture as captures
    from polcap.path import STAGES, UserInput

    _limit_memory(memory)
    for flag, stage in (("--until", until), ("--force", force)):
        if stage is not None and stage not in STAGES:
            raise SettingError(f"{flag} {stage}: no such stage; choose one of {', '.join(STAGES)}")
    chosen = settings.load(config, assignments or ())
    calibration = _chart(chart, no_chart)

    @functools.cache
    def supplied() -> UserInput:
        return UserInput(
            chart=calibration,
            mask=None if mask is None else _mask(mask),
            network=pipeline.load_network(estimator, model, device, threads),
            mask_network=pipeline.load_mask_network(threads),
        )

    def once() -> None:
        found = captures.read(capture, _angles(angles))
        if dry_run:
            _print_plan(found, pipeline.plan(found, supplied(), chosen, target, force), json)
            return
        known = supplied()
        table = captures.table(found)
        terminal.tell(table)
        with terminal.progress(len(STAGES) + 1) as bar:
            about = pipeline.process(found, known, chosen, target, until, force, bar.stage, bar.frame)
        if about is None:
            work = str(target / "work")
            terminal.say({"until": until, "work": work} if json else work)
            return
        unchanged.remember(target, request, table, (*pipeline.timings(target), "write"))
        _tell_result(about, target, json)

    if watch:
        _whenever_settled(capture, target, once)
    else:
        once()


def _request(options: dict[str, Any], capture: Path, out: Path) -> str | None:
    """What identifies a run of `process`: its options and the state of all files that it reads."""
    from polcap import unchanged

    aside = ("capture", "out", "json", "dry_run", "watch", "threads", "memory")  # they change no byte of a result
    given = [options[name] for name in ("config", "mask", "model") if options[name] is not None]
    if options["chart"] is not None and Path(options["chart"]).suffix == ".toml":
        given.append(Path(options["chart"]))
    asked = {name: value for name, value in options.items() if name not in aside}
    return unchanged.fingerprint(asked, capture, out, given)


def _tell_result(about: dict[str, Any], out: Path, json: bool) -> None:
    """The asset on stdout, the verdict beside it; a failed gate ends with exit code 3."""
    terminal.say(about if json else str(out / "asset" / f"{about['capture']['name']}.glb"))
    terminal.tell(f"verdict {about['verdict']}; {out / 'report.html'}")
    terminal.tell_gates(about)


def _whenever_settled(capture: Path, target: Path, once: Callable[[], None]) -> None:
    """Process a folder as it is and after each change; what is wrong with it is said, and it is looked at further."""
    from polcap.formats import arrivals

    if not capture.is_dir():
        raise SettingError(f"{capture} is no folder; --watch needs the one that the photographs go to")
    for _ in arrivals.settled(capture, target):
        try:
            once()
        except (InputError, GateError, OSError) as error:  # a frame may have gone between two looks
            terminal.tell(f"polcap: {terminal.line(error)}")
        terminal.tell(f"watching {capture}; Ctrl-C ends")


@app.command()
@terminal.reported
def batch(
    context: typer.Context,
    root: Annotated[Path, typer.Argument(help="Folder with captures, however deep.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the results; by default CAPTURE/polcap each.")] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file of settings, a section per stage.")] = None,
    assignments: Annotated[
        list[str] | None, typer.Option("--set", metavar="K=V", help="A setting, as hdr.clip=0.95; repeatable.")
    ] = None,
    shard: Annotated[
        str | None, typer.Option(metavar="K/N", help="The K-th of N parts; else what Slurm, AWS, Kubernetes, PBS say.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, tcp://host:8786 or local (extra [batch]).")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Captures at a time on this machine.")] = 1,
    retries: Annotated[int, typer.Option(min=0, help="Tries more for a capture whose process died.")] = 2,
    keep_going: Annotated[
        bool, typer.Option("--keep-going/--fail-fast", help="Go on after a failure, or stop at the first.")
    ] = True,
    write_jobs: Annotated[
        Literal["slurm", "openjd", "opencue", "snakemake", "kubernetes"] | None,
        typer.Option(metavar="KIND", help="Only write the job file for slurm, openjd, opencue, snakemake, kubernetes."),
    ] = None,
    jobs: Annotated[int, typer.Option(min=0, help="Shards of the job file; 0 is one per capture, 1000 at most.")] = 0,
    json: Json = False,
    device: Annotated[Device, typer.Option(help="Where the network runs; cuda never falls back.")] = "cpu",
    threads: Annotated[int, typer.Option(min=0, help="Threads per capture; 0 is all.")] = 0,
    memory: Annotated[float, typer.Option(min=0, help="Most memory per process, GB; 0 is no limit.")] = 0,
    angles: Annotated[
        str | None, typer.Option(metavar="DEG,…", help="Angles of the shots in order, as 0,45,90.")
    ] = None,
    chart: Annotated[Path | None, typer.Option(metavar="FILE", help="Color profile for all captures.")] = None,
    no_chart: Annotated[bool, typer.Option("--no-chart", help="Use the camera's own colours.")] = False,
    estimator: Annotated[
        Literal["network", "analytic"] | None, typer.Option(help="By default the network where one is shipped.")
    ] = None,
    model: Annotated[Path | None, typer.Option(metavar="ONNX", help="Another model than the shipped one.")] = None,
) -> None:
    """Process every capture below a folder; what is finished is left alone, what breaks does not stop the rest."""
    import msgspec

    from polcap import batch as batches
    from polcap import config as settings
    from polcap.batch import job_files, shards, unit

    if write_jobs is not None:
        found = batches.find(root, out)
        command = job_files.command(root, context.params)
        job = job_files.Job(command, root.resolve(), jobs or min(len(found), 1000), memory_gb=memory or 4.0)
        file = job_files.write(write_jobs, job, (out or root).resolve() / unit.FOLDER)
        terminal.tell(f"start it: {job_files.SUBMIT[write_jobs].format(file=file)}")
        terminal.say({"file": str(file), "shards": job.shards} if json else str(file))
        return
    order = unit.Order(
        settings=msgspec.to_builtins(settings.load(config, assignments or ())),
        chart=_chart(None if chart is None else str(chart), no_chart),
        estimator=estimator,
        model=None if model is None else str(model.resolve()),
        device=device,
        threads=threads,
        memory_gb=memory,
        angles_deg=_angles(angles),
    )
    part = shards.from_environment(os.environ) if shard is None else shards.parse(shard)
    how = batches.How(part, scheduler, workers, retries, keep_going)
    summary = batches.run(root, out, order, how, terminal.tell)
    terminal.say(summary if json else str((out or root) / unit.FOLDER / "summary.html"))
    if code := batches.exit_code(summary):
        raise typer.Exit(code)


@app.command()
@terminal.reported
def export(
    context: typer.Context,
    result: Result,
    gltf: Annotated[bool, typer.Option("--gltf", help="asset/NAME.glb")] = False,
    obj: Annotated[bool, typer.Option("--obj", help="asset/NAME.obj, .mtl and textures")] = False,
    usd: Annotated[bool, typer.Option("--usd", help="asset/NAME.usdc and textures (extra [usd])")] = False,
    materialx: Annotated[bool, typer.Option("--materialx", help="asset/NAME.mtlx and textures")] = False,
    exr: Annotated[bool, typer.Option("--exr", help="asset/NAME_layers.exr, every map as a layer")] = False,
    preset: Annotated[
        str | None, typer.Option(metavar="NAME", help="blender, unreal, unity, web or archive, into asset/NAME/.")
    ] = None,
    images: Annotated[
        Literal["png", "jpeg", "webp", "ktx2"] | None, typer.Option(help="Kind of the pictures in the GLB.")
    ] = None,
    color: Annotated[
        str, typer.Option(metavar="SPACE", help="Colour space or OCIO role of the EXR's colours, as ACEScg.")
    ] = "lin_rec709",
    texture_size: Annotated[
        int | None, typer.Option(min=16, max=16384, help="Px of the textures' longer side; by default the maps'.")
    ] = None,
    lod: Annotated[
        int, typer.Option(min=0, max=6, help="Further GLBs, each in a quarter of the triangles of the one before.")
    ] = 0,
    json: Json = False,
) -> None:
    """Write the asset again from the maps of a result; without a flag GLB and OBJ, as `process` does."""
    from polcap import pipeline
    from polcap.asset_export import Wanted
    from polcap.formats import presets

    flags = {"gltf": gltf, "obj": obj, "usd": usd, "materialx": materialx, "exr": exr}
    formats = tuple(name for name in presets.FORMATS if flags[name])
    if preset is not None and formats:
        raise SettingError(f"--preset {preset} brings its formats; leave out --{formats[0]}")
    wanted = Wanted(formats or ("gltf", "obj"), preset, images, color, texture_size, lod)
    written = [str(file) for file in pipeline.export(result, wanted)]
    terminal.say({"written": written} if json else "\n".join(written))


@app.command()
@terminal.reported
def show(
    context: typer.Context,
    result: Result,
    stage: Annotated[
        str | None, typer.Argument(help="hdr, whitebalance, align, mask, selfcal, stokes, cues, …")
    ] = None,
    all_: Annotated[bool, typer.Option("--all", help="Every stage.")] = False,
    animate: Annotated[
        Literal["light", "turntable"] | None,
        typer.Option(help="WebP, and MP4 where FFmpeg is present: a light that goes round, or the surface turned."),
    ] = None,
    json: Json = False,
) -> None:
    """Draw what a stage made; prints the picture's path, and on a terminal shows it."""
    from polcap import pipeline
    from polcap.path import STAGES

    if (stage is None) + (not all_) + (animate is None) != 2:
        raise SettingError(f"show {result}: give one of a stage ({', '.join(STAGES)}), --all or --animate")
    if animate is not None:
        drawn = pipeline.animate(result, animate)
    else:
        drawn = pipeline.show(result, STAGES if stage is None else (stage,))
    terminal.say({"written": [str(file) for file in drawn]} if json else "\n".join(map(str, drawn)))
    terminal.preview(drawn)


@app.command()
@terminal.reported
def status(context: typer.Context, result: Result, json: Json = False) -> None:
    """What a result folder holds, stage by stage; or how far a batch of captures is."""
    from polcap import store

    found = store.contents(result)
    if not found and (result / "polcap-batch").is_dir():
        from polcap import batch as batches

        about = batches.status(batches.reopen(result))
        terminal.say(about if json else batches.lines(about))
        return
    if not found:
        raise SettingError(f"{result} holds no stage cache; give the result folder of `polcap process`")
    rows = [{name: about[name] for name in ("stage", "version", "key", "seconds", "bytes")} for about in found]
    complete = (result / "report.json").exists()
    if json:
        terminal.say({"stages": rows, "complete": complete})
        return
    lines = [f"{r['stage']:14}{r['seconds']:8.2f} s {r['bytes'] / 1e6:9.2f} MB   {r['key'][:12]}" for r in rows]
    terminal.say("\n".join([*lines, "complete" if complete else "not complete: run `polcap process` to go on"]))


@app.command()
@terminal.reported
def report(
    context: typer.Context,
    result: Result,
    compare: Annotated[Path | None, typer.Option(metavar="OTHER", help="Another result folder.")] = None,
    json: Json = False,
) -> None:
    """Judge a result again from its stage cache, or show in which figures two results differ."""
    from polcap import report as reports

    if compare is not None:
        from polcap.report import compare as pairs

        abouts = reports.read(result), reports.read(compare)
        file = result / "compare.html"
        pairs.write(file, (result, compare), abouts)
        rows = pairs.rows(*abouts)
        named = [{"name": name, "here": here, "there": there} for name, here, there in rows]
        spoken = (pairs.spoken(row) for row in rows)
        terminal.say(named if json else "\n".join(f"{title}: {here}  |  {there}" for title, here, there in spoken))
        print(f"polcap: both side by side: {file}", file=sys.stderr)
        return
    from polcap import pipeline

    about = pipeline.judge_again(result)
    terminal.say(about if json else str(result / "report.html"))
    terminal.tell_gates(about)


@app.command()
@terminal.reported
def check(
    context: typer.Context,
    capture: Annotated[Path, typer.Argument(help="Folder with the photographs.")],
    config: Annotated[Path | None, typer.Option(help="TOML file of settings, a section per stage.")] = None,
    assignments: Annotated[
        list[str] | None, typer.Option("--set", metavar="K=V", help="A setting, as gates.max_blur_px=2; repeatable.")
    ] = None,
    angles: Annotated[
        str | None, typer.Option(metavar="DEG,…", help="Angles of the shots in order, as 0,45,90.")
    ] = None,
    chart: Annotated[
        str | None, typer.Option(metavar="X0,Y0,…|FILE", help="As given to process: the chart's corners, or a profile.")
    ] = None,
    no_chart: Annotated[bool, typer.Option("--no-chart", help="As given to process: there is no chart.")] = False,
    json: Json = False,
) -> None:
    """Keep a capture or reshoot it, and why: seconds after its last frame. Writes nothing."""
    from concurrent.futures import ThreadPoolExecutor

    from polcap import check as checks
    from polcap import config as settings
    from polcap import pipeline
    from polcap.formats import capture as captures

    chosen = settings.load(config, assignments or ())
    request = _chart(chart, no_chart)
    with ThreadPoolExecutor(1) as beside:  # the model loads while the headers are read
        network = beside.submit(pipeline.load_network, None, None, "cpu", 0)
        found = captures.read(capture, _angles(angles))
    verdict = checks.inspect(found, network.result(), chosen, pipeline.load_mask_network(), request)
    terminal.say(checks.shown(verdict) if json else checks.table(verdict))
    if not verdict.keep:
        raise typer.Exit(GateError.exit_code)


@app.command()
@terminal.reported
def doctor(
    context: typer.Context,
    ask_ports: Annotated[
        bool | None,
        typer.Option("--ports/--no-ports", help="Write to the serial ports to learn who answers; else you are asked."),
    ] = None,
    json: Json = False,
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE.RAW]", help="One photograph: can polcap use it, what does it tell?")
    ] = None,
) -> None:
    """What works on this machine, or with one photograph; what does not, and the remedy."""
    from polcap import doctor as doctors

    if file is not None:
        told = doctors.examine_file(file)
        terminal.say(doctors.shown(told) if json else doctors.table(told))
        if any(one.state == "fault" for one in told):
            raise typer.Exit(SettingError.exit_code)
        return
    from polcap.rig import camera_gphoto2, rotator, serial_port

    rig = doctors.Rig(
        serial_port.ports, functools.partial(_may_write, ask_ports), rotator.probe, camera_gphoto2.connected
    )
    found = doctors.examine(rig, Path.cwd())
    terminal.say(doctors.shown(found) if json else doctors.table(found))
    if any(one.state == "fault" for one in found):
        raise typer.Exit(SettingError.exit_code)


@app.command()
@terminal.reported
def synth(
    context: typer.Context,
    folder: Annotated[Path, typer.Argument(help="Folder to make; must be new or empty.")],
    scene: Annotated[Literal["bumps", "clusters", "vase"], typer.Option(help="What stands there.")] = "bumps",
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
        Literal["smooth", "rough"], typer.Option(help="Interface that light from inside the body leaves through.")
    ] = "smooth",
    dataset: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Make N samples of a data set instead (extra [train]); goes on."),
    ] = None,
) -> None:
    """Photograph an object that does not exist: RAW brackets, with the truth beside them."""
    from msgspec.structs import replace

    from polcap import config as settings
    from polcap.synth import scenes
    from polcap.synth import shooting as synthetic

    if dataset is not None:
        corpus = _extra("corpus")
        named = {"seed": seed, "mesh": str(mesh or ""), "material": str(material or ""), "law": law}
        corpus.main(folder, dataset, settings.fill(corpus.Recipe, named, assignments or ()))
        terminal.say(str(folder / "dataset.json"))
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
    terminal.say(str(folder))


@app.command()
@terminal.reported
def capture(
    context: typer.Context,
    folder: Annotated[Path, typer.Argument(help="Folder to shoot into; new, or begun with --resume.")],
    rotator: Annotated[
        str | None, typer.Option(metavar="URL", help="elliptec:PORT, grbl:PORT, line:PORT, manual or simulated.")
    ] = None,
    camera: Annotated[
        str | None, typer.Option(metavar="NAME", help="gphoto2, gphoto2:MODEL, folder:PATH or simulated.")
    ] = None,
    angles: Annotated[str | None, typer.Option(metavar="DEG,…", help="By default 0,45,90.")] = None,
    bracket: Annotated[
        str | None, typer.Option(metavar="1/200,1/50,…", help="Exposures; also as f/11, iso100, flash1/16.")
    ] = None,
    repeat: Annotated[
        str | None,
        typer.Option(metavar="DEG,…", help="Angles whose bracket is taken twice, to see the flash's spread."),
    ] = None,
    ambient: Annotated[bool, typer.Option("--ambient", help="Also frames without the flash.")] = False,
    chart: Annotated[bool, typer.Option("--chart", help="Also a frame of the chart alone.")] = False,
    tries: Annotated[int, typer.Option(min=0, help="How often a bad frame is taken again.")] = 2,
    resume: Annotated[bool, typer.Option("--resume", help="Go on: take what is missing.")] = False,
    no_check: Annotated[bool, typer.Option("--no-check", help="Leave out the verdict at the end.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan with its times, and stop.")] = False,
    json: Json = False,
) -> None:
    """Shoot a capture: turn the polarizer, take the bracket, check every frame as it lands."""
    from polcap.rig import camera as cameras
    from polcap.rig import plan, sequence

    stated = {
        "rotator": rotator,
        "camera": camera,
        "angles_deg": _angles(angles),
        "bracket": None if bracket is None else cameras.parse_bracket(bracket),
        "repeat_deg": None if repeat is None else _numbers("--repeat", repeat),
        "ambient": ambient or None,
        "chart": chart or None,
    }
    wanted = sequence.order(folder, stated, resume)
    if dry_run:
        planned = plan.dry_run(wanted)
        terminal.say(planned if json else plan.table(planned))
        return
    done = sequence.shoot(folder, wanted, resume=resume, tries=tries, tell=terminal.tell)
    verdict = None if no_check else _verdict(folder)
    terminal.say(done | {"check": verdict} if json else str(folder))
    if verdict and verdict["verdict"] != "keep":
        raise typer.Exit(GateError.exit_code)


def _verdict(folder: Path) -> dict[str, Any] | None:
    """What `polcap check` says of a capture, told on stderr; None where it cannot be judged."""
    from polcap import check as checks
    from polcap import pipeline
    from polcap.config import Config
    from polcap.formats import capture as captures

    try:
        networks = pipeline.load_network(None, None, "cpu", 0), pipeline.load_mask_network()
        verdict = checks.inspect(captures.read(folder), networks[0], Config(), networks[1])
    except InputError as error:
        terminal.tell(f"polcap: not judged: {terminal.line(error)}")
        return None
    terminal.tell(checks.table(verdict))
    return checks.shown(verdict)


@app.command()
@terminal.reported
def train(
    context: typer.Context,
    data: Annotated[Path, typer.Argument(help="Folder with meshes/ and materials/.")],
    out: Annotated[Path, typer.Option(help="Checkpoints and metrics.")] = Path("runs/train"),
    preset: Annotated[Literal["cpu", "gpu"], typer.Option(help="Size of the network and of a batch.")] = "cpu",
    minutes: Annotated[float, typer.Option(min=0.1, help="Training time, resumed parts together.")] = 90,
    samples: Annotated[int | None, typer.Option(min=1, help="Pictures to learn from, instead of minutes.")] = None,
    variant: Annotated[str, typer.Option(help="The network with one thing taken away, as the ablations.")] = "ours",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the last checkpoint.")] = False,
    start: Annotated[Path | None, typer.Option(metavar="ONNX", help="Begin with this model's weights.")] = None,
    threads: Annotated[int, typer.Option(min=1)] = 2,
    seed: Annotated[int, typer.Option(min=0)] = 1,
) -> None:
    """Train the network (extra [train])."""
    trainer = _extra("train")
    params = trainer.Params(
        preset=preset, data=data, out=out, minutes=minutes, samples=samples, variant=variant, resume=resume,
        start=start, threads=threads, seed=seed,
    )  # fmt: skip
    terminal.say(str(trainer.main(params)))


@app.command()
@terminal.reported
def evaluate(
    context: typer.Context,
    model: Annotated[Path, typer.Argument(help="ONNX model.")],
    data: Annotated[Path | None, typer.Argument(help="Folder with meshes/ and materials/.")] = None,
    out: Annotated[Path, typer.Option(help="Tables, picture panel and what is done so far.")] = Path("runs/evaluate"),
    ablations: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Networks to compare, DIR/NAME/last.pt of `polcap train`.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="50 pictures at 256² instead of 250 at 512².")] = False,
    count: Annotated[int | None, typer.Option(min=1, help="Pictures to judge.")] = None,
    size: Annotated[int | None, typer.Option(min=64, help="Their side, px.")] = None,
    protocol: Annotated[
        int, typer.Option(min=1, max=2, help="1: smooth bodies, high F0 as often as low; 2: rough bodies, F0 as met.")
    ] = 1,
    real: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Photographs with normals instead: pol000/ … mask/ normal/.")
    ] = None,
) -> None:
    """Score a model on test meshes and materials beside baselines and published figures (extra [train])."""
    if (data is None) == (real is None):
        raise SettingError("evaluate takes DATA, a folder with meshes/ and materials/, or --real DIR; give one of them")
    if real is not None:
        _extra("real").main(real, model, out)
        terminal.say(str(out / "real.md"))
        return
    judge, fixed = _extra("evaluate"), _extra("protocol")
    usual = (fixed.QUICK_COUNT, fixed.QUICK_SIZE) if quick else (fixed.COUNT, fixed.SIZE)
    judge.main(judge.Params(model, data, out, ablations, count or usual[0], size or usual[1], protocol))
    terminal.say(str(out / "evaluation.md"))


def _extra(module: str) -> Any:
    """A module of polcap.training; an error with the remedy where torch is not installed."""
    import importlib

    try:
        return importlib.import_module(f"polcap.training.{module}")
    except ModuleNotFoundError as error:
        raise SettingError(f"{error.name} is not installed; pip install 'polcap[train]'") from error


def _may_write(said: bool | None, ports: list[str]) -> bool:
    """Whether serial ports may be written to: a command for a rotator may mean something else to another device."""
    if said is not None or not sys.stdin.isatty():
        return bool(said)
    return typer.confirm(f"write to {', '.join(ports)} to learn who answers?", err=True)


def _use_threads(count: int) -> None:
    """Set the number of threads before any numerical library starts its own."""
    if count:
        for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
            os.environ[name] = str(count)
        import cv2

        cv2.setNumThreads(count)


def _limit_memory(gigabytes: float) -> None:
    """Beyond this much of its own memory (mapped files apart) the process fails at once, and says so."""
    if gigabytes:
        if not math.isfinite(gigabytes):
            raise SettingError(f"--memory {gigabytes}: give a number of GB, or leave it out")
        try:
            import resource
        except ImportError as error:
            raise SettingError(f"--memory {gigabytes:g}: this system knows no such limit; leave it out") from error
        size = int(gigabytes * 1e9)
        resource.setrlimit(resource.RLIMIT_DATA, (size, resource.getrlimit(resource.RLIMIT_DATA)[1]))


def _angles(text: str | None) -> tuple[float, ...] | None:
    return None if text is None else _numbers("--angles", text)


def _numbers(flag: str, text: str) -> tuple[float, ...]:
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise SettingError(f"{flag} {text}: not numbers separated by commas") from None
    if not all(map(math.isfinite, found)):
        raise SettingError(f"{flag} {text}: every number has to be finite")
    return found


def _chart(text: str | None, no_chart: bool) -> "ChartRequest":
    import numpy as np

    from polcap.formats import calib
    from polcap.images import ChartRequest

    if text is None:
        return ChartRequest("none" if no_chart else "auto")
    if no_chart:
        raise SettingError("--chart and --no-chart exclude each other; leave one out")
    if Path(text).suffix == ".toml":
        return ChartRequest("profile", profile=calib.read_profile(Path(text)))
    corners = _numbers("--chart", text)
    if len(corners) != 8:
        raise SettingError(f"--chart gives {len(corners)} numbers; four corners have 8, a profile ends in .toml")
    return ChartRequest("corners", corners=np.reshape(corners, (4, 2)))


def _mask(file: Path) -> Any:
    from polcap.formats import png

    picture = png.read(file)
    half = 128 if picture.dtype.itemsize == 1 else 32768
    return (picture if picture.ndim == 2 else picture[..., :3].max(-1)) >= half


def _print_plan(found: "Capture", stages: dict[str, str], json: bool) -> None:
    from polcap import report as reports
    from polcap.formats import capture as captures

    if json:
        terminal.say({"capture": reports.capture_facts(found), "stages": stages})
        return
    terminal.say("\n".join([captures.table(found), "", *(f"{name:14}{state}" for name, state in stages.items())]))
