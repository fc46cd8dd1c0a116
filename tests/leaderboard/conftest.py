"""The example of a board, and a browser, for all tests of the site."""

import helpers_browser
import helpers_site
import pytest


@pytest.fixture(scope="session")
def reported(tmp_path_factory):
    """Tables of reported rows; see `helpers_site.example`."""
    return helpers_site.example(tmp_path_factory.mktemp("results"))


@pytest.fixture(scope="session")
def season():
    """A season; see `helpers_site.season`."""
    return helpers_site.season()


@pytest.fixture(scope="session")
def window(tmp_path_factory):
    """One window of a browser, which the last test has left as it likes."""
    if helpers_browser.programs() is None:
        pytest.skip("no chromium with chromedriver on this machine (Debian: chromium-driver)")
    with helpers_browser.launch(tmp_path_factory.mktemp("browser")) as window:
        yield window
