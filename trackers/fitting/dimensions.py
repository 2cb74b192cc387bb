"""What of an instrument is measured: lengths and widths of its parts, and how each of them moves its body.

A body is stretched along the axes of its links' frames. Unknown is a factor for each dimension, 1 as in the file that
the fit begins with. Links fall into three kinds: the first is the shaft, those that hold a tip are its jaws (or the end
of a tool without), whatever lies between is the wrist. The shaft's length is none of them, for no picture shows it all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from surgbench.camera import Camera
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.instrument.model import LinkMesh
from surgbench.instrument.shapes import round_vertices
from surgbench.instrument.spec import LinkPoint
from surgbench.silhouette import ContourPoints
from surgbench.state import POSITION

Part = Literal["shaft", "wrist", "jaw"]
# Where along a jaw its width is measured, as shares of the way to the tip; linear between them.
STATIONS = (0.25, 0.6, 1.0)
STATION_NAMES = ("root", "middle", "tip")
X, Y, Z = 0, 1, 2


@dataclass(frozen=True)
class Dimension:
    """One length of an instrument.

    Attributes:
        name: In the words of who holds a ruler to it.
        value_m: As in the file that the fit begins with.
        links: Places of the links that it stretches.
        axes: Along which axes of their frames.
        station: Of a width that is measured along a jaw, its place in ``STATIONS``; else ``None``.
        child: Links whose offset from their parent grows with it.
    """

    name: str
    value_m: float
    links: tuple[int, ...]
    axes: tuple[int, ...]
    station: int | None = None
    child: tuple[int, ...] = ()


class Dimensions:
    """The dimensions of one instrument.

    Args:
        instrument: As in the file that the fit begins with.

    Attributes:
        instrument: It.
        every: Its dimensions, in a fixed order; the shaft's diameter is the first.
    """

    def __init__(self, instrument: Instrument) -> None:
        self.instrument = instrument
        self._jaws = tuple(sorted({instrument.link_index[tip.link] for tip in instrument.tips} - {0}))
        self.every: tuple[Dimension, ...] = tuple(self._found())

    def __len__(self) -> int:
        return len(self.every)

    @property
    def names(self) -> list[str]:
        """Of all."""
        return [one.name for one in self.every]

    @property
    def values_m(self) -> FloatArray:
        """``(m,)`` as in the file that the fit begins with."""
        return np.array([one.value_m for one in self.every])

    def _found(self) -> list[Dimension]:
        found = [Dimension("shaft diameter", self._size((0,), X), (0,), (X, Y))]
        spec, bodied = self.instrument.spec, self.instrument.meshes
        wrist = tuple(
            index for index, link in enumerate(spec.links) if index and index not in self._jaws and link.name in bodied
        )
        # The link whose offset a_m is the wrist's length: from the pitch axis to the yaw axis.
        child = tuple(index for index, link in enumerate(spec.links) if link.a_m != 0.0)
        holders = tuple({int(self.instrument.parents[index]) for index in child} & set(wrist))
        if child and holders:
            found.append(Dimension("wrist length", spec.links[child[0]].a_m, holders, (X,), child=child))
        if wrist:
            across = holders or wrist
            found.append(Dimension("wrist width", self._size(across, Y), across, (Y,)))
            found.append(Dimension("wrist thickness", self._size(across, Z), across, (Z,)))
        if self._jaws:
            what = "jaw" if self.instrument.has_two_tips else "end"
            along, width = self._along, self._width_axis
            found.append(Dimension(f"{what} length", self._reach_m, self._jaws, (along,)))
            for station, name in enumerate(STATION_NAMES):
                value = self._width_at(STATIONS[station])
                found.append(Dimension(f"{what} width at the {name}", value, self._jaws, (width,), station))
            found.append(Dimension(f"{what} thickness", self._size(self._jaws, Z), self._jaws, (Z,)))
        return found

    @cached_property
    def _along(self) -> int:
        """The axis of the jaws' frames that their tips lie along; in the plane in which they open, or the longest."""
        tip = np.abs(np.mean([np.abs(point.point_m) for point in self.instrument.tips], axis=0))
        return int(np.argmax(tip[:2])) if tip[:2].any() else Z

    @property
    def _width_axis(self) -> int:
        return X if self._along == Y else Y

    @cached_property
    def _reach_m(self) -> float:
        return float(np.abs(self.instrument.tips[0].point_m[self._along]))

    def _size(self, links: Sequence[int], axis: int) -> float:
        corners = np.concatenate([self._vertices(index) for index in links])
        if links == (0,):
            return float(2.0 * np.abs(corners[:, axis]).max())
        return float(np.ptp(corners[:, axis]))

    def _width_at(self, share: float) -> float:
        """Of one jaw, the widest there within a tenth of its length."""
        corners = self._vertices(self._jaws[0])
        near = np.abs(corners[:, self._along] / self._reach_m) - share
        own = corners[np.abs(near) <= 0.12][:, self._width_axis]
        return float(np.ptp(own)) if len(own) > 1 else float(np.ptp(corners[:, self._width_axis]))

    def _vertices(self, index: int) -> FloatArray:
        return self.instrument.meshes[self.instrument.spec.links[index].name].vertices_m

    # --- How points move ---

    def growth(self, link: int, points_m: FloatArray) -> FloatArray:
        """``(n, m, 3)``: how far each dimension's factor moves points of a link's body, ``(n, 3)``, in its own frame.

        Linear in the factors: a body of factors ``s`` has its points at ``x + growth @ (s - 1)``.
        """
        moved = np.zeros((len(points_m), len(self.every), 3))
        for place, one in enumerate(self.every):
            if link not in one.links:
                continue
            share = 1.0 if one.station is None else self._shares(points_m)[:, one.station]
            for axis in one.axes:
                moved[:, place, axis] = points_m[:, axis] * share
        return moved

    def _shares(self, points_m: FloatArray) -> FloatArray:
        """``(n, 3)`` how much of each station's factor a point of a jaw takes."""
        return _hats(np.abs(points_m[:, self._along]) / self._reach_m)

    def jacobian(
        self, contour: ContourPoints, state: FloatArray, factors: FloatArray, camera: Camera, built: Instrument
    ) -> FloatArray:
        """How far each factor moves a contour along its normal.

        Args:
            contour: K points of one arm's state.
            state: ``(9,)``.
            factors: ``(m,)`` of the body whose contour it is.
            camera: That sees it.
            built: :meth:`build` of the factors.

        Returns:
            ``(K, m)`` pixels.
        """
        along_normal = contour.jacobian[:, POSITION]  # of a shift of the wrist, pixels per metre
        # The normal is of unit length, so that a shift across the line of sight moves it by f / z.
        depth = 0.5 * (camera.fx + camera.fy) / np.hypot(along_normal[:, 0], along_normal[:, 1])
        rays = (contour.points_px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        places = np.concatenate([rays * depth[:, None], depth[:, None]], axis=1)
        transforms = built.link_transforms(state)
        columns = np.zeros((len(depth), len(self.every)))
        for link in np.unique(contour.link):
            own = contour.link == link
            turn, origin = transforms[link][:3, :3], transforms[link][:3, 3]
            here = (places[own] - origin) @ turn
            # Where the point is on the body before it was stretched.
            there = here / self._stretch(int(link), here, factors)
            moved = self.growth(int(link), there) @ turn.T
            for place, one in enumerate(self.every):
                for child in one.child:
                    if self._hangs_on(int(link), child):
                        parent = transforms[int(self.instrument.parents[child])][:3, :3]
                        moved[:, place] += parent[:, X] * self.instrument.spec.links[child].a_m
            columns[own] = np.einsum("kmi,ki->km", moved, along_normal[own])
        return columns

    def _stretch(self, link: int, points_m: FloatArray, factors: FloatArray) -> FloatArray:
        """``(n, 3)`` by which a link's body is stretched at points of the stretched body."""
        stretch = np.ones((len(points_m), 3))
        length = next((s for one, s in zip(self.every, factors, strict=True) if one.name.endswith(" length") and
                       link in one.links and link in self._jaws), 1.0)  # fmt: skip
        for one, factor in zip(self.every, factors, strict=True):
            if link not in one.links:
                continue
            if one.station is None:
                stretch[:, list(one.axes)] *= factor
            else:
                share = _hats(np.abs(points_m[:, self._along]) / (length * self._reach_m))[:, one.station]
                stretch[:, one.axes[0]] += share * (factor - 1.0)
        return stretch

    def _hangs_on(self, link: int, ancestor: int) -> bool:
        while link >= 0:
            if link == ancestor:
                return True
            link = int(self.instrument.parents[link])
        return False

    # --- The instrument of some factors ---

    def build(self, factors: FloatArray) -> Instrument:
        """The instrument with its dimensions multiplied by ``(m,)`` factors, as meshes."""
        spec, change = self.instrument.spec, np.asarray(factors) - 1.0

        def moved(link: int, points_m: FloatArray) -> FloatArray:
            grown: FloatArray = np.einsum("nmi,m->ni", self.growth(link, points_m), change)
            return points_m + grown

        def point(one: LinkPoint) -> LinkPoint:
            x, y, z = moved(self.instrument.link_index[one.link], np.array([one.point_m]))[0].tolist()
            return one.model_copy(update={"point_m": (x, y, z)})

        offsets = np.ones(len(spec.links))
        for one, factor in zip(self.every, factors, strict=True):
            offsets[list(one.child)] *= factor
        # Its body is what the meshes say from here on.
        links = tuple(
            link.model_copy(update={"a_m": link.a_m * float(offset), "shapes": (), "parts": ()})
            for link, offset in zip(spec.links, offsets, strict=True)
        )
        meshes = {
            name: LinkMesh(round_vertices(moved(self.instrument.link_index[name], mesh.vertices_m)), mesh.faces)
            for name, mesh in self.instrument.meshes.items()
        }
        return Instrument(
            spec.model_copy(
                update={
                    "links": links,
                    "tips": tuple(point(tip) for tip in spec.tips),
                    "skeleton": tuple((point(a), point(b)) for a, b in spec.skeleton),
                    "markers": tuple(one.model_copy(update={"point": point(one.point)}) for one in spec.markers),
                }
            ),
            meshes,
        )


def _hats(share: FloatArray) -> FloatArray:
    """``(n, 3)`` weights of the stations at shares of a jaw's length, which sum to 1."""
    low, middle, high = STATIONS
    inner = np.clip((share - low) / (middle - low), 0.0, 1.0)
    outer = np.clip((share - middle) / (high - middle), 0.0, 1.0)
    hats: FloatArray = np.stack([1.0 - inner, inner - outer, outer], axis=1)
    return hats
