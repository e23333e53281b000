"""`python -m benchmarks`."""

from pipelines.cli.main import run

if __name__ == "__main__":
    run("benchmarks.app", "python -m benchmarks")
