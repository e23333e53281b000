"""Settings of SLAM in submaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from factors import Robust
from saga_fg.settings import Positive, Range, Settings, setting

GATE = 0.999  # gate probability of association


@dataclass(frozen=True)
class SubmapSettings(Settings):
    """Size of submaps, association and confirmation of landmarks."""

    length: Positive = setting(30.0, "way after which the next submap begins, m; usual 20 to 50; higher: slower")
    confirm_after: Annotated[int, Range(1, 10**9)] = setting(4, "observations that confirm a landmark")
    relinearise_above: Positive = setting(
        0.5, "linearise factors again when a variable moved by this many standard deviations; higher: faster"
    )
    robust_scale: Positive = setting(
        3.0,
        "residual from which losses discount poles and curbs (Geman-McClure) and loops (Cauchy, which pulls from far), "
        "standard deviations",
    )

    @property
    def robust(self) -> Robust:
        """The loss of landmarks."""
        return Robust("geman-mcclure", self.robust_scale)

    @property
    def robust_loops(self) -> Robust:
        """The loss of loops."""
        return Robust("cauchy", self.robust_scale)
