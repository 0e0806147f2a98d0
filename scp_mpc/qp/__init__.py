"""Quadratic programs and who solves them."""
