"""`polcap train` and `polcap evaluate`: the commands of the extra [train]."""

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from polcap import terminal
from polcap.cli import options
from polcap.cli.options import choice
from polcap.errors import SettingError


def train(
    data: Annotated[Path, Argument(help="Folder with meshes/ and materials/.")],
    out: Annotated[Path, Option("--out", "-o", help="Checkpoints and metrics.")] = Path("runs/train"),
    preset: Annotated[Literal["cpu", "gpu"], choice("Size of the network and of a batch.")] = "cpu",
    minutes: Annotated[float, Option(min=0.1, help="Training time, resumed parts included.")] = 90,
    samples: Annotated[int | None, Option(min=1, help="Pictures to learn from, instead of minutes.")] = None,
    variant: Annotated[
        str, Option(help="Leave one thing out, such as 'plain skips'; an unknown name lists all.")
    ] = "ours",
    ablation: Annotated[
        bool,
        Option("--ablation", help="Train every variant, one after the other, and write the table of their errors."),
    ] = False,
    resume: Annotated[bool, Option("--resume", help="Go on from the last checkpoint.")] = False,
    start: Annotated[Path | None, Option(metavar="ONNX", help="Begin with this model's weights.")] = None,
    done: Annotated[
        int, Option(min=0, help="Pictures of --samples that --start has seen; sets the learning rate.")
    ] = 0,
    rate: Annotated[float, Option(min=0, help="Learning rate of Muon; lower for trained weights.")] = 1e-3,
    views: Annotated[
        int | None, Option(min=1, help="Views of each mesh; cpu 80, gpu 400. A view takes 0.8 or 1.4 MB.")
    ] = None,
    procedural: Annotated[int | None, Option(min=0, help="Random shapes, six views each; cpu 1200, gpu 3000.")] = None,
    flat: Annotated[
        int | None, Option(min=0, help="Flat, sharp-edged shapes, six views each; cpu 600, gpu 1500.")
    ] = None,
    threads: Annotated[int, Option("--threads", "-j", min=1, help="Batches computed at a time.")] = 2,
    seed: Annotated[int, Option(min=0, help="Of views, batches and first weights.")] = 1,
    license_: Annotated[
        str, Option("--license", metavar="SPDX", help="License of the weights, stated in the model, such as CC-BY-4.0.")
    ] = "NOASSERTION",
) -> None:
    """Train the main network (extra [train])."""
    options.check_out(out)
    terminal.print_progress("loading PyTorch, meshes and materials")
    trainer = options.training("train")
    run = options.training("ablation_study").main if ablation else trainer.main
    stated = {"preset": preset, "data": data, "out": out, "minutes": minutes, "samples": samples, "variant": variant}
    stated |= {"resume": resume, "start": start, "done": done, "rate": rate, "views": views}
    stated |= {"procedural": procedural, "flat": flat, "threads": threads, "seed": seed, "licence": license_}
    terminal.print_data(str(run(trainer.TrainingOptions(**stated), terminal.print_progress)))


def evaluate(
    model: Annotated[Path, Argument(help="ONNX model.")],
    data: Annotated[Path | None, Argument(help="Folder with meshes/ and materials/.")] = None,
    out: Annotated[Path, Option("--out", "-o", help="Tables and pictures; a stopped evaluation goes on.")] = Path(
        "runs/evaluate"
    ),
    ablations: Annotated[
        Path | None, Option(metavar="DIR", help="Networks to compare, DIR/NAME/last.pt of `polcap train`.")
    ] = None,
    quick: Annotated[bool, Option("--quick", help="50 pictures at 256² instead of 250 at 512².")] = False,
    count: Annotated[int | None, Option(min=1, help="Number of pictures.")] = None,
    size: Annotated[int | None, Option(min=64, help="Side of the pictures, px.")] = None,
    protocol: Annotated[
        int,
        Option(min=1, max=2, help="1: smooth surfaces, high F0 in half of the materials; 2: rough surfaces, usual F0."),
    ] = 1,
    real: Annotated[
        Path | None, Option(metavar="DIR", help="Photographs with normals instead: pol000/ … mask/ normal/.")
    ] = None,
) -> None:
    """Score a model on test meshes and materials (extra [train]), or on photographs with --real (without the extra)."""
    options.check_out(out)
    if (data is None) == (real is None):
        raise SettingError(
            "write evaluate MODEL DATA, with meshes/ and materials/ in DATA, or evaluate MODEL --real DIR"
        )
    if real is not None:
        options.training("evaluation_photographs").main(real, model, out, terminal.print_progress)
        terminal.print_data(str(out / "real.md"))
        return
    evaluation, defaults = options.training("evaluate"), options.training("evaluation_protocol")
    usual = (defaults.QUICK_COUNT, defaults.QUICK_SIZE) if quick else (defaults.COUNT, defaults.SIZE)
    stated = evaluation.EvaluationOptions(model, data, out, ablations, count or usual[0], size or usual[1], protocol)
    evaluation.main(stated, terminal.print_progress)
    terminal.print_data(str(out / "evaluation.md"))
