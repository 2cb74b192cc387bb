"""How often controllers break a rule, on reported and on true poses, and what of it no motion could have avoided.

    surgbench generate wire-chaser-hard --out data/hard
    python benchmarks/viewpoint_rules.py data/hard --controller gaze --controller autocam

Prints Markdown. Camera and feature are of one moment: the camera where the joints are at a sample, or where their set
points are, the feature as measured (or truly) at that sample. An event is a row of samples that break a rule by more
than half a millimetre. A sample counts as unavoidable only with a proof, from the state one servo lag earlier and from
the state half a second earlier (:mod:`surgbench.viewpoint.avoidable`); none are asked for on true poses, for no
controller knows them. The second table says what the rules cost: errors in the samples in which no rule speaks against
the naive pose, in the others, and in all; and in how many samples the ring is in at least one picture and not behind
the object that holds it, and how many in which no tag is seen by less than 75 degrees off its normal, on true poses.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from surgbench.dataset.open import open_as
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.registry import create, find
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.viewpoint.avoidable import PLACE_RULES, TOLERANCE_M, broken_m, unavoidable
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.optics.grasp_object import CHAMFER_RAD, Tags
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.scores import course_errors, naive_violations
from surgbench.viewpoint.simulator import Course, Simulation, make_scene
from surgbench.viewpoint.trial import Trial

LONG_S = 0.5
# Half diagonals of the lozenge prism that holds the ring, and how far behind its centre the prism begins.
BELOW_M, BEHIND_M = 6.07e-3, 11.5e-3
STEEPEST_DEG = 75.0


def events(broken: NDArray[np.bool_]) -> int:
    """How many rows of true samples there are."""
    return int((np.diff(broken.astype(int), prepend=0) == 1).sum())


def seen(camera: FloatArray, feature: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Whether the ring's centre, and any tag, shows in any picture; ``(T,)`` each."""
    _, inside = AUTOCAM_STEREO.see(camera, feature[:, :3, 3])
    back = inverse_transform(feature)
    ring, tag = np.zeros(len(camera), dtype=bool), np.zeros(len(camera), dtype=bool)
    wide, flat = BELOW_M / np.sin(CHAMFER_RAD), BELOW_M / np.cos(CHAMFER_RAD)
    tags = Tags()
    for eye, T_camera_eye in enumerate((AUTOCAM_STEREO.T_camera_left, AUTOCAM_STEREO.T_camera_right)):
        place = (back @ camera @ T_camera_eye)[:, :3, 3]
        x, y, z = np.abs(place[:, 0]), np.abs(place[:, 1]), place[:, 2]
        hidden = (z < 0) & (x / wide + y / flat <= -z / BEHIND_M)
        ring |= inside[:, eye] & ~hidden
        for index in tags.centre_m:
            pose = tags.T_feature_tag(index)
            towards = place - pose[:3, 3]
            cosine = towards @ pose[:3, 2] / np.linalg.norm(towards, axis=1)
            tag |= inside[:, eye] & (cosine > np.cos(np.radians(STEEPEST_DEG)))
    return ring, tag


# By pose and rule: samples, events, deepest, unavoidable within a lag and within half a second.
Counts = dict[tuple[str, str], list[Any]]


