"""The command line: `scp-mpc report`, `coverage`, `replay`, `export`. The only file that prints."""

import json as json_format
import runpy
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from scp_mpc import MPC, Containment, Margin, ScpMpcError, Settings, __version__
from scp_mpc import export as write_export
from scp_mpc.arrays import as_count
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.problem import Problem
from scp_mpc.report import (
    coverage_figure,
    coverage_numbers,
    coverage_table,
    replay_figure,
    replay_table,
    save,
    summarise_replay,
    table_cells,
    write_animation,
    write_figures,
    write_replay_animation,
    write_summary,
)
from scp_mpc.simulation import (
    SCENARIOS,
    STEPS,
    Crossing,
    Recording,
    Run,
    control_steps,
    measure_coverage,
    read_recording,
    replay_problem,
)
from scp_mpc.simulation import replay as run_replay
from scp_mpc.tracking import TrackerSettings

try:
    import typer
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from tqdm import tqdm
except ModuleNotFoundError as error:
    raise SystemExit(
        f"scp-mpc: {error.name} is not installed; the command line needs the extra 'cli'"
    ) from None

_ANIMATED = "scenario-4"

app = typer.Typer(
    help="Model predictive control among moving, Gaussian-predicted obstacles.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"scp-mpc {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Offer the options that belong to no command."""


@app.command()
def report(
    out: Annotated[Path, typer.Option(help="Directory for everything that is written.")],
    steps: Annotated[int, typer.Option(help="Control steps of 0.2 s per scenario.")] = STEPS,
    seed: Annotated[int, typer.Option(help="Seed of the disturbance.")] = 0,
    inflation: Annotated[str, typer.Option(help='Shape of the no-go set: "axes" or "exact".')] = (
        "axes"
    ),
    s_min: Annotated[
        float | None, typer.Option(help="Smallest size s; s_ref if not given.")
    ] = None,
    animation: Annotated[bool, typer.Option(help="Write the animated GIF too.")] = True,
    multi_start: Annotated[
        bool, typer.Option(help="Try other ways past the obstacles, too.")
    ] = True,
) -> None:
    """Run the four scenarios; write their table, figures and animation."""
    with _one_line_errors():
        margin = Margin() if s_min is None else Margin(lower=s_min)
        settings = Settings(multi_start=multi_start, deadline=None)
        shape = cast(Literal["axes", "exact"], inflation)  # the problem checks it
        problems = {name: o.problem(shape, margin) for name, o in SCENARIOS.items()}
        as_count("steps", steps)
        if seed < 0:
            raise BoundsError("seed", f"{seed} is negative")
        out.mkdir(parents=True, exist_ok=True)
        runs = _run_all(problems, settings, steps, seed)
        summary = write_summary(list(runs.values()), out)
        Console(markup=False).print(_table(summary["scenarios"]))
        typer.echo("Drawing ...")
        figures = write_figures(list(runs.values()), out)
        written = f"summary.json, summary.md, {len(figures)} figures"
        if animation:
            file = write_animation(runs[_ANIMATED], out / f"{_ANIMATED}.gif")
            written += f", {file.name}"
        typer.echo(f"Written to {out}: {written}")


_File = Annotated[
    Path, typer.Argument(help="Recording: OpenTraj's obsmat.txt, or text: frame id x y.")
]
_Rate = Annotated[
    float | None,
    typer.Option(help="Frame numbers per second; an obsmat's velocities tell it if not given."),
]
_Layout = Annotated[
    str | None, typer.Option(help='"obsmat" or "text"; told from the columns if not given.')
]
_Noise = Annotated[float, typer.Option(help="Standard deviation of the measurements' errors [m].")]
_StdInflation = Annotated[
    float, typer.Option(help="Factor on the standard deviations of predictions.")
]


@app.command()
def coverage(
    file: _File,
    rate: _Rate = None,
    layout: _Layout = None,
    noise: _Noise = 0.05,
    seed: Annotated[int, typer.Option(help="Seed of the errors.")] = 0,
    std_inflation: _StdInflation = 1.0,
    json: Annotated[Path | None, typer.Option(help="File for the numbers.")] = None,
    figure: Annotated[Path | None, typer.Option(help="File for the figure, PNG.")] = None,
) -> None:
    """Count how often recorded people are where the tracker said that they would be."""
    with _one_line_errors():
        settings = TrackerSettings(std_inflation=std_inflation)
        recording = _recording(file, rate, layout)
        with tqdm(total=len(recording.times), unit="frame") as bar:
            found = measure_coverage(
                recording, noise=noise, seed=seed, settings=settings, advance=bar.update
            )
        header, *rows = coverage_table(found)
        table = Table(*header, box=SIMPLE_HEAD, padding=(0, 0))
        for column in table.columns:
            column.justify = "right"
        for row in rows:
            table.add_row(*row)
        Console(markup=False).print(table)
        typer.echo(
            "Predicted: the RMS error that the covariances tell. NEES: 2 is right. ±: one "
            "standard error."
        )
        if json is not None:
            _write_json(coverage_numbers(found), json)
        if figure is not None:
            typer.echo(f"Written to {save(coverage_figure(found), figure)}")


@app.command()
def replay(
    file: _File,
    out: Annotated[
        Path | None, typer.Option(help="Directory for replay.json, replay.png and replay.gif.")
    ] = None,
    rate: _Rate = None,
    layout: _Layout = None,
    course: Annotated[str, typer.Option(help='The main flow: "along" it or "across".')] = "along",
    start: Annotated[
        tuple[float, float] | None, typer.Option(help="Where the robot starts [m]; with --goal.")
    ] = None,
    goal: Annotated[tuple[float, float] | None, typer.Option(help="Where to [m].")] = None,
    speed: Annotated[float, typer.Option(help="Of the robot's reference [m/s].")] = 1.3,
    horizon: Annotated[int, typer.Option(help="Intervals of 0.2 s to plan ahead.")] = 15,
    level: Annotated[
        float, typer.Option(help="Share of positions that the ellipses to avoid are to hold.")
    ] = 0.95,
    obstacles: Annotated[int, typer.Option(help="How many of the nearest people count.")] = 20,
    noise: _Noise = 0.05,
    seed: Annotated[int, typer.Option(help="Seed of the errors.")] = 0,
    std_inflation: _StdInflation = 1.0,
    steps: Annotated[
        int | None, typer.Option(help="Control steps of 0.2 s; to the recording's end.")
    ] = None,
    animation: Annotated[bool, typer.Option(help="Write the animated GIF too.")] = True,
) -> None:
    """Drive a robot through a recorded crowd, there and back again."""
    with _one_line_errors():
        if (start is None) != (goal is None):
            raise InvalidArgumentError("start", "goes with a goal, and a goal with a start")
        tracking = TrackerSettings(std_inflation=std_inflation)
        problem = replay_problem(horizon, Containment(level), obstacles)
        recording = _recording(file, rate, layout)
        if start is not None and goal is not None:
            crossing = Crossing(start, goal, speed)
        else:
            way = cast(Literal["along", "across"], course)  # the crossing checks it
            crossing = Crossing.through(recording, way, speed)
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
        with tqdm(total=control_steps(recording, steps), unit="step") as bar:
            run = run_replay(
                *(recording, crossing, problem),
                noise=noise,
                seed=seed,
                steps=steps,
                tracking=tracking,
                advance=bar.update,
            )
        numbers = {**summarise_replay(run), "noise_m": noise}
        table = Table(show_header=False)
        for name, value in replay_table(numbers):
            table.add_row(name, value)
        Console(markup=False).print(table)
        typer.echo("People walk as they were recorded: they do not react to the robot.")
        if out is not None:
            _write_json(numbers, out / "replay.json")
            typer.echo("Drawing ...")
            written = [save(replay_figure(run), out / "replay.png")]
            if animation:
                written.append(write_replay_animation(run, out / "replay.gif"))
            typer.echo(f"Written to {out}: {', '.join(path.name for path in written)}")


@app.command()
def export(
    source: Annotated[
        str,
        typer.Argument(
            help="A scenario of the report, scenario-1 to scenario-4, or a Python file that makes "
            "a Problem of the name `problem` and perhaps Settings `settings`."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Directory for the package.")],
    name: Annotated[str, typer.Option(help="Of the CMake package and its functions.")] = "robot",
) -> None:
    """Write a controller in C99 for one problem: sources, CMake files, example, test vectors."""
    with _one_line_errors():
        made: dict[str, Any] = {"settings": Settings()}
        if source in SCENARIOS:
            made["problem"] = SCENARIOS[source].problem()
        else:
            made |= runpy.run_path(source)
        for kind in (Problem, Settings):
            if not isinstance(made.get(kind.__name__.lower()), kind):
                lacking = f"makes no `{kind.__name__.lower()}` that is a {kind.__name__}"
                raise InvalidArgumentError("source", f"{source} {lacking}")
        typer.echo(f"Written to {write_export(made['problem'], made['settings'], out, name)}")


def _recording(file: Path, rate: float | None, layout: str | None) -> Recording:
    form = cast(Literal["obsmat", "text"] | None, layout)  # the reader checks it
    return read_recording(file, rate=rate, layout=form)


def _write_json(numbers: dict[str, Any], file: Path) -> None:
    text = json_format.dumps(numbers, indent=2, allow_nan=False) + "\n"
    file.write_text(text, encoding="utf-8")
    typer.echo(f"Written to {file}")


def _run_all(
    problems: dict[str, Problem], settings: Settings, steps: int, seed: int
) -> dict[str, Run]:
    runs = {}
    with tqdm(total=steps * len(problems), unit="step") as bar:
        for name, problem in problems.items():
            bar.set_description(name)
            mpc = MPC(problem, settings)
            runs[name] = SCENARIOS[name].run(mpc, steps, seed, advance=bar.update)
    return runs


def _table(scenarios: list[dict[str, Any]]) -> Table:
    """The table of the summary, turned so that it fits a terminal: one column per scenario."""
    columns = [table_cells(row) for row in scenarios]
    name, *headers = columns[0]
    table = Table(name, *(column[name] for column in columns))
    for right in table.columns[1:]:
        right.justify = "right"
    for header in headers:
        table.add_row(header, *(column[header] for column in columns))
    return table


@contextmanager
def _one_line_errors() -> Iterator[None]:
    """Turn what the user can mend into one line and exit code 1."""
    try:
        yield
    except (ScpMpcError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from None


if __name__ == "__main__":
    app()
