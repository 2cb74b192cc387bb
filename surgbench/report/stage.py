"""Where things are put to be looked at over time: a recording of Rerun, in a file or in its viewer. Extra ``view``.

Rerun counts pixels from the picture's corner, so that their centres are at half numbers. Here they are at whole ones,
and half a pixel is added to whatever is put in a picture.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.dataset.base import Dataset
from surgbench.errors import SurgbenchError
from surgbench.extras import missing
from surgbench.files import PARTIAL_SUFFIX
from surgbench.geometry import FloatArray
from surgbench.locks import in_use, locked_beside
from surgbench.records.format import Record
from surgbench.report.drawing import REFERENCE_COLOUR, Colour

# The timelines.
FRAME, SECONDS = "frame", "seconds"
ENDING = ".rrd"
CORNER_PX = 0.5
# Of masks in pictures: how they are drawn, and what is seen through them.
MASK_CLASS, MASK_OPACITY = 1, 0.35
CONTOUR_PX = 0.75

MOST_NAMED = 8
VIEWER_MEMORY = "75%"


@dataclass(frozen=True)
class Subject:
    """What is to be looked at: units of a dataset, or runs on them.

    Attributes:
        dataset: The dataset; ``None`` where runs are.
        records: The runs; empty where a dataset is.
        moved: Where the dataset of the runs is, if not where their records say.
        units: Ids; none for the first.
        rows: Row ids; none for all.
        every: Every so many frames have pictures.
    """

    dataset: Dataset[Any] | None = None
    records: tuple[Record, ...] = ()
    moved: Path | None = None
    units: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()
    every: int = 1


def others(names: Sequence[str], shown: Sequence[str], subject: Subject) -> list[str]:
    """A line on the units that are not shown, where nobody chose.

    Args:
        names: Of all units.
        shown: Of those that are.
        subject: What was asked for.
    """
    rest = [name for name in names if name not in shown]
    if subject.units or not rest:
        return []
    listed = f"{', '.join(rest[:MOST_NAMED])}{', ...' if len(rest) > MOST_NAMED else ''}"
    return [f"shown is {', '.join(shown)}; with --unit: {listed}"]


class Stage:
    """A recording under way. Paths are sequences of names, which may be any text.

    Args:
        name: Shown over it.

    Raises:
        SurgbenchError: Rerun is not installed.
    """

    def __init__(self, name: str) -> None:
        lacking = missing(["rerun"])
        if lacking is not None:
            raise SurgbenchError(lacking)
        import rerun
        import rerun.blueprint as blueprint

        self.rr, self._blueprint = rerun, blueprint
        # A mistake here is no warning that scrolls by.
        rerun.set_strict_mode(True)
        self.recording: Any = rerun.RecordingStream("surgbench", recording_id=None)
        if hasattr(rerun, "set_log_time_enabled"):  # later than 0.26
            rerun.set_log_time_enabled(False, self.recording)
        self.recording.send_recording_name(name)
        self._views: list[Any] = []

    # where it goes

    @contextmanager
    def written(self, out: Path) -> Iterator[None]:
        """What is put here within the block goes into a file, which is there whole or not at all.

        Raises:
            SurgbenchError: It cannot be written, or another command is at it.
        """
        partial = out.with_name(f"{out.stem}.{os.getpid()}{PARTIAL_SUFFIX}{ENDING}")
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            with locked_beside(out) as ours:
                if not ours:
                    raise in_use(out, "view")
                try:
                    self.recording.save(partial)
                    yield
                    self._end()
                    partial.replace(out)
                finally:
                    self.recording.disconnect()
                    partial.unlink(missing_ok=True)
        except OSError as error:
            raise SurgbenchError(f"{out}: cannot be written ({error.strerror})") from None
        except RuntimeError as error:  # of Rerun, which says so for whatever its writer meets
            raise SurgbenchError(f"{out}: cannot be written ({error})") from None

    @contextmanager
    def watched(self) -> Iterator[None]:
        """What is put here within the block is shown in the viewer, which is started and stays.

        Raises:
            SurgbenchError: It does not start.
        """
        try:
            self.recording.spawn(memory_limit=VIEWER_MEMORY, hide_welcome_screen=True)
        except (OSError, RuntimeError) as error:
            raise SurgbenchError(f"the viewer does not start ({error}); write a file: --out FILE{ENDING}") from None
        yield
        self._end()
        self.recording.disconnect()

    def _end(self) -> None:
        """Say how it is to be shown, and send what is left."""
        layout = self._blueprint
        spaces = [view for view in self._views if not isinstance(view, layout.TimeSeriesView)]
        plots = [view for view in self._views if isinstance(view, layout.TimeSeriesView)]
        parts = [layout.Horizontal(*spaces)]
        if plots:
            parts.append(layout.Grid(*plots))
        whole = layout.Blueprint(layout.Vertical(*parts, row_shares=[3, 2][: len(parts)]), collapse_panels=True)
        self.recording.send_blueprint(whole)
        self.recording.flush()

    # how it is shown

    def space(self, root: Sequence[object], name: str) -> None:
        """Show what lies below a path in space."""
        self._views.append(self._blueprint.Spatial3DView(origin=self.path(root), name=name))

    def picture(self, root: Sequence[object], name: str, seen: Sequence[Sequence[object]] = ()) -> None:
        """Show what lies below a camera's path as its picture, with bodies in space as it sees them.

        Args:
            root: The camera's.
            name: Title.
            seen: Paths of the bodies.
        """
        origin = self.path(root)
        contents = [f"{path}/**" for path in (origin, *map(self.path, seen))]
        self._views.append(self._blueprint.Spatial2DView(origin=origin, contents=contents, name=name))

    def curves(self, root: Sequence[object], name: str) -> None:
        """Show the numbers below a path over time."""
        self._views.append(self._blueprint.TimeSeriesView(origin=self.path(root), name=name))

    # what is put in it

    def path(self, names: Sequence[object]) -> str:
        """Names as Rerun writes a path."""
        path: str = self.rr.new_entity_path(list(names))
        return path

    def put(self, names: Sequence[object], thing: Any) -> None:
        """What is there at all times."""
        self.recording.log(self.path(names), thing, static=True)

    def at(self, frame: int, seconds: float) -> None:
        """When what :meth:`show` takes is so."""
        self.recording.set_time(FRAME, sequence=frame)
        self.recording.set_time(SECONDS, duration=seconds)

    def show(self, names: Sequence[object], thing: Any) -> None:
        """What is there from now on, until the same path is told anew."""
        self.recording.log(self.path(names), thing)

    def series(self, names: Sequence[object], frames: NDArray[np.int64], seconds: FloatArray, columns: Any) -> None:
        """Many times at once: a row for each of ``(n,)`` frames, as an archetype's ``columns`` makes them."""
        if len(frames):
            times = [self.rr.TimeColumn(FRAME, sequence=frames), self.rr.TimeColumn(SECONDS, duration=seconds)]
            self.recording.send_columns(self.path(names), times, columns)

    def numbers(
        self,
        names: Sequence[object],
        frames: NDArray[np.int64],
        seconds: FloatArray,
        values: FloatArray,
        title: str,
        colour: Colour,
    ) -> None:
        """A curve: ``(n,)`` values, NaN where there is none."""
        known = np.flatnonzero(np.isfinite(values))
        if not len(known):
            return
        self.put(names, self.rr.SeriesLines(colors=[colour], names=[title]))
        self.series(names, frames[known], seconds[known], self.rr.Scalars.columns(scalars=values[known]))

    def poses(
        self, names: Sequence[object], frames: NDArray[np.int64], seconds: FloatArray, transforms: FloatArray
    ) -> None:
        """Where something is: ``(n, 4, 4)`` from its frame to that of what it hangs on; NaN: nowhere to be seen."""
        shown = np.asarray(np.isfinite(transforms).all(axis=(1, 2)))
        # A body of no size is not drawn: there is no other way to take something away whose shape stays.
        turns = np.where(shown[:, None, None], transforms[:, :3, :3], 0.0)
        places = np.where(shown[:, None], transforms[:, :3, 3], 0.0)
        columns = self.rr.Transform3D.columns(translation=places, mat3x3=turns)
        self.series(names, frames, seconds, columns)

    @staticmethod
    def painted(colour: Colour, count: int) -> NDArray[np.uint32]:
        """A colour for each of so many rows, as one number: what a tuple means has changed from version to version."""
        red, green, blue = colour
        return np.full(count, red << 24 | green << 16 | blue << 8 | 0xFF, dtype=np.uint32)

    def pose(self, names: Sequence[object], transform: FloatArray) -> None:
        """The same of what stays where it is."""
        self.put(names, self.rr.Transform3D(translation=transform[:3, 3], mat3x3=transform[:3, :3]))

    def body(
        self, names: Sequence[object], points_m: FloatArray, faces: NDArray[np.int32], colours: NDArray[np.uint8]
    ) -> None:
        """A mesh: ``(V, 3)`` points, ``(F, 3)`` faces, a colour for all or ``(F, 3)``; every face is flat."""
        corners = points_m[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        painted = np.broadcast_to(np.asarray(colours, dtype=np.uint8), (len(faces), 3))
        mesh = self.rr.Mesh3D(
            vertex_positions=corners.reshape(-1, 3).astype(np.float32),
            triangle_indices=np.arange(3 * len(faces), dtype=np.uint32).reshape(-1, 3),
            vertex_normals=normals.repeat(3, axis=0).astype(np.float32),
            vertex_colors=painted.repeat(3, axis=0),
        )
        self.put(names, mesh)

    def ball(self, names: Sequence[object], radius_m: float, line_m: float, colour: Colour) -> None:
        """A ball of lines that stays about the origin of what it hangs on."""
        wires = self.rr.components.FillMode.MajorWireframe
        ball = self.rr.Ellipsoids3D(half_sizes=[[radius_m] * 3], colors=[colour], line_radii=[line_m], fill_mode=wires)
        self.put(names, ball)

    def lines(self, names: Sequence[object], strips_m: Sequence[FloatArray], radius_m: float, colour: Colour) -> None:
        """Lines in space that stay."""
        self.put(names, self.rr.LineStrips3D(list(strips_m), radii=[radius_m], colors=[colour]))

    def camera(self, names: Sequence[object], camera: Camera, plane_m: float) -> None:
        """A camera that looks along z of the path's own frame, its picture's plane so far before it.

        Pinhole and no lens: pictures of datasets have none.
        """
        matrix = camera.pinhole.matrix.copy()
        matrix[:2, 2] += CORNER_PX
        pinhole = self.rr.Pinhole(
            image_from_camera=matrix,
            resolution=[camera.width, camera.height],
            camera_xyz=self.rr.ViewCoordinates.RDF,
            image_plane_distance=plane_m,
        )
        self.put(names, pinhole)
        classes = [(0, "", (0, 0, 0, 0)), (MASK_CLASS, "mask", REFERENCE_COLOUR)]
        self.put(names, self.rr.AnnotationContext(classes))

    def png(self, names: Sequence[object], data: bytes) -> None:
        """A picture, as the bytes of a PNG file."""
        self.show(names, self.rr.EncodedImage(contents=data, media_type="image/png"))

    def mask(self, names: Sequence[object], mask: Mask) -> None:
        """A mask over the picture."""
        self.show(names, self.rr.SegmentationImage(mask.astype(np.uint8), opacity=MASK_OPACITY))

    def contours(self, names: Sequence[object], strips_px: Sequence[FloatArray], colour: Colour) -> None:
        """Closed lines in a picture."""
        closed = [np.concatenate([strip, strip[:1]]) + CORNER_PX for strip in strips_px]
        self.show(names, self.rr.LineStrips2D(closed, radii=[CONTOUR_PX], colors=[colour]))

    def dots(self, names: Sequence[object], pixels: FloatArray, colour: Colour, radius_px: float = 3.0) -> None:
        """``(n, 2)`` points of a picture."""
        self.show(names, self.rr.Points2D(pixels + CORNER_PX, radii=[radius_px], colors=[colour]))


def see_that_there_is_a_display() -> None:
    """Refuse to start a viewer where it would only complain.

    Raises:
        SurgbenchError: There is no display; one line on what to do.
    """
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise SurgbenchError(
            f"no display here for the viewer: write a file with --out FILE{ENDING}, and open it where there is one "
            f"(rerun FILE{ENDING}) or in a browser (rerun --web-viewer FILE{ENDING})"
        )
