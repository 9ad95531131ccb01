"""Pages: that they stand alone; and a real browser, where there is one: what a page's own script did to it."""

import html
import json
import re
import shutil
import subprocess

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on PATH: the page's script was not run")


def assert_stands_alone(text):
    """It fetches nothing, and no id is there twice."""
    assert not re.findall(r"https?:|@import|url\((?!#)|\bsrc=|<link|<iframe", text)
    ids = re.findall(r'\bid="([^"]*)"', text)
    assert len(ids) == len(set(ids))


def browse(page, profile):
    """The page's DOM after its scripts ran, and whatever the console said."""
    flags = ["--headless", "--no-sandbox", "--no-first-run", "--dump-dom", "--enable-logging=stderr"]
    flags += ["--window-size=1280,900", "--virtual-time-budget=10000", f"--user-data-dir={profile}", page.as_uri()]
    flags += [f"--disable-{x}" for x in ("background-networking", "component-update", "sync", "gpu", "dev-shm-usage")]
    done = subprocess.run([CHROMIUM, *flags], capture_output=True, text=True, timeout=120, check=True)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


BEGIN = """<script>
const wait = setInterval(() => {
  if (!root.dataset.ready) return;
  clearInterval(wait);
  const $ = (selector) => document.querySelector(selector);
  const active = () => document.activeElement ?? document.body;
  const press = (key) => active().dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
"""
END = """  root.dataset.seen = JSON.stringify(seen);
}, 20);
</script></body>"""


def seen(folder, text, script):
    """What a script leaves in `seen` that runs after those of the page; none of them failed, and the console is empty.

    It has `$(selector)`, `active()`, the element with the focus, and `press(key)`.
    """
    page = folder / "report.html"
    page.write_text(text.replace("</body>", f"{BEGIN}{script}{END}"), "utf-8")
    dom, console = browse(page, folder / "profile")
    assert console == []
    tag = re.search("<html[^>]*>", dom)[0]
    assert 'data-ready="1"' in tag and "data-error" not in tag
    return json.loads(html.unescape(re.search('data-seen="([^"]*)"', tag)[1]))
