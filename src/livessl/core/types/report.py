"""A node's report on itself as values: levels of its channels, and clock and load of its machine."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ChannelLevel:
    """Level of one channel over the whole band, in the second before the report unless it says otherwise.

    Parameters
    ----------
    peak_dbfs : float
        Largest magnitude of a sample since the report before, dB re full scale; -200 for digital silence.
    rms_dbfs : float
        Root of the mean square about the mean, dB re full scale: a sine of full scale has -3.
    clipped : int
        Clipped samples since the node started.
    mean : float or None
        Mean of the samples in the last 10 s, full scale 1. Like the figures below, None in the first second.
    hum_hz, hum_dbfs : float or None
        Frequency and level of hum of the mains in the last 10 s; None if there is none, and in the first 3 s.
    noise_dbfs : float or None
        Noise floor: power in the quietest fifth of frames of 50 ms, dB re full scale squared.
    noise_over_db : float or None
        Height of its noise over the median of the array's channels, in decibels; None with fewer than three channels
        that are not silent.
    """

    peak_dbfs: float
    rms_dbfs: float
    clipped: int
    mean: float | None
    hum_hz: float | None
    hum_dbfs: float | None
    noise_dbfs: float | None
    noise_over_db: float | None = None


@dataclass(frozen=True, slots=True)
class HostState:
    """State of a node's machine: its clock, and whether it keeps up with its sound.

    Parameters
    ----------
    synchronized : bool or None
        Whether its clock follows another one, by NTP or PTP; None if the system does not say.
    service : str
        The program that reports it: `chrony`, `systemd-timesyncd`, or `kernel` if only the kernel does.
    reference : str
        The clock that it follows, such as the name of a time server; empty if that is not known.
    error_s : float or None
        Largest error of the clock in seconds, by the account of the service or the kernel; None if it is not known.
    lost_blocks : int
        Blocks of the device that were lost since the node started because the machine did not keep up.
    load : float or None
        Programs that run or wait for a processor, over the last minute, per processor; None if it is not known.
    sound_server : bool
        Whether its device is read through a sound server or plug-in, whose stamps do not show the device's clock.
    machine : str
        Sign by which nodes on one machine are recognized, because they share its clock; empty if it is not known.
    """

    synchronized: bool | None = None
    service: str = ""
    reference: str = ""
    error_s: float | None = None
    lost_blocks: int = 0
    load: float | None = None
    sound_server: bool = False
    machine: str = ""
