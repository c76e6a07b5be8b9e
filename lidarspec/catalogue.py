"""The CRCs in common use, by the names that catalogues give them."""

from __future__ import annotations

from lidarspec.checksums import Crc


def _crc(width: int, poly: int, init: int = 0, *, reflected: bool = False, xorout: int = 0) -> Crc:
    return Crc(width, poly, init, reflected, reflected, xorout)


_ONES = 0xFFFF_FFFF

#: name -> its parameters, the most used first.
CRCS: dict[str, Crc] = {
    "CRC-32": _crc(32, 0x04C11DB7, _ONES, reflected=True, xorout=_ONES),
    "CRC-16/MODBUS": _crc(16, 0x8005, 0xFFFF, reflected=True),
    "CRC-16/CCITT-FALSE": _crc(16, 0x1021, 0xFFFF),
    "CRC-16/XMODEM": _crc(16, 0x1021),
    "CRC-8": _crc(8, 0x07),
    "CRC-8/MAXIM": _crc(8, 0x31, reflected=True),
    "CRC-8/LTE": _crc(8, 0x9B),
    "CRC-8/CDMA2000": _crc(8, 0x9B, 0xFF),
    "CRC-8/DARC": _crc(8, 0x39, reflected=True),
    "CRC-8/DVB-S2": _crc(8, 0xD5),
    "CRC-8/AUTOSAR": _crc(8, 0x2F, 0xFF, xorout=0xFF),
    "CRC-8/SAE-J1850": _crc(8, 0x1D, 0xFF, xorout=0xFF),
    "CRC-8/EBU": _crc(8, 0x1D, 0xFF, reflected=True),
    "CRC-8/I-CODE": _crc(8, 0x1D, 0xFD),
    "CRC-8/ITU": _crc(8, 0x07, xorout=0x55),
    "CRC-8/ROHC": _crc(8, 0x07, 0xFF, reflected=True),
    "CRC-8/WCDMA": _crc(8, 0x9B, reflected=True),
    "CRC-8/BLUETOOTH": _crc(8, 0xA7, reflected=True),
    "CRC-8/NRSC-5": _crc(8, 0x31, 0xFF),
    "CRC-16/ARC": _crc(16, 0x8005, reflected=True),
    "CRC-16/BUYPASS": _crc(16, 0x8005),
    "CRC-16/USB": _crc(16, 0x8005, 0xFFFF, reflected=True, xorout=0xFFFF),
    "CRC-16/MAXIM": _crc(16, 0x8005, reflected=True, xorout=0xFFFF),
    "CRC-16/KERMIT": _crc(16, 0x1021, reflected=True),
    "CRC-16/X-25": _crc(16, 0x1021, 0xFFFF, reflected=True, xorout=0xFFFF),
    "CRC-16/MCRF4XX": _crc(16, 0x1021, 0xFFFF, reflected=True),
    "CRC-16/GENIBUS": _crc(16, 0x1021, 0xFFFF, xorout=0xFFFF),
    "CRC-16/AUG-CCITT": _crc(16, 0x1021, 0x1D0F),
    "CRC-16/DNP": _crc(16, 0x3D65, reflected=True, xorout=0xFFFF),
    "CRC-16/EN-13757": _crc(16, 0x3D65, xorout=0xFFFF),
    "CRC-16/T10-DIF": _crc(16, 0x8BB7),
    "CRC-16/DECT-X": _crc(16, 0x0589),
    "CRC-16/TELEDISK": _crc(16, 0xA097),
    "CRC-16/CDMA2000": _crc(16, 0xC867, 0xFFFF),
    "CRC-32/MPEG-2": _crc(32, 0x04C11DB7, _ONES),
    "CRC-32/BZIP2": _crc(32, 0x04C11DB7, _ONES, xorout=_ONES),
    "CRC-32/POSIX": _crc(32, 0x04C11DB7, xorout=_ONES),
    "CRC-32/JAMCRC": _crc(32, 0x04C11DB7, _ONES, reflected=True),
    "CRC-32C": _crc(32, 0x1EDC6F41, _ONES, reflected=True, xorout=_ONES),
    "CRC-32D": _crc(32, 0xA833982B, _ONES, reflected=True, xorout=_ONES),
    "CRC-32/AUTOSAR": _crc(32, 0xF4ACFB13, _ONES, reflected=True, xorout=_ONES),
    "CRC-32Q": _crc(32, 0x814141AB),
    "CRC-32/XFER": _crc(32, 0x000000AF),
}
_NAMES = {crc: name for name, crc in CRCS.items()}
#: polynomials by width.
KNOWN = {width: {crc.poly for crc in CRCS.values() if crc.width == width} for width in (8, 16, 32)}


def name_of(crc: Crc) -> str:
    """The catalogue's name of a CRC, "" where it has none."""
    return _NAMES.get(crc, "")
