"""An extension of Griffe for the site: examples in docstrings are set as code, roles of Sphinx are left out."""

from __future__ import annotations

import re
from typing import Any

import griffe


class Examples(griffe.Extension):
    """Rewrites docstrings as they are loaded."""

    def on_instance(self, *, obj: Any, **_: Any) -> None:
        """Of each module, class, function and attribute."""
        if obj.docstring is not None:
            text = re.sub(r"^( *)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
            obj.docstring.value = re.sub(r":[a-z]+:(`+)~?([^`]+)\1", r"`\2`", text)
