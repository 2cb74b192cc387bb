"""``surgbench train``."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

train_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@train_app.callback()
def _train() -> None:
    """Train what learns from synthetic data.

    Example: surgbench train keypoints --out models/mine
    """


@train_app.command("keypoints")
def keypoints(
    training: Annotated[
        str, typer.Argument(metavar="NAME|FILE.yaml", help="A training file: surgbench list training.")
    ] = "resnet18",
    out: Annotated[
        Path, typer.Option(help="The model's folder: new, or that of an interrupted training of the same settings.")
    ] = Path("model"),
    start: Annotated[
        Path | None,
        typer.Option(metavar="FILE.safetensors", help="Begin with the weights of this model, of the same size."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Instead of the file's.")] = None,
    masks: Annotated[int | None, typer.Option(min=1, help="How many are learnt, instead of the file's.")] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="At most so many passes, instead of the file's.")] = None,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="Where the network is trained.")] = "cpu",
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes that make masks; all cores unless told.")] = None,
) -> None:
    """Train the network of the keypoint source `resnet18` on masks that are made for it.

    Example: surgbench train keypoints resnet18 --out models/mine --masks 20000

    Use the result with --keypoints resnet18 --set resnet18.model=models/mine/weights.safetensors. The best weights and
    the log of losses and accuracies are written after every epoch, the log's picture and the accuracy at the end; after
    an interruption the same command goes on where it stopped.
    """
    from surgbench.cli.training import load_training, train

    settings = load_training(training, seed, masks, epochs)
    _train_in(out, device, lambda say: train(settings, out, start, device, _jobs(jobs), say))


@train_app.command("masks")
def masks(
    training: Annotated[
        str, typer.Argument(metavar="NAME|FILE.yaml", help="A training file: surgbench list training.")
    ] = "masks",
    out: Annotated[
        Path, typer.Option(help="The model's folder: new, or that of an interrupted training of the same settings.")
    ] = Path("model"),
    start: Annotated[
        Path | None,
        typer.Option(metavar="FILE.safetensors", help="Begin with the weights of this model, of the same size."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Instead of the file's.")] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="At most so many passes, instead of the file's.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Any key of the file, for example looks.recolour=0.2; may be repeated."
        ),
    ] = None,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="Where the network is trained.")] = "cpu",
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes that make images; all cores unless told.")] = None,
) -> None:
    """Train the network of the mask source `learned` on images that are made for it, or on your own.

    Example: surgbench train masks --out models/mine

    Use the result with --masks learned --set learned.model=models/mine/weights.safetensors. The images are made in the
    model's folder, under data, which may be removed afterwards. The best weights and the log of losses and accuracies
    are written after every epoch, the log's picture and the accuracy at the end; after an interruption the same command
    goes on where it stopped.
    """
    from surgbench.cli.training_masks import load_training, train
    from surgbench.generation import parse_settings

    changes = {**parse_settings(set_ or []), "seed": seed, "training.epochs": epochs}
    settings = load_training(training, {key: value for key, value in changes.items() if value is not None})
    _train_in(out, device, lambda say: train(settings, out, start, device, _jobs(jobs), say))


def _jobs(told: int | None) -> int:
    return told or len(os.sched_getaffinity(0))


def _train_in(out: Path, device: str, train: Callable[[Callable[[str], None]], Mapping[str, Any]]) -> None:
    """Train in a folder that nobody else writes to, and tell the accuracy and where the weights are."""
    from surgbench.locks import sole_writer
    from surgbench.silhouette.torch_evaluator import check_device

    if device != "cpu":
        check_device(device)

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    with sole_writer(out, "train"):
        found = train(say)
    for key, value in found.items():
        print(f"{key}: {value}")
    print(out / "weights.safetensors")
