"""Names of association methods in settings and options."""

from typing import Literal

AssociationName = Literal["hungarian", "greedy", "graph"]
