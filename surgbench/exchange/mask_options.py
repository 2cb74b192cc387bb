"""What importers may be told of how masks are coded."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from surgbench.config import Section
from surgbench.recordings.coding import Told
from surgbench.recordings.labels import parse_codes, parse_instances
from surgbench.recordings.survey import Channel
from surgbench.tasks.instrument.format import ARMS


class MaskOptions(Section):
    """The base of an importer's options."""

    label: Annotated[
        str | None, Field(description="VALUES that are instrument: 5 or 1,2, or colours as red/green/blue: 64/0/0.")
    ] = None
    instances: Annotated[
        str | None, Field(description="VALUES of each arm, as 1=left,2=right: masks of their own for both.")
    ] = None
    ignore: Annotated[
        str | None, Field(description="VALUES that mean nothing, as 255 in some label maps; not instrument.")
    ] = None
    threshold: Annotated[
        int | None,
        Field(ge=1, le=65535, description="Pixels of at least this value are instrument; default: half of the range."),
    ] = None
    invert: Annotated[bool, Field(description="The instrument is the dark part, or 0.")] = False
    channel: Annotated[
        Channel,
        Field(description="Where masks with transparency are coded; auto: where they are not all the same."),
    ] = "auto"

    def told(self, *, several: bool) -> Told:
        """The same, read.

        Args:
            several: Several objects in one mask are as it should be.

        Raises:
            ConfigError: An option is wrong; one line with an example.
        """
        return Told(
            label=parse_codes(self.label, "--label"),
            instances=parse_instances(self.instances, "--instances", ARMS),
            ignore=parse_codes(self.ignore, "--ignore"),
            threshold=self.threshold,
            invert=self.invert,
            channel=self.channel,
            several=several,
        )
