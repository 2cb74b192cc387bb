"""Names that the shell completes (``surgbench --install-completion``)."""

from __future__ import annotations

from collections.abc import Callable


def files(folder: str) -> Callable[[str], list[str]]:
    """Completes the names of YAML files that come with the package in ``configs/<folder>/``."""

    def complete(incomplete: str) -> list[str]:
        from surgbench.config import packaged_names

        return [name for name in packaged_names(folder) if name.startswith(incomplete)]

    return complete


def plugins(kind: str) -> Callable[[str], list[str]]:
    """Completes the names of plug-ins of a kind, of all tasks."""

    def complete(incomplete: str) -> list[str]:
        from surgbench.registry import discover

        return [name for name in sorted(discover(kind)) if name.startswith(incomplete)]

    return complete
