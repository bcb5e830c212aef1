"""Byte sources behind pseudo-terminals, to measure driver and recorder without a simulator.

As a script, `python -m benchmarks.sources PORTS RATE SECONDS BURST` prints the names of its ports, waits until each was
asked for its id, then sends numbered reports and prints their number.
"""

from __future__ import annotations

import sys
import time

from uwblink.boards.ports import Terminal
from uwblink.wire.codec import encode
from uwblink.wire.messages import IdReport, RangeReport

PIECE = 64


def report(number: int) -> bytes:
    return encode(RangeReport(99, 3.055, number, 1, 2, 3, 4, 5, -87.4977, -87.5239, -3.4971, 3.5222))


def answer(terminals: list[Terminal], seconds: float) -> set[int]:
    """Answer requests for ids; return the ports that asked."""
    asked, until = set(), time.monotonic() + seconds
    while time.monotonic() < until:
        for k, terminal in enumerate(terminals):
            if b"C01\r" in terminal.read():
                terminal.write(encode(IdReport(k)))
                asked.add(k)
        time.sleep(0.001)
    return asked


def main() -> None:
    ports, rate, seconds, burst = int(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
    terminals = [Terminal() for _ in range(ports)]
    print(" ".join(t.name for t in terminals), flush=True)
    asked: set[int] = set()
    while len(asked) < ports:
        asked |= answer(terminals, 0.05)
    time.sleep(1.0)
    start, sent = time.monotonic(), 0
    while sent < rate * seconds:
        data = b"".join(report(sent + k) for k in range(burst))
        for terminal in terminals:
            # In bursts, bytes are sent in pieces of 64, as by USB.
            for at in range(0, len(data), PIECE if burst > 1 else len(data)):
                terminal.write(data[at : at + (PIECE if burst > 1 else len(data))])
        sent += burst
        time.sleep(max(start + sent / rate - time.monotonic(), 0))
    time.sleep(1.0)
    print(sent * ports, sum(t.lost_bytes for t in terminals), flush=True)


if __name__ == "__main__":
    main()
