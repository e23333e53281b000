"""The page "How to add a factor" runs as printed, top to bottom."""

import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "add-a-factor.md"


def test_page_runs(run_apart):
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    assert len(blocks) >= 8
    out = run_apart("\n".join(blocks)).splitlines()
    assert out[0].startswith("hidden car: [")
    assert "does not determine" in out[1]
