"""A page of a report in a browser without a window, for tests."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

CATCH = """<script>window.faults = [];
window.addEventListener("error", e => window.faults.push(e.message));
window.addEventListener("unhandledrejection", e => window.faults.push(String(e.reason)));
console.error = (...words) => window.faults.push(words.join(" "));</script>"""

TRY = """<script>
const wait = setInterval(() => {
  if (document.body.dataset.ready !== "yes") return;
  clearInterval(wait);
  const found = {faults: window.faults};
  SCRIPT
  const output = document.createElement("pre");
  output.id = "found"; output.textContent = JSON.stringify(found);
  document.body.append(output);
}, 50);
</script>"""


def tried_in_browser(page: str, script: str, folder: Path, hash_: str = "") -> Any:
    """Return the object `found` that `script` fills once the page is ready; `faults` are its errors.

    The address of the page ends in `hash_`. The test is skipped where there is no Chromium.
    """
    chromium = os.environ.get("CHROMIUM") or next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None
    )
    if chromium is None:
        pytest.skip("no Chromium on the path, nor in the variable CHROMIUM")
    page = page.replace("<head>", "<head>" + CATCH).replace("</body>", TRY.replace("SCRIPT", script) + "</body>")
    path = folder / "page.html"
    path.write_text(page, encoding="utf-8")
    done = subprocess.run(
        [chromium, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}",
         "--window-size=1300,900", "--virtual-time-budget=10000", "--dump-dom", path.as_uri() + hash_],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    match = re.search(r'<pre id="found">(.*?)</pre>', done.stdout)
    assert match is not None, done.stdout[-2000:]
    return json.loads(html.unescape(match[1]))
