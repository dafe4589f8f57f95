"""Which GenICam cameras are there, and one of them under our control: GigE Vision and USB3 Vision by viva-genicam."""

from __future__ import annotations

import importlib
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from holocal.errors import BusyError, ConfigError, DeviceError, RefusedError
from rigs.genicam_table import GenicamTable

if TYPE_CHECKING:
    import viva_genicam

LOGGER = logging.getLogger("holocal.rigs")
DISCOVERY_MS = 500  # a camera answers a discovery broadcast within 250 ms unless it was just plugged in
FORGOTTEN_S = 4.0  # a camera lets go of a program that is silent for its heartbeat's 3 s: `resume` after a kill waits
RETRY_S = 0.2
DISCOVERIES = 3  # a broadcast may be lost
# Bootstrap registers of GigE Vision 2.2, section 28: control channel privilege, serial number, user-defined name.
CONTROL_PRIVILEGE, SERIAL_NUMBER, USER_NAME = 0x0A00, 0x00D8, 0x00E8
NAME_BYTES = 16


@dataclass(frozen=True)
class SeenCamera:
    """A camera that answered. `address` is an IPv4 address, or bus and number on USB; unknown names are empty."""

    transport: str
    vendor: str
    model: str
    serial: str
    user_id: str
    address: str
    handle: Any = field(repr=False, compare=False)

    def __str__(self) -> str:
        name = f" ({self.user_id})" if self.user_id else ""
        return f"{self.vendor} {self.model} {self.serial or 'without serial number'}{name} at {self.address}"


def viva() -> Any:
    """Return the package viva_genicam; `ConfigError` with what to install when it is not there."""
    try:
        return importlib.import_module("viva_genicam")
    except ImportError as error:
        raise ConfigError(
            f'the driver "genicam" needs the package viva-genicam: {error}.',
            fix='pip install "holocal[genicam]"',
            code="missing-extra",
        ) from error


@contextmanager
def asking(what: str, fix: str = "Check its cable and power; then `holocal resume`.") -> Iterator[None]:
    """Turn the library's complaints into a `DeviceError` that says what was being done."""
    try:
        yield
    except viva().GenicamError as error:
        raise DeviceError(
            f"the camera failed {what}: {error}.", why="The run cannot go on without it.", fix=fix, code="camera-lost"
        ) from error


def discover(*, interface: str | None = None) -> tuple[SeenCamera, ...]:
    """Return the cameras that answer, without taking control of any: one in use elsewhere is listed too.

    The network search reaches the subnets of this machine's network cards (of `interface` alone where it is given),
    the loopback included.
    """
    vg = viva()
    with asking("while cameras were searched", "Check the network cards, and the name in camera.interface."):
        found = vg.discover(timeout_ms=DISCOVERY_MS, iface=interface, all=True)
    usb = _usb_devices() if interface is None else []
    return (*(_seen_on_network(info, interface) for info in found), *(_seen_on_usb(info) for info in usb))


def find(table: GenicamTable, source: str) -> SeenCamera:
    """Return the one camera that a table means.

    Raises
    ------
    DeviceError
        None answers.
    RefusedError
        Cameras answer, but not the one that is named.
    ConfigError
        Several answer and none is named.
    """
    seen: tuple[SeenCamera, ...] = ()
    for _ in range(DISCOVERIES):
        seen = discover(interface=table.interface)
        fitting = [camera for camera in seen if _fits(camera, table)]
        if fitting:
            break
    else:
        raise _nothing_fits(table, seen, source)
    if len(fitting) > 1:
        raise ConfigError(
            f"{source}: [camera] names none of the {len(fitting)} cameras that answer: {_list(fitting)}.",
            why="A calibration belongs to one device.",
            fix=f"Set camera.serial, for example {fitting[0].serial or 'the number on its label'!r}.",
            measured=len(fitting),
            limit=1,
            code="several-cameras",
        )
    return fitting[0]


