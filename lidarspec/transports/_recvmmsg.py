"""Linux's recvmmsg, which Python does not have: many datagrams in one system call.

Each system call of Python gives the interpreter away and has to win it back, which takes milliseconds beside a thread that
computes. With a call for each datagram that is too slow for a fast sensor; with one for hundreds it does not matter.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import struct
import sys

#: datagrams in one call, and the room for each: memory that is not written to costs nothing.
MANY, LARGEST = 256, 1 << 16
NAME, CONTROL = 32, 128
_HEADER, _TWO = struct.Struct("@Nii"), struct.Struct("@Niiqq")
_ALIGN = struct.calcsize("@N")


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("size", ctypes.c_size_t))


class _Message(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_size", ctypes.c_uint32),
        ("vectors", ctypes.POINTER(_Vector)),
        ("vectors_number", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_size", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Datagram(ctypes.Structure):
    _fields_ = (("message", _Message), ("size", ctypes.c_uint))


#: where the size of the first datagram, and of what is told with it, stand in the headers, and how far on the next ones do, in words.
_SIZE, _SIZE_STEP = (part // ctypes.sizeof(ctypes.c_uint) for part in (_Datagram.size.offset, ctypes.sizeof(_Datagram)))
_TOLD, _TOLD_STEP = (part // ctypes.sizeof(ctypes.c_size_t) for part in (_Message.control_size.offset, ctypes.sizeof(_Datagram)))


class Slots:
    """Room for many datagrams, used again and again.

    Raises:
        OSError: where the system has no recvmmsg.
    """

    def __init__(self) -> None:
        try:
            self._call = ctypes.CDLL(None, use_errno=True).recvmmsg
        except (AttributeError, TypeError):
            raise OSError("this system has no recvmmsg") from None
        self._call.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
        self._payload, self._names, self._control = (ctypes.create_string_buffer(MANY * size) for size in (LARGEST, NAME, CONTROL))
        self._data, self._senders, self._said = (memoryview(part).cast("B") for part in (self._payload, self._names, self._control))
        self._vectors = (_Vector * MANY)()
        self._headers = ctypes.create_string_buffer(MANY * ctypes.sizeof(_Datagram))
        self._datagrams = (_Datagram * MANY).from_buffer(self._headers)
        # An access to a field by its name costs more than a datagram should.
        self._sizes, self._told = memoryview(self._headers).cast("B").cast("I"), memoryview(self._headers).cast("B").cast("P")
        for index in range(MANY):
            self._vectors[index] = _Vector(ctypes.addressof(self._payload) + index * LARGEST, LARGEST)
            message = self._datagrams[index].message
            message.name, message.name_size = ctypes.addressof(self._names) + index * NAME, NAME
            message.vectors, message.vectors_number = ctypes.pointer(self._vectors[index]), 1
            message.control, message.control_size = ctypes.addressof(self._control) + index * CONTROL, CONTROL
        self._fresh = self._headers.raw
        self._known: dict[bytes, tuple[str, int]] = {}

    def fill(self, descriptor: int) -> int:
        """The number of datagrams fetched from a socket, at most `MANY`; 0 where none waits.

        Raises:
            OSError: what the system says.
        """
        ctypes.memmove(self._headers, self._fresh, len(self._fresh))  # the kernel wrote over the sizes
        number: int = self._call(descriptor, self._datagrams, MANY, socket.MSG_DONTWAIT, None)
        if number < 0:
            code = ctypes.get_errno()
            if code in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR):
                return 0
            raise OSError(code, os.strerror(code))
        return number

    def datagram(self, index: int) -> tuple[bytes, tuple[str, int]]:
        """A datagram that was fetched, and its sender."""
        start = index * LARGEST
        data = self._data[start : start + self._sizes[_SIZE + index * _SIZE_STEP]].tobytes()
        name = self._senders[index * NAME : index * NAME + NAME].tobytes()
        sender = self._known.get(name)
        if sender is None:
            if len(self._known) >= MANY:
                self._known.clear()
            sender = self._known[name] = _address(name)
        return data, sender

    def numbers(self, index: int) -> tuple[int, int, int] | None:
        """What the socket layer said with a datagram, if it is one value of two numbers: its type, and these; else None."""
        if self._told[_TOLD + index * _TOLD_STEP] != _TWO.size:
            return None
        size, level, kind, first, second = _TWO.unpack_from(self._said, index * CONTROL)
        return (kind, first, second) if size == _TWO.size and level == socket.SOL_SOCKET else None

    def said(self, index: int) -> list[tuple[int, memoryview]]:
        """What the socket layer said with a datagram: type and value."""
        start, found = index * CONTROL, []
        end = start + self._told[_TOLD + index * _TOLD_STEP]
        while start + _HEADER.size <= end:
            size, level, kind = _HEADER.unpack_from(self._said, start)
            if size < _HEADER.size:
                break
            if level == socket.SOL_SOCKET:
                found.append((kind, self._said[start + _HEADER.size : start + size]))
            start += -(-size // _ALIGN) * _ALIGN
        return found


def _address(name: bytes) -> tuple[str, int]:
    """Host and port of a socket address as the kernel writes it."""
    family, port = int.from_bytes(name[:2], sys.byteorder), int.from_bytes(name[2:4], "big")
    packed = name[8:24] if family == socket.AF_INET6 else name[4:8]
    return socket.inet_ntop(family, packed), port
