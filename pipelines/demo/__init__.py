"""The demonstration: simulated traffic, tracked with every method, compared, drawn, and to be played in a browser."""

from pipelines.demo.run import DemoResult, run_demo

__all__ = ["DemoResult", "run_demo"]
