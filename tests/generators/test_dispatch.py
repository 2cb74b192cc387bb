"""The door of ``surgbench generate``: which generator a preset is given to, ours or a stranger's."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from surgbench.dataset.open import open_dataset
from surgbench.dataset.validate import validate
from surgbench.errors import ConfigError, NotFoundError, SurgbenchError
from surgbench.generation import GenerationRequest, parse_settings
from surgbench.generators import dispatch
from surgbench.generators.dispatch import plan_preset
from surgbench.generators.mask_sequences import MaskSequences
from surgbench.generators.resumable import generate
from surgbench.registry import Found
from surgbench.reproduce.table import DatasetRequest

# Of a task that we know: wires that are as long as the preset says, and nothing else is asked.
STRANGER = """
from surgbench.config import read_yaml
from surgbench.generators.wire_chaser.job import WirePlan
from surgbench.generators.wire_chaser.presets import WireChaser

class Mine:
    name, task = "mine", "viewpoint"

    def plan(self, preset, request):
        settings = {"name": "mine", "level": "custom", "share": (0.0, 1.0), "trials": request.sequences or 2}
        return WirePlan(WireChaser(task=self.task, samples=read_yaml(preset, "preset")["length"], **settings))

class Lacking:
    name, task = "lacking", "viewpoint"

class Stray:
    name, task = "stray", "viewpiont"
    def plan(self, preset, request): ...
"""


@pytest.fixture
def preset(tmp_path: Path) -> Callable[[str], Path]:
    """Writes a preset file, beside a stranger's generators."""
    (tmp_path / "mine.py").write_text(STRANGER)

    def write(text: str) -> Path:
        (tmp_path / "preset.yaml").write_text(text)
        return tmp_path / "preset.yaml"

    return write


def refused(path: Path) -> str:
    with pytest.raises(SurgbenchError) as caught:
        plan_preset(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    assert "\n" not in line
    return line.removeprefix(f"{path}: ")


def test_a_stranger_makes_a_dataset_from_a_file_beside_the_preset(
    preset: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = preset("generator: mine.py:Mine\nlength: 120\n")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert plan_preset(path).counts == "2 trials, 240 samples"
    plan = plan_preset("../preset.yaml", GenerationRequest(sequences=1))
    assert plan.counts == "1 trial, 120 samples"
    assert generate(plan, tmp_path / "out")
    assert validate(tmp_path / "out") == []
    # The dataset says by whom it is: another text of the generator's makes another one.
    assert open_dataset(tmp_path / "out").manifest.configuration["generator"].startswith("mine.py:Mine@")
    assert not generate(plan_preset(path, GenerationRequest(sequences=1)), tmp_path / "out")
    (tmp_path / "mine.py").write_text(STRANGER + "# edited\n")
    with pytest.raises(SurgbenchError, match="holds another dataset"):
        generate(plan_preset(path, GenerationRequest(sequences=1)), tmp_path / "out")


@pytest.mark.parametrize(
    ("plan", "message"), [("1 / 0", "raised ZeroDivisionError: division by zero"), ("None", "gave NoneType")]
)
def test_a_generator_answers_for_what_it_gives(
    preset: Callable[[str], Path], tmp_path: Path, plan: str, message: str
) -> None:
    path = preset("generator: wrong.py:Wrong")
    (tmp_path / "wrong.py").write_text(
        f"class Wrong:\n    name, task = 'wrong', 'viewpoint'\n    def plan(self, preset, request): return {plan}\n"
    )
    assert message in refused(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "generator: wire-chasr",
            "unknown generator 'wire-chasr'; did you mean 'wire-chaser'? (valid: ",
        ),
        ("generator: mine.py:Mien", "unknown class 'Mien'; did you mean 'Mine'?"),
        ("generator: mine.py", "mine.py: say which class, as "),
        ("generator: yours.py:Mine", "yours.py: no such file"),
        ("generator: mine.py:Lacking", "mine.py:Lacking: needs a method 'plan'"),
        ("generator: mine.py:Stray", "mine.py:Stray: unknown task 'viewpiont'; did you mean 'viewpoint'?"),
        ("generator: 3", "'generator': must be a name or FILE.py:Class, not 3"),
        ("generator:", "'generator': must be a name or FILE.py:Class, not None"),
        ("task: viewpiont", "unknown task 'viewpiont'; did you mean 'viewpoint'?"),
        ("generator: wire-chaser\ntask: instrument\nname: x\ntrials: 1", "'task': input should be 'viewpoint'"),
        (
            "generator: mask-sequences\ntask: viewpoint",
            "a preset of the viewpoint task; expected one of",
        ),
    ],
)
def test_a_preset_that_names_none_is_one_line(preset: Callable[[str], Path], text: str, message: str) -> None:
    assert message in refused(preset(text + "\n"))


def test_the_kind_of_error_is_kept(preset: Callable[[str], Path]) -> None:
    with pytest.raises(NotFoundError):
        plan_preset(preset("generator: nobody\n"))
    with pytest.raises(ConfigError):
        plan_preset(preset("generator: 3\n"))


