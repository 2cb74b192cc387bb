"""Published figures: a file of their own, with source, table, row, and columns with units."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from surgbench.config import Section, locate, parse_model, read_yaml


class Figure(Section):
    """A mean with its standard deviation, as printed."""

    mean: float
    std: float


Values = dict[str, float | Figure]


class PublishedRow(Section):
    """A row of a published table.

    Attributes:
        table: Which one, in the source's words.
        label: The method, in the source's words.
        data: Dataset, as the table names it, to column to figure.
    """

    table: str
    label: str
    data: Annotated[dict[str, Values], Field(min_length=1)]

    @model_validator(mode="before")
    @classmethod
    def _datasets_are_keys(cls, content: object) -> object:
        """In the file the datasets stand beside ``table`` and ``label``, which is easier to read."""
        if not isinstance(content, dict) or "data" in content:
            return content
        own = {key: value for key, value in content.items() if key in ("table", "label")}
        return {**own, "data": {key: value for key, value in content.items() if key not in own}}


class Published(Section):
    """One source's figures.

    Attributes:
        source: Authors, title, where it is published.
        short: The same in a few words.
        machine: What the published times were measured on.
        units: Column to unit; every column that a row has is here.
        rows: By name.
    """

    source: str
    short: str
    machine: str
    units: dict[str, str]
    rows: Annotated[dict[str, PublishedRow], Field(min_length=1)]

    @model_validator(mode="after")
    def _units_are_known(self) -> Published:
        for name, row in self.rows.items():
            for values in row.data.values():
                for column in values:
                    if column not in self.units:
                        raise ValueError(f"row '{name}': '{column}' has no unit")
        return self

    def value(self, row: str, dataset: str, column: str) -> float | None:
        """A published mean; ``None`` where the source has none."""
        figure = self.rows[row].data.get(dataset, {}).get(column)
        return figure.mean if isinstance(figure, Figure) else figure


def load_published(name: str) -> Published:
    """The figures of one source.

    Args:
        name: Of a file in ``configs/published/``, or a file.

    Raises:
        NotFoundError: No such file.
        ConfigError: It is wrong; one line.
    """
    path = locate("published", "source of published figures", name)
    return parse_model(Published, read_yaml(path, "published figures"), str(path))
