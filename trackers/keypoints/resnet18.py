"""The tips as a trained ResNet-18 sees them in the mask: the heatmap network of Hu et al. 2026, ours."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from surgbench.config import Section
from surgbench.contract import Observation, Plugin, Scene, View
from surgbench.extras import missing
from surgbench.files import sha256_file
from surgbench.geometry import FloatArray
from surgbench.trackers.keypoints.pairs import ArmTips

if TYPE_CHECKING:
    from surgbench.trackers.keypoints.heatmaps.detector import TipDetector

MODELS = Path(__file__).parent / "models"
HASH_DIGITS = 16
ONNX_PACKAGES = ("onnx", "onnxruntime")


class ResNet18Keypoints(Plugin):
    """Two peaks of a heatmap for each arm's mask, or one where only one stands out."""

    name: ClassVar[str] = "resnet18"
    summary: ClassVar[str] = "a trained network (ResNet-18, heatmaps) finds the tips in the mask"

    class Config(Section):
        """Options."""

        model: Annotated[str, Field(description="a model that comes with the package, or a FILE.safetensors")] = (
            "resnet18"
        )
        model_sha256: Annotated[str, Field(description="start of the file's hash; found unless told, and checked")] = ""
        least_heat: Annotated[float, Field(gt=0, lt=1, description="what a peak must reach to stand out")] = 0.36
        apart_px: Annotated[int, Field(ge=1, le=64, description="nearer peaks in the network's picture are one")] = 2
        peaks: Annotated[
            Literal["two", "top"], Field(description="a pair of exactly two peaks, or of the hottest two of more, too")
        ] = "two"
        single_heat: Annotated[
            float, Field(gt=0, le=1, description="what a peak that stands out alone must exceed to be a tip; 1: never")
        ] = 0.5
        engine: Annotated[
            Literal["auto", "torch", "onnxruntime"],
            Field(description="what works the network out on a CPU; auto: onnxruntime where it is installed"),
        ] = "auto"

        @model_validator(mode="after")
        def _find_model(self) -> ResNet18Keypoints.Config:
            # The hash is an option, so that a record says which weights it was made with.
            found = sha256_file(self.path)
            if not found.startswith(self.model_sha256):
                raise ValueError(f"{self.path} has changed: its hash is {found}, not {self.model_sha256}…")
            self.__dict__["model_sha256"] = found[:HASH_DIGITS]
            return self

        @model_validator(mode="after")
        def _find_engine(self) -> ResNet18Keypoints.Config:
            lacking = missing(ONNX_PACKAGES)
            if self.engine == "onnxruntime" and lacking is not None:
                raise ValueError(f"engine onnxruntime: {lacking}")
            if self.engine == "auto":
                self.__dict__["engine"] = "torch" if lacking else "onnxruntime"
            return self

        @property
        def path(self) -> Path:
            """The model's file.

            Raises:
                ValueError: There is no such model.
            """
            named = MODELS / self.model / "weights.safetensors"
            path = named if named.is_file() else Path(self.model)
            if not path.is_file():
                names = ", ".join(sorted(folder.name for folder in MODELS.iterdir() if folder.is_dir()))
                raise ValueError(f"no model '{self.model}' (valid: {names}; or a FILE.safetensors)")
            return path

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        self._detector: TipDetector | None = None
        self._device = "cpu"

    @classmethod
    def unavailable(cls) -> str | None:
        """What this machine lacks, or ``None``."""
        return missing(("torch", "safetensors"))

    def reset(self, scene: Scene) -> None:
        """Load the network, and ask it once, so that no frame pays for that."""
        from surgbench.trackers.keypoints.heatmaps.detector import TipDetector
        from surgbench.trackers.keypoints.heatmaps.model import load_network

        config = self.config
        self._arms = ArmTips(scene)
        if self._detector is None or scene.device != self._device:
            network, settings = load_network(config.path)
            self._device = scene.device
            self._detector = TipDetector(
                network,
                settings,
                config.least_heat,
                config.apart_px,
                self._device,
                engine="onnxruntime" if config.engine == "onnxruntime" else "torch",
                peaks=config.peaks,
                single_heat=config.single_heat,
            )
            self._detector.warm_up()

    def detect(self, observation: Observation, view: View) -> tuple[FloatArray | None, ...]:
        """Two tips per arm, or one; ``None`` where there is none, and for both where the arms cannot be told apart."""
        assert self._detector is not None, "reset comes first"
        return self._arms.find(observation, view, self._detector.detect)
