"""Time one control step at N = 8 and N = 30 against IPOPT and SLSQP; print a Markdown table.

    python benchmarks/horizon_timing.py --out out/bench

writes horizon_timing.json, .md and .png. 200 steps take about two minutes.
"""

import argparse
from pathlib import Path

from scp_mpc.comparison.horizon_timing import NAME, SLOW_STEPS, main

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--json", type=Path, help="file for the numbers; default: in --out")
    parser.add_argument("--steps", type=int, default=200, help="control steps per horizon")
    parser.add_argument("--seed", type=int, default=0, help="seed of the disturbance")
    parser.add_argument(
        "--slow-steps", type=int, default=SLOW_STEPS, help="of these, steps for SLSQP at N = 30"
    )
    arguments = parser.parse_args()
    main(
        arguments.json or arguments.out / f"{NAME}.json",
        arguments.out,
        arguments.steps,
        arguments.seed,
        arguments.slow_steps,
        print,
    )
