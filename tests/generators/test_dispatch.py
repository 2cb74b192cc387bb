"""The door of ``surgbench generate``: which generator a preset is given to, ours or a stranger's."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from surgbench.dataset.open import open_dataset
from surgbench.dataset.validate import validate
from surgbench.errors import ConfigError, NotFoundError, SurgbenchError
from surgbench.generation import GenerationRequest
from surgbench.generators import dispatch
from surgbench.generators.dispatch import plan_preset
from surgbench.generators.mask_sequences import MaskSequences
from surgbench.generators.resumable import generate
from surgbench.registry import Found

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


def test_of_a_part_all_trials_up_to_its_last_are_made() -> None:
    plan = plan_preset("wire-chaser-mini", GenerationRequest(part=(("001", "000"), 5)))
    assert plan.counts == "2 trials, 1400 samples"
    assert plan.marker == plan_preset("wire-chaser-mini", GenerationRequest(sequences=2)).marker
