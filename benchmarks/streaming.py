"""Latency of streamed ranges: from the bytes of the report at the port to a datagram in another process, in ms.

`python -m benchmarks.streaming` uses served boards on this computer, so the latency excludes the board and USB.
"""

import socket
import threading
import time

import numpy as np

import uwblink
from tests.boards import served
from uwblink.streaming import UdpSender
from uwblink.wire import RangeReport

COUNT = 1000


def main() -> None:
    """Print the median and the 99th percentile of the latencies."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear, served() as server:
        ear.bind(("127.0.0.1", 0))
        arrived: list[int] = []

        def listen() -> None:
            while len(arrived) < COUNT:
                ear.recv(65536)
                arrived.append(time.time_ns())

        listener = threading.Thread(target=listen, daemon=True)
        listener.start()
        came: list[int] = []
        sent = 0

        def note(heard: uwblink.Heard) -> None:
            if isinstance(heard.message, RangeReport):
                came.append(heard.time_ns)

        names = [str(name) for name in server.names.values()]
        plan = uwblink.RangingPlan(rate_hz=100.0)
        with UdpSender(str(ear.getsockname()[1])) as sender:
            for found in uwblink.stream(names, plan=plan, listeners=[note]):
                if isinstance(found, uwblink.StreamedRange):
                    sender.send(found)
                    sent += 1
                if sent >= COUNT:
                    break
        listener.join(10)
    late = (np.array(arrived) - np.array(came[: len(arrived)])) * 1e-6
    print(f"{len(late)} ranges: median {np.median(late):.2f} ms, 99 % within {np.percentile(late, 99):.2f} ms")


if __name__ == "__main__":
    main()
