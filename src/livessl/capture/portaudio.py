"""Decides which audio input a device name, serial number or USB port means, opens it, and words why it does not open.

A wrong sampling rate or number of channels is reported here; `input_search` runs the search in a process of its own.

Only this module imports `sounddevice`. The import is inside functions, so that all other commands work on a machine
without PortAudio. The library runs in a separate process (see `device_main`), without numpy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

from livessl.capture.device_report import DeviceState, OpeningError, Wanted
from livessl.capture.hardware import HardwareInput, hardware_inputs
from livessl.errors import DeviceError

RATES_HZ: Final = (8000, 16000, 22050, 32000, 44100, 48000, 88200, 96000, 192000)
"""Sampling rates, in Hz, that are tried for the message about a rate that a device does not offer."""

_INVALID_CHANNEL_COUNT: Final = -9998
_INVALID_SAMPLE_RATE: Final = -9997
_DEVICE_UNAVAILABLE: Final = -9985
"""PortAudio's error codes."""


@dataclass(frozen=True, slots=True)
class InputDevice:
    """An input device.

    Parameters
    ----------
    name : str
        Name that the driver gives.
    host_api : str
        PortAudio's name of the driver family, such as ALSA.
    channels : int
        Number of input channels.
    default_sample_rate_hz : float
        The driver's default sampling rate, Hz.
    serial : str or None
        Serial number of the USB device; None if the device has none.
    usb_port : str or None
        USB port, such as `usb-0000:00:14.0-2`; None if the device is not on USB.
    """

    name: str
    host_api: str
    channels: int
    default_sample_rate_hz: float
    serial: str | None = None
    usb_port: str | None = None

    @property
    def label(self) -> str:
        """`HOSTAPI: name`, unique among the entries of one device under several drivers."""
        return f"{self.host_api}: {self.name}"

    @property
    def is_hardware(self) -> bool:
        """True if samples come directly from the device (ALSA's `hw:`), not through a sound server or a plug-in."""
        return "(hw:" in self.name

    def matches(self, wanted: str) -> bool:
        """Return True if `wanted` is a part of the name, or `HOSTAPI: part of the name`, in upper or lower case."""
        folded, name = wanted.casefold(), self.name.casefold()
        host_api, _, part = folded.partition(": ")
        return folded in name or (part != "" and host_api == self.host_api.casefold() and part in name)


def library() -> Any:
    """Return the `sounddevice` module; its first import starts PortAudio.

    Raises
    ------
    OpeningError
        If PortAudio is not installed.
    """
    try:
        import sounddevice
    except OSError as error:
        raise OpeningError(
            DeviceState.UNSUITABLE,
            "sound devices need the PortAudio library, which is not on this machine; "
            "install PortAudio: apt install libportaudio2",
        ) from error
    except Exception as error:  # the import starts PortAudio; the class of its errors is part of what failed to load
        raise OpeningError(
            DeviceState.FAILED, f"PortAudio cannot be started: {_reason(error)}; trying again"
        ) from error
    return sounddevice


def input_devices() -> list[InputDevice]:
    """Return all input devices, in PortAudio's order.

    Raises
    ------
    DeviceError
        If PortAudio is not installed or cannot list the devices.
    """
    try:
        sd = library()
    except OpeningError as trouble:
        raise DeviceError(str(trouble)) from trouble
    places = {entry.name: entry for entry in hardware_inputs()}
    try:
        return [
            replace(device, serial=places[device.name].serial, usb_port=places[device.name].usb_port)
            if device.name in places
            else device
            for _, device in _inputs(sd)
        ]
    except sd.PortAudioError as error:
        raise DeviceError(f"PortAudio cannot list the devices: {_reason(error)}; is a sound driver running?") from error


def find_input(wanted: Wanted) -> InputDevice | None:
    """Return the input on which a stream of `wanted` would be opened; None if no input matches, or several do."""
    try:
        return _find(_inputs(library()), wanted)[1]
    except OpeningError:
        return None


def rescan(sd: Any) -> None:
    """Restart PortAudio, which only detects devices that were connected before it started.

    Raises
    ------
    OpeningError
        If it does not start again.
    """
    with suppress(sd.PortAudioError):  # PortAudio is not running if the last start failed
        sd._terminate()
    try:
        sd._initialize()
    except sd.PortAudioError as error:
        raise OpeningError(
            DeviceState.FAILED, f"PortAudio cannot be started: {_reason(error)}; trying again"
        ) from error


def open_stream(sd: Any, wanted: Wanted, callback: Callable[[InputDevice], Callable[..., None]]) -> tuple[Any, bool]:
    """Open and start the stream of a device.

    Parameters
    ----------
    sd : module
        `sounddevice`.
    wanted : Wanted
        The device.
    callback : callable
        Returns PortAudio's callback for the device that was found.

    Returns
    -------
    stream : sounddevice.RawInputStream
        The stream, running.
    is_hardware : bool
        Whether samples come directly from the device.

    Raises
    ------
    OpeningError
        If the stream cannot be opened now.
    """
    stream: Any = None
    index = -1
    try:
        index, device = _find(_inputs(sd), wanted)
        stream = sd.RawInputStream(
            device=index,
            channels=wanted.channels,
            samplerate=wanted.sample_rate_hz,
            blocksize=wanted.block_samples,
            dtype="float32",
            latency=wanted.latency_s,
            callback=callback(device),
        )
        stream.start()
    except sd.PortAudioError as error:
        if stream is not None:
            stream.close()
        raise _trouble(sd, wanted, index, error) from error
    return stream, device.is_hardware


def is_active(sd: Any, stream: Any) -> bool:
    """Return True while a stream runs."""
    try:
        return bool(stream.active)
    except sd.PortAudioError:
        return False


