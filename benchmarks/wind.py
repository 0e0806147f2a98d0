"""Measure how well the robot tracks under wind, with and without disturbance rejection.

    python benchmarks/wind.py --out benchmarks/results
    python benchmarks/wind.py --out out/wind --seeds 5 --steps 200

Writes wind.md, wind.json and wind.png, and wind.jsonl from which an interrupted run goes on.
"""

import argparse
from pathlib import Path

from scp_mpc.comparison import wind

if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--seeds", type=int, default=wind.SEEDS, help="winds per variant")
    parser.add_argument("--steps", type=int, default=wind.STEPS, help="control steps per run")
    parser.add_argument("--workers", type=int, default=wind.WORKERS, help="processes")
    arguments = parser.parse_args()
    wind.main(arguments.out, arguments.seeds, arguments.steps, arguments.workers, print)
