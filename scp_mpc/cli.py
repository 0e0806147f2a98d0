"""The command line: `scp-mpc report` and `scp-mpc bench`. The only file that prints."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from scp_mpc import Margin, ScpMpcError, Settings, __version__
from scp_mpc.arrays import as_count
from scp_mpc.errors import BoundsError
from scp_mpc.problem import Problem
from scp_mpc.report import COLUMNS, write_animation, write_figures, write_summary
from scp_mpc.simulation import SCENARIOS, STEPS, ClosedLoop, simulate

try:
    import typer
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
    sides: Annotated[bool, typer.Option(help="Try to pass obstacles on either side.")] = True,
) -> None:
    """Run the four scenarios; write their table, figures and animation."""
    with _one_line_errors():
        margin = Margin() if s_min is None else Margin(lower=s_min)
        settings = Settings(sides=sides)
        shape = cast(Literal["axes", "exact"], inflation)  # the problem checks it
        problems = {name: o.problem(shape, margin) for name, o in SCENARIOS.items()}
        as_count("steps", steps)
        if seed < 0:
            raise BoundsError("seed", f"{seed} is negative")
        out.mkdir(parents=True, exist_ok=True)
        runs = _simulate_all(problems, settings, steps, seed)
        summary = write_summary(runs, out)
        Console(markup=False).print(_table(summary["scenarios"]))
        typer.echo("Drawing ...")
        figures = write_figures(runs, out)
        written = f"summary.json, summary.md, {len(figures)} figures"
        if animation:
            run = next(run for run in runs if run.scenario.name == _ANIMATED)
            written += f", {write_animation(run, out / f'{_ANIMATED}.gif').name}"
        typer.echo(f"Written to {out}: {written}")


@app.command()
def bench(
    json: Annotated[Path | None, typer.Option(help="File for the numbers.")] = None,
    out: Annotated[Path | None, typer.Option(help="Directory for table and figure.")] = None,
    steps: Annotated[int, typer.Option(help="Control steps per horizon.")] = 200,
    seed: Annotated[int, typer.Option(help="Seed of the disturbance.")] = 0,
) -> None:
    """Time one control step against other solvers (extra: peers)."""
    with _one_line_errors():
        from scp_mpc.comparison import horizon_timing

        if seed < 0:
            raise BoundsError("seed", f"{seed} is negative")
        horizon_timing.main(json, out, steps, seed, echo=typer.echo)


def _simulate_all(
    problems: dict[str, Problem], settings: Settings, steps: int, seed: int
) -> list[ClosedLoop]:
    runs = []
    with tqdm(total=steps * len(problems), unit="step") as bar:
        for name, problem in problems.items():
            bar.set_description(name)
            runs.append(
                simulate(SCENARIOS[name], problem, settings, steps, seed, advance=bar.update)
            )
    return runs


def _table(scenarios: list[dict[str, Any]]) -> Table:
    """The table of the summary, turned so that it fits a terminal: one column per scenario."""
    name, *quantities = COLUMNS
    table = Table(name.header, *(name.cell(row) for row in scenarios))
    for column in table.columns[1:]:
        column.justify = "right"
    for quantity in quantities:
        table.add_row(quantity.header, *(quantity.cell(row) for row in scenarios))
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