def _trouble(sd: Any, wanted: Wanted, index: int, error: Exception) -> OpeningError:
    """Return the reason why a device that was found does not open."""
    code = error.args[1] if len(error.args) > 1 else None
    if code in (_INVALID_SAMPLE_RATE, _INVALID_CHANNEL_COUNT):
        offered = [rate for rate in RATES_HZ if _offers(sd, index, wanted.channels, rate)]
        rates = ", ".join(map(str, offered))
        cure = f"set device.sample_rate_hz to a rate that it has: {rates}" if offered else "use another device"
        return OpeningError(
            DeviceState.UNSUITABLE,
            f"device {wanted.name!r} does not offer {wanted.channels} channels at {wanted.sample_rate_hz:g} Hz; {cure}",
        )
    if code == _DEVICE_UNAVAILABLE:
        return OpeningError(
            DeviceState.BUSY,
            f"device {wanted.name!r} is busy: another program holds it; end that program; trying again",
        )
    return OpeningError(DeviceState.FAILED, f"device {wanted.name!r} cannot be opened: {_reason(error)}; trying again")


def _offers(sd: Any, index: int, channels: int, rate_hz: float) -> bool:
    try:
        sd.check_input_settings(device=index, channels=channels, dtype="float32", samplerate=rate_hz)
    except sd.PortAudioError:
        return False
    return True


def _inputs(sd: Any) -> list[tuple[int, InputDevice]]:
    """Return PortAudio's index and a description of each input device."""
    host_apis = [str(host_api["name"]) for host_api in sd.query_hostapis()]
    return [
        (
            int(found["index"]),
            InputDevice(
                name=str(found["name"]),
                host_api=host_apis[found["hostapi"]],
                channels=int(found["max_input_channels"]),
                default_sample_rate_hz=float(found["default_samplerate"]),
            ),
        )
        for found in _described(sd)
        if found["max_input_channels"] > 0
    ]


def _described(sd: Any) -> list[Any]:
    """Return PortAudio's description of each device, even if names are not UTF-8, as those of the kernel may be."""
    try:
        return list(sd.query_devices())
    except UnicodeDecodeError:
        return [_with_name_replaced(sd, index) for index in range(sd._lib.Pa_GetDeviceCount())]


def _with_name_replaced(sd: Any, index: int) -> Any:
    """Return PortAudio's description of a device, with a replacement character for each byte that is not UTF-8."""
    try:
        return sd.query_devices(index)
    except UnicodeDecodeError:
        info = sd._lib.Pa_GetDeviceInfo(index)
        return {
            "name": sd._ffi.string(info.name).decode("utf-8", "replace"),
            "index": index,
            "hostapi": info.hostApi,
            "max_input_channels": info.maxInputChannels,
            "default_samplerate": info.defaultSampleRate,
        }


def _find(devices: Sequence[tuple[int, InputDevice]], wanted: Wanted) -> tuple[int, InputDevice]:
    """Return PortAudio's index and a description of the requested device.

    A full name takes precedence over names that contain it, so that every device can be named.

    Raises
    ------
    OpeningError
        If no device matches, or several do, or the device has too few channels.
    """
    found = [(index, device) for index, device in devices if device.matches(wanted.name)]
    if wanted.serial or wanted.usb_port:
        places = {entry.name for entry in hardware_inputs() if _is_at(entry, wanted)}
        found = [(index, device) for index, device in found if device.name in places]
    in_full = [
        (index, device)
        for index, device in found
        if wanted.name.casefold() in (device.name.casefold(), device.label.casefold())
    ]
    if len(in_full) == 1:
        found = in_full
    if not found:
        raise _missing(devices, wanted)
    if len(found) > 1:
        candidates = "; ".join(device.label for _, device in found)
        raise OpeningError(
            DeviceState.UNSUITABLE,
            f"device {wanted.name!r}: expected a name that matches one input device, got {len(found)}: {candidates}; "
            "give more of the name in device.name, or device.serial or device.usb_port, as `livessl devices` prints it",
        )
    index, device = found[0]
    if device.channels < wanted.channels:
        raise OpeningError(
            DeviceState.UNSUITABLE,
            f"device {wanted.name!r}: expected at least {wanted.channels} input channels, got {device.channels}; "
            "correct the channels under arrays of this node, or use an interface with more inputs",
        )
    return index, device


def _is_at(entry: HardwareInput, wanted: Wanted) -> bool:
    return wanted.serial in (None, entry.serial) and wanted.usb_port in (None, entry.usb_port)


def _missing(devices: Sequence[tuple[int, InputDevice]], wanted: Wanted) -> OpeningError:
    """Return why PortAudio does not list a device: another program uses it, or it is not connected."""
    for entry in hardware_inputs():
        listed = InputDevice(entry.name, "ALSA", 0, 0.0)
        if listed.matches(wanted.name) and _is_at(entry, wanted):
            holder = entry.holder
            if holder is not None:
                return OpeningError(
                    DeviceState.BUSY,
                    f"device {wanted.name!r} is busy: {holder} records from it; end that program; trying again",
                )
            return OpeningError(
                DeviceState.FAILED,
                f"device {wanted.name!r} is connected but does not open; make sure that no other program uses it and "
                "that this user is in the group `audio`; trying again",
            )
    others = "; ".join(device.label for _, device in devices) or "none"
    where = f" with serial {wanted.serial}" if wanted.serial else ""
    where += f" at {wanted.usb_port}" if wanted.usb_port else ""
    return OpeningError(
        DeviceState.ABSENT,
        f"device {wanted.name!r}{where} is not connected; connect it, or correct device.name (inputs here: {others})",
    )


def _reason(error: Exception) -> str:
    return str(error.args[0]) if error.args else type(error).__name__
