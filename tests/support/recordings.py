"""Small recordings that tests share."""

import numpy as np

from scp_mpc.simulation import Recording

HEADER = "# a street\n\n"


def street(people=6, frames=30, interval=0.4, seed=0):
    """People who walk along y, both ways, side by side and one after the other."""
    rng = np.random.default_rng(seed)
    rows = []
    for name in range(people):
        first = int(rng.integers(0, max(frames // 3, 1))) if name else 0
        heading = (-1) ** name
        x, speed = rng.uniform(-2, 2), rng.uniform(0.9, 1.5)
        for k in range(first, frames):
            t = interval * k
            y = heading * (speed * (t - interval * first) - 6.0)
            rows.append((t, name, x + 0.1 * np.sin(t), y))
    table = np.array(rows)
    return Recording.from_rows(table[:, 0], table[:, 1].astype(np.intp), table[:, 2:])


def rows(recording, step):
    """Frame number, name, x and y of everybody, `step` frame numbers apart."""
    for k, (names, places) in enumerate(zip(recording.names, recording.positions, strict=True)):
        for name, (x, y) in zip(names, places, strict=True):
            yield step * k, int(name), float(x), float(y)


def write_obsmat(recording, file, step=10, scale=1.0):
    """With the velocities at the annotations, or `scale` times that."""
    velocity = {
        (time, name): scale * np.gradient(p, times, axis=0)[k] if len(times) > 1 else np.zeros(2)
        for name, (times, p) in recording.paths.items()
        for k, time in enumerate(times)
    }
    lines = []
    for f, n, x, y in rows(recording, step):
        vx, vy = velocity[recording.times[f // step], n]
        lines.append(f"   {f:e}   {n:e}   {x:.9e}   0.0   {y:.9e}   {vx:.9e}   0.0   {vy:.9e}  \n")
    file.write_text(HEADER + "".join(lines))
    return file


def write_text(recording, file, step=10, between="\t"):
    lines = [between.join(map(str, row)) + "\n" for row in rows(recording, step)]
    file.write_text(HEADER + "".join(lines))
    return file
