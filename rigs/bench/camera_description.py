"""The GenICam description of the bench's camera: which features it has, and in which registers they are.

libaravis's fake camera implements the registers below 0x400 (sizes, exposure, trigger, pixel format); its own
description lacks 12 bits and what a maker's camera comes with switched on. The registers from 0x8000 are ours.
"""

from __future__ import annotations

from collections.abc import Mapping

from rigs.bench.pixel_formats import FORMATS

WIDTH, HEIGHT, OFFSET_X, OFFSET_Y = 0x100, 0x104, 0x130, 0x134
SENSOR_HEIGHT, SENSOR_WIDTH = 0x118, 0x11C
GAIN_AUTO, EXPOSURE_US, ACQUISITION, PIXEL_FORMAT, ACQUISITION_MODE = 0x114, 0x120, 0x124, 0x128, 0x12C
TRIGGER_MODE, TRIGGER_SOURCE, TRIGGER_SOFTWARE = 0x300, 0x304, 0x30C
EXPOSURE_AUTO, GAMMA_ENABLE, TEMPERATURE_CENTI_C = 0x8000, 0x8004, 0x8008
VENDOR_NAME, MODEL_NAME, DEVICE_VERSION, SERIAL_NUMBER = 0x48, 0x68, 0x88, 0xD8
OFF, CONTINUOUS = 1, 2

HEAD = """<?xml version="1.0" encoding="utf-8"?>
<RegisterDescription ModelName="Bench" VendorName="holocal" StandardNameSpace="GEV" SchemaMajorVersion="1"
 SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1" MinorVersion="0" SubMinorVersion="0"
 ToolTip="simulated bench" ProductGuid="8f0c2c0e-3c52-4a7e-9a10-0f3c5d1b7e01"
 VersionGuid="8f0c2c0e-3c52-4a7e-9a10-0f3c5d1b7e02" xmlns="http://www.genicam.org/GenApi/Version_1_1">
"""


def description(*, width: int, height: int, exposure_us: tuple[int, int]) -> str:
    """Return the XML of a camera with that sensor and those exposure bounds (whole microseconds)."""
    features = (
        _text("DeviceVendorName", VENDOR_NAME, 32)
        + _text("DeviceModelName", MODEL_NAME, 32)
        + _text("DeviceVersion", DEVICE_VERSION, 32)
        + _text("DeviceSerialNumber", SERIAL_NUMBER, 16)
        + _scaled("DeviceTemperature", TEMPERATURE_CENTI_C, 100, access="RO")
        + _integer("SensorWidth", SENSOR_WIDTH, 1, width, access="RO")
        + _integer("SensorHeight", SENSOR_HEIGHT, 1, height, access="RO")
        + _integer("Width", WIDTH, 1, width)
        + _integer("Height", HEIGHT, 1, height)
        + _integer("OffsetX", OFFSET_X, 0, width - 1)
        + _integer("OffsetY", OFFSET_Y, 0, height - 1)
        + _enumeration("PixelFormat", PIXEL_FORMAT, {form.name: form.code for form in FORMATS})
        + _enumeration("AcquisitionMode", ACQUISITION_MODE, {"Continuous": 1, "SingleFrame": 2, "MultiFrame": 3})
        + _command("AcquisitionStart", ACQUISITION, 1)
        + _command("AcquisitionStop", ACQUISITION, 0)
        + '<Enumeration Name="TriggerSelector"><EnumEntry Name="FrameStart"><Value>0</Value></EnumEntry>'
        + "<Value>0</Value></Enumeration>"
        + _enumeration("TriggerMode", TRIGGER_MODE, {"Off": 0, "On": 1})
        + _enumeration("TriggerSource", TRIGGER_SOURCE, {"Line0": 0, "Software": 1})
        + _command("TriggerSoftware", TRIGGER_SOFTWARE, 1)
        + _scaled("ExposureTime", EXPOSURE_US, 1, bounds=exposure_us)
        + _enumeration("ExposureAuto", EXPOSURE_AUTO, {"Off": OFF, "Continuous": CONTINUOUS})
        + _enumeration("GainAuto", GAIN_AUTO, {"Off": OFF, "Once": 3, "Continuous": CONTINUOUS})
        + f'<Boolean Name="GammaEnable"><pValue>GammaEnableRegister</pValue><OnValue>{CONTINUOUS}</OnValue>'
        + f"<OffValue>{OFF}</OffValue></Boolean>"
        + _register("GammaEnableRegister", GAMMA_ENABLE)
        + '<IntSwissKnife Name="PayloadSize"><pVariable Name="W">Width</pVariable>'
        + '<pVariable Name="H">Height</pVariable><pVariable Name="F">PixelFormat</pVariable>'
        + "<Formula>W * H * ((F &gt;&gt; 16) &amp; 0xFF) / 8</Formula>"
        + '</IntSwissKnife><Integer Name="TLParamsLocked"><Value>0</Value><Min>0</Min><Max>1</Max></Integer>'
        + '<Port Name="Device"/>'
    )
    return f"{HEAD}{features}</RegisterDescription>"


def _text(name: str, address: int, length: int) -> str:
    return (
        f'<StringReg Name="{name}"><Address>{address:#x}</Address><Length>{length}</Length>'
        "<AccessMode>RO</AccessMode><pPort>Device</pPort></StringReg>"
    )


def _register(name: str, address: int, access: str = "RW") -> str:
    return (
        f'<IntReg Name="{name}"><Address>{address:#x}</Address><Length>4</Length><AccessMode>{access}</AccessMode>'
        "<pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"
    )


def _integer(name: str, address: int, low: int, high: int, access: str = "RW") -> str:
    return (
        f'<Integer Name="{name}"><pValue>{name}Register</pValue><Min>{low}</Min><Max>{high}</Max></Integer>'
        + _register(f"{name}Register", address, access)
    )


def _scaled(name: str, address: int, parts: int, *, bounds: tuple[int, int] | None = None, access: str = "RW") -> str:
    """Return a float feature that its register holds in whole parts."""
    limits = f"<Min>{bounds[0]}.0</Min><Max>{bounds[1]}.0</Max>" if bounds is not None else ""
    return (
        f'<Float Name="{name}"><pValue>{name}Converter</pValue>{limits}</Float>'
        f'<Converter Name="{name}Converter"><FormulaTo>FROM * {parts}</FormulaTo>'
        f"<FormulaFrom>TO / {parts}.0</FormulaFrom><pValue>{name}Register</pValue></Converter>"
        + _register(f"{name}Register", address, access)
    )


def _enumeration(name: str, address: int, entries: Mapping[str, int]) -> str:
    listed = "".join(f'<EnumEntry Name="{key}"><Value>{value}</Value></EnumEntry>' for key, value in entries.items())
    return f'<Enumeration Name="{name}">{listed}<pValue>{name}Register</pValue></Enumeration>' + _register(
        f"{name}Register", address
    )


def _command(name: str, address: int, value: int) -> str:
    return (
        f'<Command Name="{name}"><pValue>{name}Register</pValue><CommandValue>{value}</CommandValue></Command>'
        + _register(f"{name}Register", address, "WO")
    )
