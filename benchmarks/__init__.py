"""Benchmarks: scripts that anyone can run; their results lie in ``results/``."""
