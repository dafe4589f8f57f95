"""A GigE Vision camera on this host whose pictures are ours: libaravis's simulator with our fill function, by ctypes.

libaravis is an implementation of GigE Vision of its own (Debian: ``libaravis-0.8-0``), so a driver that reads this
camera is tested against another reading of the standard than its own library's. One camera per host: the standard
fixes the control port, UDP 3956.
"""

from __future__ import annotations

import ctypes
import logging
import os
import socket
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holocal.errors import BusyError, ConfigError
from rigs.bench import camera_description as registers
from rigs.bench.pixel_formats import BY_CODE

LOGGER = logging.getLogger("holocal.bench")
LIBRARY = "libaravis-0.8.so.0"
AUTO_EXPOSURE_US = 2500  # what its own automatic exposure chooses: wrong, as a driver that leaves it on deserves
GAMMA = 2.2
TEMPERATURE_CENTI_C = 4250
TRIGGERS_HZ = 1000.0  # how often it looks for one; its own 25 would be most of a small frame's time
CONTROL_PORT = 3956  # of GigE Vision
BROKEN = 70  # exit status of a bench that could not make a picture

# (exposure in whole microseconds, bits) -> counts of the whole sensor, (height, width)
Render = Callable[[int, int], NDArray[np.uint16]]

_Pointer = ctypes.c_void_p
_Fill = ctypes.CFUNCTYPE(None, _Pointer, _Pointer, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32)


class GigeServer:
    """The camera, serving from construction until `close`; a context manager.

    Parameters
    ----------
    render
        Makes the counts of a frame when it is triggered. It runs in the library's thread, which also answers the
        driver: after more than about 4 s of silence the driver takes the camera for lost.
    width, height
        Of the sensor.
    exposure_us
        Shortest and longest exposure.
    serial, address
        The camera's serial number; the address of the network card that it answers on.
    as_delivered
        Automatic exposure and gain and gamma are on, as cameras come from their makers; off where False.
    """

    def __init__(
        self,
        render: Render,
        *,
        width: int,
        height: int,
        exposure_us: tuple[int, int],
        serial: str = "BENCH1",
        address: str = "127.0.0.1",
        as_delivered: bool = True,
    ) -> None:
        self.frames = 0
        self._server: Any = None
        self._render, self._library = render, _library()
        _require_free_port(address)
        handle, name = tempfile.mkstemp(suffix=".xml", prefix="holocal-bench-")
        self._description = Path(name)
        with os.fdopen(handle, "w") as file:
            file.write(registers.description(width=width, height=height, exposure_us=exposure_us))
        self._library.arv_set_fake_camera_genicam_filename(name.encode())
        self._server = self._library.arv_gv_fake_camera_new(address.encode(), serial.encode())
        if not self._server or not self._library.arv_gv_fake_camera_is_running(self._server):
            self.close()
            raise ConfigError(
                f"no GigE Vision camera can be served on {address}.",
                fix="Give the address of a network card of this host.",
                code="camera-address",
            )
        self._camera = self._library.arv_gv_fake_camera_get_fake_camera(self._server)
        for register, value in (
            (registers.SENSOR_WIDTH, width),
            (registers.SENSOR_HEIGHT, height),
            (registers.WIDTH, width),
            (registers.HEIGHT, height),
            (registers.TEMPERATURE_CENTI_C, TEMPERATURE_CENTI_C),
            *((auto, registers.CONTINUOUS if as_delivered else registers.OFF) for auto in _AUTOMATIC),
        ):
            self.write(register, value)
        for register, text in ((registers.VENDOR_NAME, b"holocal"), (registers.MODEL_NAME, b"bench on libaravis")):
            self._library.arv_fake_camera_write_memory(self._camera, register, 32, text.ljust(32, b"\0"))
        self._library.arv_fake_camera_set_trigger_frequency(self._camera, TRIGGERS_HZ)
        self._callback = _Fill(self._fill)  # kept: the library holds only its address
        self._library.arv_fake_camera_set_fill_pattern(self._camera, self._callback, None)

    def close(self) -> None:
        """End the camera; safe to call twice."""
        if self._server:
            ctypes.CDLL("libgobject-2.0.so.0").g_object_unref(_Pointer(self._server))
            self._server = None
        self._description.unlink(missing_ok=True)

    def __enter__(self) -> GigeServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def register(self, address: int) -> int:
        """Return what is in a register of the camera now, past the protocol."""
        value = ctypes.c_uint32()
        self._library.arv_fake_camera_read_register(self._camera, address, ctypes.byref(value))
        return value.value

    def write(self, address: int, value: int) -> None:
        """Write a register of the camera, past the protocol: as a viewer, or the camera itself, would."""
        self._library.arv_fake_camera_write_register(self._camera, address, value)

    def _fill(self, buffer: int, _data: int, exposure_us: int, _gain: int, code: int) -> None:
        """Write a frame into the library's buffer."""
        try:
            self._write(buffer, exposure_us, code)
        except BaseException:  # an exception cannot cross C, and a camera without a picture must not send an old one
            LOGGER.exception("the bench could not make a picture; it ends, so that nobody measures the last one again")
            logging.shutdown()
            os._exit(BROKEN)

    def _write(self, buffer: int, exposure_us: int, code: int) -> None:
        form = BY_CODE[code]
        x, y, width, height = (ctypes.c_int() for _ in range(4))
        self._library.arv_buffer_get_image_region(buffer, x, y, width, height)
        automatic = self.register(registers.EXPOSURE_AUTO) == registers.CONTINUOUS
        counts = self._render(AUTO_EXPOSURE_US if automatic else exposure_us, form.bits)
        region = counts[y.value : y.value + height.value, x.value : x.value + width.value]
        if region.shape != (height.value, width.value):
            raise ValueError(f"a picture of shape {counts.shape} has no region {height.value} x {width.value}")
        if self.register(registers.GAMMA_ENABLE) == registers.CONTINUOUS:
            top = 2**form.bits - 1
            region = np.rint(top * (region / top) ** (1 / GAMMA)).astype(np.uint16)
        data = form.packed(region)
        received = ctypes.c_size_t()  # of a buffer that was received; 0 here: the size is ours to know
        ctypes.memmove(self._library.arv_buffer_get_data(buffer, ctypes.byref(received)), data, len(data))
        self.frames += 1


