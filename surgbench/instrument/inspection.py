"""What is wrong with an instrument file, all of it, and what it describes: ``surgbench instrument check``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from surgbench.config import locate, parse_model, read_yaml
from surgbench.errors import ConfigError
from surgbench.instrument.files import link_body
from surgbench.instrument.measures import (
    SAME_IOU,
    jaw_measures,
    measured_symmetry,
    shaft_diameter_m,
    triangles,
    wrist_length_m,
)
from surgbench.instrument.meshes import faces_inward
from surgbench.instrument.model import Instrument, LinkMesh
from surgbench.instrument.plausibility import exact_distance_to_body, problems
from surgbench.instrument.spec import JOINT_NAMES, InstrumentSpec

# More make trackers slow: each candidate's time grows with them.
MANY_TRIANGLES = 1500
# As near as a ruler tells.
ON_BODY_M = 2e-4


@dataclass
class Inspection:
    """What was found.

    Attributes:
        wrong: Lines, each of which keeps it from being used or makes its figures wrong.
        remarks: Lines on what works but may not be meant.
        facts: What it is, as pairs of a thing and its measures.
    """

    wrong: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    facts: list[tuple[str, str]] = field(default_factory=list)


def inspect(name_or_path: str | Path) -> Inspection:
    """Look at an instrument file as a person with a ruler would.

    Args:
        name_or_path: As :func:`surgbench.instrument.load_instrument` takes it.

    Raises:
        NotFoundError: No built-in instrument has this name.
        ConfigError: The file cannot be read, or says what no instrument file says (a misspelt key, limits in degrees).
    """
    path = locate("instruments", "instrument", name_or_path)
    spec = parse_model(InstrumentSpec, read_yaml(path, "instrument"), str(path))
    found = Inspection()
    meshes: dict[str, LinkMesh] = {}
    for link in spec.links:
        try:
            mesh = link_body(link, path)
        except ConfigError as error:
            found.wrong.append(str(error))
            continue
        if mesh is not None:
            meshes[link.name] = mesh
        if link.mesh is not None and faces_inward(link.mesh, path.parent, link.name):
            found.remarks.append(f"{link.mesh.path} of link '{link.name}' faces inward; it is turned when it is read")
    if not meshes and not found.wrong:
        found.wrong.append(f"{path}: 'links': no link has 'shapes', 'parts' or a 'mesh'")
    found.wrong += problems(spec, meshes, path)
    if meshes:
        instrument = Instrument(spec, meshes)
        _describe(instrument, found, path)
        if not found.wrong:
            _look_at_symmetry(instrument, found, path)
    return found


def _describe(instrument: Instrument, found: Inspection, path: Path) -> None:
    spec, meshes = instrument.spec, instrument.meshes
    shaft = shaft_diameter_m(instrument)
    if shaft is not None:
        ends = meshes[spec.links[0].name].vertices_m[:, 2]
        found.facts.append(("shaft", f"{1000 * shaft:.1f} mm across, {1000 * float(np.ptp(ends)):.0f} mm long"))
        if ends.min() + ends.max() > 0:
            found.wrong.append(
                f"{path}: the body of link '{spec.links[0].name}' lies ahead of the pitch axis: z of its frame runs "
                "along the shaft towards the jaws"
            )
    wrist = wrist_length_m(instrument)
    found.facts.append(("wrist", "none" if wrist is None else f"{1000 * wrist:.1f} mm from the pitch to the yaw axis"))
    for jaw in jaw_measures(instrument):
        found.facts.append(
            (
                jaw.link,
                f"{1000 * jaw.length_m:.1f} mm from its axis to its end; half-way to the tip "
                f"{1000 * jaw.width_m:.1f} mm along that axis and {1000 * jaw.thickness_m:.1f} mm across it",
            )
        )
    for number, tip in enumerate(spec.tips, start=1):
        away = float(np.linalg.norm(tip.point_m))
        where = f"{1000 * away:.1f} mm from the origin of '{tip.link}'"
        if tip.link in meshes:
            off = exact_distance_to_body(meshes[tip.link], np.array(tip.point_m))
            where += ", on its body" if off < ON_BODY_M else f", {1000 * off:.1f} mm off its body"
        found.facts.append((f"tip {number}", where))
    for name in JOINT_NAMES:
        low, high = np.degrees(spec.joints[name].generate_rad)  # type: ignore[index]
        moves = f"{low:.0f} to {high:.0f} degrees" if name in instrument.observable else "moves nothing"
        found.facts.append((name.replace("_", " "), moves))
        if name in instrument.observable and not low <= 0 <= high:
            found.remarks.append(f"{name.replace('_', ' ')} is never 0 within generate_rad: is it straight elsewhere?")
    count = triangles(instrument)
    found.facts.append(("triangles", str(count)))
    if count > MANY_TRIANGLES:
        found.remarks.append(
            f"{count} triangles make every tracker slow; {MANY_TRIANGLES} are enough ('max_triangles' under a 'mesh')"
        )
    for model in spec.models:
        found.facts.append((f"model {model.number}", f"{model.generation}, roll d {1000 * model.roll_d_m:.1f} mm"))


def _look_at_symmetry(instrument: Instrument, found: Inspection, path: Path) -> None:
    seen, declared = measured_symmetry(instrument), instrument.symmetry
    found.facts.append(
        (
            "symmetry",
            f"{declared}; its silhouettes overlap by {seen.twin:.2f} when it is turned by half a turn with its wrist "
            f"reversed, by {seen.axis:.2f} when it is turned anyhow (the same from {SAME_IOU:g})",
        )
    )
    if not seen.agrees(declared):
        right = "axis" if seen.axis >= SAME_IOU else "twin" if seen.twin >= SAME_IOU else "none"
        found.wrong.append(f"{path}: 'symmetry' is {declared}, and its silhouettes are those of '{right}'")
