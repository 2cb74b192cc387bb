"""The gradient of the loss through Mitsuba's projective sampling of silhouettes, and Dr.Jit.

The integrator is ``prb_projective`` (Z. Zhang et al., "Projective Sampling for Differentiable Rendering of Geometry",
2023) with one sample a pixel, on links that glow before a black background. Any mesh will do, and it takes a second
where the engine's own gradient takes a fraction of a millisecond.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.contract import Scene
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.instrument.model import LinkMesh
from surgbench.objective import LossWeights, Objective
from surgbench.rendering.depth import depth_view
from surgbench.state import STATE_SIZE, split_arms

# Of the central differences of the forward kinematics, radians and metres.
STEP = 1e-6


class ProjectiveSilhouette:
    """Derivatives of sums over a silhouette's pixels.

    It can be sent to another process, where its scene is made anew.

    Args:
        instruments: One per arm; states have ``9 * len(instruments)`` components.
        camera: The view.
        variant: A variant of Mitsuba that the machine can run, for example ``llvm_ad_rgb``.
        rng: Where on the contour the samples lie.
    """

    def __init__(
        self, instruments: Sequence[Instrument], camera: Camera, variant: str, rng: np.random.Generator
    ) -> None:
        self._made_of = (tuple(instruments), camera, variant, rng)
        self._links: list[tuple[str, int, int, LinkMesh]] = [
            (f"arm{arm}_{name}", arm, instrument.link_index[name], mesh)
            for arm, instrument in enumerate(instruments)
            for name, mesh in instrument.meshes.items()
        ]
        # The sensor has one focal length (surgbench.rendering.depth).
        self._squeeze = np.array([1.0, camera.fy / camera.fx, 1.0])
        mi = self._mitsuba()
        self._scene = mi.load_dict(self._describe(mi, camera))
        self._scene.integrator().sample_border_warning = False  # the border of the image does not move
        self._parameters = mi.traverse(self._scene)

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), self._made_of

    def _mitsuba(self) -> Any:
        import drjit
        import mitsuba

        if mitsuba.variant() != self._made_of[2]:
            mitsuba.set_variant(self._made_of[2])
        drjit.set_thread_count(1)  # with more the order of sums, and so their last digits, would change from run to run
        return mitsuba

    def _describe(self, mi: Any, camera: Camera) -> dict[str, Any]:
        scene: dict[str, Any] = {"type": "scene", **depth_view(mi, camera)}
        scene["integrator"] = {"type": "prb_projective", "max_depth": 1, "sppi": 0, "sppc": 0}
        # The samples of the contour come from the sampler, too: without jitter all would lie in the same place.
        scene["sensor"]["sampler"] = {"type": "independent", "sample_count": 1}
        for name, _, _, link in self._links:
            light = mi.Properties()
            light["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": 1.0}})
            mesh = mi.Mesh(name, len(link.vertices_m), len(link.faces), props=light)
            parameters = mi.traverse(mesh)
            parameters["vertex_positions"] = link.vertices_m.astype(np.float32).ravel()
            parameters["faces"] = link.faces.astype(np.uint32).ravel()
            parameters.update()
            scene[name] = mesh
        return scene

    def gradient(self, state: FloatArray, weights: NDArray[np.float32]) -> FloatArray:
        """Derivative of the sum of an image over the silhouette, ``(9 * arms,)``.

        Args:
            state: ``(9 * arms,)``, finite.
            weights: ``(H, W)``.
        """
        import drjit

        mi = self._mitsuba()
        instruments, _, _, rng = self._made_of
        parts = split_arms(state)
        transforms = [instrument.link_transforms(part) for instrument, part in zip(instruments, parts, strict=True)]
        keys = [f"{name}.vertex_positions" for name, *_ in self._links]
        for key, (_, arm, index, mesh) in zip(keys, self._links, strict=True):
            placed = mesh.vertices_m @ transforms[arm][index, :3, :3].T + transforms[arm][index, :3, 3]
            self._parameters[key] = mi.Float((placed * self._squeeze).astype(np.float32).ravel())
            drjit.enable_grad(self._parameters[key])
        self._parameters.update()
        self._scene.integrator().render_backward(
            self._scene,
            self._parameters,
            mi.TensorXf(np.asarray(weights, dtype=np.float32)[..., None]),
            seed=int(rng.integers(2**32)),
            spp=1,
        )
        result = np.zeros((len(parts), STATE_SIZE))
        rates = [_link_rates(instrument, part) for instrument, part in zip(instruments, parts, strict=True)]
        for key, (_, arm, index, mesh) in zip(keys, self._links, strict=True):
            pull = np.asarray(drjit.grad(self._parameters[key]), dtype=np.float64).reshape(-1, 3) * self._squeeze
            on_link = pull.T @ np.column_stack([mesh.vertices_m, np.ones(len(pull))])
            result[arm] += np.einsum("ij,kij->k", on_link, rates[arm][:, index])
        return result.ravel()


def _link_rates(instrument: Instrument, state: FloatArray) -> FloatArray:
    """``(9, L, 3, 4)``: how the links' transforms change with each component of a state ``(9,)``."""
    steps = STEP * np.eye(STATE_SIZE)
    ahead, behind = instrument.link_transforms(state + steps), instrument.link_transforms(state - steps)
    rates: FloatArray = (ahead - behind)[:, :, :3] / (2 * STEP)
    return rates


class ProjectiveObjective(Objective):
    """The loss, its gradient through Mitsuba; the losses themselves are the engine's exact ones.

    Args:
        scene: Instruments and cameras.
        weights: Of the terms.
        variant: As for :class:`ProjectiveSilhouette`.
        rng: Likewise.
    """

    def __init__(self, scene: Scene, weights: LossWeights, variant: str, rng: np.random.Generator) -> None:
        super().__init__(scene, weights)
        self._silhouettes = [ProjectiveSilhouette(scene.instruments, v.camera, variant, rng) for v in scene.views]

    def _view_gradient(self, place: int, states: FloatArray) -> FloatArray:
        """Derivative of one view's eq. 6 with respect to states of that view's own frame.

        Pixels of both images are 0 or 1, so that ``(S - M)^2 = S (1 - 2 M) + M``: the loss is a weighted sum over the
        silhouette, and no image of it is needed.
        """
        view = self.views[place]
        reference = view.reference
        area, _ = view.evaluator.sum_over(states, reference)
        excess = np.sign(area - reference.area)
        plain = 1.0 - 2.0 * reference.mask
        return np.stack(
            [
                self._silhouettes[place].gradient(state, (plain + view.appearance * sign).astype(np.float32))
                if np.isfinite(state).all()
                else np.zeros_like(state)
                for state, sign in zip(states, excess, strict=True)
            ]
        )
