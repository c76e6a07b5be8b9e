"""Send frames at a fixed rate from a separate process, whatever the receiver does.

    python rate_sender.py FRAMES SIZE RATE SECONDS BURST TIMES (fd NUMBER | udp PORT)

FRAMES is a file of frames of SIZE bytes each. TIMES is a file for the send time of each frame, as
int64 ns of the monotonic clock ("-" for no file). Prints the number of frames that it sent.
"""

from __future__ import annotations

import os
import socket
import sys
import time
from array import array
from collections.abc import Callable
from pathlib import Path


def sender(kind: str, where: str) -> Callable[[bytes], object]:
    """Return the function that sends one frame."""
    if kind == "udp":
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.connect(("127.0.0.1", int(where)))
        return made.send

    def write(frame: bytes) -> None:
        while frame:
            frame = frame[os.write(int(where), frame) :]

    return write


def main(
    path: str, size: str, rate: str, seconds: str, burst: str, times: str, kind: str, where: str
) -> None:
    """Send the frames, print their number, and wait a moment before closing."""
    data = Path(path).read_bytes()
    step = int(size)
    per_second = float(rate)
    frames = [data[start : start + step] for start in range(0, len(data), step)]
    number = int(per_second * float(seconds))
    together = int(burst)
    send = sender(kind, where)
    sent_at = array("q")
    began = time.monotonic()
    sent = 0
    while sent < number:
        due = min(
            int((time.monotonic() - began) * per_second) // together * together + together, number
        )
        for index in range(sent, due):
            send(frames[index % len(frames)])
            sent_at.append(time.monotonic_ns())
        sent = max(sent, due)
        time.sleep(max(0.0002, began + sent / per_second - time.monotonic()))
    if times != "-":
        Path(times).write_bytes(sent_at.tobytes())
    print(sent, flush=True)
    time.sleep(0.2)


if __name__ == "__main__":
    main(*sys.argv[1:])
