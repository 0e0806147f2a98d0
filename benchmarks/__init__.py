"""Benchmarks: what is compared, timed, soaked and drawn by Monte Carlo; not part of the wheel."""
