"""How closely a built-in instrument's silhouettes match those of measured meshes.

    python benchmarks/instrument_model.py --meshes FOLDER --picture worst.png
    python benchmarks/instrument_model.py --instrument cadiere_forceps --meshes FOLDER --roll FILE.STL

FOLDER holds the meshes of ``MEASURED``, in metres: for the needle driver those that SurRoL publishes (med-air/SurRoL,
``surrol/assets/psm/meshes/visual``, MIT licence), for the others those of the dVRK model's classic arm (package MIT).
They have no shaft: a cylinder stands in for it, with SurRoL's ``tool_roll_link.STL`` at its end.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray, look_at_angles, look_at_rotation
from surgbench.instrument import Instrument, load_instrument
from surgbench.randomness import generator
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import JointLimits

CAMERA = Camera(width=700, height=493, fx=905.955, fy=904.820, cx=294.280, cy=238.699)


@dataclass(frozen=True)
class Placed:
    """A mesh of a link, and where it is in the link's frame: turned by roll, pitch and yaw (URDF's rpy), then moved."""

    file: str
    rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


# The other jaw is the same, turned about the jaws' direction.
OVER = (0.0, np.pi, 0.0)
MEASURED = {
    "large_needle_driver": {
        "wrist": Placed("tool_pitch_link.STL"),
        "yaw": Placed("tool_yaw_link.STL"),
        "jaw_right": Placed("tool_gripper1_link.STL"),
        "jaw_left": Placed("tool_gripper2_link.STL"),
    },
    "cadiere_forceps": {
        "wrist": Placed("tool_wrist_caudier_link_1.stl", (0.0, -np.pi / 2, 0.0), (-0.0024, 0.0, 0.0)),
        "yaw": Placed("tool_wrist_caudier_link_1_shaft.stl", (0.0, np.pi / 2, 0.0)),
        "jaw_right": Placed("tool_wrist_caudier_link_2.stl", OVER, (0.0, 0.0, -0.00195)),
        "jaw_left": Placed("tool_wrist_caudier_link_2.stl", (0.0, 0.0, 0.0), (0.0, 0.0, 0.00195)),
    },
    "round_tip_scissors": {
        "wrist": Placed("tool_wrist_sca_link.stl", (np.pi / 2, np.pi, 0.0), (0.0051, 0.00315, 0.0)),
        "yaw": Placed("tool_wrist_sca_shaft_link.stl", (0.0, 0.0, 0.0), (0.0, 0.0, -0.0025)),
        "jaw_right": Placed("tool_wrist_sca_link_2.stl", OVER),
        "jaw_left": Placed("tool_wrist_sca_link_2.stl"),
    },
}
ROLL = "tool_roll_link.STL"
SHAFT_RADIUS_M = 0.00415
SHAFT_START_M = -0.3237
SHAFT_END_M = 0.00195


def measured_instrument(name: str, meshes: Path, roll_mesh: Path, shaft_end_m: float) -> Instrument:
    """The measured meshes on the built-in instrument's joints.

    Args:
        name: Of the instrument, among ``MEASURED``.
        meshes: Folder of its STL files.
        roll_mesh: The clevis, in the wrist-pitch frame.
        shaft_end_m: Where the stand-in shaft ends along z of the wrist-pitch frame.
    """
    spec = load_instrument(name).spec.model_dump(mode="json", exclude_defaults=True)
    links = []
    for link in spec["links"]:
        link = {key: value for key, value in link.items() if key not in ("shapes", "parts")}
        placed = MEASURED[name].get(link["name"])
        if placed is not None:
            link["mesh"] = {
                "path": str((meshes / placed.file).resolve()),
                "close_holes": True,  # some are off in the last digits only
                "rotation": Rotation.from_euler("xyz", placed.rpy_rad).as_matrix().tolist(),
                "translation_m": list(placed.xyz_m),
            }
            links.append(link)
            continue
        ends = [{"at_m": z, "radii_m": [SHAFT_RADIUS_M] * 2} for z in (SHAFT_START_M, shaft_end_m)]
        link["shapes"] = [{"axis": "z", "sides": 96, "sections": ends}]
        roll = {"path": str(roll_mesh.resolve())}
        links += [link, {"name": "roll", "parent": link["name"], "mesh": roll}]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "measured.yaml"
        path.write_text(yaml.safe_dump({**spec, "name": "measured", "links": links}), encoding="utf-8")
        return load_instrument(path)


def hypothesis_states(count: int, limits: JointLimits, rng: np.random.Generator) -> FloatArray:
    """Poses of the hypothesis space of Liang et al. (2025), joints uniform within limits: ``(count, 9)``."""
    elevation = np.radians(rng.uniform(30, 60, count))
    camera_roll, roll_local = rng.uniform(0, 2 * np.pi, (2, count))
    zero = np.zeros(count)

    def turn(alpha: FloatArray, beta: FloatArray, gamma: FloatArray) -> FloatArray:
        return look_at_rotation(np.stack([alpha, beta, gamma], axis=-1))

    # Rz(camera_roll) Ry(elevation) Rz(roll_local)
    rotation = turn(zero, camera_roll, zero) @ turn(zero, roll_local, elevation)
    position = np.column_stack([rng.uniform(-0.01, 0.01, (count, 2)), rng.uniform(0.10, 0.17, count)])
    joints = rng.uniform(limits.lower_rad, limits.upper_rad, (count, 3))
    return np.concatenate([look_at_angles(rotation), position, joints], axis=1)


def difference_image(model: Mask, measured: Mask) -> np.ndarray:
    """``(H, W, 3)`` RGB: both white, the model alone red, the measured meshes alone blue."""
    colours = np.array([[24, 24, 24], [40, 110, 255], [255, 60, 40], [225, 225, 225]], dtype=np.uint8)
    picture: np.ndarray = colours[2 * model.astype(np.intp) + measured]
    return picture


def write_contact_sheet(path: Path, pictures: list[np.ndarray], captions: list[str]) -> None:
    import cv2

    for picture, caption in zip(pictures, captions, strict=True):
        cv2.putText(picture, caption, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 220, 0), 2, cv2.LINE_AA)
    while len(pictures) % 3:
        pictures.append(np.zeros_like(pictures[0]))
    rows = [np.hstack(pictures[start : start + 3]) for start in range(0, len(pictures), 3)]
    _, data = cv2.imencode(".png", np.vstack(rows)[..., ::-1])
    path.write_bytes(data.tobytes())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", type=Path, required=True, help="folder of the measured STL files")
    parser.add_argument("--instrument", choices=sorted(MEASURED), default="large_needle_driver")
    parser.add_argument("--roll", type=Path, metavar="FILE", help=f"the clevis (default: {ROLL} of --meshes)")
    parser.add_argument("--states", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limits", choices=("generate", "search"), default="generate", help="box the joints come from")
    parser.add_argument(
        "--shaft-end", type=float, default=SHAFT_END_M, metavar="M",
        help="where the stand-in shaft ends; -0.005 leaves the measured clevis bare (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--without-shaft", action="store_true", help="wrist and jaws alone: no shaft hides where they differ"
    )
    parser.add_argument("--picture", type=Path, help="write the six worst states' differences to this PNG")
    options = parser.parse_args()
    try:
        model = load_instrument(options.instrument)
        roll = options.roll or options.meshes / ROLL
        measured = measured_instrument(options.instrument, options.meshes, roll, options.shaft_end)
        if options.without_shaft:
            model = model.without_shaft
            bodies = {link: mesh for link, mesh in measured.meshes.items() if link in model.meshes}
            measured = Instrument(measured.spec, bodies)
    except SurgbenchError as error:
        print(error, file=sys.stderr)
        return 2
    limits = model.generate_limits if options.limits == "generate" else model.search_limits
    rng = generator(benchmark="instrument-model", seed=options.seed)
    states = hypothesis_states(options.states, limits, rng)
    ours, theirs = SilhouetteEvaluator([model], CAMERA), SilhouetteEvaluator([measured], CAMERA)
    references = [Reference(theirs.mask(state)) for state in states]
    pairs = zip(states, references, strict=True)
    ious = np.array([ours.score(state[None], reference).iou(reference)[0] for state, reference in pairs])
    worst = np.argsort(ious)[:6]
    print(f"triangles {ours.triangles} (measured meshes {theirs.triangles})")
    shaft = "no shaft" if options.without_shaft else f"shaft end {options.shaft_end * 1e3:+.2f} mm"
    print(f"states {len(states)}, {options.limits} limits, " + shaft)
    low = np.quantile(ious, 0.05)
    print(f"silhouette IoU: mean {ious.mean():.4f}, minimum {ious.min():.4f}, 5 % quantile {low:.4f}")
    for index in worst:
        state = np.array2string(states[index], precision=4, suppress_small=True)
        print(f"  state {index}: IoU {ious[index]:.4f}  {state}")
    if options.picture is not None:
        pictures = [difference_image(ours.mask(states[index]), references[index].mask) for index in worst]
        write_contact_sheet(options.picture, pictures, [f"state {index}: {ious[index]:.3f}" for index in worst])
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
