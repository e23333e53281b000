"""Random scene graphs, as the package has them for users' own tests."""

from saga_fg.conformance.programs import *  # noqa: F403
