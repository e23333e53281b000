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
  (async () => { SCRIPT })().catch(error => window.faults.push(String(error))).then(() => {
    const output = document.createElement("pre");
    output.id = "found"; output.textContent = JSON.stringify(found);
    document.body.append(output);
  });
}, 50);
</script>"""


def with_script(page: str, script: str) -> str:
    """A page that fills the object `found` by `script`, which may await, once it is ready; `faults` are its errors."""
    return page.replace("<head>", "<head>" + CATCH).replace("</body>", TRY.replace("SCRIPT", script) + "</body>")


def found_at(url: str, folder: Path, size: str = "1300,900") -> Any:
    """Return the object `found` of a page at an address. The test is skipped where there is no Chromium."""
    chromium = os.environ.get("CHROMIUM") or next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None
    )
    if chromium is None:
        pytest.skip("no Chromium on the path, nor in the variable CHROMIUM")
    done = subprocess.run(
        [chromium, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}",
         f"--window-size={size}", "--virtual-time-budget=60000", "--dump-dom", url],
        capture_output=True, text=True, check=True, timeout=300,
    )  # fmt: skip
    match = re.search(r'<pre id="found">(.*?)</pre>', done.stdout)
    assert match is not None, done.stdout[-2000:]
    return json.loads(html.unescape(match[1]))


def tried_in_browser(page: str, script: str, folder: Path, hash_: str = "") -> Any:
    """Return the object `found` of `with_script` for a page from disk, whose address ends in `hash_`."""
    path = folder / "page.html"
    path.write_text(with_script(page, script), encoding="utf-8")
    return found_at(path.as_uri() + hash_, folder)
