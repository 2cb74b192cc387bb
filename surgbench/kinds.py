"""Kinds of plug-ins: a new one is a row of this table, and a protocol that says what its plug-ins can do."""

from __future__ import annotations

import importlib
import inspect
from dataclasses import dataclass
from typing import Any

# Names become names of files.
NAME_PATTERN = r"[A-Za-z0-9][A-Za-z0-9._-]*"


@dataclass(frozen=True)
class Kind:
    """One kind of plug-in.

    Attributes:
        name: What one of them is called, in messages and as ``--<name>``.
        plural: What ``surgbench list`` calls all of them.
        package: The package whose modules are looked through.
        group: Entry points of other distributions.
        protocol: ``module:Class`` that says which methods they have; looked up when needed, for it may load much.
        inside: Name of a module, where every sub-package of ``package`` holds its plug-in in one; else plug-ins are in
            modules of the package itself.
    """

    name: str
    plural: str
    package: str
    group: str
    protocol: str
    inside: str = ""

    def methods(self) -> tuple[str, ...]:
        """What its plug-ins must have: the public methods that the protocol's own class body defines."""
        module, _, name = self.protocol.partition(":")
        protocol: Any = getattr(importlib.import_module(module), name)
        required = getattr(protocol, "__abstractmethods__", None) or vars(protocol)
        return tuple(
            method
            for method, value in vars(protocol).items()
            if method in required and inspect.isfunction(value) and not method.startswith("_")
        )


_TABLE = (
    Kind("task", "tasks", "surgbench.tasks", "surgbench.tasks", "surgbench.task:Task", inside="task"),
    Kind("generator", "generators", "surgbench.generators", "surgbench.generators", "surgbench.contract:Generator"),
    Kind("importer", "importers", "surgbench.exchange", "surgbench.importers", "surgbench.contract:Importer"),
    Kind(
        "exporter",
        "exporters",
        "surgbench.exchange.exporters",
        "surgbench.exporters",
        "surgbench.exporting:Exporter",
    ),
    Kind("tracker", "trackers", "surgbench.trackers", "surgbench.trackers", "surgbench.contract:InstrumentTracker"),
    Kind(
        "initialiser",
        "initialisers",
        "surgbench.trackers.initialisers",
        "surgbench.initialisers",
        "surgbench.contract:Initialiser",
    ),
    Kind("filter", "filters", "surgbench.trackers.filters", "surgbench.filters", "surgbench.contract:StateFilter"),
    Kind(
        "keypoints",
        "keypoints",
        "surgbench.trackers.keypoints",
        "surgbench.keypoints",
        "surgbench.contract:KeypointSource",
    ),
    Kind(
        "mask_source",
        "masks",
        "surgbench.trackers.masks",
        "surgbench.masks",
        "surgbench.mask_sources:MaskSource",
    ),
)
KINDS = {kind.name: kind for kind in _TABLE}
