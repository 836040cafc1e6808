"""Cuts a mesh into convex pieces, in a process of its own: pieces.py < mesh > pieces.

The library is written in C++ and may take hours over a mesh or crash, so it gets its own process. This file imports nothing of
the package, so that it starts at once.
"""

import io
import resource
import sys

import numpy as np

THRESHOLD = 0.04  # remaining concavity, as a share of the mesh's size
# Iterations and resolution of the library's search, by whether the surface is closed, and by effort.
SEARCH = {
    (True, "careful"): (60, 1000),
    (False, "careful"): (10, 500),
    (True, "quick"): (10, 300),
    (False, "quick"): (3, 300),
}
REPAIR = {"careful": 30, "quick": 15}  # cells along an open surface that is made closed
MAX_MEMORY = 1_500_000_000  # bytes beyond what the libraries take to load


def main(most: int, corners: int, seconds: int, closed: bool, effort: str) -> None:
    """Reads ``vertices`` and ``faces`` (npz), writes ``points`` and ``sizes`` of the pieces.

    Args:
        most, corners: greatest number of pieces, and of corners of each.
        seconds: CPU time.
        closed: the surface has no holes.
        effort: ``careful`` or ``quick``.
    """
    import coacd

    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    with open("/proc/self/statm") as file:
        now = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + MAX_MEMORY, now + MAX_MEMORY))
    coacd.set_log_level("off")
    iterations, resolution = SEARCH[closed, effort]
    with np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False) as mesh:
        found = coacd.run_coacd(
            coacd.Mesh(mesh["vertices"], mesh["faces"]),
            threshold=THRESHOLD,
            max_convex_hull=most,
            preprocess_mode="off" if closed else "on",  # a surface with holes becomes a thicker one without
            preprocess_resolution=REPAIR[effort],
            mcts_iterations=iterations,
            resolution=resolution,
            decimate=True,
            max_ch_vertex=corners,
            seed=0,
        )
    out = io.BytesIO()
    np.savez(out, points=np.concatenate([part[0] for part in found]), sizes=np.array([len(part[0]) for part in found]))
    sys.stdout.buffer.write(out.getvalue())


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4] == "closed", sys.argv[5])
