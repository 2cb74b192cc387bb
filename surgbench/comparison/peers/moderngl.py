"""OpenGL without a window, by moderngl on EGL; without a GPU Mesa's llvmpipe draws."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from surgbench.camera import NEAR_M, Camera
from surgbench.comparison.peers.base import Peer, one_line
from surgbench.comparison.peers.body import Body
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument

FAR_M = 10.0
VERTEX_SHADER = """
#version 330
uniform mat4 clip_link[LINKS];
in vec3 position;
in int link;
void main() { gl_Position = clip_link[link] * vec4(position, 1.0); }
"""
# A covered byte is 1, so that the bytes read are booleans.
FRAGMENT_SHADER = """
#version 330
out float covered;
void main() { covered = 1.0 / 255.0; }
"""


class ModernGL(Peer):
    """Draws the back faces in one call and reads the image back."""

    name: ClassVar[str] = "moderngl"
    module: ClassVar[str] = "moderngl"
    system: ClassVar[str] = "on Debian and Ubuntu: apt-get install libegl1 libgl1"

    @classmethod
    def problem(cls) -> str | None:
        """Not installed, or no OpenGL by EGL."""
        problem = super().problem()
        if problem is None:
            try:
                _context().release()
            except Exception as error:  # moderngl and glcontext raise plain Exception
                return f"no OpenGL context by EGL ({one_line(error)}); {cls.system}"
        return problem

    def prepare(self, instrument: Instrument, camera: Camera) -> None:
        """Upload the meshes in their links' frames; only matrices change from state to state."""
        super().prepare(instrument, camera)
        body = Body(instrument)
        self._links = body.links
        place = np.searchsorted(self._links, body.vertex_link)
        vertices = np.empty(len(place), dtype=[("position", "3f4"), ("link", "i4")])
        vertices["position"], vertices["link"] = body.vertices_m, place
        gl = self._gl = _context()
        program = gl.program(VERTEX_SHADER.replace("LINKS", str(len(self._links))).strip(), FRAGMENT_SHADER.strip())
        self._matrices = program["clip_link"]
        self._array = gl.vertex_array(
            program,
            [(gl.buffer(vertices.tobytes()), "3f4 1i4", "position", "link")],
            index_buffer=gl.buffer(body.faces.tobytes()),
        )
        size = (camera.width, camera.height)
        self._frame = gl.framebuffer([gl.renderbuffer(size, components=1, dtype="f1")])
        self._frame.use()
        # OpenGL's rows go up, ours down: the image is drawn upside down and read the right way up, and what OpenGL
        # takes for a front face is a back face.
        gl.enable_only(gl.CULL_FACE)
        gl.cull_face = "back"
        self._projection = _projection(camera)
        self._image = np.empty((camera.height, camera.width), dtype=np.uint8)

    def draw(self, transforms: FloatArray) -> Mask:
        """Draw, wait, read."""
        matrices = self._projection @ transforms[self._links]
        self._matrices.write(matrices.transpose(0, 2, 1).astype("f4").tobytes())
        self._frame.clear()
        self._array.render()
        self._frame.read_into(self._image, components=1, alignment=1)
        return self._image.view(bool)

    def remark(self) -> str:
        """Who draws, and how finely: vertices are rounded to fixed-point pixels."""
        return f"{self._gl.info['GL_RENDERER']}, edges to 1/{1 << self._gl.info['GL_SUBPIXEL_BITS']} px"


def _context() -> Any:
    import moderngl

    return moderngl.create_context(require=330, standalone=True, backend="egl")


def _projection(camera: Camera) -> FloatArray:
    """``(4, 4)`` from the camera frame to clip space; OpenGL's pixel centres are at half-integers."""
    depth = (FAR_M + NEAR_M) / (FAR_M - NEAR_M), -2 * FAR_M * NEAR_M / (FAR_M - NEAR_M)
    return np.array(
        [
            [2 * camera.fx / camera.width, 0, 2 * (camera.cx + 0.5) / camera.width - 1, 0],
            [0, 2 * camera.fy / camera.height, 2 * (camera.cy + 0.5) / camera.height - 1, 0],
            [0, 0, depth[0], depth[1]],
            [0, 0, 1, 0],
        ]
    )
