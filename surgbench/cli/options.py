"""Options of a command that are the fields of a model: what a task's row or a plug-in may be told."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surgbench.cli.completion import plugins

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

Command = Callable[..., Any]


def field_options(models: Mapping[type[BaseModel], str], known: type[BaseModel] | None = None) -> dict[str, Any]:
    """Parameters of a command, one for each field; ``None`` stands for what the command line does not say.

    A field's description is the help; a word in capitals at its begin (``NAME:``) stands for the value. What a field
    keeps under ``json_schema_extra`` may name another ``option``, and one that is the same ``also``, and the
    kind of ``plugins`` whose names the shell completes; what is ``hidden`` is no option.

    Args:
        models: Their fields are taken, of two of one name the first; and the heading that each model's stand under.
        known: Fields that this model has are left out.

    Returns:
        Field name to annotation.
    """
    left_out = {} if known is None else known.model_fields
    found: dict[str, Any] = {}
    for model, heading in models.items():
        for name, field in model.model_fields.items():
            extra = field.json_schema_extra
            hidden = isinstance(extra, dict) and extra.get("hidden")
            if name not in left_out and name not in found and not hidden:
                found[name] = _option(name, field, heading)
    return found


def _option(name: str, field: FieldInfo, heading: str) -> Any:
    extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    flags = [f"--{extra.get('option', name.replace('_', '-'))}", *([f"--{extra['also']}"] if "also" in extra else [])]
    words = field.description or ""
    first, _, rest = words.partition(" ")
    metavar = first.rstrip(":") if len(first) > 2 and first.rstrip(":").isupper() else None
    meaning = rest if metavar else words
    option = typer.Option(
        *flags,
        metavar=metavar,
        help=meaning[:1].upper() + meaning[1:],
        rich_help_panel=heading or None,
        autocompletion=plugins(str(extra["plugins"])) if "plugins" in extra else None,
    )
    return Annotated[field.annotation | None, option]  # type: ignore[operator]


def with_options(command: Command, options: dict[str, Any], into: str, doc: str | None = None) -> Command:
    """A command that takes further options, which reach it together.

    Args:
        command: Takes them as the keyword ``into``: field name to value, those that were given.
        options: From :func:`field_options`.
        into: A parameter of the command.
        doc: What it says of itself; the command's own unless told.
    """

    def call(**arguments: Any) -> Any:
        given = {name: value for name in options if (value := arguments.pop(name)) is not None}
        return command(**arguments, **{into: given})

    own = inspect.signature(command, eval_str=True)
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
        for name, annotation in options.items()
    ]
    kept = [
        parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in own.parameters.items()
        if name != into
    ]
    call.__signature__ = own.replace(parameters=[*kept, *added])  # type: ignore[attr-defined]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in (*kept, *added)}
    call.__name__, call.__doc__ = command.__name__, doc or command.__doc__
    return call
