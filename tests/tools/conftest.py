"""A real browser, and silence."""

import shutil
import time

import pytest

from mjx_nero.tools.view import log

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
FLAGS = ("headless=new", "no-sandbox", "disable-gpu", "disable-dev-shm-usage")
FLAGS += ("use-angle=swiftshader", "enable-unsafe-swiftshader")
QUIET = ("disable-quic", "no-first-run", "disable-background-networking", "disable-component-update", "disable-sync")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Headless Chromium that draws in software and talks to this machine alone, whatever a page's address says."""
    if not (CHROMIUM and DRIVER):
        pytest.skip("no Chromium with its driver (Debian: apt-get install chromium chromium-driver)")
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    where = f"user-data-dir={tmp_path_factory.mktemp('browser')}"
    for flag in (*FLAGS, *QUIET, where, "host-resolver-rules=MAP * 127.0.0.1"):
        options.add_argument(f"--{flag}")
    options.add_argument("--window-size=900,700")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    driver.set_page_load_timeout(120)
    yield driver
    driver.quit()


@pytest.fixture
def silence(capfd, caplog):
    """Nothing with a traceback is written while the test runs; a line for ten seconds at most."""
    log.LOG.filters[0]._next = 0.0
    started = time.monotonic()
    yield
    out, err = capfd.readouterr()
    everything = out + err + caplog.text
    assert "Traceback" not in everything
    assert everything.count("view: ") <= 2 * (1 + (time.monotonic() - started) // log.EVERY_S)  # caplog has them a second time
    assert len(everything) < 5000