_AUTOMATIC = (registers.EXPOSURE_AUTO, registers.GAIN_AUTO, registers.GAMMA_ENABLE)


def _require_free_port(address: str) -> None:
    """Raise `BusyError` when another camera is served there: libaravis would share the port and answer at random."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, CONTROL_PORT))
        except OSError as error:
            raise BusyError(
                f"no GigE Vision camera can be served on {address}: UDP {CONTROL_PORT}, its control port: {error}.",
                why="The standard allows one camera per address.",
                fix="End the other bench on this host.",
                code="camera-port",
            ) from error


def _library() -> Any:
    """Return libaravis with the types of the functions that are used; `ConfigError` when it is not installed."""
    try:
        library = ctypes.CDLL(LIBRARY)
    except OSError as error:
        raise ConfigError(
            f"the bench needs {LIBRARY}: {error}.", fix="apt-get install libaravis-0.8-0", code="missing-library"
        ) from error
    integers = [ctypes.POINTER(ctypes.c_int)] * 4
    number, text, size = ctypes.c_uint32, ctypes.c_char_p, ctypes.c_size_t
    for name, result, arguments in (
        ("arv_set_fake_camera_genicam_filename", None, [text]),
        ("arv_gv_fake_camera_new", _Pointer, [text, text]),
        ("arv_gv_fake_camera_is_running", ctypes.c_int, [_Pointer]),
        ("arv_gv_fake_camera_get_fake_camera", _Pointer, [_Pointer]),
        ("arv_fake_camera_set_fill_pattern", None, [_Pointer, _Fill, _Pointer]),
        ("arv_fake_camera_set_trigger_frequency", None, [_Pointer, ctypes.c_double]),
        ("arv_fake_camera_read_register", ctypes.c_int, [_Pointer, number, ctypes.POINTER(number)]),
        ("arv_fake_camera_write_register", ctypes.c_int, [_Pointer, number, number]),
        ("arv_fake_camera_write_memory", ctypes.c_int, [_Pointer, number, number, text]),
        ("arv_buffer_get_image_region", None, [_Pointer, *integers]),
        ("arv_buffer_get_data", _Pointer, [_Pointer, ctypes.POINTER(size)]),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library
