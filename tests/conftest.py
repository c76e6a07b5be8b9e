"""Ctrl-C reaches the programs that tests start, also in the background of a shell, where it is ignored and that is inherited."""

from __future__ import annotations

import signal

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
