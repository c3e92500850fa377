"""API models of nodes' reports: levels of channels, drift, clock and load of the machine."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from livessl.schema.base import Model

Dbfs = Annotated[float, Field(description="Level over the whole band in dB relative to full scale.", examples=[-38.2])]


class DriftState(StrEnum):
    """Knowledge of the drift of a device's clock.

    `settling`: its error may be above 5 ppm. `known`: it is below. `unmeasurable`: the device is read through a sound
    server, whose times do not show the device's clock.
    """

    SETTLING = "settling"
    KNOWN = "known"
    UNMEASURABLE = "unmeasurable"


class Channel(Model):
    """Level of one channel over the whole band, as its node reports it once a second; not while a sound goes on."""

    peak_dbfs: Dbfs | None = Field(
        description="Largest magnitude of a sample since the report before; null if all are 0."
    )
    rms_dbfs: Dbfs | None = Field(
        description="Root of the mean square over the last second; a sine of full scale has -3. Null if all are 0."
    )
    noise_dbfs: Dbfs | None = Field(
        description="Power in the quietest fifth of frames of 50 ms in the last 10 s; null in the first second."
    )
    clipped: int = Field(ge=0, description="Clipped samples since the node started.", examples=[0])
    mean: float | None = Field(
        description="Mean of the samples in the last 10 s, full scale 1; null in the first second.", examples=[0.0002]
    )
    hum_hz: float | None = Field(description="Frequency of hum of the mains; null without hum.", examples=[None])
    hum_dbfs: Dbfs | None = Field(description="Level of the hum; null without hum.", examples=[None])
    faults: list[str] = Field(
        description="Codes of the findings about this channel, as in `GET findings`.", examples=[[]]
    )


class Host(Model):
    """State of the machine that a node runs on, as the node reads it once a minute."""

    synchronized: bool | None = Field(
        description="Whether its clock follows another one by NTP or PTP; null if the system does not say.",
        examples=[True],
    )
    service: str | None = Field(
        description="Where that is known from: `chrony`, `systemd-timesyncd` or `kernel`.", examples=["chrony"]
    )
    reference: str | None = Field(
        description="The clock that it follows; null if that is not known.", examples=["192.0.2.1"]
    )
    error_s: float | None = Field(
        ge=0,
        description="Largest error of its clock by its own account, in seconds; null if unknown.",
        examples=[0.0021],
    )
    lost_blocks: int = Field(
        ge=0,
        description="Blocks of the device lost since the node started because the machine did not keep up.",
        examples=[0],
    )
    load: float | None = Field(
        ge=0,
        description="Programs that run or wait for a processor, per processor, over the last minute; null if unknown.",
        examples=[0.4],
    )
