"""Options that are about two arms."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import SerializerFunctionWrapHandler, model_serializer

from surgbench.config import Section


class WithPairOptions(Section):
    """Options of which some, ``pair_options``, stand in a record only where they are set."""

    pair_options: ClassVar[tuple[str, ...]] = ()

    @model_serializer(mode="wrap")
    def _without_what_is_about_pairs(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # So that the hashes of runs that do not set them do not know of them.
        usual = {name: type(self).model_fields[name].default for name in self.pair_options}
        return {key: value for key, value in serialise(self).items() if key not in usual or value != usual[key]}
