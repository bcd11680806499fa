"""A GenTL producer of the tests' own: compiled on demand, with the description that it carries."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).parent
# In the order of producer.c:
NUMBERS = """Width Height OffsetX OffsetY PixelFormat PayloadSize Acquire TriggerMode TriggerSource
    Trigger ExposureTime Latch TimestampLatchValue Skip Break Vanish PaddingX Rate"""
FEATURES = """Width Height OffsetX OffsetY WidthMax HeightMax PixelFormat PayloadSize TriggerMode
    TriggerSource TriggerSoftware ExposureTime AcquisitionFrameRate AcquisitionStart AcquisitionStop
    TimestampLatch TimestampLatchValue Skip Break Vanish PaddingX"""
FORMATS = {
    "BayerRG12": 0x01100011,
    "BayerGR12": 0x01100010,
    "BayerGB12": 0x01100012,
    "BayerBG12": 0x01100013,
    "BayerRG12p": 0x010C0059,
    "BayerGR12p": 0x010C0057,
    "BayerGB12p": 0x010C0055,
    "BayerBG12p": 0x010C0053,
    "BayerRG12Packed": 0x010C002B,
    "BayerGR12Packed": 0x010C002A,
    "BayerGB12Packed": 0x010C002C,
    "BayerBG12Packed": 0x010C002D,
    "BayerRG8": 0x01080009,
    "BayerGR8": 0x01080008,
    "BayerGB8": 0x0108000A,
    "BayerBG8": 0x0108000B,
}


def compiler() -> str:
    """The C compiler's path; "" where there is none."""
    return shutil.which("gcc") or shutil.which("cc") or ""


def build(folder: Path, film: NDArray[np.uint16] | None = None) -> Path:
    """Compile the producer into `folder`; `film` (N, 96, 128) 12 bit is what its camera sees."""
    xml, pictures, made = folder / "toy.xml", folder / "film", folder / "toy.cti"
    xml.write_text(description())
    if film is not None:
        pictures.write_bytes(film.astype("<u2").tobytes())
    options = ["-std=gnu11", "-O1", "-shared", "-fPIC", "-pthread"]
    options += [f'-DXML="{xml}"', f'-DFILM="{pictures}"']
    subprocess.run([compiler(), *options, "-o", made, HERE / "producer.c"], check=True)
    return made


def sensor(x: int, y: int, width: int, height: int) -> NDArray[np.uint16]:
    """What the camera's sensor holds there, (H, W) 12 bit."""
    rows, columns = np.mgrid[y : y + height, x : x + width]
    held: NDArray[np.uint16] = ((37 * columns + 101 * rows + 5) % 4096).astype(np.uint16)
    return held


def description() -> str:
    """The camera's GenICam file."""
    registers = "".join(
        f'<IntReg Name="{name}Register"><Address>{8 * k}</Address><Length>8</Length>'
        "<AccessMode>RW</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>"
        "<Sign>Signed</Sign><Endianess>LittleEndian</Endianess></IntReg>"
        for k, name in enumerate(NUMBERS.split())
    )
    plain = _integer("Width", 1, 128) + _integer("Height", 1, 96) + _integer("OffsetX", 0, 127)
    plain += _integer("OffsetY", 0, 95) + _integer("PayloadSize", 0, 1 << 20)
    plain += _integer("TimestampLatchValue", 0, 1 << 62)
    plain += "".join(_integer(name, 0, 1 << 30) for name in ("Skip", "Break", "Vanish", "PaddingX"))
    plain += _integer("WidthMax", 128, 128, "<Value>128</Value>")
    plain += _integer("HeightMax", 96, 96, "<Value>96</Value>")
    exposure = (
        '<Converter Name="ExposureTimeConverter"><FormulaTo>FROM</FormulaTo>'
        "<FormulaFrom>TO</FormulaFrom><pValue>ExposureTimeRegister</pValue></Converter>"
        '<Float Name="ExposureTime"><pValue>ExposureTimeConverter</pValue><Min>10</Min>'
        "<Max>1000000</Max></Float>"
        '<Converter Name="RateConverter"><FormulaTo>FROM * 1000</FormulaTo>'
        "<FormulaFrom>TO / 1000.0</FormulaFrom><pValue>RateRegister</pValue></Converter>"
        '<Float Name="AcquisitionFrameRate"><pValue>RateConverter</pValue><Min>1</Min>'
        "<Max>1000</Max></Float>"
    )
    choices = _choice("PixelFormat", FORMATS) + _choice("TriggerMode", {"Off": 0, "On": 1})
    choices += _choice("TriggerSource", {"Software": 0, "Line0": 1})
    commands = "".join(
        f'<Command Name="{name}"><pValue>{register}Register</pValue>'
        f"<CommandValue>{value}</CommandValue></Command>"
        for name, register, value in (
            ("AcquisitionStart", "Acquire", 1),
            ("AcquisitionStop", "Acquire", 0),
            ("TriggerSoftware", "Trigger", 1),
            ("TimestampLatch", "Latch", 1),
        )
    )
    root = "".join(f"<pFeature>{name}</pFeature>" for name in FEATURES.split())
    return (
        '<?xml version="1.0" encoding="utf-8"?><RegisterDescription ModelName="Toy12" '
        'VendorName="Umbra" ToolTip="" StandardNameSpace="None" SchemaMajorVersion="1" '
        'SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1" MinorVersion="0" '
        'SubMinorVersion="0" ProductGuid="1F3C6A72-7842-4edd-9130-E2E90A2058BA" '
        'VersionGuid="7645D2A1-A41E-4ac6-B486-1531FB7BECE6" '
        'xmlns="http://www.genicam.org/GenApi/Version_1_1">'
        f'<Category Name="Root" NameSpace="Standard">{root}</Category>'
        f"{plain}{choices}{exposure}{commands}{registers}"
        '<Port Name="Device" NameSpace="Standard"/></RegisterDescription>'
    )


def _integer(name: str, low: int, high: int, value: str = "") -> str:
    value = value or f"<pValue>{name}Register</pValue>"
    return f'<Integer Name="{name}">{value}<Min>{low}</Min><Max>{high}</Max></Integer>'


def _choice(name: str, entries: dict[str, int]) -> str:
    inside = "".join(
        f'<EnumEntry Name="{entry}"><Value>{value}</Value></EnumEntry>'
        for entry, value in entries.items()
    )
    return f'<Enumeration Name="{name}">{inside}<pValue>{name}Register</pValue></Enumeration>'
