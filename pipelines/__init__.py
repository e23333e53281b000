"""Pipelines of saga-fg: online tracking, and the `saga-fg` command."""
