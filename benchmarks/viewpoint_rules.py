"""How often controllers break a rule, on reported and on true poses, and what of it no motion could have avoided.

    surgbench generate wire-chaser-hard --out data/hard
    python benchmarks/viewpoint_rules.py data/hard --controller gaze --controller autocam

Prints Markdown: the events of every rule as records have them (:mod:`surgbench.viewpoint.rules`), and of the samples of
rules of place how many are proven unavoidable, from the state one servo lag earlier and from half a second earlier
(:mod:`surgbench.viewpoint.avoidable`); none are asked for on true poses, which no controller knows. The second table
says what the rules cost: errors in the samples in which no rule speaks against the naive pose, in the others, in all.
Below it, how often no picture shows half of the ring uncovered, on true poses.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from surgbench.dataset.open import open_as
from surgbench.registry import create, find
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.viewpoint.avoidable import PLACE_RULES, unavoidable
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.optics.visibility import SEEN_SHARE, ring_shares
from surgbench.viewpoint.rules import RULE_UNITS, TWINS, after_steps, find_events, reported_depths, true_depths
from surgbench.viewpoint.scores import course_errors, naive_violations
from surgbench.viewpoint.simulator import Course, Simulation, make_scene
from surgbench.viewpoint.trial import Trial

LONG_S = 0.5
ERRORS = ("vva_deg", "fd_mm", "pf_deg", "an_deg", "pn_full_mm", "vva_true_deg")
# By twin and rule: samples, events, deepest, unavoidable within a lag and within half a second.
Counts = dict[tuple[str, str], list[Any]]


def count_events(course: Course, trial: Trial, scene: ViewpointScene, proofs: bool) -> Counts:
    """How often each rule was broken in a trial."""
    counts: Counts = {}
    for twin, depths in zip(TWINS, (reported_depths, true_depths), strict=True):
        for rule, depth in depths(course, trial, scene).items():
            found = find_events(depth, rule)
            counts[twin, rule] = [found.samples, found.count, float(np.nanmax(depth)), 0, 0]
            if found.samples and proofs and not twin and rule in PLACE_RULES:
                for column, steps in ((3, None), (4, round(LONG_S / scene.dt_s))):
                    counts[twin, rule][column] = int(unavoidable(course, trial, scene, rule, steps).sum())
    return counts


def mean_errors(course: Course, trial: Trial, scene: ViewpointScene) -> dict[str, list[float]]:
    """Mean errors of a trial by subset, as :data:`ERRORS`."""
    errors = course_errors(course, trial, scene)
    against = naive_violations(trial, scene).any
    subsets = {
        "all": trial.measured,
        "unconstrained": trial.measured & ~against,
        "constrained": trial.measured & against,
    }
    return {name: [float(errors[error][mask].mean()) for error in ERRORS] for name, mask in subsets.items()}


def unseen(course: Course, trial: Trial, scene: ViewpointScene) -> int:
    """In how many samples neither picture shows the ring."""
    base, feature = scene.T_world_base, trial.T_world_feature
    if trial.truth is not None:
        base, feature = trial.truth.T_world_base, trial.truth.T_world_feature
    camera = base @ scene.arm.forward(course.joints[1:])
    shares = ring_shares(AUTOCAM_STEREO, camera, after_steps(feature, len(camera)))
    return int((shares < SEEN_SHARE).all(axis=1).sum())


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
            latency, hidden = [], []
            for info in dataset.trials:
                if options.trial and info.id not in options.trial:
                    continue
                trial = dataset.trial(info.id)
                scene = make_scene(trial)
                controller = create(find("tracker", name), given)
                Simulation(controller, trial, scene, np.random.default_rng(0), 40).run()  # compiled
                course = Simulation(controller, trial, scene, np.random.default_rng(0)).run()
                latency.append(course.latency_ms)
                one = count_events(course, trial, scene, not options.no_proofs)
                errors = mean_errors(course, trial, scene)
                hidden.append((unseen(course, trial, scene), len(course.goals)))
                if options.each:
                    said = [f"{rule}{twin} {v[0]}/{v[1]} {v[2]:.2f}" for (twin, rule), v in one.items() if v[0]]
                    view = " ".join(f"{k} {v[0]:.3f} {v[1]:.2f} {v[2]:.3f} |" for k, v in errors.items())
                    print(info.id, view, "unseen", hidden[-1][0], "; ".join(said), flush=True)
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
            for (twin, rule), (samples, rows, deepest, lag, long) in rules.items():
                proven = (lag, long) if rule in PLACE_RULES and not twin else ("–", "–")
                poses, depth = "true" if twin else "reported", f"{deepest:.2f} {RULE_UNITS[rule]}"
                print(f"| {poses} | {rule} | {samples} | {rows} | {depth} | {proven[0]} | {proven[1]} |")
            print("\n| samples | VVA (°) | FD (mm) | PF (°) | AN (°) | PN, whole way (mm) | true VVA (°) |")
            print("|---|---:|---:|---:|---:|---:|---:|")
            for subset in ("all", "unconstrained", "constrained"):
                means = np.nanmean(found[subset], axis=0)
                print(f"| {subset} | " + " | ".join(f"{value:.3f}" for value in means) + " |")
            ring, count = np.sum(hidden, axis=0)
            spent = np.concatenate(latency)
            spent = spent[~np.isnan(spent)]
            print(
                f"\nRing covered or outside in both pictures: {100 * ring / count:.3f} % of {count}; "
                f"latency {spent.mean():.4f} ms, 99.9 %: {np.percentile(spent, 99.9):.3f} ms",
                flush=True,
            )


if __name__ == "__main__":
    main()
