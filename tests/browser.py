"""A browser for the pages: Chromium from the path, from Debian where we are root, or playwright's own."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, Playwright, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]


@contextmanager
def browser() -> Iterator[Browser]:
    """Chromium without a window. It is installed if there is none."""
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=_path(playwright), args=OPTIONS)
        yield opened
        opened.close()


def _path(playwright: Playwright) -> str:
    tried = []
    for install in (None, _from_debian, _from_playwright):
        if install is not None:
            tried.append(install())
        found = next(filter(None, map(shutil.which, NAMES)), playwright.chromium.executable_path)
        if os.path.exists(found):
            return found
    pytest.fail(
        "the pages need Chromium to be tested: install it (Debian: apt-get install chromium)\n" + "\n".join(tried)
    )


def _from_debian() -> str:
    if shutil.which("apt-get") is None or os.geteuid() != 0:
        return "apt-get: not here, or not root"
    quiet = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for step in (["update"], ["install", "-y", "--no-install-recommends", "chromium"]):
        done = subprocess.run(["apt-get", "-qq", *step], capture_output=True, text=True, env=quiet, check=False)
    return f"apt-get: {done.stderr[-500:]}"


def _from_playwright() -> str:
    command = [sys.executable, "-m", "playwright", "install", "chromium"]
    return f"playwright: {subprocess.run(command, capture_output=True, text=True, check=False).stderr[-500:]}"