def test_a_name_or_a_task_is_enough(preset: Callable[[str], Path]) -> None:
    masks, wires = "name: x\npairs: 1\nframes: 3\n", "name: x\ntrials: 1\nsamples: 150\n"
    plans = [plan_preset(preset(head + masks)) for head in ("", "task: instrument\n", "generator: mask-sequences\n")]
    assert {plan.counts for plan in plans} == {"1 pair of trajectories, 3 frames"}
    assert plans[0].marker == plans[1].marker == plans[2].marker
    heads = ("task: viewpoint\n", "task: viewpoint\ngenerator: wire-chaser\n")
    assert {plan_preset(preset(head + wires)).counts for head in heads} == {"1 trial, 150 samples"}


def test_where_a_task_has_several_generators_the_preset_must_say_which(
    preset: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {
        "mask-sequences": Found("mask-sequences", "ours", MaskSequences),
        "mine": Found("mine", "theirs", type("Mine", (MaskSequences,), {"name": "mine"})),
        "broken": Found("broken", "theirs", None, "ImportError: no module named 'x'"),
    }
    monkeypatch.setattr(dispatch, "discover", lambda kind: found)
    said = "say which 'generator' makes it; those of the {} task: {}; 'broken' cannot be loaded: ImportError: no "
    assert refused(preset("name: x\n")).startswith(said.format("instrument", "mask-sequences, mine"))
    assert refused(preset("task: viewpoint\n")).startswith(said.format("viewpoint", "none"))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("mini", "unknown sequence '00x'; did you mean '000'? (valid: 000)"),
        ("wire-chaser-mini", "unknown trial '00x'; did you mean '00"),
    ],
)
def test_a_part_of_something_else_is_refused(name: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        plan_preset(name, GenerationRequest(part=(("00x",), 2)))
    assert str(caught.value).startswith(message)


def test_of_a_part_its_trials_alone_are_made() -> None:
    plan = plan_preset("wire-chaser-mini", GenerationRequest(part=(("001", "000"), 5)))
    assert plan.counts == "2 trials, 1400 samples"
    assert plan.marker["part"] == ["000", "001"]


def test_any_key_of_a_preset_is_set_and_told() -> None:
    settings = {"occluders.tissue": 0.4, "corruption.blob_remove": 0.25}
    plan = plan_preset("occlusion", GenerationRequest(sequences=1, frames=2, set=settings))
    assert plan.name == "occlusion-occluders.tissue-0.4-corruption.blob_remove-0.25"
    assert plan.marker["set"] == settings
    preset = plan.marker["preset"]
    assert (preset["occluders"]["tissue"], preset["corruption"]["level"]) == (0.4, "custom")
    assert preset["frames"] == 2
    assert "set" not in plan_preset("occlusion").marker
    chaser = plan_preset("wire-chaser-mini", GenerationRequest(set={"hand.tremor_m": 0.0}))
    assert chaser.name == "wire-chaser-mini-hand.tremor_m-0.0"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("occluders.tisue=0.4", "unknown key 'occluders.tisue'; did you mean 'tissue'?"),
        ("occluders.tissue=1.4", "'occluders.tissue': input should be less than or equal to 1, not 1.4"),
        ("pairs.left=3", "--set pairs.left: 'pairs' has no keys"),
        ("occluders", "--set occluders: must be KEY=VALUE"),
        ("occluders..tissue=1", "must be KEY=VALUE"),
        ("generator=mine.py", "unknown key 'generator'"),
    ],
)
def test_what_cannot_be_set_is_said_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        plan_preset("occlusion", GenerationRequest(set=parse_settings([text])))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_generator_that_ignores_settings_does_not_get_away_with_it(preset: Callable[[str], Path]) -> None:
    path = preset("generator: mine.py:Mine\nlength: 120\n")
    with pytest.raises(ConfigError, match="generator 'mine' takes no settings"):
        plan_preset(path, GenerationRequest(set={"length": 130}))


def test_datasets_of_blocks_that_set_other_values_lie_in_other_folders() -> None:
    folders = {DatasetRequest(preset="occlusion", set={"occluders.tissue": level}).folder for level in (0.0, 0.2, 0.4)}
    assert folders == {f"occlusion-occluders.tissue-{level}" for level in (0.0, 0.2, 0.4)}
    assert DatasetRequest(preset="paper", frames=20).folder == "paper-frames-20"


def test_what_is_set_is_left_as_it_was() -> None:
    """A section, and then a key in it: the next preset is given the same section."""
    told = {"readings": {"lag_frames": [0, 1]}, "readings.noise_rad": 0.5}
    plan = plan_preset("mini", GenerationRequest(set=told))
    assert plan.marker["preset"]["readings"]["noise_rad"] == 0.5
    assert told == {"readings": {"lag_frames": [0, 1]}, "readings.noise_rad": 0.5}
