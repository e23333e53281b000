"""Benchmarks run from a clone, `python -m benchmarks NAME`: each figure beside a baseline measured in the same run."""
