"""`polcap show`, `status`, `report` and `clean`: commands on a result folder."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from polcap import terminal
from polcap.cli import options
from polcap.cli.options import Json, Result
from polcap.errors import SettingError
from polcap.formats import own_folders
from polcap.results import STAGES


def show(
    result: Result,
    stage: Annotated[str | None, Argument(help=f"One of {', '.join(STAGES)}.")] = None,
    all_: Annotated[bool, Option("--all", help="Every stage.")] = False,
    animate: Annotated[
        Literal["light", "turntable"] | None,
        Option(
            case_sensitive=False, help="WebP, and MP4 where FFmpeg is present: a moving light, or the turning surface."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Draw a stage's result and print the picture's path."""
    from polcap.pipeline import run as pipeline

    _check_single(result, "show")
    if (stage is None) + (not all_) + (animate is None) != 2:  # two of three are left out
        raise SettingError(f"show {result}: give one of a stage ({', '.join(STAGES)}), --all or --animate")
    if animate is not None:
        drawn = pipeline.animate(result, animate)
    else:
        drawn = pipeline.show(result, STAGES if stage is None else (stage,))
    terminal.print_written(drawn, json)


def status(result: Result, json: Json = False) -> None:
    """List the stored stages of a result folder, or the progress of a batch."""
    from polcap.pipeline import manifest

    if not result.is_dir():
        raise SettingError(f"{result}: no such folder; give the result folder of `polcap process`, or that of a batch")
    found = manifest.contents(result)
    if found:
        rows = [{name: about[name] for name in ("stage", "version", "key", "seconds", "bytes")} for about in found]
        complete = (result / "report.json").exists()
        lines = [f"{r['stage']:14}{r['seconds']:8.2f} s {r['bytes'] / 1e6:9.2f} MB   {r['key'][:12]}" for r in rows]
        lines.append("complete" if complete else "not complete: run `polcap process` to go on")
        terminal.print_data({"stages": rows, "complete": complete} if json else "\n".join(lines))
    elif (result / own_folders.BATCH).is_dir():
        from polcap import batch as batches

        about = batches.status(batches.reopen(result))
        terminal.print_data(about if json else batches.table(about))
    else:
        from polcap.pipeline import run_facts

        raise run_facts.no_cache(result)


def report(
    result: Result,
    compare: Annotated[
        Path | None, Option(metavar="OTHER", help="Another result folder.", callback=options.result_folder)
    ] = None,
    out: Annotated[
        Path | None, Option("--out", "-o", metavar="DIR", help="Folder for compare.html; by default RESULT.")
    ] = None,
    json: Json = False,
    open_: options.OpenPage = False,
) -> None:
    """Judge a result again from its stage cache, or compare it with another."""
    if compare is not None:
        options.check_out(out)
        _compare((result, compare), out or result, json, open_)
        return
    if out is not None:
        raise SettingError("--out is the folder of the comparison; add --compare OTHER, or leave it out")
    from polcap.pipeline import run as pipeline

    _check_single(result, "report")
    about = pipeline.judge_again(result)
    terminal.print_data(about if json else str(result / "report.html"))
    if open_:
        terminal.open_page(result / "report.html")
    terminal.print_gates(about)


def _compare(results: tuple[Path, Path], out: Path, json: bool, open_: bool) -> None:
    """Write compare.html, the page on two results, into the folder `out`, and print what changed on the object."""
    from polcap import report as reports
    from polcap.pipeline import result_folder
    from polcap.report import compare as pairs

    for result in results:
        options.warn_of_altered_archive(result)
    contents = reports.read(results[0]), reports.read(results[1])
    file = out / "compare.html"
    with result_folder.opened(out):
        sentence, table = pairs.write(file, results, contents)
    rows = pairs.rows(*contents)
    if json:
        named = [dict(zip(("quantity", *pairs.HEAD[1:]), row)) for row in table]
        differing = [{"name": name, "here": here, "there": there} for name, here, there in rows]
        terminal.print_data({"sentence": sentence, "changes": named, "differences": differing})
    else:
        lines = ["".join(cell.ljust(18) for cell in row).rstrip() for row in (pairs.HEAD, *table) if table]
        terminal.print_data("\n".join([sentence, *lines]))
    terminal.print_message(f"polcap: figures and settings that differ: {len(rows)}; comparison: {file}")
    if open_:
        terminal.open_page(file)


def clean(
    result: Annotated[
        Path, Argument(help="Result folder, its capture, or the folder of a batch.", callback=options.result_folder)
    ],
    dry_run: Annotated[bool, Option("--dry-run", "-n", help="Print the size, and remove nothing.")] = False,
    json: Json = False,
) -> None:
    """Remove the stage cache `work/` of a result, or of all results of a batch; photographs, maps and assets stay."""
    from polcap.pipeline import clean_cache

    removed = {str(folder / "work"): clean_cache.clean(folder, dry_run) for folder in _results(result)}
    total = sum(removed.values())
    rows = [f"{size / 1e6:9.2f} MB  {work}" for work, size in removed.items()]
    terminal.print_data({"removed": removed, "bytes": total, "dry_run": dry_run} if json else "\n".join(rows))
    terminal.print_progress(f"{total / 1e6:.1f} MB {'would be free' if dry_run else 'are free'}")


def _check_single(result: Path, command: str) -> None:
    """Raise a SettingError for the result of `polcap fuse` or `polcap material`, which have other stages."""
    from polcap.fusion import fused_maps
    from polcap.material import material_maps

    if fused_maps.is_fused(result):
        raise SettingError(
            f"`polcap {command}` is for results of one view, and {result} is a fused object: see its report.html and "
            "asset/turntable.webp, or give one of its views"
        )
    if material_maps.is_material(result):
        raise SettingError(
            f"`polcap {command}` is for results of one view, and {result} is a material: see its report.html, or give "
            "one of its views"
        )


def _results(named: Path) -> Iterator[Path]:
    """The result folder that was named, or the results of a batch, finished or begun, inside its folder."""
    if not (named / own_folders.BATCH).is_dir() or (named / "work").is_dir():
        yield named
        return
    from polcap import batch as batches
    from polcap.formats import own_files

    for unit in batches.reopen(named):
        if not Path(unit.out).resolve().is_relative_to(named.resolve()):
            terminal.print_message(f"polcap: {unit.out} lies outside {named} and stays; clean it by its own name")
        elif (Path(unit.out) / "work").is_dir() and own_files.is_claimed(Path(unit.out)):
            yield Path(unit.out)
