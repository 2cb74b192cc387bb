"""Statistics of images, ours beside real ones: ``python benchmarks/looks.py DATASET [--real DIR] [--out PNG]``.

Of each frame, levels of 255: mean and spread of the brightness (the brightest channel), mean saturation, of the whole
and of instruments and background apart, strength of the gradients of grey, and contrast at the mask's edge. A folder of
real frames has ``images/*.png`` and ``masks/*.png`` of the same names, white being instrument. The picture shows ours,
and of the real ones no more than their statistics.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench import open_dataset
from surgbench.tasks.instrument.dataset import InstrumentDataset

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
EDGE_PX = 5
HISTOGRAMS = ("brightness", "saturation", "gradient")
LEVELS = {"brightness": 256, "saturation": 256, "gradient": 40}


def planes(image: Image) -> dict[str, NDArray[np.float64]]:
    """Brightness, saturation and gradient strength at every pixel of an RGB image."""
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV).astype(np.float64)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    across, down = cv2.Sobel(grey, -1, 1, 0) / 8.0, cv2.Sobel(grey, -1, 0, 1) / 8.0
    return {"brightness": hsv[..., 2], "saturation": hsv[..., 1], "gradient": np.hypot(across, down), "grey": grey}


def edge_contrast(grey: NDArray[np.float64], mask: Mask) -> float:
    """Difference between the means of grey on both sides of the mask's edge, in the mean over its length."""
    size = (2 * EDGE_PX + 1, 2 * EDGE_PX + 1)
    inside = mask.astype(np.float64)
    shares = cv2.blur(inside, size), cv2.blur(1.0 - inside, size)
    means = cv2.blur(grey * inside, size), cv2.blur(grey * (1.0 - inside), size)
    edge = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & ~mask
    edge &= (shares[0] > 0.1) & (shares[1] > 0.1)
    return float(np.abs(means[0][edge] / shares[0][edge] - means[1][edge] / shares[1][edge]).mean())


def statistics(image: Image, mask: Mask) -> dict[str, float]:
    """All statistics of one frame."""
    of = planes(image)
    return {
        "brightness": float(of["brightness"].mean()),
        "brightness spread": float(of["brightness"].std()),
        "brightness of instruments": float(of["brightness"][mask].mean()),
        "saturation": float(of["saturation"].mean()),
        "saturation of instruments": float(of["saturation"][mask].mean()),
        "saturation of background": float(of["saturation"][~mask].mean()),
        "gradient": float(of["gradient"].mean()),
        "gradient of instruments": float(of["gradient"][mask].mean()),
        "gradient, 99th of 100": float(np.percentile(of["gradient"], 99)),
        "edge contrast": edge_contrast(of["grey"], mask),
    }


def of_dataset(dataset: InstrumentDataset, every: int) -> list[tuple[Image, Mask]]:
    """Images and masks of every so many frames of all sequences."""
    frames = []
    for sequence in dataset.sequences:
        for frame in range(0, sequence.frames, every):
            image = sequence.image(frame)
            if image is None:
                raise SystemExit(f"{dataset.path}: sequence '{sequence.id}' has no images")
            frames.append((image, sequence.clean_mask("both", frame)))
    return frames


def of_folder(folder: Path) -> list[tuple[Image, Mask]]:
    """Images and masks of a folder of real frames."""
    frames = []
    for path in sorted((folder / "images").glob("*.png")):
        image, mask = cv2.imread(str(path)), cv2.imread(str(folder / "masks" / path.name), cv2.IMREAD_GRAYSCALE)
        if image is None or mask is None:
            raise SystemExit(f"{path}: no image with a mask of the same name")
        frames.append((np.asarray(image[..., ::-1], np.uint8).copy(), np.asarray(mask > 127)))
    return frames


def histograms(frames: list[tuple[Image, Mask]]) -> dict[str, NDArray[np.float64]]:
    """``(frames, levels)`` share of the pixels at each level, by name."""
    found: dict[str, list[NDArray[np.float64]]] = {name: [] for name in HISTOGRAMS}
    for image, _ in frames:
        of = planes(image)
        for name in HISTOGRAMS:
            counts, _ = np.histogram(of[name], bins=64, range=(0, LEVELS[name]))
            found[name].append(counts / of[name].size)
    return {name: np.array(rows) for name, rows in found.items()}


def draw(ours: list[tuple[Image, Mask]], real: list[tuple[Image, Mask]], out: Path) -> None:
    """Our images, and the histograms of both: the range over the real frames as a band, ours as lines."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    shown = [ours[index] for index in np.linspace(0, len(ours) - 1, 3).astype(int)]
    figure, axes = plt.subplots(2, 3, figsize=(12, 6.4), gridspec_kw={"height_ratios": [1.45, 1]})
    for axis, (image, _) in zip(axes[0], shown, strict=True):
        axis.imshow(image)
        axis.axis("off")
    own, others = histograms(ours), histograms(real) if real else None
    for axis, name in zip(axes[1], HISTOGRAMS, strict=True):
        levels = (np.arange(64) + 0.5) * LEVELS[name] / 64
        if others is not None:
            axis.fill_between(levels, others[name].min(0), others[name].max(0), color="0.75", label="real, range")
        axis.fill_between(levels, *np.quantile(own[name], [0.1, 0.9], axis=0), color="tab:red", alpha=0.25)
        axis.plot(levels, own[name].mean(0), color="tab:red", label="ours, mean and 80 %")
        axis.set(title=name, yticks=[], xlim=(0, LEVELS[name]))
    axes[1][0].legend(frameon=False, fontsize=8)
    figure.tight_layout()
    figure.savefig(out, dpi=80)


def main() -> None:
    """Print the statistics, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--real", type=Path, help="folder with images/ and masks/")
    parser.add_argument("--every", type=int, default=10, help="look at every so many frames")
    parser.add_argument("--out", type=Path, help="picture to draw")
    arguments = parser.parse_args()
    dataset = open_dataset(arguments.dataset)
    if not isinstance(dataset, InstrumentDataset):
        raise SystemExit(f"{arguments.dataset}: no dataset of the instrument task")
    ours = of_dataset(dataset, arguments.every)
    real = of_folder(arguments.real) if arguments.real else []
    own, others = ([statistics(*frame) for frame in frames] for frames in (ours, real))
    print(f"{'':28}{'ours: mean':>12}{'least':>8}{'most':>8}{'real: least':>14}{'most':>8}")
    for name in own[0]:
        values = np.array([one[name] for one in own])
        line = f"{name:28}{values.mean():12.2f}{values.min():8.2f}{values.max():8.2f}"
        if others:
            low, high = min(one[name] for one in others), max(one[name] for one in others)
            inside = "" if low <= values.mean() <= high else "   outside"
            line += f"{low:14.2f}{high:8.2f}{inside}"
        print(line)
    if arguments.out is not None:
        draw(ours, real, arguments.out)
        print(f"{arguments.out} written")


if __name__ == "__main__":
    main()
