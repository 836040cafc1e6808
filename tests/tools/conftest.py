"""A real browser."""

import shutil

import pytest

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
    for flag in (*FLAGS, *QUIET, f"user-data-dir={tmp_path_factory.mktemp('browser')}", "host-resolver-rules=MAP * 127.0.0.1"):
        options.add_argument(f"--{flag}")
    options.add_argument("--window-size=900,700")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    driver.set_page_load_timeout(120)
    yield driver
    driver.quit()
