"""The seam between the engine and its tasks: all that the engine asks of one.

A task is a folder of ``surgbench.tasks`` with a module ``task.py`` that holds a class derived from :class:`Task`, or
the same behind an entry point of the group ``surgbench.tasks``. The engine finds it by its name, in child processes
too, and knows none by name. ``docs/architecture.md`` shows the way of the data through it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from surgbench.errors import ConfigError, NotFoundError, SurgbenchError, unknown_name
from surgbench.registry import default_task_name, discover

if TYPE_CHECKING:
    from surgbench.conformance.subject import Check
    from surgbench.dataset.base import Dataset
    from surgbench.dataset.manifest import Manifest
    from surgbench.handeye.table import Judged
    from surgbench.records.format import Record
    from surgbench.report.column import Column
    from surgbench.report.field import Field
    from surgbench.report.filmed import Filmed
    from surgbench.report.row import Row
    from surgbench.report.stage import Stage, Subject
    from surgbench.report.video_options import VideoOptions
    from surgbench.reproduce.sheet import Sheet
    from surgbench.suite.asked import Conditions, FileRequest, RowRequest
    from surgbench.suite.running import Run
    from surgbench.suite.settings import Job, Settings

Advance = Callable[[float], None]


class FileWork(Protocol):
    """One unit of a file of estimates that another program made."""

    @property
    def job(self) -> Job:
        """As of a run."""
        ...

    def measure(self, run: Run) -> dict[str, Any]:
        """What a record holds of it besides what every record says of its job."""
        ...


class Task(ABC):
    """What trackers do on a dataset, and how that is judged.

    Everything that loads much (readers, evaluation, drawing) is imported where it is used, so that a command can look
    at all tasks before it knows which one it is about.

    Attributes:
        name: As manifests and rows have it.
        summary: One line.
        default: Manifests, trackers and presets that name no task are of this one.
        made_by: Names of its modules that make estimates and measure errors. With what they import of the engine, they
            are part of what records depend on; what only plans, writes and shows is not. Where none are named, all
            modules of its package are.
        parts: Columns that tell apart several rows of one run, and their values in the row that stands for the whole.
        ranked_by: The error of its records that rows are ranked by, and compared by; ``None`` where it is no error of
            theirs.
        first_check: The check that a tracker must get through before it is put to the others.
        may_refuse: Checks that a tracker may answer with a :class:`~surgbench.errors.SurgbenchError`: it does not do
            this.
        aids: What a tracker may need to be given in all checks, if it refuses to run without.
    """

    name: ClassVar[str]
    summary: ClassVar[str] = ""
    default: ClassVar[bool] = False
    made_by: ClassVar[tuple[str, ...]] = ()
    parts: ClassVar[Mapping[str, Any]] = {}
    ranked_by: ClassVar[str | None] = None
    first_check: ClassVar[str] = ""
    may_refuse: ClassVar[tuple[str, ...]] = ()
    aids: ClassVar[tuple[str, ...]] = ()

    # data

    @property
    @abstractmethod
    def manifest(self) -> type[Manifest]:
        """What ``dataset.json`` says."""

    @abstractmethod
    def open(self, folder: Path, manifest: Any, sha256: str) -> Dataset[Any]:
        """A dataset whose manifest has been read."""

    @abstractmethod
    def validate(self, dataset: Any, progress: Advance) -> list[str]:
        """One line for everything that is wrong with a dataset; ``progress`` takes the number of files checked."""

    # run

    @property
    def row(self) -> type[RowRequest]:
        """What a row may ask for."""
        from surgbench.suite.asked import RowRequest

        return RowRequest

    @abstractmethod
    def complete(self, row: Any, conditions: Conditions, dataset: Any) -> Settings:
        """Look up everything a row names, check its options, and fill in the defaults.

        Raises:
            NotFoundError: A name that is not registered.
            ConfigError: A wrong option, or something that the dataset has not.
        """

    @abstractmethod
    def execute(self, job: Job, dataset: Any, run: Run) -> dict[str, Any]:
        """Run a job in a child process (:meth:`Run.child`) and measure what came of it.

        Returns:
            What a record holds besides what every record says of its job: ``status``, ``error``, ``traceback``,
            ``frames``, ``errors``, and whatever else the task's record model has.

        Raises:
            SurgbenchError: The dataset itself is at fault.
        """

    def from_file(self, dataset: Any, path: Path, asked: FileRequest) -> Sequence[FileWork]:
        """Estimates that another program made.

        Args:
            dataset: What they were made on.
            path: The file.
            asked: How it is to be called and read.

        Returns:
            One for each unit that the file has estimates of.

        Raises:
            SurgbenchError: The file is wrong; one line. Or the task takes no estimates from files.
        """
        raise ConfigError(f"the {self.name} task takes no estimates from files")

    def recorded_job(self, record: dict[str, Any], dataset: Any) -> Job:
        """The job that a record's specification describes, its plug-ins looked up as they are now.

        Args:
            record: Its whole content; ``references`` may name files where plug-ins lie here.
            dataset: What it was run on.

        Raises:
            SurgbenchError: A plug-in is not there, or the task cannot tell.
        """
        raise ConfigError(f"runs of the {self.name} task cannot be made anew from their records")

    def rescore(self, record: dict[str, Any], dataset: Any, run: Run) -> dict[str, Any]:
        """Measure once more what is wrong with a record's estimates; none of its plug-ins need be there.

        Args:
            record: Its whole content.
            dataset: What it was run on.
            run: Is told how far it is.

        Returns:
            Names of errors to their values, as the record has them; without those that a record is not enough for.

        Raises:
            SurgbenchError: The task cannot do that, or the dataset is at fault.
        """
        raise ConfigError(f"runs of the {self.name} task cannot be scored again")

    def timed(self, row: Any) -> RowRequest:
        """A row as it is run to measure latencies: without what takes time and changes no latency."""
        asked: RowRequest = row
        return asked

    # report

    @property
    def record(self) -> type[Record]:
        """What is read of a record."""
        from surgbench.records.format import Record

        return Record

    @property
    def columns(self) -> tuple[Field, ...]:
        """Of the leaderboard, in order, with their types."""
        from surgbench.report.row import COMMON_COLUMNS

        return COMMON_COLUMNS

    @property
    def further_columns(self) -> tuple[Field, ...]:
        """Of the leaderboard, after the others, those that stand only where a row has a value of them."""
        return ()

    @property
    @abstractmethod
    def shown(self) -> tuple[Column, ...]:
        """Columns that tables are read by, in order."""

    @abstractmethod
    def rows(self, head: Row, records: list[Any]) -> list[Row]:
        """The rows of one row id and settings.

        Args:
            head: The columns that rows of every task have.
            records: All of them, ordered by unit and repeat.
        """

    def group(self, record: Any) -> str:
        """Which of the rows of one row id and settings a record belongs to; in the order of these texts."""
        return ""

    def title(self, row: Row) -> str:
        """What stands over the rows of a dataset and group."""
        return self.name

    def rank(self, row: Row) -> float | None:
        """What rows are ranked by, less is better: unless told, their ``ranked_by``."""
        error: float | None = None if self.ranked_by is None else row[self.ranked_by]
        return error

    def on_page(self, row: Row) -> bool:
        """Whether a row stands in a Markdown table, or in files only."""
        return self.is_whole(row)

    def is_whole(self, row: Row) -> bool:
        """Whether a row stands for a whole run, and not for a part of it."""
        return all(row.get(column) == value for column, value in self.parts.items())

    @property
    def sheet(self) -> Sheet:
        """Its part in reproduced tables.

        Raises:
            ConfigError: It has none.
        """
        raise ConfigError(f"the {self.name} task has no reproduced tables")

    # view

    def draw(
        self,
        records: Sequence[Any],
        options: VideoOptions,
        dataset: Path | None,
        out: Path,
        progress: Callable[[str, float], Any],
    ) -> list[Path]:
        """Videos and pictures of runs.

        Args:
            records: Of one or more rows and units.
            options: What to draw.
            dataset: Where the dataset is, if not where the records say.
            out: Folder.
            progress: Takes a description and the number of frames to draw; a context manager that gives what takes the
                number of frames just drawn.

        Returns:
            The files written.
        """
        raise SurgbenchError(f"runs of the {self.name} task have no video")

    def filmed(self, record: Any, dataset: Path | None) -> Filmed:
        """What draws single frames of a run.

        Args:
            record: The run.
            dataset: Where its dataset is, if not where the record says.

        Raises:
            SurgbenchError: Runs of this task have no pictures, this one has none, or its dataset is not there.
        """
        raise SurgbenchError(f"runs of the {self.name} task have no pictures")

    def view(self, subject: Subject, stage: Stage, progress: Callable[[str, float], Any]) -> list[str]:
        """Put sequences or runs on a stage, to be looked at in space and over time.

        Args:
            subject: What is asked for; of this task.
            stage: Where they are put.
            progress: As of :meth:`draw`.

        Returns:
            Lines for the user, on what is not shown.

        Raises:
            NotFoundError: A unit or row that is not there.
            SurgbenchError: This task has nothing to look at, or something in the material is damaged.
        """
        raise SurgbenchError(f"data of the {self.name} task cannot be looked at in space")

    def plots(
        self,
        records: Sequence[Any],
        dataset: Path | None,
        out: Path,
        progress: Callable[[str, float], Any],
    ) -> list[Path]:
        """Pictures of runs over time.

        Args:
            records: Of one or more rows and units.
            dataset: Where the dataset is, if not where the records say.
            out: Folder.
            progress: As of :meth:`draw`.

        Returns:
            The files written.
        """
        raise SurgbenchError(f"runs of the {self.name} task have no plots over time")

    def hand_eye(
        self,
        records: Sequence[Any],
        dataset: Path | None,
        fix_lag: Path | None,
        progress: Callable[[str, float], Any],
    ) -> list[Judged]:
        """Hold estimates against a robot's readings of its arms, where there is no truth.

        Args:
            records: Of this task.
            dataset: Where their dataset is; where each record says, unless told.
            fix_lag: Folder to write the dataset to with its readings where they belong.
            progress: Takes a description and how much there is to do; gives what takes the part just done.

        Returns:
            One entry for each run and arm.
        """
        raise SurgbenchError(f"runs of the {self.name} task have no readings of arms to be judged by")

    # conformance

    def checks(self) -> Mapping[str, Check]:
        """By name, what a tracker is put to; each says in its docstring what it is about."""
        return {}


@cache
def find_task(name: str) -> Task:
    """The task of this name.

    Raises:
        NotFoundError: There is none.
        ConfigError: It cannot be loaded.
    """
    found = discover("task").get(name)
    if found is None:
        raise NotFoundError(unknown_name("task", name, task_names()))
    if found.cls is None:
        raise ConfigError(f"task '{name}' ({found.source}) cannot be loaded: {found.problem}")
    try:
        task: Task = found.cls()
    except Exception as error:
        raise ConfigError(f"task '{name}' ({found.source}) cannot be used: {error}") from error
    return task


def task_names() -> tuple[str, ...]:
    """The names of all tasks, the default one first."""
    names = discover("task")
    return tuple(sorted(names, key=lambda name: (name != default_task_name(), name)))


def default_task() -> Task:
    """The task of what names none."""
    return find_task(default_task_name())


def all_tasks() -> tuple[Task, ...]:
    """All tasks, the default one first, without those that cannot be used: they harm no other."""
    tasks = []
    for name in task_names():
        with suppress(ConfigError):
            tasks.append(find_task(name))
    return tuple(tasks)