def connect(camera: SeenCamera, interface: str | None = None) -> viva_genicam.Camera:
    """Return a camera under our control, which nobody else can then have.

    Raises
    ------
    BusyError
        Another program has it, and for longer than a camera takes to forget a program that was killed.
    DeviceError
        It does not answer.
    """
    vg = viva()
    deadline = time.monotonic() + FORGOTTEN_S
    while True:
        try:
            if camera.transport == "usb3":
                return vg.connect_u3v(camera.handle)  # type: ignore[no-any-return]
            return vg.connect_gige(camera.handle, iface=interface)  # type: ignore[no-any-return]
        except vg.GenicamError as error:
            if not _in_use(camera, interface, str(error)):
                raise DeviceError(
                    f"the camera {camera} cannot be opened: {error}.",
                    fix="Check its cable, power and network address; `holocal doctor`.",
                    code="camera-lost",
                ) from error
            if time.monotonic() > deadline:
                raise BusyError(
                    f"the camera {camera} is under another program's control ({error}).",
                    why="Two programs on one camera disturb each other's measurements.",
                    fix="Close the other program, a viewer for example.",
                    code="camera-busy",
                ) from error
        time.sleep(RETRY_S)


def text_of(camera: viva_genicam.Camera, node: str, register: int = 0) -> str:
    """Return a name that the camera bears: of its node, or of a GigE Vision bootstrap register; "" without either."""
    vg = viva()
    try:
        if node in camera.nodes():
            return camera.get(node).strip()
        if register and camera.transport == "gige":
            return camera.read_register(register, NAME_BYTES).split(b"\0")[0].decode(errors="replace").strip()
    except vg.GenicamError:  # optional in the standard: a camera without a name has an empty one
        pass
    return ""


def serial_of(camera: viva_genicam.Camera) -> str:
    """Return the camera's serial number, "" where it has none."""
    return text_of(camera, "DeviceSerialNumber", SERIAL_NUMBER) or text_of(camera, "DeviceID")


def _seen_on_network(info: Any, interface: str | None) -> SeenCamera:
    serial = user_id = ""
    vg = viva()
    try:
        with vg.connect_gige(info, iface=interface, monitor=True) as camera:  # reads, claims nothing
            serial, user_id = serial_of(camera), text_of(camera, "DeviceUserID", USER_NAME)
    except vg.GenicamError:  # in exclusive use elsewhere, or gone since: listed by what its discovery answer said
        pass
    return SeenCamera("gige", info.manufacturer or "", info.model or "", serial, user_id, info.ip, info)


def _usb_devices() -> list[Any]:
    vg = viva()
    try:
        return vg.discover_u3v()  # type: ignore[no-any-return]
    except vg.GenicamError as error:  # a machine without USB, a container for example, has no cameras on it
        LOGGER.info("USB was not searched for cameras: %s", error)
        return []


def _seen_on_usb(info: Any) -> SeenCamera:
    where = f"USB bus {info.bus} device {info.address}"
    return SeenCamera("usb3", info.manufacturer or "", info.model or "", info.serial or "", "", where, info)


def _fits(camera: SeenCamera, table: GenicamTable) -> bool:
    wanted = ((table.transport, camera.transport), (table.serial, camera.serial), (table.user_id, camera.user_id))
    return all(want is None or want == has for want, has in (*wanted, (table.address, camera.address)))


def _nothing_fits(table: GenicamTable, seen: tuple[SeenCamera, ...], source: str) -> DeviceError | RefusedError:
    named = {key: getattr(table, key) for key in ("transport", "serial", "user_id", "address")}
    wanted = ", ".join(f"camera.{key} = {value!r}" for key, value in named.items() if value is not None)
    if not seen:
        where = f" on the network card {table.interface}" if table.interface else ""
        return DeviceError(
            f"{source}: no camera answers{where}; wanted is {wanted or 'any'}.",
            fix="Check cable, power, and that the camera's address is in the subnet of its network card.",
            measured=0,
            limit=1,
            code="no-camera",
        )
    return RefusedError(
        f"{source}: {wanted}, and what answers is {_list(seen)}.",
        why="A calibration belongs to one device.",
        fix="Connect that camera, or name the one that is there in the file of another rig.",
        measured=[camera.serial for camera in seen],
        limit=wanted,
        code="other-device",
    )


def _in_use(camera: SeenCamera, interface: str | None, said: str) -> bool:
    """Return whether another program holds the camera: by the camera's own words, or by its control register."""
    if "ACCESS_DENIED" in said or "busy" in said.lower():  # GigE Vision's status; the operating system's for USB
        return True
    if camera.transport != "gige":
        return False
    vg = viva()
    try:
        with vg.connect_gige(camera.handle, iface=interface, monitor=True) as watched:
            return any(watched.read_register(CONTROL_PRIVILEGE, 4))
    except vg.GenicamError:
        return False


def _list(cameras: tuple[SeenCamera, ...] | list[SeenCamera]) -> str:
    return "; ".join(str(camera) for camera in cameras)
