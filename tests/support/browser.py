"""Checks of HTML pages: that they need no other files, and the effects of their scripts in a real browser."""

import html
import json
import re
import resource
import shutil
import subprocess

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
LIMITED = resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY
MISSING = "no Chromium on PATH" if CHROMIUM is None else "Chromium needs unlimited address space" if LIMITED else ""
needs_chromium = pytest.mark.skipif(MISSING != "", reason=f"{MISSING}: the page's script was not run")


def assert_stands_alone(text):
    """Check that a page fetches nothing and has unique ids."""
    assert not re.findall(r"https?:|@import|url\((?!#)|\bsrc=|<link|<iframe", text)
    ids = re.findall(r'\bid="([^"]*)"', text)
    assert len(ids) == len(set(ids))


def browse(page, profile):
    """Return the page's DOM after its scripts ran, and the lines of the browser's console."""
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
    """Run a script after the page's own scripts and return its variable `seen`.

    The script can use `$(selector)`, `active()` (the element with the focus) and `press(key)`. No script may fail, and
    the console must stay empty.
    """
    page = folder / "report.html"
    page.write_text(text.replace("</body>", f"{BEGIN}{script}{END}"), "utf-8")
    dom, console = browse(page, folder / "profile")
    assert console == []
    tag = re.search("<html[^>]*>", dom)[0]
    assert 'data-ready="1"' in tag and "data-error" not in tag
    return json.loads(html.unescape(re.search('data-seen="([^"]*)"', tag)[1]))
