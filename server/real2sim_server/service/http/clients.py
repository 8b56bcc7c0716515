"""Who a client says it is, for the record: a name, not a proof."""

from __future__ import annotations

from typing import Annotated

from fastapi import Header

CLIENT_HEADER = "X-Real2Sim-Client"

ClientName = Annotated[
    str,
    Header(
        alias=CLIENT_HEADER,
        max_length=80,
        pattern=r"^[ -~]*$",
        description="who is calling; goes into the history of what is changed",
        examples=["alice"],
    ),
]
