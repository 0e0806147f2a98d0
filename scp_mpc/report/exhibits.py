"""The gallery's exhibits: which drives are shown, and how."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from scp_mpc.report.gallery import (
    Show,
    Trace,
    instants_figure,
    road_view,
    room_view,
    space_view,
    write_drive_animation,
)
from scp_mpc.settings import Settings
from scp_mpc.simulation.doorway import ROOM, Doorway
from scp_mpc.simulation.drive import Drive, World, drive
from scp_mpc.simulation.flight import Flight
from scp_mpc.simulation.overtaking import Overtaking


@dataclass(frozen=True, eq=False)
class Exhibit:
    """A world, how it is driven through and how that is drawn.

    Attributes:
        name: What files are called.
        world: What to drive through.
        settings: How to plan.
        view: Draws the scene.
        traces: Quantities over time; the animation shows the first two.
        instants: Control steps of the figure.
        size: Of the figure [inch].
        beside: Whether the animation's traces stand beside the scene, else below.
        projection: "3d" in space.
        frames_per_second: Of the animation.
    """

    name: str
    world: World
    settings: Settings
    view: Callable[[Any, Drive], Show]
    traces: Callable[[Drive], Sequence[Trace]]
    instants: Sequence[int]
    size: tuple[float, float]
    beside: bool = False
    projection: str | None = None
    frames_per_second: int = 10

    def drive(self, seed: int = 0) -> Drive:
        """Drive through it."""
        return drive(self.world, self.settings, seed)

    def figure(self, run: Drive) -> Figure:
        """A few instants, and the traces."""
        share = 2.6 if self.beside else 1.3
        return instants_figure(
            run, self.view, self.instants, self.traces(run), self.size, self.projection, share
        )

    def animate(self, run: Drive, directory: Path) -> Path:
        """Write the animation as a GIF."""
        return write_drive_animation(
            run,
            self.view,
            self.traces(run)[:2],
            directory / f"{self.name}.gif",
            beside=self.beside,
            projection=self.projection,
            frames_per_second=self.frames_per_second,
        )


def exhibits() -> dict[str, Exhibit]:
    """Return all of them by name."""
    shown = (
        Exhibit(
            "overtaking",
            Overtaking(),
            Settings(multi_start_interval=2),
            road_view,
            _road_traces,
            (5, 15, 20, 24, 28, 36),
            (13.0, 12.0),
            beside=True,
        ),
        Exhibit(
            "flight",
            Flight(),
            Settings(multi_start_interval=4),
            space_view,
            _flight_traces,
            (10, 45, 80),
            (14.0, 8.5),
            projection="3d",
            frames_per_second=12,
        ),
        Exhibit(
            "doorway",
            Doorway(),
            Settings(multi_start_interval=4),
            partial(room_view, walls=len(Doorway().walls), room=ROOM),
            _doorway_traces,
            (15, 35, 60),
            (14.0, 7.5),
        ),
    )
    return {exhibit.name: exhibit for exhibit in shown}


def _bounds(run: Drive, state: int) -> tuple[float, float]:
    return float(run.problem.x_min[state]), float(run.problem.x_max[state])


def _limits(run: Drive, entry: int) -> tuple[float, float]:
    return float(run.problem.u_min[entry]), float(run.problem.u_max[entry])


def _road_traces(run: Drive) -> list[Trace]:
    x, u = run.states, run.inputs
    return [
        Trace("speed [m/s]", x[:, 3], _bounds(run, 3)),
        Trace("steering [rad]", x[:, 4], _bounds(run, 4)),
        Trace("acceleration [m/s²]", u[:, 0], _limits(run, 0)),
        Trace("x of the car's middle [m]", x[:, 0], _bounds(run, 0)),
    ]


def _flight_traces(run: Drive) -> list[Trace]:
    return [
        Trace("speed [m/s]", np.linalg.norm(run.states[:, 3:6], axis=1), ()),
        Trace("thrust per mass [m/s²]", run.inputs[:, 0], _limits(run, 0)),
    ]


def _doorway_traces(run: Drive) -> list[Trace]:
    return [
        Trace("speed [m/s]", run.states[:, 3], _bounds(run, 3)),
        Trace("turn rate [rad/s]", run.inputs[:, 1], _limits(run, 1)),
    ]
