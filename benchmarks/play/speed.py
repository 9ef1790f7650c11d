"""Measures the server of a run without a browser: ``python -m benchmarks.play.speed runs/tiny --data-dir data``.

Arguments after the run go to ``experiments.play``. A client on the same machine sends a step when it has the frame of
the one before, and times each from its message to its frame.
"""

import sys
import time

import numpy as np
from websockets.sync.client import connect

from benchmarks.play.latency import server
from tests.tools.play.client import Client, Picture

STEPS = 300


def main() -> None:
    """Prints frames a second, and times from message to frame in milliseconds."""
    with server(sys.argv[1:]) as address, connect(address.replace("http", "ws", 1) + "ws", max_size=2**24) as socket:
        page = Client(socket)
        page.next()
        page.ask("start", clip=0)
        for kinds in ((), ("depth",), ("depth", "truth")):
            page.ask("watch", kinds=list(kinds))
            times = []
            inside = []
            for _ in range(STEPS):
                began = time.perf_counter()
                number = page.send("step", branch=0, source={"kind": "random"})
                while not (isinstance(frame := page.next(), Picture) and frame.id == number and frame.kind == 1):
                    pass
                times.append(1000 * (time.perf_counter() - began))
                inside.append(page.wait(number)["ms"])
            page.ask("start", clip=0)
            rate = 1000 / np.mean(times)
            half, most = np.percentile(times, [50, 95])
            line = (
                f"{rate:.1f} frames a second, {half:.1f} ms (95 %: {most:.1f}), {np.median(inside):.1f} in the server"
            )
            print(f"{', '.join(('picture', *kinds))}: {line}", flush=True)


if __name__ == "__main__":
    main()