def measure(course: Course, trial: Trial, scene: ViewpointScene, proofs: bool) -> tuple[Counts, dict[str, Any]]:
    """Counts of a trial by rule and pose, and its errors by subset."""
    count = len(course.goals)
    reported = trial.T_world_feature[:count]
    cases = {
        "joints": (scene.T_world_base, course.joints, reported),
        "set points": (scene.T_world_base, course.setpoints, reported),
    }
    if trial.truth is not None:
        cases["true"] = (trial.truth.T_world_base, course.joints, trial.truth.T_world_feature[:count])
    rules: Counts = {}
    for case, (base, joints, feature) in cases.items():
        camera = base @ scene.arm.forward(joints[:count])
        depths = broken_m(camera[:, :3, 3], feature[:, :3, 3], scene)
        for rule, depth in depths.items():
            broken = np.nan_to_num(depth, nan=-1.0) > TOLERANCE_M
            rules[case, rule] = [int(broken.sum()), events(broken), 1e3 * float(np.nanmax(depth)), 0, 0]
            if broken.any() and proofs and case != "true":
                of = "joints" if case == "joints" else "setpoints"
                for column, steps in ((3, None), (4, round(LONG_S / scene.dt_s))):
                    rules[case, rule][column] = int(unavoidable(course, trial, scene, rule, steps, of=of).sum())  # type: ignore[arg-type]
        sine = camera[:, :3, 1] @ np.array(scene.workspace.preferred_side)
        rules[case, "orientation"] = [int((sine > 0).sum()), events(sine > 0), float(sine.max()), 0, 0]
    errors = course_errors(course, trial, scene)
    against = naive_violations(trial, scene).any
    subsets = {
        "all": trial.measured,
        "unconstrained": trial.measured & np.logical_not(against),
        "constrained": trial.measured & against,
    }
    names = ("vva_deg", "fd_mm", "pf_deg", "an_deg", "pn_full_mm", "vva_true_deg")
    found: dict[str, Any] = {
        name: [float(errors[error][mask].mean()) for error in names] for name, mask in subsets.items()
    }
    base, _, feature = cases["true" if trial.truth is not None else "joints"]
    ring, tag = seen(base @ scene.arm.forward(course.joints[:count]), feature)
    found["seen"] = [int(np.logical_not(ring).sum()), int(np.logical_not(tag).sum()), count]
    return rules, found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", nargs="+", type=Path)
    parser.add_argument("--controller", action="append", help="gaze unless told; a name, or FILE.py:Class")
    parser.add_argument("--set", action="append", default=[], help="OPTION=VALUE of all of them")
    parser.add_argument("--trial", action="append", help="only these")
    parser.add_argument("--no-proofs", action="store_true", help="do not ask what was unavoidable")
    parser.add_argument("--each", action="store_true", help="a line for every trial")
    options = parser.parse_args()
    given = {key: yaml.safe_load(value) for key, value in (one.split("=", 1) for one in options.set)}
    for path in options.dataset:
        dataset = open_as(ViewpointDataset, path)
        for name in options.controller or ["gaze"]:
            rules: dict[Any, list[Any]] = {}
            found: dict[str, list[list[float]]] = {}
            latency = []
            for info in dataset.trials:
                if options.trial and info.id not in options.trial:
                    continue
                trial = dataset.trial(info.id)
                scene = make_scene(trial)
                controller = create(find("tracker", name), given)
                Simulation(controller, trial, scene, np.random.default_rng(0), 40).run()  # compiled
                course = Simulation(controller, trial, scene, np.random.default_rng(0)).run()
                latency.append(course.latency_ms)
                one, errors = measure(course, trial, scene, not options.no_proofs)
                if options.each:
                    said = [f"{c} {r} {v[0]}/{v[1]} {v[2]:.2f}" for (c, r), v in one.items() if v[0]]
                    view = " ".join(f"{k} {v[0]:.3f} {v[1]:.2f} {v[2]:.3f} |" for k, v in errors.items() if k != "seen")
                    print(info.id, view, "unseen", errors["seen"][:2], "; ".join(said), flush=True)
                for key, values in one.items():
                    old = rules.setdefault(key, [0, 0, -np.inf, 0, 0])
                    rules[key] = [
                        max(a, b) if k == 2 else a + b for k, (a, b) in enumerate(zip(old, values, strict=True))
                    ]
                for subset, values in errors.items():
                    found.setdefault(subset, []).append(values)
            print(f"\n`{name}` on {path.name}\n")
            print("| poses | rule | samples | events | deepest | unavoidable in a lag | in 0.5 s |")
            print("|---|---|---:|---:|---:|---:|---:|")
            for (case, rule), (samples, rows, deepest, lag, long) in rules.items():
                unit = "mm" if rule in PLACE_RULES else "(sine)"
                proven = ("–", "–") if case == "true" or rule not in PLACE_RULES else (lag, long)
                print(f"| {case} | {rule} | {samples} | {rows} | {deepest:.2f} {unit} | {proven[0]} | {proven[1]} |")
            print("\n| samples | VVA (°) | FD (mm) | PF (°) | AN (°) | PN, whole way (mm) | true VVA (°) |")
            print("|---|---:|---:|---:|---:|---:|---:|")
            for subset in ("all", "unconstrained", "constrained"):
                means = np.nanmean(found[subset], axis=0)
                print(f"| {subset} | " + " | ".join(f"{value:.3f}" for value in means) + " |")
            ring, tag, count = np.sum(found["seen"], axis=0)
            spent = np.concatenate(latency)
            spent = spent[~np.isnan(spent)]
            print(
                f"\nRing hidden or outside: {100 * ring / count:.3f} %, no tag: {100 * tag / count:.3f} % of {count}; "
                f"latency {spent.mean():.4f} ms, 99.9 %: {np.percentile(spent, 99.9):.3f} ms",
                flush=True,
            )


if __name__ == "__main__":
    main()
