"""Measure how often robot and obstacles touch, against what was promised.

    python benchmarks/risk.py --out benchmarks/results
    python benchmarks/risk.py --out out/risk --samples 5000 --episodes 20

Writes risk.md, risk.json and risk.png, and risk.jsonl from which an interrupted run goes on.
"""

import argparse
from pathlib import Path

from scp_mpc.comparison import risk

if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--samples", type=int, default=risk.SAMPLES, help="per scene and promise")
    parser.add_argument("--episodes", type=int, default=risk.EPISODES, help="per promise")
    parser.add_argument("--seed", type=int, default=0, help="of everything that is drawn")
    arguments = parser.parse_args()
    risk.main(arguments.out, arguments.samples, arguments.episodes, arguments.seed, print)
