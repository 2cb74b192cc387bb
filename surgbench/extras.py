"""What the extras install: packages that only parts of this one need, named where they are missed."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec

# Names of modules by the extra of pyproject.toml that installs them.
EXTRAS = {
    "meshes": ("pymeshlab",),
    "turbo": ("botorch", "gpytorch"),
    "onnx": ("onnx", "onnxruntime"),
    "plots": ("matplotlib",),
    "video": ("av",),
    "sam2": ("transformers", "huggingface_hub"),
    "control": ("clarabel", "daqp"),
    "bags": ("rosbags",),
    "gym": ("gymnasium",),
    "cluster": ("distributed",),
    "view": ("rerun",),
    "browser": ("playwright",),
    "notebooks": ("ipykernel", "nbclient", "nbformat"),
    "docs": ("mkdocs", "mkdocstrings"),
    "readers": ("evo", "mlcroissant", "pycocotools"),
    "bench": ("embreex", "moderngl", "open3d"),
}
# Distributions that are not called as their modules are.
_DISTRIBUTIONS = {"cv2": "opencv-python-headless", "yaml": "PyYAML", "PIL": "pillow", "skimage": "scikit-image"}


def install(module: str) -> str:
    """What to type for a module that is missing."""
    top = module.partition(".")[0]
    extra = next((extra for extra, modules in EXTRAS.items() if top in modules), None)
    return f"pip install {_DISTRIBUTIONS.get(top, top)}" if extra is None else f"pip install 'surgbench[{extra}]'"


def missing(modules: Iterable[str]) -> str | None:
    """One line on which modules are not installed, and what installs them; ``None`` where all are there."""
    lacking = [module for module in modules if find_spec(module) is None]
    return not_installed(lacking) if lacking else None


def not_installed(modules: Iterable[str]) -> str:
    """The same of modules that are known to be missing, one at least."""
    names = list(modules)
    ways = " and ".join(dict.fromkeys(map(install, names)))
    return f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} not installed: {ways}"
